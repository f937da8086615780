"""The figures of docs/results.md, a program each: `python -m benchmarks.studies.NAME`."""

"""A fuzzer of the command line: every kind of input is damaged, and the promise must hold.

The promise: exit status 0, 1 or 2; on 1 and 2 nothing on stdout, one last line on stderr that
begins ``multipos: error: ``, no file made or touched; on 0 with ``--json`` one valid JSON object;
never JSON that the commands that read it refuse, a traceback, a Python warning, a changed input or
a temporary file left; less than 20 s of CPU and 2 GB of memory.

From the root of the repository::

    python -m tests.fuzzing all --seed 1 --cases 4200 -j 2 --keep found     # 100,000 inputs
    python -m tests.fuzzing calibrations --seed 1 --only 417                # one case again

Case n of a kind and seed depends on nothing else, so a finding is run again from these three.
Read `kinds` first: which inputs there are. `bases` makes the valid files that the damage starts
from, `recipes` are the valid command lines, `hostile` the values nobody expects, `tables`,
`json_files`, `toml_files`, `arrays`, `recordings`, `options` and `raw` do the damage,
`visits` asks what the page asks, `crossing` combines what is valid, `running` runs a case in a
process of its own, `judging` holds the promise, `findings` collects what broke it.
"""

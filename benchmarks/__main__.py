"""Run every benchmark, or those named, and print one table.

It begins with the date, the machine, the threads of linear algebra and the versions; with ``-o`` it
is written as a page.
"""

import argparse
import datetime
import importlib
import os
import pkgutil
import platform
from collections.abc import Sequence
from pathlib import Path

# Before NumPy is imported, as the command line has it; whoever sets them measures others.
THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
if not any(name in os.environ for name in THREADS):
    os.environ.update(dict.fromkeys(THREADS, "1"))

import numpy as np  # noqa: E402

import benchmarks  # noqa: E402
import multipos  # noqa: E402
from benchmarks.timing import Ratio  # noqa: E402

HEADINGS = ("what", "peer", "ratio", "min–max", "goal", "")


def main() -> None:
    names = [
        module.name.removeprefix("bench_")
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name.startswith("bench_")
    ]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}")
    parser.add_argument("-o", dest="page", type=Path, metavar="PAGE.md", help="write a page")
    arguments = parser.parse_args()
    chosen = arguments.names or names
    if unknown := set(chosen) - set(names):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(names)}")

    ratios: list[Ratio] = []
    for name in chosen:
        ratios += importlib.import_module(f"benchmarks.bench_{name}").run()

    rows = [HEADINGS, *map(row, ratios)]
    if arguments.page is not None:
        arguments.page.write_text(page(rows), encoding="utf-8")
    print(circumstances())
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for cells in rows:
        line = "  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        print(line.rstrip())


def circumstances() -> str:
    """Return where and when it was measured, in a line."""
    stated = next((os.environ[name] for name in THREADS if name in os.environ), "any")
    return (
        f"{datetime.date.today()}, {processor()}, {os.cpu_count()} processors, {stated} thread of "
        f"linear algebra, Python {platform.python_version()}, NumPy {np.__version__}, multipos "
        f"{multipos.__version__}"
    )


def processor() -> str:
    """Return the name of the processor, or at least its kind."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(encoding="utf-8").splitlines() if known.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def page(rows: Sequence[Sequence[str]]) -> str:
    """Return the table as a page."""
    head, *body = rows
    marks = ["---"] * len(head)
    lines = [f"| {' | '.join(cells)} |" for cells in (head, marks, *body)]
    return "\n".join(
        [
            "# Performance",
            "",
            "Time of ours over that of the peer, in pairs, by `python -m benchmarks -o PAGE.md`.",
            f"{circumstances()}.",
            "",
            *lines,
            "",
        ]
    )


def row(ratio: Ratio) -> tuple[str, ...]:
    return (
        ratio.what,
        ratio.peer,
        f"{ratio.median:.3g}",
        f"{ratio.low:.3g}–{ratio.high:.3g}",
        f"≤ {ratio.goal:g}",
        "" if ratio.median <= ratio.goal else "missed",
    )


if __name__ == "__main__":
    main()

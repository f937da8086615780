"""Run every benchmark, or those named, and print one table."""

import argparse
import importlib
import pkgutil

import benchmarks
from benchmarks.timing import Ratio

HEADINGS = ("what", "peer", "ratio", "min–max", "goal", "")


def main() -> None:
    names = [
        module.name.removeprefix("bench_")
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name.startswith("bench_")
    ]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}")
    chosen = parser.parse_args().names or names
    if unknown := set(chosen) - set(names):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(names)}")

    ratios: list[Ratio] = []
    for name in chosen:
        ratios += importlib.import_module(f"benchmarks.bench_{name}").run()

    rows = [HEADINGS, *map(row, ratios)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for cells in rows:
        line = "  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        print(line.rstrip())


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

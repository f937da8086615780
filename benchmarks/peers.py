"""multipos beside its peers, on the same simulations and recordings: one table.

Of every program: how often it came to a result without a first guess; rms of |f| − 1 over the means
of the rests; error, which is rms of |f| − 1 at 500 new directions without noise, and the error of
the zero, both against the truth of a simulation; U (95 %) of the zero and how often it held; what
it says against its own result; and the time that multipos takes over that of the peer, one after
the other in this run, for what a user calls. Readings are in g, or divided by their nominal g.
"""

import argparse
import logging
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.peer_programs import PROGRAMS, Found, NoAdviceError, NotDoneError, Program, plain
from benchmarks.peer_tasks import Array, Task, directions, recorded, simulated
from benchmarks.timing import paired_ratio

NEW = directions(500, np.random.default_rng(0))
HEADINGS = ("program", "ended", "rms [µg]", "error [µg]", "zero [µg]", "U of zero [µg]", "U held")
HEADINGS += ("says", "time")


@dataclass
class Row:
    """What one program made of one kind of recording, run after run."""

    program: Program
    tried: int = 0
    ended: int = 0
    rms: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    zero: list[Array] = field(default_factory=list)
    U: list[Array] = field(default_factory=list)
    says: dict[str, int] = field(default_factory=dict)
    time: float | None = None

    def add(self, task: Task, found: Found) -> None:
        self.ended += 1
        self.rms.append(off_sphere(found, task.rests))
        if found.U is not None:
            self.U.append(found.U / task.per_g)
        if task.truth is not None:
            self.error.append(off_sphere(found, task.truth.read(NEW)))
            self.zero.append((found.zero - task.truth.zero) / task.per_g)
        if found.says:
            self.says[found.says] = self.says.get(found.says, 0) + 1

    def cells(self) -> list[str]:
        held = "–"
        if self.U and self.zero:
            held = f"{100 * np.mean(np.abs(self.zero) <= np.array(self.U)):.0f} %"
        said = max(self.says, key=lambda text: self.says[text]) if self.says else "–"
        return [
            self.program.name,
            "yes" if self.ended == self.tried else f"{self.ended} of {self.tried}",
            micro(self.rms),
            micro(self.error),
            micro(self.zero),
            micro(self.U) if self.U else "none",
            held,
            f"{said} ({self.says[said]})" if self.says and self.tried > 1 else said,
            "–" if self.time is None else f"{self.time:.2g}",
        ]


def off_sphere(found: Found, raw: Array) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(found.force(raw), axis=1) - 1.0) ** 2)))


def micro(values: Iterable[object]) -> str:
    """Return the root mean square in micro-units, as three digits."""
    all_values = np.array([np.asarray(value, dtype=float) for value in values])
    if not all_values.size:
        return "–"
    return f"{float(f'{1e6 * np.sqrt(np.mean(all_values**2)):.3g}'):g}"


def compare(task: Task, table: dict[str, Row], pairs: int) -> None:
    """Give one task to every program that takes it; the first run is timed as well."""
    for program in PROGRAMS:
        if task.kind not in program.kinds or program.version is None:
            continue
        row = table.setdefault(program.name, Row(program))
        row.tried += 1
        try:
            found = program.run(task)
        except NoAdviceError:
            row.tried -= 1
            continue
        except (NotDoneError, ValueError, ArithmeticError):
            continue
        row.add(task, found)
        if row.ended == 1 and pairs and program.package != "multipos":
            ratios = paired_ratio(
                lambda: plain(task), lambda run=program.run: run(task), repeats=pairs, inner=1
            )
            row.time = float(np.median(ratios))


def print_table(tables: dict[str, dict[str, Row]]) -> None:
    print("| recording |", " | ".join(HEADINGS), "|")
    print("|---" * (len(HEADINGS) + 1) + "|")
    for name, table in tables.items():
        for row in table.values():
            if row.tried:
                print(f"| {name} |", " | ".join(row.cells()), "|")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, help="of the recordings")
    parser.add_argument("--runs", type=int, default=20, help="of each simulation")
    parser.add_argument("--pairs", type=int, default=5, help="to time; 0 leaves times out")
    chosen = parser.parse_args()
    if chosen.folder is not None and not chosen.folder.is_dir():
        parser.error(f"{chosen.folder} is no folder")
    warnings.simplefilter("ignore")
    logging.disable()
    tables: dict[str, dict[str, Row]] = {}
    for seed in range(chosen.runs):
        for task in simulated(seed):
            compare(task, tables.setdefault(task.name, {}), chosen.pairs)
    for task in recorded(chosen.folder) if chosen.folder else ():
        compare(task, tables.setdefault(task.name, {}), chosen.pairs)
    print_table(tables)
    known = {program.package: program.version for program in PROGRAMS}
    print("\nwith", ", ".join(f"{name} {found}" for name, found in known.items() if found))
    if missing := [name for name, found in known.items() if not found]:
        print(f"not installed: {', '.join(missing)}; pip install {' '.join(missing)}")


if __name__ == "__main__":
    main()

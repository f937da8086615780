"""Change lines on purpose and see whether the tests of their subject notice.

`python -m tests.mutation [ROOM …] --samples N --seed S` draws changes evenly over the rooms that
compute. Which tests reach a line is measured once by room (coverage with contexts); of a change the
tests that reach it are run until one fails. Printed are the changes that no test noticed, and the
caught of each room. A change that takes longer than three minutes counts as caught: it hangs.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.mutation.changes import Change, changes_of

ROOMS = (
    "numerics",
    "estimation",
    "uncertainty",
    "regression",
    "diagnostics",
    "designs",
    "logs",
    "fleets",
    "exports",
    "capturing",
    "verification",
    "bias_stability",
    "compensation",
)
_LONGEST = 180.0  # seconds of one change
_TESTS = 40  # that reach a line, of which more would only take longer


def main() -> int:
    """Run the programme; the status is 0 whatever survives."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("rooms", nargs="*", default=[], metavar="ROOM")
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rooms = arguments.rooms or list(ROOMS)
    drawn = draw(rooms, arguments.samples, arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "project"
        shutil.copytree(".", root, ignore=shutil.ignore_patterns(".*", "_build", "__pycache__"))
        print("room, changed, caught")
        for room in rooms:
            if drawn[room]:
                survivors = _try_all(root, room, drawn[room])
                print(
                    f"{room}, {len(drawn[room])}, {len(drawn[room]) - len(survivors)}", flush=True
                )
                print("".join(f"  survived: {each}\n" for each in survivors), end="", flush=True)
    return 0


def draw(rooms: Sequence[str], samples: int, seed: int) -> dict[str, list[Change]]:
    """Return changes drawn evenly over rooms."""
    generator = random.Random(seed)
    drawn = {}
    for place, room in enumerate(rooms):
        files = sorted(Path("multipos", room).glob("*.py"))
        every = [change for path in files for change in changes_of(path)]
        count = samples // len(rooms) + (place < samples % len(rooms))
        drawn[room] = generator.sample(every, min(count, len(every)))
    return drawn


def _try_all(root: Path, room: str, changes: Sequence[Change]) -> list[Change]:
    """Return the changes of a room that its tests do not notice."""
    from coverage import CoverageData

    tests = _tests_of(root, room)
    _pytest(root, "--cov-map", tests)
    data = CoverageData(str(root / ".coverage"))
    data.read()
    survivors = []
    for change in changes:
        reached = data.contexts_by_lineno(str(root / change.path)).get(change.line, [])
        names = sorted(filter(None, reached))[:_TESTS]
        kept = (root / change.path).read_bytes()
        change.apply(root)
        try:
            if not names or _pytest(root, "-x", [_as_argument(root, name) for name in names]) == 0:
                survivors.append(change)
        finally:
            (root / change.path).write_bytes(kept)
    return survivors


def _tests_of(root: Path, room: str) -> list[str]:
    folder = root / "tests" / room
    return [str(folder)] if folder.is_dir() else [str(root / "tests" / "test_fitting.py")]


def _as_argument(root: Path, name: str) -> str:
    """Return the test whose dotted name coverage gives, as pytest takes it, of all its cases."""
    module, _, function = name.rpartition(".")
    parts = module.split(".")
    if (root / "tests" / Path(*parts)).with_suffix(".py").exists():
        parts = ["tests", *parts]
    return f"{root / Path(*parts)}.py::{function}"


def _pytest(root: Path, mode: str, tests: Sequence[str]) -> int:
    """Return the status of pytest in a copy of the project; of one that hangs, a failure."""
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m"]
    if mode == "--cov-map":
        setting = root / ".coveragerc"
        setting.write_text("[run]\ndynamic_context = test_function\nsource = multipos\n")
        command += ["coverage", "run", f"--rcfile={setting}", "-m", "pytest", "-q"]
    else:
        command += ["pytest", "-q", mode]
    try:
        found = subprocess.run(
            [*command, "-p", "no:cacheprovider", *dict.fromkeys(tests)],
            cwd=root,
            env=environment,
            capture_output=True,
            timeout=_LONGEST if mode == "-x" else None,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return 1
    return found.returncode


if __name__ == "__main__":
    sys.exit(main())

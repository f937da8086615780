"""Change lines on purpose and see whether the tests of their subject notice.

`python -m tests.mutation [ROOM …] --samples N --seed S` draws changes evenly over the rooms that
compute and tries them in turn, a room after the other, so that one may stop at any time (Ctrl-C)
and have as many of each. Printed are the changes that no test noticed, and the caught of each room.
"""

import argparse
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

from tests.mutation.changes import Change, changes_of
from tests.mutation.trying import Reached, is_noticed, tests_that_reach

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


def main() -> int:
    """Run the programme; the status is 0 whatever survives."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("rooms", nargs="*", default=[], metavar="ROOM")
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    drawn = draw(arguments.rooms or ROOMS, arguments.samples, arguments.seed)
    tried: Counter[str] = Counter()
    caught: Counter[str] = Counter()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "project"
        shutil.copytree(".", root, ignore=shutil.ignore_patterns(".*", "_build", "__pycache__"))
        try:
            for room, change, noticed in _try_all(root, drawn):
                tried[room] += 1
                caught[room] += noticed
                if not noticed:
                    print(f"survived: {change}", flush=True)
        except KeyboardInterrupt:
            pass
    print("room, changed, caught")
    for room in drawn:
        print(f"{room}, {tried[room]}, {caught[room]}")
    print(f"all, {tried.total()}, {caught.total()}")
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


def _try_all(root: Path, drawn: dict[str, list[Change]]) -> Iterator[tuple[str, Change, bool]]:
    """Yield each change with its room and whether the tests of the room notice it."""
    reached: dict[str, Reached] = {}
    for changes in zip_longest(*drawn.values()):
        for room, change in zip(drawn, changes, strict=True):
            if change is not None:
                if room not in reached:
                    reached[room] = tests_that_reach(root, room)
                yield room, change, is_noticed(root, change, reached[room])


if __name__ == "__main__":
    sys.exit(main())

"""Try one change: the tests that reach its line, the quickest first, in a process forked for it.

Which tests reach a line is measured once by room. The parent has imported the large libraries but
nothing of the project, so that a fork reads the changed file and little else. A test that fails
without a change is left out. A change hangs, and is caught, that takes three minutes of the
processor, or by the clock ten times what the tests took of the processor without it: a loaded
machine is no reason to be.
"""

import contextlib
import importlib
import json
import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tests.mutation.changes import Change

_LONGEST = 180  # seconds of the processor of one change
_FIRST = 12  # tests, that are tried before others are collected
_STILL = 10.0  # by the clock, in what the tests took of the processor; half a minute for the start
_ENOUGH = 40.0  # seconds of tests for one change, as they took without it
# Where tests of a room's files stand beside its own.
_BESIDE = {
    "estimation": ("tests/fleets/test_kernels.py", "tests/sensor/test_magnetometer.py"),
    "logs": ("tests/sensor/test_magnetometer.py",),
    "diagnostics": (
        "tests/fleets/test_unit_findings.py",
        "tests/sensor/test_diagnostics.py",
        "tests/sensor/test_magnetometer.py",
        "tests/uncertainty/test_claims.py",
    ),
    "compensation": (
        "tests/sensor/test_parity.py",
        "tests/sensor/test_magnetometer.py",
        "tests/regression/test_regress.py",
        "tests/regression/test_several.py",
    ),
    "exports": ("tests/sensor/test_magnetometer.py",),
    "capturing": ("tests/sensor/test_magnetometer.py",),
    "fleets": ("tests/uncertainty/test_claims.py",),
    "uncertainty": ("tests/verification/test_inclinometer.py",),
}
_LIBRARIES = (
    "numpy",
    "numpy.testing",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.special",
    "scipy.stats",
    "hypothesis",
    "pytest",
)


@dataclass(frozen=True)
class Reached:
    """What the tests of a room reach.

    Attributes
    ----------
    seconds : dict
        Of each test that passes.
    lines : dict
        The tests that reach a line of a file.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests_of(self, change: Change) -> list[str]:
        """Return the tests to try a change with: those of its line, of its file, and the others.

        What a cache or a fixture kept of a line shows which test asked first, and no other.
        """
        file = self.lines.get(str(change.path), {})
        rest = {name for names in file.values() for name in names}
        chosen: list[str] = []
        for names in (file.get(change.line, []), rest, self.seconds):
            known = sorted(self.seconds.keys() & set(names), key=self.seconds.__getitem__)
            chosen += [name for name in _each_function_first(known) if name not in set(chosen)]
        left = _ENOUGH
        return [name for name in chosen if (left := left - self.seconds[name]) > 0]

    def longest(self, names: Sequence[str]) -> float:
        """Return after how many seconds by the clock tests hang."""
        return 30.0 + _STILL * sum(self.seconds[name] for name in names)


def _each_function_first(names: Sequence[str]) -> list[str]:
    """Return tests in order, but one case of each function before the others."""
    seen: dict[str, int] = {}
    rank = {}
    for name in names:
        function = name.partition("[")[0]
        rank[name] = seen[function] = seen.get(function, -1) + 1
    return sorted(names, key=lambda name: min(rank[name], 1))


def tests_that_reach(root: Path, room: str) -> Reached:
    """Run the tests of a room in a copy of the project and return what they reach."""
    kept = root / f".reached-{room}"
    _forked(root, lambda: _measure(root, room, kept), math.inf)
    seconds, lines = json.loads(kept.read_text())
    return Reached(
        seconds, {path: {int(n): of for n, of in at.items()} for path, at in lines.items()}
    )


def is_noticed(root: Path, change: Change, reached: Reached) -> bool:
    """Tell whether a test fails with a change."""
    names = reached.tests_of(change)
    if not names:
        return False
    file = root / change.path
    kept = file.read_bytes()
    change.apply(root)
    try:
        parts = [part for part in (names[:_FIRST], names[_FIRST:]) if part]
        return any(
            _forked(root, partial(_limited, ["-x", *part]), reached.longest(part)) != 0
            for part in parts
        )
    finally:
        file.write_bytes(kept)


def _limited(arguments: Sequence[str]) -> int:
    resource.setrlimit(resource.RLIMIT_CPU, (_LONGEST, _LONGEST))
    return _pytest(arguments)


class _Recorder:
    """A plugin that keeps the seconds of each test and names it to the measurement.

    Seconds are of the processor, its children's too, so that a loaded machine has as many tests.
    """

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.begin = 0.0

    def pytest_runtest_protocol(self, item: Any) -> None:
        self.begin = sum(os.times()[:4])
        self.coverage.switch_context(item.nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.seconds[report.nodeid] = sum(os.times()[:4]) - self.begin
        if not report.passed:
            self.failed.add(report.nodeid)


def _measure(root: Path, room: str, kept: Path) -> int:
    from coverage import Coverage

    coverage = Coverage(data_file=None, source=[str(root / "multipos" / room)])
    recorder = _Recorder(coverage)
    coverage.start()
    status = _pytest([f"tests/{room}", *_BESIDE.get(room, ())], plugins=[recorder])
    coverage.stop()
    data = coverage.get_data()
    lines = {
        str(Path(path).relative_to(root)): data.contexts_by_lineno(path)
        for path in data.measured_files()
    }
    passed = {name: s for name, s in recorder.seconds.items() if name not in recorder.failed}
    kept.write_text(json.dumps([passed, lines]))
    return status


def _pytest(arguments: Sequence[str], plugins: Sequence[object] = ()) -> int:
    import pytest

    # Hypothesis is among the libraries that are imported before.
    settings = ["-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return int(pytest.main([*settings, *arguments], plugins=list(plugins)))


def _forked(root: Path, work: Callable[[], int], longest: float) -> int:
    """Return the status of work in a fork that stands in a copy of the project."""
    for name in _LIBRARIES:
        importlib.import_module(name)
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            _settle(root)
            status = work()
        finally:
            os._exit(status)
    return _waited(child, longest)


def _settle(root: Path) -> None:
    """Make the copy the project of this process and of those it starts, silent, with one seed."""
    os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(silent, stream)
    os.chdir(root)
    elsewhere = {*os.environ.get("PYTHONPATH", "").split(os.pathsep)}
    sys.path[:] = [str(root), *(path for path in sys.path[1:] if path not in elsewhere)]
    for name in [name for name in sys.modules if name.partition(".")[0] in ("tests", "multipos")]:
        del sys.modules[name]
    # Two versions of a file in one second look alike to a byte-code cache.
    sys.dont_write_bytecode = True
    os.environ.update(PYTHONPATH=str(root), PYTHONDONTWRITEBYTECODE="1", CI="1")


def _waited(child: int, longest: float) -> int:
    """Return the status of a process; of one that hangs, a failure. None is left alive."""
    end = time.monotonic() + longest
    found = 0
    try:
        while time.monotonic() < end:
            found, status = os.waitpid(child, os.WNOHANG)
            if found:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        return 1
    finally:
        if not found:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.kill(child, signal.SIGKILL)  # it may lead no group yet
            os.waitpid(child, 0)

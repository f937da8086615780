"""Time two things side by side: ours, peer, ours, peer, …

Each pair gives one ratio, so what slows the machine for a while slows both sides of it; the median
then ignores the pairs that were hit on one side only. A ratio says the same on every machine, a
time does not.
"""

import resource
import statistics
import subprocess
import time
import timeit
from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Ratio:
    """Time of ours over time of the peer, one value a pair, and the largest median we want."""

    what: str
    peer: str
    pairs: Sequence[float]
    goal: float

    @property
    def median(self) -> float:
        return statistics.median(self.pairs)

    @property
    def low(self) -> float:
        return min(self.pairs)

    @property
    def high(self) -> float:
        return max(self.pairs)


def paired_ratio(
    ours: Callable[[], object],
    peer: Callable[[], object],
    *,
    repeats: int = 25,
    inner: int = 20,
    timer: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Time two callables, `inner` calls at a time."""
    a, b = timeit.Timer(ours, timer=timer), timeit.Timer(peer, timer=timer)
    return _pairs(lambda: a.timeit(inner), lambda: b.timeit(inner), repeats)


def paired_process_ratio(
    ours: Sequence[str],
    peer: Sequence[str],
    *,
    repeats: int = 15,
    timer: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Time two whole processes, from their start to their end."""
    return _pairs(lambda: _process_time(ours, timer), lambda: _process_time(peer, timer), repeats)


def time_of_children() -> float:
    """Return the processor time [s] of the processes that were started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _pairs(ours: Callable[[], float], peer: Callable[[], float], repeats: int) -> list[float]:
    ours(), peer()  # the first of each fills caches
    return [ours() / peer() for _ in range(repeats)]


def _process_time(argv: Sequence[str], timer: Callable[[], float]) -> float:
    start = timer()
    subprocess.run(argv, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=True)
    return timer() - start

"""Where a log stands still: the rests between the motions.

`choose_grid` chooses windows, `find_edges` returns where runs of them begin and end, `long_enough`
and `is_long` which of them are rests; `read_sections` reads rests that the user knows.

A single sample, or two, far from the fifteen around it, is a spike and takes their median. Samples
are then taken in blocks, and `W` = 8 blocks make a window of half a second that slides by a block.
The standard deviation of a window, and that of the means of its blocks, the largest of all outputs,

    s = max_j sqrt( sum_i (y_ij - mean_j)² / (8 B - 1) ),                                   (1)
    v = max_j sqrt( sum_b (mean_bj - mean_j)² / 7 ),                                        (2)

are the sensor's noise where nothing moves and much more where something does. Over a whole log
log s has a narrow peak at rest and a wide hill of motion, and the threshold lies where the log
has the fewest windows between 2.5 and 4 times the peak; where many places are as good the middle
is taken, 3.2 times. Noise or vibration above a fiftieth of what the positions change hides a turn
in s, but less in v, which then has its threshold too, 1.7 to 2.8 times the peak. Nothing needs to
be set. A run of windows below the threshold is a rest. Where it ends is a change point: from its
inside outward, with mean and standard deviation of the second before,

    g_i = sum_j [ z_ij² (1 - 1/a) - ln a ] / 2,    z_ij = (y_ij - mean_j) / sd_j,  a = 6,   (3)

tells motion from rest, and where its sum up to the first sample that is 8 sd off is lowest motion
shows, if it has grown by 12 since [1]_. A turn begins slowly, below the noise, so the rest ends at
the k up to there from which on

    z_ij = c_j (i - k)²,                                                                    (4)

by least squares with any c, explains the samples best. Noise with a memory ρ from sample to sample
goes astray by chance: of places that are as good to 2 M ρ/(1 - ρ) the last is taken. Windows in
which nothing changes at all, of a sensor that else has noise, are frozen and no rest.

The shortest rest is two seconds, or .4 of the usual stretch at rest where that is less, never less
than .75 s. Usual is the median, or what half of the time at rest is spent in longer stretches than,
the longest aside, whichever is shorter.

Every pass sees the samples piece by piece and keeps a histogram, a handful of blocks and the
runs, so that a log can be of any length.

Rests that the user knows: a file of the rows where each begins and ends.

References
----------
.. [1] E. S. Page, Biometrika 41 (1954), 100–115.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.handed import take_in
from multipos.files.pipes import rereadable
from multipos.files.spelling import require_columns
from multipos.files.tables import Source, Table, read_table
from multipos.files.trees import read_json_value
from multipos.files.whole import read_bytes
from multipos.numerics.arrays import Array, Mask, Places, median, require_rate
from multipos.results import frozen

BLOCKS = 8  # of a window
PIECE = 1 << 13  # samples at a time: what stays in the processor's cache is fast
_WINDOW = 0.5  # [s]
_WINDOW_SAMPLES = 48  # where the sample rate is not known
_SMALLEST_BLOCK = 2
_SHORTEST = 4  # windows in a rest
_LEAST = 12  # blocks in a rest, however short those of a log are
_OF_USUAL = 0.4  # of the usual rest of a log: what is shorter was not meant to be one
_LONGEST = 1e9  # [s], whose samples can still be counted at any rate
_MANY = 1024  # arrays, each of which costs more than the few numbers in it

# The histogram of log10 s.
_BINS_PER_DECADE = 100
_LOWEST, _HIGHEST = -18, 18
_SMOOTHING = 0.05  # [decades], standard deviation of the kernel
_PEAK = 0.2  # of the highest density: a lower hill is no peak of its own
_BETWEEN = (2.5, 4.0)  # times the peak
_BETWEEN_SLOW = (1.7, 2.8)  # of v, which is hardly that of noise without a memory
_NOISY = 0.02  # of the log's half range: above, turns hide in s
_MOTION = 0.05  # of it: no sensor at rest drifts as far
_NOISE = 1.0  # steps of resolution: with more no window is constant by chance

# Spikes.
_CHUNK = 16  # samples
_AT_ONCE = 1 << 10  # chunks, of a size that stays in the processor's cache
_LONGEST_SPIKE = 2  # samples: longer is motion
_LIKELY = 3.5  # times the mean deviation of a chunk: without spikes hardly a sample is so far
_SPIKE = 12.0  # times what a quarter of the samples is beyond: 14 standard deviations

# Edges of rests, eq. (3).
_TIMES = 6.0  # the variance of motion that is looked for, in that of the rest
_ALARM = 12.0
_CLEAR = 8.0  # standard deviations: no noise
_ASTRAY = 1.0  # per output, and time that noise remembers
_ONSETS = 64  # places that are tried
_AHEAD = 3  # blocks beyond the last still window that may still be rest
_ROUNDING = 8.0 * np.finfo(np.float64).eps  # of a mean: a window that varies less is constant
_QUIETEST = 0.1  # of the threshold: no output is taken to be quieter


class NoRestError(MultiposError):
    """Nothing in a log is at rest."""


class Rest(NamedTuple):
    """Rows of a log in which nothing moves, `end` not included."""

    start: int
    end: int


@frozen(eq=True)
class Grid:
    """Sizes of blocks and of the shortest rest, in samples.

    Attributes
    ----------
    block : int
        Samples in a block; a window has eight blocks.
    shortest : int
        Samples in the shortest run that counts as a rest.
    adapts : bool
        Whether rests may be shorter where those of the log are.
    """

    block: int
    shortest: int
    adapts: bool = False

    @property
    def window(self) -> int:
        """Samples in a window."""
        return BLOCKS * self.block


def choose_grid(rate: float | None, min_duration: float | None) -> Grid:
    """Return windows of half a second, or of the shortest rest where that is shorter.

    Parameters
    ----------
    rate : float or None [Hz]
        Unknown: a window is 96 samples.
    min_duration : float or None [s]
        Shortest rest; two windows where it is not given.

    Raises
    ------
    UsageError
        `min_duration` without `rate`, or either out of range.
    """
    if rate is not None:
        require_rate(rate)
    if min_duration is None:
        samples = _WINDOW_SAMPLES if rate is None else rate * _WINDOW
        block = max(_SMALLEST_BLOCK, round(samples / BLOCKS))
        return Grid(block, _SHORTEST * BLOCKS * block, adapts=True)
    if rate is None:
        raise UsageError("--min-duration is in seconds; give --rate or --time-column as well.")
    if not 0.0 < min_duration <= _LONGEST:
        raise UsageError(
            f"--min-duration must be above 0, up to {_LONGEST:g} s, got {min_duration:g}."
        )
    shortest = max(round(rate * min_duration), _SMALLEST_BLOCK * BLOCKS)
    block = min(round(rate * _WINDOW), shortest) // BLOCKS
    return Grid(max(_SMALLEST_BLOCK, block), shortest)


class Limits(NamedTuple):
    """What tells rest from motion.

    Attributes
    ----------
    size : float
        Largest standard deviation of a window at rest, eq. (1).
    slow : float
        Largest standard deviation of the means of its blocks, eq. (2).
    frozen : bool
        Whether a window in which nothing changes is no rest.
    """

    size: float
    slow: float = np.inf
    frozen: bool = False


class Spikes:
    """Take single samples that are far from their neighbours out, from samples in pieces.

    Attributes
    ----------
    found : list of (int, int, float)
        Row, output and value of each.
    """

    def __init__(self, outputs: int) -> None:
        self._outputs = outputs
        self._left: Array | None = None  # rows short of a chunk and what is looked at behind it
        self._before = np.full((outputs, _LONGEST_SPIKE), np.nan)  # samples before those
        self._step = np.full(outputs, np.inf)  # between samples, the smallest so far
        self._row = 0
        self.found: list[tuple[int, int, float]] = []

    def feed(self, data: Array) -> Array:
        """Return the rows (k, n') of whole chunks that (k, n) completes, the outputs first."""
        if self._left is not None and self._left.shape[1]:
            data = np.concatenate([self._left, data], axis=1)
        whole = max(data.shape[1] - _LONGEST_SPIKE, 0) // _CHUNK * _CHUNK
        self._left = data[:, whole:].copy()
        if not whole:
            return data[:, :0]
        kept = data[:, :whole].copy()
        self._clean(data, kept[: self._outputs])
        self._before = data[: self._outputs, whole - _LONGEST_SPIKE : whole].copy()
        self._row += whole
        return kept

    def finish(self) -> Array:
        """Return the rows (k, n) that are left; some must have been fed."""
        assert self._left is not None
        left, self._left = self._left, self._left[:, :0]
        return left

    def _clean(self, samples: Array, kept: Array) -> None:
        """Put medians for spikes of chunks (M, n), of samples with two more behind."""
        reach = np.arange(-_LONGEST_SPIKE, _CHUNK + _LONGEST_SPIKE)
        chunks = kept.reshape(self._outputs, -1, _CHUNK)
        for j, own in enumerate(chunks):
            at = _likely_chunks(own) * _CHUNK
            if not len(at):
                continue
            around = samples[j, np.maximum(at[:, None] + reach, 0)]
            if at[0] == 0:
                around[0, :_LONGEST_SPIKE] = self._before[j]
            for which, middle, places in self._spikes(around, j):
                for i in (int(at[which]) + place for place in places):
                    self.found.append((self._row + i, j, float(kept[j, i])))
                    kept[j, i] = middle

    def _spikes(self, around: Array, j: int) -> list[tuple[int, float, list[int]]]:
        """Return which of chunks (k, 20) have spikes, the median, and which samples these are."""
        y = around[:, _LONGEST_SPIKE:-_LONGEST_SPIKE]
        middle = np.sort(y, axis=1)[:, _CHUNK // 2]  # a reading: numbers of a converter are whole
        steps = np.abs(np.diff(y, axis=1))
        none = 4.0 * np.finfo(float).eps * np.abs(y).max(axis=1, keepdims=True)
        least = np.where(steps > none, steps, np.inf).min(axis=1)
        least = np.minimum.accumulate(np.minimum(least, self._step[j]))
        self._step[j] = least[-1]
        spread = np.sort(np.abs(y - middle[:, None]), axis=1)[:, 3 * _CHUNK // 4]
        beyond = np.abs(around - middle[:, None]) > _SPIKE * np.maximum(spread, least)[:, None]
        return [
            (i, float(middle[i]), places)
            for i in np.flatnonzero(beyond.any(axis=1)).tolist()
            if (places := _short_runs(beyond[i].tolist()))
        ]


def _likely_chunks(chunks: Array) -> Places:
    """Return which chunks (K, n) have a sample much further from their mean than is usual."""
    found = []
    for first in range(0, len(chunks), _AT_ONCE):
        off = chunks[first : first + _AT_ONCE].T.copy()  # long rows are fast
        off -= off.sum(axis=0) / _CHUNK
        np.abs(off, out=off)
        found.append(first + np.flatnonzero(_CHUNK * off.max(axis=0) > _LIKELY * off.sum(axis=0)))
    return np.concatenate(found)


def _short_runs(beyond: list[bool]) -> list[int]:
    """Return the samples of a chunk that lie in runs as short as spikes, of it and what is by."""
    ends = [i for i, (a, b) in enumerate(pairwise([False, *beyond, False])) if a != b]
    runs = [range(*run) for run in zip(ends[::2], ends[1::2], strict=True)]
    rows = [i - _LONGEST_SPIKE for run in runs if len(run) <= _LONGEST_SPIKE for i in run]
    return [i for i in rows if 0 <= i < _CHUNK]


class Windows:
    """Mean and spread, eqs. (1) and (2), of windows, from samples that come in pieces."""

    def __init__(self, block: int) -> None:
        self._block = block
        self._left: Array | None = None  # samples short of a block
        self._mean: Array | None = None  # the blocks that the next windows need
        self._square: Array | None = None
        self._room: Array = np.empty((0, 0))  # of the last piece, which is in the cache

    def feed(self, samples: Array) -> tuple[Array, Array]:
        """Return means (M, k) and s, v (2, k) of the windows that samples (M, n) complete."""
        block, outputs = self._block, len(samples)
        if self._left is not None and self._left.shape[1]:
            samples = np.concatenate([self._left, samples], axis=1)
        count = samples.shape[1] // block
        self._left = samples[:, count * block :].copy()
        # Sums over a block as products with ones: for rows so short that is the fastest way.
        blocks = samples[:, : count * block].reshape(outputs * count, block)
        mean = blocks @ np.full(block, 1.0 / block)
        if self._room.shape != blocks.shape:
            self._room = np.empty(blocks.shape)
        spread = np.subtract(blocks, mean[:, None], out=self._room)
        square = np.einsum("bi,bi->b", spread, spread).reshape(outputs, count)
        mean = mean.reshape(outputs, count)
        if self._mean is not None and self._square is not None:
            mean = np.concatenate([self._mean, mean], axis=1)
            square = np.concatenate([self._square, square], axis=1)
        keep = max(mean.shape[1] - BLOCKS + 1, 0)
        self._mean, self._square = mean[:, keep:].copy(), square[:, keep:].copy()
        if mean.shape[1] < BLOCKS:
            return np.empty((outputs, 0)), np.empty((2, 0))
        middle = _slide(mean) / BLOCKS
        # About the first block, so that squares of a large offset do not cancel.
        offset = mean - mean[:, :1]
        between = _slide(offset**2) - BLOCKS * (middle - mean[:, :1]) ** 2
        variance = (_slide(square) + block * between) / (BLOCKS * block - 1)
        same = variance <= (_ROUNDING * middle) ** 2
        variance[same], between[same] = 0.0, 0.0
        largest = np.array([variance.max(axis=0), between.max(axis=0) / (BLOCKS - 1)])
        return middle, np.sqrt(np.maximum(largest, 0.0))


def _slide(values: Array) -> Array:
    """Return the sums of eight neighbours (M, k - 7) of values (M, k)."""
    pairs = values[:, 1:] + values[:, :-1]
    fours = pairs[:, 2:] + pairs[:, :-2]
    return np.asarray(fours[:, 4:] + fours[:, :-4])


class Survey:
    """What a whole log is like: the distribution of s, the range and resolution of each output.

    Attributes
    ----------
    rows, windows : int
        Samples and windows seen.
    lowest, highest : (M,) arrays
        Extremes of the samples.
    resolution : (M,) array
        Smallest step between samples, as the first pieces show it; NaN where nothing changed.
    """

    def __init__(self, outputs: int, grid: Grid) -> None:
        self.grid = grid
        self.rows: int = 0
        self.windows: int = 0
        self.lowest: Array = np.full(outputs, np.inf)
        self.highest: Array = np.full(outputs, -np.inf)
        self.resolution: Array = np.full(outputs, np.nan)
        self._counts = np.zeros((2, (_HIGHEST - _LOWEST) * _BINS_PER_DECADE), dtype=np.int64)
        self._constant = 0  # windows in which nothing changes
        self._mean_range = np.array([self.lowest, self.highest])
        self._sizes: list[Array] = []

    def add(self, samples: Array, mean: Array, spread: Array) -> None:
        """Add samples (M, n), and means (M, k) and s, v (2, k) of the windows they completed."""
        if not samples.shape[1]:
            return
        self.rows += samples.shape[1]
        self.lowest = np.minimum(self.lowest, samples.min(axis=1))
        self.highest = np.maximum(self.highest, samples.max(axis=1))
        for j in np.flatnonzero(np.isnan(self.resolution)).tolist():
            steps = np.abs(np.diff(samples[j]))
            steps = steps[steps > 4.0 * np.finfo(float).eps * np.abs(samples[j]).max()]
            self.resolution[j] = steps.min() if len(steps) else np.nan
        if mean.shape[1]:
            every = mean[:, -self.windows % BLOCKS :: BLOCKS]
            self._sizes.append(np.linalg.norm(every, axis=0))
            if len(self._sizes) > _MANY:
                self._sizes = [np.concatenate(self._sizes)]
            self.windows += mean.shape[1]
            low, high = self._mean_range
            low, high = np.minimum(low, mean.min(axis=1)), np.maximum(high, mean.max(axis=1))
            self._mean_range = np.array([low, high])
            changing = spread[0] > 0.0
            self._constant += len(changing) - int(np.count_nonzero(changing))
            size = np.maximum(spread[:, changing], 10.0**_LOWEST)
            place = ((np.log10(size) - _LOWEST) * _BINS_PER_DECADE).astype(np.intp)
            for counts, each in zip(self._counts, place, strict=True):
                counts += np.bincount(each, minlength=len(counts))

    def sizes(self) -> Array:
        """Return the size of every eighth window's mean, of three outputs: no samples in two."""
        if len(self.lowest) != 3 or not self._sizes:
            return np.empty(0)
        return np.concatenate(self._sizes)

    def limits(self) -> Limits:
        """Return what tells rest from motion, from the log itself.

        Raises
        ------
        MultiposError
            The log is shorter than a rest, constant, or without anything like a rest.
        """
        least = _LEAST * self.grid.block
        if self.rows < least or not self.windows:
            raise MultiposError(
                f"the log has {self.rows} rows, fewer than one rest ({least}); "
                "record longer, or give --sections."
            )
        if np.isnan(self.resolution).all():
            raise MultiposError(
                "every sample of the log is the same; the sensor is stuck or not connected."
            )
        # A window can vary by less than the resolution by chance, but a sensor never is that good.
        step = float(np.nanmax(self.resolution))
        quietest = max(step / np.sqrt(12.0), 10.0**_LOWEST)
        noise = size = 0.0
        if self._counts[0].any():
            noise, size = _valley(self._counts[0], 0, quietest)
        still = self._counts[0][: int((np.log10(max(size, quietest)) - _LOWEST) * _BINS_PER_DECADE)]
        frozen = noise > _NOISE * step and self._constant < still.sum()
        if not frozen:
            noise, size = _valley(self._counts[0], self._constant, quietest)
        half_range = float((self._mean_range[1] - self._mean_range[0]).max()) / 2.0
        # Where even the range is noise the log is one long rest, which is said elsewhere.
        if not (half_range > 2.0 * noise and noise > _NOISY * half_range):
            return Limits(size, np.inf, frozen)
        noise, slow = _valley(self._counts[1], 0, quietest, _BETWEEN_SLOW)
        if noise > _MOTION * half_range:
            raise NoRestError(
                f"the log has no rest: even where it is quietest it varies by {noise:.3g} (one "
                f"standard deviation), {100 * noise / half_range:.0f} % of what the positions "
                "change; hold the sensor still, or give --threshold or --sections."
            )
        return Limits(size, slow, frozen)


def _valley(
    counts: Array, constant: int, quietest: float, between: tuple[float, float] = _BETWEEN
) -> tuple[float, float]:
    """Return the first peak of a histogram, and where it has the fewest windows above."""
    first = int((np.log10(quietest) - _LOWEST) * _BINS_PER_DECADE)
    density = counts.astype(np.float64)
    density[first] += density[:first].sum() + constant
    density[:first] = 0.0
    density = _smooth(density)
    peak = _first_peak(density)
    low, high = (peak + round(np.log10(x) * _BINS_PER_DECADE) for x in between)
    valley = density[low : high + 1]
    middle = (len(valley) - 1) / 2.0
    cost = valley / density[peak] + 1e-3 * np.abs(np.arange(len(valley)) - middle) / middle
    place = np.array([peak, low + int(np.argmin(cost))])
    noise, limit = (10.0 ** (_LOWEST + (place + 0.5) / _BINS_PER_DECADE)).tolist()
    return noise, limit


def _smooth(counts: Array) -> Array:
    width = _SMOOTHING * _BINS_PER_DECADE
    reach = np.arange(-int(4 * width), int(4 * width) + 1)
    return np.convolve(counts, np.exp(-0.5 * (reach / width) ** 2), mode="same")


def _first_peak(density: Array) -> int:
    """Return the place of the leftmost peak that is high enough to be the noise."""
    inner = (density[1:-1] >= density[:-2]) & (density[1:-1] > density[2:])
    high = density[1:-1] >= _PEAK * density.max()
    return 1 + int(np.argmax(inner & high))


class Run(NamedTuple):
    """Rows of windows below the threshold, one after the other.

    Attributes
    ----------
    start, end : int
        First row of the first window, and the one after the last, without what is frozen.
    begins, ends : bool
        Whether the rest may begin before, and end behind: not where a frozen stretch does.
    """

    start: int
    end: int
    begins: bool = True
    ends: bool = True


class Finder:
    """Collect the runs of windows below a threshold, from windows that come in pieces.

    Attributes
    ----------
    limits : Limits
    """

    def __init__(self, grid: Grid, limits: Limits) -> None:
        self._grid = grid
        self.limits = limits
        self._count = 0
        # The first block of each run, and the one after its last. Runs that share blocks are one
        # rest with a window in between that was near the threshold; runs that only touch have a
        # step between them.
        self._still = _Runs()
        self._frozen = _Runs()
        self._ended = 0  # runs that nothing which follows can change
        self._settled: list[Run] = []

    def add(self, spread: Array) -> None:
        """Add s and v (2, k) of the windows that follow."""
        size, slow = spread
        if not len(size):
            return
        still = (size <= self.limits.size) & (slow <= self.limits.slow)
        self._still.add(still, self._count)
        if self.limits.frozen:
            self._frozen.add(size == 0.0, self._count)
        self._count += len(size)

    def runs(self) -> list[Run]:
        """Return the runs so far."""
        return [run for ends in self._still.found for run in self._without_frozen(*ends)]

    @property
    def still_since(self) -> int | None:
        """First row of the stretch that is still as far as seen, None while something moves."""
        return self._still.found[-1][0] * self._grid.block if self._still.open else None

    @property
    def open_since(self) -> int:
        """First row that the edge of a rest which is not settled yet may need."""
        found = self._still.found
        open_ = bool(found) and found[-1][1] > self._count
        first = found[-1][0] if open_ else self._count
        return max(0, first - _AHEAD) * self._grid.block

    def settled(self) -> list[Run]:
        """Return the runs that nothing which follows can change: they have long ended."""
        found = self._still.found
        while self._ended < len(found) and found[self._ended][1] <= self._count:
            self._settled += self._without_frozen(*found[self._ended])
            self._ended += 1
        return self._settled

    def frozen(self) -> list[Rest]:
        """Return the stretches in which nothing changes."""
        block = self._grid.block
        return [Rest(first * block, last * block) for first, last in self._frozen.found]

    def _without_frozen(self, first: int, last: int) -> list[Run]:
        """Return what is left of a run, in rows."""
        block, left, begins = self._grid.block, [], True
        for from_, to in self._frozen.found:
            if from_ < last and to > first:
                left.append(Run(first * block, from_ * block, begins, ends=False))
                first, begins = to, False
        left.append(Run(first * block, last * block, begins))
        return [run for run in left if run.end - run.start >= self._grid.window]


class _Runs:
    """Windows of a kind, one after the other, as their first block and the one after the last."""

    def __init__(self) -> None:
        self.found: list[list[int]] = []
        self.open = False

    def add(self, inside: Mask, count: int) -> None:
        """Add whether windows are of the kind; so many have come before."""
        changes = np.flatnonzero(np.diff(inside, prepend=self.open))
        for edge in (count + changes).tolist():
            if self.open:
                self.found[-1][1] = edge - 1 + BLOCKS
            elif not self.found or edge >= self.found[-1][1]:
                self.found.append([edge, edge])
            self.open = not self.open
        if self.open:
            self.found[-1][1] = count + len(inside) - 1 + BLOCKS


Reader = Callable[[list[Rest]], list[Array]]  # gives the outputs (M, n) of stretches of rows


def find_edges(
    runs: Sequence[Run], rows: int, grid: Grid, limits: Limits, read: Reader, after: int = 0
) -> list[Rest]:
    """Return where the rests begin and end that runs are, by eqs. (3) and (4).

    Parameters
    ----------
    runs : sequence of Run
        In order.
    rows : int
        Of the log so far.
    read : callable
        Gives the outputs of stretches of rows.
    after : int
        Row before which none begins.
    """
    regions, places = [], []
    for run in runs:
        blocks = (run.end - run.start) // grid.block
        cut = grid.block * max(1, min(BLOCKS, blocks // 4))
        first, last = run.start + cut, run.end - cut  # surely at rest
        reach = min(last - first, 2 * grid.window)
        before = max(run.start - _AHEAD * grid.block, 0)
        behind = min(run.end + _AHEAD * grid.block, rows)
        regions += [Rest(before, first + reach), Rest(last - reach, behind)]
        places.append((first, last, reach))
    samples = read(regions)
    rests: list[Rest] = []
    for run, (first, last, reach), head, tail in zip(
        runs, places, samples[::2], samples[1::2], strict=True
    ):
        start, end = run.start, run.end if rows - run.end >= grid.block else rows
        if run.begins and (moved := _change(head[:, ::-1], reach, limits)) is not None:
            start = first - moved
        if run.ends and (moved := _change(tail, reach, limits)) is not None:
            end = last + moved
        start = max(start, rests[-1].end if rests else after)
        rests.append(Rest(start, max(end, start)))
    return rests


def _change(samples: Array, reach: int, limits: Limits) -> int | None:
    """Return how many of samples (M, n) behind the first `reach` are still at rest.

    None where all of them are.
    """
    away = samples - samples[:, :reach].sum(axis=1, keepdims=True) / reach
    rest = away[:, :reach]
    variance = np.einsum("ij,ij->i", rest, rest) / reach
    sd = np.maximum(np.sqrt(variance), _QUIETEST * limits.size)
    z = away[:, reach:] / sd[:, None]
    square = np.einsum("ij,ij->j", z, z)
    gain = 0.5 * (square * (1.0 - 1.0 / _TIMES) - len(z) * np.log(_TIMES))
    total = np.zeros(len(gain) + 1)
    np.cumsum(gain, out=total[1:])
    clear = np.abs(z).max(axis=0) > _CLEAR
    seen = int(clear.argmax()) + 1 if clear.any() else len(clear)
    lowest = total[: seen + 1].min()
    if total[seen] - lowest < _ALARM:
        return None
    # Noise that remembers goes astray for a while by chance.
    lagged = np.einsum("ij,ij->i", rest[:, 1:], rest[:, :-1]) / (reach - 1)
    memory = float(np.minimum(np.maximum(lagged / sd**2, 0.0), 0.95).sum()) / len(z)
    astray = _ASTRAY * len(z) * 2.0 * memory / (1.0 - memory)
    change = int(np.flatnonzero(total[: seen + 1] <= lowest + astray)[-1])
    return _onset(z[:, :seen], min(change, seen - 1), astray)


def _onset(z: Array, change: int, astray: float) -> int:
    """Return up to which of samples (M, n) nothing moves, no more than `change`, by eq. (4)."""
    first = np.arange(change, -1, -(change // _ONSETS + 1))[::-1]
    n = z.shape[1]
    t = np.arange(n) - float(change)
    # of (i − k)² = (t + h)² with h = change − k + 1 > 0, sums over i from k on
    between = np.add.reduceat(np.stack([z, t * z, t * t * z]), first, axis=2)
    moments = between[..., ::-1].cumsum(axis=2)[..., ::-1]
    h, m = change + 1.0 - first, n - first.astype(np.float64)
    along = moments[2] + 2.0 * h * moments[1] + h * h * moments[0]
    fourth = m * (m + 1.0) * (2.0 * m + 1.0) * (3.0 * m * m + 3.0 * m - 1.0) / 30.0
    explained = (along**2).sum(axis=0) / fourth
    return int(first[np.flatnonzero(explained >= explained.max() - astray)[-1]])


def long_enough(rests: Sequence[Rest], grid: Grid) -> tuple[list[Rest], list[Rest], int]:
    """Return the rests, the stretches too short for one, and the samples that the shortest has."""
    lengths = np.sort([rest.end - rest.start for rest in rests])[:-1]
    shortest = grid.shortest
    adapts = grid.adapts and len(lengths) > 0
    if adapts and not all(is_long(rest, shortest, grid) for rest in rests):
        half = lengths[int(np.searchsorted(np.cumsum(lengths), lengths.sum() / 2.0))]
        usual = min(half, median(lengths))
        least = _LEAST * grid.block
        shortest = min(shortest, max(least, int(_OF_USUAL * usual)))
    kept = [is_long(rest, shortest, grid) for rest in rests]
    long = [rest for rest, keep in zip(rests, kept, strict=True) if keep]
    return long, [rest for rest, keep in zip(rests, kept, strict=True) if not keep], shortest


def is_long(rest: Rest, shortest: int, grid: Grid) -> bool:
    """Tell whether a rest is one: its ends are not known to two blocks."""
    return rest.end - rest.start > shortest - 2 * grid.block


@frozen(eq=True)
class Sections:
    """Rests that the user knows, by label."""

    source: str
    rests: dict[str, Rest]

    def inside(self, rows: int) -> dict[str, Rest]:
        """Return the rests of a log of so many rows, or say which lies outside."""
        for label, rest in self.rests.items():
            if rest.start < 0 or rest.end > rows:
                raise MultiposError(
                    f"{self.source}: section '{label}' is rows {rest.start} to {rest.end}, but the "
                    f"log has {rows} rows, counted from 0."
                )
        return self.rests


def read_sections(source: Source) -> Sections:
    """Read where rests begin and end: rows of the log from 0, the end not included.

    Parameters
    ----------
    source : path of JSON or CSV, or mapping
        ``{label: {"start": row, "end": row}}``, or columns position, start, end.

    Raises
    ------
    MultiposError
        Missing, empty, of another form, or a section with fewer than two rows.
    """
    given = take_in(source, "sections", ("position", "start", "end"))
    given = given if isinstance(given, Mapping) else rereadable(given)
    by_label = _by_label(given)
    if by_label is None:
        where, found = _from_table(read_table(given, what="sections"))
    else:
        where, found = "sections" if isinstance(given, Mapping) else str(given), by_label
    if not found:
        raise MultiposError(f"{where}: no sections; give a start and an end for each position.")
    return Sections(
        where, {str(label): _section(where, label, each) for label, each in found.items()}
    )


def _from_table(table: Table) -> tuple[str, Mapping[str, Any]]:
    require_columns(("position", "start", "end"), table.columns, table.source)
    ends = zip(table.number("start").tolist(), table.number("end").tolist(), strict=True)
    labels = table.text("position")
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        where = f"{table.source}: section '{twice}'"
        raise MultiposError(f"{where} appears twice; give each its label.")
    rows = [{"start": start, "end": end} for start, end in ends]
    return table.source, dict(zip(labels, rows, strict=True))


def _by_label(given: Mapping[str, Any] | os.PathLike[str]) -> Mapping[str, Any] | None:
    """Return sections by label; None of a table: JSON by its ending, or the brace it begins with.

    A pipe has no ending.
    """
    found: Any = given
    if not isinstance(given, Mapping):
        name = str(given).lower()
        is_json = name.endswith(".json") or read_bytes(given, "sections").lstrip()[:1] == b"{"
        if not is_json or name.endswith((".jsonl", ".ndjson")):
            return None
        found = read_json_value(given, "sections")
    labelled = isinstance(found, Mapping) and isinstance(found.get("position", {}), Mapping)
    return found if labelled else None


def _section(where: str, label: str, each: Any) -> Rest:
    try:
        start, end = each["start"], each["end"]
        rest = Rest(int(start), int(end))
        whole = rest == (start, end)
    except (KeyError, TypeError, ValueError, OverflowError):
        whole = False
    if not whole:
        raise MultiposError(
            f"{where}: section '{label}' needs a start and an end that are whole numbers of rows."
        )
    if rest.end - rest.start < 2:
        raise MultiposError(
            f"{where}: section '{label}' goes from row {rest.start} to {rest.end}; the end must "
            "be at least two rows after the start."
        )
    return rest

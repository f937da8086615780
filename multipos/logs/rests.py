"""Where a log stands still: the rests between the motions.

Samples are taken in blocks, and `W` = 8 blocks make a window that slides by a block. The standard
deviation of a window, the largest of all outputs,

    s = max_j sqrt( sum_i (y_ij - mean_j)² / (8 B - 1) ),                                   (1)

is the sensor's noise where nothing moves and much more where something does. Over a whole log
log s has a narrow peak at rest and a wide hill of motion, and the threshold lies where the log
has the fewest windows between 2.5 and 4 times the peak; where many places are as good the middle
is taken, 3.2 times. Nothing needs to be set. A run of windows below the threshold is a rest; its
ends, where a window could hide the begin of a motion, are cut.

Every pass sees the samples piece by piece and keeps a histogram, a handful of blocks and the
runs, so that a log can be of any length.

Rests that the user knows: a file of the rows where each begins and ends.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.files.pipes import rereadable
from multipos.files.tables import Source, Table, read_table
from multipos.files.trees import read_json_value
from multipos.files.whole import read_bytes
from multipos.numerics.arrays import Array
from multipos.numerics.series import require_rate

BLOCKS = 8  # of a window
LARGEST_SAMPLE = 1e15  # no sensor counts so far, and sums of squares are far from overflow
PIECE = 1 << 13  # samples at a time: what stays in the processor's cache is fast
_WINDOW = 1.0  # [s]
_WINDOW_SAMPLES = 96  # where the sample rate is not known
_SMALLEST_BLOCK = 2
_SHORTEST = 2  # windows in a rest
_LONGEST = 1e9  # [s], whose samples can still be counted at any rate
_MANY = 1024  # arrays, each of which costs more than the few numbers in it

# The histogram of log10 s.
_BINS_PER_DECADE = 100
_LOWEST, _HIGHEST = -18, 18
_SMOOTHING = 0.05  # [decades], standard deviation of the kernel
_PEAK = 0.2  # of the highest density: a lower hill is no peak of its own
_BETWEEN = (2.5, 4.0)  # times the peak
_MOTION = 0.05  # of the log's half range: no sensor at rest is as noisy


class Rest(NamedTuple):
    """Rows of a log in which nothing moves, `end` not included."""

    start: int
    end: int


@dataclass(frozen=True)
class Grid:
    """Sizes of blocks and of the shortest rest, in samples.

    Attributes
    ----------
    block : int
        Samples in a block; a window has eight blocks.
    shortest : int
        Samples in the shortest run that counts as a rest.
    """

    block: int
    shortest: int

    @property
    def window(self) -> int:
        """Samples in a window."""
        return BLOCKS * self.block


def choose_grid(rate: float | None, min_duration: float | None) -> Grid:
    """Return windows of one second, or of the shortest rest where that is shorter.

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
        return Grid(block, _SHORTEST * BLOCKS * block)
    if rate is None:
        raise UsageError("--min-duration is in seconds; give --rate or --time-column as well.")
    if not 0.0 < min_duration <= _LONGEST:
        raise UsageError(
            f"--min-duration must be above 0, up to {_LONGEST:g} s, got {min_duration:g}."
        )
    shortest = max(round(rate * min_duration), _SMALLEST_BLOCK * BLOCKS)
    block = min(round(rate * _WINDOW), shortest) // BLOCKS
    return Grid(max(_SMALLEST_BLOCK, block), shortest)


class Windows:
    """Mean and standard deviation, eq. (1), of windows, from samples that come in pieces."""

    def __init__(self, block: int) -> None:
        self._block = block
        self._left: Array | None = None  # samples short of a block
        self._mean: Array | None = None  # the blocks that the next windows need
        self._square: Array | None = None

    def feed(self, samples: Array) -> tuple[Array, Array]:
        """Return means (M, k) and s (k,) of the windows that samples (M, n) complete."""
        block, outputs = self._block, len(samples)
        if self._left is not None and self._left.shape[1]:
            samples = np.concatenate([self._left, samples], axis=1)
        count = samples.shape[1] // block
        self._left = samples[:, count * block :].copy()
        # Sums over a block as products with ones: for rows so short that is the fastest way.
        blocks = samples[:, : count * block].reshape(outputs * count, block)
        mean = blocks @ np.full(block, 1.0 / block)
        spread = blocks - mean[:, None]
        square = np.einsum("bi,bi->b", spread, spread).reshape(outputs, count)
        mean = mean.reshape(outputs, count)
        if self._mean is not None and self._square is not None:
            mean = np.concatenate([self._mean, mean], axis=1)
            square = np.concatenate([self._square, square], axis=1)
        keep = max(mean.shape[1] - BLOCKS + 1, 0)
        self._mean, self._square = mean[:, keep:].copy(), square[:, keep:].copy()
        if mean.shape[1] < BLOCKS:
            return np.empty((outputs, 0)), np.empty(0)
        middle = _slide(mean) / BLOCKS
        # About the first block, so that squares of a large offset do not cancel.
        offset = mean - mean[:, :1]
        between = _slide(offset**2) - BLOCKS * (middle - mean[:, :1]) ** 2
        variance = (_slide(square) + block * between) / (BLOCKS * block - 1)
        return middle, np.sqrt(np.maximum(variance.max(axis=0), 0.0))


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
        self.rows = 0
        self.windows = 0
        self.lowest = np.full(outputs, np.inf)
        self.highest = np.full(outputs, -np.inf)
        self.resolution = np.full(outputs, np.nan)
        self._counts = np.zeros((_HIGHEST - _LOWEST) * _BINS_PER_DECADE, dtype=np.int64)
        self._mean_range = np.array([self.lowest, self.highest])
        self._sizes: list[Array] = []

    def add(self, samples: Array, mean: Array, sd: Array) -> None:
        """Add samples (M, n), and means (M, k) and s (k,) of the windows they completed."""
        if not samples.shape[1]:
            return
        self.rows += samples.shape[1]
        self.lowest = np.minimum(self.lowest, samples.min(axis=1))
        self.highest = np.maximum(self.highest, samples.max(axis=1))
        for j in np.flatnonzero(np.isnan(self.resolution)).tolist():
            steps = np.abs(np.diff(samples[j]))
            steps = steps[steps > 4.0 * np.finfo(float).eps * np.abs(samples[j]).max()]
            self.resolution[j] = steps.min() if len(steps) else np.nan
        if len(sd):
            every = mean[:, -self.windows % BLOCKS :: BLOCKS]
            self._sizes.append(np.linalg.norm(every, axis=0))
            if len(self._sizes) > _MANY:
                self._sizes = [np.concatenate(self._sizes)]
            self.windows += len(sd)
            low, high = self._mean_range
            low, high = np.minimum(low, mean.min(axis=1)), np.maximum(high, mean.max(axis=1))
            self._mean_range = np.array([low, high])
            size = np.maximum(sd, 10.0**_LOWEST)
            place = ((np.log10(size) - _LOWEST) * _BINS_PER_DECADE).astype(np.intp)
            self._counts += np.bincount(place, minlength=len(self._counts))

    def sizes(self) -> Array:
        """Return the size of every eighth window's mean, of three outputs: no samples in two."""
        if len(self.lowest) != 3 or not self._sizes:
            return np.empty(0)
        return np.concatenate(self._sizes)

    def threshold(self) -> float:
        """Return the standard deviation of a window above which it moves, from the log itself.

        Raises
        ------
        MultiposError
            The log is shorter than a rest, constant, or without anything like a rest.
        """
        if self.rows < self.grid.shortest or not self.windows:
            raise MultiposError(
                f"the log has {self.rows} rows, fewer than one rest ({self.grid.shortest}); "
                "record longer, or give --sections."
            )
        if np.isnan(self.resolution).all():
            raise MultiposError(
                "every sample of the log is the same; the sensor is stuck or not connected."
            )
        # A window can vary by less than the resolution by chance, but a sensor never is that good.
        floor = max(float(np.nanmax(self.resolution)) / np.sqrt(12.0), 10.0**_LOWEST)
        first = int((np.log10(floor) - _LOWEST) * _BINS_PER_DECADE)
        counts = self._counts.astype(np.float64)
        counts[first] += counts[:first].sum()
        counts[:first] = 0.0
        density = _smooth(counts)
        peak = _first_peak(density)
        low, high = (peak + round(np.log10(x) * _BINS_PER_DECADE) for x in _BETWEEN)
        valley = density[low : high + 1]
        middle = (len(valley) - 1) / 2.0
        cost = valley / density[peak] + 1e-3 * np.abs(np.arange(len(valley)) - middle) / middle
        threshold = 10.0 ** (_LOWEST + (low + int(np.argmin(cost)) + 0.5) / _BINS_PER_DECADE)
        noise = 10.0 ** (_LOWEST + (peak + 0.5) / _BINS_PER_DECADE)
        self._refuse_motion(noise)
        return float(threshold)

    def _refuse_motion(self, noise: float) -> None:
        half_range = float((self._mean_range[1] - self._mean_range[0]).max()) / 2.0
        # Where even the range is noise the log is one long rest, which is said elsewhere.
        if half_range > 2.0 * noise and noise > _MOTION * half_range:
            raise MultiposError(
                f"the log has no rest: even where it is quietest it varies by {noise:.3g} (one "
                f"standard deviation), {100 * noise / half_range:.0f} % of what the positions "
                "change; hold the sensor still, or give --threshold or --sections."
            )


def _smooth(counts: Array) -> Array:
    width = _SMOOTHING * _BINS_PER_DECADE
    reach = np.arange(-int(4 * width), int(4 * width) + 1)
    return np.convolve(counts, np.exp(-0.5 * (reach / width) ** 2), mode="same")


def _first_peak(density: Array) -> int:
    """Return the place of the leftmost peak that is high enough to be the noise."""
    inner = (density[1:-1] >= density[:-2]) & (density[1:-1] > density[2:])
    high = density[1:-1] >= _PEAK * density.max()
    return 1 + int(np.argmax(inner & high))


class Finder:
    """Collect the runs of windows below a threshold, from windows that come in pieces.

    Attributes
    ----------
    threshold : float
    """

    def __init__(self, grid: Grid, threshold: float) -> None:
        self._grid = grid
        self.threshold = threshold
        self._count = 0
        self._still = False
        # The first block of each run, and the one after its last. Runs that share blocks are one
        # rest with a window in between that was near the threshold; runs that only touch have a
        # step between them.
        self._runs: list[list[int]] = []
        self._ended = 0  # runs that nothing which follows can change
        self._settled: list[Rest] = []  # those of them that are rests

    def add(self, sd: Array) -> None:
        """Add s (k,) of the windows that follow."""
        if not len(sd):
            return
        still = sd <= self.threshold
        changes = np.flatnonzero(np.diff(still, prepend=self._still))
        for edge in (self._count + changes).tolist():
            if self._still:
                self._runs[-1][1] = edge - 1 + BLOCKS
            elif not self._runs or edge >= self._runs[-1][1]:
                self._runs.append([edge, edge])
            self._still = not self._still
        self._count += len(still)
        if self._still:
            self._runs[-1][1] = self._count - 1 + BLOCKS

    def rests(self, rows: int) -> list[Rest]:
        """Return the rests of a log of so many rows, their ends cut."""
        return [
            self._cut(first, last, rows) for first, last in self._runs if self._is_rest(first, last)
        ]

    @property
    def still_since(self) -> int | None:
        """First row of the stretch that is still as far as seen, None while something moves."""
        return self._runs[-1][0] * self._grid.block if self._still else None

    @property
    def open_since(self) -> int:
        """First row that a rest which is not settled yet may have."""
        open_ = bool(self._runs) and self._runs[-1][1] > self._count
        return (self._runs[-1][0] if open_ else self._count) * self._grid.block

    def settled(self) -> list[Rest]:
        """Return the rests that nothing which follows can change: they have long ended."""
        rows = (self._count + BLOCKS) * self._grid.block  # more than a block behind their ends
        while self._ended < len(self._runs) and self._runs[self._ended][1] <= self._count:
            first, last = self._runs[self._ended]
            if self._is_rest(first, last):
                self._settled.append(self._cut(first, last, rows))
            self._ended += 1
        return self._settled

    def short(self) -> list[Rest]:
        """Return the stretches that stood still, but not for so long as a rest does."""
        block = self._grid.block
        return [
            Rest(first * block, last * block)
            for first, last in self._runs
            if not self._is_rest(first, last)
        ]

    def _is_rest(self, first: int, last: int) -> bool:
        return (last - first) * self._grid.block >= self._grid.shortest

    def _cut(self, first: int, last: int, rows: int) -> Rest:
        """Cut half a window at each end, an eighth of a short rest; not where the log ends."""
        block = self._grid.block
        cut = max(1, min(BLOCKS // 2, (last - first) // 8))
        start = first + (cut if first else 0)
        end = last - (cut if (last + 1) * block <= rows else 0)
        return Rest(start * block, end * block)


def detect_static(
    samples: ArrayLike,
    *,
    rate: float | None = None,
    min_duration: float | None = None,
    threshold: float | None = None,
) -> tuple[list[Rest], float]:
    """Return the rests in samples, and the threshold that found them.

    Parameters
    ----------
    samples : (n, M) array
        One row a sample, one column an output.
    rate : float, optional [Hz]
    min_duration : float, optional [s]
        Shortest rest; two seconds, or 192 samples where the rate is not given.
    threshold : float, optional
        Standard deviation of a window above which it moves, in the unit of the samples; learnt
        from the samples where it is not given.

    Returns
    -------
    rests : list of Rest
    threshold : float

    Raises
    ------
    MultiposError
        There is nothing like a rest, or a sample is not finite or beyond what sensors give.
    """
    columns = np.ascontiguousarray(np.asarray(samples, dtype=np.float64).T)
    bad = ~(np.abs(columns) <= LARGEST_SAMPLE)
    if bad.any():
        output, row = np.argwhere(bad)[0].tolist()
        raise MultiposError(
            f"`samples[{row}, {output}]` is {columns[output, row]:g}, no reading of a sensor; "
            "leave the row out."
        )
    grid = choose_grid(rate, min_duration)
    scan, survey, seen = Windows(grid.block), Survey(len(columns), grid), []
    for i in range(0, columns.shape[1], PIECE):
        piece = columns[:, i : i + PIECE]
        mean, sd = scan.feed(piece)
        survey.add(piece, mean, sd)
        seen.append(sd)
    threshold = survey.threshold() if threshold is None else threshold
    finder = Finder(grid, threshold)
    finder.add(np.concatenate(seen))
    return finder.rests(columns.shape[1]), threshold


@dataclass(frozen=True)
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
    if isinstance(source, str | os.PathLike):
        source = rereadable(source)
    if isinstance(source, os.PathLike) and _is_json(source):
        where, found = str(source), _from_json(source)
    elif isinstance(source, Mapping) and "position" not in source:
        where, found = "sections", source
    else:
        where, found = _from_table(read_table(source, what="sections"))
    if not found:
        raise MultiposError(f"{where}: no sections; give a start and an end for each position.")
    return Sections(
        where, {str(label): _section(where, label, each) for label, each in found.items()}
    )


def _from_table(table: Table) -> tuple[str, Mapping[str, Any]]:
    where = table.source
    missing = [name for name in ("position", "start", "end") if name not in table]
    if missing:
        raise MultiposError(
            f"{where}: no column '{missing[0]}'; sections need position, start, end."
        )
    ends = zip(table.number("start").tolist(), table.number("end").tolist(), strict=True)
    labels = table.text("position")
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise MultiposError(f"{where}: section '{twice}' appears twice; give each its label.")
    return where, {
        label: {"start": start, "end": end}
        for label, (start, end) in zip(labels, ends, strict=True)
    }


def _is_json(path: os.PathLike[str]) -> bool:
    """Tell by the ending, or by the brace it begins with: a pipe has no ending."""
    if str(path).lower().endswith(".json"):
        return True
    return read_bytes(path, "sections").lstrip().startswith(b"{")


def _from_json(path: os.PathLike[str]) -> Mapping[str, Any]:
    found = read_json_value(path, "sections")
    if not isinstance(found, dict):
        raise MultiposError(
            f'{path}: sections are {{"label": {{"start": row, "end": row}}}}, got another form.'
        )
    return found


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

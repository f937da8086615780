"""One log: its rests, found or given, and what their samples say.

`find_still` returns it, `average_rests` what its samples say; `would_take` is for
messages.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError, refused_with
from multipos.files.spelling import listed
from multipos.finding import Finding, Findings
from multipos.logs.averages import taken_in_words
from multipos.logs.clock import Clock, time_columns
from multipos.logs.ellipsoids import covers, usual_turn
from multipos.logs.faults import fault_and_way, find_saturated, find_second_unit, find_wrapped
from multipos.logs.log_columns import choose_outputs
from multipos.logs.rest_means import RestMean, RestSum, rest_means
from multipos.logs.rests import (
    Finder,
    Grid,
    Limits,
    NoRestError,
    Rest,
    Sections,
    Survey,
    Windows,
    find_edges,
    long_enough,
)
from multipos.logs.samples import Kept, Progress, Samples, Timing, small_pieces
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import COLUMNS
from multipos.positions.headers import unused_columns
from multipos.results import frozen

_POSE_DEG = 20.0  # from row to row
_ALL_AROUND = 0.7  # of the half range: standard deviation of all directions together
_RESOLVED = 1e-17  # a smaller half range is none to the survey
_MOVED = 0.05  # of the largest reading: a sensor in one position has a smaller half range
_TURNED = 0.05  # of the half range, that a rest does not drift by
_GAP = 3.0  # usual steps of the time: a longer one is a gap


@frozen(eq=True)
class Wish:
    """What the user asks of each log."""

    outputs: tuple[str, ...] | None
    timing: Timing
    min_duration: float | None
    threshold: float | None
    sections: Sections | None
    label_column: str | None
    signed: int | None
    drop_bad: bool
    accept_faults: bool


@frozen(eq=True)
class Still:
    """One rest as its samples show it.

    Attributes
    ----------
    label : str
        As it was given; '' where the rest was found.
    rows : Rest
        Of the log.
    found : RestMean
    environment : mapping of str to float
    time : (float, float) or None [s]
    gaps : int
    moving : float or None
        Share of the windows above the threshold.
    saturated : tuple of str
        What is said of outputs that are cut off.
    """

    label: str
    rows: Rest
    found: RestMean
    environment: Mapping[str, float]
    time: tuple[float, float] | None
    gaps: int
    moving: float | None
    saturated: tuple[str, ...]


@frozen(eq=True)
class StillLog:
    """A log, and where it stands still.

    Attributes
    ----------
    log : Log
    outputs : tuple of str
    rests : tuple of Still
    short : tuple of Rest
        Stretches that stood still, but for less than a rest.
    shortest : int
        Samples in the shortest rest.
    survey : Survey
    clock : Clock or None
    rate : float or None [Hz]
    threshold : float or None
    findings : tuple of Finding
    """

    log: Log
    outputs: tuple[str, ...]
    rests: tuple[Still, ...]
    short: tuple[Rest, ...]
    shortest: int
    survey: Survey
    clock: Clock | None
    rate: float | None
    threshold: float | None
    findings: Findings


def find_still(log: Log, wish: Wish, progress: Progress | None = None) -> StillLog:
    """Find the rests of one log and average them.

    Raises
    ------
    MultiposError
        The log cannot be read as numbers, has no rest, or its time runs backwards.
    """
    label_column = None if wish.label_column is None else log.find(wish.label_column)
    timing = wish.timing.in_log(log)
    taken = [*time_columns(log), *filter(None, (timing.column, label_column))]
    outputs = choose_outputs(log, wish.outputs, taken)
    samples = Samples(
        log,
        outputs.names,
        timing,
        label_column=label_column,
        signed=wish.signed,
        drop_bad=wish.drop_bad,
    )
    notes = [*log.notes, *outputs.findings]
    with samples, refused_with(lambda: taken_in_words(outputs.names, notes=notes)):
        survey = samples.survey(wish.min_duration, progress)
        grid = survey.grid
        wrong = [*find_wrapped(samples, survey), *find_second_unit(survey)]
        if wrong and not wish.accept_faults:
            raise MultiposError(f"{log.source}: {fault_and_way(wrong[0])}")
        known = _known(samples, wish)
        notes[len(log.notes) : len(log.notes)] = _find_clock(samples)
        source = log.source if known is None else None
        limits = _limits(survey, wish.threshold, source, log.columns)
        found = None
        if known is None:
            assert limits is not None
            _refuse_poses(samples)
            found = _detect(samples, grid, limits)
            known = [("", rest) for rest in found.rests]
            notes += found.notes
        rests = average_rests(samples, known, grid, survey, None if found else limits)
        if found is not None:
            _require_still(log.source, rests, survey)
        return StillLog(
            log=log,
            outputs=outputs.names,
            rests=tuple(rests),
            short=() if found is None else tuple(map(samples.in_log, found.short)),
            shortest=grid.shortest if found is None else found.shortest,
            survey=survey,
            clock=samples.clock,
            rate=samples.rate,
            threshold=None if limits is None else limits.size,
            findings=(
                *notes,
                *_find_spikes(samples, [rest for _, rest in known]),
                *log.left_out,
                *wrong,
                *_find_left_out(samples, found),
            ),
        )


def _known(samples: Samples, wish: Wish) -> list[tuple[str, Rest]] | None:
    """Return the rests that the user knows, with their labels."""
    if wish.sections is not None:
        inside = wish.sections.inside(samples.log_rows)
        kept = [(label, samples.among_kept(rest)) for label, rest in inside.items()]
        empty = next((label for label, rest in kept if rest.end - rest.start < 2), None)
        if empty is not None:
            raise MultiposError(
                f"{samples.log.source}: of section '{empty}' fewer than two rows are not bad; "
                "correct the log, or leave the section out."
            )
        return kept
    return None if samples.labels is None else samples.labels.rests()


def _find_clock(samples: Samples) -> list[Finding]:
    clock = samples.clock
    said = []
    if clock is not None and (clock.column, clock.unit) != ("time", "s"):
        text = f"column '{clock.column}' is the time, in {clock.unit} by {clock.by}"
        said.append(Finding("time-column", "note", text))
    size, count = samples.wraps
    if clock is not None and count:
        text = (
            f"column '{clock.column}' wraps around {count} {'time' if count == 1 else 'times'}, "
            f"after {size:.10g} s; the time was continued"
        )
        said.append(Finding("time-column", "note", text))
    if samples.counter is not None:
        text = f"column '{samples.counter}' increases by 1 per row: a row counter, not a time"
        said.append(Finding("time-column", "note", text))
    if clock is None and samples.rate is not None and samples.rate == samples.log.rate:
        text = f"the log states a sample rate of {samples.rate:g} Hz"
        said.append(Finding("stated-rate", "note", text))
    return said


def _find_spikes(samples: Samples, rests: list[Rest]) -> list[Finding]:
    """Return how many single samples of the rests are far from their neighbours."""
    rows = np.array([row for row, _, _ in samples.spikes.found])
    count = sum(int(((rows >= start) & (rows < end)).sum()) for start, end in rests)
    if not count:
        return []
    share = count / sum(end - start for start, end in rests) / len(samples.outputs)
    text = (
        f"{count} samples at rest ({100 * share:.2g} %) are spikes; each was replaced by the "
        "median of its neighbours"
    )
    return [Finding("spikes", "note", text)]


def _find_left_out(samples: Samples, found: "_Found | None") -> list[Finding]:
    """Return what was left out, and what is assumed."""
    said = _unused(samples)
    if samples.dropped:
        rows = "row was" if samples.dropped == 1 else "rows were"
        text = f"{samples.dropped} bad {rows} omitted of {samples.log_rows}"
        said.append(Finding("dropped-rows", "note", text))
    if found is not None and found.frozen:
        where = listed([f"{start} to {end}" for start, end in map(samples.in_log, found.frozen)])
        text = (
            f"rows {where} repeat one value although the sensor has noise; they were omitted as "
            "frozen"
        )
        said.append(Finding("frozen", "warning", text, "Check the cable and the logger."))
    if found is not None and samples.rate is None:
        text = (
            f"the log has no time: a rest is at least {found.shortest} samples, of unknown duration"
        )
        action = "Add --rate or --time-column."
        said.append(Finding("no-time", "warning", text, action))
    return said


def _unused(samples: Samples) -> list[Finding]:
    log = samples.log
    used = {*samples.outputs, *log.numeric}
    used |= {each.column for each in (samples.clock, samples.labels) if each is not None}
    texts = [name for name in log.columns if name not in used | log.nameless]
    nameless = [place for place, name in enumerate(log.columns, 1) if name in log.nameless]
    said = [f"column '{name}' holds text and is not used" for name in texts]
    said += [f"column {place} has no name and is not used" for place in nameless]
    return unused_columns(said)


def _limits(
    survey: Survey, given: float | None, source: str | None, columns: Sequence[str]
) -> Limits | None:
    """Return what tells rest from motion; None where a log without `source` has no such."""
    if given is not None:
        return Limits(given)
    try:
        return survey.limits()
    except MultiposError as error:
        if source and survey.rows < survey.grid.shortest:
            free = " --unknown-orientation, or --scheme NAME where they are known"
            how = "" if COLUMNS & set(columns) else free
            raise MultiposError(
                f"{source}: {survey.rows} rows are too few for a log of samples, which has fewer "
                "than one rest; a table of means, one row a position, is for "
                f"multipos fit {Path(source).name}{how}."
            ) from None
        if source:
            raise type(error)(f"{source}: {error}") from None
        return None  # rests that are known need none; motion in them is then not looked for


class _Found(NamedTuple):
    """What stands still in a log."""

    rests: list[Rest]
    short: list[Rest]
    shortest: int  # samples in a rest
    frozen: list[Rest]
    notes: list[Finding]


def _detect(samples: Samples, grid: Grid, limits: Limits) -> _Found:
    """Return the rests, and the stretches that are too short for one."""
    windows, finder = Windows(grid.block), Finder(grid, limits)
    for _, piece in samples.pieces():
        for outputs in small_pieces(piece[: len(samples.outputs)]):
            finder.add(windows.feed(outputs)[1])
    found = find_edges(finder.runs(), samples.rows, grid, limits, samples.read)
    rests, short, shortest = long_enough(found, grid)
    said = [] if shortest == grid.shortest else [_adapted(samples, shortest)]
    if limits.slow < np.inf:
        text = (
            f"slow rotations were detected in means of {grid.block} samples (threshold "
            f"{limits.slow:.3g}), as single samples are too noisy"
        )
        said.append(Finding("vibration", "note", text))
    if not rests:
        raise NoRestError(
            f"{samples.log.source}: no rest of {shortest} samples in {samples.rows} rows at "
            f"threshold {limits.size:.3g}{would_take(short, shortest, samples.rate)}; hold the "
            f"sensor still, or give --sections."
        )
    return _Found(rests, short, shortest, finder.frozen(), said)


def _refuse_poses(samples: Samples) -> None:
    """Refuse rows without time that are a position each."""
    if samples.rate is not None or len(samples.outputs) != 3:
        return
    _, piece = next(samples.pieces())
    values = piece[:3].T
    turn = usual_turn(values) if covers(values) else 0.0
    if turn > _POSE_DEG:
        name = Path(samples.log.source).name
        raise MultiposError(
            f"{samples.log.source}: rows without time turn by {turn:.0f} degrees from one to the "
            "next: each is a position, not a sample of a log; type multipos fit "
            f"{name} --unknown-orientation."
        )


def _require_still(source: str, rests: Sequence[Still], survey: Survey) -> None:
    """Refuse a log of which most of what moves least turns, as a rest does not."""
    half_range = float((survey.highest - survey.lowest).max()) / 2.0
    size = float(np.abs([survey.highest, survey.lowest]).max())
    if len(survey.lowest) != 3 or half_range < max(_MOVED * size, _RESOLVED):
        return
    count = sum(_turns(each.found, half_range) for each in rests)
    if count > len(rests) / 2.0:
        raise NoRestError(
            f"{source}: no rest: {count} of the {len(rests)} stretches in which the sensor moves "
            f"least turn by more than {_TURNED:.0%} of 1 g; hold it still in each position, or "
            "turn it slowly in all directions for a minute or more and use calibrate."
        )


def _turns(found: RestMean, half_range: float) -> bool:
    """Tell whether a stretch drifts, or varies, as no rest does."""
    drift, sd = (float(np.linalg.norm(each)) / half_range for each in (found.drift, found.sd))
    return drift > _TURNED or sd > _ALL_AROUND


def _adapted(samples: Samples, shortest: int) -> Finding:
    long = f"{shortest} samples" if samples.rate is None else f"{shortest / samples.rate:.3g} s"
    return Finding("short-rests", "note", f"short rests were accepted, of {long} or more")


def would_take(short: Sequence[Rest], shortest: int, rate: float | None) -> str:
    """Return what would take in the stretches that are too short, '' where there are none."""
    if not short:
        return ""
    many = "stretch" if len(short) == 1 else "stretches"
    least = min(rest.end - rest.start for rest in short)
    if rate is None:
        long = f"{shortest} samples; --rate HZ --min-duration S takes them in"
    else:
        seconds = np.floor(100.0 * least / rate) / 100.0
        long = f"{shortest / rate:.3g} s; --min-duration {seconds:.3g} takes them in"
    return f"; {len(short)} more {many} stood still for less than {long}"


def average_rests(
    samples: Kept, rests: list[tuple[str, Rest]], grid: Grid, survey: Survey, limits: Limits | None
) -> list[Still]:
    """Average every rest, with the label that it has, in one pass; look for motion by limits."""
    threshold = None if limits is None else limits.size
    sums = [_Sum(samples, label, rest, grid, threshold) for label, rest in rests]
    for first, piece in samples.pieces():
        for each in sums:
            each.feed(first, piece)
    means = rest_means([each.taken for each in sums])
    return [each.result(found, survey) for each, found in zip(sums, means, strict=True)]


class _Sum:
    """Take up the rows of one rest: its outputs, its other columns and its time."""

    def __init__(
        self, samples: Kept, label: str, rest: Rest, grid: Grid, threshold: float | None
    ) -> None:
        self._samples, self._label, self._rest = samples, label, rest
        self._threshold = threshold
        self.taken = RestSum(rest.end - rest.start, len(samples.outputs))
        self._windows = Windows(grid.block)
        self._seen = self._moved = 0
        others = len(samples.others)
        self._total, self._count = np.zeros(others), np.zeros(others)
        self._time: list[float] = []
        self._gaps = 0

    def feed(self, first: int, piece: Array) -> None:
        start = max(self._rest.start - first, 0)
        end = min(self._rest.end - first, piece.shape[1])
        if start >= end:
            return
        inside = piece[:, start:end]
        outputs = inside[: len(self._samples.outputs)]
        for small in small_pieces(outputs):
            self.taken.feed(small)
            if self._threshold is not None:
                sd = self._windows.feed(small)[1][0]
                self._seen += len(sd)
                self._moved += int((sd > self._threshold).sum())
        others = inside[len(outputs) : len(outputs) + len(self._total)]
        there = np.isfinite(others)
        self._total += others.sum(axis=1, where=there)
        self._count += np.count_nonzero(there, axis=1)
        if self._samples.clock is not None:
            time = np.concatenate([self._time[-1:], inside[-1]])
            self._gaps += int((np.diff(time) > _GAP * self._samples.step).sum())
            self._time = [self._time[0] if self._time else float(time[0]), float(time[-1])]

    def result(self, found: RestMean, survey: Survey) -> Still:
        with np.errstate(invalid="ignore"):
            means = (self._total / self._count).tolist()
        time = (self._time[0], self._time[1]) if self._time else self._samples.time(self._rest)
        return Still(
            label=self._label,
            rows=self._samples.in_log(self._rest),
            found=found,
            environment=dict(zip(self._samples.others, means, strict=True)),
            time=time,
            gaps=self._gaps,
            moving=self._moved / self._seen if self._seen else None,
            saturated=tuple(find_saturated(self._samples, self._rest, found, survey)),
        )

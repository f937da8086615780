"""From a raw log to readings: find the rests, average each, say how well and where.

The log is read once. Its numbers are kept in a temporary file where they are many, so that the
passes that follow (find the threshold, find the rests, average them) cost little and a log may
be longer than memory.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.lists import Names, split_names
from multipos.files.tables import Source
from multipos.logs.averages import Averages, RestAverage
from multipos.logs.known_rests import read_sections
from multipos.logs.matching import FARTHEST_DEG, Match, match_directions
from multipos.logs.opening import open_log
from multipos.logs.rest_faults import check_units, find_faults, refuse_saturated
from multipos.logs.rest_means import RestMean, RestSum
from multipos.logs.rests import Finder, Grid, Rest, Survey, Windows
from multipos.logs.samples import Progress, Samples, small_pieces
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import Convention, check_convention
from multipos.positions.reading_tables import is_environment
from multipos.positions.scheme import Scheme, read_scheme

_GAP = 3.0  # usual steps of the time: a longer one is a gap


def average(
    log: "Source | Log",
    *,
    outputs: Names | None = None,
    columns: Names | None = None,
    time_column: str | None = None,
    rate: float | None = None,
    min_duration: float | None = None,
    threshold: float | None = None,
    sections: Source | None = None,
    only: Names | None = None,
    scheme: "Source | Scheme | None" = None,
    convention: Convention = "specific-force",
    progress: Progress | None = None,
) -> Averages:
    """Average the rests of a raw log.

    Parameters
    ----------
    log : path, mapping of columns, data frame, or Log
    outputs : names, optional
        The columns that are outputs; otherwise every numeric column without another meaning.
    columns : names, optional
        Names of all columns of the log, where it has no header or another is wanted.
    time_column : str, optional
        Column with the time [s]; ``time`` where there is one.
    rate : float, optional [Hz]
        Sample rate, where no column tells the time.
    min_duration : float, optional [s]
        Shortest rest; two seconds, or 192 samples where the rate is not known.
    threshold : float, optional
        Standard deviation of a window above which it moves; learnt from the log otherwise.
    sections : path or mapping, optional
        Rows where each rest begins and ends, instead of finding them.
    only : names, optional
        Labels of the rests to average.
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        Positions to match the rests to, by direction.
    convention : str
        'specific-force' or 'gravity': which sign the axis that points up has, for matching.
    progress : callable, optional
        Is told how much of the log has been read.

    Returns
    -------
    Averages

    Raises
    ------
    MultiposError
        The log has no rests, or only one; a time that runs backwards; a saturated or stuck
        output; outputs of different units; rests that match no position.
    UsageError
        An option is at fault.
    """
    if time_column is not None and rate is not None:
        raise UsageError("--time-column and --rate both tell the time; give one.")
    if threshold is not None and not 0.0 < threshold < np.inf:
        raise UsageError(f"--threshold must be above 0, got {threshold:g}.")
    check_convention(convention)
    wanted = None if scheme is None else read_scheme(scheme)
    given_outputs = None if outputs is None else split_names(outputs, "--outputs")
    source = open_log(log, columns=columns)
    names = _outputs(source, given_outputs, time_column)
    check_units(names, None)
    if time_column is None and rate is None and "time" in source.numeric:
        time_column = "time"
    given = None if sections is None else read_sections(sections)
    with Samples(source, names, time_column) as samples:
        survey, grid, rate = samples.survey(rate, min_duration, progress)
        threshold = _threshold(survey, threshold, needed=given is None)
        if given is None:
            assert threshold is not None
            rests = _detect(samples, grid, threshold)
            labelled = {str(i + 1): rest for i, rest in enumerate(rests)}
        else:
            labelled = given.inside(samples.rows)
        chosen = _choose(labelled, None if only is None else split_names(only, "--only"))
        found = _average_all(samples, chosen, grid, threshold)
    means = [each.found for each in found]
    refuse_saturated(names, list(chosen.items()), means, survey)
    check_units(names, np.array([each.mean for each in means]))
    match = None if wanted is None else _match(means, chosen, wanted, convention)
    return _complete(
        source, names, chosen, found, survey, match, wanted, rate, threshold, samples.notes
    )


def _outputs(log: Log, given: tuple[str, ...] | None, time_column: str | None) -> tuple[str, ...]:
    for name in (*(given or ()), *([time_column] if time_column else ())):
        if name not in log.columns:
            raise MultiposError(
                f"{log.source}: no column '{name}'; the columns are {', '.join(log.columns)}."
            )
    if given is not None:
        return given
    names = tuple(n for n in log.numeric if n != time_column and not is_environment(n))
    if not names:
        raise MultiposError(f"{log.source}: no numeric column can be an output; see --columns.")
    if len(names) > 3:
        raise UsageError(
            f"{len(names)} columns could be outputs: {', '.join(names)}; name them with --outputs."
        )
    return names


def _threshold(survey: Survey, given: float | None, *, needed: bool) -> float | None:
    if given is not None:
        return given
    try:
        return survey.threshold()
    except MultiposError:
        if needed:
            raise
        return None  # sections need none; motion in them is then not looked for


def _detect(samples: Samples, grid: Grid, threshold: float) -> list[Rest]:
    windows, finder = Windows(grid.block), Finder(grid, threshold)
    for _, piece in samples.pieces():
        for outputs in small_pieces(piece[: samples.outputs]):
            finder.add(windows.feed(outputs)[1])
    rests = finder.rests(samples.rows)
    where = samples.log.source
    if not rests:
        raise MultiposError(
            f"{where}: no rest of {grid.shortest} samples in {samples.rows} rows at threshold "
            f"{threshold:.3g}; hold the sensor still, lower --min-duration, or give --sections."
        )
    if len(rests) == 1:
        raise MultiposError(
            f"{where}: one rest only, rows {rests[0].start} to {rests[0].end} of {samples.rows}, "
            f"at threshold {threshold:.3g}; a calibration needs several positions: record them "
            "in one log, lower --threshold, or give --sections."
        )
    return rests


def _choose(labelled: dict[str, Rest], only: tuple[str, ...] | None) -> dict[str, Rest]:
    if only is None:
        return labelled
    strange = [label for label in only if label not in labelled]
    if strange:
        raise MultiposError(
            f"--only names '{strange[0]}', but the rests are {', '.join(labelled)}."
        )
    return {label: rest for label, rest in labelled.items() if label in only}


def _match(
    means: list[RestMean], chosen: Mapping[str, Rest], scheme: Scheme, convention: Convention
) -> Match:
    match = match_directions(np.array([each.mean for each in means]), scheme, convention)
    bad = np.flatnonzero(match.doubtful).tolist()
    if bad:
        known = scheme.labels or [str(i + 1) for i in range(len(scheme))]
        i, label = bad[0], list(chosen)[bad[0]]
        raise MultiposError(
            f"{len(bad)} of {len(means)} rests match no position of scheme '{scheme.name}': rest "
            f"'{label}' (rows {chosen[label].start} to {chosen[label].end}) lies "
            f"{match.distance_deg[i]:.1f} degrees from position '{known[match.rows[i]]}' and "
            f"{match.second_deg[i]:.1f} from the next (the nearest must be within "
            f"{FARTHEST_DEG:g} degrees and twice as near as the next); name the right rests with "
            "--only, or leave --scheme out and use fit --unknown-orientation."
        )
    return match


@dataclass(frozen=True)
class _Found:
    """One rest as its samples show it."""

    found: RestMean
    environment: dict[str, float]
    time: tuple[float, float] | None
    gaps: int
    moving: float | None  # share of the windows above the threshold


def _average_all(
    samples: Samples, rests: Mapping[str, Rest], grid: Grid, threshold: float | None
) -> list[_Found]:
    """Average every rest in one pass."""
    sums = [_Sum(samples, rest, grid, threshold) for rest in rests.values()]
    for first, piece in samples.pieces():
        for each in sums:
            each.feed(first, piece)
    return [each.result() for each in sums]


class _Sum:
    """Take up the rows of one rest: its outputs, its other columns and its time."""

    def __init__(self, samples: Samples, rest: Rest, grid: Grid, threshold: float | None) -> None:
        self._samples, self._rest, self._threshold = samples, rest, threshold
        self._sum = RestSum(rest.end - rest.start, samples.outputs)
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
        outputs = inside[: self._samples.outputs]
        for small in small_pieces(outputs):
            self._sum.feed(small)
            if self._threshold is not None:
                sd = self._windows.feed(small)[1]
                self._seen += len(sd)
                self._moved += int((sd > self._threshold).sum())
        others = inside[len(outputs) : len(outputs) + len(self._total)]
        self._total += np.nansum(others, axis=1)
        self._count += np.isfinite(others).sum(axis=1)
        if self._samples.time_column is not None:
            time = np.concatenate([self._time[-1:], inside[-1]])
            self._gaps += int((np.diff(time) > _GAP * self._samples.step).sum())
            self._time = [self._time[0] if self._time else float(time[0]), float(time[-1])]

    def result(self) -> _Found:
        with np.errstate(invalid="ignore"):
            means = (self._total / self._count).tolist()
        time = (self._time[0], self._time[1]) if self._time else self._samples.time(self._rest)
        return _Found(
            found=self._sum.result(),
            environment=dict(zip(self._samples.others, means, strict=True)),
            time=time,
            gaps=self._gaps,
            moving=self._moved / self._seen if self._seen else None,
        )


def _complete(
    log: Log,
    names: tuple[str, ...],
    chosen: Mapping[str, Rest],
    found: list[_Found],
    survey: Survey,
    match: Match | None,
    scheme: Scheme | None,
    rate: float | None,
    threshold: float | None,
    notes: list[str],
) -> Averages:
    labels = list(chosen)
    if match is not None and scheme is not None:
        known = scheme.labels or [str(i + 1) for i in range(len(scheme))]
        labels = [known[row] for row in match.rows]
        unseen = [label for i, label in enumerate(known) if i not in match.rows]
        if unseen:
            notes = [*notes, f"no rest at position {', '.join(unseen)} of scheme '{scheme.name}'"]
    faults, general = find_faults(
        names,
        [each.found for each in found],
        survey.resolution,
        [each.gaps for each in found],
        [each.moving for each in found],
        labels,
    )
    rests = tuple(
        RestAverage(
            position=label,
            rows=rest,
            time=each.time,
            found=each.found,
            environment=each.environment,
            distance_deg=None if match is None else float(match.distance_deg[i]),
            notes=tuple(faults[i]),
        )
        for i, (label, rest, each) in enumerate(zip(labels, chosen.values(), found, strict=True))
    )
    warnings = [
        f"position '{rest.position}' (rows {rest.rows.start} to {rest.rows.end}): {note}"
        for rest in rests
        for note in rest.notes
    ]
    return Averages(
        source=log.source,
        outputs=names,
        rests=rests,
        scheme_up=None if match is None or scheme is None else scheme.up[match.rows],
        sample_rate=rate,
        threshold=threshold,
        warnings=(*notes, *warnings, *general),
    )

"""From raw logs to readings: find the rests, average each, say how well and where.

A log is read once. Its numbers are kept in a temporary file where they are many, so that the
passes that follow (find the threshold, find the rests, average them) cost little and a log may
be longer than memory. Of several logs those with one rest are a position each, named by their
files; the rests of the others follow each other.
"""

from dataclasses import replace
from typing import TypedDict

import numpy as np

from multipos.errors import MultiposError, UsageError, refused_with
from multipos.files.spelling import Names, split_names, spread
from multipos.files.tables import Source
from multipos.finding import in_order
from multipos.logs.averages import Averages, taken_in_words
from multipos.logs.clock import TimeUnit
from multipos.logs.faults import SaturatedRestsError, fault_and_way, saturated_few
from multipos.logs.joining import choose, complete, faults_of_means, require_alike, require_several
from multipos.logs.opening import less_copies, open_log
from multipos.logs.rests import read_sections
from multipos.logs.samples import Progress, read_timing, rows_of_sensor, share_of
from multipos.logs.still import StillLog, Wish, find_still
from multipos.logs.table import Log, called_as
from multipos.positions.attitudes import Convention, check_convention
from multipos.positions.headers import TEMPERATURE
from multipos.positions.order import Order
from multipos.positions.scheme import Scheme, read_scheme


class ReadingOptions(TypedDict, total=False):
    """How the rows of a log are read, and where they are at rest: options of `average`."""

    columns: Names | None
    time_column: str | None
    time_unit: TimeUnit | None
    rate: float | None
    min_duration: float | None
    threshold: float | None


class RestOptions(ReadingOptions, total=False):
    """The options of `average` beside those that a fit of its readings has too."""

    sections: Source | None
    label_column: str | None
    only: Names | None
    signed: int | None
    drop_bad: bool
    accept_faults: bool
    progress: Progress | None


def average(
    *logs: "Source | Log",
    outputs: Names | None = None,
    columns: Names | None = None,
    time_column: str | None = None,
    time_unit: TimeUnit | None = None,
    rate: float | None = None,
    min_duration: float | None = None,
    threshold: float | None = None,
    sections: Source | None = None,
    label_column: str | None = None,
    only: Names | None = None,
    signed: int | None = None,
    drop_bad: bool = False,
    accept_faults: bool = False,
    scheme: "Source | Scheme | None" = None,
    order: Order = "paper",
    convention: Convention = "specific-force",
    progress: Progress | None = None,
) -> Averages:
    """Average the rests of raw logs.

    Parameters
    ----------
    *logs : path, mapping of columns, data frame, or Log
        One or more, or one list of them. Of several, each with one rest is a position, named by
        its file; the rests of the others follow each other.
    outputs : names, optional
        The columns that are outputs; otherwise those that the log names as acceleration, or every
        numeric column without another meaning.
    columns : names, optional
        Names of all columns of the log, where it has no header or another is wanted.
    time_column : str, optional
        Column with the time; otherwise the one that is named so.
    time_unit : str, optional
        's', 'ms', 'us' or 'ns'; otherwise by the column's name, or its steps.
    rate : float, optional [Hz]
        Sample rate, where no column tells the time.
    min_duration : float, optional [s]
        Shortest rest; two seconds (192 samples where the rate is not known), or less where
        the rests of the log are shorter.
    threshold : float, optional
        Standard deviation of a window above which it moves; learnt from the log otherwise.
    sections : path or mapping, optional
        Rows where each rest begins and ends, instead of finding them.
    label_column : str, optional
        Column that names the position of each row, instead of finding rests; rows where it is
        empty belong to none.
    only : names, optional
        Labels of the rests to average; or ``COLUMN=VALUE``, the rows of one of several sensors
        that take turns in the log.
    signed : int, optional
        Bits of two's complement that outputs are read as, which the log has without a sign.
    drop_bad : bool
        Leave out rows in which an output or the time is no number, or any number a million times
        the median of its column; how many is said.
    accept_faults : bool
        Go on where outputs look saturated, stuck, wrapped around or of two units, and warn.
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        Positions to match the rests to: by direction, with fewer than three outputs in order.
    order : str
        That order: 'paper' (as published or written), 'spread' or 'travel'.
    convention : str
        'specific-force' or 'gravity': which sign the axis that points up has, for matching.
    progress : callable, optional
        Called with how much has been read.

    Returns
    -------
    Averages

    Raises
    ------
    MultiposError
        There is no rest, or only one; a time that runs backwards; a saturated or stuck
        output; outputs of different units; rests that match no position.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import multipos as mp
    >>> log = mp.simulate_log(mp.demo().calibration, "faces-6", sample_sd=1e-3, seed=1)
    >>> found = mp.average(log, scheme="faces-6", convention="gravity")
    >>> [rest.position for rest in found.rests], round(found.sample_rate, 6)
    (['1', '2', '3', '4', '5', '6'], 100.0)
    """
    sources, copies = less_copies(spread(logs))
    if not sources:
        raise TypeError("average needs a log.")
    check_convention(convention)
    wanted = None if scheme is None else read_scheme(scheme, order=order)
    which, sensor = _sensor(_names(only, "--only"))
    wish = Wish(
        outputs=_names(outputs, "--outputs"),
        timing=read_timing(time_column, time_unit, rate),
        min_duration=min_duration,
        threshold=threshold,
        sections=None if sections is None else read_sections(sections),
        label_column=label_column,
        signed=signed,
        drop_bad=drop_bad,
        accept_faults=accept_faults,
    )
    _check(wish, len(sources))
    found: list[StillLog] = []
    for i, source in enumerate(sources):
        log = called_as(open_log(source, columns=columns, outputs=outputs), (TEMPERATURE,))
        log = log if sensor is None else rows_of_sensor(log, *sensor)
        found.append(find_still(log, wish, share_of(progress, i, len(sources))))
    require_alike(found)
    rests = [each.rows for log in found for each in log.rests]
    short = [each for log in found for each in log.short]
    with refused_with(lambda: taken_in_words(found[0].outputs, rests, short)):
        if len(found) == 1 and wish.sections is None and label_column is None:
            require_several(found[0])
        chosen = choose(found, which)
        wrong = faults_of_means(chosen)
        if wrong and not accept_faults:
            few = saturated_few(wrong, len(chosen)) and all(each.rows for each in wrong)
            raise (SaturatedRestsError if few else MultiposError)(fault_and_way(wrong[0]))
        averages = complete(found, chosen, wanted, convention, wrong)
    return replace(averages, findings=in_order((*copies, *averages.findings)))


def _check(wish: Wish, logs: int) -> None:
    signed, threshold = wish.signed, wish.threshold
    if signed is not None and not 2 <= signed <= 32:
        raise UsageError(f"--signed takes the bits of a register, 2 to 32, got {signed}.")
    if threshold is not None and not 0.0 < threshold < np.inf:
        raise UsageError(f"--threshold must be above 0, got {threshold:g}.")
    if wish.sections is not None and wish.label_column is not None:
        raise UsageError("--sections and --label-column both state the positions; give one.")
    if wish.sections is not None and logs > 1:
        raise UsageError("--sections are rows of one log, but several are given.")


def _names(given: Names | None, option: str) -> tuple[str, ...] | None:
    return None if given is None else split_names(given, option)


def _sensor(only: tuple[str, ...] | None) -> tuple[tuple[str, ...] | None, tuple[str, str] | None]:
    """Return labels, and the column and value of one sensor, that --only names."""
    filters = [each.partition("=")[::2] for each in only or () if "=" in each]
    if len(filters) > 1:
        raise UsageError("--only takes the rows of one sensor: give one COLUMN=VALUE.")
    labels = tuple(each for each in only or () if "=" not in each)
    return labels or None, filters[0] if filters else None

"""From a source to a result: the loop that a session lives in, and the front door `capture`.

`make_plan` and `make_reading` gather what was asked for, `run_session` is the loop, and `captured`
or, after a fault, `rescued` gives the result. Rows go from the source into the session as they
come, and, where they are in no file yet, into a log (`multipos.capturing.keeping`). The loop ends
with the source, with `finish`, when it is enough, or by Ctrl-C; what has been taken then is the
result.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Unpack

from multipos.capturing.arrivals import RowSource
from multipos.capturing.evaluation import SessionPlan, average_poses
from multipos.capturing.keeping import Kept, RawLog
from multipos.capturing.live_rows import RowOptions
from multipos.capturing.rehearsal import rehearse
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.capturing.state import line_of, state_of
from multipos.capturing.targets import Targets, read_targets
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, StrPath, split_names
from multipos.files.tables import Source
from multipos.finding import Finding, Findings, in_order
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import FitOptions, takes_options
from multipos.logs.averages import Averages
from multipos.logs.averaging import ReadingOptions, average
from multipos.logs.clock import TimeUnit
from multipos.logs.samples import read_timing
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import check_convention
from multipos.positions.order import Order
from multipos.positions.scheme import Scheme, lay_scheme
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration

Notify = Callable[[dict[str, Any]], object]


@frozen
class Captured(Result):
    """What a guided session gave.

    Attributes
    ----------
    averages : Averages or None
        The poses that count; None where there is none.
    calibration : Calibration or None
        None where they are too few; `problem` says why.
    problem : str or None
    state : mapping
        What was shown at last, keys as in the reference of the command.

    Examples
    --------
    >>> import multipos as mp
    >>> sensor = mp.demo().calibration
    >>> log = mp.simulate_log(sensor, "corners-8", rate=50, rest=4, sample_sd=1e-3, seed=1)
    >>> mp.write_table("log.csv", log)
    >>> found = mp.capture("replay:log.csv:0")
    >>> len(found.averages.rests), found.calibration is None
    (8, True)
    >>> print(found.problem[:44])
    8 positions give 8 equations for 9 parameter
    """

    averages: Averages | None
    calibration: Calibration | None
    problem: str | None
    state: Mapping[str, Any]

    @property
    def findings(self) -> Findings:
        """What was found about the result."""
        found = self.averages if self.calibration is None else self.calibration
        if found is None:
            return ()
        if self.problem is None or self.calibration is None:
            return found.findings
        return in_order((*found.findings, Finding("reduced-model", "warning", self.problem)))

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry."""
        calibration = None if self.calibration is None else self.calibration.to_dict()
        findings = [each.to_dict() for each in self.findings]
        return {**self.state, "calibration": calibration, "findings": findings}


_OF_ROWS = ("time_column", "time_unit", "rate", "min_duration", "threshold")


class CaptureOptions(ReadingOptions, FitOptions, total=False):
    """The options of `capture`: how rows are read, and how the rests are fitted."""


@takes_options(CaptureOptions, average, fit, order=None)
def capture(
    source: str,
    *,
    target: "Targets | Sequence[str]" = (),
    positions: int | None = None,
    log: StrPath | None = None,
    told: Notify | None = None,
    **options: Unpack[CaptureOptions],
) -> Captured:
    """Take rests from a live source until it is enough, and calibrate from them.

    Parameters
    ----------
    source : str
        ``serial:DEVICE:BAUD``, ``udp:PORT``, ``-``, a log that grows, or ``replay:LOG:SPEED``.
    target : mapping of str to float, or sequence of 'TERM=U', optional
        U that parameters shall have, by name or kind; without them it goes on until `positions`,
        or the end of the source.
    positions : int, optional
        Poses after which it is enough.
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        Known positions to lead through; otherwise the orientations are unknown.
    order : str
        'spread' against drift, 'travel' in short ways, or 'paper' (`multipos.positions.order`);
        'spread' for a name where not given, and else as written.
    log : path, optional
        Where the rows go as they come.
    told : callable, optional
        Is given each pose as it is taken or refused, and ``connected`` where that changes: a line
        of ``--headless`` as a mapping.
    **options
        How the rows are read: as for `multipos.average`. What is fitted, and how: as for
        `multipos.fit`.

    Returns
    -------
    Captured

    Raises
    ------
    MultiposError
        The source cannot be read, or nothing in it is like a rest; or nominal readings cannot be
        fitted by these options.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import multipos as mp
    >>> sensor = mp.demo().calibration
    >>> log = mp.simulate_log(sensor, "faces-6", rate=50, rest=4, sample_sd=1e-3, seed=1)
    >>> mp.write_table("log.csv", log)
    >>> found = mp.capture("replay:log.csv:0", scheme="faces-6", convention="gravity")
    >>> len(found.averages.rests), found.calibration.names[0]
    (6, 'bias_ax')
    """
    opened = open_source(source)
    given: dict[str, Any] = {**options}
    scheme, order = given.pop("scheme", None), given.pop("order", None)
    columns = given.pop("columns", None)
    rows = {name: given.pop(name, None) for name in ("outputs", *_OF_ROWS)}
    plan = make_plan(target, positions, scheme, given, order)
    reading = make_reading(**rows)
    rehearse(plan, reading.outputs)
    session = Session(plan, reading, None if told is None else teller(told))
    run_session(session, opened, columns, Kept(log=None if log is None else Path(log)))
    return captured(session)


def teller(told: Notify) -> Callable[[Session], object]:
    """Return what tells of a session: its newest pose, or a connection that is lost or back."""
    connected = True

    def tell(session: Session) -> None:
        nonlocal connected
        changed, connected = session.connected != connected, session.connected
        told({"connected": connected} if changed else line_of(session))

    return tell


def make_plan(
    target: "Targets | Sequence[str]",
    positions: int | None,
    scheme: "Source | Scheme | None",
    fitting: dict[str, Any],
    order: Order | None = None,
) -> SessionPlan:
    """Return what was asked for, checked."""
    check_convention(fitting.get("convention", "specific-force"))
    if positions is not None and positions < 1:
        raise UsageError(f"--positions must be 1 or more, got {positions}.")
    known = None if scheme is None else lay_scheme(scheme, order)
    return SessionPlan(fitting, read_targets(target), positions, known, order)


def make_reading(
    outputs: Names | None,
    time_column: str | None,
    time_unit: TimeUnit | None,
    rate: float | None,
    min_duration: float | None,
    threshold: float | None,
) -> RowOptions:
    """Return how the rows are read, checked."""
    timing = read_timing(time_column, time_unit, rate)
    if threshold is not None and not 0.0 < threshold < float("inf"):
        raise UsageError(f"--threshold must be above 0, got {threshold:g}.")
    named = None if outputs is None else split_names(outputs, "--outputs")
    return RowOptions(named, timing, min_duration, threshold)


def run_session(
    session: Session, source: RowSource, columns: Names | None = None, kept: Kept | None = None
) -> None:
    """Let rows go into the session until it is finished; Ctrl-C is the word that it is enough.

    Parameters
    ----------
    session : Session
    source : RowSource
    columns : names, optional
    kept : Kept, optional
        Where rows and decisions go, and what the session goes on from.
    """
    kept = kept or Kept()
    with closing(RawLog(kept)) as raw:
        if kept.before is not None:
            earlier = open_source(f"replay:{kept.before}:0")
            _feed(session, earlier, None, None, kept, going_on=True)
        try:
            with suppress(KeyboardInterrupt):
                _feed(session, source, columns, raw, kept, going_on=False)
        except BaseException:  # the rests that are there count all the same
            with suppress(Exception):
                _finish(session, kept)
            raise
        _finish(session, kept)


def _finish(session: Session, kept: Kept) -> None:
    with session.changed:
        session.finish()
        session.changed.notify_all()
    kept.write(session)


def _feed(
    session: Session,
    source: RowSource,
    columns: Names | None,
    raw: RawLog | None,
    kept: Kept,
    *,
    going_on: bool,
) -> None:
    for arrival in source.arrivals(columns):
        with session.changed:
            if arrival.log is not None:
                _begin(session, source, arrival.log, arrival.columns)
                if raw is not None:
                    raw.begin(arrival.log)
                continue
            if session.rows is not None:
                good = session.feed(arrival.columns, connected=arrival.connected)
                if raw is not None:
                    raw.write(arrival.lines, good)
            session.changed.notify_all()
            done = session.asked_to_finish or (session.is_enough and not going_on)
        kept.write(session)
        if done:
            return


def _begin(session: Session, source: RowSource, log: Log, head: Array) -> None:
    """Settle the columns, or see that they are those that the session began with."""
    if session.rows is None:
        session.begin(log, head)
    elif not _goes_on(session.rows.log, log):
        raise MultiposError(
            f"{source.name}: the columns are {', '.join(log.columns)}, but the session began with "
            f"{', '.join(session.rows.log.columns)}; give another -o, or the same source."
        )
    source.rate = session.rate or source.rate


def _goes_on(before: Log, log: Log) -> bool:
    """Tell whether columns are those of before; a device says their names only when it starts."""
    if not log.headless:
        return log.columns == before.columns
    known, now = ([each.columns.index(n) for n in each.numeric] for each in (before, log))
    return len(log.columns) == len(before.columns) and known == now


def captured(session: Session) -> Captured:
    """Return the result of a session."""
    found = session.evaluation
    return Captured(found.averages, found.calibration, found.problem, state_of(session))


def rescued(session: Session) -> Captured:
    """Return what an unfinished session has taken: the averages of the poses that count."""
    averages = average_poses(session.plan, session.still_log(), session.accepted)
    return Captured(averages, None, None, state_of(session))

"""From a source to a result: the loop that a session lives in, and the front door `capture`.

What of a session is kept in files, so that nothing is lost and it can go on: beside READINGS.csv
stand READINGS_log.csv, the rows of a source that is no log, written as they come, and
READINGS_session.json, the threshold and rate that were fixed and what the user took back. With
these and the log the same poses are found again. READINGS_session.lock has the number of the
process that writes them, while it does.

Rows go from the source into the session as they come, and, where they are in no file yet, into a
log. The loop ends with the source, with `finish`, when it is enough, or by Ctrl-C; what has been
taken then is the result.

The log of a session: every row as it came, at once, so that nothing is lost.

Rows without numbers are kept as comments: read again, the log has the rows that the session had.
"""

import csv
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import IO, Any, Unpack

from multipos.capturing.evaluation import SessionPlan, Targets, average_poses, read_targets
from multipos.capturing.live_rests import RowOptions
from multipos.capturing.session import Session, line_of, state_of
from multipos.capturing.streams import RowSource, open_source
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, StrPath, split_names
from multipos.files.tables import Source
from multipos.files.trees import read_json, to_json
from multipos.files.whole import write_text, writing
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

_SCHEMA = "multipos/capture/1"
_LAST = 1 << 16  # bytes that hold the last row
_DIGITS = 10  # that no process number has
_DEFAULT = Path("capture.csv")  # of a source whose rows would be gone otherwise


@dataclass
class Kept:
    """What is kept of a session.

    Attributes
    ----------
    log : path or None
        Where the rows go.
    before : path or None
        The log that the session goes on from.
    session : path or None
        Where decisions go.
    earlier : mapping
        What the session file held.
    said : list of str
        What the user is to know.
    """

    log: Path | None = None
    before: Path | None = None
    session: Path | None = None
    earlier: Mapping[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    seen: int = -1  # version of the session
    written: str = ""

    @property
    def decided(self) -> Mapping[str, str]:
        """What the user took back."""
        found: Mapping[str, str] = self.earlier.get("taken_back", {})
        return found

    def as_before(self, reading: RowOptions) -> RowOptions:
        """Return how the rows are read, with the threshold and the rate that were fixed."""
        threshold, rate = self.earlier.get("threshold"), self.earlier.get("rate_by_arrival")
        timing = reading.timing
        if rate is not None and timing.rate is None and timing.column is None:
            timing = timing._replace(rate=rate)
        return replace(reading, threshold=reading.threshold or threshold, timing=timing)

    def write(self, session: Session) -> None:
        """Write the session file, where anything in it has changed."""
        if self.session is None or session.rows is None or session.threshold is None:
            return
        if session.version == self.seen:
            return
        self.seen = session.version
        counted = session.rows.clock is None
        text = to_json(
            {
                "schema": _SCHEMA,
                "source": session.rows.log.source,
                "threshold": session.threshold,
                "rate": session.rate,
                "rate_by_arrival": session.rate if counted else None,
                "taken_back": dict(session.decided),
            }
        )
        if text != self.written:
            write_text(self.session, text)
            self.written = text


def files_kept(source: RowSource, readings: Path) -> tuple[Path, ...]:
    """Return the session file, its lock and, of a source that is no log, where its rows go."""
    endings = ("_session.json", "_session.lock", *(("_log.csv",) if source.path is None else ()))
    return tuple(readings.with_name(f"{readings.stem}{ending}") for ending in endings)


@contextmanager
def keep(source: RowSource, readings: Path | None, *, resume: bool) -> Iterator[Kept]:
    """Yield what is kept, beside the readings; earlier rows are never written over.

    Raises
    ------
    UsageError, MultiposError
        There is no session to go on with, or another process keeps one there.
    """
    if readings is None and not source.untimed:
        if resume:
            raise UsageError("--resume goes on with the session of -o READINGS.csv; name it.")
        yield Kept()
        return
    session, lock, *logs = files_kept(source, readings or _DEFAULT)
    with _locked(lock) as said:
        yield _kept(session, logs[0] if logs else None, said, resume=resume)


@contextmanager
def _locked(lock: Path) -> Iterator[list[str]]:
    """Hold a lock, by the number of this process; yield what to say of an older one.

    Raises
    ------
    MultiposError
        A process that still runs holds it, or it cannot be made.
    """
    said = []
    owner = _owner(lock)
    if owner is not None:
        said.append(f"process {owner} has ended without its session; {lock} is taken over")
        lock.unlink(missing_ok=True)
    with writing(lock), lock.open("x", encoding="ascii") as stream:
        stream.write(f"{os.getpid()}\n")
    try:
        yield said
    finally:
        lock.unlink(missing_ok=True)


def _owner(lock: Path) -> int | None:
    """Return the process that left a lock; None where there is none.

    Raises
    ------
    MultiposError
        It still runs.
    """
    try:
        text = lock.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return None
    owner = int(text) if text.isdecimal() and len(text) < _DIGITS else 0
    try:
        if owner:
            os.kill(owner, 0)
    except ProcessLookupError:
        return owner
    except OSError:  # somebody else's
        pass
    if not owner:
        return owner
    raise MultiposError(
        f"{lock}: process {owner} keeps a session there; end it, or give another -o."
    )


def _kept(session: Path, log: Path | None, said: list[str], *, resume: bool) -> Kept:
    """Return what is kept where the lock is held."""
    kept = Kept(log=log, session=session, said=said)
    if resume:
        kept.earlier = _read(session)
        kept.before = log
    if log is not None:
        kept.said += _make_way(log, resume=resume)
        kept.said.append(f"rows are written to {log} as they come")
    return kept


def _make_way(log: Path, *, resume: bool) -> list[str]:
    """Move the rows of an earlier session aside, unless it goes on; return what to say of it."""
    if resume:
        if not log.exists():
            raise MultiposError(f"{log}: no such file; the session cannot go on without its rows.")
        return _end_with_a_row(log)
    if not log.exists() or not log.stat().st_size:
        return []
    names = (log.with_name(f"{log.stem}.old{i}.csv") for i in count(1))
    old = next(path for path in names if not path.exists())
    log.rename(old)
    return [f"the rows of an earlier session are now {old}"]


def _end_with_a_row(log: Path) -> list[str]:
    """Leave out what was not written to its end; return what to say of it."""
    with log.open("r+b") as stream:
        start = max(stream.seek(0, os.SEEK_END) - _LAST, 0)
        stream.seek(start)
        last = stream.read()
        cut = last[last.rfind(b"\n") + 1 :]
        if not cut:
            return []
        stream.truncate(start + len(last) - len(cut))
    return [f"the last row of {log}, {cut.decode(errors='replace')!r}, is cut off and left out"]


def _read(path: Path) -> dict[str, Any]:
    found = read_json(path, _SCHEMA)
    threshold, taken_back = found.get("threshold"), found.get("taken_back")
    rate = found.get("rate_by_arrival")
    numbers = all(each is None or isinstance(each, int | float) for each in (threshold, rate))
    if not numbers or not isinstance(taken_back, dict):
        raise MultiposError(
            f"{path}: 'threshold', 'rate_by_arrival' or 'taken_back' is of another kind; begin a "
            "new session."
        )
    return {**found, "taken_back": {str(k): str(v) for k, v in taken_back.items()}}


class RawLog:
    """A log that is written row by row."""

    def __init__(self, path: StrPath, *, going_on: bool) -> None:
        self._path = path
        self._going_on = going_on
        self._delimiter = ","
        with writing(path):
            self._stream: IO[str] = Path(path).open(  # noqa: SIM115
                "a" if going_on else "w", encoding="utf-8", newline="", errors="backslashreplace"
            )

    def begin(self, log: Log) -> None:
        """Write the header, where the columns have names."""
        self._delimiter = log.delimiter
        if self._going_on or log.headless:
            return
        text = io.StringIO()
        csv.writer(text, delimiter=log.delimiter or ",", lineterminator="\n").writerow(log.header)
        self._write(text.getvalue())

    def write(self, lines: list[str], good: list[bool]) -> None:
        """Write rows, those that are not good as comments."""
        if not lines:
            return
        kept = [
            self._row(line) if fine else f"# {line.encode('unicode_escape').decode()}"
            for line, fine in zip(lines, good, strict=True)
        ]
        self._write("\n".join(kept) + "\n")

    def _row(self, line: str) -> str:
        return line if self._delimiter else ",".join(line.split())

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError as error:
            raise MultiposError(
                f"{self._path}: cannot write: {error.strerror or error}; check the disk."
            ) from None

    def close(self) -> None:
        """Close the log."""
        self._stream.close()


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
        if self.problem is None:
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
        Is given each pose as it is taken or refused, a line of ``--headless`` as a mapping.
    **options
        How the rows are read: as for `multipos.average`. What is fitted, and how: as for
        `multipos.fit`.

    Returns
    -------
    Captured

    Raises
    ------
    MultiposError
        The source cannot be read, or nothing in it is like a rest.
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
    tell = None if told is None else lambda session: told(line_of(session))
    session = Session(plan, reading, tell)
    run_session(session, opened, columns, Kept(log=None if log is None else Path(log)))
    return captured(session)


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
    if kept.before is not None:
        earlier = open_source(f"replay:{kept.before}:0")
        _feed(session, earlier, None, None, kept, going_on=True)
    going_on = kept.before is not None
    log = nullcontext(None) if kept.log is None else closing(RawLog(kept.log, going_on=going_on))
    with log as raw:
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

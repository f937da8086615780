"""What of a session is kept in files, so that nothing is lost and it can go on.

`files_kept` names them and `keep` opens them: beside READINGS.csv stand READINGS_log.csv, the rows
of a source that is no log, written as they come (`RawLog`), and READINGS_session.json, the
source, the threshold and rate that were fixed, and what the user took back (`Kept`). With these and
the log the same poses are found again. READINGS_session.lock has the number of the process that
writes them, while it does. Of a source that gives no row nothing is kept.

Rows without numbers are kept as comments: read again, the log has the rows that the session had.
"""

import csv
import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import IO, Any

from multipos.capturing.arrivals import RowSource
from multipos.capturing.live_rows import RowOptions
from multipos.capturing.session import Session
from multipos.errors import MultiposError, UsageError
from multipos.files.trees import read_json, to_json
from multipos.files.whole import write_text, writing
from multipos.logs.table import Log

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
    opened : str
        The source that they come from.
    before : path or None
        The log that the session goes on from.
    session : path or None
        Where decisions go.
    earlier : mapping
        What the session file held.
    say : callable
        Is given what the user is to know.
    """

    log: Path | None = None
    opened: str = ""
    before: Path | None = None
    session: Path | None = None
    earlier: Mapping[str, Any] = field(default_factory=dict)
    say: Callable[[str], object] = lambda text: None
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
                "opened": self.opened,
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
def keep(
    source: RowSource, readings: Path | None, say: Callable[[str], object], *, resume: bool
) -> Iterator[Kept]:
    """Yield what is kept, beside the readings; earlier rows are never written over.

    Raises
    ------
    UsageError, MultiposError
        There is no session to go on with, or one of another source; another process keeps one
        there.
    """
    if readings is None and not source.untimed:
        if resume:
            raise UsageError("--resume goes on with the session of -o READINGS.csv; name it.")
        yield Kept()
        return
    session, lock, *logs = files_kept(source, readings or _DEFAULT)
    log = logs[0] if logs else None
    with _locked(lock, say):
        kept = Kept(log=log, opened=source.opened, session=session, say=say)
        if resume:
            kept.earlier = _read(session)
            _require_same(session, kept)
            kept.before = log
        yield kept


def _require_same(session: Path, kept: Kept) -> None:
    """Refuse to go on with rows of another source: its poses are of another sensor."""
    before = kept.earlier.get("opened", kept.opened)  # not of version 0.2
    if before != kept.opened:
        raise UsageError(
            f"{session} is of {before}, but SOURCE is {kept.opened}; give the same source, or "
            "another -o."
        )
    if kept.log is not None and not kept.log.exists():
        raise MultiposError(f"{kept.log}: no such file; the session cannot go on without its rows.")


@contextmanager
def _locked(lock: Path, say: Callable[[str], object]) -> Iterator[None]:
    """Hold a lock, by the number of this process; say of an older one that it is taken over.

    Raises
    ------
    MultiposError
        A process that still runs holds it, or it cannot be made.
    """
    owner = _owner(lock)
    if owner is not None:
        say(f"process {owner} has ended without its session; {lock} is taken over")
        lock.unlink(missing_ok=True)
    with writing(lock), lock.open("x", encoding="ascii") as stream:
        stream.write(f"{os.getpid()}\n")
    try:
        yield
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


def _make_way(log: Path, say: Callable[[str], object]) -> None:
    """Move the rows of an earlier session aside, and say so."""
    if not log.exists() or not log.stat().st_size:
        return
    names = (log.with_name(f"{log.stem}.old{i}.csv") for i in count(1))
    old = next(path for path in names if not path.exists())
    log.rename(old)
    say(f"the rows of an earlier session are now {old}")


def _end_with_a_row(log: Path, say: Callable[[str], object]) -> None:
    """Leave out what was not written to its end, and say so."""
    with log.open("r+b") as stream:
        start = max(stream.seek(0, os.SEEK_END) - _LAST, 0)
        stream.seek(start)
        last = stream.read()
        cut = last[last.rfind(b"\n") + 1 :]
        if cut:
            stream.truncate(start + len(last) - len(cut))
            said = cut.decode(errors="replace")
            say(f"the last row of {log}, {said!r}, is cut off and left out")


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
    """A log that is written row by row, from the first row on."""

    def __init__(self, kept: Kept) -> None:
        self._path = kept.log
        self._going_on = kept.before is not None
        self._say = kept.say
        self._delimiter = ","
        self._stream: IO[str] | None = None
        if self._going_on and self._path is not None:
            _end_with_a_row(self._path, kept.say)

    def begin(self, log: Log) -> None:
        """Open it, and write the header where the columns have names."""
        if self._path is None:
            return
        self._delimiter = log.delimiter
        if not self._going_on:
            _make_way(self._path, self._say)
        with writing(self._path):
            self._stream = self._path.open(
                "a" if self._going_on else "w",
                encoding="utf-8",
                newline="",
                errors="backslashreplace",
            )
        self._say(f"rows are written to {self._path} as they come")
        if self._going_on or log.headless:
            return
        text = io.StringIO()
        csv.writer(text, delimiter=log.delimiter or ",", lineterminator="\n").writerow(log.header)
        self._write(text.getvalue())

    def write(self, lines: list[str], good: list[bool]) -> None:
        """Write rows, those that are not good as comments."""
        if not lines or self._stream is None:
            return
        kept = [
            self._row(line) if fine else f"# {line.encode('unicode_escape').decode()}"
            for line, fine in zip(lines, good, strict=True)
        ]
        self._write("\n".join(kept) + "\n")

    def _row(self, line: str) -> str:
        return line if self._delimiter else ",".join(line.split())

    def _write(self, text: str) -> None:
        assert self._stream is not None
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError as error:
            raise MultiposError(
                f"{self._path}: cannot write: {error.strerror or error}; check the disk."
            ) from None

    def close(self) -> None:
        """Close the log."""
        if self._stream is not None:
            self._stream.close()

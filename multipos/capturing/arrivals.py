"""From bytes to rows: lines, what the first tell of the columns, and the numbers of the rest.

A `RowSource` is an iterator of arrivals; `bytes_source` makes one of bytes. The first arrival says
what the columns are; then rows come as they are there, and an empty arrival some twenty times a
second, so that whoever waits is never stuck. The first lines show what the columns are, as in a log
(`multipos.files.layout`), and at which rate they come where nothing else tells it. A line that is
cut off by an unplugged cable is no row.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.capturing.read_ahead import Chunks, read_ahead
from multipos.errors import MultiposError, UsageError
from multipos.files.csv_columns import unix_lines
from multipos.files.spelling import Names, split_names
from multipos.logs.clock import time_columns
from multipos.logs.table import Log
from multipos.logs.text_logs import LiveText, open_lines
from multipos.numerics.arrays import Array

ASSUMED_RATE = 100.0  # [Hz] of a replay where nothing tells the time
_HEAD_LINES = 40  # that show what a row is
_MOST_LINES = 2000  # of what is no table, before it begins
_COUNTED = 3.0  # [s] in which arriving rows are counted for their rate
_LONGEST_LINE = 1 << 16


class Arrival(NamedTuple):
    """What a source gives at a time.

    Attributes
    ----------
    log : Log or None
        In the first arrival: the columns; `columns` are then rows that show what they hold, and
        come again.
    columns : (k, n) array
        The numeric columns of the log.
    lines : list of str
        The rows as they came, where they were text.
    connected : bool
    """

    log: Log | None
    columns: Array
    lines: list[str]
    connected: bool = True


@dataclass
class RowSource:
    """Where rows come from.

    Attributes
    ----------
    name : str
    opened : str
        The kind, and the device, address or file: the same for the same source.
    path : path or None
        The log that has the rows already.
    rate : float [Hz]
        By which a replay is paced; set when it is known.
    untimed : bool
        Whether the rate is that at which rows arrive, where nothing else tells it.
    arrivals : callable
        Return the arrivals, given the names of the columns or None.
    """

    name: str
    opened: str
    path: Path | None
    arrivals: Callable[[Names | None], Iterator[Arrival]] = field(repr=False)
    rate: float = ASSUMED_RATE
    untimed: bool = False


def bytes_source(
    name: str,
    opened: str,
    chunks: Callable[[], Chunks],
    path: Path | None = None,
    *,
    untimed: bool = False,
) -> RowSource:
    """Return a source of lines, given what opens it."""

    def arrivals(columns: Names | None) -> Iterator[Arrival]:
        return _rows_of(source, chunks(), columns)

    source = RowSource(name, opened, path, arrivals, untimed=untimed)
    return source


def _rows_of(source: RowSource, chunks: Chunks, columns: Names | None) -> Iterator[Arrival]:
    """Yield arrivals from bytes; an empty one where nothing has come."""
    given = None if columns is None else split_names(columns, "--columns")
    head = _Head(source, given)
    left = b""
    connected = True
    with contextlib.closing(read_ahead(chunks)) as taken:
        for chunk in taken:
            if chunk != b"":
                connected = chunk is not None
            content, left = _whole_lines(left, chunk)
            if content and head.text is not None:
                yield Arrival(None, *head.text.rows(content), connected)
            elif content and head.take(content):
                yield from head.arrivals()
            else:
                yield Arrival(None, np.empty((0, 0)), [], connected)
    last = left.decode("utf-8", "replace")
    if head.text is None:
        head.end(last)
        yield from head.arrivals()
    elif last:
        yield Arrival(None, *head.text.rows(last), connected)


class _Head:
    """The first lines, until they tell what a row is, and how many come in a second."""

    def __init__(self, source: RowSource, given: tuple[str, ...] | None) -> None:
        self._source, self._given = source, given
        self._lines: list[str] = []
        self._begun: tuple[float, int] | None = None  # when counting began, and at which line
        self._rate: float | None = None
        self.text: LiveText | None = None

    def take(self, content: str) -> bool:
        """Take up lines; tell whether they are enough."""
        self._lines += content.splitlines()
        if len(self._lines) < _HEAD_LINES:
            return False
        try:
            text = open_lines(self._source.name, self._lines, self._given)
        except UsageError:
            raise
        except MultiposError:
            if len(self._lines) >= _MOST_LINES:
                raise MultiposError(
                    f"{self._source.name}: {len(self._lines)} lines came, and no rows of numbers "
                    "among them; check what sends them, and the baud rate of a serial port."
                ) from None
            return False  # what a device says when it starts; its rows may still come
        untimed = self._source.untimed and text.log.rate is None and not time_columns(text.log)
        if untimed and not self._is_counted():
            return False
        self.text = text
        return True

    def _is_counted(self) -> bool:
        """Tell whether lines have come for long enough to tell the rate."""
        now = time.monotonic()
        if self._begun is None:  # what had been waiting before says nothing of the rate
            self._begun = now, len(self._lines)
        elapsed = now - self._begun[0]
        if elapsed < _COUNTED:
            return False
        self._rate = (len(self._lines) - self._begun[1]) / elapsed or None
        return True

    def end(self, last: str) -> None:
        """Take the lines that came for all there are."""
        self._lines += last.splitlines()
        if not any(line.strip() for line in self._lines):
            raise MultiposError(f"{self._source.name}: nothing came; a session needs samples.")
        self.text = open_lines(self._source.name, self._lines, self._given)

    def arrivals(self) -> Iterator[Arrival]:
        """Yield the log, and the rows among the first lines."""
        assert self.text is not None
        columns, lines = self.text.rows(self.text.head)
        log = self.text.log
        yield Arrival(log if self._rate is None else replace(log, rate=self._rate), columns, [])
        yield Arrival(None, columns, lines)


def _whole_lines(left: bytes, chunk: bytes | None) -> tuple[str, bytes]:
    """Return the lines that are whole, and what is left of the last one."""
    if chunk is None:
        return "", b""
    block = left + chunk
    end = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1
    whole, left = block[:end], block[end:]
    left = left[:_LONGEST_LINE]  # of a longer line the middle goes, and it is a bad row
    text = unix_lines(whole).decode("utf-8", "replace")
    return text.lstrip("\ufeff"), left

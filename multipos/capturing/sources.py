"""Where rows come from: a serial port, UDP, stdin, a log that grows, or a log replayed.

Each source is an iterator of arrivals. The first says what the columns are, by the first lines as
in a log (`multipos.logs.layout`); then rows come as they are there, and an empty arrival at least
forty times a second, so that whoever waits is never stuck. Bytes become lines and lines
rows here; a line that is cut off by an unplugged cable is no row.
"""

import contextlib
import math
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.lists import Names, split_names
from multipos.logs.clock import time_columns
from multipos.logs.opening import open_log
from multipos.logs.table import Log
from multipos.logs.text import LiveText, open_lines
from multipos.numerics.arrays import Array

TICK = 0.025  # [s]
_MOMENT = 0.02  # [s]
_HEAD_LINES = 40  # that show what a row is
_MOST_LINES = 2000  # of what is no table, before it begins
_COUNTED = 3.0  # [s] in which arriving rows are counted for their rate
_LONGEST_LINE = 1 << 16
_HEAD_ROWS = 4096  # of a replayed log
_AT_ONCE = 2048  # rows of a replay as fast as it goes
_ASSUMED_RATE = 100.0  # [Hz] of a replay where nothing tells the time
_RETRY = 0.5  # [s] until a lost port is tried again
_BAUD = 115200


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
    is_log : bool
        Whether the rows are in a file already.
    path : path or None
        That file.
    rate : float [Hz]
        By which a replay is paced; set when it is known.
    untimed : bool
        Whether the rate is that at which rows arrive, where nothing else tells it.
    arrivals : callable
        Return the arrivals, given the names of the columns or None.
    """

    name: str
    is_log: bool
    path: Path | None
    arrivals: Callable[[Names | None], Iterator[Arrival]] = field(repr=False)
    rate: float = _ASSUMED_RATE
    untimed: bool = False


def open_source(text: str) -> RowSource:
    """Return the source that a text names; nothing is opened yet.

    Raises
    ------
    UsageError
        The text names none.
    """
    kind, _, rest = text.partition(":")
    if text == "-":
        return _bytes_source("stdin", _stdin)
    if kind == "serial":
        return _serial_source(rest)
    if kind == "udp":
        return _udp_source(rest)
    if kind == "replay":
        return _replay_source(rest)
    if not text:
        raise UsageError("SOURCE is empty; see 'multipos capture --help'.")
    path = Path(text)
    source = _bytes_source(text, lambda: _growing(path))
    source.is_log, source.path = True, path
    return source


def _bytes_source(name: str, chunks: Callable[[], Iterator[bytes | None]]) -> RowSource:
    source = RowSource(name, False, None, lambda columns: _rows_of(source, chunks(), columns))
    return source


def _rows_of(
    source: RowSource, chunks: Iterator[bytes | None], columns: Names | None
) -> Iterator[Arrival]:
    """Yield arrivals from bytes; None among them says that the connection is lost."""
    given = None if columns is None else split_names(columns, "--columns")
    head = _Head(source, given)
    left = b""
    connected = True
    with contextlib.closing(chunks):  # type: ignore[type-var]
        for chunk in _together(chunks):
            connected = chunk is not None
            content, left = _whole_lines(left, chunk)
            if head.text is not None:
                yield Arrival(None, *head.text.rows(content), connected)
            elif head.take(content):
                yield from head.arrivals()
            else:
                yield Arrival(None, np.empty((0, 0)), [], connected)
    last = left.decode("utf-8", "replace")
    if head.text is None:
        head.end(last)
        yield from head.arrivals()
    elif last:
        yield Arrival(None, *head.text.rows(last), connected)


def _together(chunks: Iterator[bytes | None]) -> Iterator[bytes | None]:
    """Yield what comes within a moment at once: row by row would cost ten times as much."""
    gathered, since = b"", time.monotonic()
    for chunk in chunks:
        now = time.monotonic()
        if chunk:
            gathered += chunk
            if now - since < _MOMENT:
                continue
        if gathered or chunk is not None:
            yield gathered
        if chunk is None:
            yield None
        gathered, since = b"", now
    if gathered:
        yield gathered


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
                raise
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
    if len(left) > _LONGEST_LINE:
        left = b""
    text = whole.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    return text.removeprefix("\ufeff"), left


def _stdin() -> Iterator[bytes | None]:
    if sys.stdin is None:
        raise MultiposError("stdin is closed; give a log, or replay:LOG.")
    number = sys.stdin.fileno()
    chunks: queue.Queue[bytes] = queue.Queue(64)

    def read() -> None:
        while chunk := os.read(number, 1 << 16):
            chunks.put(chunk)
        chunks.put(b"")

    threading.Thread(target=read, daemon=True).start()  # select knows no pipes on Windows
    while True:
        try:
            chunk = chunks.get(timeout=TICK)
        except queue.Empty:
            yield b""
            continue
        if not chunk:
            return
        yield chunk


def _growing(path: Path) -> Iterator[bytes | None]:
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        raise MultiposError(f"{path}: no such file; check the path of the log.") from None
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot read the log: {error.strerror or error}; check its permissions."
        ) from None
    with stream:
        while True:
            chunk = stream.read(1 << 20)
            if not chunk and os.fstat(stream.fileno()).st_size < stream.tell():
                stream.seek(0)  # it was begun anew
                yield None
            if not chunk:
                time.sleep(TICK)
            yield chunk


def _udp_source(rest: str) -> RowSource:
    address, _, port = rest.rpartition(":")
    if not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise UsageError(f"'udp:{rest}' names no port; give udp:PORT, or udp:ADDRESS:PORT.")
    source = _bytes_source(f"udp:{rest}", lambda: _udp(address or "127.0.0.1", int(port)))
    source.untimed = True
    return source


def _udp(address: str, port: int) -> Iterator[bytes | None]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind((address, port))
        except OSError as error:
            raise MultiposError(
                f"udp:{address}:{port}: cannot listen: {error.strerror or error}; "
                "choose another port."
            ) from None
        receiver.settimeout(TICK)
        while True:
            try:
                datagram = receiver.recv(1 << 16)
            except TimeoutError:
                yield b""
            else:
                yield datagram if datagram.endswith((b"\n", b"\r")) else datagram + b"\n"


def _serial_source(rest: str) -> RowSource:
    device, _, baud = rest.rpartition(":")
    if not (device and baud.isdigit()):
        device, baud = rest, str(_BAUD)
    if not device:
        raise UsageError("'serial:' names no port; give serial:/dev/ttyUSB0:115200.")
    source = _bytes_source(f"serial:{rest}", lambda: _serial(device, int(baud)))
    source.untimed = True
    return source


def _serial(device: str, baud: int) -> Iterator[bytes | None]:
    """Yield what comes from a port; None where it is lost, until it can be opened again."""
    try:
        import serial
    except ImportError:
        raise MultiposError("a serial port needs pyserial: pip install 'multipos[live]'.") from None
    port: Any = None
    opened = False
    while True:
        try:
            if port is None:
                port = serial.Serial(device, baud, timeout=TICK)
                opened = True
            yield port.read(max(1, port.in_waiting))
        except (OSError, serial.SerialException) as error:
            if not opened:
                raise MultiposError(
                    f"{device}: cannot open the port: {error}; check the cable, the name and "
                    "who may use it."
                ) from None
            if port is not None:
                port.close()
                port = None
            yield None
            time.sleep(_RETRY)


def _replay_source(rest: str) -> RowSource:
    path, _, last = rest.rpartition(":")
    speed = _number(last)
    if not path or speed is None:
        path, speed = rest, 1.0
    if not path or not 0.0 <= speed < math.inf:
        raise UsageError(
            f"'replay:{rest}': give replay:LOG, or replay:LOG:SPEED with SPEED 0 (as fast as it "
            "goes) or more."
        )
    source = RowSource(path, True, Path(path), lambda columns: _replay(source, columns, speed))
    return source


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _replay(source: RowSource, columns: Names | None, speed: float) -> Iterator[Arrival]:
    assert source.path is not None
    log = open_log(source.path, columns=columns)
    if not log.numeric:
        raise MultiposError(f"{log.source}: no column of numbers; a log needs samples.")
    begun, sent, opened = time.monotonic(), 0, False
    for piece in log.read((), log.numeric, (), lenient=True):
        table = np.array([piece.table.columns[name] for name in log.numeric], dtype=np.float64)
        if not opened:
            yield Arrival(log, table[:, :_HEAD_ROWS], [])
            opened = True
        at_once = _AT_ONCE if not speed else max(1, round(source.rate * speed * TICK))
        for start in range(0, table.shape[1], at_once):
            part = table[:, start : start + at_once]
            while speed and (ahead := begun + sent / (source.rate * speed) - time.monotonic()) > 0:
                time.sleep(min(ahead, TICK))
                yield Arrival(None, part[:, :0], [])
            yield Arrival(None, part, [])
            sent += part.shape[1]
    if not opened:
        raise MultiposError(f"{log.source}: no rows; a log needs samples.")

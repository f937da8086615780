"""Where rows come from: a serial port, UDP, stdin, a log that grows, or a log replayed.

Each source is an iterator of arrivals. The first says what the columns are; then rows come as they
are there, and an empty arrival some twenty times a second, so that whoever waits is never stuck.
What gives bytes is read by a thread of its own (`multipos.capturing.streams`); None among them says
that the connection is lost.

Bytes taken as they come, by a thread of its own, so that none is lost while a fit goes on.

A serial port holds a tenth of a second of a fast sensor, a socket a quarter. What has come is
handed on twenty times a second, as often as a page can show it: what that costs is by the
occasion and hardly by the row, so that row by row would cost twenty times as much.

Bytes of a serial port, which may be unplugged and plugged in again, from the first whole row on.

A port is opened in the middle of a row more often than not. What is left of that row can look like
a whole one, "12.5,…" as "5,…", and its time then runs ahead of all others; so the first line counts
only where there is more in it than numbers: a header, or what a device says when it starts.

From bytes to rows: lines, what the first tell of the columns, and the numbers of the rest.

The first lines say what the columns are, as in a log (`multipos.logs.layout`), and at which rate
they come where nothing else tells it. A line that is cut off by an unplugged cable is no row.
"""

import contextlib
import math
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.csv_columns import unix_lines
from multipos.files.spelling import Names, split_names
from multipos.files.whole import reading
from multipos.logs.clock import time_columns
from multipos.logs.opening import open_log
from multipos.logs.table import Log
from multipos.logs.text_logs import LiveText, open_lines
from multipos.numerics.arrays import Array

Chunks = Generator[bytes | None, None, None]  # as they come; None: the connection is lost

MOMENT = 0.05  # [s]
_MOST = 1 << 20  # bytes that wait; they are handed on then, and a pipe waits
_PATIENCE = 0.1  # [s] for the thread to end


def read_ahead(chunks: Chunks) -> Chunks:
    """Yield what has come since the last time, b"" where nothing has; None where it was lost.

    Parameters
    ----------
    chunks : generator of bytes or None
        Is closed in the end. It gives something several times a second, if only b"", unless it
        cannot be made to end.
    """
    reader = _Reader(chunks)
    reader.start()
    try:
        while True:
            waiting, ended = reader.take()
            for lost, together in groupby(waiting, key=lambda chunk: chunk is None):
                yield None if lost else b"".join(filter(None, together))
            if ended:
                return
            if not waiting:
                yield b""
    finally:
        reader.stop()


class _Reader(threading.Thread):
    """Reads, and waits where nobody takes it."""

    def __init__(self, chunks: Chunks) -> None:
        super().__init__(daemon=True)  # stdin cannot be made to end
        self._chunks = chunks
        self._changed = threading.Condition()
        self._waiting: list[bytes | None] = []
        self._size = 0
        self._ended = self._stopped = False
        self._error: Exception | None = None

    def run(self) -> None:
        try:
            with closing(self._chunks):
                for chunk in self._chunks:
                    if not self._add(chunk):
                        break
        except Exception as error:  # raised again where the bytes are taken
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _add(self, chunk: bytes | None) -> bool:
        """Keep a chunk until it is taken; tell whether to go on."""
        with self._changed:
            if chunk != b"":
                self._waiting.append(chunk)
                self._size += len(chunk or b"")
            if self._is_full():
                self._changed.notify_all()
                self._changed.wait_for(lambda: not self._is_full() or self._stopped)
            return not self._stopped

    def _is_full(self) -> bool:
        return self._size >= _MOST

    def take(self) -> tuple[list[bytes | None], bool]:
        """Return what comes within a moment, and whether that is all.

        Raises
        ------
        Exception
            That of the source, once all that came before it has been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_full() or self._ended, timeout=MOMENT)
            ended = self._ended
            waiting, self._waiting, self._size = self._waiting, [], 0
            self._changed.notify_all()
        if ended and not waiting and self._error is not None:
            raise self._error
        return waiting, ended and self._error is None

    def stop(self) -> None:
        """End the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self.join(_PATIENCE)


_BAUD = 115200
_MOST_BAUD = (1 << 31) - 1
_WAITED = 0.025  # [s] for the first byte
_GATHERED = 0.02  # [s] of bytes that are taken at once
_RETRY = 0.5  # [s] until a lost port is tried again
_LONGEST = 1 << 16  # bytes in which a line must have ended
_LINE_END = re.compile(rb"[\r\n]")
_NUMBERS = re.compile(rb"[-+\d.eE,;:|\s]*")


def split_port(text: str) -> tuple[str, int]:
    """Return the device and the baud rate of ``DEVICE:BAUD``, where the rate may lack.

    Raises
    ------
    UsageError
        There is no device, or no such rate.
    """
    device, _, baud = text.rpartition(":")
    if not (device and baud.isdecimal()):
        device, baud = text, str(_BAUD)
    if not device:
        raise UsageError("'serial:' names no port; give serial:/dev/ttyUSB0:115200.")
    if not 0 < int(baud) <= _MOST_BAUD:
        raise UsageError(f"'serial:{text}': no port runs at {baud} baud; give its rate, as 115200.")
    return device, int(baud)


def read_port(device: str, baud: int) -> Chunks:
    """Yield what comes from a port; None where it is lost, until it can be opened again.

    Raises
    ------
    MultiposError
        It cannot be opened at first, or there is no pyserial.
    """
    begun: bytes | None = b""  # of the first line; None once it has ended
    for chunk in _bytes_of(device, baud):
        if not chunk:
            begun = b"" if chunk is None else begun
            yield chunk
        elif begun is None:
            yield chunk
        else:
            begun += chunk
            end = _LINE_END.search(begun)
            if end is None and len(begun) < _LONGEST:
                yield b""
                continue
            first = begun if end is None else begun[: end.start()]
            yield begun[len(first) :] if _NUMBERS.fullmatch(first) else begun
            begun = None


def _bytes_of(device: str, baud: int) -> Chunks:
    try:
        import serial
    except ImportError:
        raise MultiposError("a serial port needs pyserial: pip install 'multipos[live]'.") from None
    port: Any = None
    opened = False
    while True:
        try:
            if port is None:
                port = serial.Serial(device, baud, timeout=_WAITED)
                opened = True
            chunk = port.read(max(1, port.in_waiting))
        except Exception as error:  # of the system, of its terminals, of the rate
            if not opened:
                raise MultiposError(
                    f"{device}: cannot open the port: {error}; check the cable, the name, the "
                    "rate, and who may use it."
                ) from None
            if port is not None:
                port.close()
                port = None
            yield None
            time.sleep(_RETRY)
            continue
        yield chunk
        if chunk:
            time.sleep(_GATHERED)  # byte by byte would cost ten times as much


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
    path: Path | None
    arrivals: Callable[[Names | None], Iterator[Arrival]] = field(repr=False)
    rate: float = ASSUMED_RATE
    untimed: bool = False


def bytes_source(
    name: str, chunks: Callable[[], Chunks], path: Path | None = None, *, untimed: bool = False
) -> RowSource:
    """Return a source of lines, given what opens it."""

    def arrivals(columns: Names | None) -> Iterator[Arrival]:
        return _rows_of(source, chunks(), columns)

    source = RowSource(name, path, arrivals, untimed=untimed)
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
    return text.removeprefix("\ufeff"), left


_TICK = 0.025  # [s] from one look at a log that grows to the next
_CHUNK = 1 << 16  # bytes
_BUFFER = 1 << 20  # bytes that the system is asked to hold of datagrams
_HEAD_ROWS = 4096  # of a replayed log
_AT_ONCE = 2048  # rows of a replay as fast as it goes


def open_source(text: str) -> RowSource:
    """Return the source that a text names; nothing is opened yet.

    Raises
    ------
    UsageError
        The text names none.
    """
    kind, _, rest = text.partition(":")
    if text == "-":
        return bytes_source("stdin", _stdin)
    if kind == "serial":
        return _serial_source(rest)
    if kind == "udp":
        return _udp_source(rest)
    if kind == "replay":
        return _replay_source(rest)
    if not text:
        raise UsageError("SOURCE is empty; see 'multipos capture --help'.")
    path = Path(text)
    return bytes_source(text, lambda: _growing(path), path)


def _stdin() -> Chunks:
    if sys.stdin is None:
        raise MultiposError("stdin is closed; give a log, or replay:LOG.")
    number = sys.stdin.fileno()
    while chunk := os.read(number, _CHUNK):
        yield chunk


def _growing(path: Path) -> Chunks:
    with reading(path, "log"):
        stream = path.open("rb")
    with stream:
        while True:
            chunk = stream.read(_CHUNK)
            if not chunk and os.fstat(stream.fileno()).st_size < stream.tell():
                stream.seek(0)  # it was begun anew
                yield None
            if not chunk:
                time.sleep(_TICK)
            yield chunk


def _udp_source(rest: str) -> RowSource:
    address, _, port = rest.rpartition(":")
    if not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise UsageError(f"'udp:{rest}' names no port; give udp:PORT, or udp:ADDRESS:PORT.")
    chunks = partial(_udp, address or "127.0.0.1", int(port))
    return bytes_source(f"udp:{rest}", chunks, untimed=True)


def _udp(address: str, port: int) -> Chunks:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind((address, port))
        except OSError as error:
            raise MultiposError(
                f"udp:{address}:{port}: cannot listen: {error.strerror or error}; "
                "choose another port."
            ) from None
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        receiver.setblocking(False)
        while True:
            time.sleep(_GATHERED)
            yield b"".join(_datagrams(receiver))


def _datagrams(receiver: socket.socket) -> Iterator[bytes]:
    """Yield the datagrams that are there, each as whole lines."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(_CHUNK >> 4):
            datagram = receiver.recv(_CHUNK)
            yield datagram if datagram.endswith((b"\n", b"\r")) else datagram + b"\n"


def _serial_source(rest: str) -> RowSource:
    return bytes_source(f"serial:{rest}", partial(read_port, *split_port(rest)), untimed=True)


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
    source = RowSource(path, Path(path), lambda columns: _replay(source, columns, speed))
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
        wanted = source.rate * speed * MOMENT if speed else _AT_ONCE
        at_once = round(min(max(wanted, 1.0), _AT_ONCE))
        for start in range(0, table.shape[1], at_once):
            part = table[:, start : start + at_once]
            while speed and (ahead := begun + sent / (source.rate * speed) - time.monotonic()) > 0:
                time.sleep(min(ahead, MOMENT))
                yield Arrival(None, part[:, :0], [])
            yield Arrival(None, part, [])
            sent += part.shape[1]
    if not opened:
        raise MultiposError(f"{log.source}: no rows; a log needs samples.")

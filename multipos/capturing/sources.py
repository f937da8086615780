"""Where rows come from: a serial port, UDP, stdin, a log that grows, or a log replayed.

`open_source` reads the name of a source and makes a `RowSource` of it. What gives bytes is read by
a thread of its own (`multipos.capturing.read_ahead`); None among them says that the connection is
lost.
"""

import contextlib
import math
import os
import socket
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from multipos.capturing.arrivals import Arrival, RowSource, bytes_source
from multipos.capturing.read_ahead import MOMENT, Chunks
from multipos.capturing.serial_port import _GATHERED, read_port, split_port
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names
from multipos.files.whole import reading
from multipos.logs.opening import open_log

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
        return bytes_source("stdin", "-", _stdin)
    if kind == "serial":
        return _serial_source(rest)
    if kind == "udp":
        return _udp_source(rest)
    if kind == "replay":
        return _replay_source(rest)
    if not text:
        raise UsageError("SOURCE is empty; see 'multipos capture --help'.")
    path = Path(text)
    return bytes_source(text, str(path.resolve()), lambda: _growing(path), path)


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
    address = address or "127.0.0.1"
    chunks = partial(_udp, address, int(port))
    return bytes_source(f"udp:{rest}", f"udp:{address}:{int(port)}", chunks, untimed=True)


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
    device, baud = split_port(rest)
    chunks = partial(read_port, device, baud)
    return bytes_source(f"serial:{rest}", f"serial:{device}", chunks, untimed=True)


def _replay_source(rest: str) -> RowSource:
    path, _, last = rest.rpartition(":")
    try:
        speed = float(last)
    except ValueError:
        path = ""
    if not path:
        path, speed = rest, 1.0
    if not path or not 0.0 <= speed < math.inf:
        raise UsageError(
            f"'replay:{rest}': give replay:LOG, or replay:LOG:SPEED with SPEED 0 (as fast as it "
            "goes) or more."
        )
    opened = f"replay:{Path(path).resolve()}"
    source = RowSource(path, opened, Path(path), lambda columns: _replay(source, columns, speed))
    return source


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

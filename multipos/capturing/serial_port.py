"""Bytes of a serial port, which may be unplugged and plugged in again, from the first whole row on.

`split_port` reads the name of a port with its speed, `read_port` gives its bytes. A port is opened
in the middle of a row more often than not. What is left of that row can look like a whole one,
"12.5,…" as "5,…", and its time then runs ahead of all others; so the first line counts only where
there is more in it than numbers: a header, or what a device sends when it starts.
"""

import re
import time
from typing import Any

from multipos.capturing.read_ahead import Chunks
from multipos.errors import MultiposError, UsageError

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

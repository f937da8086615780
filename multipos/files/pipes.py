"""Paths that can be read as often as a file: pipes, what was packed, text in other encodings.

`rereadable` returns one of any path, of which `is_pipe`, `is_folder`, `is_file` and `is_there` tell
what it is; `unpack_text` returns one of text that is no UTF-8, as `decoded` finds it; `text_of` and
`lines_of` read UTF-8.

A pipe gives its bytes once, but a log is read in two passes, a calibration after a look at its
kind, and the data of a regression again for its figure. A `Pipe` and an `Unpacked` file are paths:
``str`` is the name for messages, ``os.fspath`` a temporary file with the bytes, which goes with the
object.

Windows and Excel write UTF-16, in China GB 18030, in western Europe Windows-1252. Bytes that are no
UTF-8 are GB 18030 where every Chinese character they would be has another beside it, as a letter
with an accent among plain ones would make single ones; else Windows-1252 where of its signs only
letters of German and French and those of units appear.
"""

import contextlib
import errno
import io
import os
import re
import stat
import sys
import weakref
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from multipos.errors import MultiposError
from multipos.files.spelling import StrPath

BOM = "\ufeff"
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_CHINESE = re.compile(r"[\u4e00-\u9fff]+")
_WESTERN = frozenset("äöüÄÖÜßéèêëàâçôûîïÉÈÀÇ°²³µ±·–")


def text_of(raw: bytes) -> str:
    """Return UTF-8 as text, without the marks of the byte order that it begins with."""
    return raw.decode().lstrip(BOM)


def lines_of(path: StrPath) -> Iterator[str]:
    """Yield the lines of a file without their ends, what is no UTF-8 in it replaced."""
    with Path(path).open(encoding="utf-8", errors="replace", newline=None) as stream:
        for number, line in enumerate(stream):
            yield line.rstrip("\n") if number else line.rstrip("\n").lstrip(BOM)


def decoded(raw: bytes) -> str | None:
    """Return the text that bytes are which are no UTF-8; None where that is unclear."""
    if raw.startswith(UTF_16):
        try:
            return raw.decode("utf-16")
        except UnicodeDecodeError:
            return None
    try:
        text = raw.decode("gb18030")
    except UnicodeDecodeError:
        text = ""
    runs = _CHINESE.findall(text)
    if runs and min(map(len, runs)) > 1:
        return text
    try:
        text = raw.decode("cp1252")
    except UnicodeDecodeError:
        return None
    strange = {letter for letter in text if letter > "\x7f"}
    return text if strange <= _WESTERN and "\0" not in text else None


def unpack_text(path: os.PathLike[str]) -> "Unpacked":
    """Return a text in another encoding as one in UTF-8.

    Raises
    ------
    MultiposError
        The encoding is unclear.
    """
    found = decoded(Path(path).read_bytes())
    if found is None:
        raise MultiposError(
            f"{path}: the text is not UTF-8, nor by its marks UTF-16, GB 18030 or Windows-1252; "
            "save it as UTF-8."
        )
    return Unpacked(str(path), io.BytesIO(found.encode()), Path(str(path)).suffix)


STDIN = "-"
_PIECE = 1 << 18  # bytes
_DEVICE, _MOST = 1 << 20, 1 << 32  # bytes of a device such as /dev/zero, and of all else
GZIP = b"\x1f\x8b"


class Pipe(os.PathLike[str]):
    """A pipe, or stdin, as a path that can be read more than once."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._kept: Unpacked | None = None

    def __str__(self) -> str:
        return "stdin" if self._source == STDIN else self._source

    def __fspath__(self) -> str:
        if self._kept is None:
            with _opened(self._source) as stream:
                device = False
                with contextlib.suppress(OSError):  # of a stream without a number
                    status = os.fstat(stream.fileno())
                    device = stat.S_ISCHR(status.st_mode) and not stream.isatty()
                most = _DEVICE if device else _MOST
                self._kept = Unpacked(str(self), stream, "", most)
        return os.fspath(self._kept)

    def close(self) -> None:
        """Let go of what was kept."""
        if self._kept is not None:
            self._kept.close()


def is_pipe(path: StrPath) -> bool:
    """Tell whether a path is there, and neither a file nor a folder: a pipe, a terminal, …."""
    mode = _mode(path)
    return mode is not None and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def is_folder(path: StrPath) -> bool:
    """Tell whether a path is a folder."""
    mode = _mode(path)
    return mode is not None and stat.S_ISDIR(mode)


def is_file(path: StrPath) -> bool:
    """Tell whether a path can be read: a file, or a pipe."""
    mode = _mode(path)
    return mode is not None and not stat.S_ISDIR(mode)


def is_there(path: StrPath) -> bool:
    """Tell whether a path is anything that can be looked at."""
    return _mode(path) is not None


def _mode(path: StrPath) -> int | None:
    try:
        return Path(path).stat().st_mode
    except (OSError, ValueError):  # too long, no name at all: refused where it is read
        return None


def rereadable(path: StrPath) -> os.PathLike[str]:
    """Return a path that can be read more than once: the path itself, of a pipe a `Pipe`."""
    if isinstance(path, Pipe | Unpacked):
        return path
    return Pipe(os.fspath(path)) if is_pipe(path) else Path(path)


def _opened(source: str) -> contextlib.AbstractContextManager[BinaryIO]:
    if source != STDIN:
        return Path(source).open("rb")
    if sys.stdin is None:
        raise OSError(errno.EBADF, "it is closed")
    return contextlib.nullcontext(sys.stdin.buffer)


def _remove(path: str) -> None:
    Path(path).unlink(missing_ok=True)


def _pieces(source: str, stream: Any, most: int) -> Iterator[bytes]:
    """Yield what comes, but for what has no end: a device, or more than can be."""
    left = most
    for piece in iter(partial(stream.read, _PIECE), b"") if hasattr(stream, "read") else stream:
        left -= len(piece)
        if left < 0:
            raise MultiposError(
                f"{source}: more than {most >> 20} MiB came, and no end; put what is wanted into a "
                "file."
            )
        yield piece


class Unpacked(os.PathLike[str]):
    """What was in a packed file, or came through a pipe, as a path."""

    def __init__(
        self, source: str, stream: Any, suffix: str, most: int = _MOST, said: str = ""
    ) -> None:
        import tempfile  # slow to import, and seldom needed

        self._source = source
        self.said = said  # of what was taken of it
        handle, path = tempfile.mkstemp(prefix="multipos-", suffix=suffix)
        self._kept = weakref.finalize(self, _remove, path)
        self._path = path
        try:
            with os.fdopen(handle, "wb") as kept:
                kept.writelines(_pieces(source, stream, most))
        except BaseException:
            self.close()
            raise

    def __str__(self) -> str:
        return self._source

    def __fspath__(self) -> str:
        if not self._kept.alive:
            raise OSError(errno.EPIPE, "the pipe has been read already")
        return self._path

    def close(self) -> None:
        """Let go of what was kept."""
        self._kept()

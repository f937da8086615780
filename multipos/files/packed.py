"""Compressed files, unpacked so that they can be read as any other.

An `Unpacked` file is a path: ``str`` is the name for messages, that of the packed file, and
``os.fspath`` a temporary file with what was in it, which goes with the object.
"""

import os
import shutil
import tempfile
import weakref
import zlib
from pathlib import Path
from typing import IO

from multipos.errors import MultiposError

GZIP = b"\x1f\x8b"


class Unpacked(os.PathLike[str]):
    """What was in a packed file, as a path."""

    def __init__(self, source: str, stream: IO[bytes], suffix: str) -> None:
        self._source = source
        handle, path = tempfile.mkstemp(prefix="multipos-", suffix=suffix)
        self._kept = weakref.finalize(self, _remove, path)
        self._path = path
        with os.fdopen(handle, "wb") as kept:
            shutil.copyfileobj(stream, kept)

    def __str__(self) -> str:
        return self._source

    def __fspath__(self) -> str:
        return self._path


def unpack_gzip(path: os.PathLike[str]) -> Unpacked:
    """Return a file that gzip has compressed, unpacked.

    Raises
    ------
    MultiposError
        The file is damaged or cut off.
    """
    import gzip

    suffix = Path(Path(str(path)).stem).suffix
    try:
        with gzip.open(os.fspath(path)) as stream:
            return Unpacked(str(path), stream, suffix)  # type: ignore[arg-type]
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise MultiposError(
            f"{path}: cannot unpack: {error}; the file is damaged or cut off, write it again."
        ) from None


def _remove(path: str) -> None:
    Path(path).unlink(missing_ok=True)

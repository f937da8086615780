"""Readers that come with an extra or may crash, each run in a process of its own.

`reader_with_extra` returns one that says what to install where its library is missing, `read_apart`
runs one, `answer` is what runs in the child, `first_line` says what an error does.

Some formats are read by compiled code that believes its file: a damaged one ends the whole process,
and with it a notebook or a server. `read_apart` runs such a reader in a child of the same
interpreter, which hands its arrays back as `.npy` through a temporary file, without pickle. Nothing
of the caller's program runs in the child, `__main__` neither; it costs a quarter of a second to
start, and one more for a hundred megabytes.
"""

import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.handed import broken, require_extra
from multipos.files.pipes import is_folder

_PATIENCE = 30.0  # seconds to start and to read a small file, on a slow machine
_SLOWEST = 1e6  # bytes per second below which a reader no longer reads but turns in circles

# Isolated from the folder and the environment, until the parent's own path is set. It ends without
# clearing up, because a library that has answered may still stumble over its own threads.
_CHILD = """
import json, os, sys
task = json.loads(sys.stdin.buffer.read())
sys.path[:] = task["path"]
from multipos.logs.extras import answer
answer(task["module"], task["reader"], task["file"])
os._exit(0)
"""


def read_apart(
    path: os.PathLike[str],
    reader: Callable[[os.PathLike[str]], Mapping[str, Any]],
    *,
    patience: float = _PATIENCE,
) -> dict[str, NDArray[Any]]:
    """Return the arrays that a reader finds in a file, read in a process of its own.

    Parameters
    ----------
    path : path
    reader : function
        Of a module, so that the child can import it. What is no array of plain cells is left out.
    patience : float [s]
        Beyond what the size of the file allows for.

    Raises
    ------
    MultiposError
        The reader refuses the file, crashes over it, or does not end.
    """
    import subprocess  # slow to import, and seldom needed
    import tempfile

    task = {
        "path": [str(place) for place in sys.path],
        "module": reader.__module__,
        "reader": reader.__qualname__,
        "file": os.fspath(path),
    }
    parts = Path(path).iterdir() if is_folder(path) else [Path(path)]
    limit = patience + sum(part.lstat().st_size for part in parts) / _SLOWEST
    with tempfile.TemporaryFile() as answers:
        try:
            done = subprocess.run(
                [sys.executable, "-I", "-c", _CHILD],
                input=json.dumps(task).encode(),
                stdout=answers,
                stderr=subprocess.PIPE,
                timeout=limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise MultiposError(
                f"{path}: the file is damaged: its reader did not end within {limit:.0f} s; "
                "write it again."
            ) from None
        except OSError as error:
            raise MultiposError(
                f"{path}: cannot start '{sys.executable}' to read the log: "
                f"{error.strerror or error}; convert the log to CSV."
            ) from None
        if done.returncode:
            raise MultiposError(f"{path}: {_why(done.returncode, done.stderr)}; write it again.")
        answers.seek(0)
        found = json.loads(answers.readline())
        if "broken" in found:
            name, said = found["broken"]
            raise broken(path, ImportError(said, name=name))
        if "refused" in found:
            raise MultiposError(f"{path}: cannot read the log: {found['refused']}; write it again.")
        return {name: np.load(answers, allow_pickle=False) for name in found["names"]}


def _why(status: int, stderr: bytes) -> str:
    """Return why a child ended otherwise than by an answer."""
    said = stderr.decode(errors="replace").strip().splitlines()
    if status == 1 and said:  # an exception: a disk that is full, say
        return f"cannot read the log: {said[-1]}"
    how = f"signal {-status}" if status < 0 else f"status {status:#x}"
    return f"the file is damaged: its reader crashed ({how})"


def answer(module: str, name: str, file: str) -> None:
    """Read a file and write what it holds to stdout: in the child."""
    reader = getattr(importlib.import_module(module), name)
    with os.fdopen(os.dup(1), "wb") as stream:
        os.dup2(2, 1)  # what libraries print is no part of the answer
        try:
            found = {key: np.asarray(value) for key, value in reader(Path(file)).items()}
        except ImportError as error:
            _write_head(stream, {"broken": [error.name, first_line(error)]})
            return
        except Exception as error:  # each format has exceptions of its own for a damaged file
            _write_head(stream, {"refused": first_line(error)})
            return
        arrays = {key: array for key, array in found.items() if not array.dtype.hasobject}
        _write_head(stream, {"names": list(arrays)})
        for array in arrays.values():
            np.save(stream, array, allow_pickle=False)


def _write_head(stream: IO[bytes], head: Mapping[str, Any]) -> None:
    stream.write(json.dumps(head).encode() + b"\n")


def first_line(error: Exception) -> str:
    """Return what an error says, in one line."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__


NOTES = "\0notes"  # the name of a column that is none: what there is to say of the others


def reader_with_extra(
    kind: str, library: str, extra: str, load: Callable[[os.PathLike[str]], Mapping[str, Any]]
) -> Callable[[os.PathLike[str]], Mapping[str, Any]]:
    """Return a reader that runs `load` in a process of its own, where its library is there."""

    def read(path: os.PathLike[str]) -> Mapping[str, Any]:
        require_extra(path, kind, library, extra)
        return read_apart(path, load)

    return read

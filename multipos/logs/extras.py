"""Formats whose readers come with an extra of the package, and what to say where it is missing.

Libraries that read binary files are in part compiled, and print what they like, so each runs in
a process of its own (`multipos.logs.isolation`).
"""

import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

from multipos.errors import MultiposError
from multipos.logs.isolation import read_apart

NOTES = "\0notes"  # the name of a column that is none: what there is to say of the others


class Noted(dict[str, Any]):
    """Columns, and what is to be said of how they were chosen."""

    notes: tuple[str, ...] = ()


def require_extra(path: os.PathLike[str], kind: str, library: str, extra: str) -> None:
    """Refuse a file whose library is not installed.

    Raises
    ------
    MultiposError
        Names the kind of the file and the extra.
    """
    if find_spec(library) is None:
        raise MultiposError(
            f"{path}: {kind}, which {library} reads; install it with "
            f"pip install 'multipos[{extra}]'."
        )


def reader_with_extra(
    kind: str, library: str, extra: str, load: Callable[[os.PathLike[str]], Mapping[str, Any]]
) -> Callable[[os.PathLike[str]], Mapping[str, Any]]:
    """Return a reader that runs `load` in a process of its own, where its library is there."""

    def read(path: os.PathLike[str]) -> Mapping[str, Any]:
        require_extra(path, kind, library, extra)
        found = Noted(read_apart(path, load))
        found.notes = tuple(str(note) for note in found.pop(NOTES, ()))
        return found

    return read

"""Which reader serves which log.

A log is a table of samples, one row a sample. Text comes with commas, semicolons (and decimal
commas), tabs or white space between the cells, with or without a header; without one the columns
are called 1, 2, 3, …. Which reader serves a file is decided by its first bytes and then by its
suffix (`READERS`); whatever is neither is text. Only what was asked for is turned into numbers,
in pieces of some megabytes, so that the length of a log does not matter; a `.npz` or `.mat` file
is the exception, because its format holds each array in one piece.
"""

import os
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.lists import Names, split_names
from multipos.files.packed import GZIP, unpack_gzip
from multipos.files.pipes import rereadable
from multipos.files.tables import Column, Source, read_table
from multipos.logs.arrays import log_of_columns
from multipos.logs.readers import READERS, Reader
from multipos.logs.table import Log
from multipos.logs.text import HEAD, open_text


def open_log(source: "Source | Log", *, columns: Names | None = None) -> Log:
    """Return a log from a file, a mapping of columns, or a data frame.

    Parameters
    ----------
    source : path, mapping of name to (n,) array, data frame, or Log
    columns : names, optional
        Names of the columns, instead of those the file gives.

    Returns
    -------
    Log

    Raises
    ------
    MultiposError
        The file is missing, empty, or of a kind that is not read.
    UsageError
        `columns` does not name each column once.
    """
    if isinstance(source, Log):
        return source
    names = None if columns is None else split_names(columns, "--columns")
    if not isinstance(source, str | os.PathLike):
        table = read_table(source, what="log")
        return log_of_columns(table.source, table.columns, names)
    path = rereadable(source)
    head = _read_head(path)
    if head.startswith(GZIP):
        path = unpack_gzip(path)
        head = _read_head(path)
    reader = _reader_of(path, head)
    if reader is None:
        return open_text(path, head, names)
    return log_of_columns(str(path), reader.columns(path), names)


def _reader_of(path: os.PathLike[str], head: bytes) -> Reader | None:
    """Return what reads a file, by its first bytes or else its suffix; None of a text."""
    by_content = [reader for reader in READERS if head.startswith(reader.magic)]
    suffix = Path(os.fspath(path)).suffix.lower()
    by_suffix = [reader for reader in READERS if suffix in reader.suffixes]
    return next(iter(by_content or (by_suffix if b"\0" in head else ())), None)


def read_log(log: Log) -> dict[str, Column]:
    """Return all columns of a log at once: numbers, NaN where a cell is none, and texts."""
    texts = [name for name in log.columns if name not in log.numeric]
    columns: dict[str, list[Any]] = {name: [] for name in log.columns}
    for piece in log.read((), log.numeric, texts):
        for name in log.columns:
            columns[name].append(piece.table.columns[name])
    return {name: _joined(parts) for name, parts in columns.items() if parts}


def _joined(parts: list[Any]) -> Column:
    """Return the column that its pieces make: an array, or a list of texts."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    return list(chain.from_iterable(parts))


def _read_head(path: os.PathLike[str]) -> bytes:
    try:
        with Path(path).open("rb") as stream:
            head = stream.read(HEAD)
    except FileNotFoundError:
        raise MultiposError(f"{path}: no such file; check the path of the log.") from None
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot read the log: {error.strerror or error}; "
            "check the path and its permissions."
        ) from None
    if not head.strip():
        raise MultiposError(f"{path}: the file is empty; a log needs rows of samples.")
    return head

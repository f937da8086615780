"""Logs that are arrays: in memory, or in NumPy's and MATLAB's formats."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.logs.isolation import first_line, read_apart
from multipos.logs.table import Log, Piece, name_columns

_ROWS = 1 << 16  # at a time


def log_of_columns(source: str, found: Mapping[str, Any], names: Sequence[str] | None) -> Log:
    """Return a log of arrays by name; shorter ones than the longest are left out."""
    arrays = {name: np.asarray(column) for name, column in _flat(found).items()}
    lengths = {len(column) for column in arrays.values()}
    rows = max(lengths, default=0)
    columns = {name: column for name, column in arrays.items() if len(column) == rows}
    if not rows or not columns:
        raise MultiposError(f"{source}: no arrays of samples; a log needs rows.")
    given = name_columns(source, list(columns), len(columns), names)
    columns = dict(zip(given, columns.values(), strict=True))
    numeric = tuple(name for name, column in columns.items() if column.dtype.kind in "fiub")
    read = partial(_read_arrays, source, columns, rows)
    return Log(source, given, numeric, ",", False, read)


def _read_arrays(
    source: str,
    columns: Mapping[str, NDArray[Any]],
    rows: int,
    names: Sequence[str],
    optional: Sequence[str],
) -> Iterator[Piece]:
    step = _ROWS
    for start in range(0, rows, step):
        part = {
            name: np.array(columns[name][start : start + step], dtype=np.float64)
            for name in dict.fromkeys((*names, *optional))
        }
        end = min(start + step, rows)
        table = Table(source, part, rows=end - start, first=start)
        for name in names:
            table.number(name)
        yield Piece(table, None, end / rows)


def _flat(found: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return arrays as columns: acc (n, 3) as acc_x, acc_y, acc_z, wider ones by number."""
    columns: dict[str, NDArray[Any]] = {}
    for name, value in found.items():
        array = np.asarray(value)
        if array.dtype.kind not in "fiubUS" or array.size < 2:
            continue  # structures, and scalars such as a sample rate
        if array.ndim == 2 and min(array.shape) == 1:
            array = array.ravel()
        if array.ndim == 1:
            columns[name] = array
        elif array.ndim == 2:
            width = array.shape[1]
            ends = "xyz" if width == 3 else [str(i + 1) for i in range(width)]
            stem = f"{name}_" if name else ""
            columns |= {f"{stem}{end}": array[:, i] for i, end in enumerate(ends)}
    return columns


def read_npy(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of an array file, which stay on the disk until they are read."""
    array = loaded(path, lambda: np.load(Path(path), mmap_mode="r", allow_pickle=False))
    if array.ndim not in (1, 2) or not array.size:
        raise MultiposError(
            f"{path}: an array of shape {array.shape}; a log is one column (n,), or one row a "
            "sample (n, columns)."
        )
    if array.dtype.names:
        return {name: array[name] for name in array.dtype.names}
    if array.ndim == 1:
        array = array[:, None]
    return {str(i + 1): array[:, i] for i in range(array.shape[1])}


def read_npz(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the arrays of an archive."""

    def load() -> dict[str, Any]:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return dict(archive)

    found: dict[str, Any] = loaded(path, load)
    return found


def read_mat(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file up to version 7, whose reader a damaged one crashes."""
    return read_apart(path, load_mat)


def load_mat(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file: in a process of its own."""
    from scipy.io import loadmat

    found: dict[str, Any] = loadmat(path, squeeze_me=False)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def refuse_hdf(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Say what to do with MATLAB's version 7.3."""
    raise MultiposError(
        f"{path}: an HDF5 file (MATLAB writes it with -v7.3), which is not read; "
        "save it in MATLAB with -v7, or as CSV."
    )


def loaded(path: os.PathLike[str], load: Callable[[], Any]) -> Any:
    """Return what a library's reader gives, and refuse a damaged file by its first line."""
    try:
        return load()
    except Exception as error:  # each format has exceptions of its own for a damaged file
        raise MultiposError(
            f"{path}: cannot read the log: {first_line(error)}; write it again."
        ) from None

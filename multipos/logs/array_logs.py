"""Logs that are arrays or archives: of NumPy, MATLAB, HDF5, JSON, and what phones export.

`log_of_columns` makes a log of arrays; `read_npy`, `read_npz`, `read_mat`, `load_mat`, `load_hdf`
and `read_records` read them from files, refused by `loaded` where they are damaged. Of an archive
`tables_in` names the tables and `unpack_phone` takes the accelerometer's; `refuse_without_gravity`
refuses one from which gravity was taken.

phyphox puts one experiment into ``Raw Data.csv``; its ``Linear Acceleration`` is without gravity.
Sensor Logger [1]_ has ``TotalAcceleration.csv`` with gravity (Android) or the uncalibrated
accelerometer (iOS, in g), columns z, y, x, while its ``Accelerometer.csv`` has had gravity taken
away, which no calibration can use. Its JSON has the records of all sensors, numbers as texts.

References
----------
.. [1] Sensor Logger, "One-Page Unit Reference" and "Coordinates Reference".
"""

import os
import re
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.handed import of_array, read_json_columns
from multipos.files.layout import goes_up
from multipos.files.pipes import Unpacked
from multipos.files.tables import Column, Table
from multipos.files.written_units import split_unit
from multipos.logs.extras import first_line, read_apart
from multipos.logs.log_columns import name_header
from multipos.logs.table import Log, Piece, Wanted

_ROWS = 1 << 16  # at a time
_WIDEST = 12  # rows of an array whose rows are its columns
_FIRST = 50  # rows that tell whether a column is a time


def log_of_columns(source: str, found: Mapping[str, Any], names: Sequence[str] | None) -> Log:
    """Return a log of arrays by name; shorter ones than the longest are left out."""
    flat = _flat(found)
    rows = max(map(len, flat.values()), default=0)
    whole = {name: column for name, column in flat.items() if len(column) == rows}
    if not rows or not whole:
        raise MultiposError(f"{source}: no arrays of samples; a log needs rows.")
    header = None if all(map(str.isdigit, whole)) else list(whole)
    named = name_header(source, header, len(whole), names)
    arrays = dict(zip(named.columns, whole.values(), strict=True))
    named_units = zip(named.columns, map(split_unit, whole), strict=True)
    return Log(
        source=source,
        **named._asdict(),
        numeric=_of_kind(arrays, "fiubM"),
        delimiter=",",
        text=False,
        pieces=partial(_read_arrays, source, arrays, rows),
        units={name: unit for name, (_, unit) in named_units if unit},
        rising=named.headless and _rises(next(iter(arrays.values()))),
        dates=frozenset(_of_kind(arrays, "M")),
    )


def _rises(column: NDArray[Any]) -> bool:
    """Tell whether a column goes up in its first rows, and not by ones."""
    return column.dtype.kind in "fiu" and goes_up(column[:_FIRST].astype(np.float64))


def _of_kind(arrays: Mapping[str, NDArray[Any]], kinds: str) -> tuple[str, ...]:
    return tuple(name for name, column in arrays.items() if column.dtype.kind in kinds)


def _read_arrays(
    source: str, columns: Mapping[str, NDArray[Any]], rows: int, wanted: Wanted
) -> Iterator[Piece]:
    for start in range(0, rows, _ROWS):
        end = min(start + _ROWS, rows)
        part: dict[str, Column] = {
            name: _numbers(_cells(columns[name][start:end])) for name in wanted.numbers
        }
        cells = {name: _cells(columns[name][start:end]) for name in wanted.texts}
        plain = Table(source, cells, rows=end - start)
        part |= {name: list(plain.text(name)) for name in wanted.texts}
        table = Table(source, part, rows=end - start, first=start)
        for name in wanted.names:
            table.number(name)
        yield Piece(table, None, end / rows)


def _cells(column: NDArray[Any]) -> NDArray[Any]:
    """Return cells as they are, of bytes their text."""
    return np.char.decode(column, "utf-8", "replace") if column.dtype.kind == "S" else column


def _numbers(column: NDArray[Any]) -> Column:
    if column.dtype.kind == "U":  # cells that the table reads, and names where they are no numbers
        return [str(cell) for cell in column.tolist()]
    if column.dtype.kind != "M":
        with np.errstate(all="ignore"):  # a NaN that signals; a long double beyond all doubles
            return np.array(column, dtype=np.float64)
    seconds = column.astype("datetime64[ns]").astype(np.int64) * 1e-9
    return np.where(np.isnat(column), np.nan, seconds)


def _flat(found: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return arrays as columns: acc (n, 3) as acc_x, acc_y, acc_z, wider ones by number."""
    columns: dict[str, NDArray[Any]] = {}
    for name, value in found.items():
        array = _plain(value)
        if array.ndim == 1 and array.size:
            columns[name] = array
        elif array.ndim == 2:
            columns |= _split_columns(name, array)
    return columns


def _plain(value: Any) -> NDArray[Any]:
    """Return an array of numbers, dates or texts; an empty one for structures, and for scalars."""
    array = np.asarray(value)
    if array.dtype.kind == "O" and array.size and isinstance(array.flat[0], str):
        array = array.astype(np.str_)  # texts of a data frame
    if array.dtype.kind not in "fiubUSM" or array.size < 2:
        return np.empty(0)
    return array.ravel() if array.ndim == 2 and min(array.shape) == 1 else array


def _split_columns(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    width = array.shape[1]
    ends = "xyz" if width == 3 else [str(i + 1) for i in range(width)]
    stem = f"{name}_" if name else ""
    return {f"{stem}{end}": array[:, i] for i, end in enumerate(ends)}


def read_npy(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of an array file, which stay on the disk until they are read."""
    array = loaded(path, lambda: np.load(Path(path), mmap_mode="r", allow_pickle=False))
    if array.ndim == 2 and array.shape[0] <= _WIDEST < array.shape[1]:
        array = array.T  # as NumPy users hold it, a row an output
    return _legible(path, of_array(array, str(path), None))


def read_npz(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the arrays of an archive."""

    def load() -> dict[str, Any]:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return dict(archive)

    return _legible(path, loaded(path, load))


def _legible(path: os.PathLike[str], columns: dict[str, Any]) -> dict[str, Any]:
    """Return columns whose texts are made of characters: NumPy reads any four bytes as one."""
    for name, column in columns.items():
        # what is no array in an archive comes as bytes
        is_text = isinstance(column, np.ndarray) and column.dtype.kind == "U"
        if not is_text or not column.dtype.itemsize:
            continue
        number = np.dtype(np.uint32).newbyteorder(column.dtype.byteorder)
        if (np.ascontiguousarray(column).view(number) > sys.maxunicode).any():
            raise MultiposError(
                f"{path}: cannot read the log: column '{name}' has text that is none; the file is "
                "damaged, write it again."
            )
    return columns


def read_mat(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file up to version 7, whose reader a damaged one crashes."""
    return read_apart(path, load_mat)


def load_mat(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file: in a process of its own."""
    from scipy.io import loadmat

    found: dict[str, Any] = loadmat(path, squeeze_me=False)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def loaded(path: os.PathLike[str], load: Callable[[], Any]) -> Any:
    """Return what a library's reader gives, and refuse a damaged file by its first line."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of headers by Python 2, and the like
            return load()
    except Exception as error:  # each format has exceptions of its own for a damaged file
        raise MultiposError(
            f"{path}: cannot read the log: {first_line(error)}; write it again."
        ) from None


_MATLAB = b"MATLAB 7.3"  # stores matrices column by column, so that they come out transposed


def load_hdf(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the data sets of numbers, and the columns of tables."""
    import h5py

    with Path(path).open("rb") as stream:
        transposed = stream.read(len(_MATLAB)) == _MATLAB
    found: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.attrs.get("MATLAB_class") == b"char":
            return
        if item.dtype.names:
            found.update({f"{name}/{part}": item[part] for part in item.dtype.names})
        elif item.dtype.kind in "fiub" and item.ndim in (1, 2):
            found[name] = np.asarray(item).T if transposed else np.asarray(item)

    with h5py.File(os.fspath(path), "r") as file:
        file.visititems(take)
    rows = max((len(column) for column in found.values()), default=0)
    samples = {name: column for name, column in found.items() if len(column) == rows}
    last = [name.rpartition("/")[2] for name in samples]
    if len(set(last)) == len(last):
        return dict(zip(last, samples.values(), strict=True))
    return samples


# In the order in which they are looked for.
_WITH_GRAVITY = ("total ?acc.*", "acc.*uncalibrated.*", "acc.*with.?g.*", "acc.*", "raw data")
_TABLES = (".csv", ".tsv", ".txt")
_BESIDE = {"meta", "__MACOSX"}  # folders of phyphox, and of whoever packs on a Mac
_LINEAR, _ELAPSED = "Accelerometer", "seconds_elapsed"  # of Sensor Logger: without gravity


def tables_in(path: os.PathLike[str]) -> list[str]:
    """Return the tables in an archive, in any folder but those about the device."""
    from zipfile import ZipFile

    with ZipFile(path) as archive:
        names = [PurePosixPath(name) for name in archive.namelist()]
    tables = [each for each in names if each.suffix.lower() in _TABLES]
    return [str(each) for each in tables if _BESIDE.isdisjoint(each.parts)]


def unpack_phone(path: os.PathLike[str]) -> Unpacked:
    """Return the accelerometer's table of an archive.

    Raises
    ------
    MultiposError
        There is none, or only one without gravity.
    """
    names: list[str] = loaded(path, lambda: tables_in(path))
    stems = {PurePosixPath(name).stem: name for name in names}
    found = _with_gravity(stems)
    if found is None:
        raise MultiposError(
            f"{path}: none of {', '.join(names)} looks like an accelerometer's; unpack the one."
        )
    if found == _LINEAR and "Gravity" in stems:
        raise _without_gravity(path, f"{found}.csv")
    return loaded(path, lambda: _unpacked(path, stems[found]))  # type: ignore[no-any-return]


def _with_gravity(names: Collection[str]) -> str | None:
    """Return which of a phone's sensors is the accelerometer, with gravity where there is one."""
    pairs = [(pattern, name) for pattern in _WITH_GRAVITY for name in names]
    found = next((name for p, name in pairs if re.fullmatch(p, name, re.IGNORECASE)), None)
    return next(iter(names)) if found is None and len(names) == 1 else found


def _without_gravity(path: object, name: str) -> MultiposError:
    return MultiposError(
        f"{path}: {name} has gravity taken away, which a calibration needs; record total "
        "acceleration, or the uncalibrated accelerometer."
    )


def refuse_without_gravity(log: Log) -> Log:
    """Return a log unless it is the table of Sensor Logger's accelerometer without gravity."""
    name = PurePosixPath(log.source).name
    if PurePosixPath(log.source).stem == _LINEAR and {*"xyz", _ELAPSED} <= set(log.columns):
        raise _without_gravity(log.source, name)
    return log


def read_records(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of JSON; of Sensor Logger's, those of the accelerometer with gravity."""
    columns = read_json_columns(path, "log")
    if "sensor" not in columns or _ELAPSED not in columns:
        return columns
    sensors = columns["sensor"]
    found = _with_gravity(dict.fromkeys(sensors.tolist()))
    if found is None:
        raise MultiposError(f"{path}: no accelerometer among its sensors; record one.")
    if found == _LINEAR:
        raise _without_gravity(path, f"sensor '{found}'")
    rows = sensors == found
    return {name: columns[name][rows] for name in ("time", _ELAPSED, *"xyz") if name in columns}


def _unpacked(path: os.PathLike[str], name: str) -> Unpacked:
    from zipfile import ZipFile

    with ZipFile(path) as archive, archive.open(name) as stream:
        return Unpacked(str(path), stream, PurePosixPath(name).suffix)

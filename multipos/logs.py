"""Raw logs, read piece by piece: text, NumPy and MATLAB files, of any length.

A log is a table of samples, one row a sample. Text comes with commas, semicolons (and decimal
commas), tabs or white space between the cells, with or without a header; without one the columns
are called 1, 2, 3, …. Which reader serves a file is decided by its first bytes and then by its
suffix (`READERS`); whatever is neither is text. Only what was asked for is turned into numbers,
in pieces of some megabytes, so that the length of a log does not matter; a `.npz` or `.mat` file
is the exception, because its format holds each array in one piece.
"""

import csv
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.files import Column, Source, Table, read_table

Array = NDArray[np.float64]

_PIECE = 1 << 22  # bytes of text, or a tenth as many rows of arrays, read at a time
_HEAD = 1 << 16  # bytes that must hold the header and the first row
_SAMPLE = 50  # first rows, which tell numbers from text


class Piece(NamedTuple):
    """Consecutive rows of a log."""

    table: Table  # the columns that were asked for, as numbers
    lines: list[str] | None  # the rows as they stand in a text file
    done: float  # how much of the log has been read, 0 to 1


@dataclass(frozen=True)
class Log:
    """A log that can be read from its beginning, more than once.

    Attributes
    ----------
    source : str
    columns : tuple of str
    numeric : tuple of str
        Columns whose first rows hold numbers.
    delimiter : str
        What stands between the cells of the text; '' is white space; ',' where it is no text.
    text : bool
        Whether pieces have rows of text.
    read : callable
        ``read(names, optional)`` yields pieces with those columns. A cell of `names` that is no
        finite number is an error, in `optional` it is NaN.
    """

    source: str
    columns: tuple[str, ...]
    numeric: tuple[str, ...]
    delimiter: str
    text: bool
    read: Callable[[Sequence[str], Sequence[str]], Iterator[Piece]]


class Reader(NamedTuple):
    """How one kind of file is told from others, and opened."""

    kind: str
    suffixes: tuple[str, ...]
    magic: bytes
    columns: Callable[[Path], Mapping[str, Any]]


def open_log(source: "Source | Log", *, columns: Sequence[str] | None = None) -> Log:
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
    if not isinstance(source, str | os.PathLike):
        table = read_table(source, what="log")
        return _from_columns(table.source, table.columns, columns)
    path = Path(source)
    head = _read_head(path)
    for reader in READERS:
        by_suffix = path.suffix.lower() in reader.suffixes
        if head.startswith(reader.magic) or (by_suffix and b"\0" in head):
            return _from_columns(str(path), reader.columns(path), columns)
    return _open_text(path, head, columns)


def read_log(log: Log) -> dict[str, Column]:
    """Return all columns of a log at once: numbers, NaN where a cell is none, and texts."""
    columns: dict[str, list[Any]] = {name: [] for name in log.columns}
    texts = [name for name in log.columns if name not in log.numeric]
    for piece in log.read((), log.numeric):
        for name in log.numeric:
            columns[name].append(piece.table.columns[name])
        rows = _split(piece.lines, log.delimiter) if piece.lines and texts else []
        for name in texts:
            place = log.columns.index(name)
            columns[name] += [row[place] for row in rows]
    return {
        name: np.concatenate(column) if name in log.numeric else column
        for name, column in columns.items()
        if column
    }


def _read_head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
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


# --- text


class _Text(NamedTuple):
    """How the rows of a text file are laid out."""

    path: Path
    columns: tuple[str, ...]
    numeric: tuple[str, ...]
    delimiter: str
    header_line: int  # 0 where the first row is a sample


def _open_text(path: Path, head: bytes, columns: Sequence[str] | None) -> Log:
    first = [
        (number, line)
        for number, line in enumerate(_decode(path, head).split("\n"), start=1)
        if _is_row(line)
    ]
    if len(head) == _HEAD:
        first = first[:-1]  # its last line may be cut
    if not first:
        raise MultiposError(f"{path}: no rows in the first {_HEAD} bytes; a log needs samples.")
    line_number, line = first[0]
    delimiter = next((mark for mark in ";\t," if mark in line), "")
    cells = _split([line], delimiter)[0]
    headless = all(_is_number(cell, delimiter) or not cell for cell in cells)
    samples = [row for _, row in (first if headless else first[1:])][:_SAMPLE]
    if not samples:
        raise MultiposError(f"{path}: only a header, no rows; a log needs samples.")
    names = _names(str(path), None if headless else cells, len(cells), columns)
    rows = [row for row in _split(samples, delimiter) if len(row) == len(names)]
    numeric = tuple(
        name
        for i, name in enumerate(names)
        if any(_is_number(row[i], delimiter) for row in rows)
        and all(_is_number(row[i], delimiter) or not row[i] for row in rows)
    )
    text = _Text(path, names, numeric, delimiter, 0 if headless else line_number)
    return Log(str(path), names, numeric, delimiter, True, partial(_read_text, text))


def _read_text(text: _Text, names: Sequence[str], optional: Sequence[str]) -> Iterator[Piece]:
    first = 0
    for rows, done in _text_rows(text):
        if rows.lines:
            yield Piece(_parse(text, rows, first, names, optional), rows.lines, done)
            first += len(rows.lines)


class _Rows(NamedTuple):
    """Rows of text without header, comments and empty lines."""

    lines: list[str]
    numbers: Sequence[int]  # of the lines in the file
    delimiters: int  # in all of them


def _text_rows(text: _Text) -> Iterator[tuple[_Rows, float]]:
    size = max(text.path.stat().st_size, 1)
    line, rest = 1, b""
    with text.path.open("rb") as stream:
        while block := stream.read(_PIECE):
            block = rest + block
            end = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1
            block, rest = block[:end], block[end:]
            if block:
                content = _decode(text.path, block)
                yield _rows_only(text, content, line), min(stream.tell() / size, 1.0)
                line += content.count("\n")
        if rest:
            yield _rows_only(text, _decode(text.path, rest), line), 1.0


def _rows_only(text: _Text, content: str, first: int) -> _Rows:
    lines = content.split("\n")
    if not lines[-1]:
        lines.pop()
    skipped = max(text.header_line - first + 1, 0)
    numbers: Sequence[int] = range(first + skipped, first + len(lines))
    gone, lines = lines[:skipped], lines[skipped:]
    # A row has a character for every cell and separator; shorter ones may be empty lines.
    if "#" in content or min(map(len, lines), default=0) < 2 * len(text.columns) - 1:
        rows = [_is_row(line) for line in lines]
        gone += [line for line, row in zip(lines, rows, strict=True) if not row]
        numbers = [i for i, row in zip(numbers, rows, strict=True) if row]
        lines = [line for line, row in zip(lines, rows, strict=True) if row]
    mark = text.delimiter or " "
    return _Rows(lines, numbers, content.count(mark) - sum(line.count(mark) for line in gone))


def _parse(
    text: _Text, rows: _Rows, first: int, names: Sequence[str], optional: Sequence[str]
) -> Table:
    """Return the named columns of rows of text: by NumPy's reader, by ours where it stumbles."""
    wanted = list(dict.fromkeys((*names, *optional)))
    index = [text.columns.index(name) for name in wanted]
    table = partial(
        Table, str(text.path), rows=len(rows.lines), lines=rows.numbers, first=first,
        delimiter=text.delimiter or " ",
    )  # fmt: skip
    try:
        columns = dict(zip(wanted, _fast(text, rows, index), strict=True))
        if all(np.isfinite(columns[name]).all() for name in names):
            return table(columns)
    except ValueError:
        pass
    cells = _split(rows.lines, text.delimiter)
    width = len(text.columns)
    for i, row in enumerate(cells):
        if len(row) != width:
            raise MultiposError(
                f"{text.path}: row {first + i + 1} (line {rows.numbers[i]}) has {len(row)} cells "
                f"where there are {width} columns, the last '{text.columns[-1]}'; a log that was "
                "cut off may end in half a row, remove it."
            )
    texts = table({name: [row[i] for row in cells] for name, i in zip(wanted, index, strict=True)})
    parsed = {name: texts.number(name) for name in names}
    for name in optional:
        if name not in parsed:
            column = [_lenient(cell, text.delimiter) for cell in texts.columns[name]]
            parsed[name] = np.array(column)
    return table(parsed)


def _fast(text: _Text, rows: _Rows, index: list[int]) -> Array:
    mark, width = text.delimiter, len(text.columns)
    lines = [line.replace(",", ".") for line in rows.lines] if mark == ";" else rows.lines
    if not mark:
        # White space may come in any amount, so here NumPy counts the cells of every row.
        values = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
        if values.shape[1] != width:
            raise ValueError
        return np.ascontiguousarray(values.T[index])
    # With as many separators as there must be, no row can have more cells than it should, unless
    # another has less; and that one stumbles over the last column.
    last = width - 1
    even = rows.delimiters == last * len(rows.lines) and last in index
    if not even and set(map(methodcaller("count", mark), lines)) != {last}:
        raise ValueError  # a ragged row, or quotes
    values = np.loadtxt(
        lines, dtype=np.float64, delimiter=mark, usecols=index, comments=None, ndmin=2
    )
    return np.ascontiguousarray(values.T)


def _decode(path: Path, block: bytes) -> str:
    try:
        text = block.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        if len(block) == _HEAD and error.start > _HEAD - 4:  # the head may end inside a letter
            return _decode(path, block[: error.start])
        raise MultiposError(
            f"{path}: byte 0x{block[error.start]:02x} is not UTF-8; save the log as UTF-8 text."
        ) from None
    if "\0" in text:
        raise MultiposError(
            f"{path}: neither text nor a format that is read ({', '.join(r.kind for r in READERS)})"
            "; convert the log to CSV."
        )
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _split(lines: list[str], delimiter: str) -> list[list[str]]:
    if not delimiter:
        return [line.split() for line in lines]
    rows = csv.reader(lines, delimiter=delimiter)
    return [[cell.strip() for cell in row] for row in rows]


def _is_row(line: str) -> bool:
    stripped = line.lstrip()
    return bool(stripped) and not stripped.startswith("#")


def _is_number(cell: str, delimiter: str) -> bool:
    return not np.isnan(_lenient(cell, delimiter)) or cell.lower() == "nan"


def _lenient(cell: str, delimiter: str) -> float:
    try:
        return float(cell.replace(",", ".") if delimiter == ";" else cell)
    except ValueError:
        return float("nan")


def _names(
    source: str, header: list[str] | None, width: int, given: Sequence[str] | None
) -> tuple[str, ...]:
    if given is not None:
        if len(given) != width:
            raise UsageError(
                f"--columns names {len(given)} columns, but {source} has {width}; name each."
            )
        header = list(given)
    if header is None:
        return tuple(str(i + 1) for i in range(width))
    for i, name in enumerate(header):
        if not name:
            raise MultiposError(f"{source}: column {i + 1} has no name; name it or give --columns.")
        if name in header[:i]:
            raise MultiposError(
                f"{source}: column '{name}' appears twice; rename one or give --columns."
            )
    return tuple(header)


# --- arrays


def _from_columns(source: str, found: Mapping[str, Any], names: Sequence[str] | None) -> Log:
    arrays = {name: np.asarray(column) for name, column in _flat(found).items()}
    lengths = {len(column) for column in arrays.values()}
    rows = max(lengths, default=0)
    columns = {name: column for name, column in arrays.items() if len(column) == rows}
    if not rows or not columns:
        raise MultiposError(f"{source}: no arrays of samples; a log needs rows.")
    given = _names(source, list(columns), len(columns), names)
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
    step = _PIECE // 64
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


def _npy(path: Path) -> Mapping[str, Any]:
    array = _loaded(path, lambda: np.load(path, mmap_mode="r", allow_pickle=False))
    if array.dtype.names:
        return {name: array[name] for name in array.dtype.names}
    width = array.shape[1] if array.ndim == 2 else 1
    return {str(i + 1): array.reshape(len(array), -1)[:, i] for i in range(width)}


def _npz(path: Path) -> Mapping[str, Any]:
    def load() -> dict[str, Any]:
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)

    found: dict[str, Any] = _loaded(path, load)
    return found


def _mat(path: Path) -> Mapping[str, Any]:
    from scipy.io import loadmat

    found = _loaded(path, lambda: loadmat(path, squeeze_me=False))
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _hdf(path: Path) -> Mapping[str, Any]:
    raise MultiposError(
        f"{path}: an HDF5 file (MATLAB writes it with -v7.3), which is not read; "
        "save it in MATLAB with -v7, or as CSV."
    )


def _loaded(path: Path, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:  # each format has exceptions of its own for a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MultiposError(f"{path}: cannot read the log: {reason}; write it again.") from None


READERS = (
    Reader("NumPy .npy", (".npy",), b"\x93NUMPY", _npy),
    Reader("NumPy .npz", (".npz",), b"PK\x03\x04", _npz),
    Reader("MATLAB .mat up to v7", (".mat",), b"MATLAB 5.0 MAT-file", _mat),
    Reader("HDF5", (".h5", ".hdf5"), b"\x89HDF", _hdf),
)

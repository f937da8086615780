"""What users hand in as a table, made a path that can be opened or columns by name.

`take_in` is the door; `read_json_columns`, `read_arrow`, `arrow_columns` and `of_array` read what
is no text, `unpack` and `unpack_workbook` make it a file that can be read as any other, `is_json`,
`is_packed` and `members` know it by its bytes, `content_of` and `find_copies` know copies,
`require_extra` and `broken` say that a library is missing or cannot be loaded.

A table is a path (text, a workbook, JSON, Parquet or Feather, packed or not), an open file or
``io.StringIO``, a mapping of columns, a data frame, a lazy frame, anything with the Arrow C stream
[1]_ or the dataframe interchange protocol [2]_, or an array of NumPy, one row a line. Excel
workbooks are text, row by row.

JSON is a table where it has records ``[{"ax": 1.0, "ay": 0.1}, …]``, rows ``[[1.0, 0.1], …]``,
columns ``{"ax": [1.0, …], …}``, as pandas and this package write them, or one record a line. They
may stand at any depth beside anything else, and be nested: the one with most rows is the table, and
``{"acc": {"x": 1.0}}`` is a column ``acc.x``, ``{"acc": [1.0, …]}`` are ``acc[0]`` and so on.

References
----------
.. [1] Apache Arrow, "The Arrow PyCapsule Interface": ``__arrow_c_stream__``.
.. [2] Consortium for Python Data API Standards, "Python dataframe interchange protocol".
"""

import csv
import datetime
import io
import json
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.files.pipes import GZIP, Unpacked, text_of
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json_value
from multipos.files.whole import first_bytes, read_bytes, reading, sha256_of

ZIP = b"PK\x03\x04"
WORKBOOK = "xl/workbook.xml"  # the ending of a name in an archive that is one
OLE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"  # of .xls, as phyphox and old programs write it


def require_extra(path: StrPath, kind: str, library: str, extra: str, does: str = "reads") -> None:
    """Refuse a file whose library, which reads or writes it, is not installed.

    Raises
    ------
    MultiposError
        Names the kind of the file and the extra.
    """
    try:
        there = find_spec(library) is not None
    except ModuleNotFoundError:  # of the package above it
        there = False
    if not there:
        raise MultiposError(
            f"{path}: {kind}, which {library} {does}; install it with "
            f"pip install 'multipos[{extra}]'."
        )


def broken(path: StrPath, error: ImportError) -> MultiposError:
    """Return what is said of a library that is installed and cannot be loaded."""
    name = (error.name or "a library").partition(".")[0]
    said = " ".join(str(error).split())[:100]
    return MultiposError(
        f"{path}: {name} is installed but cannot be loaded ({said}); install it again."
    )


def members(path: StrPath) -> list[str]:
    """Return the names in a zip archive, none where it cannot be read."""
    from zipfile import BadZipFile, ZipFile

    # ValueError: a name in it is no text
    with suppress(BadZipFile, OSError, NotImplementedError, ValueError), ZipFile(path) as archive:
        return archive.namelist()
    return []


def unpack_workbook(path: StrPath) -> Unpacked:
    """Return the sheet of a workbook that holds readings as a file of comma separated text.

    That is the one that was open, or the first with at least half as many rows of numbers as any.

    Raises
    ------
    MultiposError
        It cannot be read, or `openpyxl` or `xlrd`, which reads it, is not installed.
    """
    old = first_bytes(path, len(OLE)) == OLE
    require_extra(path, "an Excel workbook", "xlrd" if old else "openpyxl", "excel")
    try:
        with warnings.catch_warnings(action="ignore"):  # of print areas and styles: cells are read
            sheets = dict(_sheets_of_xls(path) if old else _sheets_of_xlsx(path))
    except Exception as error:  # of a damaged file whatever its library raises
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise MultiposError(
            f"{path}: cannot read the workbook: {reason}; save it again as .xlsx or CSV."
        ) from None
    rows = {name: len(_NUMBERED.findall(text)) for name, text in sheets.items()}
    name = next(each for each in sheets if 2 * rows[each] >= max(rows.values()))
    said = f"taken from sheet '{name}', of {len(sheets)}" if len(sheets) > 1 else ""
    return Unpacked(str(path), io.BytesIO(sheets[name].encode()), ".csv", said=said)


_NUMBERED = re.compile(r"^(?:.*,)?-?\d+(?:\.\d*)?(?:,.*)?$", re.MULTILINE)  # a row with a number


def _sheets_of_xlsx(path: StrPath) -> Iterator[tuple[str, str]]:
    """Yield name and text of each sheet, first of the one that was open."""
    from openpyxl import load_workbook

    with Path(path).open("rb") as stream:
        book = load_workbook(stream, read_only=True, data_only=True)
        for sheet in sorted(book.worksheets, key=lambda each: each is not book.active):
            yield sheet.title, _as_text(sheet.iter_rows(values_only=True))


def _sheets_of_xls(path: StrPath) -> Iterator[tuple[str, str]]:
    import xlrd

    with xlrd.open_workbook(path, logfile=io.StringIO()) as book:
        for sheet in sorted(book.sheets(), key=lambda each: not each.sheet_selected):
            rows = (
                tuple(
                    xlrd.xldate_as_datetime(cell.value, book.datemode)
                    if cell.ctype == xlrd.XL_CELL_DATE
                    else cell.value
                    for cell in row
                )
                for row in sheet.get_rows()
            )
            yield sheet.name, _as_text(rows)


def _as_text(rows: Iterable[tuple[Any, ...]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([*map(_cell, row)] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="microseconds")
    return "" if value is None else str(value)


XZ = b"\xfd7zXZ\0"
ZSTD = b"\x28\xb5\x2f\xfd"
ARROW = (b"PAR1", b"ARROW1")  # Parquet, Feather
_JSON = re.compile(rb'(?:\xef\xbb\xbf)*\s*(?:\{\s*"|\[\s*\{|\[\s*\[\s*[-+.\deE]+\s*,)')
_DEEPEST = 32  # objects in objects
_VECTOR = 32  # numbers in a list of a record, at most


def is_json(head: bytes) -> bool:
    """Tell by its first bytes whether a file is JSON of objects."""
    return _JSON.match(head) is not None


def take_in(
    source: Any, what: str, names: Sequence[str] | None = None
) -> StrPath | Mapping[str, Any]:
    """Return a path that can be opened, or columns by name.

    Parameters
    ----------
    source : path, open file, mapping of columns, data frame, or array
    what : str
        What the table is for, in messages.
    names : names, optional
        Of the columns of an array, which are 1, 2, 3, … without.

    Raises
    ------
    UsageError
        `names` does not name each column of an array once.
    TypeError
        It is none of these.
    """
    if isinstance(source, str | os.PathLike | Mapping):
        return source
    if callable(getattr(source, "read", None)):
        return _kept(source, what)
    if isinstance(source, np.ndarray):
        return of_array(source, what, names)
    if hasattr(source, "collect_schema") and hasattr(source, "collect"):
        return take_in(source.collect(), what)  # a lazy frame
    own: Any = getattr(source, "columns", None)
    if callable(own):  # a result that is written as a table
        return take_in(own(), what)
    if hasattr(source, "column_names"):  # a table of Arrow, or a batch
        return arrow_columns(source)
    frame = own is not None and hasattr(source, "__getitem__")
    if frame and (hasattr(source, "__array__") or not hasattr(source, "__arrow_c_stream__")):
        return {str(name): source[name] for name in own}
    return _by_protocol(source, what)


def _kept(stream: Any, what: str) -> Unpacked:
    """Return what is left of an open file as a path that can be read more than once."""
    name = getattr(stream, "name", None)
    found = stream.read()
    raw = found.encode("utf-8", "surrogatepass") if isinstance(found, str) else bytes(found)
    shown = name if isinstance(name, str) else what
    return Unpacked(shown, io.BytesIO(raw), Path(shown).suffix)


def of_array(array: NDArray[Any], what: str, names: Sequence[str] | None) -> dict[str, Any]:
    """Return the columns of an array: its fields, or by names, or numbered."""
    if array.dtype.names:
        return {name: array[name] for name in array.dtype.names}
    if array.ndim not in (1, 2):
        raise MultiposError(
            f"{what}: an array of shape {array.shape}; give one row a line, (n, columns)."
        )
    columns = array[:, None] if array.ndim == 1 else array
    width = columns.shape[1]
    if names is not None and len(names) != width:
        raise UsageError(f"{len(names)} names, but the array has {width} columns; name each.")
    named = names or [str(i + 1) for i in range(width)]
    return {name: columns[:, i] for i, name in enumerate(named)}


def _by_protocol(source: Any, what: str) -> dict[str, Any]:
    """Return the columns of what says itself how to read it."""
    kind = type(source).__name__
    stream, frame = hasattr(source, "__arrow_c_stream__"), hasattr(source, "__dataframe__")
    if not stream and not frame:
        raise TypeError(
            f"{what} must be a path, an open file, a mapping of columns, a data frame or an array, "
            f"got {kind}."
        )
    require_extra(f"the {what}", f"a {kind}", "pyarrow", "parquet")
    if stream:
        from pyarrow import ArrowInvalid, table

        try:
            return arrow_columns(table(source))
        except ArrowInvalid:
            raise TypeError(f"{what} is one column, a {kind}; give a data frame.") from None
    from pyarrow.interchange import from_dataframe

    return arrow_columns(from_dataframe(source))


def arrow_columns(table: Any) -> dict[str, Any]:
    """Return the columns of a table of Arrow: numbers, times, or texts."""
    columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        array = column.to_numpy(zero_copy_only=False)
        if array.dtype.kind == "O" and all(isinstance(cell, str | None) for cell in array):
            array = np.array([cell or "" for cell in array], dtype=np.str_)
        columns[str(name)] = array
    return columns


def read_arrow(path: StrPath) -> dict[str, Any]:
    """Return the columns of a Parquet or Feather file.

    Raises
    ------
    MultiposError
        It is damaged, or `pyarrow` is not installed.
    """
    require_extra(path, "a Parquet or Feather file", "pyarrow", "parquet")
    try:
        from pyarrow import ArrowException, feather, parquet
    except ImportError as error:
        raise broken(path, error) from None
    reader = parquet if first_bytes(path, 4) == ARROW[0] else feather
    try:
        with Path(path).open("rb") as stream:
            return arrow_columns(reader.read_table(stream))
    except (ArrowException, OSError) as error:
        said = " ".join(str(error).split())[:200]
        raise MultiposError(f"{path}: cannot be read ({said}); write it again.") from None


def is_packed(head: bytes) -> bool:
    """Tell by its first bytes whether a file is packed by gzip, xz or Zstandard."""
    return head.startswith((GZIP, XZ, ZSTD))


def content_of(source: object) -> str | None:
    """Return the SHA-256 of what a file holds, packed or not; None of what is no file's path."""
    if not isinstance(source, str | os.PathLike):
        return None
    with reading(source, "file"):  # a name may be too long to ask for
        if not Path(source).is_file():
            return None
    held = unpack(source) if is_packed(first_bytes(source, len(XZ))) else source
    return sha256_of(held, "file")


def find_copies(contents: Sequence[str | None], named: Sequence[str]) -> dict[int, str]:
    """Return the places of what holds the same as one before it, and what each is a copy of.

    Parameters
    ----------
    contents : sequence of str or None
        What tells contents apart; None is like no other.
    named : sequence of str
    """
    first: dict[str, str] = {}
    again: dict[int, str] = {}
    for place, (content, name) in enumerate(zip(contents, named, strict=True)):
        if content is not None and content in first:
            again[place] = f"{name} (as {first[content]})"
        elif content is not None:
            first[content] = name
    return again


def unpack(path: StrPath) -> Unpacked:
    """Return a file that gzip, xz or Zstandard has packed as it was before.

    Raises
    ------
    MultiposError
        It is damaged or cut off, or of Zstandard, whose reader is not installed.
    """
    head = first_bytes(path, len(XZ))
    if head.startswith(GZIP):
        library: Any = import_module("gzip")
    elif head.startswith(XZ):
        library = import_module("lzma")
    else:
        library = _zstd(path)
    try:
        with library.open(os.fspath(path)) as stream:
            return Unpacked(str(path), stream, Path(Path(str(path)).stem).suffix)
    except MultiposError:
        raise
    except Exception as error:  # each library has exceptions of its own for a damaged file
        raise MultiposError(
            f"{path}: cannot unpack: {error}; the file is damaged or cut off, write it again."
        ) from None


def _zstd(path: StrPath) -> Any:
    if sys.version_info >= (3, 14):
        return import_module("compression.zstd")
    require_extra(path, "a Zstandard file", "backports.zstd", "zst")
    return import_module("backports.zstd")


def read_json_columns(path: StrPath, what: str) -> dict[str, Any]:
    """Return the columns of JSON: records, rows or columns at any depth, or one record a line.

    Raises
    ------
    MultiposError
        It is no JSON, or none of these.
    """
    try:
        found = read_json_value(path, what)
    except MultiposError:
        found = _lines(path, what)
        if found is None:
            raise
    if isinstance(found, dict) and isinstance(found.get("columns"), dict):
        found = found["columns"]  # as `--json` of a table writes it
    own = isinstance(found, dict) and ("findings" in found or type(found.get("schema")) is str)
    tables = [] if own else [*_tables_in(found, _DEEPEST)]
    if not tables:
        raise MultiposError(
            f"{path}: the JSON is no table; give records, columns by name, or one record a line."
        )
    longest = max(tables, key=_rows)
    return {name: _column(cells) for name, cells in longest.items()}


def _rows(table: Mapping[str, Sequence[Any]]) -> int:
    return max(map(len, table.values()), default=0)


def _tables_in(value: Any, depth: int) -> Iterator[dict[str, list[Any]]]:
    """Yield the tables in a value: by records, by rows, by columns."""
    if depth == 0:
        return
    if isinstance(value, list):
        if value and all(isinstance(each, dict) for each in value):
            yield _of_records(value)
        elif _are_rows(value):
            yield {str(i): [*cells] for i, cells in enumerate(zip(*value, strict=True), 1)}
    elif isinstance(value, dict) and all(map(str.isdigit, value)):
        yield from _tables_in([*value.values()], depth - 1)
    elif isinstance(value, dict):
        lists = {name: cells for name, cells in _leaves(value, depth) if isinstance(cells, list)}
        longest = _rows(lists)
        columns = {name: cells for name, cells in lists.items() if len(cells) == longest}
        if longest and not any(isinstance(cells[0], dict | list) for cells in columns.values()):
            yield _without_shared(columns)
        for each in value.values():
            yield from _tables_in(each, depth - 1)


def _without_shared(columns: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    """Return columns without the names of objects that hold all of them."""
    shared = 0
    heads = [name.split(".")[:-1] for name in columns]
    while heads[0][shared : shared + 1] and len({(*head[: shared + 1],) for head in heads}) == 1:
        shared += 1
    return {".".join(name.split(".")[shared:]): cells for name, cells in columns.items()}


def _are_rows(value: Sequence[Any]) -> bool:
    """Tell whether a list is of lists of as many numbers, or texts, each."""
    widths = {len(each) if isinstance(each, list) else 0 for each in value}
    if len(widths) != 1 or widths <= {0}:
        return False
    return not any(isinstance(cell, dict | list) for each in value for cell in each)


def _of_records(records: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the columns of records, the parts of a nested one under names of their own."""
    flat = [dict(_parts(record)) for record in records]
    names = dict.fromkeys(name for each in flat for name in each)
    return {name: [each.get(name) for each in flat] for name in names}


def _parts(record: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in _leaves(record, _DEEPEST):
        if isinstance(value, list):
            if len(value) <= _VECTOR:
                yield from ((f"{name}[{i}]", each) for i, each in enumerate(value))
        else:
            yield name, value


def _leaves(value: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    """Yield what is no object in nested ones; an object of numbered cells is their list."""
    for name, each in value.items():
        if not isinstance(each, dict):
            yield name, each
        elif each and all(map(str.isdigit, each)):
            yield name, [*each.values()]
        elif depth:
            yield from ((f"{name}.{part}", leaf) for part, leaf in _leaves(each, depth - 1))


def _lines(path: StrPath, what: str) -> list[Any] | None:
    """Return the values of JSON that has one on every line; None where a line is none."""
    raw = read_bytes(path, what)
    try:
        lines = text_of(raw).splitlines()
        found = [json.loads(line) for line in lines if line.strip()]
    except (ValueError, RecursionError):
        return None
    return found if len(found) > 1 else None


def _column(cells: Iterable[Any]) -> Any:
    """Return cells of JSON as an array: whole numbers, numbers, or texts; None is empty."""
    cells = list(cells)
    if all(isinstance(cell, str | None) for cell in cells):
        texts = np.array([cell or "" for cell in cells], dtype=np.str_)
        filled = np.where(texts == "", "nan", texts) if (texts != "").any() else texts
        for kind in (np.int64, np.float64):  # times in nanoseconds have more digits than a float
            try:
                return filled.astype(kind)
            except (ValueError, OverflowError):
                continue
        return texts
    if all(isinstance(cell, int | float | None) for cell in cells):
        numbers = np.array([np.nan if cell is None else cell for cell in cells])
        # Whole numbers beyond 64 bits would stay objects.
        return numbers.astype(np.str_).astype(np.float64) if numbers.dtype == object else numbers
    return np.array(["" if cell is None else str(cell) for cell in cells], dtype=np.str_)

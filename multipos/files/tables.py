"""CSV tables, in and out.

`read_table` and `open_table` read, `write_table`, `format_csv`, `format_rows` and `to_parquet`
write, `safe_rows` passes rows on. Cells stay text until a column is asked for, so that a column
nobody uses can hold anything and a bad cell is reported by file, row and column.

A table is one row a line, UTF-8 with or without byte-order mark; `multipos.files.layout` finds its
header and what stands between its cells, of tables and logs alike. Wherever a file is taken, what
`multipos.files.handed` lists is taken too.
"""

import csv
import io
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files import handed, spelling, whole
from multipos.files.csv_columns import Cells, Lines, Plain, read_plain
from multipos.files.csv_columns import Column as Column
from multipos.files.layout import find_layout, units_in
from multipos.files.marks import cleaned_columns, may_have_marks, number_in
from multipos.files.pipes import UTF_16, Pipe, decoded, is_pipe, rereadable, text_of
from multipos.files.printed import Records, holds_number, is_comment, is_row
from multipos.files.spelling import StrPath
from multipos.files.written_units import split_unit
from multipos.results import frozen

_FINITE = float(np.finfo(np.float64).max)
_BINARY = 4096  # bytes, in which no text has a NUL
_HEAD = 1000  # lines that tell how a table is laid out
_FEW = 1000  # rows, up to which cells are written one by one
_LONG = 1 << 20  # bytes: a longer text stays bytes until its cells are asked for
Source = StrPath | Mapping[str, Any] | Any  # see `multipos.files.handed`


@frozen(eq=True)
class Table:
    """Columns by name, with what is needed to say where a cell came from."""

    source: str
    columns: Mapping[str, Column]
    rows: int
    lines: Lines | None = None  # line of the file each row ends on
    sha256: str | None = None
    delimiter: str = ","
    content: str | None = None  # SHA-256 of what a packed file holds
    first: int = 0  # rows of the source that came before these, where it is read piece by piece
    copies: tuple[str, ...] = ()  # files that are no part of it, as they hold what others do
    read_as: str = ""  # what was decided of the marks in its numbers, in words
    commented: tuple[int, ...] = ()  # lines that begin as comments and are like rows

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def select(self, rows: Sequence[int]) -> "Table":
        """Return the table with some of its rows; messages still name the lines of the file."""
        columns: dict[str, Column] = {}
        places = np.asarray(rows, dtype=np.intp)
        for name, column in self.columns.items():
            if isinstance(column, np.ndarray) and column.dtype.kind in "fiub":
                columns[name] = column[places]
            else:
                columns[name] = [column[row] for row in rows]
        lines = None if self.lines is None else [int(self.lines[row]) for row in rows]
        return replace(self, columns=columns, rows=len(rows), lines=lines)

    def renamed(self, names: Mapping[str, str]) -> "Table":
        """Return the table with other names of some columns."""
        return replace(self, columns={names.get(n, n): each for n, each in self.columns.items()})

    @property
    def decimal_comma(self) -> bool:
        """Whether numbers may be written 1,5: semicolons stand between the cells."""
        return self.delimiter == ";"

    def text(self, name: str) -> tuple[str, ...]:
        """Return a column as labels; whole numbers lose a trailing ``.0``.

        Raises
        ------
        MultiposError
            A label has a control character, which a terminal would obey.
        """
        labels = self.unchecked(name)
        for row, label in enumerate(() if "".join(labels).isprintable() else labels):
            if spelling.control_characters(label):
                raise MultiposError(
                    f"{self.where(row, name)}: '{spelling.visible(label)}' has a control "
                    "character; write it without."
                )
        return labels

    def unchecked(self, name: str) -> tuple[str, ...]:
        """Return a column as labels that are compared, and never printed."""
        cells = self.columns[name]
        if set(map(type, cells)) == {int}:
            return tuple(map(str, cells))
        labels = (_label(None if _is_nan(cell) else cell) for cell in cells)
        return tuple(map(spelling.of_cell, labels))

    def number(
        self, name: str, *, empty: bool = False, largest: float = math.inf
    ) -> NDArray[np.float64]:
        """Return a column as finite numbers (n,); with `empty`, empty cells become NaN.

        Raises
        ------
        MultiposError
            A cell is text, empty, not finite or beyond `largest`; the message names file, row and
            column.
        """
        cells = self.columns[name]
        values = self.numbers(name)
        if (np.abs(values) <= min(largest, _FINITE)).all():
            return values
        bad = ~np.isfinite(values)
        if empty and isinstance(cells, np.ndarray) and cells.dtype.kind == "f":
            bad &= ~np.isnan(values)
        if bad.any():
            for row in np.flatnonzero(bad).tolist():
                cell = _label(cells[row])
                if cell in ("", "nan") and empty:
                    continue
                raise MultiposError(f"{self.where(row, name)}: {_fault(cell, self.decimal_comma)}")
        far = np.abs(values) > largest
        if far.any():  # a float with a flipped bit, whose square may be no number
            row = int(np.argmax(far))
            raise MultiposError(
                f"{self.where(row, name)}: {values[row]:g} is no number that is measured (beyond "
                f"{largest:g}); correct it or leave the row out."
            )
        return values

    def is_text(self, name: str) -> bool:
        """Tell whether no cell of the column is a number."""
        cells = self.columns[name]
        if isinstance(cells, list) and np.isfinite(self._parse(cells[:1])).any():
            return False  # in most columns the first cell decides
        return not np.isfinite(self.numbers(name)).any()

    def where(self, row: int, name: str) -> str:
        """Return the place of a cell in words."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return f"{self.source}: row {self.first + row + 1}{line}, column '{name}'"

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a column as numbers (n,), NaN where a cell is none."""
        cells = self.columns[name]
        if isinstance(cells, Cells):
            return cells.numbers(self._parse, decimal_comma=self.decimal_comma)
        return self._parse(cells)

    def _parse(self, cells: Column) -> NDArray[np.float64]:
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiub":
            with np.errstate(all="ignore"):  # a NaN that signals is one
                return cells.astype(np.float64, copy=False)
        try:
            if self.decimal_comma:
                cells = [cell.replace(",", ".") for cell in cells]
            if "_" in "\n".join(cells):  # float() would take 1_000
                raise ValueError
            return np.array([*map(float, cells)], dtype=np.float64)
        except (ValueError, TypeError, AttributeError):
            return np.array([_float(cell) for cell in cells], dtype=np.float64)


def read_table(
    source: Source, *, what: str = "table", outputs: Sequence[str] | None = None
) -> Table:
    """Read a table from a file, columns in memory, a data frame, or an array.

    Parameters
    ----------
    source : path, open file, mapping of name to (n,) array, data frame, or (n, columns) array
        A file is CSV, a workbook, JSON or Parquet, packed by gzip, xz or Zstandard or not; a frame
        is one of pandas, polars or Arrow, or anything with the Arrow C stream or the dataframe
        interchange protocol.
    what : str
        What the table is for, in messages.
    outputs : names, optional
        Of the columns of an array, which are 1, 2, 3, … without.

    Returns
    -------
    Table

    Raises
    ------
    MultiposError
        Missing, empty, unreadable, ragged, or with duplicate or unnamed columns.
    UsageError
        `outputs` does not name each column of an array.
    TypeError
        It is nothing of this.

    Examples
    --------
    >>> import multipos as mp
    >>> mp.write_table("run.csv", {"angle": [0.0, 90.0], "volt": [0.012, 2.513]})
    >>> table = mp.read_table("run.csv")
    >>> list(table.columns), table.numbers("volt").tolist()
    (['angle', 'volt'], [0.012, 2.513])
    """
    if isinstance(source, Table):
        return source
    given = handed.take_in(source, what, outputs)
    return _of_columns(given, what) if isinstance(given, Mapping) else _read_file(given, what)


def _of_columns(given: Mapping[str, Any], what: str) -> Table:
    """Return the table of columns in memory."""
    columns: dict[str, Column] = {str(n): _array(column, n, what) for n, column in given.items()}
    _check_names(what, columns)
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise MultiposError(f"the columns of the {what} differ in length: {lengths}.")
    rows = max(lengths.values(), default=0)
    if not rows:
        raise MultiposError(f"the {what} has no rows; give one row per position.")
    return Table(source=what, columns=columns, rows=rows)


def _array(column: Any, name: Any, what: str) -> NDArray[Any]:
    if isinstance(column, np.ma.MaskedArray):
        empty: Any = np.nan if column.dtype.kind in "fiub" else None
        column = np.where(np.ma.getmaskarray(column), empty, column.data)
    found = np.asarray(column)
    if found.ndim != 1:
        raise MultiposError(
            f"column '{name}' of the {what} must be one-dimensional, got shape {found.shape}."
        )
    return found


def open_table(path: StrPath, what: str) -> Table:
    """Return the table of a file; the cells of text without quotes stay in it, however short."""
    return _read_file(path, what, in_text=True)


def _read_file(path: StrPath, what: str, *, in_text: bool = False) -> Table:
    if not isinstance(path, Pipe) and is_pipe(path):
        path = rereadable(path)
    with whole.reading(path, what), Path(path).open("rb") as stream:
        head = stream.read(1 << 10)
        is_text = not (handed.is_packed(head) or handed.is_json(head))
        if is_text and not head.startswith(handed.ARROW):
            stream.seek(0)
            return _read_csv(path, stream.read(), what, in_text=in_text)
    if handed.is_packed(head):  # what people compare is the file that they have
        table = _read_file(handed.unpack(path), what, in_text=in_text)
        sha256 = whole.sha256_of(path, what)
        return replace(table, sha256=sha256, content=table.sha256)
    columns = (
        handed.read_json_columns(path, what) if handed.is_json(head) else handed.read_arrow(path)
    )
    sha256 = whole.sha256_of(path, what)
    return replace(_of_columns(columns, str(path)), sha256=sha256)


def _read_csv(path: StrPath, raw: bytes, what: str, *, in_text: bool) -> Table:
    import hashlib  # slow to import, and a log has no need of it

    sha256, said = hashlib.sha256(raw).hexdigest(), ""
    if raw.startswith((handed.ZIP, handed.OLE)):
        names = handed.members(path)
        if names and not any(name.endswith(handed.WORKBOOK) for name in names):
            raise MultiposError(
                f"{path}: the archive is no workbook; unpack it, or give a log to multipos "
                "calibrate."
            )
        book = handed.unpack_workbook(path)
        raw, said = whole.read_bytes(book, what), book.said
    if raw.startswith(UTF_16) and (found := decoded(raw)) is not None:
        raw = found.encode()
    plain = _plain(raw)
    if plain is None:
        return _read_cells(path, raw, sha256, what, said)
    table = replace(_plain_table(path, plain, sha256), read_as=said)
    if in_text or len(raw) > _LONG:
        return table
    return replace(table, columns={name: [*cells] for name, cells in table.columns.items()})


def _plain(raw: bytes) -> Plain | None:
    """Return columns that stay in their text; None where cells have to be looked at."""
    plain = read_plain(raw)
    if plain is None or len(plain.header) < 2 or not plain.header[-1] or plain.comments:
        return None
    if any(map(holds_number, plain.header)):
        return None
    first = [[*islice(column, _FEW)] for column in plain.columns]
    commas = plain.delimiter == "\t" and any("," in cell for cells in first for cell in cells)
    has_units = units_in([cells[0] for cells in first]) is not None
    return None if commas or has_units or may_have_marks(first) else plain


def _plain_table(path: StrPath, plain: Plain, sha256: str) -> Table:
    _check_header(path, plain.header)
    columns = dict(zip(plain.header, plain.columns, strict=True))
    return Table(str(path), columns, len(plain.lines), plain.lines, sha256, plain.delimiter)


def _read_cells(path: StrPath, raw: bytes, sha256: str, what: str, taken: str) -> Table:
    """Read a table cell by cell, quotes included, or lines that a program printed."""
    lines = io.StringIO(_decode(path, raw, what), newline=None).read().split("\n")
    if not any(map(is_row, lines)):
        raise MultiposError(f"{path}: the file is empty; give a header and rows of {what}.")
    layout = find_layout(str(path), lines[:_HEAD], needs="give one row per position")
    printed = layout.printed
    if printed is not None:
        lines = [*Records(printed).text(lines)]
    begin = 1 if layout.header is None else layout.below
    numbered = [(n, line) for n, line in enumerate(lines, 1) if n >= begin and is_row(line)]
    records = _records(path, numbered, layout.delimiter)
    pairs = zip(layout.names, layout.units, strict=True)
    header = [f"{n} [{unit}]" if unit and not split_unit(n)[1] else n for n, unit in pairs]
    if layout.header is None and numbered and numbered[0][0] < layout.first:
        header = [cell.strip() for cell in next(records).cells]  # which the rows do not fit
    _check_header(path, header)
    found = _filled(path, records, header, trailing=layout.trailing)
    if not found:
        raise MultiposError(f"{path}: only a header, no rows; give one row per position.")
    cells = zip(*(record.cells for record in found), strict=True)
    named = {name: list(map(str.strip, column)) for name, column in zip(header, cells, strict=True)}
    columns, marks = cleaned_columns(
        str(path),
        named,
        commas_between=layout.delimiter == ",",
        decimal_commas=layout.decimal_comma and layout.delimiter != ";",
    )
    comments = [(n, line) for n, line in enumerate(lines, 1) if n > begin and is_comment(line)]
    said = (taken, layout.begins, "" if printed is None else printed.said, marks)
    return Table(
        str(path),
        columns,
        len(found),
        [record.end for record in found],
        sha256,
        "," if printed else layout.delimiter or " ",
        read_as="; ".join(filter(None, said)),
        commented=tuple(number for number, line in comments if layout.is_like_a_row(line)),
    )


def _decode(path: StrPath, raw: bytes, what: str) -> str:
    try:
        text = text_of(raw)
    except UnicodeDecodeError as error:
        found = decoded(raw)
        if found is None:
            log = " A binary log is for multipos calibrate." if b"\0" in raw[:_BINARY] else ""
            raise MultiposError(
                f"{path}: byte {error.start} is not UTF-8; save the {what} as UTF-8 text.{log}"
            ) from None
        text = found
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise MultiposError(
            f"{path}: line {line} holds a NUL byte; the file is damaged or no text, save the "
            f"{what} as UTF-8 text."
        )
    return text


def _filled(
    path: StrPath, records: "Iterator[_Record]", header: Sequence[str], *, trailing: bool
) -> "list[_Record]":
    """Return the rows below a header, each of which must have a cell for every column."""
    found: list[_Record] = []
    for record in records:
        if trailing and record.cells[-1:] == [""]:
            record.cells.pop()
        if len(record.cells) != len(header):
            where = (
                f"line{'' if record.begin == record.end else f's {record.begin} to'} {record.end}"
            )
            way = f"; give one cell per column, last column '{header[-1]}'"
            if _with_decimal_commas(record.cells, len(header)):
                way = (
                    ": numbers with decimal commas between commas; save it with semicolons between "
                    "cells, or with decimal points"
                )
            raise MultiposError(
                f"{path}: row {len(found) + 1} ({where}) has {len(record.cells)} cells "
                f"where the header names {len(header)}{way}."
            )
        found.append(record)
    return found


def _with_decimal_commas(cells: Sequence[str], columns: int) -> bool:
    """Tell whether a row has a cell more for every number with a decimal comma, of two or more."""
    more = len(cells) - columns
    pairs = itertools.pairwise(cells)
    fractions = sum(after.isdigit() and math.isfinite(_float(before)) for before, after in pairs)
    return 1 < more <= columns and fractions >= more


class _Record(NamedTuple):
    """The cells of one row, and the lines of the file from which to which it goes."""

    cells: list[str]
    begin: int
    end: int


def _records(
    path: StrPath, numbered: Sequence[tuple[int, str]], delimiter: str
) -> Iterator[_Record]:
    """Yield the rows of numbered lines; a quoted cell may go on over several of them."""
    if not delimiter:
        yield from (_Record(line.split(), number, number) for number, line in numbered)
        return
    reader = csv.reader((line for _, line in numbered), delimiter=delimiter, strict=True)
    begin = 0
    try:
        for cells in reader:
            yield _Record(cells, numbered[begin][0], numbered[reader.line_num - 1][0])
            begin = reader.line_num
    except csv.Error as error:  # a quote that nobody closes has swallowed what follows it
        reason = "a quote is not closed" if "end of data" in str(error) else str(error)
        raise MultiposError(
            f"{path}: line {numbered[begin][0]}: {reason}; check the quotes of the row that "
            "begins there."
        ) from None


def _check_header(path: StrPath, header: list[str]) -> None:
    seen = set()
    for index, name in enumerate(header):
        if not name:
            raise MultiposError(
                f"{path}: column {index + 1} has no name; name it or remove the separator."
            )
        if name in seen:
            raise MultiposError(f"{path}: column '{name}' appears twice; rename or remove one.")
        seen.add(name)
    _check_names(path, header)


def _check_names(source: StrPath, names: Iterable[str]) -> None:
    for place, name in enumerate(names, start=1):
        if spelling.control_characters(name):
            raise MultiposError(
                f"{source}: the name of column {place}, '{spelling.visible(name)}', has a control "
                "character; rename it."
            )


def _float(cell: Any) -> float:
    return number_in(_label(cell))


def _is_nan(cell: Any) -> bool:
    return isinstance(cell, float | np.floating) and bool(np.isnan(cell))


def _label(cell: Any) -> str:
    if cell is None or str(cell) == "<NA>":  # pandas.NA
        return ""
    if isinstance(cell, float | np.floating) and float(cell).is_integer():
        return str(int(cell))
    return str(cell).strip()


def _fault(cell: str, decimal_comma: bool) -> str:
    if cell == "":
        return "the cell is empty; a number is needed there, or leave the row out."
    try:
        number = float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        comma = (
            " (decimal commas need semicolons between the cells)"
            if "," in cell and not decimal_comma
            else ""
        )
        return f"'{cell}' is not a number{comma}; a number is needed there."
    if math.isfinite(number):
        return f"'{cell}' is not a number; write it without underscores."
    return f"'{cell}' is not finite; a finite number is needed there, or leave the row out."


def format_csv(
    columns: Mapping[str, Column], delimiter: str = ",", digits: Mapping[str, int] | None = None
) -> str:
    """Return columns as CSV text; numbers keep all their digits, NaN is an empty cell.

    Text is escaped, and what a spreadsheet would run gets an apostrophe, which `Table.text` takes
    off. With semicolons between the cells, numbers get decimal commas. Columns of which `digits`
    says so have as many significant ones.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
    writer.writerow(columns)
    if any(len(column) for column in columns.values()):
        stream.write(format_rows(columns, delimiter, digits))
    return stream.getvalue()


def format_rows(
    columns: Mapping[str, Column], delimiter: str = ",", digits: Mapping[str, int] | None = None
) -> str:
    """Return the rows of `format_csv`, without its header."""
    from multipos.files.decimals import format_numbers

    asked = digits or {}
    arrays = [c for c in columns.values() if isinstance(c, np.ndarray) and c.dtype.kind in "fiub"]
    if len(arrays) == len(columns) and (asked or len(arrays[0]) > _FEW):
        return format_numbers(arrays, delimiter, [asked.get(name) for name in columns])
    lists = []
    for name, column in columns.items():
        if name in asked:
            text = format_numbers([np.asarray(column)], delimiter, [asked[name]])
            lists.append(text.splitlines())
            continue
        cells = column.tolist() if isinstance(column, np.ndarray) else list(column)
        if any(isinstance(cell, float) for cell in cells):
            cells = ["" if cell != cell else repr(cell) for cell in cells]
            if delimiter == ";":
                cells = [cell.replace(".", ",") for cell in cells]
        else:
            cells = [spelling.as_cell(cell) if isinstance(cell, str) else cell for cell in cells]
        lists.append(cells)
    stream = io.StringIO()
    rows = zip(*lists, strict=True)
    csv.writer(stream, delimiter=delimiter, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def safe_rows(lines: list[str], delimiter: str) -> list[str]:
    """Return rows of CSV with their cells as `format_csv` writes text, the rest untouched."""
    if not spelling.is_risky("\n".join(lines)):
        return lines
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
    # a cell that nothing reads may be as long as its line
    limit = csv.field_size_limit(max(csv.field_size_limit(), *map(len, lines)))
    try:
        rows = csv.reader(lines, delimiter=delimiter)
        writer.writerows([spelling.as_cell(cell) for cell in row] for row in rows)
    finally:
        csv.field_size_limit(limit)
    return stream.getvalue().split("\n")[:-1]


def write_table(path: StrPath, columns: Source) -> None:
    """Write columns as a CSV file, whole or not at all; numbers keep all their digits.

    Parameters
    ----------
    path : path
    columns : mapping of name to (n,) array, or data frame
        NaN becomes an empty cell.

    Raises
    ------
    MultiposError
        The columns are empty or differ in length, or the file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import multipos as mp
    >>> mp.write_table("run.csv", {"angle": [0.0, 90.0], "volt": [0.012, float("nan")]})
    >>> Path("run.csv").read_text().split()
    ['angle,volt', '0.0,0.012', '90.0,']
    """
    whole.write_text(path, format_csv(read_table(columns).columns))


def to_parquet(parts: Iterable[Mapping[str, Any]]) -> Iterator[bytes]:
    """Yield the parts of a table as a Parquet file, a row group each; all numbers are whole.

    Raises
    ------
    MultiposError
        `pyarrow` is not installed.
    """
    handed.require_extra("the result", "a Parquet file", "pyarrow", "parquet", "writes")
    import pyarrow as pa
    from pyarrow import parquet

    stream, writer = io.BytesIO(), None
    for part in parts:
        group = pa.table({name: pa.array(_as_objects(column)) for name, column in part.items()})
        if writer is None:
            writer = parquet.ParquetWriter(stream, group.schema)
        writer.write_table(group)
    if writer is not None:
        writer.close()
    yield stream.getvalue()


def _as_objects(column: Column) -> Column:
    """Return texts as Python's, which repeat and are kept once."""
    is_text = isinstance(column, np.ndarray) and column.dtype.kind == "U"
    return column.astype(object) if is_text else column  # type: ignore[union-attr]

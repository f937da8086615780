"""Logs that are text, read in pieces of some megabytes.

`head_lines` returns the first lines of a file and `open_text` its log, `open_lines` that of text
which still comes, a `LiveText`.

The columns of a piece are had by NumPy's reader in one step where its lines are nothing but rows of
numbers, or become so without comments, empty lines and a separator behind the last cell; else cell
by cell, so that what is bad is named, or is no number where that may be.
"""

import os
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.csv_columns import rows_of_text, unix_lines
from multipos.files.layout import (
    Layout,
    cells_of,
    find_layout,
    has_open_quote,
    is_number,
    number_of,
)
from multipos.files.pipes import text_of
from multipos.files.printed import Records, is_row
from multipos.files.spelling import of_cell
from multipos.files.tables import Column, Table
from multipos.finding import Finding, Findings
from multipos.logs.clock import read_dates, require_dates
from multipos.logs.log_columns import Named, name_header
from multipos.logs.readers import formats_read
from multipos.logs.table import Log, Piece, ReadPieces, Wanted
from multipos.numerics.arrays import Array
from multipos.results import frozen


class Rows(NamedTuple):
    """Rows of text without header, comments and empty lines."""

    lines: list[str]
    numbers: Sequence[int]  # of the lines in the file


def _with_points(layout: Layout, content: str) -> str:
    """Return lines of the table with decimal points, unless semicolons tell that commas are."""
    if layout.decimal_comma and layout.delimiter != ";":
        return content.replace(",", ".")
    return content


def _lines_of(content: str) -> list[str]:
    """Return lines without their ends."""
    return content.removesuffix("\n").split("\n") if content else []


def _rows_only(layout: Layout, content: str, first: int) -> Rows:
    """Return the rows among lines, the number of whose first is given, without a last separator."""
    lines, places = rows_of_text(content)
    if layout.header is not None and any(line.startswith(layout.header[0]) for line in lines):
        mark, header = layout.delimiter, layout.header
        kept = [i for i, line in enumerate(lines) if tuple(cells_of(line, mark)) != header]
        lines, places = [lines[i] for i in kept], [places[i] for i in kept]
    if layout.trailing:
        lines = [line.rstrip().removesuffix(layout.delimiter) for line in lines]
    return Rows(lines, [first + place for place in places])


HEAD = 1 << 16  # bytes that must hold what stands above the table, and its first row
_PIECE = 1 << 22  # bytes read at a time
_SHOWN = 40  # characters of a line in a message
_LINE_END = re.compile(rb"\r\n|\r|\n")


@frozen
class _Text:
    """A text file, and how its rows are laid out."""

    path: os.PathLike[str]
    columns: tuple[str, ...]
    layout: Layout
    begin: int  # byte of the file at which the first row begins
    end: int  # bytes of the file, without a row that is cut off

    @cached_property
    def places(self) -> dict[str, int]:
        """Which column has which name."""
        return {name: place for place, name in enumerate(self.columns)}

    @property
    def dates(self) -> frozenset[str]:
        """Names of the columns of dates."""
        flags = zip(self.columns, self.layout.dates, strict=True)
        return frozenset(name for name, is_date in flags if is_date)


def head_lines(path: os.PathLike[str], head: bytes) -> list[str]:
    """Return the lines of the first bytes of a text, without one that may be cut."""
    lines = _decode(path, unix_lines(head)).split("\n")
    return lines[:-1] if len(head) >= HEAD and len(lines) > 1 else lines


def open_text(
    path: os.PathLike[str], head: bytes, layout: Layout, given: Sequence[str] | None
) -> Log:
    """Return a log of text, whose first bytes and layout are given."""
    named = name_header(str(path), layout.header, layout.width, given)
    end, left_out = _cut_row(path, layout)
    text = _Text(path, named.columns, layout, _begin(head, layout.first), end)
    return _log(text, named, partial(_read_text, text), left_out)


def open_lines(source: str, lines: Sequence[str], given: Sequence[str] | None) -> "LiveText":
    """Return how the rows of a text that still comes are read, from its first lines.

    Raises
    ------
    MultiposError, UsageError
        As of a file: no row among the lines, or names that do not fit.
    """
    layout = find_layout(source, lines)
    printed = layout.printed
    rows = lines if printed is None else [*Records(printed).text(lines)]
    named = name_header(source, layout.header, layout.width, given)
    text = _Text(Path(source), named.columns, layout, 0, 0)
    log = _log(text, named, partial(_read_head, text, "\n".join(rows[layout.first - 1 :])), ())
    head = lines[layout.first - 1 :] if printed is None else lines
    return LiveText(log, text, "\n".join(head), None if printed is None else Records(printed))


@frozen(eq=True)
class LiveText:
    """Text that comes piece by piece, its rows laid out as its first lines show.

    Attributes
    ----------
    log : Log
        Its `read` gives the first lines only.
    text : what is known of the layout
    head : str
        The first lines, without what stands above the table.
    records : Records or None
        What makes rows of lines that are printed.
    """

    log: Log
    text: _Text
    head: str
    records: Records | None = None

    def rows(self, content: str) -> tuple[Array, list[str]]:
        """Return the numeric columns (k, n) of lines, NaN where a cell is bad, and the rows."""
        layout = self.text.layout
        if self.records is not None:
            content = "\n".join(self.records.text(content.removesuffix("\n").split("\n")))
        names = self.log.numeric
        wanted = Wanted((), names, (), lenient=True)
        table, lines = _parse(self.text, _with_points(layout, content), layout.first, 0, wanted)
        columns = [table.columns[name] for name in names]
        return np.array(columns, dtype=np.float64).reshape(len(names), -1), lines()


def _read_head(text: _Text, head: str, wanted: Wanted) -> Iterator[Piece]:
    content = _with_points(text.layout, head)
    yield Piece(*_parse(text, content, text.layout.first, 0, wanted), 1.0)


def _log(text: _Text, named: Named, read: ReadPieces, left_out: Findings) -> Log:
    layout = text.layout
    numbers = zip(named.columns, layout.numeric, layout.dates, strict=True)
    named_units = zip(named.columns, layout.units, strict=True)
    return Log(
        source=str(text.path),
        **named._asdict(),
        numeric=tuple(name for name, number, date in numbers if number or date),
        delimiter=layout.delimiter,
        text=True,
        pieces=read,
        units={name: unit for name, unit in named_units if unit},
        rising=named.headless and layout.rising,
        dates=text.dates,
        rate=layout.rate,
        notes=(Finding("table-begin", "note", layout.begins),) if layout.begins else (),
        left_out=left_out,
    )


def _begin(head: bytes, line: int) -> int:
    """Return the byte at which a line begins, behind a mark of the byte order."""
    ends = islice(_LINE_END.finditer(head), line - 1)
    begin = next(place for place in range(0, len(head), 3) if head[place : place + 3] != BOM_UTF8)
    return max([begin, *(end.end() for end in ends)])


def _cut_row(path: os.PathLike[str], layout: Layout) -> tuple[int, Findings]:
    """Return where the last whole row ends, and what is said of one that is cut off after it.

    That is one with fewer cells than there are, or half a number.
    """
    with Path(path).open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        begin = stream.seek(max(size - HEAD, 0))
        block = stream.read(size - begin)
    body = block.rstrip(b"\r\n")
    start = body.rfind(b"\n") + 1
    line = body[start:].decode("utf-8", "replace")
    if body.count(b"\n") < 2 or not is_row(line) or not _is_cut(line, layout, block == body):
        return size, ()
    shown = (line if len(line) <= _SHOWN else f"{line[:_SHOWN]}…").replace("\t", " ")
    text = f"the last row, '{shown}', is incomplete and was omitted"
    return begin + start, (Finding("cut-row", "note", text),)


def _is_cut(line: str, layout: Layout, unended: bool) -> bool:
    """Tell whether a row has too few cells, or ends in what is no number without a line end."""
    cells = cells_of(line, layout.delimiter)[: layout.width]
    if len(cells) < layout.width:
        return True
    held = [cell for cell, numeric in zip(cells, layout.numeric, strict=True) if numeric]
    return unended and any(cell and not is_number(cell, layout.delimiter) for cell in held)


def _read_text(text: _Text, wanted: Wanted) -> Iterator[Piece]:
    first = 0
    for block in _blocks(text):
        content = _with_points(text.layout, _decode(text.path, block.content))
        table, lines = _parse(text, content, block.line, first, wanted)
        if table.rows:
            yield Piece(table, lines, block.done)
            first += table.rows


class _Block(NamedTuple):
    """Whole lines of a file, line feeds between them."""

    content: bytes
    line: int  # of the first of them
    done: float  # how much of the file has been read, 0 to 1


def _blocks(text: _Text) -> Iterator[_Block]:
    line, rest = text.layout.first, b""
    size = max(text.end, 1)
    with Path(text.path).open("rb") as stream:
        stream.seek(text.begin)
        while block := stream.read(min(_PIECE, text.end - stream.tell())):
            block = rest + block
            end = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1
            block, rest = block[:end], block[end:]
            if block:
                content = unix_lines(block)
                yield _Block(content, line, min(stream.tell() / size, 1.0))
                line += content.count(b"\n")
        if rest:
            yield _Block(unix_lines(rest), line, 1.0)


def _parse(
    text: _Text, content: str, line: int, first: int, wanted: Wanted
) -> tuple[Table, Callable[[], list[str]]]:
    """Return the wanted columns of lines, the first of which has this number, and their rows."""
    count = content.count("\n") + (content[-1:] not in ("", "\n"))
    table = _table(text, range(line, line + count), first)
    if all(text.layout.numeric) and not text.layout.trailing:
        found = _parse_at_once(text, content, table, wanted)
        if found is not None:
            return found, partial(_lines_of, content)
    rows = _rows_only(text.layout, content, line)
    table = _table(text, rows.numbers, first)
    found = _parse_at_once(text, "\n".join(rows.lines), table, wanted)
    if found is None:
        found = _parse_slowly(text, rows, table, wanted)
    return found, partial(list, rows.lines)


def _table(text: _Text, numbers: Sequence[int], first: int) -> Table:
    """Return a table without columns, of rows on lines of these numbers."""
    mark = text.layout.delimiter or " "
    return Table(str(text.path), {}, rows=len(numbers), lines=numbers, first=first, delimiter=mark)


def _parse_at_once(text: _Text, content: str, table: Table, wanted: Wanted) -> Table | None:
    """Return the wanted columns by NumPy's reader; None where a line is no row it can read."""
    if not text.dates.isdisjoint(wanted.numbers) or wanted.texts or not table.rows:
        return None
    index = [text.places[name] for name in wanted.numbers]
    try:
        values = _load(text.layout, content, table.rows, index)
    except ValueError:
        return None
    columns = dict(zip(wanted.numbers, values, strict=True))
    if not all(np.isfinite(columns[name]).all() for name in wanted.names):
        return None
    return replace(table, columns=columns)


def _load(layout: Layout, content: str, rows: int, index: list[int]) -> Array:
    """Return columns (k, n) of lines, each of which must be a row."""
    mark, width = layout.delimiter, layout.width
    every = all(layout.numeric) or not mark  # then NumPy counts the cells of every row
    if not every and any(
        line.count(mark) != width - 1 or has_open_quote(line, mark) for line in _lines_of(content)
    ):
        raise ValueError
    values = np.loadtxt(
        StringIO(content.replace(",", ".") if mark == ";" else content),
        dtype=np.float64,
        delimiter=mark or None,
        usecols=None if every else index,
        comments=None,
        ndmin=2,
    )
    if len(values) != rows or (every and values.shape[1] != width):
        raise ValueError
    return np.ascontiguousarray(values.T[index] if every else values.T)


def _parse_slowly(text: _Text, rows: Rows, table: Table, wanted: Wanted) -> Table:
    """Return columns cell by cell: what is bad is named, or not a number where it may be."""
    cells = _cells(text, rows, table.first, lenient=wanted.lenient)

    def column(name: str) -> list[str]:
        place = text.places[name]
        return [row[place] for row in cells]

    parsed: dict[str, Column] = {n: [*map(of_cell, column(n))] for n in wanted.texts}
    for name in wanted.optional:
        if name not in wanted.names:
            is_date = name in text.dates
            mark = text.layout.delimiter
            parsed[name] = read_dates(column(name)) if is_date else _lenient(column(name), mark)
    for name in wanted.names:
        if name in text.dates:
            parsed[name] = require_dates(table, name, column(name))
        else:
            parsed[name] = replace(table, columns={name: column(name)}).number(name)
    return replace(table, columns=parsed)


def _cells(text: _Text, rows: Rows, first: int, *, lenient: bool) -> list[list[str]]:
    """Return the cells of rows; empty ones where a row has too few or too many and that is fine."""
    mark, width = text.layout.delimiter, len(text.columns)
    cells = [cells_of(line, mark) for line in rows.lines]
    for i, line in enumerate(rows.lines):
        is_open = has_open_quote(line, mark)
        if len(cells[i]) == width and not is_open:
            continue
        if not lenient:
            where = f"line {rows.numbers[i]}"
            raise MultiposError(
                f"{text.path}: {where}: a quote is not closed; check the quotes of that line."
                if is_open
                else f"{text.path}: row {first + i + 1} ({where}) has {len(cells[i])} cells where "
                f"there are {width} columns, the last '{text.columns[-1]}'; correct it, or give "
                "--drop-bad to leave such rows out."
            )
        cells[i] = [""] * width
    return cells


def _lenient(cells: Sequence[str], mark: str) -> Array:
    return np.array([number_of(cell, mark) for cell in cells], dtype=np.float64)


def _decode(path: os.PathLike[str], block: bytes) -> str:
    try:
        text = text_of(block)
    except UnicodeDecodeError as error:
        if len(block) >= HEAD and error.start > len(block) - 4:  # the head may end inside a letter
            return _decode(path, block[: error.start])
        raise MultiposError(
            f"{path}: byte 0x{block[error.start]:02x} is not UTF-8; save the log as UTF-8 text."
        ) from None
    if "\0" in text:
        raise MultiposError(
            f"{path}: neither text nor a format that is read ({formats_read()}); "
            "convert the log to CSV."
        )
    return text

"""Logs that are text, read in pieces of some megabytes.

Rows of a text log, apart from the lines that are none.

Text that is nothing but numbers with one separator, read by arithmetic on its bytes.

The digits of a number, without its point, are an integer M; the number is M / 10^k with k decimals.
That is the nearest double, as `float` gives it, where M and 10^k are doubles, for then only the
division rounds (W. D. Clinger, How to read floating point numbers accurately, PLDI 1990): for M up
to 2^53 and k up to 22; and where k = 0. Numbers with an exponent or more digits go through `float`.

Eight digits are read as one 64-bit word of bytes 48 + d, the first digit lowest: pairs 10 d + d',
pairs of pairs, and their pair are summed in place, each in one step for all of them.
"""

import csv
import os
import re
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from operator import methodcaller
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.csv_columns import unix_lines
from multipos.files.pipes import Unpacked
from multipos.files.printed import COMMENTS, Records, find_printed
from multipos.files.spelling import of_cell
from multipos.files.tables import Column, Table
from multipos.finding import Finding, Findings
from multipos.logs.clock import read_dates, require_dates
from multipos.logs.layout import (
    Layout,
    cells_of,
    find_layout,
    is_comment,
    is_number,
    number_of,
)
from multipos.logs.log_columns import Named, name_header
from multipos.logs.readers import formats_read
from multipos.logs.table import Log, Piece, ReadPieces, Wanted
from multipos.numerics.arrays import Array, Mask
from multipos.results import frozen


class Part(NamedTuple):
    """Consecutive lines of a text from its first row on."""

    content: str
    line: int  # of the first of them in the file

    def lines(self) -> list[str]:
        """Return the lines, without their ends."""
        return self.content.removesuffix("\n").split("\n") if self.content else []


class Rows(NamedTuple):
    """Rows of text without header, comments and empty lines."""

    lines: list[str]
    numbers: Sequence[int]  # of the lines in the file
    delimiters: int | None  # in all of them, where they have been counted
    quotes: bool  # whether one of them holds a quote that it does not close


def table_text(layout: Layout, content: str, first: int) -> Part:
    """Return lines of the table, the number of whose first is given."""
    if layout.decimal_comma and layout.delimiter != ";":
        content = content.replace(",", ".")
    return Part(content, first)


def rows_only(layout: Layout, part: Part) -> Rows:
    """Return the rows among lines, without a separator behind their last cell."""
    content, lines = part.content, part.lines()
    rows = _without_comments(lines, part.line, content, layout.width)
    if layout.trailing:
        bare = [line.rstrip().removesuffix(layout.delimiter) for line in rows.lines]
        return rows._replace(lines=bare)
    if len(rows.lines) == len(lines):
        return rows._replace(delimiters=content.count(layout.delimiter or " "))
    return rows


def _without_comments(lines: list[str], first: int, content: str, width: int) -> Rows:
    """Return the lines that are rows, and their numbers, the first of which is given."""
    numbers: Sequence[int] = range(first, first + len(lines))
    quotes = '"' in content and any(line.count('"') % 2 for line in lines)
    # A row has a character for every cell and separator; shorter ones may be empty lines.
    short = min(map(len, lines), default=0) < 2 * width - 1
    if short or any(mark in content for mark in COMMENTS) or any(map(str.isspace, lines)):
        kept = [i for i, line in enumerate(lines) if is_row(line)]
        numbers = [first + i for i in kept]
        lines = [lines[i] for i in kept]
    return Rows(lines, numbers, None, quotes)


def is_row(line: str) -> bool:
    """Tell whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not is_comment(line)


def split_rows(
    source: str, lines: Sequence[str], numbers: Sequence[int], delimiter: str
) -> list[list[str]]:
    """Return the cells of rows of text, whose line numbers are given; a row is one line.

    Raises
    ------
    MultiposError
        Of a quote that is not closed, or a cell of more than 128 KiB.
    """
    if not delimiter:
        return [line.split() for line in lines]
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    rows: list[list[str]] = []
    reason = ""
    try:
        for row in reader:
            if reader.line_num > len(rows) + 1:
                break
            rows.append([cell.strip() for cell in row])
    except csv.Error as error:
        reason = "" if "end of data" in str(error) else str(error)
    if len(rows) < len(lines):  # a quote that is not closed has swallowed what follows it
        raise MultiposError(
            f"{source}: line {numbers[len(rows)]}: {reason or 'a quote is not closed'}; check the "
            "quotes of that line."
        )
    return rows


_SEPARATORS = ("", ",", ";", "\t")
_BLOCK = 1 << 17  # bytes at a time, whose arrays stay in the processor's cache
_WORD = 8  # digits of a 64-bit word
_OTHERS = (8 * np.arange(_WORD, -1, -1)).astype(np.uint64)  # bits of a word that are no digits
_DIGITS = 19  # a 64-bit integer holds any number of so many
_EXACT = 1 << 53
_SHARE = 4  # one number in four may be written otherwise; beyond, NumPy's reader is quicker
_OTHERWISE = re.compile(rb"(?:[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?\n)*")
_POWERS = np.array([float(10**k) for k in range(_DIGITS + 1)])  # exact, as no `power` promises


class _Cells(NamedTuple):
    """Cells of numbers, row by row, and where they stand in a block of text."""

    block: bytes
    end: NDArray[np.int64]  # of each, in bytes
    last: NDArray[np.int64]  # end of each in the block without points
    length: NDArray[np.int64]
    digits: NDArray[np.int64]
    decimals: NDArray[np.int64]
    negative: Mask
    odd: Mask  # neither digits alone nor digits with a point and a minus

    def texts(self, which: Mask) -> list[bytes]:
        """Return what some cells hold."""
        pairs = zip(self.end[which].tolist(), self.length[which].tolist(), strict=True)
        return [self.block[end - length : end] for end, length in pairs]

    def of_columns(self, width: int, columns: Sequence[int]) -> "_Cells":
        """Return the cells of some columns."""
        which = np.arange(len(self.odd)).reshape(-1, width)[:, columns].ravel()
        return _Cells._make([self.block, *(each[which] for each in self[1:])])


def read_plain(text: bytes, delimiter: str, width: int, columns: Sequence[int]) -> Array | None:
    """Return columns of numbers (k, n), None where text holds anything else.

    Parameters
    ----------
    text : bytes
        Rows, a line each.
    delimiter : str
        '' is white space; a comma, a semicolon or a tabulator otherwise.
    width : int
        Cells of a row.
    columns : sequence of int
        Which of them are wanted.
    """
    if not text or delimiter not in _SEPARATORS:
        return None
    every = [*columns] == [*range(width)]
    found = np.empty((len(columns), text.count(b"\n") + (not text.endswith(b"\n"))))
    start = row = 0
    while start < len(text):
        end = text.rfind(b"\n", start, start + _BLOCK) + 1 or len(text)
        cells = _find_cells(text[start:end], delimiter.encode(), width)
        if cells is None:
            return None
        rows = len(cells.odd) // width
        wanted = cells if every else cells.of_columns(width, columns)
        found[:, row : row + rows] = _values(wanted).reshape(rows, len(columns)).T
        start, row = end, row + rows
    return found


def _find_cells(rows: bytes, mark: bytes, width: int) -> _Cells | None:
    """Return the cells of rows, None where one is no number, missing or too many, or many odd."""
    block = b"\n" * _WORD + rows + b"\n" * (not rows.endswith(b"\n"))
    cells = _between(block, mark or b" ", width)
    if cells is None and (b" " in block or b"\t" in block):
        return _between(_even(block, mark), mark or b" ", width)
    return cells


def _even(block: bytes, mark: bytes) -> bytes:
    """Return rows with one mark between cells, and no white space around it or a line."""
    if not mark:
        block, mark = block.replace(b"\t", b" "), b" "
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    for each in {mark, b"\n"} - {b" "}:
        block = block.replace(b" " + each, each).replace(each + b" ", each)
    return block


def _between(block: bytes, mark: bytes, width: int) -> _Cells | None:
    """Return what stands between separators, behind a word of line ends."""
    characters = np.frombuffer(block, dtype=np.uint8)
    places = np.flatnonzero(characters - np.uint8(ord("0")) > 9)[_WORD - 1 :]  # of no digits
    kinds = characters[places]
    between = np.flatnonzero((kinds == ord(mark)) | (kinds == ord("\n")))
    after = between[1:]
    row = mark * (width - 1) + b"\n"
    if kinds[after].tobytes() != row * (len(after) // width):
        return None
    points = kinds == ord(".")
    ends = places[between]
    end, length = ends[1:], np.diff(ends) - 1
    others = np.diff(between) - 1  # characters that are no digits
    digits = length - others
    pointed = points[after - 1]
    # A minus stands right behind a separator: the first character there that is no digit.
    first = between[:-1] + 1
    negative = (kinds[first] == ord("-")) & (places[first] == ends[:-1] + 1)
    odd = (others != pointed.astype(np.int64) + negative) | (digits < 1) | (digits > _DIGITS)
    if _SHARE * np.count_nonzero(odd) > len(odd):
        return None
    cells = _Cells(
        block,
        end,
        last=end - np.cumsum(points)[after],
        length=length,
        digits=digits,
        decimals=(end - places[after - 1] - 1) * pointed,
        negative=negative,
        odd=odd,
    )
    written_otherwise = b"".join(text + b"\n" for text in cells.texts(odd))
    return cells if _OTHERWISE.fullmatch(written_otherwise) else None


def _values(cells: _Cells) -> Array:
    """Return the numbers of cells."""
    words = _words(cells.block.translate(None, b"."))
    digits, decimals, odd = cells.digits, cells.decimals, cells.odd
    if odd.any():
        digits, decimals = np.where(odd, 0, digits), np.where(odd, 0, decimals)
    whole = _eight(words, cells.last, digits)
    for place in range(_WORD, _DIGITS, _WORD):
        longer = np.flatnonzero(digits > place)
        if not len(longer):
            break
        more = _eight(words, cells.last[longer] - place, digits[longer] - place)
        whole[longer] += more * np.uint64(10**place)
    values = whole.astype(np.float64)
    values /= _POWERS[decimals]
    np.negative(values, out=values, where=cells.negative)
    other = odd | ((whole > _EXACT) & (decimals > 0))
    values[other] = [float(text) for text in cells.texts(other)]
    return values


def _words(text: bytes) -> NDArray[np.uint64]:
    """Return the words that begin at each byte of a text, its characters rising in value."""
    return np.ndarray(len(text) - _WORD + 1, dtype="<u8", buffer=text, strides=(1,))


def _eight(
    words: NDArray[np.uint64], end: NDArray[np.int64], digits: NDArray[np.int64]
) -> NDArray[np.uint64]:
    """Return the integers of up to eight digits that end at given bytes."""
    word = words[end - _WORD] & np.uint64(0x0F0F0F0F0F0F0F0F)
    before = _OTHERS[np.minimum(digits, _WORD)]
    word = (word >> before) << before
    word = (word * np.uint64(10) + (word >> np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    word = (word * np.uint64(100) + (word >> np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    return (word * np.uint64(10_000) + (word >> np.uint64(32))) & np.uint64(0xFFFFFFFF)


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
    # Numbers of the first lines, once they are read, where nothing names the columns: what they
    # show of gravity is looked at before the log is gone through.
    kept: list[Array | None] | None = None

    @cached_property
    def places(self) -> dict[str, int]:
        """Which column has which name."""
        return {name: place for place, name in enumerate(self.columns)}

    @property
    def dates(self) -> frozenset[str]:
        """Names of the columns of dates."""
        flags = zip(self.columns, self.layout.dates, strict=True)
        return frozenset(name for name, is_date in flags if is_date)


def open_text(path: os.PathLike[str], head: bytes, given: Sequence[str] | None) -> Log:
    """Return a log of text, whose first bytes are given."""
    lines = _decode(path, unix_lines(head)).split("\n")
    if len(head) >= HEAD and len(lines) > 1:
        lines = lines[:-1]  # its last line may be cut
    layout = find_layout(str(path), lines, path.header if isinstance(path, Unpacked) else None)
    named = name_header(str(path), layout.header, layout.width, given)
    cut = _cut_row(path, layout)
    kept: list[Array | None] | None = [] if named.headless else None
    text = _Text(path, named.columns, layout, _begin(head, layout.first), cut.end, kept)
    return _log(text, named, partial(_read_text, text), cut.found)


def open_lines(source: str, lines: Sequence[str], given: Sequence[str] | None) -> "LiveText":
    """Return how the rows of a text that still comes are read, from its first lines.

    Raises
    ------
    MultiposError, UsageError
        As of a file: no row among the lines, or names that do not fit.
    """
    printed = find_printed(lines)
    rows = lines if printed is None else [*Records(printed).text(lines)]
    layout = find_layout(source, rows, None if printed is None else printed.names)
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
        rows = rows_only(layout, table_text(layout, content, layout.first))
        names = self.log.numeric
        if not rows.lines:
            return np.empty((len(names), 0)), []
        table = _parse(self.text, rows, 0, Wanted((), names, (), lenient=True))
        return np.array([table.columns[name] for name in names], dtype=np.float64), rows.lines


def _read_head(text: _Text, head: str, wanted: Wanted) -> Iterator[Piece]:
    rows = rows_only(text.layout, table_text(text.layout, head, text.layout.first))
    yield Piece(_parse(text, rows, 0, wanted), partial(list, rows.lines), 1.0)


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
        notes=layout.notes,
        left_out=left_out,
    )


def _begin(head: bytes, line: int) -> int:
    """Return the byte at which a line begins, behind a mark of the byte order."""
    ends = islice(_LINE_END.finditer(head), line - 1)
    begin = len(BOM_UTF8) if head.startswith(BOM_UTF8) else 0
    return max([begin, *(end.end() for end in ends)])


class _Cut(NamedTuple):
    """Where the last whole row ends, and what is said of the one after it."""

    end: int
    found: Findings


def _cut_row(path: os.PathLike[str], layout: Layout) -> _Cut:
    """Find a last row that is cut off: with fewer cells than there are, or half a number."""
    with Path(path).open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        begin = stream.seek(max(size - HEAD, 0))
        block = stream.read(size - begin)
    body = block.rstrip(b"\r\n")
    start = body.rfind(b"\n") + 1
    line = body[start:].decode("utf-8", "replace")
    if body.count(b"\n") < 2 or not is_row(line) or not _is_cut(line, layout, block == body):
        return _Cut(size, ())
    shown = (line if len(line) <= _SHOWN else f"{line[:_SHOWN]}…").replace("\t", " ")
    text = f"the last row, '{shown}', is incomplete and was omitted"
    return _Cut(begin + start, (Finding("cut-row", "note", text),))


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
        table = _plain_table(text, block, first, wanted)
        if table is not None:
            yield Piece(table, partial(_lines, text, block), block.done)
            first += table.rows
        elif (rows := rows_only(text.layout, _part(text, block))).lines:
            yield Piece(_parse(text, rows, first, wanted), partial(list, rows.lines), block.done)
            first += len(rows.lines)


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


def _part(text: _Text, block: _Block) -> Part:
    return table_text(text.layout, _decode(text.path, block.content), block.line)


def _lines(text: _Text, block: _Block) -> list[str]:
    return _part(text, block).lines()


def _plain_table(text: _Text, block: _Block, first: int, wanted: Wanted) -> Table | None:
    """Return the wanted columns of lines that are nothing but rows of numbers, None of others."""
    layout = text.layout
    if wanted.texts or layout.trailing or not all(layout.numeric):
        return None
    values = _numbers(text, block, [text.places[name] for name in wanted.numbers])
    if values is None or not np.isfinite(values).all():
        return None
    rows = range(block.line, block.line + values.shape[1])
    columns = dict(zip(wanted.numbers, values, strict=True))
    return replace(_table(text, rows, first), columns=columns)


def _numbers(text: _Text, block: _Block, columns: Sequence[int]) -> Array | None:
    """Return columns of lines that are nothing but rows of numbers, None of others."""
    layout = text.layout
    # With semicolons between them numbers may have a decimal comma.
    comma = layout.decimal_comma or layout.delimiter == ";"
    content = block.content.replace(b",", b".") if comma else block.content
    if text.kept is None or block.line != layout.first:
        return read_plain(content, layout.delimiter, layout.width, columns)
    if not text.kept:
        text.kept.append(read_plain(content, layout.delimiter, layout.width, range(layout.width)))
    found = text.kept[0]
    return None if found is None else found[columns]


def _table(text: _Text, numbers: Sequence[int], first: int) -> Table:
    """Return a table without columns, of rows on lines of these numbers."""
    mark = text.layout.delimiter or " "
    return Table(str(text.path), {}, rows=len(numbers), lines=numbers, first=first, delimiter=mark)


def _parse(text: _Text, rows: Rows, first: int, wanted: Wanted) -> Table:
    """Return the wanted columns of rows of text: by NumPy's reader, by ours where it stumbles."""
    table = _table(text, rows.numbers, first)
    if not text.dates.isdisjoint(wanted.numbers) or wanted.texts:
        return _parse_slowly(text, rows, table, wanted)
    try:
        index = [text.places[name] for name in wanted.numbers]
        columns = dict(zip(wanted.numbers, _fast(text, rows, index), strict=True))
        if all(np.isfinite(columns[name]).all() for name in wanted.names):
            return replace(table, columns=columns)
    except ValueError:
        pass
    return _parse_slowly(text, rows, table, wanted)


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
    mark = text.layout.delimiter
    try:
        cells = split_rows(str(text.path), rows.lines, rows.numbers, mark)
    except MultiposError:
        if not lenient:
            raise
        cells = [_cells_of(line, mark) for line in rows.lines]
    width = len(text.columns)
    for i, row in enumerate(cells):
        if len(row) == width:
            continue
        if not lenient:
            raise MultiposError(
                f"{text.path}: row {first + i + 1} (line {rows.numbers[i]}) has {len(row)} cells "
                f"where there are {width} columns, the last '{text.columns[-1]}'; correct it, or "
                "give --drop-bad to leave such rows out."
            )
        cells[i] = [""] * width
    return cells


def _cells_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of one row, none where its quotes are not closed."""
    try:
        return split_rows("", [line], [0], delimiter)[0]
    except MultiposError:
        return []


def _lenient(cells: Sequence[str], mark: str) -> Array:
    return np.array([number_of(cell, mark) for cell in cells], dtype=np.float64)


def _fast(text: _Text, rows: Rows, index: list[int]) -> Array:
    if rows.quotes:
        raise ValueError
    mark, width = text.layout.delimiter, len(text.columns)
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


def _decode(path: os.PathLike[str], block: bytes) -> str:
    try:
        text = block.decode("utf-8").removeprefix("\ufeff")
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

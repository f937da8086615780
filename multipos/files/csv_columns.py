"""Columns of a long text table: bytes, which become cells or numbers when they are asked for.

`read_plain` returns the columns of a text, `joined_cells` and `arrange_cells` those of several
texts and of some rows in an order of their own; `rows_of_text` leaves comments out, `unix_lines`
gives lines one end.

A cell that is a Python string takes ten times the memory of its characters, and most cells of a
long table are numbers of a column that is asked for once, or of one that nobody uses. So the bytes
stay as they were read, and a column is split out of them in pieces of some megabytes. This serves
plain text, in which every line is a row and has all its cells; quotes are for the `csv` module.
"""

import io
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import repeat
from operator import itemgetter, methodcaller
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from multipos.files.printed import COMMENTS, is_comment, is_row
from multipos.numerics.arrays import Array, Places

Column = Sequence[Any] | NDArray[Any]  # of a table

_PIECE = 1 << 22  # bytes
_LINE = 1 << 16  # bytes in which a mark of the byte order is looked for
_TOGETHER = 1 << 16  # rows that are arranged in a piece
_WIDE = 100  # columns, from which on
_SHORT = 1 << 26  # fewer bytes are taken apart once: each column by itself would split all the text


Lines = Sequence[int] | NDArray[np.int64]  # of the file, counted from 1


class Plain(NamedTuple):
    """A table of plain text: its header and columns, and the line of the file of every row."""

    header: list[str]
    columns: list["Cells"]
    lines: Lines
    delimiter: str
    comments: bool  # lines below the header that begin as comments and have as many cells


class _Piece(NamedTuple):
    """Whole lines of the text, and how many rows came before them."""

    start: int
    end: int
    first: int


class Cells(Sequence[str]):
    """One column of the text, without the white space around its cells.

    Attributes
    ----------
    raw : bytes
    pieces : sequence of _Piece
        Where its rows are.
    place : int
        Of the column.
    mark : str
        Between cells.
    """

    def __init__(
        self, raw: bytes, pieces: Sequence[_Piece], rows: int, place: int, mark: str
    ) -> None:
        """Name the rows of some pieces."""
        self.raw: bytes = raw
        self.pieces: Sequence[_Piece] = pieces
        self.place: int = place
        self.mark: str = mark
        self._rows = rows
        self._firsts = np.array([piece.first for piece in pieces])
        self._last: tuple[int, list[str]] = (-1, [])

    def __len__(self) -> int:
        return self._rows

    def __iter__(self) -> Iterator[str]:
        for piece in self.pieces:
            yield from self._split(_rows_of(self.raw, piece))

    @overload
    def __getitem__(self, row: int) -> str: ...

    @overload
    def __getitem__(self, row: slice) -> list[str]: ...

    def __getitem__(self, row: int | slice) -> str | list[str]:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(self._rows))]
        place = range(self._rows)[row]
        number = int(np.searchsorted(self._firsts, place, side="right")) - 1
        if number != self._last[0]:
            self._last = number, self._split(_rows_of(self.raw, self.pieces[number]))
        cells = self._last[1]
        return cells[place - self.pieces[number].first]

    def numbers(self, parse: Callable[[list[str]], Array], *, decimal_comma: bool) -> Array:
        """Return the column as numbers (n,): by NumPy's reader, by `parse` where it stumbles."""
        rows = (_rows_of(self.raw, piece) for piece in self.pieces)
        return np.concatenate([self._numbers(each, parse, decimal_comma) for each in rows])

    def _numbers(
        self, rows: list[str], parse: Callable[[list[str]], Array], decimal_comma: bool
    ) -> Array:
        try:
            return np.loadtxt(
                [row.replace(",", ".") for row in rows] if decimal_comma else rows,
                dtype=np.float64,
                delimiter=self.mark,
                usecols=self.place,
                comments=None,
                ndmin=1,
            )
        except ValueError:
            return parse(self._split(rows))

    def _split(self, rows: list[str]) -> list[str]:
        cells = map(str.split, rows, repeat(self.mark), repeat(self.place + 1))
        return list(map(str.strip, map(itemgetter(self.place), cells)))


def joined_cells(columns: Sequence[Column]) -> Cells | None:
    """Return a column of several texts as one; None where one is not in memory."""
    parts: list[bytes] = []
    marks: set[tuple[int, str]] = set()
    for column in columns:
        if not isinstance(column, Cells):
            return None
        pieces = column.pieces
        if len(pieces) > 1:
            return None
        marks.add((column.place, column.mark))
        text = column.raw[pieces[0].start : pieces[0].end]
        parts.append(text if text.endswith(b"\n") else text + b"\n")
    if len(marks) > 1:
        return None
    raw = b"".join(parts)
    (place, mark), rows = marks.pop(), sum(map(len, columns))
    return Cells(raw, (_Piece(0, len(raw), 0),), rows, place, mark)


def arrange_cells(columns: Mapping[str, Cells], rows: Places) -> dict[str, Cells]:
    """Return some rows of columns of one text in an order of their own, in memory."""
    one = next(iter(columns.values()))
    lines = np.array([line for piece in one.pieces for line in _rows_of(one.raw, piece)], object)
    arranged = lines[rows]
    del lines
    stream, pieces = io.BytesIO(), []
    for first in range(0, len(rows), _TOGETHER):
        some, start = arranged[first : first + _TOGETHER], stream.tell()
        stream.write(_joined_lines(some))
        some[:] = None  # so that bytes take the place of lines
        pieces.append(_Piece(start, stream.tell(), first))
    raw = stream.getvalue()
    return {
        name: Cells(raw, pieces, len(rows), each.place, each.mark) for name, each in columns.items()
    }


def _joined_lines(lines: NDArray[np.object_]) -> bytes:
    return "".join(f"{line}\n" for line in lines.tolist()).encode()


def read_plain(raw: bytes) -> Plain | None:
    """Return the columns of a table in UTF-8; None where it is not as plain as that.

    Blank lines and comments are no rows.
    """
    found = _Pieces(raw)
    head = raw[0:_LINE]
    start = len(head) - len(head.lstrip(BOM_UTF8))
    while start < len(raw):
        end = _line_end(raw, start + _PIECE)
        if not found.take(start, end):
            return None
        start = end
    return found.plain() if found.rows and not found.wide else None


def _line_end(raw: bytes, place: int) -> int:
    """Return where the line ends that goes on at a place."""
    return raw.find(b"\n", place) + 1 or len(raw)


class _Pieces:
    """Take up the text piece by piece: its header, and where the rows are."""

    def __init__(self, raw: bytes) -> None:
        self._raw = raw
        self._header: list[str] = []
        self._mark, self._line = ",", 1
        self._pieces: list[_Piece] = []
        self._numbers: list[NDArray[np.int64]] = []
        self.rows = 0
        self.comments = False

    @property
    def wide(self) -> bool:
        """Whether the table is better taken apart once."""
        return len(self._header) > _WIDE and len(self._raw) < _SHORT

    def take(self, start: int, end: int) -> bool:
        """Take up a piece; tell whether it is UTF-8 and all its rows have all their cells."""
        raw = self._raw[start:end]
        if b'"' in raw or b"\0" in raw:
            return False
        try:
            text = _text(raw)
        except UnicodeDecodeError:
            return False
        kept, places = rows_of_text(text)
        begin = 0
        if kept and not self._header:
            self._take_header(kept[0])
            lines = raw.splitlines(keepends=True)
            start += sum(map(len, lines[: places[0] + 1]))
            begin, kept, places = places[0], kept[1:], places[1:]
        if kept:
            if set(map(methodcaller("count", self._mark), kept)) != {len(self._header) - 1}:
                return False
            self._pieces.append(_Piece(start, end, self.rows))
            self._numbers.append(self._line + np.asarray(places, dtype=np.int64))
            self.rows += len(kept)
        if not isinstance(places, range):
            count = len(self._header) - 1
            below = filter(is_comment, text.split("\n")[begin:])
            self.comments |= any(line.count(self._mark) == count for line in below)
        self._line += text.count("\n")
        return True

    def _take_header(self, line: str) -> None:
        self._mark = next((mark for mark in ";\t" if mark in line), ",")
        self._header = [cell.strip() for cell in line.split(self._mark)]

    def plain(self) -> Plain:
        """Return the table."""
        columns = [
            Cells(self._raw, self._pieces, self.rows, place, self._mark)
            for place in range(len(self._header))
        ]
        lines = np.concatenate(self._numbers)
        return Plain(self._header, columns, lines, self._mark, self.comments)


def unix_lines(raw: bytes) -> bytes:
    """Return whole lines that end as in Unix."""
    return raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in raw else raw


def _text(raw: bytes) -> str:
    return unix_lines(raw).decode("utf-8")


def _rows_of(raw: bytes, piece: _Piece) -> list[str]:
    return rows_of_text(_text(raw[piece.start : piece.end]))[0]


def rows_of_text(text: str) -> tuple[list[str], Sequence[int]]:
    """Return the rows of a text, and which of its lines they are, counted from 0."""
    lines = text.removesuffix("\n").split("\n") if text else []
    if not any(mark in text for mark in COMMENTS) and all(map(str.strip, lines)):
        return lines, range(len(lines))
    places = [place for place, line in enumerate(lines) if is_row(line)]
    return [lines[place] for place in places], places

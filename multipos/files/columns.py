"""Columns of a long text table: bytes, which become cells or numbers when they are asked for.

A cell that is a Python string takes ten times the memory of its characters, and most cells of a
long table are numbers of a column that is asked for once, or of one that nobody uses. So the bytes
stay as they were read, and a column is split out of them in pieces of some megabytes. This serves
plain text, in which every line is a row and has all its cells; quotes are for the `csv` module.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, repeat
from operator import itemgetter, methodcaller
from typing import NamedTuple, overload

import numpy as np

from multipos.numerics.arrays import Array

_PIECE = 1 << 22  # bytes
_WIDE = 100  # columns, from which on
_SHORT = 1 << 26  # fewer bytes are taken apart once: each column by itself would split all the text


class Plain(NamedTuple):
    """A table of plain text: its header and columns, and the line of the file of every row."""

    header: list[str]
    columns: list["Cells"]
    lines: Sequence[int]
    delimiter: str


class _Piece(NamedTuple):
    """Whole lines of the text, and how many rows came before them."""

    start: int
    end: int
    first: int


class Cells(Sequence[str]):
    """One column of the text, without the white space around its cells."""

    def __init__(self, raw: bytes, pieces: Sequence[_Piece], rows: int, place: int, mark: str):
        self._raw, self._pieces, self._rows = raw, pieces, rows
        self._place, self._mark = place, mark
        self._firsts = np.array([piece.first for piece in pieces])
        self._last: tuple[int, list[str]] = (-1, [])

    def __len__(self) -> int:
        return self._rows

    def __iter__(self) -> Iterator[str]:
        for piece in self._pieces:
            yield from self._split(_rows_of(self._raw, piece))

    @overload
    def __getitem__(self, row: int) -> str: ...

    @overload
    def __getitem__(self, row: slice) -> list[str]: ...

    def __getitem__(self, row: int | slice) -> str | list[str]:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(self._rows))]
        row = range(self._rows)[row]
        number = int(np.searchsorted(self._firsts, row, side="right")) - 1
        if number != self._last[0]:
            self._last = number, self._split(_rows_of(self._raw, self._pieces[number]))
        return self._last[1][row - self._pieces[number].first]

    def numbers(self, parse: Callable[[list[str]], Array], *, decimal_comma: bool) -> Array:
        """Return the column as numbers (n,): by NumPy's reader, by `parse` where it stumbles."""
        return np.concatenate(
            [
                self._numbers(_rows_of(self._raw, piece), parse, decimal_comma)
                for piece in self._pieces
            ]
        )

    def _numbers(
        self, rows: list[str], parse: Callable[[list[str]], Array], decimal_comma: bool
    ) -> Array:
        try:
            return np.loadtxt(
                [row.replace(",", ".") for row in rows] if decimal_comma else rows,
                dtype=np.float64,
                delimiter=self._mark,
                usecols=self._place,
                comments=None,
                ndmin=1,
            )
        except ValueError:
            return parse(self._split(rows))

    def _split(self, rows: list[str]) -> list[str]:
        cells = map(str.split, rows, repeat(self._mark))
        return list(map(str.strip, map(itemgetter(self._place), cells)))


def read_plain(raw: bytes) -> Plain | None:
    """Return the columns of a table in UTF-8; None where it is not as plain as that.

    Blank lines, and those that begin with ``#``, are no rows.
    """
    if b'"' in raw or b"\0" in raw:
        return None
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in raw:
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    found = _Pieces(raw)
    start = 0
    while start < len(raw):
        end = raw.find(b"\n", start + _PIECE) + 1 or len(raw)
        if not found.take(start, end):
            return None
        start = end
    return found.plain() if found.rows and not found.wide else None


class _Pieces:
    """Take up the text piece by piece: its header, and where the rows are."""

    def __init__(self, raw: bytes) -> None:
        self._raw = raw
        self._header: list[str] = []
        self._mark, self._line = ",", 1
        self._pieces: list[_Piece] = []
        self._numbers: list[Sequence[int]] = []
        self.rows = 0

    @property
    def wide(self) -> bool:
        """Whether the table is better taken apart once."""
        return len(self._header) > _WIDE and len(self._raw) < _SHORT

    def take(self, start: int, end: int) -> bool:
        """Take up a piece; tell whether it is UTF-8 and all its rows have all their cells."""
        try:
            text = self._raw[start:end].decode("utf-8")
        except UnicodeDecodeError:
            return False
        kept, places = _kept(text)
        if kept and not self._header:
            start = end - self._take_header(text, kept[0], places[0])
            kept, places = kept[1:], places[1:]
        if kept:
            if set(map(methodcaller("count", self._mark), kept)) != {len(self._header) - 1}:
                return False
            self._pieces.append(_Piece(start, end, self.rows))
            self._numbers.append(_shifted(places, self._line))
            self.rows += len(kept)
        self._line += text.count("\n")
        return True

    def _take_header(self, text: str, line: str, place: int) -> int:
        """Take the header from the line at a place; return how many bytes stand below it."""
        self._mark = next((mark for mark in ";\t" if mark in line), ",")
        self._header = [cell.strip() for cell in line.split(self._mark)]
        below = text.split("\n", place + 1)[place + 1 :]
        return sum(len(each.encode()) for each in below)

    def plain(self) -> Plain:
        """Return the table."""
        columns = [
            Cells(self._raw, self._pieces, self.rows, place, self._mark)
            for place in range(len(self._header))
        ]
        return Plain(self._header, columns, _joined(self._numbers), self._mark)


def _rows_of(raw: bytes, piece: _Piece) -> list[str]:
    return _kept(raw[piece.start : piece.end].decode("utf-8"))[0]


def _kept(text: str) -> tuple[list[str], Sequence[int]]:
    """Return the rows of a text, and which of its lines they are, counted from 0."""
    lines = text.removesuffix("\n").split("\n")
    if "#" not in text and all(map(str.strip, lines)):
        return lines, range(len(lines))
    places = [
        place
        for place, line in enumerate(lines)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    return [lines[place] for place in places], places


def _shifted(places: Sequence[int], line: int) -> Sequence[int]:
    if isinstance(places, range):
        return range(places.start + line, places.stop + line)
    return [place + line for place in places]


def _joined(numbers: Sequence[Sequence[int]]) -> Sequence[int]:
    """Return the line numbers of all rows, which take no memory where they follow each other."""
    first, count = numbers[0][0], sum(map(len, numbers))
    if numbers[-1][-1] - first + 1 == count:
        return range(first, first + count)
    return tuple(chain.from_iterable(numbers))

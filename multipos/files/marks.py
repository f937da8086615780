"""Marks in numbers, decided by the whole column: thousands, decimals, registers.

In ``16.586`` the point may stand between thousands or before decimals. No number tells which, but
its column does:

- a number that has the mark twice, ``1.234.567``, has thousands;
- a mark with other than three digits behind, or with a zero alone before, ``0.125``, is decimal,
  and so is the last one where a number has both, ``1.234,56``;
- a column that mixes numbers with three digits behind the mark and whole numbers below 1,000
  without one, ``16.586`` and ``-246``, has thousands; one in which every number has the mark has
  decimals, unless other columns of the table show thousands, as an axis that is never below 1,000
  beside two that are. A column of the surroundings, of one sign and within a factor of two, keeps
  its decimals, as does a time, which goes up: a temperature of ``25.312`` in every row stays.

A table has one decimal mark: what one column, or a comma between cells, settles holds for all.
Columns that contradict each other are refused by name.

Registers ``0x3F2A`` are whole numbers. Words of one length whose first digit reaches 8 are two's
complement of that length.

`may_have_marks` tells by the first rows whether a table has to be looked at, `read_marks` looks at
all of its rows, and `Marks.clean` writes a row so that `float` reads it; `cleaned_columns` does all
three. `number_in` is the one rule by which a cell of text is a number.
"""

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import listed
from multipos.results import frozen

_SIGNS = str.maketrans("\u2212\u2013\uff0d\uff0b\uff0e\uff0c", "---+.,")
_REGISTER = re.compile(r"[-+]?0[xX]([0-9a-fA-F]+)")
_GROUPS = {mark: re.compile(rf"[-+]?[1-9]\d{{0,2}}(\{mark}\d{{3}})+") for mark in ".,"}
_TWICE = {mark: re.compile(rf"[-+]?\d+\{mark}\d+\{mark}") for mark in ".,"}
_SMALL = re.compile(r"[-+]?\d{1,3}")
_NUMBER = re.compile(r"[-+]?(\d[\d.,]*|[.,]\d+)([eE][-+]?\d+)?")
_WITHIN = 2.0  # times its smallest number, a column of the surroundings keeps below
_TIMES = 9  # rows from which on a column that goes up is a time
_FEWEST = 2  # rows that tell of a column


def number_in(cell: str, *, decimal_comma: bool = False) -> float:
    """Return the number that a cell is, NaN where it is none; digits and signs of any script."""
    try:
        value = float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        plain = cell.translate(_SIGNS)
        if plain != cell:
            return number_in(plain, decimal_comma=decimal_comma)
        register = _REGISTER.fullmatch(cell)
        return float(int(cell, 16)) if register else math.nan
    return math.nan if "_" in cell else value


@frozen
class Marks:
    """The marks of a table's numbers.

    Attributes
    ----------
    thousands : tuple of str
        The mark between thousands in each column; '' where it has none.
    bits : tuple of int
        Of the words of each column of registers; 0 where it has none, -1 of several lengths.
    signed : tuple of bool
        Which of them are two's complement.
    decimal : str
        The decimal mark.
    """

    thousands: tuple[str, ...]
    bits: tuple[int, ...]
    signed: tuple[bool, ...]
    decimal: str

    def __bool__(self) -> bool:
        return any(self.thousands) or any(self.bits)

    def clean(self, cells: Sequence[str]) -> list[str]:
        """Return the cells of a row without marks between thousands, registers as numbers."""
        if len(cells) != len(self.thousands):
            return [*cells]
        return [self._cleaned(cell, place) for place, cell in enumerate(cells)]

    def _cleaned(self, cell: str, place: int) -> str:
        if self.bits[place] and _REGISTER.fullmatch(cell):
            value = int(cell, 16)
            half = 1 << max(self.bits[place] - 1, 0)
            return str(value - 2 * half if self.signed[place] and value >= half else value)
        plain = cell.translate(_SIGNS)
        if not _NUMBER.fullmatch(plain):
            return cell
        mark = self.thousands[place]
        plain = plain.replace(mark, "") if mark else plain
        return plain.replace(",", ".") if self.decimal == "," else plain

    def said(self, names: Sequence[str]) -> str:
        """Return in words what was taken off."""
        by_mark = {".": "points", ",": "commas"}
        parts = []
        for mark, word in by_mark.items():
            columns = [name for name, own in zip(names, self.thousands, strict=True) if own == mark]
            if columns:
                parts.append(f"{word} in {listed(columns, 6)} stand between thousands")
        registers = [name for name, bits in zip(names, self.bits, strict=True) if bits]
        if registers:
            size = {bits for bits, signed in zip(self.bits, self.signed, strict=True) if signed}
            unsigned = "numbers without a sign (--signed BITS gives them one)"
            kind = f"two's complement of {max(size)} bits" if size else unsigned
            parts.append(f"registers in {listed(registers, 6)} are {kind}")
        return "; ".join(parts)


def is_grouped(cell: str, *, commas_between: bool = False) -> bool:
    """Tell whether a cell is a register, or a number with marks that only thousands can have.

    Where commas stand between cells, one in a cell is such a mark.
    """
    plain = cell.translate(_SIGNS)
    both = "." in plain and "," in plain and _NUMBER.fullmatch(plain) is not None
    grouped = [mark for mark in ".," if _GROUPS[mark].fullmatch(plain)]
    sure = any(_TWICE[mark].match(plain) or (mark == "," and commas_between) for mark in grouped)
    return both or sure or _REGISTER.fullmatch(plain) is not None


def may_have_marks(columns: Iterable[Sequence[str]]) -> bool:
    """Tell by the first cells of columns whether they may be of thousands, or registers."""
    return any(map(_is_suspect, columns))


def _is_suspect(cells: Sequence[str]) -> bool:
    """Tell whether a column may be one of registers or of thousands."""
    plain = [cell.translate(_SIGNS) for cell in cells]
    if any(_REGISTER.fullmatch(cell) for cell in plain):
        return True
    plain = [cell for cell in plain if _NUMBER.fullmatch(cell)]
    if not plain:
        return False
    for mark in ".,":
        if all(_SMALL.fullmatch(cell) or _GROUPS[mark].fullmatch(cell) for cell in plain):
            return any(mark in cell for cell in plain)
    return any("." in cell and "," in cell and _NUMBER.fullmatch(cell) for cell in plain)


class _Column:
    """What the numbers of a column have shown so far."""

    def __init__(self) -> None:
        self.rows = self.small = self.registers = 0
        self.grouped = {".": 0, ",": 0}  # three digits behind the mark, once
        self.twice = {".": 0, ",": 0}
        self.decimal = {".": 0, ",": 0}
        self.large = False  # whole numbers from 1,000 on without a mark
        self.lengths: set[int] = set()
        self.high = False  # a register whose first digit reaches 8
        self.least, self.most = math.inf, -math.inf
        self.last, self.rises = -math.inf, True

    def take(self, cell: str) -> None:
        """Take up a cell."""
        register = _REGISTER.fullmatch(cell)
        if register:
            self.registers += 1
            self.lengths.add(len(register[1]))
            self.high |= register[1][0] in "89abcdefABCDEF"
            return
        if not _NUMBER.fullmatch(cell):
            return
        self.rows += 1
        if "." in cell and "," in cell:
            last = max(".,", key=cell.rindex)
            self.decimal[last] += 1
            self.twice["." if last == "," else ","] += 1
            return
        mark = next((each for each in ".," if each in cell), "")
        if not mark:
            # a zero is written so beside decimals too
            self.small += _SMALL.fullmatch(cell) is not None and int(cell) != 0
            self.large |= _SMALL.fullmatch(cell) is None
        elif _TWICE[mark].match(cell):
            self.twice[mark] += 1
        elif _GROUPS[mark].fullmatch(cell):
            self.grouped[mark] += 1
            value = float(cell.replace(",", "."))
            self.rises &= value >= self.last
            self.last = value
            self.least, self.most = min(self.least, value), max(self.most, value)
        else:
            self.decimal[mark] += 1

    def mixes(self, mark: str) -> bool:
        """Tell whether numbers show thousands: by two marks, or by whole numbers beside them."""
        if self.twice[mark]:
            return True
        once = self.grouped[mark] and self.small and not self.large
        return bool(once) and not self.decimal[mark] and self.rows >= _FEWEST

    def is_only(self, mark: str) -> bool:
        """Tell whether every number has the mark, with three digits behind."""
        return self.rows > 0 and self.grouped[mark] == self.rows

    @property
    def keeps(self) -> bool:
        """Whether numbers are of one sign and within a factor of two, or go up as a time does."""
        size = sorted((abs(self.least), abs(self.most)))
        near = self.least * self.most > 0.0 and size[1] < _WITHIN * size[0]
        return near or (self.rises and self.rows > _TIMES)


def read_marks(
    source: str, names: Sequence[str], rows: Iterable[Sequence[str]], *, commas_between: bool
) -> Marks:
    """Return the marks of a table, from all of its rows.

    Parameters
    ----------
    source : str
        For messages.
    names : sequence of str
        Of the columns.
    rows : iterable of sequences of str
    commas_between : bool
        Whether commas stand between cells, so that the point is the decimal mark.

    Raises
    ------
    MultiposError
        Columns contradict each other.
    """
    columns = [_Column() for _ in names]
    for row in rows:
        if len(row) == len(columns):
            for column, cell in zip(columns, row, strict=True):
                column.take(cell.translate(_SIGNS))
    settled = {
        mark: [name for name, each in zip(names, columns, strict=True) if each.decimal[mark]]
        for mark in ".,"
    }
    if settled["."] and settled[","]:
        raise MultiposError(
            f"{source}: column '{settled['.'][0]}' has decimal points and column "
            f"'{settled[','][0]}' decimal commas; write one of them in all."
        )
    mark = _thousands(source, names, columns, settled, commas_between=commas_between)
    thousands = tuple(mark if mark and _has_thousands(each, mark) else "" for each in columns)
    return Marks(
        thousands,
        tuple(_bits(each) for each in columns),
        tuple(each.high and len(each.lengths) == 1 for each in columns),
        "," if settled[","] or mark == "." else ".",
    )


def _thousands(
    source: str,
    names: Sequence[str],
    columns: Sequence[_Column],
    settled: dict[str, list[str]],
    *,
    commas_between: bool,
) -> str:
    """Return the mark between thousands, '' where none is."""
    for mark in ".,":
        mixing = [name for name, each in zip(names, columns, strict=True) if each.mixes(mark)]
        twice = [name for name, each in zip(names, columns, strict=True) if each.twice[mark]]
        if settled[mark] and twice:
            raise MultiposError(
                f"{source}: column '{twice[0]}' has '{mark}' between thousands and column "
                f"'{settled[mark][0]}' before decimals; write one decimal mark in all."
            )
        if mixing and not settled[mark] and (mark == "," or not commas_between or twice):
            return mark
    return ""


def _has_thousands(column: _Column, mark: str) -> bool:
    return column.mixes(mark) or (column.is_only(mark) and not column.keeps)


def _bits(column: _Column) -> int:
    if not column.registers:
        return 0
    return 4 * max(column.lengths) if len(column.lengths) == 1 else -1


def cleaned_columns(
    source: str, columns: dict[str, list[str]], *, commas_between: bool, decimal_commas: bool
) -> tuple[dict[str, list[str]], str]:
    """Return columns whose numbers have no marks but the decimal point, and what is said of it."""
    names, rows = [*columns], [*zip(*columns.values(), strict=True)]
    if not (decimal_commas or may_have_marks(cells[:_SAMPLE] for cells in columns.values())):
        return columns, ""
    marks = read_marks(source, names, rows, commas_between=commas_between)
    if not (marks or decimal_commas):
        return columns, ""
    cells = np.array([*map(marks.clean, rows)], dtype=object).T.tolist()
    return dict(zip(names, cells, strict=True)), marks.said(names)


_SAMPLE = 1000  # rows that tell whether a column is looked at as a whole

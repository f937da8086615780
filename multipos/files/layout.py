"""Where the table of a text begins, and how its rows are cut into cells.

`find_layout` returns it from the first lines of a table or a log; `cells_of`, `has_open_quote`,
`is_number` and `number_of` are how one line and one cell are read, `units_in` a line of
units, `goes_up` a column of times.

A text may begin with lines that are no table: what wrote it, with which settings, in which units.
What a row is tell the rows farther down: how many cells they have and which of them are numbers.
The first line that is so begins the table; its header is the nearest line above that names as many
columns, behind ``#``, ``//`` or ``%`` too, and between the two may stand a line of units. Lines
that a program printed (`multipos.files.printed`) become rows first.
"""

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.marks import is_grouped, number_in
from multipos.files.printed import DATE, Printed, Records, find_printed, holds_number, is_comment
from multipos.files.written_units import split_unit, unit_of
from multipos.numerics.arrays import Array
from multipos.results import frozen

_LAST = 50  # rows that tell what a row is
_SHARE = 3  # a column holds numbers where at least one cell in three is one
_STATED = re.compile(r'"?sep=(.)"?\s*')
_RATE = re.compile(
    r"(?:rate|sampl\w*|freq\w*|\bat)\b(?:[^\d\n]*?(\d+(?:\.\d+)?)\s*Hz\b"
    r"|\W*Hz\W+(\d+(?:\.\d+)?))",
    re.IGNORECASE,
)
_UNITLESS = ("", "-", "none", "no_units", "n/a")
_KNOWN = re.compile(r"(time.*|t|.*acc.*|[a-z_. ]*[xyz])", re.IGNORECASE)


class Line(NamedTuple):
    """A line of the file, counted from 1."""

    number: int
    text: str


@frozen(eq=True)
class Layout:
    """How the rows of a text are laid out.

    Attributes
    ----------
    delimiter : str
        '' is white space.
    width : int
        Columns.
    trailing : bool
        Whether a separator stands behind the last cell too.
    decimal_comma : bool
    header : tuple of str or None
        What stands in the header, without white space; '' is no name.
    units : tuple of str or None
        Of each column; '' where none is stated.
    numeric, dates : tuples of bool
        Which columns hold numbers, and dates.
    below : int
        Line below the header and its units; 1 without.
    first : int
        Line of the first row.
    rising : bool
        Whether the first column goes up in the first rows, and not by ones.
    rate : float or None [Hz]
        Sample rate, where a line above the table tells one.
    begins : str
        In words where the table begins, if that is not where one looks for it; '' otherwise.
    printed : Printed or None
        How the records are printed of which these are the rows.
    """

    delimiter: str
    width: int
    trailing: bool
    decimal_comma: bool
    header: tuple[str, ...] | None
    units: tuple[str, ...]
    numeric: tuple[bool, ...]
    dates: tuple[bool, ...]
    below: int
    first: int
    rising: bool
    rate: float | None
    begins: str
    printed: Printed | None

    @property
    def in_words(self) -> str:
        """How the rows stand in the text."""
        if self.printed is not None:
            return self.printed.said
        marks = {",": "commas", ";": "semicolons", "\t": "tabs", "": "blanks"}
        between = marks.get(self.delimiter, f"'{self.delimiter}'")
        header = "no header" if self.header is None else f"header above line {self.below}"
        return f"{self.width} columns between {between}, {header}"

    def is_like_a_row(self, line: str) -> bool:
        """Tell whether a comment has as many cells as a row, and numbers where it has."""
        cells = cells_of(line, self.delimiter)
        pairs = zip(cells, self.numeric, strict=False)
        numbers = [is_number(cell, self.delimiter) for cell, numeric in pairs if numeric]
        return len(cells) == self.width and any(numbers) and sum(numbers) >= len(numbers) - 1

    @property
    def names(self) -> tuple[str, ...]:
        """The header; of a table without one the numbers of its columns."""
        return self.header or tuple(map(str, range(1, self.width + 1)))


def find_layout(source: str, lines: Sequence[str], *, needs: str = "a log needs samples") -> Layout:
    """Return how the rows of a text are laid out, from its first lines.

    Raises
    ------
    MultiposError
        There is no row, or the header does not fit the rows; the message ends in what is needed.
    """
    printed = find_printed(lines)
    if printed is None:
        return _laid_out(source, lines, None, needs)
    rows = [*Records(printed).text(lines)]
    return replace(_laid_out(source, rows, printed.names, needs), printed=printed)


def _laid_out(source: str, lines: Sequence[str], names: Sequence[str] | None, needs: str) -> Layout:
    """Return how rows are laid out; names are given where no line holds them."""
    stated, table = _stated(lines)
    rows = [line for line in table if not is_comment(line.text)]
    if not rows:
        raise MultiposError(f"{source}: no rows in its first lines; {needs}.")
    last = [line.text for line in rows[-_LAST:]]
    mark = _separator(rows[0].text, last) if stated is None else stated
    shape = _shape([cells_of(line, mark) for line in last], mark)
    if not shape.numbers and len(rows) == 1:
        raise MultiposError(f"{source}: only a header, no rows; {needs}.")
    begin = _first_row(rows, shape).number
    above = [line for line in table if line.number < begin]
    shape, header = _headed(source, above, shape)
    body = _body(rows, begin, shape)
    if not body:
        raise MultiposError(f"{source}: no row has all its numbers; {needs}.")
    if names and len(names) == shape.columns:
        header = header._replace(
            cells=(*names,), units=tuple(split_unit(name)[1] or "" for name in names)
        )
    columns = [list(filter(None, column)) for column in zip(*body, strict=True)]
    return Layout(
        delimiter=mark,
        width=shape.columns,
        trailing=shape.trailing,
        decimal_comma=mark != "," and any("," in row[i] for row in body for i in shape.numbers),
        header=header.cells,
        units=header.units,
        numeric=tuple(_mostly([is_number(cell, mark) for cell in cells]) for cells in columns),
        dates=tuple(_mostly([DATE.fullmatch(cell) for cell in cells]) for cells in columns),
        below=header.below,
        first=begin,
        rising=goes_up(np.array([number_of(row[0], mark) for row in body], dtype=np.float64)),
        rate=_stated_rate(above),
        begins=_begins(above, begin, header),
        printed=None,
    )


def _mostly(units_found: Sequence[object]) -> bool:
    """Tell whether half of the cells are of a kind: a bad one is an error, where it is used."""
    return any(units_found) and 2 * sum(map(bool, units_found)) >= len(units_found)


def _stated(lines: Sequence[str]) -> tuple[str | None, list[Line]]:
    """Return the separator that a first line ``sep=;`` states, and the lines that are not empty."""
    numbered = [Line(i, line) for i, line in enumerate(lines, start=1) if line.strip()]
    found = _STATED.fullmatch(numbered[0].text) if numbered else None
    return (None, numbered) if found is None else (found[1].strip(" "), numbered[1:])


def _body(rows: Sequence[Line], begin: int, shape: "_Shape") -> list[list[str]]:
    """Return the cells of the first rows, of those that have as many as they should."""
    first = islice((line.text for line in rows if line.number >= begin), _LAST)
    cells = [cells_of(row, shape.mark) for row in first]
    return [row[: shape.columns] for row in cells if len(row) == shape.cells]


def _stated_rate(above: Sequence[Line]) -> float | None:
    found = [rate for line in above if (rate := _RATE.search(line.text))]
    return float(found[0][1] or found[0][2]) if found else None


def _begins(before: Sequence[Line], begin: int, header: "_Header") -> str:
    """Return where the table is, if that is not where one looks for it."""
    skipped = [line for line in before if line.number != header.line]
    if not header.commented and all(is_comment(line.text) for line in skipped):
        return ""
    where = f"its header on line {header.line}" if header.cells else "without a header"
    return f"the table begins on line {begin}, {where}"


def cells_of(line: str, mark: str) -> list[str]:
    """Return the cells of one line, without white space around them."""
    if not mark:
        return line.rstrip("; ").split()
    cells = line.split(mark)
    if '"' in line:
        with suppress(csv.Error):
            cells = next(csv.reader([line], delimiter=mark), [])
    return [cell.strip(" \t\r'") for cell in cells]


def has_open_quote(line: str, mark: str) -> bool:
    """Tell whether a quote of a line is not closed, where quotes stand around cells."""
    return mark != "" and line.count('"') % 2 > 0


def number_of(cell: str, mark: str) -> float | None:
    """Return the number in a cell, 'nan' too; with a decimal comma where none separates."""
    value = number_in(cell, decimal_comma=mark != ",")
    return None if math.isnan(value) and cell.casefold().strip("+-") != "nan" else value


def is_number(cell: str, mark: str) -> bool:
    """Tell whether a cell is a number, also one with marks between thousands."""
    return number_of(cell, mark) is not None or is_grouped(cell, commas_between=mark == ",")


def _separator(head: str, rows: Sequence[str]) -> str:
    """Return what stands between cells: as many times as in a header, or what leaves most numbers.

    Where nothing separates and there is no number, a row is one cell.
    """
    for mark in ";\t,|":
        names = cells_of(head, mark)
        even = sum(len(cells_of(row, mark)) == len(names) for row in rows)
        if len(names) > 1 and even == len(rows) and not any(map(holds_number, names)):
            return mark

    def numbers(mark: str) -> int:
        return sum(is_number(cell, mark) for row in rows for cell in cells_of(row, mark))

    present = [mark for mark in ";\t,|" if any(mark in row for row in rows)]
    best = max([*present, ""], key=numbers)  # the first of those that are as good
    return best if best or numbers("") else ","


class _Shape(NamedTuple):
    """What rows have in common."""

    mark: str
    cells: int
    trailing: bool
    numbers: tuple[int, ...]  # columns

    @property
    def columns(self) -> int:
        return self.cells - self.trailing

    def fits(self, cells: Sequence[str]) -> bool:
        """Tell whether cells are a row: more than half of the numbers are there."""
        if len(cells) != self.cells:
            return False
        held = [cells[i] for i in self.numbers]
        good = sum(is_number(cell, self.mark) for cell in held)
        return good > 0 and 2 * (good + held.count("")) > len(held)


def _shape(rows: Sequence[list[str]], mark: str) -> _Shape:
    counts = Counter(map(len, rows))
    width = max(counts, key=lambda count: (counts[count], count))
    same = [row for row in rows if len(row) == width]
    held = np.array([[is_number(cell, mark) for cell in row] for row in same])
    numbers = np.flatnonzero(_SHARE * held.sum(axis=0) >= len(same)).tolist()
    ends = [same[i][-1] for i in np.flatnonzero(held.any(axis=1)).tolist()]
    trailing = mark != "" and width > 1 and ends != [] and not any(ends)
    return _Shape(mark, width, trailing, tuple(numbers))


def _first_row(rows: Sequence[Line], shape: _Shape) -> Line:
    """Return the first row of the table; of one without numbers, the line after its header."""
    if not shape.numbers:
        return rows[min(1, len(rows) - 1)]
    first = next((row for row in rows if shape.fits(cells_of(row.text, shape.mark))), rows[-1])
    if first == rows[0] and len(rows) > 1 and _named_by_numbers(first, shape):
        return rows[1]
    return first


def _named_by_numbers(row: Line, shape: _Shape) -> bool:
    """Tell whether a row is a header in which columns have whole numbers: time,1,2,3."""
    cells = cells_of(row.text, shape.mark)
    held = [cells[i] for i in shape.numbers]
    texts = [cell for cell in held if not is_number(cell, shape.mark)]
    numbers = [cell for cell in held if cell not in texts]
    if not any(texts):  # columns of text may stand beside
        return len(numbers) > 1 and numbers == [str(i) for i in range(1, len(numbers) + 1)] != cells
    return all(map(str.isdigit, numbers))


class _Header(NamedTuple):
    """The header that was found."""

    cells: tuple[str, ...] | None
    units: tuple[str, ...]
    line: int
    below: int  # of it and of the line of its units
    commented: bool


def _headed(source: str, above: Sequence[Line], shape: _Shape) -> tuple[_Shape, _Header]:
    """Return the header, and the shape of the rows as it settles it.

    Cells that are always empty may be those of a column, or what a last separator leaves.
    """
    if shape.trailing:
        whole = shape._replace(trailing=False)
        header = _header(source, above, whole)
        if header.cells and header.cells[-1]:
            return whole, header
    header = _header(source, above, shape)
    if header.cells is None and above and not is_comment(above[-1].text):
        _refuse_other_width(source, above[-1], shape)
    return shape, header


def _header(source: str, above: Sequence[Line], shape: _Shape) -> _Header:
    """Return the nearest line that names columns, rather one that holds no number."""
    units, below, best = tuple[str, ...](), 0, None
    for line in reversed(above):
        bare, comment = _bare(line.text)
        cells = _names(bare, shape, comment=comment)
        if cells is None:
            if not comment:
                break
        elif not units and line is not above[0] and (units_found := units_in(cells)):
            units, below = units_found, line.number + 1
        else:
            _refuse_open_quote(source, line)
            named = units or tuple(split_unit(name)[1] or "" for name in cells)
            found = _Header(cells, named, line.number, below or line.number + 1, comment)
            if not any(is_number(cell, ",") for cell in cells):
                return found
            best = best or found
    return best or _Header(None, units or ("",) * shape.columns, 0, 1, False)


def _refuse_open_quote(source: str, line: Line) -> None:
    if has_open_quote(line.text, '"'):
        raise MultiposError(
            f"{source}: line {line.number}: a quote is not closed; check the quotes of that line."
        )


def _bare(line: str) -> tuple[str, bool]:
    """Return a line without its comment mark, and whether it had one."""
    stripped = line.strip(" \r\n")  # a tabulator at its begin stands behind a cell
    commented = is_comment(line)
    return stripped.lstrip("#/%").strip() if commented else stripped, commented


def _names(line: str, shape: _Shape, *, comment: bool) -> tuple[str, ...] | None:
    """Return the names of the columns that a line holds, None where it is no header."""
    marks = [shape.mark, *((",", ";", "\t", "") if comment else ())]
    for mark in dict.fromkeys(marks):
        cells = cells_of(line, mark)
        if len(cells) == shape.columns + 1 and not cells[-1]:
            cells = cells[:-1]
        known = sum(_KNOWN.fullmatch(cell) is not None for cell in cells)
        sentence = comment and not mark and 2 * known <= len(cells)
        if len(cells) == shape.columns and not sentence and _may_name(cells, shape):
            return tuple(cells)
    return None


def _may_name(cells: Sequence[str], shape: _Shape) -> bool:
    """Tell whether cells may be names: of the numbers among them all are whole."""
    numbers = [cells[i] for i in shape.numbers if is_number(cells[i], ",")]
    return any(re.search(r"\w", cell) for cell in cells) and all(map(str.isdigit, numbers))


def units_in(cells: Sequence[str]) -> tuple[str, ...] | None:
    """Return units, where all cells are units."""
    bare = [cell[1:-1] if cell[:1] in ("(", "[") else cell for cell in cells]
    units_found = ["" if cell.casefold() in _UNITLESS else unit_of(cell) for cell in bare]
    if None in units_found or not any(units_found):
        return None
    return tuple(unit or "" for unit in units_found)


def _refuse_other_width(source: str, line: Line, shape: _Shape) -> None:
    """Refuse a header that names one column more or less than there are."""
    cells = cells_of(line.text, shape.mark)
    if len(cells) < 3 or abs(len(cells) - shape.columns) > 1:
        return
    if not any(is_number(cell, shape.mark) for cell in cells):
        raise MultiposError(
            f"{source}: line {line.number} names {len(cells)} columns, the last '{cells[-1]}', but "
            f"the rows below have {shape.columns} cells; correct it, or remove it and give "
            "--columns."
        )


def goes_up(values: Array) -> bool:
    """Tell whether numbers (n,) go up, and not by ones, as a time does."""
    with np.errstate(over="ignore", invalid="ignore"):  # between infinities
        steps = np.diff(values)
    rising = len(steps) > 1 and (steps >= 0.0).all() and steps.any()
    return bool(rising and (steps != 1.0).any())

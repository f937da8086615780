"""Numbers as a report prints them: aligned at the point, with a minus sign, no powers in letters.

`readable` rewrites one cell, `aligned_rows` a table. They serve every form that people read;
programs read JSON and XML.
"""

import re
from collections.abc import Sequence

from multipos.files import numbers
from multipos.reports.sections import PageTable

_FIGURE, _POINT = "\u2007", "\u2008"  # spaces as wide as a digit and as a point
_PLAIN = re.compile(r"[-+]?\d+(?P<rest>(?:\.\d+)?)(?:\(\d+\))?")
_POWER = re.compile(r"(?<![\w.])([-+]?\d+(?:\.\d+)?(?:\(\d+\))?)e([-+]?\d+)(?!\w|\.\w)")
_UNIT = re.compile(r"(/[A-Za-z]+)\^(\d)(?!\d)")  # of a unit; a formula stays as it is typed
_MINUS = re.compile(r"(^|[\[( ])-(?=\d)")  # elsewhere it may be a date or a name
_ZERO = re.compile(r"(^|[\[( ])-(?=0(?:\.0+)?(?![\d.]))")  # what rounds to it has no sign
_CELSIUS = re.compile(r"(?<=[/\[])degC\b")
_DEGREES = re.compile(r"(?<=\[)deg(?=\])|^deg$")


def aligned_rows(grid: PageTable, figure: str = _FIGURE, point: str = _POINT) -> list[list[str]]:
    """Return the rows of a table, filled up by spaces as wide as a figure and as a point."""
    columns = [list(column) for column in zip(*grid.rows, strict=True)]
    shown = [
        [readable(cell) for cell in column]
        if place < grid.left
        else _aligned(column, figure, point)
        for place, column in enumerate(columns)
    ]
    return [list(row) for row in zip(*shown, strict=True)]


def readable(text: str) -> str:
    """Return a cell with powers, units and infinity as people write them."""
    text = _POWER.sub(lambda m: f"{m[1]}×10{str(int(m[2])).translate(numbers.SUPERSCRIPT)}", text)
    text = _DEGREES.sub("°", _CELSIUS.sub("°C", text))
    text = _UNIT.sub(lambda m: m[1] + m[2].translate(numbers.SUPERSCRIPT), text)
    if text == "inf":
        return "∞"
    return _MINUS.sub(r"\1−", _ZERO.sub(r"\1", text))


def _aligned(column: Sequence[str], figure: str, space: str) -> list[str]:
    """Return a column of numbers, each filled up on the right to the longest behind its point."""
    found = [_PLAIN.fullmatch(cell) for cell in column]
    longest = max((len(match["rest"]) for match in found if match), default=0)
    cells = []
    for cell, match in zip(column, found, strict=True):
        behind = len(match["rest"]) if match else longest
        fill = figure * (longest - max(behind, 1)) if longest > behind else ""
        point = space if longest and match and not match["rest"] else ""
        cells.append(readable(cell) + point + fill)
    return cells

"""What a report is made of: sections of paragraphs, figures and tables.

Numbers are text here, with the digits that their uncertainty leaves; figures are functions and
drawn only where they are wanted, by `draw_svg`. `chosen_rows` picks the rows of a table,
`shortened` keeps the largest of a long one, which by `with_annex` an annex has in full;
`method_section` says how something was done, `worded_section` rewords a section for the sensor of
another field, and `template` reads a file of the folder of templates.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.files.numbers import largest_rows, table
from multipos.results import frozen
from multipos.sensor.gravity import Field


def template(name: str) -> str:
    """Return a file of the folder of templates."""
    return (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")


_WIDTH = 4.5  # inches of a figure, whose type can be read on a telephone
LONG_TABLE = 24  # rows of a table in the body of a report; a longer one stands in its annex
_WHOLE = 400  # rows of a table in the annex


@frozen(eq=True)
class PageTable:
    """A table: its caption, header and rows of text; the first `left` columns hold words.

    Of a long one the body of the report shows the rows `kept`, else the first, and the last `foot`.
    What follows from what stands elsewhere is not `on_paper`.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1
    on_paper: bool = True
    kept: tuple[int, ...] = ()
    foot: int = 0

    def __str__(self) -> str:
        return table(self.header, self.rows, left=self.left)


@frozen(eq=True)
class Figure:
    """A figure: caption, what it shows in words, and the function that draws it as SVG."""

    caption: str
    description: str
    draw: Callable[[], str]


@frozen(eq=True)
class Section:
    """A section of the report, in the order paragraphs, figures, tables."""

    title: str
    paragraphs: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[PageTable, ...] = ()


def worded_section(section: Section, field: Field) -> Section:
    """Return a section as it is said of a sensor of a field; the rows of its tables stay."""

    def said(texts: Iterable[str]) -> tuple[str, ...]:
        return tuple(field.worded(text) for text in texts)

    figures = []
    for figure in section.figures:
        caption, description = said((figure.caption, figure.description))
        figures.append(replace(figure, caption=caption, description=description))
    tables = [
        replace(table, caption=field.worded(table.caption), header=said(table.header))
        for table in section.tables
    ]
    title = field.worded(section.title)
    return Section(title, said(section.paragraphs), tuple(figures), tuple(tables))


def method_section(rows: Iterable[tuple[str, str]]) -> Section:
    """Return the section on how something was done."""
    header = ("Item", "Value")
    table = PageTable("How it was done", header, tuple(rows), left=2)
    return Section("Method and data", tables=(table,))


def draw_svg(height: float, *panels: Callable[[Any], object]) -> str:
    """Return a figure of panels of a height, each drawn on its own axes, as SVG."""
    # Imported here: a sentence on the screen needs no figure.
    from multipos.plots.style import figure_of, to_svg

    return to_svg(figure_of(panels, width=_WIDTH, height=height))


def chosen_rows(sizes: NDArray[np.float64]) -> tuple[list[int], tuple[int, ...], str]:
    """Return the rows that a table takes, those that its body keeps, and what its caption adds."""
    largest = tuple(largest_rows(sizes.tolist(), LONG_TABLE))
    if len(sizes) <= _WHOLE:
        return list(range(len(sizes))), largest if len(sizes) > LONG_TABLE else (), ""
    more = f" (the {LONG_TABLE} largest of {len(sizes)}; the calibration file has all)"
    return list(largest), (), more


def shortened(grid: PageTable, where: str) -> PageTable:
    """Return a table with the largest rows of a long one, and in its caption where all are."""
    count = len(grid.rows) - grid.foot
    if count <= LONG_TABLE:
        return grid
    kept = [*(grid.kept or range(LONG_TABLE)), *range(count, len(grid.rows))]
    which = f"{LONG_TABLE} largest" if grid.kept else f"first {LONG_TABLE}"
    caption = f"{grid.caption} (the {which} of {count}; {where})"
    return replace(grid, caption=caption, rows=tuple(grid.rows[row] for row in kept))


def with_annex(
    sections: Iterable[Section], more: tuple[PageTable, ...] = ()
) -> tuple[Section, ...]:
    """Return the sections with the largest rows of long tables, which an annex has in full.

    Before these it has tables of its own.
    """
    given = tuple(sections)
    short = {id(t): shortened(t, "all in the annex") for part in given for t in part.tables}
    long = tuple(t for part in given for t in part.tables if short[id(t)] is not t)
    whole = (*more, *long)
    body = tuple(replace(part, tables=tuple(short[id(t)] for t in part.tables)) for part in given)
    return (*body, Section("Annex", tables=whole)) if whole else body

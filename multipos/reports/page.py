"""What a report is made of: sections of paragraphs, figures and tables.

Numbers are text here, with the digits that their uncertainty leaves. Figures are functions and
drawn only where they are wanted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.files.numbers import largest_rows
from multipos.plots.style import new_figure, to_svg
from multipos.reports.translations import Translator

_SHOWN = " (the {shown} largest of {count}; the calibration file has all)"


@dataclass(frozen=True)
class PageTable:
    """A table: its caption, header and rows of text; the first `left` columns hold words.

    What says again what stands elsewhere is not `on_paper`.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1
    on_paper: bool = True


@dataclass(frozen=True)
class Figure:
    """A figure: caption, what it shows in words, and the function that draws it as SVG.

    What shows again what a table holds is not `on_paper`.
    """

    caption: str
    description: str
    draw: Callable[[], str]
    on_paper: bool = True


@dataclass(frozen=True)
class Section:
    """A section of the report, in the order paragraphs, figures, tables."""

    title: str
    paragraphs: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[PageTable, ...] = ()
    on_paper: bool = True


def draw_svg(tr: Translator, rows: int, height: float, draw: Callable[[Any], None]) -> str:
    """Return a figure of so many axes as SVG with its words translated."""
    figure, axes = new_figure(rows, height=height)
    draw(axes)
    return to_svg(figure, tr.label)


def largest_positions(tr: Translator, sizes: NDArray[np.float64]) -> tuple[list[int], str]:
    """Return the positions that a table shows, and what its title says where it leaves some out."""
    shown = largest_rows(sizes.tolist())
    if len(shown) == len(sizes):
        return shown, ""
    return shown, tr(_SHOWN, shown=str(len(shown)), count=str(len(sizes)))

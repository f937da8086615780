"""The marks of figures: what a series of numbers looks like, in its own colour.

`draw_points` draws points, each with a bar of its uncertainty where that is given, `draw_line` a
line through points, and `draw_band` what lies about a line. A series has a number, which gives its
colour and its marker; `look` is what Matplotlib is to do otherwise.
"""

from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from multipos.numerics.arrays import Array
from multipos.plots.style import COLOURS, MARKERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_points(
    axes: "Axes", x: ArrayLike, y: ArrayLike, series: int, label: str | None = None, **look: Any
) -> None:
    """Draw points in the marker of a series; `xerr` or `yerr` gives them bars."""
    look = {"marker": MARKERS[series % 8], "linestyle": "none", **look}
    if "xerr" in look or "yerr" in look:
        bars = {"elinewidth": 0.8, "capsize": 0.0}
        axes.errorbar(x, y, **_in_colour(series, label, bars | look))
    else:
        axes.plot(x, y, **_in_colour(series, label, look))


def draw_line(
    axes: "Axes", x: ArrayLike, y: ArrayLike, series: int, label: str | None = None, **look: Any
) -> None:
    """Draw a line through points."""
    axes.plot(x, y, **_in_colour(series, label, {"linewidth": 0.9} | look))


def draw_band(
    axes: "Axes",
    x: Array,
    middle: Array,
    half: Array,
    series: int,
    label: str | None = None,
    **look: Any,
) -> None:
    """Fill what is not further from a line than `half`."""
    look = {"alpha": 0.35, "linewidth": 0.0} | look
    axes.fill_between(x, middle - half, middle + half, **_in_colour(series, label, look))


def _in_colour(series: int, label: str | None, look: dict[str, Any]) -> dict[str, Any]:
    return {"color": COLOURS[series % 6], "label": label, **look}

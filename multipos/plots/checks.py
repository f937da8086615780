"""Figures of an independent run: errors before and after compensation, with the limit.

`draw_check` draws one axis, `check_panels` returns what draws every panel, and `check_figure` is
the figure of all. `errors_apart` tells whether before and after need scales of their own.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from multipos.files.numbers import in_unit, pretty_unit
from multipos.plots import style
from multipos.plots.marks import draw_points
from multipos.plots.style import When
from multipos.verification.verdicts import Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDE = 5.0  # times the limit, from which errors are drawn logarithmically beyond it
_LIMIT = 10.0  # times what is left after, from which a limit would hide it
_APART = 5.0  # times what is left after, from which errors before have axes of their own


def draw_check(found: Check, axes: "Axes", *, axis: str, when: When = "both") -> None:
    """Draw the errors of one axis before and after, U about the latter, and the limit.

    Those of a regression are drawn against its segment variable. A limit so wide
    that errors after and their U would shrink to a line is named beside them and not drawn.
    """
    column = found.axes.index(axis)
    used = found.counted[:, column]
    order = np.argsort(found.reference[used, column], kind="stable")
    known = found.reference[used, column][order]
    before, after, U = (
        array[used, column][order] for array in (found.before, found.after, found.U)
    )
    axes.axhline(0.0, color="#999999", linewidth=0.5)
    if when != "after":
        draw_points(axes, known, before, 1, "before", fillstyle="none", clip_on=False)
    if when != "before":
        draw_points(axes, known, after, 0, "after, with U", yerr=U, clip_on=False)
        _draw_limit(found, axes, drawn=when == "both" or _limit_fits(found))
    if (
        when == "both"
        and found.limit is not None
        and np.nanmax(np.abs(before)) > (_WIDE * found.limit)
    ):  # else the limits would be one line
        style.scale_by_powers(axes, "y", found.unit, linthresh=2.0 * found.limit)
    axes.margins(0.06)
    unit = f" [{pretty_unit(found.unit)}]" if found.unit else ""
    axes.set_xlabel(found.against or f"{found.quantity} of {axis}{unit}")
    word = axis if found.against else "error"
    if axes.get_yscale() == "linear":
        style.name_axis(axes.yaxis, word, found.unit)
    else:
        axes.set_ylabel(word)
    style.name_series(axes, 3)


def _draw_limit(found: Check, axes: "Axes", *, drawn: bool) -> None:
    if found.limit is None:
        return
    said = f"limit ±{in_unit(found.limit, found.unit)}"
    if not drawn:
        axes.plot([], [], color="#555555", linestyle="--", linewidth=0.8, label=f"{said}, outside")
        return
    for height, label in ((-found.limit, None), (found.limit, said)):
        axes.axhline(height, color="#555555", linestyle="--", linewidth=0.8, label=label)


def errors_apart(found: Check) -> bool:
    """Tell whether errors before would hide those after on one and the same scale."""
    left = _left(found)
    if _limit_fits(found):
        left = max(left, found.limit or 0.0)
    return float(np.nanmax(np.abs(found.before[found.counted]), initial=0.0)) > _APART * left


def _left(found: Check) -> float:
    """Return the largest error after compensation with its U."""
    return float(np.nanmax((np.abs(found.after) + found.U)[found.counted], initial=0.0))


def _limit_fits(found: Check) -> bool:
    """Tell whether errors after can still be seen where the limit is drawn."""
    return found.limit is not None and found.limit <= _LIMIT * _left(found)


def check_panels(found: Check) -> "list[Callable[[Axes], None]]":
    """Return what draws each panel: before and after apart, where one would hide the other."""
    drawn: tuple[When, ...] = ("before", "after") if errors_apart(found) else ("both",)
    return [
        partial(draw_check, found, axis=axis, when=when) for axis in found.axes for when in drawn
    ]


def check_figure(found: Check) -> "Figure":
    """Return the errors of every axis; before and after apart, where one would hide the other."""
    return style.figure_of(check_panels(found))

"""The figure of an independent run at known positions."""

from typing import TYPE_CHECKING

import numpy as np

from multipos.plots.style import COLOURS, MARKERS, name_series, new_figure, scale_by_powers
from multipos.verification.verdicts import Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDE = 5.0  # times the limit, from which errors are drawn logarithmically beyond it


def draw_check(found: Check, axes: "Axes", *, axis: str) -> None:
    """Draw the errors of one axis before and after, U about the latter, and the limit.

    Those of a regression are drawn against its segment variable.
    """
    column = found.axes.index(axis)
    used = found.counted[:, column]
    order = np.argsort(found.reference[used, column], kind="stable")
    known = found.reference[used, column][order]
    before, after, U = (
        array[used, column][order] for array in (found.before, found.after, found.U)
    )
    axes.plot(known, before, MARKERS[1], color=COLOURS[1], fillstyle="none", label="before")
    axes.errorbar(
        known,
        after,
        U,
        fmt=MARKERS[0],
        color=COLOURS[0],
        elinewidth=0.8,
        capsize=0.0,
        label="after, with U",
    )
    if found.limit is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * found.limit, color="#555555", linestyle="--", linewidth=0.8)
        axes.annotate(
            f"limit ±{found.limit:g} {found.unit}",
            (1.0, found.limit),
            va="bottom",
            ha="right",
            xycoords=("axes fraction", "data"),
            color="#555555",
            fontsize=9.0,
        )
        if np.abs(before).max() > _WIDE * found.limit:  # else the limits would be one line
            scale_by_powers(axes, "y", linthresh=2.0 * found.limit)
    axes.axhline(0.0, color="#999999", linewidth=0.5)
    unit = f" [{found.unit}]" if found.unit else ""
    axes.set_xlabel(found.against or f"{found.quantity} of {axis}{unit}")
    axes.set_ylabel(f"{axis if found.against else 'error'}{unit}")
    name_series(axes, 2)


def check_figure(found: Check) -> "Figure":
    """Return the errors of every axis, one below the other."""
    figure, axes = new_figure(len(found.axes))
    for axis, one in zip(found.axes, axes, strict=True):
        draw_check(found, one, axis=axis)
    return figure

"""The figure of an independent run at known positions."""

from typing import TYPE_CHECKING

import numpy as np

from multipos.checks import Check
from multipos.plots.style import COLOURS, MARKERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDE = 5.0  # times the limit, from which errors are drawn logarithmically beyond it


def draw_check(found: Check, axes: "Axes", *, axis: str) -> None:
    """Draw the errors of one axis before and after, U about the latter, and the limit."""
    column = found.axes.index(axis)
    used = found.counted[:, column]
    order = np.argsort(found.reference[used, column], kind="stable")
    known = found.reference[used, column][order]
    before, after, U = (
        array[used, column][order] for array in (found.before, found.after, found.U)
    )
    axes.plot(known, before, MARKERS[1], color=COLOURS[1], fillstyle="none", label="before")
    axes.errorbar(
        known, after, U, fmt=MARKERS[0], color=COLOURS[0], elinewidth=0.8, label="after, with U"
    )
    if found.limit is not None:
        for sign in (-1.0, 1.0):
            axes.axhline(sign * found.limit, color="#555555", linestyle="--", linewidth=0.8)
        axes.annotate(
            f"limit ±{found.limit:g} {found.unit}", (1.0, found.limit), va="bottom", ha="right",
            xycoords=("axes fraction", "data"), color="#555555",
        )  # fmt: skip
        if np.abs(before).max() > _WIDE * found.limit:  # else the limits would be one line
            axes.set_yscale("symlog", linthresh=2.0 * found.limit)
    axes.axhline(0.0, color="#999999", linewidth=0.5)
    axes.set_xlabel(f"{found.quantity} of {axis} [{found.unit}]")
    axes.set_ylabel(f"error [{found.unit}]")
    axes.legend(frameon=False)

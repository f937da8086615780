"""Figures, each a function that draws on an axes it is given.

Colours are those of Okabe and Ito, which colour-blind people can tell apart, and every series has
a second cue: a marker, a hatch or a number.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from multipos.checks import Check
from multipos.single_axis import Tumble

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#f0e442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
HATCHES = ("", "//", "\\\\", "xx", "--", "||", "++", "////")

_WIDE = 5.0  # times the limit, from which errors are drawn logarithmically beyond it


def draw_signal(found: Tumble, axes: "Axes") -> None:
    """Draw the signal of a tumble against the angle of each roll, with its Fourier series."""
    calibration = found.calibration
    signal = calibration.readings.values[:, 0]
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    for k, roll in enumerate(found.rolls):
        terms = [h for h in found.harmonics if h.plane == roll.plane]
        curve = sum(h.cos * np.cos(h.order * turn) + h.sin * np.sin(h.order * turn) for h in terms)
        if terms:
            axes.plot(np.degrees(turn), curve, color=COLOURS[k], linewidth=0.8)
        axes.plot(
            np.degrees(roll.angle), signal[roll.rows], MARKERS[k], color=COLOURS[k],
            fillstyle="none", label=f"plane {roll.plane}",
        )  # fmt: skip
    axes.set_xticks(range(0, 361, 45))
    axes.set_xlabel("angle [deg]")
    axes.set_ylabel(f"{calibration.outputs[0]} [{calibration.model.unit}]")
    axes.legend(frameon=False)


def draw_residual_harmonics(found: Tumble, axes: "Axes") -> None:
    """Draw the amplitudes of what the model of a tumble leaves, named ones marked by a star."""
    width = 0.8 / max(len(found.rolls), 1)
    named = " ".join(found.warnings)
    for k, roll in enumerate(found.rolls):
        left = [h for h in found.residual_harmonics if h.plane == roll.plane]
        place = np.array([h.order for h in left]) + (k - (len(found.rolls) - 1) / 2.0) * width
        axes.bar(
            place, [h.amplitude for h in left], width, color=COLOURS[k], hatch=HATCHES[k],
            edgecolor="white", linewidth=0.0, label=f"plane {roll.plane}",
        )  # fmt: skip
        for x, h in zip(place.tolist(), left, strict=True):
            if f"harmonic {h.order} in plane {h.plane} " in named:
                axes.annotate("*", (x, h.amplitude), ha="center", va="bottom")
    axes.set_xlabel("order")
    axes.set_ylabel(f"left by the model [{found.calibration.model.unit}]")
    axes.legend(frameon=False)


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

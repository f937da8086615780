"""Figures of a single-axis tumble."""

from typing import TYPE_CHECKING

import numpy as np

from multipos.plots.style import COLOURS, HATCHES, MARKERS
from multipos.single_axis import Tumble

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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

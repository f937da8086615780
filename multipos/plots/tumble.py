"""Figures of a single-axis tumble, and of the rolls of any calibration.

`draw_signal` draws the signal of a tumble and `draw_rolls` that of any calibration against the
angle, `draw_harmonics` and `draw_residual_harmonics` what is left at each harmonic, and
`tumble_figure` is the figure of a tumble.
"""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.diagnostics.criticism import fourier_residuals
from multipos.numerics.arrays import Array
from multipos.plots.marks import draw_line, draw_points
from multipos.plots.style import COLOURS, HATCHES, figure_of, name_axis, name_series, write
from multipos.positions.harmonics import Harmonic, Roll, beyond_chance, find_rolls, series
from multipos.sensor.calibration import Calibration
from multipos.verification.tumbling import Tumble, Tumbles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_signal(found: Tumble, axes: "Axes") -> None:
    """Draw the signal of a tumble against the angle of each roll, with its Fourier series."""
    calibration = found.calibration
    _draw_signal(calibration, calibration.outputs[0], found.rolls, found.harmonics, axes)


def draw_rolls(calibration: Calibration, axes: "Axes", *, output: str) -> None:
    """Draw the signal of an output against the angle of each roll, with its Fourier series."""
    rolls = find_rolls(calibration.readings)
    signal = calibration.readings.values[:, calibration.outputs.index(output)]
    _draw_signal(calibration, output, rolls, series(rolls, signal), axes)


def _draw_signal(
    calibration: Calibration,
    output: str,
    rolls: Sequence[Roll],
    harmonics: Sequence[Harmonic],
    axes: "Axes",
) -> None:
    signal = calibration.readings.values[:, calibration.outputs.index(output)]
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    for k, roll in enumerate(rolls):
        terms = [h for h in harmonics if h.plane == roll.plane]
        curve = sum(h.cos * np.cos(h.order * turn) + h.sin * np.sin(h.order * turn) for h in terms)
        if terms:
            draw_line(axes, np.degrees(turn), curve, k)
        at, name = np.degrees(roll.angle), f"plane {roll.plane}"
        draw_points(axes, at, signal[roll.rows], k, name, fillstyle="none")
    axes.set_xticks(range(0, 361, 45))
    axes.set_xlabel("angle [°]")
    name_axis(axes.yaxis, output, calibration.model.unit)
    name_series(axes, 3)


def draw_harmonics(calibration: Calibration, axes: "Axes", *, output: str) -> None:
    """Draw the amplitudes of the residuals' harmonics along each roll of a calibration."""
    rolls = [entry for entry in fourier_residuals(calibration) if entry["output"] == output]
    for k, entry in enumerate(rolls):
        orders = [h["order"] for h in entry["harmonics"]]
        sizes = [h["amplitude"] for h in entry["harmonics"]]
        _draw_bars(axes, orders, sizes, k, len(rolls), f"roll about {entry['roll']}")
        axes.set_xticks(orders)
    _name_harmonics(axes, output, calibration)


def _draw_bars(
    axes: "Axes", orders: Sequence[int], sizes: Sequence[float], k: int, rolls: int, label: str
) -> Array:
    """Draw the harmonics of a roll, beside those of the others; return where the bars stand."""
    width = 0.8 / rolls
    place = np.array(orders) + (k - (rolls - 1) / 2.0) * width
    look: dict[str, Any] = {"color": COLOURS[k], "hatch": HATCHES[k], "edgecolor": "white"}
    axes.bar(place, sizes, width, linewidth=0.0, label=label, **look)
    return place


def _name_harmonics(axes: "Axes", what: str, calibration: Calibration) -> None:
    axes.set_xlabel("order")
    name_axis(axes.yaxis, what, calibration.model.unit)
    name_series(axes, 3)


def draw_residual_harmonics(found: Tumble, axes: "Axes") -> None:
    """Draw the amplitudes of what the model of a tumble leaves, named ones marked by a star."""
    strange = beyond_chance(found.residual_harmonics)
    for k, roll in enumerate(found.rolls):
        left = [h for h in found.residual_harmonics if h.plane == roll.plane]
        orders, sizes = [h.order for h in left], [h.amplitude for h in left]
        place = _draw_bars(axes, orders, sizes, k, len(found.rolls), f"plane {roll.plane}")
        for x, h in zip(place.tolist(), left, strict=True):
            if h in strange:
                write(axes, x, h.amplitude, "*", ha="center", va="bottom")
    _name_harmonics(axes, "left by the model", found.calibration)


def tumble_figure(found: Tumble | Tumbles) -> "Figure":
    """Return the signal of every output, and what the model leaves of its harmonics."""
    each = (found,) if isinstance(found, Tumble) else tuple(found.outputs.values())
    drawn = (draw_signal, draw_residual_harmonics)
    return figure_of([partial(draw, one) for one in each for draw in drawn])

"""Figures of static records: the Allan deviation, and the zero against time.

`draw_allan` draws the Allan deviation of every output, `draw_zero` the zero of one against time,
and `stability_figure` is the figure of both.
"""

import re
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from multipos.bias_stability.allan import FLICKER
from multipos.bias_stability.stability_result import Stability
from multipos.files.numbers import SUPERSCRIPT
from multipos.plots.marks import draw_line, draw_points
from multipos.plots.style import figure_of, name_series, scale_by_powers, write
from multipos.units import MICRO_G

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINES = ("-", "--", "-.", ":")
_SMALL = 1e4  # µg, or the unit of the outputs: a zero that is written in it
_HOUR = 7200.0  # seconds, from which time is drawn in hours


def draw_allan(found: Stability, axes: "Axes") -> None:
    """Draw the overlapping Allan deviation of every output with its u, and the three laws."""
    factor, unit = _shown(found)
    for i, (name, each) in enumerate(found.outputs.items()):
        adev, u = factor * each.adev, factor * each.u
        draw_points(axes, found.tau, adev, i, name, yerr=[np.minimum(u, 0.9 * adev), u])
        N, B, K = (
            factor * law.value
            for law in (each.white_noise, each.bias_instability, each.random_walk)
        )
        laws = np.sqrt(N**2 / found.tau + FLICKER * B**2 + K**2 * found.tau / 3.0)
        draw_line(axes, found.tau, laws, i)
    scale_by_powers(axes, "x")
    scale_by_powers(axes, "y")
    axes.set_xlabel("averaging time [s]")
    axes.set_ylabel(f"Allan deviation [{unit}]")
    name_series(axes, len(found.outputs))


def draw_zero(found: Stability, axes: "Axes", *, output: str) -> None:
    """Draw the zero of one output against time, a line each record: figure 1 of the paper.

    Less the mean of the settled zeros, which is written beside the axis.
    """
    factor, unit = _shown(found)
    middle = float(np.mean([record.settled[output] for record in found.records]))
    longest = max(float(record.time[-1]) for record in found.records)
    hours = longest > _HOUR
    for i, record in enumerate(found.records):
        time = record.time / (3600.0 if hours else 1.0)
        zero = factor * (record.zero[output] - middle)
        draw_line(axes, time, zero, i, f"run {i + 1}", linestyle=_LINES[i % len(_LINES)])
    small = abs(factor * middle) < _SMALL
    about = f"{factor * middle:.4g} {unit}" if small else f"{middle:.6g} {found.unit}"
    axes.axhline(0.0, color="#999999", linewidth=0.5)
    axes.set_xlabel("time since switching on [h]" if hours else "time since switching on [s]")
    axes.set_ylabel(f"{output} [{unit}]")
    # Beside what the numbers along the axis may be multiplied by.
    look = {"transform": axes.transAxes, "fontsize": 8.0, "color": "#555555"}
    write(axes, 0.12, 1.02, f"about {_with_powers(about)}", **look)
    if len(found.records) > 1:
        name_series(axes, min(len(found.records), 8))


def stability_figure(found: Stability) -> "Figure":
    """Return the Allan deviation, and below it the zero of every output against time."""
    zeros = [partial(draw_zero, found, output=output) for output in found.outputs]
    return figure_of([partial(draw_allan, found), *zeros])


def _shown(found: Stability) -> tuple[float, str]:
    return (MICRO_G[found.unit], "µg") if found.unit in MICRO_G else (1.0, found.unit)


def _with_powers(text: str) -> str:
    """Return a number with its unit, 3×10⁻⁵ where it was written 3e-05."""
    powers = re.sub(
        r"(?<=\d)e\+?(-?)0*(\d+)", lambda m: f"×10{(m[1] + m[2]).translate(SUPERSCRIPT)}", text
    )
    return powers.replace("-", "−")

"""Figures of many units, drawn from counts and means and never from the units themselves.

`draw_histogram` draws how many units have which value of a parameter, `draw_chart` its course along
the line, and `limited` returns the parameters that are drawn.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.plots.marks import draw_points
from multipos.plots.style import COLOURS, name_axis, name_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def limited(parameters: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """Return the first parameters that have limits, or the first that are counted where none has.

    At the most so many, each with a histogram.
    """
    counted = [each for each in parameters if each["histogram"] is not None]
    held = [each for each in counted if each["lsl"] is not None or each["usl"] is not None]
    return (held or counted)[:most]


def draw_histogram(parameter: Mapping[str, Any], axes: "Axes") -> None:
    """Draw how many units have which value, and the limits."""
    drawn = parameter["histogram"]
    edges = np.linspace(drawn["low"], drawn["high"], len(drawn["counts"]) + 1)
    axes.stairs(drawn["counts"], edges, fill=True, color=COLOURS[5])
    low, high = axes.get_xlim()
    for side in ("lsl", "usl"):
        if parameter[side] is not None:
            axes.axvline(parameter[side], color=COLOURS[1], linestyle="--", linewidth=1.0)
            low, high = min(low, parameter[side]), max(high, parameter[side])
    margin = 0.02 * (high - low)
    axes.set_xlim(low - margin, high + margin)
    name_axis(axes.xaxis, parameter["name"], parameter["unit"])
    axes.locator_params(axis="y", integer=True)
    axes.set_ylabel("units")


def draw_chart(parameter: Mapping[str, Any], axes: "Axes") -> None:
    """Draw the medians of consecutive units of every station, with the limits of its EWMA."""
    for series, line in enumerate(parameter["chart"]):
        name = line["station"] or parameter["name"]
        joined = {"linestyle": "-", "linewidth": 0.9, "markersize": 2.5}
        draw_points(axes, line["place"], line["median"], series, name, **joined)
        for side in ("ewma_lcl", "ewma_ucl"):
            axes.axhline(
                line["control"][side], color=COLOURS[series % 6], linestyle=":", linewidth=0.8
            )
    axes.set_xlabel("share of the line's units")
    name_axis(axes.yaxis, parameter["name"], parameter["unit"])
    name_series(axes, 3)

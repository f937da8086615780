"""Figures of repeated calibrations."""

from typing import TYPE_CHECKING

import numpy as np

from multipos.numerics.terms import CONSTANT
from multipos.plots.style import COLOURS, MARKERS, name_series, new_figure
from multipos.verification.comparison import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_runs(comparison: Comparison, axes: "Axes", *, term: str = "1") -> None:
    """Draw one parameter of every output against the run: the paper's figure 1 is the bias.

    Each less its mean, with U of each run.
    """
    found = comparison
    runs = np.arange(1, len(found.calibrations) + 1)
    model = found.calibrations[0].model
    wanted = [
        i
        for i, (_, t) in enumerate(model.keys)
        if (t == CONSTANT if term == "1" else str(t) == term)
    ]
    for series, i in enumerate(wanted):
        U = np.array([c.U[i] for c in found.calibrations])
        values = found.values[:, i] - found.mean[i]
        axes.errorbar(
            runs + 0.06 * (series - (len(wanted) - 1) / 2.0),
            values,
            yerr=np.where(np.isfinite(U), U, 0.0),
            color=COLOURS[series % 6],
            marker=MARKERS[series % 8],
            capsize=2.0,
            capthick=1.0,
            linewidth=0.9,
            label=model.names[i],
        )
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    axes.set_xticks(runs)
    axes.set_xlabel("run")
    axes.set_ylabel(f"less its mean [{model.units[wanted[0]] if wanted else model.unit}]")
    axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    name_series(axes, 3)


def runs_figure(comparison: Comparison) -> "Figure":
    """Return the biases against the run."""
    figure, axes = new_figure()
    draw_runs(comparison, axes[0])
    return figure

"""Figures of repeated calibrations."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from multipos.numerics.terms import CONSTANT
from multipos.plots.style import COLOURS, MARKERS, name_axis, name_series, new_figure
from multipos.verification.comparison import Comparison
from multipos.verification.regression_comparison import RegressionComparison

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
    _dress(axes, len(runs), model.units[wanted[0]] if wanted else model.unit)


def _dress(axes: "Axes", runs: int, unit: str) -> None:
    """Name the runs, the axes and the series of values less their mean."""
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    axes.set_xticks(range(1, runs + 1))
    axes.set_xlabel("run")
    name_axis(axes.yaxis, "less its mean", unit)
    name_series(axes, 3)


def draw_values(values: Mapping[str, Sequence[float]], axes: "Axes", *, unit: str) -> None:
    """Draw values by run, each name a line, as a file of a comparison holds them."""
    count = 0
    for series, (name, found) in enumerate(values.items()):
        count = max(count, len(found))
        axes.plot(
            range(1, len(found) + 1),
            found,
            color=COLOURS[series % 6],
            marker=MARKERS[series % 8],
            linewidth=0.9,
            label=name,
        )
    _dress(axes, count, unit)


def runs_figure(comparison: Comparison) -> "Figure":
    """Return the biases against the run."""
    figure, axes = new_figure()
    draw_runs(comparison, axes[0])
    return figure


def terms_figure(comparison: RegressionComparison) -> "Figure":
    """Return the terms of repeated regressions, each less its mean over its u."""
    figure, axes = new_figure(height=0.9 + 0.22 * len(comparison.terms))
    one = axes[0]
    runs = len(comparison.files)
    for run in range(runs):
        places, values = [], []
        for row, term in enumerate(comparison.terms):
            if not np.isnan(term.values[run]) and term.u[run] > 0.0:
                typical = float(np.sqrt(np.nanmean(term.u**2)))
                values.append((term.values[run] - np.nanmean(term.values)) / typical)
                places.append(row)
        one.plot(
            values,
            places,
            color=COLOURS[run % 6],
            marker=MARKERS[run % 8],
            linestyle="none",
            label=str(run + 1),
        )
    one.set_yticks(
        range(len(comparison.terms)),
        [f"{t.segment}: {t.term}" for t in comparison.terms],
    )
    one.invert_yaxis()
    one.axvline(0.0, color="#000000", linewidth=0.6)
    one.set_xlabel("less its mean, over u")
    name_series(one, min(runs, 6))
    return figure

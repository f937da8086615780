"""Figures of repeated calibrations and of repeated regressions.

`draw_runs` draws one parameter of every output by run, `draw_chart` one parameter over the dates;
`runs_figure` is the figure of all. `draw_terms` draws the terms of repeated regressions, and
`terms_figure` is their figure.
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.plots.marks import draw_band, draw_line, draw_points
from multipos.plots.style import (
    COLOURS,
    figure_of,
    name_axis,
    name_series,
    new_figure,
    write_title,
)
from multipos.verification.comparison import Comparison
from multipos.verification.recalibration import DAY, YEAR, dates_of, expanded_apart
from multipos.verification.regression_repeats import RegressionComparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = 3  # beside each other
_CAPS: dict[str, Any] = {"capsize": 2.0, "capthick": 1.0}
_BESIDE = 0.1  # of a run, between outputs, so that no bar hides another


def draw_runs(comparison: Comparison, axes: "Axes", *, term: str = "1") -> None:
    """Draw one parameter of every output against the run: the paper's figure 1 is the bias.

    Each less its mean, with U of each run.
    """
    model = comparison.calibrations[0].model
    wanted = [i for i, (_, t) in enumerate(model.keys) if str(t) == term]
    runs = np.arange(1, len(comparison.calibrations) + 1)
    joined = {"linestyle": "-", "linewidth": 0.9}
    for series, i in enumerate(wanted):
        run = runs + _BESIDE * (series - (len(wanted) - 1) / 2.0)
        found = comparison.values[:, i] - comparison.mean[i]
        U = np.array([c.U[i] for c in comparison.calibrations])
        bars = np.where(np.isfinite(U), U, 0.0)  # a run whose U is not finite has none
        draw_points(axes, run, found, series, model.names[i], yerr=bars, **joined, **_CAPS)
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    axes.set_xticks(runs)
    axes.set_xlabel("run")
    name_axis(axes.yaxis, "less its mean", model.units[wanted[0]] if wanted else model.unit)
    name_series(axes, 3)


def runs_figure(comparison: Comparison) -> "Figure":
    """Return a control chart of every parameter, or the biases by run where methods are compared.

    Each panel has the values with U over their dates, the trend with its U where there is one, and
    the limits of the value.
    """
    if not comparison.changes:
        return figure_of([partial(draw_runs, comparison)])
    rows = -(-len(comparison.changes) // _PANELS)
    figure, panels = new_figure(rows, _PANELS, width=7.8, height=1.6)
    for axes in panels[len(comparison.changes) :]:
        axes.set_visible(False)
    for i, axes in enumerate(panels[: len(comparison.changes)]):
        draw_chart(comparison, i, axes)
        if i < len(comparison.changes) - _PANELS:  # said once, below
            axes.set_xlabel("")
    return figure


def draw_chart(comparison: Comparison, index: int, axes: "Axes") -> None:
    """Draw one parameter over the dates of its calibrations, with trend and limits."""
    found, change = comparison.calibrations, comparison.changes[index]
    at = dates_of(found)
    values = comparison.values[:, index]
    dated = np.ptp(at) >= DAY
    x = 1970.0 + at / YEAR if dated else np.arange(1.0, len(found) + 1.0)
    U = expanded_apart(found, at // DAY)[:, index]
    if change.per_year is not None:
        line = np.array([x.min(), x.max()])
        away = line - np.mean(x)
        middle = np.mean(values) + change.per_year.value * away
        wide = change.per_year.U * np.abs(away)
        draw_line(axes, line, middle, 1)
        draw_band(axes, line, middle, wide, 1, alpha=0.15)
    draw_points(axes, x, values, 0, yerr=np.where(np.isfinite(U), U, 0.0), **_CAPS)
    limit = change.limit
    sides = limit if isinstance(limit, tuple) else ()
    if isinstance(limit, float):
        sides = (values[0] - limit, values[0] + limit)
    for side in sides:
        if side is not None:
            axes.axhline(side, color=COLOURS[2], linewidth=0.9, linestyle="--")
    axes.set_xlabel("year" if dated else "run")
    axes.set_xticks(np.unique(np.round(x)))
    axes.xaxis.set_major_formatter("{x:.0f}")
    due = f"; due {change.due}" if change.due else ""
    write_title(axes, f"{change.name}{due}")
    name_axis(axes.yaxis, "", found[0].model.units[index])


def draw_terms(comparison: RegressionComparison, axes: "Axes") -> None:
    """Draw the terms of repeated regressions, each less its mean over its u, with a bar of u."""
    runs = len(comparison.files)
    for run in range(runs):
        shown = [
            (row, term, float(np.sqrt(np.nanmean(term.u**2))))
            for row, term in enumerate(comparison.terms)
            if not np.isnan(term.values[run]) and term.u[run] > 0.0
        ]
        x = [(term.values[run] - np.nanmean(term.values)) / typical for _, term, typical in shown]
        y = [row + 0.6 * ((run + 0.5) / runs - 0.5) for row, _, _ in shown]
        bars = [term.u[run] / typical for _, term, typical in shown]
        draw_points(axes, x, y, run, f"run {run + 1}", xerr=bars)
    rows = len(comparison.terms)
    axes.set_yticks(range(rows), [f"{t.segment}: {t.term}" for t in comparison.terms])
    axes.set_ylim(rows - 0.5, -0.5)
    axes.axvline(0.0, color="#000000", linewidth=0.6)
    axes.set_xlabel("less its mean, over u")
    name_series(axes, min(runs, 6))


def terms_figure(comparison: RegressionComparison) -> "Figure":
    """Return the terms of repeated regressions."""
    return figure_of([partial(draw_terms, comparison)], height=0.9 + 0.22 * len(comparison.terms))

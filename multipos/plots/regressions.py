"""Figures of a regression: a column before and after, in thermal balance, how terms were chosen.

`draw_correction` draws a column before and after, of which `corrected_rows` are the numbers and
`complete_rows` the rows that have all. `draw_balance` draws what is predicted in thermal balance,
`draw_path` the F of every step of a selection, and `regression_figure` is the figure of all.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from multipos.compensation.correction import correct, range_column, read_predictors, read_runs
from multipos.errors import UsageError
from multipos.files.tables import Source, Table, read_table
from multipos.numerics.arrays import Array
from multipos.numerics.selection import Step
from multipos.plots import style
from multipos.plots.marks import draw_band, draw_line, draw_points
from multipos.plots.style import When
from multipos.regression.regression import Regression, Regressions
from multipos.regression.segment import Segment, format_span

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FAR = 5.0  # times what is left after, from which the response before would hide it


def draw_correction(
    regression: Regression,
    data: Source,
    axes: "Axes",
    *,
    variable: str | None = None,
    column: str | None = None,
    when: When = "both",
) -> None:
    """Draw a column before and after its correction against a variable, with the segments.

    Parameters
    ----------
    regression : Regression
    data : path, mapping of columns, or data frame
    axes : matplotlib Axes
    variable : str, optional
        What it is drawn against: the segment variable, or the first variable, by default.
    column : str, optional
        What is corrected; the response by default.
    when : str
        'before' or 'after' draws that alone, on a scale of its own.
    """
    table = read_table(data, what="data")
    _draw_corrected(
        regression, corrected_rows(regression, table, variable, column), axes, when=when
    )


class _Corrected(NamedTuple):
    """A column before and after its correction, and what it is drawn against."""

    column: str
    before: Array
    after: Array
    variable: str
    x: Array


def corrected_rows(
    regression: Regression, table: Table, variable: str | None = None, column: str | None = None
) -> _Corrected:
    """Return a column before and after its correction, against a variable or that of segments."""
    target = column or regression.response
    columns = read_predictors(regression, table, read_runs(regression, table))
    name, x = range_column(regression, table, columns)
    if variable is not None:
        name, x = variable, table.number(variable)
    after = np.asarray(correct(regression, table, column=target)["corrected"])
    return _Corrected(target, table.number(target), after, name, x)


def _draw_corrected(regression: Regression, found: _Corrected, axes: "Axes", *, when: When) -> None:
    x, grey = found.x, style.COLOURS[6]
    if when != "after":
        draw_points(axes, x, found.before, 0, "before", marker="x", color=grey, markersize=3.0)
    if when != "before":
        draw_points(axes, x, found.after, 0, "after", marker=".", markersize=3.0)
    if found.variable == regression.segment_variable:
        for edge in regression.edges:
            axes.axvline(edge, color="black", linewidth=0.8, linestyle="--")
    axes.axhline(0.0, color="black", linewidth=0.5)
    axes.set(xlabel=found.variable, ylabel=found.column)
    style.name_series(axes, 2)


def draw_balance(regression: Regression, axes: "Axes") -> None:
    """Draw what is predicted in thermal balance, with U, and where nothing was measured.

    Raises
    ------
    UsageError
        The regression has no rates.
    """
    if regression.balance is None:
        raise UsageError("the regression has no rates, so it is in balance everywhere.")
    b = regression.balance
    draw_band(axes, b.at, b.predicted, b.U, 5)
    draw_line(axes, b.at, b.predicted, 0, "in balance, with U", linewidth=1.2)
    if b.outside.any():
        x, y = b.at[b.outside], b.predicted[b.outside]
        draw_points(axes, x, y, 0, "outside", marker="x", color=style.COLOURS[6])
    axes.set(xlabel=b.variable, ylabel=regression.response)
    style.name_series(axes, 2)


def draw_path(segment: Segment, axes: "Axes") -> None:
    """Draw the F of every step of a selection; a removal hangs open, the runner-up is a bar's mark.

    F spans decades, so its axis is logarithmic; steps read downward as the path went. A term that
    leaves no residual has an infinite F, drawn a decade beyond the others.
    """
    steps = segment.path
    drawn = [t.F for step in steps for t in (step, step.runner_up) if t is not None]
    far = 10.0 * max([1.0, *(F for F in drawn if np.inf > F)])
    for row, step in enumerate(steps):
        _draw_step(step, row, axes, far)
    axes.set_yticks(
        range(len(steps)),
        [f"{'+' if step.action == 'add' else '−'} {step.term}" for step in steps],
    )
    if steps:
        style.scale_by_powers(axes, "x")
        axes.set_xlim(left=min([1.0, *(0.5 * step.F for step in steps if step.F > 0.0)]))
    axes.invert_yaxis()
    axes.set(xlabel="F to enter or to remove; ◆ the runner-up")


def _draw_step(step: Step, row: int, axes: "Axes", far: float) -> None:
    added = step.action == "add"
    axes.barh(
        row,
        min(step.F, far),
        color=style.COLOURS[0] if added else "none",
        edgecolor=style.COLOURS[0],
        hatch="" if added else "//",
        linewidth=1.0,
    )
    if np.inf == step.F:
        axes.text(far, row, "∞ ", ha="right", va="center", color="white")
    if step.runner_up is not None and step.runner_up.F > 0.0:
        draw_points(axes, min(step.runner_up.F, far), row, 1, marker="D")


def regression_figure(regression: Regression | Regressions, data: Source) -> "Figure":
    """Return the response before and after, in thermal balance, and how terms were chosen.

    Before and after stand apart where one would hide the other. Of several responses each before
    and after. Rows with an empty cell, which the regression may have dropped, are not drawn.
    """
    table = read_table(data, what="data")
    if isinstance(regression, Regressions):
        drawn = [panel for one in regression.values() for panel in _before_and_after(one, table)]
        return style.figure_of(drawn)
    chosen = [s for s in regression.segments if s.path][: 1 if regression.continuous else None]
    paths = [partial(_titled_path, regression, segment) for segment in chosen]
    still = [] if regression.balance is None else [partial(draw_balance, regression)]
    return style.figure_of([*_before_and_after(regression, table), *still, *paths])


def _before_and_after(regression: Regression, table: Table) -> "list[Callable[[Axes], None]]":
    found = corrected_rows(regression, complete_rows(regression, table))
    before, after = (np.abs(y).max(initial=0.0) for y in (found.before, found.after))
    words: tuple[When, ...] = ("before", "after") if before > _FAR * after else ("both",)
    return [partial(_draw_corrected, regression, found, when=word) for word in words]


def _titled_path(regression: Regression, segment: Segment, axes: "Axes") -> None:
    draw_path(segment, axes)
    span = format_span(regression.range_variable, segment.range, segment.branch)
    style.write_title(axes, "all segments" if regression.continuous else span.replace(" -", " −"))


def complete_rows(regression: Regression, table: Table) -> Table:
    """Return the rows without an empty cell in what the regression needs."""
    r = regression
    needed = [r.response, r.range_variable, *r.needed, *([r.time] if r.time else [])]
    names = {n if n in table else n.removesuffix("_rate") for n in needed}
    columns = [table.number(n, empty=True) for n in names if n in table]
    return table.select(np.flatnonzero(np.isfinite(columns).all(axis=0)).tolist())

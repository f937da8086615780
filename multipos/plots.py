"""Figures, each a function that draws on an axes it is given.

Colours are those of Okabe and Ito, which colour-blind people can tell apart, and every series has
a second cue: a marker, a line style, a hatch or a number. `new_figure` makes a figure that knows
nothing of the screen, `to_svg` writes it so that the same drawing gives the same bytes.
"""

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from multipos.calibration import Calibration, labels
from multipos.comparison import Comparison
from multipos.correction import correct
from multipos.files import Source, read_table
from multipos.model import COMPONENTS, CONSTANT, linear_term
from multipos.regression import Regression
from multipos.segment import Segment
from multipos.temperature import Curve
from multipos.uncertainty import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#f0e442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
HATCHES = ("", "//", "\\\\", "xx", "--", "||", "++", "////")  # dots would weigh 150 kB each

_TICKS = 26  # labels that fit below a figure
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "multipos",
    "font.size": 9.0,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.6,
    "lines.markersize": 4.0,
}


def new_figure(rows: int = 1, *, width: float = 5.8, height: float = 2.6) -> "tuple[Figure, Any]":
    """Return a figure of so many axes below each other, and the axes (rows,); sizes in inches."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(width, height * rows), layout="constrained")
        axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    return figure, axes


def to_svg(figure: "Figure") -> str:
    """Return a figure as an SVG element, without date: the same drawing gives the same bytes."""
    from io import StringIO

    from matplotlib import rc_context

    stream = StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with rc_context(_STYLE):
        figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    return re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)


# --- A calibration and its repeats


def draw_residuals(calibration: Calibration, axes: "Axes", *, output: str) -> None:
    """Draw the residuals of an output at every position, with ±2 standard deviations of each.

    The band is that of the residuals themselves, s sqrt(1 − h), narrow where the leverage h is
    large.
    """
    c = calibration
    column = c.outputs.index(output)
    left = np.maximum(1.0 - c.diagnostics.leverage[:, column], 0.0)
    band = 2.0 * _noise(c)[:, column] * np.sqrt(left)
    at = np.arange(len(c.readings))
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    if np.isfinite(band).all():
        axes.vlines(at, -band, band, color=COLOURS[5], linewidth=5.0, label="±2 sd")
    axes.plot(at, c.residuals[:, column], MARKERS[column % 8], color=COLOURS[column % 6],
              label=output)  # fmt: skip
    _name_positions(axes, labels(c.readings))
    axes.set_ylabel(f"{output} [{c.model.unit}]")
    axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    _legend(axes, 2)


def draw_coverage(calibration: Calibration, axes: "Axes") -> None:
    """Draw which way was up at every position, on the two halves of the sphere.

    Equal-area: the left disc is seen from +z, the right one from −z; the rim is the xy plane.
    """
    c = calibration
    up = c.reference / np.linalg.norm(c.reference, axis=1)[:, None]
    if c.convention == "gravity":
        up = -up
    circle = np.linspace(0.0, 2.0 * np.pi, 181)
    for side, centre in ((1.0, -1.2), (-1.0, 1.2)):
        axes.plot(centre + np.cos(circle), np.sin(circle), color="#000000", linewidth=0.8)
        for elevation in (30.0, 60.0):
            r = np.sqrt(1.0 - np.sin(np.radians(elevation)))
            axes.plot(centre + r * np.cos(circle), r * np.sin(circle), color=COLOURS[6],
                      linewidth=0.4)  # fmt: skip
        on = side * up[:, 2] >= -1e-12  # positions on the rim belong to both discs
        height = np.clip(side * up[on, 2], 0.0, 1.0)
        radius = np.sqrt(1.0 - height) / np.maximum(np.hypot(up[on, 0], up[on, 1]), 1e-300)
        x, y = up[on, 0] * radius, up[on, 1] * radius
        axes.plot(centre + x, y, MARKERS[0] if side > 0 else MARKERS[1], linestyle="none",
                  color=COLOURS[0] if side > 0 else COLOURS[1])  # fmt: skip
        axes.text(centre, -1.24, "+z" if side > 0 else "-z", ha="center", va="center")
        for name, px, py in (("+x", 1.13, 0.0), ("+y", 0.0, 1.1)):
            axes.text(centre + px, py, name, ha="center", va="center", fontsize=7)
    axes.set_aspect("equal")
    axes.set_xlim(-2.4, 2.5)
    axes.set_ylim(-1.4, 1.25)
    axes.set_axis_off()


def draw_leverage(calibration: Calibration, axes: "Axes") -> None:
    """Draw how far every position fixes its own fit, 0 … 1, for each output."""
    c = calibration
    n, m = c.readings.values.shape
    width = 0.8 / m
    for i, output in enumerate(c.outputs):
        at = np.arange(n) + (i - (m - 1) / 2.0) * width
        axes.bar(at, c.diagnostics.leverage[:, i], width, color=COLOURS[i % 6], label=output,
                 hatch=HATCHES[i % 8], edgecolor="#ffffff", linewidth=0.3)  # fmt: skip
    axes.set_ylim(0.0, min(1.02, 1.2 * float(c.diagnostics.leverage.max())))
    axes.set_ylabel("leverage")
    _name_positions(axes, labels(c.readings))
    _legend(axes, min(m, 4))


def draw_errors(calibration: Calibration, axes: "Axes") -> None:
    """Draw the size of the error at every position before and after compensation [g].

    Before: `nominal_error`, after: compensated force less reference.
    """
    c = calibration
    before, after = nominal_error(c), compensated_error(c)
    at = np.arange(len(before))
    tiny = 1e-3 * max(float(np.nanmax(before)), 1e-12)
    axes.plot(at, np.maximum(before, tiny), MARKERS[1], color=COLOURS[1], label="before")
    axes.plot(at, np.maximum(after, tiny * 1e-3), MARKERS[0], color=COLOURS[0], label="after")
    axes.set_yscale("log")
    axes.set_ylabel("error [g]")
    _name_positions(axes, labels(c.readings))
    _legend(axes, 2)


def nominal_error(calibration: Calibration) -> Array:
    """Return the size (n,) [g] of the error with one nominal scale factor and no bias.

    The nominal scale factor is 1 for readings in g, else the mean own-axis one.
    """
    c = calibration
    own = [
        c.parameters[c.model.keys.index((output, linear_term(axis)))]
        for output, axis in zip(c.outputs, c.model.axes, strict=True)
        if (output, linear_term(axis)) in c.model.keys
    ]
    scale = 1.0 if c.model.unit == "g" or not own else float(np.mean(own))
    axes = [COMPONENTS.index(axis) for axis in c.model.axes]
    error = c.readings.values / scale - c.reference[:, axes]
    return np.asarray(np.linalg.norm(error, axis=1))


def compensated_error(calibration: Calibration) -> Array:
    """Return the size (n,) [g] of what is left after compensation."""
    c = calibration
    force = c.compensate(c.readings.values, c.readings.environment)
    sensed = [i for i, axis in enumerate(COMPONENTS) if axis in c.model.axes]
    return np.asarray(np.linalg.norm(force - c.reference[:, sensed], axis=1))


def draw_budget(evaluation: Evaluation, axes: "Axes") -> None:
    """Draw what share of each parameter's variance every input quantity has [%]."""
    quantities, share = variance_shares(evaluation)
    at = np.arange(len(evaluation.names))
    left = np.zeros(len(at))
    for i, (quantity, part) in enumerate(zip(quantities, share, strict=True)):
        axes.barh(at, part, left=left, color=COLOURS[i % 8], hatch=HATCHES[i % 8], label=quantity,
                  edgecolor="#ffffff", linewidth=0.3)  # fmt: skip
        left = left + part
    axes.set_yticks(at, list(evaluation.names))
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of the variance [%]")
    _legend(axes, 3)


def variance_shares(evaluation: Evaluation) -> tuple[list[str], Array]:
    """Return the quantities and their share (quantities, p) of each variance [%]."""
    added = np.array([np.diag(row.added) for row in evaluation.rows])
    names = list(dict.fromkeys(row.quantity for row in evaluation.rows))
    total = np.maximum(added.sum(axis=0), np.finfo(float).tiny)
    parts = [
        sum(added[i] for i, row in enumerate(evaluation.rows) if row.quantity == name)
        for name in names
    ]
    return names, 100.0 * np.array(parts) / total


def draw_correlation(calibration: Calibration, axes: "Axes") -> None:
    """Draw the correlation matrix of the parameters, with the size of each coefficient."""
    from matplotlib.colors import LinearSegmentedColormap

    c = calibration
    p = len(c.names)
    shades = LinearSegmentedColormap.from_list("signed", [COLOURS[1], "#ffffff", COLOURS[0]])
    values = np.nan_to_num(c.correlation)
    axes.pcolormesh(np.arange(p + 1), np.arange(p + 1), values, cmap=shades, vmin=-1.0, vmax=1.0,
                    edgecolors="#999999", linewidth=0.2)  # fmt: skip
    for i in range(p):
        for j in range(p):
            if i != j and abs(values[i, j]) >= 0.05 and p <= 20:
                axes.text(j + 0.5, i + 0.5, f"{values[i, j]:.1f}".replace("0.", "."), ha="center",
                          va="center", fontsize=6,
                          color="#ffffff" if abs(values[i, j]) > 0.6 else "#222222")  # fmt: skip
    axes.set_xticks(np.arange(p) + 0.5, list(c.names), rotation=90, fontsize=7)
    axes.set_yticks(np.arange(p) + 0.5, list(c.names), fontsize=7)
    axes.invert_yaxis()
    axes.set_aspect("equal")


def draw_runs(comparison: Comparison, axes: "Axes", *, term: str = "1") -> None:
    """Draw one parameter of every output against the run: the paper's figure 1 is the bias.

    Each less its mean, with U of each run.
    """
    found = comparison
    runs = np.arange(1, len(found.calibrations) + 1)
    model = found.calibrations[0].model
    wanted = [
        i for i, (_, t) in enumerate(model.keys)
        if (t == CONSTANT if term == "1" else str(t) == term)
    ]  # fmt: skip
    for series, i in enumerate(wanted):
        U = np.array([c.U[i] for c in found.calibrations])
        values = found.values[:, i] - found.mean[i]
        axes.errorbar(
            runs + 0.06 * (series - (len(wanted) - 1) / 2.0), values,
            yerr=np.where(np.isfinite(U), U, 0.0), color=COLOURS[series % 6],
            marker=MARKERS[series % 8], capsize=2.0, linewidth=0.9, label=model.names[i],
        )  # fmt: skip
    axes.axhline(0.0, color="#000000", linewidth=0.6)
    axes.set_xticks(runs)
    axes.set_xlabel("run")
    axes.set_ylabel(f"less its mean [{model.units[wanted[0]] if wanted else model.unit}]")
    axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    _legend(axes, 3)


def runs_svg(comparison: Comparison) -> str:
    """Return the biases against the run as an SVG file."""
    figure, axes = new_figure()
    draw_runs(comparison, axes[0])
    return to_svg(figure)


def _noise(c: Calibration) -> Array:
    """Standard deviation (n, M) of a reading: as stated and believed, or as the residuals show."""
    if c.readings.u is not None and np.isinf(c.dof).all():
        return c.readings.u
    return np.broadcast_to(c.residual_sd, c.residuals.shape)


def _legend(axes: "Axes", columns: int) -> None:
    """Name the series above the axes, where no datum is."""
    axes.legend(loc="lower right", ncols=columns, fontsize=8, bbox_to_anchor=(1.0, 1.0),
                frameon=False, borderaxespad=0.0)  # fmt: skip


def _name_positions(axes: "Axes", names: tuple[str, ...]) -> None:
    step = -(-len(names) // _TICKS)
    at = np.arange(0, len(names), step)
    long = max(map(len, names)) > 3 and len(at) > 8
    axes.set_xticks(at, [names[i] for i in at], rotation=90 if long else 0)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_xlabel("position")


# --- Temperature


def draw_correction(
    regression: Regression,
    data: Source,
    axes: "Axes",
    *,
    variable: str | None = None,
    column: str | None = None,
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
    """
    table = read_table(data, what="data")
    name = variable or regression.range_variable
    target = column or regression.response
    x = table.number(name)
    found = correct(regression, table, column=target)
    before, after = table.number(target), np.asarray(found["corrected"])
    for values, label, colour, marker in (
        (before, "before", COLOURS[6], "x"),
        (after, "after", COLOURS[0], "."),
    ):
        axes.plot(x, values, color=colour, marker=marker, linestyle="none", markersize=3.0,
                  label=label)  # fmt: skip
    if name == regression.segment_variable:
        for edge in regression.edges:
            axes.axvline(edge, color="black", linewidth=0.8, linestyle="--")
    axes.axhline(0.0, color="black", linewidth=0.5)
    axes.set(xlabel=name, ylabel=target)
    axes.legend(frameon=False)


def draw_curve(curve: Curve, axes: "Axes") -> None:
    """Draw a parameter against temperature with its bands: U at one, and at all temperatures."""
    t = curve.temperature
    axes.fill_between(t, curve.value - curve.band, curve.value + curve.band, color=COLOURS[5],
                      alpha=0.35, linewidth=0.0, label="band, all temperatures")  # fmt: skip
    for sign in (-1.0, 1.0):
        axes.plot(t, curve.value + sign * curve.U, color=COLOURS[0], linewidth=0.8, linestyle="--",
                  label="U, one temperature" if sign > 0.0 else None)  # fmt: skip
    axes.plot(t, curve.value, color=COLOURS[0], linewidth=1.2, label=curve.name)
    axes.set(xlabel="temperature", ylabel=f"{curve.name} [{curve.unit}]")
    axes.legend(frameon=False)


def draw_path(segment: Segment, axes: "Axes") -> None:
    """Draw the F of every step of a selection; a removal hangs open, the runner-up is a bar's mark.

    F spans decades, so its axis is logarithmic; steps read downward as the path went.
    """
    steps = segment.path
    for row, step in enumerate(steps):
        added = step.action == "add"
        axes.barh(row, step.F, color=COLOURS[0] if added else "none", edgecolor=COLOURS[0],
                  hatch="" if added else "//")  # fmt: skip
        if step.runner_up is not None and step.runner_up.F > 0.0:
            axes.plot(step.runner_up.F, row, marker="D", color=COLOURS[1], linestyle="none")
    axes.set_yticks(
        range(len(steps)),
        [f"{'+' if step.action == 'add' else '−'} {step.term}" for step in steps],
    )
    if steps:
        axes.set_xscale("log")
    axes.invert_yaxis()
    axes.set(xlabel="F to enter or to remove; ◆ the runner-up")

"""The sections of a report on what was found: parameters, sensor, uncertainty, compensation.

A section is paragraphs, figures and tables; numbers are text here, with the digits that their
uncertainty leaves. Figures are functions and drawn only where they are wanted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from multipos.files.numbers import number, uncertain
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import COMPONENTS
from multipos.plots.calibration import draw_budget
from multipos.plots.style import new_figure, to_svg
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.derived import intrinsic_gradient
from multipos.uncertainty.budgets import KINDS
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.validity import evaluate_sphere


@dataclass(frozen=True)
class Grid:
    """A table: its caption, header and rows of text; the first `left` columns hold words."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1


@dataclass(frozen=True)
class Figure:
    """A figure: caption, what it shows in words, and the function that draws it as SVG."""

    caption: str
    description: str
    draw: Callable[[], str]


@dataclass(frozen=True)
class Section:
    """A section of the report, in the order paragraphs, figures, tables."""

    title: str
    paragraphs: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Grid, ...] = ()


def draw_svg(tr: Translator, rows: int, height: float, draw: Callable[[Any], None]) -> str:
    """Return a figure of so many axes as SVG with its words translated."""
    figure, axes = new_figure(rows, height=height)
    draw(axes)
    return tr.svg(to_svg(figure))


def parameters_section(c: Calibration, tr: Translator) -> Section:
    """Return the parameters with their uncertainty."""
    rows = []
    for output, term in c.model.keys:
        p = c[output, str(term)]
        rows.append(
            (
                p.name,
                p.symbol or "",
                tr.message(p.label),
                p.unit,
                uncertain(p.value, p.u),
                number(p.u, 2),
                number(p.k, 3),
                number(p.U, 2),
                number(p.dof),
            )
        )
    header = ("Parameter", "Symbol", "Meaning", "Unit", "Value(u)", "u", "k", "U", "dof")
    symbols = any(row[1] for row in rows)
    keep = [i for i in range(len(header)) if symbols or i != 1]
    return Section(
        tr("Results"),
        (
            tr(
                "The model of output i is y_i = sum of coefficients times terms of the reference "
                "in g; the terms of each output are in the table."
            ),
            tr(
                "U = k u is the expanded uncertainty for a coverage probability of {percent} %, "
                "with k from Student's t at the effective degrees of freedom (dof). It says how "
                "well the coefficients of this model are known. Whether the model is right is "
                "outside it; the residuals and checks below speak of that.",
                percent=f"{100.0 * c.confidence:g}",
            ),
        ),
        tables=(
            Grid(
                tr("Parameters with uncertainty"),
                tuple(tr(header[i]) for i in keep),
                tuple(tuple(row[i] for i in keep) for row in rows),
                left=4 if symbols else 3,
            ),
        ),
    )


def sensor_section(c: Calibration, budget: Evaluation, tr: Translator) -> Section:
    """Return what the sensor is: sensitivities, offsets, angles, with U."""
    rows = []
    if c.intrinsic is not None:
        values, gradient = intrinsic_gradient(c.model, c.parameters, c.mean_environment)
        u, dof, _ = budget.combine(gradient)
        m = len(c.outputs)
        names = [
            *((tr("Sensitivity of {output}", output=o), f"{c.model.unit}/g") for o in c.outputs),
            *((tr("Offset of {output}", output=o), "g") for o in c.outputs),
            *((tr("Angle between input axes {pair}", pair=p), "deg") for p in ("xy", "xz", "yz")),
            *((tr("Mounting, rotation about {axis}", axis=a), "deg") for a in COMPONENTS),
        ]
        for (name, unit), value, sd, nu in zip(
            names, values.tolist(), u.tolist(), dof.tolist(), strict=True
        ):
            k = coverage_factor(c.confidence, nu)
            shown = "1" if unit == "g/g" else unit
            rows.append((name, shown, uncertain(value, sd), number(k * sd, 2), number(k, 3)))
        assert len(names) == 2 * m + 6
    for pair, found in c.installation_deg.items():
        in_mrad = {key: np.pi / 0.18 * size for key, size in found.items()}
        for unit, entry in (("deg", found), ("mrad", in_mrad)):
            rows.append(
                (
                    tr("Output on {i} leans to {j}", i=pair[0], j=pair[1]),
                    unit,
                    uncertain(entry["value"], entry["u"]),
                    number(entry["U"], 2),
                    number(entry["U"] / entry["u"] if entry["u"] else None, 3),
                )
            )
    if not rows:
        return Section(tr("The sensor"), (tr("The model has too few linear terms for it."),))
    header = tuple(map(tr, ("Quantity", "Unit", "Value(u)", "U", "k")))
    return Section(
        tr("The sensor"),
        (tr("Quantities derived from the parameters, with their full covariance."),),
        tables=(Grid(tr("Sensitivity, offset and axes"), header, tuple(rows), left=2),),
    )


def budget_section(c: Calibration, budget: Evaluation, tr: Translator) -> Section:
    """Return the budget: quantities and what each contributes."""
    seen, lines = set(), []
    for row in budget.rows:
        if row.quantity in seen:
            continue
        seen.add(row.quantity)
        lines.append(
            (
                tr(row.text),
                row.evaluation,
                tr(row.distribution),
                number(row.u, 3),
                row.unit,
                number(float(row.dof.min())),
                tr("yes") if row.common else tr("no"),
                tr("in the scatter") if row.contained.all() else tr("added"),
            )
        )
    stated = c.budget_tables
    absent = [
        tr(kind.text) for name, kind in KINDS.items() if name not in seen and name not in stated
    ]
    names = list(dict.fromkeys(row.quantity for row in budget.rows))
    contributions = [
        (name, *(_contribution(budget, quantity, i) for quantity in names), number(c.u[i], 2))
        for i, name in enumerate(budget.names)
    ]
    paragraphs = [
        tr(
            "Every input quantity enters by what it does to the parameters through this estimator "
            "at these positions. Quantities marked as common are systematic: they are the same at "
            "all positions and in repeated calibrations. What stands in brackets is independent at "
            "every position, so the scatter of the residuals holds it already and it is not "
            "added again."
        )
    ]
    if absent:
        paragraphs.append(tr("Not in the budget: {list}.", list=tr.listed(absent)))
    return Section(
        tr("Uncertainty budget"),
        tuple(paragraphs),
        (
            Figure(
                tr("Share of every input quantity in the variance of each parameter"),
                tr("Stacked bars, one for each parameter; the numbers are in the table below."),
                lambda: draw_svg(
                    tr,
                    1,
                    0.9 + 0.2 * len(budget.names),
                    lambda axes: draw_budget(budget, axes[0]),
                ),
            ),
        ),
        (
            Grid(
                tr("Input quantities"),
                tuple(
                    map(
                        tr,
                        (
                            "Quantity",
                            "Type",
                            "Distribution",
                            "u",
                            "Unit",
                            "dof",
                            "Common",
                            "Treatment",
                        ),
                    )
                ),
                tuple(lines),
                left=3,
            ),
            Grid(
                tr("Contributions to the standard uncertainty of each parameter"),
                (tr("Parameter"), *(tr(name) for name in names), tr("combined u")),
                tuple(contributions),
            ),
        ),
    )


def _contribution(budget: Evaluation, quantity: str, parameter: int) -> str:
    """Return what a quantity contributes; in brackets what the scatter holds already."""
    rows = [row for row in budget.rows if row.quantity == quantity]
    size = float(np.sqrt(sum(max(row.covariance[parameter, parameter], 0.0) for row in rows)))
    if not size > 1e-12 * float(np.sqrt(budget.covariance[parameter, parameter])):
        return "0"  # rounding
    contained = any(row.contained[parameter] for row in rows)
    return f"({number(size, 2)})" if contained else number(size, 2)


def sphere_section(c: Calibration, tr: Translator) -> Section:
    """Return how well force and tilt are known, and where."""
    rows = []
    allowed = "third_order" in c.budget_tables
    for size in (1.0, 2.0, 5.0) if allowed else (1.0,):
        for what, axes in evaluate_sphere(c, size=size).items():
            if what == "tilt_deg" and size > 1.0:
                continue
            for axis, entry in axes.items():
                rows.append(
                    (
                        tr("force along {axis}", axis=axis)
                        if what == "force"
                        else tr("tilt of {axis}", axis=axis),
                        f"{size:g} g" + ("" if size <= 1.0 else " *"),
                        "g" if what == "force" else "deg",
                        number(entry["rms"], 2),
                        number(entry["worst"], 2),
                        number(entry["k"], 3),
                        number(entry["U"], 2),
                        ", ".join(f"{v / size:.2f}" for v in entry["at"]),
                    )
                )
    paragraphs = [
        tr(
            "Uncertainty of compensated force and of tilt from the parameters, over all "
            "directions; the noise of the reading that is compensated comes on top."
        ),
        tr(
            "Lines marked * are beyond what was applied; U there grows with the third-order term "
            "that the budget allows."
        )
        if allowed
        else tr(
            "The calibration holds within what was applied, up to {size} g. Beyond, terms that the "
            "positions cannot show may grow without limit.",
            size=f"{float(np.linalg.norm(c.reference, axis=1).max()):.4g}",
        ),
    ]
    header = ("Quantity", "At", "Unit", "rms u", "worst u", "k", "U", "Worst direction")
    return Section(
        tr("Compensated force and tilt"),
        tuple(paragraphs),
        tables=(
            Grid(
                tr("Worst case and rms over the sphere"),
                tuple(map(tr, header)),
                tuple(rows),
                left=3,
            ),
        ),
    )

"""The sections of a report on what was found: parameters, sensor, uncertainty, compensation."""

from collections.abc import Sequence

import numpy as np

from multipos.diagnostics.model_error import not_stated
from multipos.diagnostics.projections import shown_sizes
from multipos.files.numbers import (
    common_units,
    decimals_of,
    largest_rows,
    number,
    plain_number,
    pretty_unit,
    readable_unit,
)
from multipos.numerics.arrays import COMPONENTS
from multipos.reports.quantities import leaning_quantities, parameter_cells, quantity_rows
from multipos.reports.sections import LONG_TABLE, PageTable, Section, Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.uncertainty.budgets import KINDS
from multipos.uncertainty.propagation import Evaluation, Row
from multipos.uncertainty.validity import applied, evaluate_sphere, unseen_sizes


def parameters_section(c: Calibration, tr: Translator) -> Section:
    """Return the parameters with their uncertainty, and how the outputs lean."""
    leaning = quantity_rows(leaning_quantities(c, tr)) if c.intrinsic is not None else []
    header = tuple(map(tr, ("Quantity", "Value", "U", "Unit", "k")))
    installed = (PageTable(tr("Installation"), header, tuple(leaning)),) if leaning else ()
    return Section(
        tr("Parameters"),
        (
            _equation(c, tr),
            tr(
                "U = k u is the expanded uncertainty for a coverage probability of {percent} %, "
                "with k from Student's t at the effective degrees of freedom (dof). It is the "
                "uncertainty of the coefficients of this model. Whether the model is right is "
                "outside it; see the residuals and checks below.",
                percent=f"{100.0 * c.confidence:g}",
            ),
        ),
        tables=(_parameter_table(c, tr), *installed),
    )


def _equation(c: Calibration, tr: Translator) -> str:
    """Return the measurement equation: the terms of the table, or formulas as they were written."""
    if isinstance(c.model, ExpressionModel):
        return tr(
            "Each output reads, in the reference x, y, z and that along its own axis [{unit}]: "
            "{model}.",
            model=c.model.text,
            unit=c.field.printed,
        )
    return tr(
        "The model of output i is y_i = sum of coefficients times terms of the reference "
        "in g; the terms of each output are in the table."
    )


def _parameter_table(c: Calibration, tr: Translator) -> PageTable:
    """Return every parameter; the column of symbols only where there are any."""
    entries = [c[output, str(term)] for output, term in c.model.keys]
    cells = parameter_cells(entries)
    rows = [
        (p.name, p.symbol or "", tr.message(p.label), *row, plain_number(p.k, 3), number(p.dof))
        for p, row in zip(entries, cells, strict=True)
    ]
    header = ("Parameter", "Symbol", "Meaning", "Value", "u", "U", "Unit", "k", "dof")
    symbols = any(row[1] for row in rows)
    keep = [i for i in range(len(header)) if symbols or i != 1]
    return PageTable(
        tr("Parameters with uncertainty"),
        tuple(tr(header[i]) for i in keep),
        tuple(tuple(row[i] for i in keep) for row in rows),
        left=3 if symbols else 2,
        kept=_surest(c),
    )


def _surest(c: Calibration) -> tuple[int, ...]:
    """Return which parameters of many the body shows: those that most exceed their u."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.abs(c.parameters) / c.u
    return tuple(sorted(largest_rows(sizes.tolist(), LONG_TABLE, LONG_TABLE)))


def budget_section(c: Calibration, budget: Evaluation, tr: Translator) -> Section:
    """Return the budget: quantities and what each contributes."""
    paragraphs = [
        tr(
            "Every input quantity enters by what it does to the parameters through this estimator "
            "at these positions. Quantities marked as common are systematic: they are the same at "
            "all positions and in repeated calibrations. What stands in brackets is independent at "
            "every position, so the residual noise holds it already and it is not "
            "added again."
        )
    ]
    absent = _absent_quantities(c, budget)
    if absent:
        paragraphs.append(tr("Not in the budget: {list}.", list=tr.listed(list(map(tr, absent)))))
    return Section(
        tr("Uncertainty budget"),
        tuple(paragraphs),
        tables=(_quantity_table(budget, tr), _contribution_table(c, budget, tr)),
    )


def _absent_quantities(c: Calibration, budget: Evaluation) -> list[str]:
    """Return what a budget could state and this one does not, in plain words."""
    known = {row.quantity for row in budget.rows}.union(c.budget_tables)
    return [kind.text for name, kind in KINDS.items() if name not in known]


def _quantity_table(budget: Evaluation, tr: Translator) -> PageTable:
    """Return the input quantities, each once."""
    first = {row.quantity: row for row in reversed(budget.rows)}
    lines = [
        (
            tr(row.text),
            row.evaluation,
            tr(row.distribution),
            *_scaled(row.u, row.unit),
            number(float(row.dof.min())),
            tr("yes") if row.common else tr("no"),
            _treatment(row, tr),
        )
        for row in budget.rows
        if row is first[row.quantity]
    ]
    header = ("Quantity", "Evaluation", "Distribution", "u", "Unit", "dof", "Common", "Treatment")
    return PageTable(tr("Input quantities"), tuple(map(tr, header)), tuple(lines), left=3)


def _treatment(row: Row, tr: Translator) -> str:
    """Return what becomes of a quantity: added, unless the scatter holds it."""
    if row.contained.all():
        return tr("in the residuals")
    return tr("added")


def _contribution_table(c: Calibration, budget: Evaluation, tr: Translator) -> PageTable:
    """Return what every quantity contributes to every parameter."""
    quantities = list(dict.fromkeys(row.quantity for row in budget.rows))
    rows = []
    units = common_units(zip(c.model.units, c.u.tolist(), strict=True))
    for i, (name, unit) in enumerate(zip(budget.names, c.model.units, strict=True)):
        factor, shown = units[unit]
        cells = [_contribution(budget, quantity, i, factor) for quantity in quantities]
        rows.append((name, *cells, plain_number(factor * float(c.u[i]), 2), shown))
    quantity_names = map(tr, quantities)
    return PageTable(
        tr("Contributions to the standard uncertainty of each parameter"),
        (tr("Parameter"), *quantity_names, tr("combined u"), tr("Unit")),
        tuple(rows),
        kept=_surest(c),
    )


def _scaled(size: float, unit: str) -> tuple[str, str]:
    """Return a size to three digits, and the unit that people read it in."""
    if not np.isfinite(size):
        return "-", pretty_unit(unit)
    factor, shown = readable_unit(size, unit)
    return f"{float(f'{factor * size:.3g}'):g}", shown


def _contribution(budget: Evaluation, quantity: str, parameter: int, factor: float) -> str:
    """Return what a quantity contributes, in the unit of its row by `factor`.

    To one digit more than the combined u; in brackets what the scatter holds already.
    """
    rows = [row for row in budget.rows if row.quantity == quantity]
    size = float(np.sqrt(sum(max(row.covariance[parameter, parameter], 0.0) for row in rows)))
    combined = float(np.sqrt(budget.covariance[parameter, parameter]))
    if not size > 1e-12 * combined:
        return "0"  # rounding
    decimals = decimals_of(factor * combined)
    printed = plain_number(factor * size, 2)
    if decimals is not None and size < combined:
        printed = f"{factor * size:.{decimals + 1}f}"
    return f"({printed})" if any(row.contained[parameter] for row in rows) else printed


def sphere_section(c: Calibration, tr: Translator) -> Section:
    """Return how well force and tilt are known, and where."""
    allowed, hidden = bool(unseen_sizes(c)), not_stated(c)
    seen = applied(c)
    forced = (seen.largest,) if c.readings.forced.any() and seen.largest > 1.0 else ()
    sizes = sorted({1.0, *forced, *((2.0, 5.0) if allowed else ())})
    if c.field.magnetic:
        sizes = [c.field.magnitude]
    rows = _sphere_rows(c, sizes, max((1.0, *forced)), tr)
    paragraphs = [
        tr(
            "Uncertainty of compensated force and of tilt from the parameters, over all "
            "directions; the noise of the reading that is compensated comes on top."
        ),
        tr(
            "Lines marked * are beyond what was applied; U there grows with the terms that the "
            "budget states."
        )
        if allowed
        else tr(
            "The calibration holds within what was applied, up to {size} {unit}. Beyond, omitted "
            "terms may grow without limit.",
            size=f"{seen.largest:.4g}",
            unit=pretty_unit(c.field.unit),
        ),
    ]
    if hidden:
        without = tr(
            "{terms} cannot be determined from these positions and is not included in U between "
            "them.",
            terms=", ".join(hidden),
        )
        paragraphs[1:] = [paragraphs[1], without] if allowed else [without]
        paragraphs += _seen_terms(c, tr)
    if c.model.inputs == COMPONENTS and not c.readings.forced.any():
        paragraphs.append(
            tr(
                "No static positions can separate the sum of the squares of x, y and z from a "
                "bias: at rest it is one."
            )
        )
    if c.readings.forced.any():
        printed = seen.in_words(c.model.sensed_axes)
        paragraphs.append(
            tr("Forces that were applied in addition to gravity: {range}.", range=printed)
        )
    header = ("Quantity", "At", "rms u", "worst u", "U", "Unit", "k", "Worst direction")
    return Section(
        tr("Compensated force and tilt"),
        tuple(paragraphs),
        tables=(
            PageTable(
                tr("Worst case and rms over the sphere"),
                tuple(map(tr, header)),
                tuple(rows),
                left=2,
            ),
        ),
    )


def _seen_terms(c: Calibration, tr: Translator) -> list[str]:
    """Return the sizes of terms that the positions show, beside which hidden ones are judged."""
    listed = [f"{name} ({c.field.shown(size)})" for name, size in shown_sizes(c).items()]
    said = "Of higher order these positions do show {terms}, with what noise leaves open."
    return [tr(said, terms=", ".join(listed))] if listed else []


def _sphere_rows(
    c: Calibration, sizes: Sequence[float], seen: float, tr: Translator
) -> list[tuple[str, ...]]:
    """Return force at each size [g], beyond `seen` marked, and tilt at 1 g, by axis."""
    unit = c.field.printed
    words = {"force": ("force along {axis}", unit), "tilt_deg": ("tilt of {axis}", "deg")}
    rows: list[tuple[str, ...]] = []
    evaluated = {size: evaluate_sphere(c, size=size) for size in sizes}
    units = common_units(
        (words[what][1], entry["U"])
        for found in evaluated.values()
        for what, axes in found.items()
        for entry in axes.values()
    )
    for size, found in evaluated.items():
        for what in ("force",) if size > 1.0 or c.field.magnetic else found:
            text, unit = words[what]
            for axis, entry in found[what].items():
                factor, shown = units[unit]
                rows.append(
                    (
                        tr(text, axis=axis),
                        f"{size:g} {pretty_unit(c.field.printed)}"
                        + ("" if size <= seen or c.field.magnetic else " *"),
                        *(plain_number(factor * entry[key], 2) for key in ("rms", "worst", "U")),
                        shown,
                        plain_number(entry["k"], 3),
                        ", ".join(f"{v / size:.2f}" for v in entry["at"]),
                    )
                )
    return rows

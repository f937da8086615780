"""The sections of a report on what came out of a calibration.

`result_section` is the first screen: one picture of all errors before and after, how far the
result holds, and sensitivities, offsets and angles. Then `parameters_section`, `budget_section`
with what each input contributes, and `sphere_section` on compensated force and tilt over all
directions.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

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
from multipos.plots.pictures import error_picture
from multipos.positions.headers import TEMPERATURE
from multipos.reports.quantities import (
    QUANTITY_HEADER,
    Quantity,
    derived_quantities,
    leaning_quantities,
    leaning_table,
    parameter_cells,
    quantity_rows,
)
from multipos.reports.sections import LONG_TABLE, Figure, PageTable, Section
from multipos.sensor.calibration import Calibration, has_nominal
from multipos.uncertainty.budgets import KINDS
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.sphere import evaluate_sphere
from multipos.uncertainty.unseen_terms import unseen_sizes
from multipos.uncertainty.validity import applied


def result_section(c: Calibration, budget: Evaluation, *, forces: bool) -> Section:
    """Return the first screen below the answer: errors before and after, validity, the sensor.

    Parameters
    ----------
    c : Calibration
    budget : Evaluation
    forces : bool
        Whether readings give forces, so that there are errors to speak of.
    """
    rows = quantity_rows(derived_quantities(c, budget) or _of_few_axes(c))
    picture = Figure(
        f"Errors at all positions{', before and' if has_nominal(c) else ''} after compensation",
        (
            "The two halves of the sphere of up vectors. Arrows are errors perpendicular to, rings "
            "errors along the up vector, filled where they point out; each picture has a scale of "
            "its own, as the arrow at its largest error shows."
        ),
        partial(error_picture, c),
    )
    caption = f"Sensitivity, offset and axes, U with {100.0 * c.confidence:g} %"
    return Section(
        "Result",
        (_validity(c),),
        (picture,) if forces else (),
        (PageTable(caption, QUANTITY_HEADER, tuple(rows)),) if rows else (),
    )


def _validity(c: Calibration) -> str:
    """Return within what the calibration holds."""
    said = f"Valid for forces {pretty_unit(applied(c).in_words(c.model.sensed_axes))}"
    for name in c.model.environment:
        column = c.readings.environment[name]
        unit = " °C" if name == TEMPERATURE else ""
        said += f", {name} {column.min():.4g} to {column.max():.4g}{unit}"
    return said + "."


def _of_few_axes(c: Calibration) -> list[Quantity]:
    """Return scale factors, biases and how the outputs lean, of one or two axes."""
    wanted = [p for p in c.entries if p.name.startswith(("scale_", "bias_"))]
    wanted.sort(key=lambda p: not p.name.startswith("scale_"))
    found = [Quantity(p.label, p.unit, p.value, p.u, p.U, p.k) for p in wanted]
    return found + leaning_quantities(c)


def parameters_section(c: Calibration) -> Section:
    """Return the parameters with their uncertainty, and how the outputs lean."""
    installed = leaning_table(c) if c.intrinsic is not None else ()
    return Section(
        "Parameters",
        (
            c.model.equation,
            (
                "U = k u is the expanded uncertainty for a coverage probability of "
                f"{100.0 * c.confidence:g} %, with k from Student's t at the effective degrees of "
                "freedom (dof). It is the uncertainty of the coefficients of this model. Whether "
                "the model is right is outside it; see the residuals and checks below."
            ),
        ),
        tables=(_parameter_table(c), *installed),
    )


def _parameter_table(c: Calibration) -> PageTable:
    """Return every parameter; the column of symbols only where there are any."""
    entries = [c[output, str(term)] for output, term in c.model.keys]
    cells = parameter_cells(entries)
    rows = [
        (p.name, p.symbol or "", p.label, *row, plain_number(p.k, 3), number(p.dof))
        for p, row in zip(entries, cells, strict=True)
    ]
    header = ("Parameter", "Symbol", "Meaning", "Value", "u", "U", "Unit", "k", "dof")
    symbols = any(row[1] for row in rows)
    keep = [i for i in range(len(header)) if symbols or i != 1]
    return PageTable(
        "Parameters with uncertainty",
        tuple(header[i] for i in keep),
        tuple(tuple(row[i] for i in keep) for row in rows),
        left=3 if symbols else 2,
        kept=_surest(c),
    )


def _surest(c: Calibration) -> tuple[int, ...]:
    """Return which parameters of many the body shows: those that most exceed their u."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.abs(c.parameters) / c.u
    return tuple(sorted(largest_rows(sizes.tolist(), LONG_TABLE)))


def budget_section(c: Calibration, budget: Evaluation) -> Section:
    """Return the budget: quantities and what each contributes."""
    paragraphs = [
        (
            "Every input quantity enters by what it does to the parameters through this estimator "
            "at these positions. Quantities marked as common are systematic: they are the same at "
            "all positions and in repeated calibrations. What stands in brackets is independent at "
            "every position, so the residual noise holds it already and it is not "
            "added again."
        )
    ]
    held = c.estimator.contains | c.estimator.unaffected_by
    known = {row.quantity for row in budget.rows}.union(c.budget_tables, held)
    absent = [kind.text for name, kind in KINDS.items() if name not in known]
    if absent:
        paragraphs.append(f"Not in the budget: {', '.join(absent)}.")
    return Section(
        "Uncertainty budget",
        tuple(paragraphs),
        tables=(_quantity_table(c, budget), _contribution_table(c, budget)),
    )


def _quantity_table(c: Calibration, budget: Evaluation) -> PageTable:
    """Return the input quantities, each once."""
    first = {row.quantity: row for row in reversed(budget.rows)}
    lines = [
        (
            c.field.worded(row.text),
            row.evaluation,
            row.distribution,
            *_scaled(row.u, row.unit),
            number(float(row.dof.min())),
            "yes" if row.common else "no",
            "in the residuals" if row.contained.all() else "added",
        )
        for row in budget.rows
        if row is first[row.quantity]
    ]
    header = ("Quantity", "Evaluation", "Distribution", "u", "Unit", "dof", "Common", "Treatment")
    return PageTable("Input quantities", header, tuple(lines), left=3)


def _contribution_table(c: Calibration, budget: Evaluation) -> PageTable:
    """Return what every quantity contributes to every parameter."""
    quantities = list(dict.fromkeys(row.quantity for row in budget.rows))
    rows = []
    units = common_units(zip(c.model.units, c.u.tolist(), strict=True))
    for i, (name, unit) in enumerate(zip(budget.names, c.model.units, strict=True)):
        factor, shown = units[unit]
        cells = [_contribution(budget, quantity, i, factor) for quantity in quantities]
        rows.append((name, *cells, plain_number(factor * float(c.u[i]), 2), shown))
    return PageTable(
        "Contributions to the standard uncertainty of each parameter",
        ("Parameter", *quantities, "combined u", "Unit"),
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


def sphere_section(c: Calibration) -> Section:
    """Return how well force and tilt are known, and where."""
    allowed, hidden = bool(unseen_sizes(c)), not_stated(c)
    seen = applied(c)
    at_rest = c.field.full_scale
    largest = max(at_rest, seen.largest if c.readings.forced.any() else 0.0)
    sizes = sorted({at_rest, largest, *(c.field.beyond if allowed else ())})
    rows = _sphere_rows(c, sizes, largest)
    paragraphs = [
        (
            "Uncertainty of compensated force and of tilt from the parameters, over all "
            "directions; the noise of the reading that is compensated comes on top."
        ),
        (
            "Lines marked * are beyond what was applied; U there grows with the terms that the "
            "budget states."
        )
        if allowed
        else (
            f"The calibration holds within what was applied, up to {seen.largest:.4g} "
            f"{pretty_unit(c.field.unit)}. Beyond, omitted terms may grow without limit."
        ),
    ]
    if hidden:
        without = (
            f"{', '.join(hidden)} cannot be determined from these positions and is not included "
            "in U between them."
        )
        paragraphs[1:] = [paragraphs[1], without] if allowed else [without]
        listed = [f"{name} ({c.field.shown(size)})" for name, size in shown_sizes(c).items()]
        omitted = f"The model omits {', '.join(listed)}, which these positions would show; in "
        paragraphs += [f"{omitted}parentheses the size that noise allows."] if listed else []
    if c.model.inputs == COMPONENTS and not c.readings.forced.any():
        paragraphs.append(
            "No static positions can separate the sum of the squares of x, y and z from a "
            "bias: at rest it is one."
        )
    if c.readings.forced.any():
        printed = seen.in_words(c.model.sensed_axes)
        paragraphs.append(f"Forces that were applied in addition to gravity: {printed}.")
    header = ("Quantity", "At", "rms u", "worst u", "U", "Unit", "k", "Worst direction")
    return Section(
        "Compensated force and tilt",
        tuple(paragraphs),
        tables=(PageTable("Worst case and rms over the sphere", header, tuple(rows), left=2),),
    )


def _sphere_rows(c: Calibration, sizes: Sequence[float], seen: float) -> list[tuple[str, ...]]:
    """Return force at each size [g], beyond `seen` marked, and tilt at 1 g, by axis."""
    evaluated = {size: evaluate_sphere(c, size=size) for size in sizes}
    words = {
        "force": (f"{c.field.quantity} along", c.field.printed),
        "tilt_deg": ("tilt of", "deg"),
    }
    units = common_units(
        (words[what][1], entry["U"])
        for found in evaluated.values()
        for what, axes in found.items()
        for entry in axes.values()
    )
    rows: list[tuple[str, ...]] = []
    for size, found in evaluated.items():
        at = f"{size:g} {pretty_unit(c.field.printed)}{'' if size <= seen else ' *'}"
        at_rest = f"{c.field.angle}_deg" if size <= c.field.full_scale else ""
        for what in (name for name in found if name in ("force", at_rest)):
            text, unit = words[what]
            rows += [
                (f"{text} {axis}", at, *_sphere_cells(entry, size, units[unit]))
                for axis, entry in found[what].items()
            ]
    return rows


def _sphere_cells(
    entry: Mapping[str, Any], size: float, unit: tuple[float, str]
) -> tuple[str, ...]:
    """Return rms, worst u, U, unit, k and the worst direction."""
    factor, shown = unit
    return (
        *(plain_number(factor * entry[key], 2) for key in ("rms", "worst", "U")),
        shown,
        plain_number(entry["k"], 3),
        ", ".join(f"{v / size:.2f}" for v in entry["at"]),
    )

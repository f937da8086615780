"""What a report says was found: the result, parameters, uncertainty, compensation.

Values stand with their uncertainty: in a unit that people read, to the digits of u. A row has one
unit, by the larger of value and U; a column of numbers of one unit has one as well.

The first screen is the result, one picture of all errors before and after, and how far it holds;
what is signed last, and the equipment, are here as well.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from multipos.diagnostics.model_error import not_stated
from multipos.diagnostics.projections import shown_sizes
from multipos.files.numbers import (
    beside,
    beyond_rounding,
    common_units,
    decimals_of,
    fixed,
    largest_rows,
    most_of,
    number,
    plain_number,
    pretty_unit,
    readable_unit,
)
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.quantiles import coverage_factor
from multipos.plots.pictures import error_picture
from multipos.positions.headers import TEMPERATURE
from multipos.reports.sections import (
    LONG_TABLE,
    Figure,
    PageTable,
    Section,
    chosen_rows,
)
from multipos.sensor.calibration import Calibration, Parameter, has_nominal
from multipos.sensor.derived import intrinsic_gradient
from multipos.uncertainty.budgets import KINDS
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.validity import applied, evaluate_sphere, unseen_sizes
from multipos.units import unit_per


class Quantity(NamedTuple):
    """A quantity with its uncertainty."""

    name: str
    unit: str
    value: float
    u: float
    U: float
    k: float


class Column(NamedTuple):
    """Numbers of one unit as cells, and the unit."""

    unit: str
    cells: list[str]


def derived_quantities(c: Calibration, budget: Evaluation) -> list[Quantity]:
    """Return sensitivities, offsets, angles between axes and mounting of a triad; else nothing.

    What the gauge has fixed is left out.
    """
    if c.intrinsic is None:
        return []
    values, gradient = intrinsic_gradient(c.model, c.parameters, c.mean_environment)
    u, dof, _ = budget.combine(gradient)
    per = unit_per(c.model.unit, 1, (), c.field.unit)
    names = [
        *((f"Sensitivity of {o}", per) for o in c.outputs),
        *((c.field.worded(f"Offset of {o}"), c.field.printed) for o in c.outputs),
        *((f"Angle between input axes {p}", "deg") for p in ("xy", "xz", "yz")),
        *((f"Mounting, rotation about {a}", "deg") for a in COMPONENTS),
    ]
    if c.model.gauge is not None:
        names = names[:-3]
    found = zip(names, values.tolist(), u.tolist(), dof.tolist(), strict=False)
    quantities = []
    for (name, unit), value, sd, nu in found:
        k = coverage_factor(c.confidence, nu)
        quantities.append(Quantity(name, unit, value, sd, k * sd, k))
    for i, p in enumerate((c[output, "1"] for output in c.outputs), start=len(c.outputs)):
        of_readings = Quantity(quantities[i].name, p.unit, p.value, p.u, p.U, p.k)
        quantities[i] = c.field.zero(quantities[i], of_readings)
    return quantities


def leaning_quantities(c: Calibration) -> list[Quantity]:
    """Return how far each output leans to the others; without what the gauge has fixed."""
    return [
        Quantity(
            f"Output on {pair[0]}, tilt to {pair[1]}",
            "deg",
            angle["value"],
            angle["u"],
            angle["U"],
            angle["U"] / angle["u"],
        )
        for pair, angle in c.installation_deg.items()
        if angle["u"]
    ]


def quantity_rows(found: Sequence[Quantity]) -> list[tuple[str, ...]]:
    """Return name, value, U, unit and k of each; those of one unit have it in common."""
    units = common_units((q.unit, most_of(q.value, q.U)) for q in found)
    rows: list[tuple[str, ...]] = []
    for q in found:
        factor, unit = units[q.unit]
        shown = beside(factor * q.value, factor * q.u, factor * q.U)
        rows.append((q.name, *shown, unit, plain_number(q.k, 3)))
    return rows


def parameter_cells(entries: Iterable[Parameter]) -> list[tuple[str, str, str, str]]:
    """Return value, u, U and unit of parameters; those of one unit have it in common."""
    given = list(entries)
    units = common_units((p.unit, most_of(p.value, p.U)) for p in given)
    return [with_u(p.value, p.u, p.U, units[p.unit]) for p in given]


def with_u(
    value: float, u: float, U: float, unit: str | tuple[float, str]
) -> tuple[str, str, str, str]:
    """Return a value, its u and its U to the digits of u, and the unit of all three.

    `unit` is that of the numbers, or the one to print with its factor, as of `common_units`.
    """
    factor, shown = readable_unit(most_of(value, U), unit) if isinstance(unit, str) else unit
    decimals = decimals_of(factor * u)
    value_cell, U_cell = beside(factor * value, factor * u, factor * U)
    return value_cell, "-" if decimals is None else f"{factor * u:.{decimals}f}", U_cell, shown


def column(
    values: Sequence[float] | Array,
    unit: str | tuple[float, str],
    u: float | None = None,
    *,
    signed: bool = False,
    scale: float = 1.0,
) -> Column:
    """Return numbers as cells of one unit, to the digits of `u`, else to three.

    What is but the rounding of numbers of size `scale` is 0. `unit` is that of the numbers, or
    the one to print with its factor, as of `readable_unit`.
    """
    values = [beyond_rounding(x, scale) for x in np.asarray(values, dtype=np.float64).tolist()]
    u = None if u is None else beyond_rounding(u, scale)
    sizes = np.abs(np.asarray(values))
    if isinstance(unit, str):
        unit = readable_unit(float(np.max(sizes[np.isfinite(sizes)], initial=0.0)), unit)
    factor, shown = unit
    decimals = None if u is None else decimals_of(factor * u)
    cells = []
    for value in (factor * np.asarray(values, dtype=np.float64)).tolist():
        if not np.isfinite(value):
            cells.append(number(value))
        elif decimals is None:
            sign = "+" if signed and value > 0.0 else ""
            cells.append(sign + plain_number(value))
        else:
            cells.append(fixed(value, decimals, signed=signed))
    return Column(shown, cells)


EQUIPMENT = {
    "name": "Equipment",
    "type": "Type",
    "serial": "Serial number",
    "calibrated": "Calibrated",
    "due": "Due",
    "certificate": "Certificate",
}
_LINE = "________________"  # to be written on by hand


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
    header = ("Quantity", "Value", "U", "Unit", "k")
    caption = f"Sensitivity, offset and axes, U with {100.0 * c.confidence:g} %"
    return Section(
        "Result",
        (_validity(c),),
        (_picture(c),) if forces else (),
        (PageTable(caption, header, tuple(rows)),) if rows else (),
    )


def _picture(c: Calibration) -> Figure:
    return Figure(
        f"Errors at all positions{', before and' if has_nominal(c) else ''} after compensation",
        (
            "The two halves of the sphere of up vectors. Arrows are errors perpendicular to, rings "
            "errors along the up vector, filled where they point out; each picture has a scale of "
            "its own."
        ),
        partial(error_picture, c),
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


def readings_table(c: Calibration) -> PageTable:
    """Return the readings as they were measured, with what was stated of each."""
    shown, kept, suffix = chosen_rows(c.relative_residuals)
    r = c.readings
    columns: list[tuple[str, Sequence[str]]] = [("Position", r.labels)]
    for i, output in enumerate(c.outputs):
        decimals = decimals_of(float(c.residual_sd[i]))
        form = ".10g" if decimals is None or decimals > 12 else f".{decimals + 1}f"
        columns.append((f"{output} [{c.model.unit}]", [f"{v:{form}}" for v in r.values[:, i]]))
    if r.u is not None:
        for i, output in enumerate(c.outputs):
            stated = column(r.u[:, i], c.model.unit)
            columns.append((f"u {output} [{stated.unit}]", stated.cells))
    if r.samples is not None:
        columns.append(("n", [f"{n:g}" for n in r.samples]))
    columns += [(name, [f"{v:.6g}" for v in r.environment[name]]) for name in c.model.environment]
    rows = tuple(tuple(column[row] for _, column in columns) for row in shown)
    header = tuple(name for name, _ in columns)
    return PageTable("Readings as measured" + suffix, header, rows, kept=kept)


def equipment_section(said: Mapping[str, str]) -> Section | None:
    """Return the equipment that the laboratory names; nothing where it names none."""
    rows: list[tuple[str, ...]] = []
    while any(f"equipment.{len(rows) + 1}.{key}" in said for key in EQUIPMENT):
        rows.append(tuple(said.get(f"equipment.{len(rows) + 1}.{key}", "-") for key in EQUIPMENT))
    if not rows:
        return None
    header = tuple(EQUIPMENT.values())
    table = PageTable("Equipment used", header, tuple(rows), left=len(header))
    return Section("Equipment", tables=(table,))


def signature_section(said: Mapping[str, str]) -> Section:
    """Return where the report is signed."""
    rows = (
        ("Authorised by", said.get("report.authorised_by", _LINE)),
        ("Date", said.get("report.issued", _LINE)),
        ("Signature", _LINE),
    )
    table = PageTable("Signed by", ("Item", "Value"), rows, left=2)
    return Section("Signature", tables=(table,))


def parameters_section(c: Calibration) -> Section:
    """Return the parameters with their uncertainty, and how the outputs lean."""
    leaning = quantity_rows(leaning_quantities(c)) if c.intrinsic is not None else []
    header = ("Quantity", "Value", "U", "Unit", "k")
    installed = (PageTable("Installation", header, tuple(leaning)),) if leaning else ()
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
        (
            p.name,
            p.symbol or "",
            p.label,
            *row,
            plain_number(p.k, 3),
            number(p.dof),
        )
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
    return tuple(sorted(largest_rows(sizes.tolist(), LONG_TABLE, LONG_TABLE)))


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
    absent = _absent_quantities(c, budget)
    if absent:
        paragraphs.append(f"Not in the budget: {', '.join(absent)}.")
    return Section(
        "Uncertainty budget",
        tuple(paragraphs),
        tables=(_quantity_table(c, budget), _contribution_table(c, budget)),
    )


def _absent_quantities(c: Calibration, budget: Evaluation) -> list[str]:
    """Return what a budget could state and this one does not, in plain words."""
    known = {row.quantity for row in budget.rows}.union(c.budget_tables)
    return [kind.text for name, kind in KINDS.items() if name not in known]


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
        paragraphs += _seen_terms(c)
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
        tables=(
            PageTable(
                "Worst case and rms over the sphere",
                header,
                tuple(rows),
                left=2,
            ),
        ),
    )


def _seen_terms(c: Calibration) -> list[str]:
    """Return the sizes of terms that the positions show, beside which hidden ones are judged."""
    listed = [f"{name} ({c.field.shown(size)})" for name, size in shown_sizes(c).items()]
    if not listed:
        return []
    terms = ", ".join(listed)
    return [f"Of higher order these positions do show {terms}, with what noise leaves open."]


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

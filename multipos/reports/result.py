"""What a report says first, and what it signs last: the result, the readings, the equipment.

The first screen is the result in units that people read, each value to the digits that its u
supports, one picture of all errors before and after, and how far it holds.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from multipos.files.numbers import beside, in_g, number, readable_g
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import COMPONENTS
from multipos.plots.calibration import compensated_error, nominal_error
from multipos.plots.errors import draw_error_sphere
from multipos.reports.page import Figure, PageTable, Section, draw_svg, largest_positions
from multipos.reports.sheets import run_conclusions
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.derived import intrinsic_gradient
from multipos.sensor.inverse import sensed_axes
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.validity import applied
from multipos.verification.verdicts import Check

EQUIPMENT = {
    "name": "Equipment",
    "type": "Type",
    "serial": "Serial number",
    "calibrated": "Calibrated",
    "due": "Due",
    "certificate": "Certificate",
}
_LINE = "________________"  # to be written on by hand


class _Quantity(NamedTuple):
    """A derived quantity with its uncertainty."""

    name: str
    unit: str
    value: float
    u: float
    U: float
    k: float


def result_section(
    c: Calibration, budget: Evaluation, check: Check | None, tr: Translator, *, forces: bool
) -> Section:
    """Return the first screen: verdict, errors before and after, validity, and the sensor.

    Parameters
    ----------
    c : Calibration
    budget : Evaluation
    check : Check or None
    tr : Translator
    forces : bool
        Whether readings give forces, so that there are errors to speak of.
    """
    paragraphs = [] if check is None else list(map(tr.message, run_conclusions(check)))
    if forces:
        before, after = (
            float(np.sqrt(np.mean(e**2))) for e in (nominal_error(c), compensated_error(c))
        )
        paragraphs.append(
            tr(
                "Error at the positions, rms: {before} before, {after} after compensation.",
                before=in_g(before),
                after=in_g(after),
            )
        )
    paragraphs.append(_validity(c, tr))
    rows = _rows(_quantities(c, budget, tr))
    header = tuple(map(tr, ("Quantity", "Value", "U", "Unit", "k")))
    caption = tr("Sensitivity, offset and axes, U with {percent} %", percent=_percent(c))
    return Section(
        tr("Result"),
        tuple(paragraphs),
        (_picture(c, tr),) if forces else (),
        (PageTable(caption, header, tuple(rows)),) if rows else (),
    )


def _picture(c: Calibration, tr: Translator) -> Figure:
    return Figure(
        tr("Errors at all positions, before and after compensation"),
        tr(
            "The two halves of the sphere of up vectors. Arrows are errors across, rings errors "
            "along the up vector, filled where they point out; each picture has a scale of its own."
        ),
        lambda: draw_svg(tr, 1, 1.75, lambda axes: draw_error_sphere(c, axes[0])),
    )


def _validity(c: Calibration, tr: Translator) -> str:
    """Return within what the calibration holds."""
    said = tr(
        "Valid for forces {range}", range=tr.message(applied(c).in_words(sensed_axes(c.model)))
    )
    for name in c.model.environment:
        column = c.readings.environment[name]
        said += tr(
            ", {name} {low} to {high}",
            name=tr(name),
            low=f"{column.min():.4g}",
            high=f"{column.max():.4g}",
        )
    return said + tr(".")


def _percent(c: Calibration) -> str:
    return f"{100.0 * c.confidence:g}"


def _quantities(c: Calibration, budget: Evaluation, tr: Translator) -> list[_Quantity]:
    """Return what the sensor is; without what the gauge fixed, and in one unit for angles."""
    if c.intrinsic is None:
        return _of_few_axes(c, tr)
    values, gradient = intrinsic_gradient(c.model, c.parameters, c.mean_environment)
    u, dof, _ = budget.combine(gradient)
    names = [
        *((tr("Sensitivity of {output}", output=o), f"{c.model.unit}/g") for o in c.outputs),
        *((tr("Offset of {output}", output=o), "g") for o in c.outputs),
        *((tr("Angle between input axes {pair}", pair=p), "deg") for p in ("xy", "xz", "yz")),
        *((tr("Mounting, rotation about {axis}", axis=a), "deg") for a in COMPONENTS),
    ]
    known = len(names) - (3 if c.model.gauge is not None else 0)
    found = zip(names, values.tolist(), u.tolist(), dof.tolist(), strict=True)
    return [
        _quantity(c, name, unit, value, sd, nu)
        for (name, unit), value, sd, nu in list(found)[:known]
    ]


def _quantity(
    c: Calibration, name: str, unit: str, value: float, u: float, dof: float
) -> _Quantity:
    k = coverage_factor(c.confidence, dof)
    return _Quantity(name, unit, value, u, k * u, k)


def _of_few_axes(c: Calibration, tr: Translator) -> list[_Quantity]:
    """Return biases, own-axis scale factors and how the outputs lean, of one or two axes."""
    wanted = [p for p in c.entries if p.name.startswith(("scale_", "bias_"))]
    wanted.sort(key=lambda p: not p.name.startswith("scale_"))
    found = [_Quantity(tr.message(p.label), p.unit, p.value, p.u, p.U, p.k) for p in wanted]
    for pair, angle in c.installation_deg.items():
        if angle["u"]:
            name = tr("Output on {i} leans to {j}", i=pair[0], j=pair[1])
            k = angle["U"] / angle["u"]
            found.append(_Quantity(name, "deg", angle["value"], angle["u"], angle["U"], k))
    return found


def _rows(found: Sequence[_Quantity]) -> list[tuple[str, ...]]:
    """Return the rows of a table, forces in one unit that people read."""
    largest = max((abs(q.value) + q.U for q in found if q.unit == "g"), default=0.0)
    rows: list[tuple[str, ...]] = []
    for q in found:
        factor, unit = readable_g(largest) if q.unit == "g" else (1.0, _SHOWN.get(q.unit, q.unit))
        shown = beside(factor * q.value, factor * q.u, factor * q.U)
        rows.append((q.name, *shown, unit, number(q.k, 3)))
    return rows


_SHOWN = {"deg": "°", "g/g": "1"}


def readings_table(c: Calibration, tr: Translator) -> PageTable:
    """Return the readings as they were measured, with what was stated of each."""
    shown, suffix = largest_positions(tr, c.relative_residuals)
    r = c.readings
    columns: list[tuple[str, Sequence[str]]] = [(tr("Position"), r.labels)]
    for i, output in enumerate(c.outputs):
        sd = c.residual_sd[i]
        told = np.isfinite(sd) and sd > 0.0
        decimals = max(0, 2 - int(np.floor(np.log10(sd)))) if told else -1
        form = f".{decimals}f" if 0 <= decimals <= 12 else ".10g"
        columns.append((f"{output} [{c.model.unit}]", [f"{v:{form}}" for v in r.values[:, i]]))
    if r.u is not None:
        columns += [
            (f"u {output}", [number(v, 2) for v in r.u[:, i].tolist()])
            for i, output in enumerate(c.outputs)
        ]
    if r.samples is not None:
        columns.append(("n", [f"{n:g}" for n in r.samples]))
    columns += [
        (tr(name), [f"{v:.6g}" for v in r.environment[name]]) for name in c.model.environment
    ]
    rows = tuple(tuple(column[row] for _, column in columns) for row in shown)
    header = tuple(name for name, _ in columns)
    return PageTable(tr("Readings as measured") + suffix, header, rows)


def equipment_section(said: Mapping[str, str], tr: Translator) -> Section | None:
    """Return the equipment that the laboratory names; nothing where it names none."""
    rows: list[tuple[str, ...]] = []
    while any(f"equipment.{len(rows) + 1}.{key}" in said for key in EQUIPMENT):
        rows.append(tuple(said.get(f"equipment.{len(rows) + 1}.{key}", "-") for key in EQUIPMENT))
    if not rows:
        return None
    header = tuple(map(tr, EQUIPMENT.values()))
    table = PageTable(tr("Equipment used"), header, tuple(rows), left=len(header))
    return Section(tr("Equipment"), tables=(table,))


def signature_section(said: Mapping[str, str], tr: Translator) -> Section:
    """Return where the report is signed."""
    rows = (
        (tr("Authorised by"), said.get("report.authorised_by", _LINE)),
        (tr("Date"), said.get("report.issued", _LINE)),
        (tr("Signature"), _LINE),
    )
    table = PageTable(tr("Signed by"), (tr("Item"), tr("Value")), rows, left=2)
    return Section(tr("Signature"), tables=(table,))

"""What a report says first, and what it signs last: the result, the readings, the equipment.

The first screen is the result in units that people read, each value to the digits that its u
supports, one picture of all errors before and after, and how far it holds.

The section of a report on a calibration that was combined from sessions.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.files.numbers import common_units, decimals_of, most_of, plain_number, pretty_unit
from multipos.plots.pictures import error_picture
from multipos.positions.headers import TEMPERATURE
from multipos.reports.quantities import (
    Quantity,
    column,
    derived_quantities,
    leaning_quantities,
    parameter_cells,
    quantity_rows,
)
from multipos.reports.sections import Figure, PageTable, Section, Translator, chosen_rows
from multipos.sensor.calibration import Calibration, has_nominal
from multipos.sensor.found import Sessions
from multipos.uncertainty.propagation import Evaluation
from multipos.uncertainty.validity import applied

EQUIPMENT = {
    "name": "Equipment",
    "type": "Type",
    "serial": "Serial number",
    "calibrated": "Calibrated",
    "due": "Due",
    "certificate": "Certificate",
}
_LINE = "________________"  # to be written on by hand


def result_section(c: Calibration, budget: Evaluation, tr: Translator, *, forces: bool) -> Section:
    """Return the first screen below the answer: errors before and after, validity, the sensor.

    Parameters
    ----------
    c : Calibration
    budget : Evaluation
    tr : Translator
    forces : bool
        Whether readings give forces, so that there are errors to speak of.
    """
    rows = quantity_rows(derived_quantities(c, budget, tr) or _of_few_axes(c, tr))
    header = tuple(map(tr, ("Quantity", "Value", "U", "Unit", "k")))
    caption = tr("Sensitivity, offset and axes, U with {percent} %", percent=_percent(c))
    return Section(
        tr("Result"),
        (_validity(c, tr),),
        (_picture(c, tr),) if forces else (),
        (PageTable(caption, header, tuple(rows)),) if rows else (),
    )


def _picture(c: Calibration, tr: Translator) -> Figure:
    return Figure(
        tr(
            "Errors at all positions, before and after compensation"
            if has_nominal(c)
            else "Errors at all positions after compensation"
        ),
        tr(
            "The two halves of the sphere of up vectors. Arrows are errors perpendicular to, rings "
            "errors along the up vector, filled where they point out; each picture has a scale of "
            "its own."
        ),
        lambda: error_picture(c, tr.label),
    )


def _validity(c: Calibration, tr: Translator) -> str:
    """Return within what the calibration holds."""
    said = tr(
        "Valid for forces {range}",
        range=tr.message(pretty_unit(applied(c).in_words(c.model.sensed_axes))),
    )
    for name in c.model.environment:
        column = c.readings.environment[name]
        said += tr(
            ", {name} {low} to {high}",
            name=tr(name),
            low=f"{column.min():.4g}",
            high=f"{column.max():.4g}{' °C' if name == TEMPERATURE else ''}",
        )
    return said + tr(".")


def _percent(c: Calibration) -> str:
    return f"{100.0 * c.confidence:g}"


def _of_few_axes(c: Calibration, tr: Translator) -> list[Quantity]:
    """Return scale factors, biases and how the outputs lean, of one or two axes."""
    wanted = [p for p in c.entries if p.name.startswith(("scale_", "bias_"))]
    wanted.sort(key=lambda p: not p.name.startswith("scale_"))
    found = [Quantity(tr.message(p.label), p.unit, p.value, p.u, p.U, p.k) for p in wanted]
    return found + leaning_quantities(c, tr)


def readings_table(c: Calibration, tr: Translator) -> PageTable:
    """Return the readings as they were measured, with what was stated of each."""
    shown, kept, suffix = chosen_rows(tr, c.relative_residuals)
    r = c.readings
    columns: list[tuple[str, Sequence[str]]] = [(tr("Position"), r.labels)]
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
    columns += [
        (tr(name), [f"{v:.6g}" for v in r.environment[name]]) for name in c.model.environment
    ]
    rows = tuple(tuple(column[row] for _, column in columns) for row in shown)
    header = tuple(name for name, _ in columns)
    return PageTable(tr("Readings as measured") + suffix, header, rows, kept=kept)


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


def sessions_section(c: Calibration, sessions: Sessions, tr: Translator) -> Section:
    """Return how many sessions there were, how they differ, and what U holds.

    Parameters
    ----------
    c : Calibration
        Combined of the sessions.
    sessions : Sessions
        Its own.
    tr : Translator
    """
    header = ("Parameter", "Value", "u", "U", "Unit", "k", "sd between sessions")
    table = PageTable(
        tr("Parameters of all sessions"),
        tuple(map(tr, header)),
        _rows(c, sessions.sd),
    )
    return Section(
        tr("Combined sessions"),
        (
            tr(
                "{count} sessions were combined: {files}.",
                count=str(sessions.runs),
                files=tr.listed(sessions.files),
            ),
            tr(
                "U is that of the next session against these parameters: it includes how the "
                "sessions differ, mounting and switch-on among it, on {dof} degrees of freedom, "
                "and what "
                "all sessions share, such as gravity.",
                dof=f"{np.min(c.parameter_dof):.3g}",
            ),
        ),
        tables=(table,),
    )


def _rows(c: Calibration, sds: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Return parameters with their U, and the sd over the sessions in the same unit."""
    entries = [c[name] for name in sds]
    rows = []
    cells = parameter_cells(entries)
    units = common_units((p.unit, most_of(p.value, p.U)) for p in entries)
    for p, shown, sd in zip(entries, cells, sds.values(), strict=True):
        factor = units[p.unit][0]
        decimals = decimals_of(factor * p.u)
        spread = plain_number(factor * sd, 2) if decimals is None else f"{factor * sd:.{decimals}f}"
        rows.append((p.name, *shown, plain_number(p.k, 3), spread))
    return tuple(rows)

"""The sections of a report on what was seen: readings, residuals, rolls, temperature, another run.

`residuals_section` has residuals and errors of every position (`residual_tables`),
`positions_section` where the positions were and the readings there (`readings_table`),
`correlation_section` and `covariance_table` how parameters hang together. `rolls_section` is of a
sensor that was turned about level axes, `temperature_sections` of parameters that change with it,
and `check_section` of an independent run.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from multipos.diagnostics.criticism import fourier_residuals
from multipos.errors import MultiposError
from multipos.files import numbers
from multipos.files.numbers import decimals_of
from multipos.numerics.rotations import directions
from multipos.plots.calibration import compensated_error, residual_series
from multipos.plots.checks import draw_check, errors_apart
from multipos.plots.curves import draw_curve, temperature_curves
from multipos.plots.pictures import residual_picture
from multipos.plots.tumble import draw_harmonics, draw_rolls
from multipos.reports.check_text import check_tables, run_conclusions
from multipos.reports.quantities import column
from multipos.reports.sections import LONG_TABLE, Figure, PageTable, Section, chosen_rows, draw_svg
from multipos.reports.turntable_text import turntable_tables
from multipos.sensor.calibration import Calibration, has_nominal, nominal_error
from multipos.uncertainty.turntable import table_errors
from multipos.verification.verdicts import Check

_WIDE = 16  # parameters beyond which the correlation matrix is only a figure


def residuals_section(c: Calibration) -> Section:
    """Return the residuals of every position, and what is left of its error after compensation."""
    said = ["Residual = reading − model. The bars are ±2 standard deviations of each residual."]
    if not c.by_own_axes:
        said[0] += f" {c.estimator.residual_note}".rstrip()
    said += [_kind_of_error(c)] if math.isfinite(c.rms) else []
    figure = Figure(
        "Residuals at every position",
        "The numbers are in the table below.",
        partial(residual_picture, c),
    )
    return Section("Residuals", tuple(said), (figure,), residual_tables(c))


def residual_tables(c: Calibration) -> tuple[PageTable, ...]:
    """Return the tables of residuals, and of linearity where it can be said."""
    shown, kept, suffix = chosen_rows(c.relative_residuals)
    names = [*(c.readings.labels[row] for row in shown), "s", "dof"]
    columns = []
    sizes = np.abs(c.readings.values).max(axis=0).tolist()
    largest = np.abs(np.vstack([c.residuals[shown], c.residual_sd]))
    size = float(np.max(largest[np.isfinite(largest)], initial=0.0))
    unit = numbers.readable_unit(numbers.beyond_rounding(size, max(sizes)), c.model.unit)
    for output, left, sd, dof, size in zip(
        c.outputs, c.residuals.T, c.residual_sd.tolist(), c.dof.tolist(), sizes, strict=True
    ):
        printed = column([*left[shown], sd], unit, sd, signed=True, scale=size)
        s = printed.cells.pop().removeprefix("+")
        columns.append((f"{output} [{printed.unit}]", [*printed.cells, s, numbers.number(dof)]))
    for name, of_size, left, band in residual_series(c):
        if name not in c.outputs:  # what a position of unknown orientation has
            printed = column(left[shown], of_size, 0.5 * float(band.max()), signed=True)
            columns.append((f"{name} [{printed.unit}]", [*printed.cells, "", ""]))
    if math.isfinite(c.rms):
        before = [("before", nominal_error(c))] if has_nominal(c) else []
        for when, error in (*before, ("after", compensated_error(c))):
            printed = column([*error[shown]], c.field.printed)
            columns.append((f"error {when} [{printed.unit}]", [*printed.cells, "", ""]))
    table = PageTable(
        "Residuals at every position" + suffix,
        ("Position", *(head for head, _ in columns)),
        tuple(zip(names, *(cells for _, cells in columns), strict=True)),
        kept=kept,
        foot=2,
    )
    return (table, *_linearity(c))


def _kind_of_error(c: Calibration) -> str:
    """Return what an error before compensation is, and one after it."""
    if not has_nominal(c):
        return "After: compensated. At the same positions that were fitted."
    if c.nominal is None:
        return (
            "Before: readings divided by one nominal scale factor (1 for readings in g, else "
            "the mean of the outputs), without bias. After: compensated. At the same positions "
            "that were fitted."
        )
    return (
        f"Before: (reading − {c.nominal.bias:g})/{c.nominal.scale:g}, the nominal conversion. "
        "After: compensated. At the same positions that were fitted."
    )


def _linearity(c: Calibration) -> tuple[PageTable, ...]:
    """Return the largest distance from a straight line and from the model, in percent."""
    cells = partial(numbers.plain_number, digits=2)
    lines = [
        (output, *(cells(found[f"{w}_model_percent"]) for w in ("without", "with")))
        for output, found in c.linearity.items()
    ]
    caption = "Linearity: largest distance from a line and from the model, % of −1 g to +1 g"
    header = ("Output", "without the model", "with the model")
    return (PageTable(caption, header, tuple(lines)),) if lines else ()


def positions_section(c: Calibration) -> Section:
    """Return where the positions were and what each decides."""
    stood = np.where(c.readings.forced[:, None], c.reference, directions(c.reference))
    up = c.sign * stood + 0.0
    leverage, names = c.diagnostics.leverage, c.readings.labels
    shown, kept, suffix = chosen_rows(leverage.max(axis=1))
    rows = [
        (
            names[row],
            *(f"{value:.4f}" for value in up[row].tolist()),
            *(f"{value:.3f}" for value in leverage[row].tolist()),
        )
        for row in shown
    ]
    table = PageTable(
        "Up vector and leverage of every position" + suffix,
        ("Position", "x", "y", "z", *(f"h {output}" for output in c.outputs)),
        tuple(rows),
        kept=kept,
    )
    return Section(
        "Positions and readings",
        (
            (
                "The up vector of every position in case axes, and how far each position fixes its "
                "own fit (leverage). At a leverage of 1 the model passes through the reading "
                "whatever it is."
            ),
        ),
        tables=(table, readings_table(c)),
    )


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


def correlation_section(c: Calibration) -> Section:
    """Return the correlation of the parameters: all of it, or of many the largest coefficients."""
    names, size = c.names, c.correlation
    header: tuple[str, ...] = ("", *names)
    rows = [
        (name, *(f"{value:.2f}" if abs(value) >= 0.005 else "0" for value in row))
        for name, row in zip(names, size.tolist(), strict=True)
    ]
    caption, left = "Correlation coefficients", 1
    if len(names) > _WIDE:
        pairs = np.transpose(np.triu_indices(len(names), 1))
        largest = np.argsort(-np.abs(size[tuple(pairs.T)]), kind="stable")[:LONG_TABLE]
        rows = [(names[i], names[j], f"{size[i, j]:.2f}") for i, j in pairs[largest].tolist()]
        header, left = ("Parameter", "Parameter", "r"), 2
        caption = "The largest correlation coefficients"
    return Section(
        "Correlation",
        (
            (
                "Correlation of the parameters; the covariance is in the annex. What is computed "
                "from several parameters needs it."
            ),
        ),
        tables=(PageTable(caption, header, tuple(rows), left),),
    )


def covariance_table(c: Calibration) -> PageTable:
    """Return the covariance of the parameters: all of it, or of many by pairs."""
    named = [f"{p.name} [{numbers.pretty_unit(p.unit)}]" for p in c.entries]
    scales = np.outer(c.u, c.u).tolist()
    cells = [
        [numbers.number(numbers.beyond_rounding(*each), 3) for each in zip(row, of, strict=True)]
        for row, of in zip(c.covariance.tolist(), scales, strict=True)
    ]
    header: tuple[str, ...] = ("", *c.names)
    rows, left = [(name, *row) for name, row in zip(named, cells, strict=True)], 1
    if len(named) > _WIDE:
        header, left = ("Parameter", "Parameter", "covariance"), 2
        pairs = np.transpose(np.triu_indices(len(named))).tolist()
        rows = [(named[i], named[j], cells[i][j]) for i, j in pairs]
    return PageTable("Covariance, in products of units", header, tuple(rows), left)


def rolls_section(c: Calibration) -> Section:
    """Return the signal along each roll, the harmonics left, and the errors of the turntable."""
    signals = [partial(draw_rolls, c, output=output) for output in c.outputs]
    left = [partial(draw_harmonics, c, output=output) for output in c.outputs]
    figures = [
        Figure(
            "Signal against angle",
            "One panel for each output; markers are readings, by the plane of the roll.",
            partial(draw_svg, 2.2, *signals),
        )
    ]
    if fourier_residuals(c):
        figures.append(
            Figure(
                "Residual harmonics",
                "Bars for each order and roll; the numbers are in the checks.",
                partial(draw_svg, 1.9, *left),
            )
        )
    return Section(
        "Rolls",
        (
            (
                "Signal of every output against the angle of each roll; the curves are the Fourier "
                "series of the readings."
            ),
            (
                "Errors of the turntable from the rolls: the zero of its encoder and two harmonics "
                "of its circle, estimated together with the sensor. Each names the terms of a "
                "sensor that would look the same; where the model has them it is not identifiable."
            ),
        ),
        tuple(figures),
        tuple(turntable_tables(table_errors(c))),
    )


def check_section(c: Calibration, found: Check) -> Section:
    """Return an independent run before and after compensation.

    Raises
    ------
    MultiposError
        The check is of another calibration.
    """
    if found.calibration != c.created:
        raise MultiposError(
            f"the check is of a calibration created {found.calibration}, this one was created "
            f"{c.created}; run check with this calibration."
        )

    apart = errors_apart(found)
    when: Literal["after", "both"] = "after" if apart else "both"
    drawn = replace(found, quantity=c.field.worded(found.quantity))
    panels = [partial(draw_check, drawn, axis=axis, when=when) for axis in found.axes]
    paragraphs = [
        (
            f"An independent run at known positions ({found.source or 'from memory'}), before "
            f"compensation by (reading − {found.bias:g}) / {found.scale:g}, and after. U has the "
            "calibration and the readings of the run in it, with a coverage probability of "
            f"{100.0 * found.confidence:g} %."
        )
    ]
    if found.limit is not None:
        paragraphs.append(
            f"Verdict against {numbers.in_unit(found.limit, found.unit)}: {found.verdict or '-'}. "
            "It is pass where error and U together stay within the limit, fail where the error "
            "less U is beyond it, else indeterminate; the worst position counts."
        )
    paragraphs += run_conclusions(found)
    shown = "open squares before, circles with U after, dashed lines the limit."
    if apart:
        shown = (
            "circles with U after compensation, dashed lines the limit. Before, errors are so "
            "large that they would hide these; see the table."
        )
    figure = Figure(
        f"Error against {found.quantity}",
        f"One panel for each axis: {shown}",
        partial(draw_svg, 1.9, *panels),
    )
    tables = tuple(check_tables(found))
    return Section("Independent check", tuple(paragraphs), (figure,), tables)


def temperature_sections(c: Calibration) -> tuple[Section, ...]:
    """Return the section, or none where nothing changes with temperature."""
    curves = temperature_curves(c)
    if not curves:
        return ()
    return (
        Section(
            "Over temperature",
            (
                (
                    "What changes with temperature, over the range of the readings: U holds at one "
                    "temperature, the band at all of them together (Scheffé)."
                ),
            ),
            (
                Figure(
                    "Parameters over temperature",
                    "One panel for each parameter that changes.",
                    partial(draw_svg, 1.9, *(partial(draw_curve, curve) for curve in curves)),
                ),
            ),
        ),
    )

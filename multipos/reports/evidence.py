"""The sections of a report on what was seen: residuals, errors, positions, rolls, another run.

The section of a report on temperature: what changes with it, with its bands.
"""

from typing import Any

import numpy as np

from multipos.diagnostics.criticism import fourier_residuals
from multipos.errors import MultiposError
from multipos.files.numbers import in_unit, number, plain_number
from multipos.numerics.rotations import directions
from multipos.plots.calibration import (
    compensated_error,
    draw_correlation,
    draw_errors,
    draw_leverage,
    nominal_error,
    residual_panels,
    size_residuals,
)
from multipos.plots.check import draw_check, errors_apart
from multipos.plots.temperature import draw_curve, temperature_curves
from multipos.plots.tumble import draw_harmonics, draw_rolls
from multipos.reports.page import (
    Figure,
    PageTable,
    Section,
    Translator,
    draw_svg,
    largest_positions,
)
from multipos.reports.quantities import column
from multipos.reports.sensor_result import readings_table
from multipos.reports.sheets import Sheet, check_sheets, table_error_sheets
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.uncertainty.turntable import table_errors
from multipos.verification.verdicts import Check

_WIDE = 16  # parameters beyond which the correlation matrix is only a figure


def residuals_section(c: Calibration, tr: Translator) -> Section:
    """Return the residuals of every position."""
    panels = residual_panels(c)

    def draw(axes: Any) -> None:
        for panel, one in zip(panels, axes, strict=True):
            panel(one)

    shown, suffix = largest_positions(tr, c.relative_residuals)
    names = c.readings.labels
    columns = [
        column([*left, sd], c.model.unit, float(sd), signed=True)
        for left, sd in zip(c.residuals[shown].T, c.residual_sd, strict=True)
    ]
    rows = list(
        zip([*(names[row] for row in shown), "s"], *(x.cells for x in columns), strict=True)
    )
    rows[-1] = ("s", *(cell.removeprefix("+") for cell in rows[-1][1:]))
    header = [f"{o} [{x.unit}]" for o, x in zip(c.outputs, columns, strict=True)]
    dof = [number(value) for value in c.dof.tolist()]
    if c.estimator is Estimator.UNKNOWN:
        sizes, sd = size_residuals(c)
        printed = column(sizes[shown], "g", float(sd.max()), signed=True)
        header.append(f"{tr('size of the force')} [{printed.unit}]")
        rows = [(*row, cell) for row, cell in zip(rows, [*printed.cells, ""], strict=True)]
        dof.append("")
    paragraphs = [
        tr("Residual = reading − model. The bars are ±2 standard deviations of each residual.")
    ]
    if c.sessions is not None:
        paragraphs = [
            tr(
                "Residual = reading − model of all sessions, so that it holds how its session "
                "differs. The bars are ±2 standard deviations within a session."
            )
        ]
    if c.estimator is Estimator.UNKNOWN:
        paragraphs.append(
            tr(
                "No orientation is known, so a position has one number: by how much the size of "
                "its compensated force is off. It is what the figure shows."
            )
        )
    elif not c.estimator.exact:
        paragraphs.append(
            tr(
                "The orientations were estimated with the parameters, so a residual shows only "
                "what no turn of its position explains."
            )
        )
    rows.append((tr("dof"), *dof))
    return Section(
        tr("Residuals"),
        tuple(paragraphs),
        (
            Figure(
                tr("Residuals at every position"),
                tr("One panel for each output; the numbers are in the table below.")
                if len(panels) > 1
                else tr("The numbers are in the table below."),
                lambda: draw_svg(tr, len(panels), 1.9, draw),
            ),
        ),
        (
            PageTable(
                tr("Residuals at every position") + suffix,
                (tr("Position"), *header),
                tuple(rows),
            ),
        ),
    )


def errors_section(c: Calibration, tr: Translator) -> Section:
    """Return the errors before and after compensation, and linearity."""
    before, after = nominal_error(c), compensated_error(c)
    shown, suffix = largest_positions(tr, after)
    names = c.readings.labels
    ends = (np.max, lambda e: np.sqrt(np.mean(e**2)))
    columns = [
        column([*error[shown], *(float(size(error)) for size in ends)], "g")
        for error in (before, after)
    ]
    said = [*(names[row] for row in shown), tr("largest"), tr("rms")]
    rows = list(zip(said, *(x.cells for x in columns), strict=True))
    heads = [f"{tr(w)} [{x.unit}]" for w, x in zip(("before", "after"), columns, strict=True)]
    lines = [
        (output, *(plain_number(found[f"{w}_model_percent"], 2) for w in ("without", "with")))
        for output, found in c.linearity.items()
    ]
    return Section(
        tr("Error before and after"),
        (
            tr(
                "Before: readings divided by one nominal scale factor (1 for readings in g, else "
                "the mean of the outputs), without bias. After: compensated. At the same positions "
                "that were fitted."
            )
            if c.nominal is None
            else tr(
                "Before: (reading − {bias})/{scale}, the nominal conversion. After: compensated. "
                "At the same positions that were fitted.",
                bias=f"{c.nominal.bias:g}",
                scale=f"{c.nominal.scale:g}",
            ),
            tr(
                "Linearity: the largest distance of a reading from the least-squares line in its "
                "own reference (without the model), and the largest residual of the model (with "
                "it), in percent of the span from −1 g to +1 g. The six-position paper's table 3 "
                "does not follow from its table 2, and its definition is not known."
            ),
        ),
        (
            Figure(
                tr("Size of the error at every position, before and after compensation"),
                tr("Squares before, circles after; the numbers are in the table below."),
                lambda: draw_svg(tr, 1, 2.4, lambda axes: draw_errors(c, axes[0])),
            ),
        ),
        (
            PageTable(
                tr("Size of the error") + suffix,
                (tr("Position"), *heads),
                tuple(rows),
                on_paper=False,  # the figure tells it, and the first sheet the largest and the rms
            ),
            PageTable(
                tr("Linearity [%]"),
                tuple(map(tr, ("Output", "without the model", "with the model"))),
                tuple(lines),
            ),
        ),
    )


def positions_section(c: Calibration, tr: Translator) -> Section:
    """Return where the positions were and what each decides."""
    stood = np.where(c.readings.forced[:, None], c.reference, directions(c.reference))
    up = c.sign * stood + 0.0
    leverage, names = c.diagnostics.leverage, c.readings.labels
    shown, suffix = largest_positions(tr, leverage.max(axis=1))
    rows = [
        (
            names[row],
            *(f"{value:.4f}" for value in up[row].tolist()),
            *(f"{value:.3f}" for value in leverage[row].tolist()),
        )
        for row in shown
    ]
    return Section(
        tr("Positions and readings"),
        (
            tr(
                "The up vector of every position in case axes, and how far each position fixes its "
                "own fit (leverage). At a leverage of 1 the model passes through the reading "
                "whatever it is."
            ),
        ),
        (
            Figure(
                tr("Leverage of every position"),
                tr("Bars, one for each output; the numbers are in the table below."),
                lambda: draw_svg(tr, 1, 2.4, lambda axes: draw_leverage(c, axes[0])),
                on_paper=False,
            ),
        ),
        (
            PageTable(
                tr("Up vector and leverage of every position") + suffix,
                (tr("Position"), "x", "y", "z", *(f"h {output}" for output in c.outputs)),
                tuple(rows),
            ),
            readings_table(c, tr),
        ),
    )


def correlation_section(c: Calibration, tr: Translator) -> Section:
    """Return the correlation of the parameters."""
    names = c.names
    rows = tuple(
        (name, *(f"{value:.2f}" if abs(value) >= 0.005 else "0" for value in row))
        for name, row in zip(names, c.correlation.tolist(), strict=True)
    )
    small = len(names) <= _WIDE
    return Section(
        tr("Correlation"),
        (
            tr(
                "Correlation of the parameters; the whole covariance is in the calibration file. "
                "What is computed from several parameters needs it."
            ),
        ),
        (
            Figure(
                tr("Correlation matrix of the parameters"),
                tr("Blue is positive, orange negative; coefficients from 0.05 are written in."),
                lambda: draw_svg(tr, 1, 5.4, lambda axes: draw_correlation(c, axes[0])),
            ),
        ),
        (PageTable(tr("Correlation coefficients"), ("", *names), rows, on_paper=False),)
        if small
        else (),
    )


def rolls_section(c: Calibration, tr: Translator) -> Section:
    """Return the signal along each roll, the harmonics left, and the errors of the turntable."""

    def signal(axes: Any) -> None:
        for output, one in zip(c.outputs, axes, strict=True):
            draw_rolls(c, one, output=output)

    def left(axes: Any) -> None:
        for output, one in zip(c.outputs, axes, strict=True):
            draw_harmonics(c, one, output=output)

    figures = [
        Figure(
            tr("Signal against angle"),
            tr("One panel for each output; markers are readings, by the plane of the roll."),
            lambda: draw_svg(tr, len(c.outputs), 2.2, signal),
        )
    ]
    if fourier_residuals(c):
        figures.append(
            Figure(
                tr("Residual harmonics"),
                tr("Bars for each order and roll; the numbers are in the checks."),
                lambda: draw_svg(tr, len(c.outputs), 1.9, left),
            )
        )
    return Section(
        tr("Rolls"),
        (
            tr(
                "Signal of every output against the angle of each roll; the curves are the Fourier "
                "series of the readings."
            ),
            tr(
                "What the rolls tell of the turntable: the zero of its encoder and two harmonics "
                "of its circle, estimated together with the sensor. Each names the terms of a "
                "sensor that would look the same; where the model holds them it cannot be told."
            ),
        ),
        tuple(figures),
        tuple(_table_of(sheet, tr, left=2) for sheet in table_error_sheets(table_errors(c))),
    )


def check_section(c: Calibration, found: Check, tr: Translator) -> Section:
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

    def draw(axes: Any) -> None:
        for axis, one in zip(found.axes, axes, strict=True):
            draw_check(found, one, axis=axis, when="after" if apart else "both")

    paragraphs = [
        tr(
            "An independent run at known positions ({file}), before compensation by (reading − "
            "{bias}) / {scale}, and after. U has the calibration and the readings of the run in "
            "it, with a coverage probability of {percent} %.",
            file=found.source or tr("from memory"),
            bias=f"{found.bias:g}",
            scale=f"{found.scale:g}",
            percent=f"{100.0 * found.confidence:g}",
        )
    ]
    if found.limit is not None:
        paragraphs.append(
            tr(
                "Verdict against {limit}: {verdict}. It is pass where error and U together "
                "stay within the limit, fail where the error less U is beyond it, else "
                "indeterminate; the worst position counts.",
                limit=in_unit(found.limit, found.unit),
                verdict=tr(found.verdict or "-"),
            )
        )
    return Section(
        tr("Independent check"),
        tuple(paragraphs),
        (
            Figure(
                tr("Error against {what}", what=tr(found.quantity)),
                tr(
                    "One panel for each axis: circles with U after compensation, dashed lines the "
                    "limit. Before, errors are so large that they would hide these; see the table."
                    if apart
                    else "One panel for each axis: open squares before, circles with U after, "
                    "dashed lines the limit."
                ),
                lambda: draw_svg(tr, len(found.axes), 1.9, draw),
            ),
        ),
        tuple(_table_of(sheet, tr) for sheet in check_sheets(found)),
    )


def _table_of(sheet: Sheet, tr: Translator, left: int = 1) -> PageTable:
    rows = tuple(tuple(_translated(cell, tr) for cell in row) for row in sheet.rows)
    return PageTable(tr.message(sheet.title), tuple(map(tr.label, sheet.header)), rows, left)


def _translated(cell: str, tr: Translator) -> str:
    """Return a cell, word by word where it is a list."""
    return tr.listed([tr.message(word) for word in cell.split(", ")])


def temperature_sections(c: Calibration, tr: Translator) -> tuple[Section, ...]:
    """Return the section, or none where nothing changes with temperature."""
    curves = temperature_curves(c)
    if not curves:
        return ()

    def draw(axes: Any) -> None:
        for curve, one in zip(curves, axes, strict=True):
            draw_curve(curve, one)

    return (
        Section(
            tr("Over temperature"),
            (
                tr(
                    "What changes with temperature, over the range of the readings: U holds at one "
                    "temperature, the band at all of them together (Scheffé)."
                ),
            ),
            (
                Figure(
                    tr("Parameters over temperature"),
                    tr("One panel for each parameter that changes."),
                    lambda: draw_svg(tr, len(curves), 1.9, draw),
                ),
            ),
        ),
    )

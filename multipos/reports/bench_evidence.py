"""The sections of a report on the bench: what the rolls say, and an independent run."""

from typing import Any

from multipos.doubts.criticism import fourier_residuals
from multipos.errors import MultiposError
from multipos.plots.check import draw_check
from multipos.plots.tumble import draw_harmonics, draw_rolls
from multipos.reports.findings import Figure, Grid, Section, draw_svg
from multipos.reports.sections import Sheet, check_sheets, table_error_sheets
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.turntable import table_errors
from multipos.verification.verdicts import Check


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
        tuple(_grid(sheet, tr, left=2) for sheet in table_error_sheets(table_errors(c))),
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

    def draw(axes: Any) -> None:
        for axis, one in zip(found.axes, axes, strict=True):
            draw_check(found, one, axis=axis)

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
                "Verdict against {limit} {unit}: {verdict}. It is pass where error and U together "
                "stay within the limit, fail where the error less U is beyond it, else undecided; "
                "the worst position counts.",
                limit=f"{found.limit:g}",
                unit=found.unit,
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
                    "One panel for each axis: open squares before, circles with U after, dashed "
                    "lines the limit."
                ),
                lambda: draw_svg(tr, len(found.axes), 2.4, draw),
            ),
        ),
        tuple(_grid(sheet, tr) for sheet in check_sheets(found)),
    )


def _grid(sheet: Sheet, tr: Translator, left: int = 1) -> Grid:
    rows = tuple(tuple(map(tr, row)) for row in sheet.rows)
    return Grid(tr.message(sheet.title), tuple(map(tr.label, sheet.header)), rows, left)

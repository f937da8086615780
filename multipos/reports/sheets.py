"""What the installation of a sensor and its rolls on a turntable give: as sheets of text.

A `Sheet` is a title, a header and rows, which commands print and reports take as a table.
`installation_sheets` has the angles of the outputs, `table_error_sheets` the errors of the
turntable and shifts of the zero between rolls, and `table_errors_text` prints the latter.
"""

from typing import NamedTuple

from multipos.files.numbers import chance, number, plain_number, readable_unit, table, uncertain
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.turntable import TableErrors, ZeroShift


class Sheet(NamedTuple):
    """A table under a title, all of it text."""

    title: str
    header: list[str]
    rows: list[list[str]]

    def __str__(self) -> str:
        return table(self.header, self.rows)


def installation_sheets(calibration: Calibration) -> list[Sheet]:
    """Return how the outputs are installed, θ_ij with u and U; nothing where not identifiable."""
    rows = []
    for pair, angle in calibration.installation_deg.items():
        output = calibration.outputs[calibration.model.axes.index(pair[0])]
        rows.append(
            [
                f"theta_{pair}",
                f"{output} towards {pair[1]}",
                uncertain(angle["value"], angle["u"]),
                number(angle["U"], 2),
            ]
        )
    header = ["angle", "of", "value(u) [deg]", "U"]
    return [Sheet("Installation", header, rows)] if rows else []


def table_error_sheets(found: TableErrors) -> list[Sheet]:
    """Return the errors of the turntable with what they are confounded with, and zero shifts."""
    sections = []
    rows = []
    for of, errors in (("", found.errors), ("shaft ", found.shaft)):
        for error in errors:
            value, alike = "not identifiable", ", ".join(error.confounded_with) or "nothing"
            if error.value_deg is not None and error.u_deg is not None:
                value = uncertain(error.value_deg, error.u_deg)
            elif of:
                continue
            quantity = f"{of}{error.quantity.replace('_', ' ')}"
            rows.append([error.plane, quantity, value, plain_number(error.U_deg, 2), alike])
    if rows:
        header = ["roll", "table error", "value(u) [deg]", "U", "does the same as"]
        sections.append(Sheet("Turntable", header, rows))
    shifts = [[s.plane, s.output, *_shift_cells(s), chance(s.p)] for s in found.zero_shifts]
    if shifts:
        header = ["roll", "zero of", "shift(u)", "U", "unit", "p"]
        sections.append(Sheet("Zero between rolls", header, shifts))
    return sections


def table_errors_text(found: TableErrors) -> str:
    """Return what the rolls tell of the turntable as plain text."""
    sheets = table_error_sheets(found)
    return (
        "\n\n".join(f"{sheet.title}\n{sheet}" for sheet in sheets)
        or "no roll determines table errors"
    )


def _shift_cells(shift: ZeroShift) -> tuple[str, str, str]:
    """Return a shift with u, its U, and the unit of both."""
    factor, unit = readable_unit(max(abs(shift.value), shift.U), shift.unit)
    known = uncertain(factor * shift.value, factor * shift.u)
    return known, plain_number(factor * shift.U, 2), unit

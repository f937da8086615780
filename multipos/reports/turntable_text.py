"""What rolls tell of the turntable, as tables of text.

`turntable_tables` has the errors of the turntable and shifts of the zero between rolls, which
`table_errors_text` prints.
"""

from multipos.files.numbers import chance, plain_number, readable_unit, uncertain
from multipos.reports.sections import PageTable
from multipos.uncertainty.turntable import TableErrors, ZeroShift


def turntable_tables(found: TableErrors) -> list[PageTable]:
    """Return the errors of the turntable with what they are confounded with, and zero shifts."""
    tables = []
    rows = []
    for of, errors in (("", found.errors), ("shaft ", found.shaft)):
        for error in errors:
            value, alike = "not identifiable", ", ".join(error.confounded_with) or "nothing"
            if error.value_deg is not None and error.u_deg is not None:
                value = uncertain(error.value_deg, error.u_deg)
            elif of:
                continue
            quantity = f"{of}{error.quantity.replace('_', ' ')}"
            rows.append((error.plane, quantity, value, plain_number(error.U_deg, 2), alike))
    if rows:
        header = ("roll", "table error", "value(u) [deg]", "U", "does the same as")
        tables.append(PageTable("Turntable", header, tuple(rows), left=2))
    shifts = tuple((s.plane, s.output, *_shift_cells(s), chance(s.p)) for s in found.zero_shifts)
    if shifts:
        of_shifts = ("roll", "zero of", "shift(u)", "U", "unit", "p")
        tables.append(PageTable("Zero between rolls", of_shifts, shifts, left=2))
    return tables


def table_errors_text(found: TableErrors) -> str:
    """Return what the rolls tell of the turntable as plain text."""
    return (
        "\n\n".join(f"{each.caption}\n{each}" for each in turntable_tables(found))
        or "no roll determines table errors"
    )


def _shift_cells(shift: ZeroShift) -> tuple[str, str, str]:
    """Return a shift with u, its U, and the unit of both."""
    factor, unit = readable_unit(max(abs(shift.value), shift.U), shift.unit)
    known = uncertain(factor * shift.value, factor * shift.u)
    return known, plain_number(factor * shift.U, 2), unit

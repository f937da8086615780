"""What tumbles, turntables and checks say: as sheets of text, and as plain text of them.

A sheet is a title, a header and rows. Commands print it, and `multipos.reports.documents` puts it
into a report of any form and language.
"""

from typing import Any, NamedTuple

import numpy as np

from multipos.files.numbers import largest_rows, number, table, uncertain
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.table_findings import TableErrors
from multipos.verification.agreement import agreement_in_words
from multipos.verification.verdicts import VERDICTS, Check, worst


class Sheet(NamedTuple):
    """A table under a title, all of it text."""

    title: str
    header: list[str]
    rows: list[list[str]]

    def __str__(self) -> str:
        return table(self.header, self.rows)


def installation_sheets(calibration: Calibration) -> list[Sheet]:
    """Return how the outputs are installed, θ_ij with u and U; nothing where it cannot be told."""
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
    for error in found.errors:
        told = error.value_deg is not None and error.u_deg is not None
        rows.append(
            [
                error.plane,
                error.quantity.replace("_", " "),
                uncertain(error.value_deg or 0.0, error.u_deg or 0.0) if told else "cannot be told",
                number(error.U_deg, 2),
                ", ".join(error.confounded_with) or "nothing",
            ]
        )
    for error in found.shaft:
        if error.value_deg is not None and error.u_deg is not None:
            rows.append(
                [
                    error.plane,
                    f"shaft {error.quantity.replace('_', ' ')}",
                    uncertain(error.value_deg, error.u_deg),
                    number(error.U_deg, 2),
                    "nothing",
                ]
            )
    if rows:
        header = ["roll", "table error", "value(u) [deg]", "U", "does the same as"]
        sections.append(Sheet("Turntable", header, rows))
    shifts = [
        [
            shift.plane,
            shift.output,
            f"{uncertain(shift.value, shift.u)} {shift.unit}",
            number(shift.U, 2),
            f"{shift.p:.2g}",
        ]
        for shift in found.zero_shifts
    ]
    if shifts:
        header = ["roll", "zero of", "shift(u)", "U", "p"]
        sections.append(Sheet("Zero between rolls", header, shifts))
    return sections


def check_sheets(found: Check) -> list[Sheet]:
    """Return the summary and the errors of every position; of a regression by segment."""
    if found.segments:
        return [_by_segment(found)]
    return [_by_axis(found), _by_position(found)]


def _by_axis(found: Check) -> Sheet:
    header = [
        "axis",
        f"max before [{found.unit}]",
        "max after",
        "rms before",
        "rms after",
        "linearity before [%]",
        "after",
        "largest U",
        "verdict",
    ]
    rows = []
    for axis in (*found.axes, None) if len(found.axes) > 1 else found.axes:
        s = found.summary(axis)
        values = _before_and_after(s, "maximum", "rms", "linearity_percent")
        rows.append(
            [axis or "all", *values, number(s["after"]["largest_U"], 2), s["verdict"] or "-"]
        )
    return Sheet("Errors before and after compensation", header, rows)


def _before_and_after(summary: dict[str, Any], *keys: str) -> list[str]:
    return [number(summary[when][key]) for key in keys for when in ("before", "after")]


def _by_position(found: Check) -> Sheet:
    header = ["position"]
    for axis in found.axes:
        header += [f"{axis} [{found.unit}]", "before", "after", "U"]
    rows = []
    shown = largest_rows(np.abs(found.after).max(axis=1).tolist())
    for row in shown:
        cells = [found.positions[row]]
        for column in np.arange(len(found.axes)):
            cells += [f"{found.reference[row, column]:.6g}"]
            cells += [_signed(found.before[row, column]), _signed(found.after[row, column])]
            cells += [number(float(found.U[row, column]), 2)]
        rows.append([*cells, worst(found.verdicts[row]) or "-"])
    title = "Every position"
    if len(shown) < len(found.positions):
        title += f" (the {len(shown)} farthest off of {len(found.positions)}; JSON has all)"
    return Sheet(title, [*header, "verdict"], rows)


def _by_segment(found: Check) -> Sheet:
    """Return the summary of a regression's check: one row for each segment that has rows."""
    unit = f" [{found.unit}]" if found.unit else ""
    header = [
        "segment",
        "rows",
        f"max before{unit}",
        "max after",
        "rms before",
        "rms after",
        "largest U",
        "verdict",
    ]
    rows = []
    for name in (*(n for n, inside in found.segments.items() if inside.any()), None):
        s = found.summary(segment=name)
        counted = found.counted[:, 0] if name is None else found.counted[found.segments[name], 0]
        values = _before_and_after(s, "maximum", "rms")
        U = s["after"]["largest_U"]
        rows.append(
            [
                name or "all",
                str(int(counted.sum())),
                *values,
                number(U if np.isfinite(U) else None, 2),
                s["verdict"] or "-",
            ]
        )
    return Sheet("Errors before and after correction", header, rows)


def check_text(found: Check) -> str:
    """Return the check as plain text."""
    sheets = check_sheets(found)
    text = "\n".join(f"{s.title}\n{'-' * len(s.title)}\n{s}\n" for s in sheets)
    said = []
    if found.limit is not None:
        count = {name: int((found.verdicts == name).sum()) for name in VERDICTS}
        counted = ", ".join(f"{count[name]} {name}" for name in VERDICTS)
        said.append(
            f"{found.verdict} against {found.limit:g} {found.unit} with U "
            f"({100 * found.confidence:g} %) as guard band: {counted}"
        )
    said += run_conclusions(found)
    return text + ("\n" + "\n".join(said) + "\n" if said else "")


def run_conclusions(found: Check) -> list[str]:
    """Return the verdict of a run as a whole, and whether it agrees with the calibration."""
    said = []
    if found.limit is not None:
        said.append(
            f"the run as a whole: {found.run_verdict}; it fails where an error is beyond the limit "
            f"by more than the U of all {int(found.counted.sum())} together"
        )
    whole = found.consistency
    if whole is not None and np.isfinite(whole.statistic):
        agrees = "consistent" if whole.p >= 1.0 - found.confidence else "NOT consistent"
        largest = found.summary()["after"]["largest_En"]
        said.append(
            f"{agrees} with the calibration: {agreement_in_words(whole)}; largest En "
            f"{number(largest, 2)}"
        )
    return said


def _signed(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:+.3g}"

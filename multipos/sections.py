"""Sections of reports on one- and two-axis sensors: (title, text) pairs, and plain text of them.

`draw` turns a header and rows into a table: `formatting.table` for plain text, or
`formatting.markdown_table`.
"""

from collections.abc import Callable, Sequence

import numpy as np

from multipos.calibration import Calibration
from multipos.checks import VERDICTS, Check, worst
from multipos.formatting import number, table, uncertain
from multipos.single_axis import Tumble
from multipos.turntable import TableErrors

Draw = Callable[[Sequence[str], Sequence[Sequence[str]]], str]


def installation_sections(calibration: Calibration, draw: Draw = table) -> list[tuple[str, str]]:
    """Return the section of a report on how the outputs are installed, θ_ij with u and U."""
    rows = []
    for pair, angle in calibration.installation_deg.items():
        output = calibration.outputs[calibration.model.axes.index(pair[0])]
        name = f"{output} towards {pair[1]}"
        rows.append([name, uncertain(angle["value"], angle["u"]), number(angle["U"], 2)])
    return [("Installation", draw(["theta", "value(u) [deg]", "U"], rows))] if rows else []


def table_error_sections(found: TableErrors, draw: Draw = table) -> list[tuple[str, str]]:
    """Return the sections of a report on the turntable."""
    sections = []
    rows = []
    for error in found.errors:
        told = error.value_deg is not None and error.u_deg is not None
        rows.append(
            [error.plane, error.quantity.replace("_", " "),
             uncertain(error.value_deg or 0.0, error.u_deg or 0.0) if told else "cannot be told",
             number(error.U_deg, 2), ", ".join(error.confounded_with) or "nothing"]
        )  # fmt: skip
    if rows:
        header = ["roll", "table error", "value(u) [deg]", "U", "does the same as"]
        sections.append(("Turntable", draw(header, rows)))
    shifts = [
        [shift.plane, shift.output, f"{uncertain(shift.value, shift.u)} {shift.unit}",
         number(shift.U, 2), f"{shift.p:.2g}"]
        for shift in found.zero_shifts
    ]  # fmt: skip
    if shifts:
        header = ["roll", "zero of", "shift(u)", "U", "p"]
        sections.append(("Zero between rolls", draw(header, shifts)))
    return sections


def tumble_sections(found: Tumble, draw: Draw = table) -> list[tuple[str, str]]:
    """Return the sections of a report: coefficients, what is hidden, harmonics, turntable."""
    rows = []
    for name, c in found.coefficients.items():
        custom = c.customary
        value = uncertain(custom["value"], custom["u"]) if "value" in custom else "-"
        rows.append(
            [name, uncertain(c.value, c.u), c.unit, value, number(custom["U"], 2), custom["unit"],
             number(c.k), number(c.dof)]
        )  # fmt: skip
    header = ["coefficient", "value(u)", "unit", "value(u)", "U", "unit", "k", "dof"]
    sections = [("Tumble", draw(header, rows))]
    hidden = [*found.unidentifiable, *found.weak]
    if found.taken_as_zero:
        hidden.append(f"taken as zero: {', '.join(found.taken_as_zero)}")
    if hidden:
        text = "\n".join(f"- {line}" for line in hidden)
        sections.append(("What the points cannot tell", text))
    unit = found.calibration.model.unit
    residual = {(h.plane, h.order): h for h in found.residual_harmonics}
    rows = []
    for h in found.harmonics:
        left = residual[h.plane, h.order]
        rows.append(
            [h.plane, str(h.order), *(f"{v:.6g}" for v in (h.cos, h.sin, h.amplitude)),
             f"{left.amplitude:.2g}", number(left.p, 2)]
        )  # fmt: skip
    if rows:
        header = ["plane", "order", f"cos [{unit}]", "sin", "amplitude", "left by the model", "p"]
        sections.append(("Harmonics", draw(header, rows)))
    return [*sections, *table_error_sections(found.table_errors, draw)]


def tumble_text(found: Tumble) -> str:
    """Return the tumble as plain text."""
    text = "\n".join(
        f"{title}\n{'-' * len(title)}\n{body}\n" for title, body in tumble_sections(found)
    )
    if found.fourier_max_difference is not None:
        text += (
            f"\nFourier against least squares: {found.fourier_max_difference:.1e} of a reading\n"
        )
    return text


def check_sections(found: Check, draw: Draw = table) -> list[tuple[str, str]]:
    """Return the sections of a report: the summary and the errors of every position."""
    unit = found.unit
    header = ["axis", f"max before [{unit}]", "max after", "rms before", "rms after",
              "linearity before [%]", "after", "largest U", "verdict"]  # fmt: skip
    rows = []
    for axis in (*found.axes, None) if len(found.axes) > 1 else found.axes:
        s = found.summary(axis)
        values = [
            number(s[when][key])
            for key in ("maximum", "rms", "linearity_percent")
            for when in ("before", "after")
        ]
        rows.append(
            [axis or "all", *values, number(s["after"]["largest_U"], 2), s["verdict"] or "-"]
        )
    parts = [("Errors before and after compensation", draw(header, rows))]
    header = ["position"]
    for axis in found.axes:
        header += [f"{axis} [{unit}]", "before", "after", "U"]
    rows = []
    for row, label in enumerate(found.positions):
        cells = [label]
        for column in np.arange(len(found.axes)):
            cells += [f"{found.reference[row, column]:.6g}"]
            cells += [_signed(found.before[row, column]), _signed(found.after[row, column])]
            cells += [number(float(found.U[row, column]), 2)]
        rows.append([*cells, worst(found.verdicts[row]) or "-"])
    parts.append(("Every position", draw([*header, "verdict"], rows)))
    return parts


def check_text(found: Check) -> str:
    """Return the check as plain text."""
    sections = check_sections(found)
    text = "\n".join(f"{title}\n{'-' * len(title)}\n{body}\n" for title, body in sections)
    if found.limit is None:
        return text
    count = {name: int((found.verdicts == name).sum()) for name in VERDICTS}
    said = ", ".join(f"{count[name]} {name}" for name in VERDICTS)
    return (
        f"{text}\n{found.verdict} against {found.limit:g} {found.unit} with U "
        f"({100 * found.confidence:g} %) as guard band: {said}\n"
    )


def _signed(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:+.3g}"

"""The summary that a fit prints; the whole report is `multipos.reports.documents`.

`text_report` is all of it: `calibration_sentence`, the answer in a sentence, with
`counted_findings` and the largest U in percent or ppm (`share`); `parameter_text`, the parameters
as value(u) with U, k and degrees of freedom; the findings; and `detail_text`, what was done, of
one- and two-axis sensors how they are installed and what their rolls say of the turntable, the
residuals of every position, and how the result was checked, in the tables of a report.
`method_rows` are those of what was done.
"""

import math
from collections.abc import Iterable

import numpy as np

from multipos.files import numbers
from multipos.files.written_units import MAGNETIC_UNITS
from multipos.finding import LEVELS, Finding, errors_of
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import CONSTANT
from multipos.sensor.calibration import Calibration, parameter_rows, rms_before

_ROUNDING = 1e-12  # of the largest scale factor: an output that does not respond


def counted_findings(findings: Iterable[Finding]) -> str:
    """Return how many errors and warnings there are."""
    levels = [found.level for found in findings]
    counts = {level: levels.count(level) for level in LEVELS[:2]}
    said = [f"{n} {level}{'s' if n > 1 else ''}" for level, n in counts.items() if n]
    return ", ".join(said) or "no warnings"


def calibration_sentence(c: Calibration) -> str:
    """Return from what a calibration was made, its rms error and U, and whether to use it."""
    count, kind = len(c.readings), c.field.row(c.estimator.position)
    whole = count + len(c.excluded)
    of = f"{count} of {whole}" if c.excluded else f"{count}"
    parts = [f"{', '.join(c.outputs)} calibrated from {of} {kind}{'' if whole == 1 else 's'}"]
    if math.isfinite(c.rms):
        before, after = rms_before(c), _with_angle(c, c.rms, " near level")
        if before is not None:
            after = f"{numbers.in_unit(before, 'g')} before, {after} after"
        parts[0] += f": rms error {after}"
    bias, scale = _largest_expanded(c)
    sizes = [c.field.worded(f"{_with_angle(c, bias)} of bias")] if math.isfinite(bias) else []
    sizes += [f"{share(scale)} of scale"] if math.isfinite(scale) else []
    if sizes:
        percent = f"{100.0 * c.confidence:g}"
        parts.append(f"U ({percent} %) up to {' and '.join(sizes)}")
    head = "Not fit for use: " if errors_of(c.findings) else ""
    return f"{head}{'; '.join([*parts, counted_findings(c.findings)])}."


def _with_angle(c: Calibration, size: float, where: str = "") -> str:
    """Return a size, of an inclinometer with the angle near level that it is."""
    shown, angle = _shown(c, size), c.field.level_angle(size)
    if not angle or len(c.model.sensed_axes) == len(COMPONENTS):
        return shown
    return f"{shown} ({angle}{where})"


def _shown(c: Calibration, size: float) -> str:
    """Return a size of force or field; of a field of unknown size in the unit of the readings."""
    if c.field.unit or c.model.unit not in MAGNETIC_UNITS:
        return c.field.shown(size)
    return numbers.in_unit(size * float(np.linalg.norm(c.sensitivity, axis=1).mean()), c.model.unit)


def _largest_expanded(c: Calibration) -> tuple[float, float]:
    """Return the largest U of a bias [g], and of a scale factor as a share of it.

    Of each output that is the scale factor along the axis that it senses most.
    """
    own = {c.model.keys[i][0]: i for i in c.model.own_scales}
    for i in c.model.scaled[0]:
        output = c.model.keys[i][0]
        own[output] = max(own[output], i, key=lambda place: abs(c.parameters[place]))
    keys = enumerate(c.model.keys)
    zero = [i for i, (output, term) in keys if term == CONSTANT and output in own]
    places = list(own.values())
    response = np.abs(c.parameters)
    response[response <= _ROUNDING * response[places].max(initial=0.0)] = np.nan
    size: Array = response[[own[c.model.keys[i][0]] for i in zero]]
    bias, scale = c.U[zero] / size, c.U[places] / response[places]
    largest = (float(np.max(each)) if len(each) else math.nan for each in (bias, scale))
    return next(largest), next(largest)


def share(size: float) -> str:
    """Return a share in percent, a small one in ppm, to two digits."""
    size = numbers.beyond_rounding(size)
    factor, unit = (100.0, "%") if size >= 1e-3 else (1e6, "ppm")
    return f"{float(f'{factor * size:.2g}'):g} {unit}"


def text_report(calibration: Calibration) -> str:
    """Return the summary as plain text."""
    parts = [f"{calibration_sentence(calibration)}\n", parameter_text(calibration)]
    if calibration.findings:
        said = "\n".join(f"- {found}" for found in calibration.findings)
        parts.append(numbers.titled("Findings", said))
    return "\n".join([*parts, detail_text(calibration)])


def parameter_text(calibration: Calibration) -> str:
    """Return the table of parameters, after the positions that were set aside."""
    aside = f"{calibration.set_aside}\n\n" if calibration.excluded else ""
    return aside + numbers.titled("Parameters", numbers.table(*parameter_rows(calibration)))


def detail_text(calibration: Calibration) -> str:
    """Return what was done, how the sensor is installed, the residuals and the checks."""
    # Imported here: a fit that is not asked for details needs neither tests nor figures.
    from multipos.reports import evidence, fit_tests, quantities, sections, turntable_text
    from multipos.uncertainty.turntable import has_rolls, table_errors

    c = calibration
    tables = [*sections.method_section(method_rows(c)).tables]
    if len(c.model.sensed_axes) < len(COMPONENTS):
        tables += quantities.leaning_table(c)
        tables += turntable_text.turntable_tables(table_errors(c)) if has_rolls(c) else []
    tables += [*evidence.residual_tables(c), fit_tests.checks_table(c)]
    worded = sections.worded_section(sections.Section("", tables=tuple(tables)), c.field)
    shown = (sections.shortened(each, "--json has all") for each in worded.tables)
    return "\n".join(numbers.titled(each.caption, str(each)) for each in shown)


def method_rows(c: Calibration) -> list[tuple[str, str]]:
    """Return what was done and by what, each with its name."""
    *in_field, (field, size) = c.field.lines(c.convention)
    if c.gravity is not None:
        unit = c.gravity.size_unit
        size = f"{c.gravity.value:.10g} {unit}, u = {numbers.in_unit(c.gravity.u, unit)}"
    rows = [
        ("Readings", c.readings.source or "from memory"),
        ("SHA-256 of the readings", c.readings.sha256 or "-"),
        ("Number of readings", str(len(c.readings))),
        ("Outputs and unit", f"{', '.join(c.outputs)} [{c.model.unit}]"),
        ("Model", c.model.text),
        *((name.capitalize(), value) for name, value in (*in_field, (field, size))),
        ("Estimator", c.estimator),
        ("Criterion", c.field.worded(c.criterion)),
        ("Computed", f"{c.created}, multipos {c.version}"),
    ]
    if c.model.drift_tau is not None:
        unit = "s" if c.model.drift_per == "h" else "rows"
        tau = f"{numbers.uncertain(*c.model.drift_tau)} {unit}"
        rows.append(("Drift", f"exponential, tau = {tau}; biases are those at its end"))
    for name, column in c.readings.environment.items():
        if np.isfinite(column).all():
            rows.append((name, f"{column.min():.6g} … {column.max():.6g}"))
    return rows

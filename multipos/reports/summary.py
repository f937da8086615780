"""The summary that a fit prints; the whole report is `multipos.reports.documents`.

`text_report` is all of it: `calibration_sentence`, the answer in a sentence, with
`counted_findings` and the largest U in percent or ppm (`share`); `parameter_text`, the parameters
as value(u) with U, k and degrees of freedom; the findings; and `detail_text`, what was done, of
one- and two-axis sensors how they are installed and what their rolls say of the turntable, the
residuals of every position, and how the result was checked.
"""

import math
from collections.abc import Iterable

import numpy as np

from multipos.files import numbers
from multipos.finding import LEVELS, Finding, errors_of
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import CONSTANT
from multipos.positions.headers import MAGNETIC_UNITS
from multipos.sensor.calibration import Calibration, nominal_error, parameter_rows, rms_before

_ROUNDING = 1e-12  # of the largest scale factor: an output that does not respond


def counted_findings(findings: Iterable[Finding]) -> str:
    """Return how many errors and warnings there are."""
    levels = [found.level for found in findings]
    counts = {level: levels.count(level) for level in LEVELS[:2]}
    said = [f"{n} {level}{'s' if n > 1 else ''}" for level, n in counts.items() if n]
    return ", ".join(said) or "no warnings"


def calibration_sentence(c: Calibration) -> str:
    """Return from what a calibration was made, its rms error and U, and whether to use it."""
    count = len(c.readings)
    kind = c.field.row(c.estimator.position)
    plural = "" if count == 1 else "s"
    parts = [f"{', '.join(c.outputs)} calibrated from {count} {kind}{plural}"]
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
    """Return the largest U of a bias [g], and of an own scale factor as a share of it."""
    own = {c.model.keys[i][0]: i for i in c.model.own_scales}
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
    return "\n".join(numbers.titled(title, body) for title, body in _sections(calibration))


def _sections(calibration: Calibration) -> list[tuple[str, str]]:
    sections = [("Calibration", _summary(calibration))]
    if len(calibration.model.sensed_axes) < len(COMPONENTS):
        from multipos.reports.installation import installation_tables, turntable_tables
        from multipos.uncertainty.turntable import has_rolls, table_errors

        tables = installation_tables(calibration)
        if has_rolls(calibration):
            tables += turntable_tables(table_errors(calibration))
        sections += [(each.caption, str(each)) for each in tables]
    sections.append(("Residuals", _residuals(calibration)))
    sections.append(("Checks", _checks(calibration)))
    return sections


def _summary(calibration: Calibration) -> str:
    c = calibration
    readings = c.readings
    counted = f"{len(readings)} of {', '.join(c.outputs)} [{c.model.unit}]"
    lines = [
        f"readings    {readings.source or 'from memory'}: {counted}",
        f"model       {c.model.text}, inputs {', '.join(c.model.inputs)}",
        *(f"{name:<12}{value}" for name, value in c.field.lines(c.convention)),
        *(f"at          {name} 0, where its terms vanish" for name in c.model.environment),
        f"estimator   {c.estimator}: {c.criterion}",
        f"created     {c.created}, multipos {c.version}",
    ]
    return "\n".join(lines)


def _residuals(calibration: Calibration) -> str:
    c = calibration
    header = ["position", "x", "y", "z", *(f"{output} [{c.model.unit}]" for output in c.outputs)]
    sizes = np.abs(c.readings.values).max(axis=0).tolist()
    names, shown = c.readings.labels, numbers.largest_rows(c.relative_residuals.tolist())
    rows = [
        [
            names[row],
            *(f"{value:.4g}" for value in c.reference[row].tolist()),
            *map(_residual, c.residuals[row].tolist(), sizes),
        ]
        for row in shown
    ]
    spreads = zip(c.residual_sd.tolist(), sizes, strict=True)
    sd = ["s", "", "", "", *(numbers.number(numbers.beyond_rounding(*each), 3) for each in spreads)]
    dof = ["dof", "", "", "", *(numbers.number(value) for value in c.dof.tolist())]
    text = numbers.table(header, [*rows, sd, dof])
    if len(shown) == len(names):
        return text
    return f"{text}\nthe largest {len(shown)} of {len(names)} positions; --json has all"


def _residual(value: float, scale: float) -> str:
    """Return a residual of readings of size `scale`; one that is rounding is 0."""
    return f"{value:+.3e}" if numbers.beyond_rounding(value, scale) else "0"


def _checks(calibration: Calibration) -> str:
    c = calibration
    unit = c.field.unit or "of the field"
    no_force = c.field.worded("none, as the parameters give no force")
    left = f"{numbers.beyond_rounding(c.rms):.3e} {unit}" if math.isfinite(c.rms) else no_force
    lines = [f"rms of what is left after compensation: {left}"]
    if c.nominal is not None:
        before = nominal_error(c)
        rms = math.sqrt(float(before @ before) / len(before))
        said = f"(reading - {c.nominal.bias:g})/{c.nominal.scale:g}"
        lines.append(f"before, by {said}: rms {rms:.3e} {unit}, largest {before.max():.3e} {unit}")
    for output, found in c.linearity.items():
        lines.append(
            f"linearity of {output}: {numbers.number(found['without_model_percent'])} % without, "
            f"{numbers.number(found['with_model_percent'])} % with the model"
        )
    if c.cross_check is not None:
        lines.append(f"closed form against least squares: {c.cross_check:.1e} of a reading")
    lines.append(
        f"rank {c.diagnostics.rank} of {c.diagnostics.parameters}, "
        f"condition {c.diagnostics.condition:.3g}"
    )
    for output, test in c.diagnostics.lack_of_fit.items():
        p = test["p"]
        if isinstance(p, float) and math.isfinite(p):
            lines.append(f"lack of fit of {output} against repeats: {numbers.p_in_words(p)}")
    return "\n".join(lines)

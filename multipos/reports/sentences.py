"""The answer of a fit in one sentence: from what, its rms error, its U, and whether to use it."""

import math
from collections.abc import Iterable

import numpy as np

from multipos.files.numbers import beyond_rounding, in_unit
from multipos.finding import LEVELS, Finding, errors_of
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS, CONSTANT
from multipos.positions.headers import MAGNETIC_UNITS
from multipos.reports.sections import Translator
from multipos.sensor.calibration import Calibration, rms_before
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import sensed_axes

_ROUNDING = 1e-12  # of the largest scale factor: an output that does not respond


_ENGLISH = Translator("en")


def counted_findings(findings: Iterable[Finding], tr: Translator = _ENGLISH) -> str:
    """Return how many errors and warnings there are."""
    levels = [found.level for found in findings]
    counts = {level: levels.count(level) for level in LEVELS[:2]}
    said = [
        tr(f"{{count}} {level}{'s' if n > 1 else ''}", count=str(n))
        for level, n in counts.items()
        if n
    ]
    return tr.listed(said) or tr("no warnings")


def calibration_sentence(c: Calibration, tr: Translator = _ENGLISH) -> str:
    """Return from what a calibration was made, its rms error and U, and whether to use it."""
    if c.field.magnetic and not tr.field.magnetic:
        tr = Translator(tr.language, c.field)
    count = len(c.readings)
    kind = "hand-held position" if c.estimator is Estimator.UNKNOWN else "position"
    kind = "reading" if c.field.magnetic else kind
    said = f"{{outputs}} calibrated from {{count}} {kind}{'s' if count != 1 else ''}"
    parts = [tr(said, outputs=tr.listed(c.outputs), count=str(count))]
    if math.isfinite(c.rms):
        before, after = rms_before(c), _with_angle(c, c.rms, tr, "{angle} near level")
        said = (
            ": rms error {after}"
            if before is None
            else ": rms error {before} before, {after} after"
        )
        parts[0] += tr(said, before=in_unit(before or 0.0, "g"), after=after)
    bias, scale = _largest_expanded(c)
    sizes = [tr("{size} of bias", size=_with_angle(c, bias, tr))] if math.isfinite(bias) else []
    sizes += [tr("{size} of scale", size=share(scale))] if math.isfinite(scale) else []
    if sizes:
        percent = f"{100.0 * c.confidence:g}"
        parts.append(
            tr("U ({percent} %) up to {sizes}", percent=percent, sizes=tr(" and ").join(sizes))
        )
    head = tr("Not fit for use: ") if errors_of(c.findings) else ""
    return f"{head}{tr('; ').join([*parts, counted_findings(c.findings, tr)])}{tr('.')}"


def _with_angle(c: Calibration, size: float, tr: Translator, form: str = "{angle}") -> str:
    """Return a size, of an inclinometer with the angle near level that it is."""
    shown = _shown(c, size)
    if c.field.magnetic or len(sensed_axes(c.model)) == len(COMPONENTS):
        return shown
    return f"{shown} ({tr(form, angle=in_unit(math.degrees(size), 'deg'))})"


def _shown(c: Calibration, size: float) -> str:
    """Return a size of force or field; of a field of unknown size in the unit of the readings."""
    if c.field.unit or c.model.unit not in MAGNETIC_UNITS:
        return c.field.shown(size)
    return in_unit(size * float(np.linalg.norm(c.sensitivity, axis=1).mean()), c.model.unit)


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
    size = beyond_rounding(size)
    factor, unit = (100.0, "%") if size >= 1e-3 else (1e6, "ppm")
    return f"{float(f'{factor * size:.2g}'):g} {unit}"

"""What is said of the axis and sense of outputs: by their names, and by a minus before an axis.

Where the orientations are unknown the fit leaves every reflection free,
y = b + K f = b + (K D)(D f) with D of signs, and takes own-axis scale factors positive. An output
that is said to face down its axis has a negative one: the reflection that makes it so is applied
to what was found.

Where every output falls as what it is said to sense rises, the other convention is the likely one.
"""

from dataclasses import replace

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.terms import COMPONENTS, Term
from multipos.positions.attitudes import CONVENTIONS
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Model


def note_names(readings: Readings, model: Model) -> Readings:
    """Return readings that say where their outputs stand in another order than x, y, z."""
    if model.axes == COMPONENTS[: len(model.axes)]:
        return readings
    pairs = zip(model.outputs, model.axes, strict=True)
    said = ", ".join(f"{output} senses {axis}" for output, axis in pairs)
    note = f"by their names {said}; --axes says otherwise"
    return replace(readings, notes=(*readings.notes, note))


def face(calibration: Calibration, facing: tuple[str, ...] | None) -> Calibration:
    """Return a calibration that knows what was said of its outputs, reflected where it is free.

    Where nothing was said every output is taken to face along its axis. One that says of all its
    outputs that they face the other way has that as a warning.

    Raises
    ------
    UsageError
        A symmetric gauge, which no reflection leaves.
    """
    if facing is None:
        return _with_convention(calibration, calibration.model.axes)
    down = {axis.removeprefix("-") for axis in facing if axis.startswith("-")}
    if down and calibration.model.gauge is not None:
        calibration = _reflected(calibration, down)
    return _with_convention(replace(calibration, facing=facing), facing)


def _with_convention(calibration: Calibration, facing: tuple[str, ...]) -> Calibration:
    """Return a calibration that warns where the readings look like the other convention."""
    c = calibration
    down = {o for o, axis in zip(c.outputs, facing, strict=True) if axis.startswith("-")}
    along = [-scale if output in down else scale for output, scale in _own_scales(c)]
    if not along or max(along) >= 0.0:
        return c
    other = next(name for name in CONVENTIONS if name != c.convention)
    how = "of the other sign than --axes says" if down else "negative"
    text = (
        f"every own-axis scale factor is {how} under --convention {c.convention}; "
        f"the readings look like --convention {other}"
    )
    diagnostics = replace(c.diagnostics, warnings=(*c.diagnostics.warnings, text))
    return replace(c, diagnostics=diagnostics)


def _own_scales(c: Calibration) -> list[tuple[str, float]]:
    """Return how each output responds along its axis, of those that have a term for it."""
    if isinstance(c.model, ExpressionModel):
        slopes = c.model.force_jacobian(c.parameters, c.reference, c.readings.environment)
        along = [COMPONENTS.index(axis) for axis in c.model.axes]
        mean = slopes.mean(axis=0)[range(len(along)), along]
        return list(zip(c.outputs, mean.tolist(), strict=True))
    return [(c.model.keys[i][0], float(c.parameters[i])) for i in c.model.own_scales]


def _reflected(calibration: Calibration, down: set[str]) -> Calibration:
    """Return a calibration whose gauge leaves it free with some axes the other way round."""
    gauge = calibration.model.gauge
    terms = [term for _, term in calibration.model.keys]
    if gauge == "symmetric" or not all(isinstance(term, Term) for term in terms):
        raise UsageError(
            "--axes with a minus needs --gauge lower, and a model of terms, where orientations are "
            "unknown."
        )
    sign = np.array([_parity(term, down) for term in terms])
    mirror = np.array([-1.0 if axis in down else 1.0 for axis in COMPONENTS])
    return replace(
        calibration,
        parameters=sign * calibration.parameters,
        covariance=np.outer(sign, sign) * calibration.covariance,
        reference=calibration.reference * mirror + 0.0,
    )


def _parity(term: Term, axes: set[str]) -> float:
    """Return what a term is multiplied by where components change their sign; a modulus is even."""
    odd = sum(factor.power for factor in term.factors if factor.variable in axes)
    return -1.0 if odd % 2 else 1.0

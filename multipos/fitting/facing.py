"""What is said of the axis and sense of outputs: by their names, and by a minus before an axis.

Where the orientations are unknown the fit leaves every reflection free,
y = b + K f = b + (K D)(D f) with D of signs, and takes own-axis scale factors positive. An output
that is said to face down its axis has a negative one: the reflection that makes it so is applied
to what was found.
"""

from dataclasses import replace

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.terms import COMPONENTS, Term
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
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

    It stays as it is where nothing was said.

    Raises
    ------
    UsageError
        A symmetric gauge, which no reflection leaves.
    """
    if facing is None:
        return calibration
    down = {axis.removeprefix("-") for axis in facing if axis.startswith("-")}
    if down and calibration.model.gauge is not None:
        calibration = _reflected(calibration, down)
    return replace(calibration, facing=facing)


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

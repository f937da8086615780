"""The laws of consumers that take numbers: matrix and offset, or a scale and an offset an axis.

With raw = K f + o and T = K⁻¹, f the specific force in m/s² on axes x, y, z,

    f = T (raw - o)                                                                        (1)

is all that these consumers can do. A calibration with more in it is fitted again with the terms
that remain, to the same readings and references, and what that loses is told. A calibration under
the convention 'gravity' has the sign of its force turned: consumers work in specific force.
"""

from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.known import solve_known
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.model import build_model
from multipos.units import STANDARD_GRAVITY

LINEAR = "1 + x + y + z"
DIAGONAL = "1 + own"
_METRES = ("m/s^2", "m/s2", "m/s²", "m/s/s", "ms-2", "m s-2", "m s^-2")


class Law(NamedTuple):
    """Matrix T (3, 3) and offset o (3,) of eq. (1), and how well they do on the readings."""

    matrix: Array
    offset: Array
    formula: str  # the terms it has
    lost: bool  # whether the calibration says more than this law can
    rms: float  # [g]

    def of_raw_in(self, metres: float) -> "Law":
        """Return the law of raw values in m/s²; `metres` is the m/s² in a unit of the readings."""
        return self._replace(matrix=self.matrix / metres, offset=self.offset * metres)


def reduce_to(calibration: Calibration, formula: str, target: str, *, allow_lossy: bool) -> Law:
    """Return the law of a formula, LINEAR or DIAGONAL, in the unit of the readings.

    Raises
    ------
    MultiposError
        Not a triad; a model with temperature or another column; a model that says more, unless
        `allow_lossy`.
    """
    _check_inputs(calibration, target)
    model = calibration.model
    reduced = build_model(formula, model.outputs, model.axes, unit=model.unit)
    lost = not all(set(a) <= set(b) for a, b in zip(model.terms, reduced.terms, strict=True))
    if lost:
        solution = solve_known(reduced, calibration.reference, calibration.readings)
        linear = reduced.linear_map({}) @ solution.parameters
    else:
        linear = model.linear_map({}) @ calibration.parameters
    sign = calibration.sign
    order = [model.axes.index(axis) for axis in COMPONENTS]
    K = sign * linear[:, 1:] / STANDARD_GRAVITY
    # Columns of T belong to the outputs in the order x, y, z in which consumers hold them.
    try:
        inverse = np.asarray(np.linalg.inv(K))
    except np.linalg.LinAlgError:
        raise MultiposError(
            f"{target} needs the inverse of the sensitivities, and this calibration's have none; "
            "an output does not sense its axis."
        ) from None
    law = Law(inverse[:, order], linear[order, 0], formula, lost, 0.0)
    law = law._replace(rms=rms_left(calibration, law_residuals(calibration, *law[:2])))
    if lost and not allow_lossy:
        raise MultiposError(f"{loss_text(calibration, law, target)}; accept it with --allow-lossy.")
    return law


def law_residuals(calibration: Calibration, matrix: Array, offset: Array) -> Array:
    """Return the specific force of eq. (1) less the reference (n, 3) [g] at each position."""
    order = [calibration.model.axes.index(axis) for axis in COMPONENTS]
    raw = calibration.readings.values[:, order]
    return (raw - offset) @ matrix.T / STANDARD_GRAVITY - specific_force(calibration)


def rms_left(calibration: Calibration, residuals: Array) -> float:
    """Return the rms of what is left [g], of the same kind as the calibration's own."""
    if calibration.estimator is Estimator.UNKNOWN:
        reference = specific_force(calibration)
        size = np.linalg.norm(reference + residuals, axis=1)
        return float(np.sqrt(np.mean((size - np.linalg.norm(reference, axis=1)) ** 2)))
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def specific_force(calibration: Calibration) -> Array:
    """Return the references (n, 3) [g] as specific force, whatever the convention."""
    return calibration.sign * calibration.reference


def loss_text(calibration: Calibration, law: Law, target: str) -> str:
    """Return in words what a law loses."""
    kept = build_model(law.formula, calibration.outputs, calibration.model.axes).names
    gone = [name for name in calibration.names if name not in kept]
    listed = ", ".join(gone[:9]) + (f" and {len(gone) - 9} more" if len(gone) > 9 else "")
    return (
        f"{target} cannot express {listed}: the rms of what is left after compensation grows from "
        f"{1e3 * calibration.rms:.3g} to {1e3 * law.rms:.3g} mg"
    )


def in_metres(calibration: Calibration, target: str) -> float:
    """Return the m/s² in a unit of the readings, for consumers that hold raw values in m/s².

    Raises
    ------
    MultiposError
        The readings are neither in m/s² nor in g.
    """
    _check_inputs(calibration, target)
    unit = calibration.model.unit
    if unit in _METRES:
        return 1.0
    if unit == "g":
        return STANDARD_GRAVITY
    slope = calibration.model.force_jacobian(calibration.parameters, np.zeros((1, 3)), {})[0]
    scale = float(np.abs(slope).max(axis=1).mean())
    if unit == "reading" and 0.5 < scale / STANDARD_GRAVITY < 2.0:  # not stated, but plain
        return 1.0
    raise MultiposError(
        f"{target} holds raw values in m/s^2, but the readings are in '{unit}' with a scale factor "
        f"of {scale:.4g} per g; convert them, or state --unit g or --unit m/s^2 in fit."
    )


def _check_inputs(calibration: Calibration, target: str) -> None:
    model = calibration.model
    if sorted(model.axes) != list(COMPONENTS):
        raise MultiposError(
            f"{target} takes three outputs, one on each of x, y, z; this calibration has "
            f"{', '.join(f'{o} on {a}' for o, a in zip(model.outputs, model.axes, strict=True))}."
        )
    if model.environment:
        raise MultiposError(
            f"the model uses column '{model.environment[0]}', but {target} has no such input; "
            "export --to c, or fit a model without it."
        )

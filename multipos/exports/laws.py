"""The laws of consumers that take numbers: matrix and offset, or a scale and an offset an axis.

`reduce_to` reduces a calibration to such a law after `check_inputs`; `law_residuals`, `rms_left`
and `largest_difference` return what it leaves, `loss_text` says what it loses, and `specific_force`
returns the references that it is held to. `in_metres`, `raw_in`, `raw_zero`, `scale_per_g` and
`reference_in` convert between the units of readings, consumer and reference.

With raw = K f + o and T = K⁻¹, f the specific force in m/s² on axes x, y, z,

    f = T (raw - o)                                                                        (1)

is all that these consumers can do. Of a magnetometer f is the field in the consumer's unit, raw is
so too, and consumers hold a symmetric T: of T = V S (polar), S the symmetric root, they take S, so
that their field is turned by V'. Nothing is known of V where orientations were unknown; else it
is a turn of the triad that such a file loses. A field of unknown size has the triad's own mean
scale, the cube root of det K, so that det T = 1.

Some take an offset that drifts with the temperature t,

    f = T (raw - o - sum_k c_k (t' - t_0)^k),    k = 1 to 3,                               (2)

t' being t held to the calibrated range. A calibration with more in it is fitted again with the
terms that remain, to the same readings and references, and what that loses is reported. A
calibration under the convention 'gravity' has the sign of its force turned: consumers work in
specific force.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.estimation.known import solve_known
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.sensor.calibration import Calibration, hidden_turn
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import in_tesla
from multipos.sensor.model import Model, build_model
from multipos.units import STANDARD_GRAVITY

LINEAR = "1 + x + y + z"
DIAGONAL = "1 + own"
_METRES = ("m/s^2", "m/s2", "m/s²", "m/s/s", "ms-2", "m s-2", "m s^-2")


TEMPERATURE = "temperature"
_POWERS = (TEMPERATURE, f"{TEMPERATURE}^2", f"{TEMPERATURE}^3")
_SINGULAR = 1e12  # condition of sensitivities whose inverse has no digits to rely on


class Drift(NamedTuple):
    """How the offset drifts with temperature, the sum of eq. (2).

    Attributes
    ----------
    slopes : (3, 3) array
        c_k, a row for each power, columns x, y, z.
    reference, low, high : float [°C]
        t_0, and the calibrated range.
    """

    slopes: Array
    reference: float
    low: float
    high: float

    def offset(self, temperature: ArrayLike) -> Array:
        """Return the sum of eq. (2) at temperatures (n,) as (n, 3)."""
        off = np.clip(np.asarray(temperature, dtype=np.float64), self.low, self.high)
        powers = (off - self.reference)[..., None] ** np.arange(1, 4)
        return np.asarray(powers @ self.slopes)

    def about(self, reference: float) -> "Drift":
        """Return the same drift about another t_0, without what the offset gains there."""
        x = np.polynomial.Polynomial([reference - self.reference, 1.0])
        found = np.zeros((4, 3))
        for axis in range(3):
            moved = np.polynomial.Polynomial([0.0, *self.slopes[:, axis]])(x).coef
            found[: len(moved), axis] = moved
        return self._replace(slopes=found[1:], reference=reference)

    def scaled(self, factor: float) -> "Drift":
        """Return the drift of readings in another unit."""
        return self._replace(slopes=self.slopes * factor)


class Correction(NamedTuple):
    """Matrix T (3, 3), offset o (3,) and drift of eqs. (1) and (2), and V, where it is unknown."""

    matrix: Array
    offset: Array
    drift: Drift | None = None
    turn: Array = np.eye(3)

    def of_raw_in(self, metres: float, zero: float = 0.0) -> "Correction":
        """Return the law of raw values in m/s², which are `metres` (readings − `zero`)."""
        drift = None if self.drift is None else self.drift.scaled(metres)
        offset = (self.offset - zero) * metres
        return Correction(self.matrix / metres, offset, drift, self.turn)


class Law(NamedTuple):
    """What a target's law makes of a calibration, and how well it does on the readings."""

    correction: Correction
    formula: str  # the terms it has
    lost: bool  # whether the calibration says more than this law can
    rms: float  # [g]


def reduce_to(
    calibration: Calibration,
    formula: str,
    target: str,
    *,
    allow_lossy: bool,
    thermal: bool = False,
    tesla: float | None = None,
    offset_alone: bool = False,
) -> Law:
    """Return the law of a formula, LINEAR or DIAGONAL, in the unit of the readings.

    Where it is `thermal`, powers of the temperature that the calibration's offsets have stay in.
    Of a magnetometer `tesla` is the consumer's unit; its matrix is symmetric, or one where the
    consumer takes the `offset_alone`.

    Raises
    ------
    MultiposError
        Not a triad; a model with temperature or another column; a model that says more, unless
        `allow_lossy`.
    """
    check_inputs(calibration, target, thermal=thermal)
    model = calibration.model
    if thermal:
        formula = " + ".join([formula, *_thermal_terms(calibration)])
    reduced = build_model(formula, model.outputs, model.axes, unit=model.unit)
    lost = not all(set(a) <= set(b) for a, b in zip(model.terms, reduced.terms, strict=True))
    parameters = calibration.parameters
    if lost:
        parameters = solve_known(reduced, calibration.reference, calibration.readings).parameters
        model = reduced
    middle = calibration.mean_environment
    linear = model.linear_part(parameters, middle)
    sign = calibration.sign
    order = [model.axes.index(axis) for axis in COMPONENTS]
    K = sign * linear[:, 1:] / reference_in(calibration, tesla, linear[:, 1:])
    # Columns of T belong to the outputs in the order x, y, z in which consumers hold them.
    if not np.linalg.cond(K) < _SINGULAR:
        raise MultiposError(
            f"{target} needs the inverse of the sensitivities, and this calibration's have none; "
            "an output does not sense its axis."
        )
    inverse = np.asarray(np.linalg.inv(K))
    drift = _drift(calibration, model, parameters)
    matrix, turn = inverse[:, order], np.eye(3)
    if tesla is not None:
        matrix, turn = _symmetric(matrix)
        if calibration.estimator is not Estimator.UNKNOWN:
            _require_no_turn(calibration, turn, target, allow_lossy)
            turn = np.eye(3)
    found = Correction(matrix, linear[order, 0], drift, turn)
    law = Law(found, formula, lost, rms_left(calibration, law_residuals(calibration, found, tesla)))
    if lost and not allow_lossy:
        raise MultiposError(f"{loss_text(calibration, law, target)}; accept it with --allow-lossy.")
    return _of_offset(calibration, law, target, tesla) if offset_alone and tesla else law


def _of_offset(calibration: Calibration, law: Law, target: str, tesla: float) -> Law:
    """Return a law whose matrix is one: of the consumer's raw field the offset is taken away."""
    size = in_metres(calibration, target, tesla)
    found = law.correction._replace(matrix=np.eye(3) * size)
    left = rms_left(calibration, law_residuals(calibration, found, tesla))
    return law._replace(correction=found, lost=True, rms=left)


def _symmetric(matrix: Array) -> tuple[Array, Array]:
    """Return the symmetric root S and the turn V of a matrix T = V S."""
    U, size, Vt = np.linalg.svd(matrix)
    return Vt.T * size @ Vt, U @ Vt


_TURN = 1e-6  # [degrees] that is rounding


def _require_no_turn(calibration: Calibration, turn: Array, target: str, allow_lossy: bool) -> None:
    """Refuse a triad that is turned in its case by more than U, which a symmetric matrix loses."""
    mounting = calibration.intrinsic
    u = 0.0 if mounting is None else max(v["u"] for v in mounting["mounting_deg"].values())
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))))
    if angle > max(2.0 * u, _TURN) and not allow_lossy:
        raise MultiposError(
            f"{target} takes a symmetric matrix, and the triad is turned by {angle:.3g} degrees in "
            "its case (U "
            f"{2.0 * u:.2g}), which would be lost; accept it with --allow-lossy."
        )


def reference_in(
    calibration: Calibration, tesla: float | None, linear: Array | None = None
) -> float:
    """Return one unit of the reference in the consumer's: m/s², or its unit of a field [T].

    Parameters
    ----------
    linear : (3, 3) array, optional
        Sensitivities, whose mean is that of a field of unknown size.
    """
    if tesla is None:
        return STANDARD_GRAVITY
    own = in_tesla(calibration.field.size_unit) if calibration.field.size is not None else None
    if own is not None:
        return own / tesla
    if linear is None:
        linear = calibration.sensitivity
    mean = float(np.cbrt(abs(np.linalg.det(linear))))
    return mean * raw_in(calibration, "", tesla, mean)


def _thermal_terms(calibration: Calibration) -> list[str]:
    """Return the powers of the temperature that the offset of some output has."""
    held = {str(term) for terms in calibration.model.terms for term in terms}
    return [power for power in _POWERS if power in held]


def _drift(calibration: Calibration, model: Model, parameters: Array) -> Drift | None:
    """Return how the offset of a model drifts about the mean temperature, None where it cannot."""
    if not any(str(term) in _POWERS for _, term in model.keys):
        return None
    seen = calibration.readings.environment[TEMPERATURE]
    slopes = np.zeros((3, 3))
    for (output, term), value in zip(model.keys, parameters.tolist(), strict=True):
        if str(term) in _POWERS:
            axis = COMPONENTS.index(model.axes[model.outputs.index(output)])
            slopes[_POWERS.index(str(term)), axis] = value
    zero = Drift(slopes, 0.0, float(seen.min()), float(seen.max()))
    return zero.about(float(np.mean(seen)))


def law_residuals(calibration: Calibration, law: Correction, tesla: float | None = None) -> Array:
    """Return the specific force of the law less the reference (n, 3) [g] at each position."""
    order = [calibration.model.axes.index(axis) for axis in COMPONENTS]
    raw = calibration.readings.values[:, order] - law.offset
    if law.drift is not None:
        raw = raw - law.drift.offset(calibration.readings.environment[TEMPERATURE])
    force = raw @ law.matrix.T / reference_in(calibration, tesla)
    return force @ law.turn.T - specific_force(calibration)


def largest_difference(
    calibration: Calibration, law: Correction, tesla: float | None = None
) -> float:
    """Return the largest difference of a law's forces from the calibration's, at its readings."""
    readings = calibration.readings
    force = calibration.sign * calibration.compensate(readings.values, readings.environment)
    of_law = specific_force(calibration) + law_residuals(calibration, law, tesla)
    return float(np.abs(of_law - force).max())


def rms_left(calibration: Calibration, residuals: Array) -> float:
    """Return the rms of what is left [g], of the same kind as the calibration's own."""
    errors, reference = calibration.sign * residuals, calibration.reference
    turn = hidden_turn(calibration, errors)
    errors = errors if turn is None else errors - turn
    return float(np.sqrt(np.mean(calibration.estimator.off(reference + errors, reference) ** 2)))


def specific_force(calibration: Calibration) -> Array:
    """Return the references (n, 3) [g] as specific force, whatever the convention."""
    return calibration.sign * calibration.reference


def loss_text(calibration: Calibration, law: Law, target: str) -> str:
    """Return in words what a law loses."""
    kept = build_model(law.formula, calibration.outputs, calibration.model.axes).names
    gone = [name for name in calibration.names if name not in kept]
    listed = ", ".join(gone[:9]) + (f" and {len(gone) - 9} more" if len(gone) > 9 else "")
    field = calibration.field
    before, after = (field.shown(rms, ".3g", "mg") for rms in (calibration.rms, law.rms))
    grown = f"{before.removesuffix(' mg')} to {after}"
    return (
        f"{target} cannot express {listed}: the rms of what is left after compensation grows from "
        f"{grown}"
    )


def raw_in(calibration: Calibration, target: str, tesla: float, scale: float) -> float:
    """Return the consumer's unit of a magnetic field [T] in a unit of the readings.

    Raises
    ------
    MultiposError
        The readings are in no unit of a field, and no nominal conversion [µT] is stated.
    """
    own = in_tesla(calibration.model.unit)
    if own is not None:
        return own / tesla
    if calibration.nominal is not None:
        return 1e-6 / tesla / calibration.nominal.scale
    raise MultiposError(
        f"{target} holds raw values of a magnetic field, but the readings are in "
        f"'{calibration.model.unit}' with a mean scale of {scale:.4g}; give --unit, or the "
        "driver's conversion to uT with --nominal BIAS,SCALE."
    )


def in_metres(calibration: Calibration, target: str, tesla: float | None = None) -> float:
    """Return the m/s² in a unit of the readings, for consumers that hold raw values in m/s².

    Of a magnetometer it is the unit of a field that the consumer has.

    The calibration is one that `check_inputs` has let pass.

    Raises
    ------
    MultiposError
        The readings are neither in m/s² nor in g, and no nominal conversion is stated.
    """
    unit = calibration.model.unit
    if tesla is not None:
        return raw_in(calibration, target, tesla, scale_per_g(calibration))
    if unit in _METRES:
        return 1.0
    if unit == "g":
        return STANDARD_GRAVITY
    if calibration.nominal is not None:
        return STANDARD_GRAVITY / calibration.nominal.scale
    scale = scale_per_g(calibration)
    if unit == "reading" and 0.5 < scale / STANDARD_GRAVITY < 2.0:  # not stated, but plain
        return 1.0
    raise MultiposError(
        f"{target} holds raw values in m/s^2, but the readings are in '{unit}' with a scale factor "
        f"of {scale:.4g} per g; state the driver's conversion with --nominal BIAS,SCALE, or with "
        "--full-scale G --bits N."
    )


def raw_zero(calibration: Calibration) -> float:
    """Return the reading that consumers hold as 0 m/s²."""
    nominal, unit = calibration.nominal, calibration.model.unit
    in_field = unit in (*_METRES, "g") or in_tesla(unit) is not None
    return 0.0 if nominal is None or in_field else nominal.bias


def scale_per_g(calibration: Calibration) -> float:
    """Return the size of a g in the unit of the readings, a mean over outputs."""
    slopes = calibration.model.linear_part(calibration.parameters, calibration.mean_environment)
    return float(np.abs(slopes[:, 1:]).max(axis=1).mean())


def check_inputs(calibration: Calibration, target: str, *, thermal: bool) -> None:
    """Refuse what is no triad, or has columns that a target does not take.

    Raises
    ------
    MultiposError
    """
    model = calibration.model
    if sorted(model.axes) != list(COMPONENTS):
        raise MultiposError(
            f"{target} takes three outputs, one on each of x, y, z; this calibration has "
            f"{', '.join(f'{o} on {a}' for o, a in zip(model.outputs, model.axes, strict=True))}."
        )
    strange = [name for name in model.environment if not (thermal and name == TEMPERATURE)]
    if strange:
        if thermal and model.environment == (strange[0],):
            raise MultiposError(
                f"the model uses column '{strange[0]}', but {target} takes '{TEMPERATURE}' alone; "
                "name a temperature so, as with --columns, and fit again, or export --to c."
            )
        raise MultiposError(
            f"the model uses column '{strange[0]}', but {target} has no such input; "
            "export --to c, or fit a model without it."
        )

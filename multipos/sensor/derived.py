"""What a calibration says of the sensor itself: sensitivities, offsets, angles between axes.

`intrinsic` gives (1) to (3) of a triad with their uncertainties, `intrinsic_gradient` how they
follow the parameters, `installation_deg` (4).

With the linear part ``y = b + M f`` of a triad, row i of `M` is the sensitivity s_i = |M_i|
times the unit vector n_i of the input axis of output i:

    offset_i  = b_i / s_i                                    [g]                            (1)
    angle_ij  = atan2(|n_i x n_j|, n_i . n_j)                                               (2)
    mounting  = the rotation vector rho that turns the case axes into the sensor's axes,
                the rotation nearest to the n_i: with N = U S V', Exp([rho]x)' = U V'       (3)
    theta_ij  = atan2(M_ij, M_ii), how far output i leans to axis j                         (4)

Uncertainties are propagated to first order from the covariance of the parameters. The linear
part of a model with temperature terms is taken at the mean temperature of its readings.
"""

from collections.abc import Callable, Mapping

import numpy as np

from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.rotations import rotation_vector
from multipos.sensor.model import Model

Value = dict[str, float]  # {"value": …, "u": …}

_STEP = 1e-5  # central differences: truncation 1e-10, rounding 1e-11, of the largest entry


def intrinsic(
    model: Model, parameters: Array, covariance: Array, environment: Mapping[str, float]
) -> dict[str, dict[str, Value]] | None:
    """Return sensitivity, offset, angle_deg and mounting_deg of a triad with u, or None."""
    if model.axes != COMPONENTS or set(model.inputs) != set(COMPONENTS):
        return None
    if not model.has_all_linear:
        return None
    response = np.linalg.norm(model.linear_part(parameters, environment)[:, 1:], axis=1)
    if not np.all(response > _STEP * np.max(response)):
        return None  # an output that does not respond has no axis
    values, u = _propagate(_intrinsic_vector, model, parameters, covariance, environment)
    items = iter(zip(values.tolist(), u.tolist(), strict=True))

    def take(names: tuple[str, ...]) -> dict[str, Value]:
        return {name: _value(*next(items)) for name in names}

    return {
        "sensitivity": take(model.outputs),
        "offset": take(model.outputs),
        "angle_deg": take(("xy", "xz", "yz")),
        "mounting_deg": take(COMPONENTS),
    }


def installation_deg(
    model: Model, parameters: Array, covariance: Array, environment: Mapping[str, float]
) -> dict[str, Value]:
    """Return theta_ij of eq. (4) in degrees with u, keyed 'xy' for output on x leaning to y."""
    if len(set(model.axes)) < len(model.axes) or not model.has_all_linear:
        return {}
    pairs = [
        (i, COMPONENTS.index(axis), COMPONENTS.index(other))
        for i, axis in enumerate(model.axes)
        for other in model.inputs
        if other != axis
    ]
    if not pairs:
        return {}
    outputs, own, other = np.array(pairs).T

    def angles(linear: Array) -> Array:
        return np.degrees(np.arctan2(linear[:, outputs, 1 + other], linear[:, outputs, 1 + own]))

    values, u = _propagate(angles, model, parameters, covariance, environment)
    return {
        COMPONENTS[i] + COMPONENTS[j]: _value(value, sd)
        for i, j, value, sd in zip(own, other, values.tolist(), u.tolist(), strict=True)
    }


def _value(value: float, u: float) -> Value:
    return {"value": value, "u": u}


def intrinsic_gradient(
    model: Model, parameters: Array, environment: Mapping[str, float]
) -> tuple[Array, Array]:
    """Return the twelve intrinsic quantities in the order of `intrinsic`, and d/dp (12, p)."""
    return _differentiate(_intrinsic_vector, model, parameters, environment)


def _propagate(
    function: Callable[[Array], Array],
    model: Model,
    parameters: Array,
    covariance: Array,
    environment: Mapping[str, float],
) -> tuple[Array, Array]:
    """Return a function of the linear part (batch, M, 4) and its standard uncertainties."""
    values, gradient = _differentiate(function, model, parameters, environment)
    variance = np.einsum("qp,pr,qr->q", gradient, covariance, gradient)
    return values, np.sqrt(np.maximum(variance, 0.0))


def _differentiate(
    function: Callable[[Array], Array],
    model: Model,
    parameters: Array,
    environment: Mapping[str, float],
) -> tuple[Array, Array]:
    """Return a function of the linear part (batch, M, 4) and its derivative (q, p)."""
    to_linear = model.linear_map(environment)
    linear = to_linear @ parameters
    step = _STEP * (np.abs(linear).max() or 1.0)  # 1: readings all zero
    nudges = step * np.eye(linear.size)
    flat, size = linear.ravel(), linear.size
    nudged = np.concatenate([flat[None], flat + nudges, flat - nudges])
    batch = function(nudged.reshape(-1, *linear.shape))
    gradient = ((batch[1 : size + 1] - batch[size + 1 :]) / (2.0 * step)).T
    return batch[0], gradient @ to_linear.reshape(size, -1)


def _intrinsic_vector(linear: Array) -> Array:
    matrix, bias = linear[:, :, 1:], linear[:, :, 0]
    sensitivity = np.linalg.norm(matrix, axis=2)
    axes = matrix / sensitivity[:, :, None]
    angles = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        cross = np.linalg.norm(np.cross(axes[:, i], axes[:, j]), axis=1)
        angles.append(np.arctan2(cross, np.einsum("bi,bi->b", axes[:, i], axes[:, j])))
    mounting = _mounting(axes)
    return np.column_stack(
        [sensitivity, bias / sensitivity, np.degrees(np.array(angles).T), np.degrees(mounting)]
    )


def _mounting(axes: Array) -> Array:
    """Return rho of eq. (3); NaN where the input axes form a left-handed set."""
    left, _, right = np.linalg.svd(axes)
    turned = (left @ right).transpose(0, 2, 1)  # Exp([rho]x)
    vectors = np.array([rotation_vector(each) for each in turned])
    return np.where((np.linalg.det(turned) > 0.0)[:, None], vectors, np.nan)

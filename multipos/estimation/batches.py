"""What is estimated of many units, and what is left of their readings after compensation.

`rms_of` is what is left after compensation and `compensated` the same by steps;
`join_estimates` puts estimates of some units after others.

Arrays have a leading axis of B units. What is left of the force, f − f_ref, follows from the
residuals r alone where the model is linear: A (f − f_ref) = r, A the sensitivities. Otherwise it is
found by steps of A⁻¹.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import COMPONENTS, Array, Places
from multipos.numerics.terms import Term
from multipos.sensor.model import Model

_STEPS = 30  # of the compensation: three gain what the model's curvature costs
_XTOL = 1e-15  # [g], where a step is only rounding
_SINGULAR = 1e-8  # determinant of A'A, its rows of length one, below which A is not inverted


class Solution(NamedTuple):
    """B units about their solutions, the angles of each position eliminated (`likelihood`)."""

    weights: Array  # W, (M, M, B, n)
    slopes: Array  # W A, (M, p, B, n)
    information: Array  # S, (B, p, p)
    push: Array  # Σ⁻¹r, (M, B, n)
    variance: Array  # Σ, (M, B, n)
    force: Array  # (3, B, n) [g]
    objective: Array  # F, (B,)
    normal: Array | None = None  # m, (M, B, n), where W is m m'
    rows: Array | None = None  # A'm, (B, p, n), there

    def of(self, units: Places) -> "Solution":
        """Return some of the units."""
        return Solution(
            self.weights[:, :, units],
            self.slopes[:, :, units],
            self.information[units],
            push=self.push[:, units],
            variance=self.variance[:, units],
            force=self.force[:, units],
            objective=self.objective[units],
            normal=None if self.normal is None else self.normal[:, units],
            rows=None if self.rows is None else self.rows[units],
        )


class Estimates(NamedTuple):
    """Estimates of B units; those that are not `sound` are left to the fit of one unit.

    Attributes
    ----------
    parameters, u : (B, p) arrays
    dof : (p,) or (B, p) array
    rms : (B,) array [g]
    residuals : (M, B, n) array, in reading units
        Of known orientations those of the plain fit, whatever the weights.
    sensitivity, inverse : (B, M, K), (B, K, M) arrays
        To the K components that the sensor has.
    sound : (B,) array of bool
    chi2 : (B,) array or None
        Of the residuals under the stated noise alone, where there is one.
    variance : (B, M) array or None
        Of a reading, stated and in excess, where it is equal in all readings of an output.
    variances, weighted : (M, B, n) arrays or None
        Of readings, where it is not, and residuals of the fit that is weighted by them.
    solutions : tuple of Solution
        Of the units, block by block, at uncertain and unknown orientations.
    """

    parameters: Array
    u: Array
    dof: Array
    rms: Array
    residuals: Array
    sensitivity: Array
    inverse: Array
    sound: NDArray[np.bool_]
    chi2: Array | None = None
    variance: Array | None = None
    variances: Array | None = None
    weighted: Array | None = None
    solutions: tuple[Solution, ...] = ()


def rms_of(
    model: Model,
    environment: Mapping[str, Array],
    reference: Array,
    parameters: Array,
    values: Array,
    residuals: Array,
) -> tuple[Array, "Inverted"]:
    """Return what is left after compensation (B,) [g], and the inverses.

    Parameters
    ----------
    model : Model
    environment : mapping of str to (n,) array
    reference : (n, 3) array [g]
    parameters : (B, p) array
    values, residuals : (M, B, n) arrays
    """
    theta = model.coefficients(parameters)
    if model.is_linear:
        inverted = _invert(model, environment, theta)
        return _rms(inverted.inverse, residuals), inverted
    left = compensated(model, environment, reference, theta, values, residuals)
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / len(reference))
    return rms, left.inverted


def join_estimates(parts: Sequence[Estimates]) -> Estimates:
    """Return estimates of some units after others."""
    if len(parts) == 1:
        return parts[0]

    def joined(name: str, axis: int = 0) -> Any:
        each = [getattr(part, name) for part in parts]
        return None if any(one is None for one in each) else np.concatenate(each, axis=axis)

    return Estimates(
        parameters=joined("parameters"),
        u=joined("u"),
        dof=np.concatenate([np.broadcast_to(part.dof, part.u.shape) for part in parts]),
        rms=joined("rms"),
        residuals=joined("residuals", 1),
        sensitivity=joined("sensitivity"),
        inverse=joined("inverse"),
        sound=joined("sound"),
        chi2=joined("chi2"),
        variance=joined("variance"),
        variances=joined("variances", 1),
        weighted=joined("weighted", 1),
        solutions=tuple(each for part in parts for each in part.solutions),
    )


class Inverted(NamedTuple):
    """Sensitivities (B, M, K) to the components that the sensor has, and their inverses (B, K, M).

    Where there is no inverse, or compensation by it came to no end, a unit is not `sound` (B,).
    """

    sensitivity: Array
    inverse: Array
    sound: NDArray[np.bool_]


def _invert(model: Model, environment: Mapping[str, Array], theta: Array) -> Inverted:
    sensed = list(model.sensed_axes)
    matrix = _linear_part(model, environment, theta)[:, :, sensed]
    inverted = _can_be_inverted(matrix)
    matrix[~inverted] = np.eye(*matrix.shape[1:])
    square = len(sensed) == matrix.shape[1]
    inverse = np.asarray(np.linalg.inv(matrix) if square else np.linalg.pinv(matrix))
    return Inverted(matrix, inverse, inverted)


def _rms(inverse: Array, residuals: Array) -> Array:
    """Return what is left after compensation (B,) [g], of a model that is linear."""
    total = np.zeros(len(inverse))
    for row in range(inverse.shape[1]):
        left = inverse[:, row, 0, None] * residuals[0]
        for i, residual in enumerate(residuals[1:], start=1):
            left += inverse[:, row, i, None] * residual
        total += np.einsum("bn,bn->b", left, left)
    return np.asarray(np.sqrt(total / residuals[0].shape[1]))


def _linear_part(model: Model, environment: Mapping[str, Array], theta: Array) -> Array:
    """Return the sensitivities (B, M, 3) to the components, in the mean environment."""
    matrix = np.zeros((*theta.shape[:2], 3))
    for column, term in enumerate(model.basis_terms):
        if term.along is None:
            continue
        beside = Term(tuple(f for f in term.factors if f.variable not in COMPONENTS))
        weight = np.mean(beside.evaluate(environment))
        matrix[:, :, COMPONENTS.index(term.along)] += weight * theta[:, :, column]
    return matrix


def _can_be_inverted(matrix: Array) -> NDArray[np.bool_]:
    """Tell which matrices (B, M, K) are far from singular."""
    size = np.linalg.norm(matrix, axis=2, keepdims=True)
    scaled = matrix / np.where(size > 0.0, size, 1.0)
    information = scaled.transpose(0, 2, 1) @ scaled
    return np.asarray(np.linalg.det(information) > _SINGULAR)


class Compensated(NamedTuple):
    """What is left of readings after compensation (B, n, K) [g], and the inverses used."""

    force: Array
    inverted: Inverted


def compensated(
    model: Model,
    environment: Mapping[str, Array],
    reference: Array,
    theta: Array,
    values: Array,
    residuals: Array,
) -> Compensated:
    """Return what is left after compensation by steps of the inverse sensitivities.

    Parameters
    ----------
    model : Model
    environment : mapping of str to (n,) array
    reference : (n, 3) or (B, n, 3) array [g]
    theta : (B, M, T) array
        Coefficients.
    values, residuals : (M, B, n) arrays
    """
    count, n = values.shape[1:]
    inverted = _invert(model, environment, theta)
    inverse = inverted.inverse.transpose(0, 2, 1)
    sensed = list(model.sensed_axes)
    misfit = np.moveaxis(residuals, 0, 2)
    if model.is_linear:
        return Compensated(misfit @ inverse, inverted)
    left = np.zeros((count, n, len(sensed)))
    if len(sensed) != len(values):  # then the steps below would end at another force
        return Compensated(left * np.nan, inverted._replace(sound=np.zeros(count, dtype=np.bool_)))
    raw = np.moveaxis(values, 0, 2)
    force = np.array(np.broadcast_to(reference, (count, n, 3)))
    start = force[:, :, sensed]
    size = np.full(count, np.inf)
    columns = {name: np.tile(column, count) for name, column in environment.items()}
    with np.errstate(over="ignore", invalid="ignore"):  # a unit may run away, and is not sound
        for _ in range(_STEPS):
            step = misfit @ inverse
            left += step
            size = np.abs(step).max(axis=(1, 2))
            if not (size > _XTOL).any():
                break
            force[:, :, sensed] = start + left
            basis = model.basis(force.reshape(-1, 3), columns).reshape(count, n, -1)
            misfit = raw - basis @ theta.transpose(0, 2, 1)
    sound = inverted.sound & (size <= 10.0 * _XTOL)
    return Compensated(left, inverted._replace(sound=sound))

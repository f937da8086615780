"""Many units on the same positions: known linear least squares in a few matrix products.

B units that were read at the same positions share the design X (n, p) of an output, and with it
everything that costs time: the factorisation X = Q R, the inverse X⁺ = R⁻¹ Q' and the cofactor
C = R⁻¹ R⁻ᵀ. With the readings of one output as rows, Y (B, n),

    b₀ = Y X⁺',    r = Y − b₀ X',    b = b₀ + r X⁺',    u² = s² diag C,   s² = r r'/(n − p),    (1)

which is `multipos.estimation.known` unit by unit. That one refines its answer until it is exact
for the numbers given; so does this: b is the exact answer but for a relative κε of the *residuals*,
where r is formed without rounding of the size of the readings. For that b₀ is rounded to a grid of
20 bits and X split at 26, X = X₁ + X₂, so that no sum of products b₀ X₁' rounds:

    r = ((Y − b₀ X₁') − b₀ X₂') − (b − b₀) X',   error below 2⁻⁷⁰ |Y|.                        (2)

What is left after compensation, f − f_ref, follows from the residuals alone where the model is
linear: A (f − f_ref) = r, A the sensitivities. Otherwise it is found by steps of that matrix.

A unit for which this cannot be as good as the fit by itself (no degree of freedom, residuals that
are only rounding, sensitivities that cannot be inverted) is left to that one.

Sources: Å. Björck, *Numerical Methods for Least Squares Problems*, SIAM 1996, section 2.9 (fixed
design, iterative refinement). K. Ozaki, T. Ogita, S. Oishi, S. M. Rump, Numer. Algorithms 59, 2012
(products of split matrices without rounding).

Many units whose readings state their noise, on positions that they share.

Units share the design X = Q R of an output, and not the stated uncertainties u (B, n), so that
every unit has weights of its own. From the plain fit b₀ with exact residuals r
(`multipos.estimation.batches`), the weighted one is

    b = b₀ + R⁻¹ d,    (Q'WQ) d = Q'W r,    W = diag 1/(u² + τ²),                           (3)

whose rounding is relative to the residuals. It is worked out with τ = 0; what units scatter beside
their claims, τ², is integrated over by `multipos.estimation.excess_variance`, of all units at
once; and (1) again with the τ² that was found. Uncertainties with degrees of freedom d go through
`multipos.estimation.stated_uncertainty` on their way in and out.

A unit is left to `fit` where its weights differ by more than double precision takes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.excess_variance import find_scatter
from multipos.estimation.known import FLOOR, per_parameter
from multipos.estimation.stated_uncertainty import carried_dof, take_claims
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import solve
from multipos.numerics.terms import COMPONENTS, Term
from multipos.sensor.inverse import sensed_axes
from multipos.sensor.model import Model

_COARSE = 20  # bits of the coefficients that multiply without rounding
_SPLIT = 26  # bits of the design that they multiply
_WORST = 1e6  # condition beyond which the cofactor needs more than double precision
ROUNDING = 1e-9  # residuals below this part of the readings are left to the fit of one unit
_STEPS = 30  # of the compensation: three gain what the model's curvature costs
_XTOL = 1e-15  # [g], where a step is only rounding
_SINGULAR = 1e-8  # determinant of A'A, its rows of length one, below which A is not inverted


@dataclass(frozen=True, eq=False)
class SharedDesign:
    """What units on the same positions share, output by output.

    Attributes
    ----------
    model : Model
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
        Other columns of the model.
    designs, inverses : tuples of M (n, p_i) and (p_i, n) arrays
    cofactors : tuple of M (p_i,) arrays
        The diagonal of C.
    """

    model: Model
    reference: Array
    environment: Mapping[str, Array]
    designs: tuple[Array, ...]
    inverses: tuple[Array, ...]
    cofactors: tuple[Array, ...]


class Estimates(NamedTuple):
    """What a batch found of B units; rows that are not `sound` are for the fit of one unit.

    Attributes
    ----------
    parameters, u : (B, p) arrays
    dof : (p,) or (B, p) array
    rms : (B,) array [g]
    residuals : M arrays (B, n), in reading units
        Of known orientations those of the plain fit, whatever the weights.
    inverse : (B, K, M) array
        Of the sensitivities to the K components that the sensor has.
    sound : (B,) array of bool
    chi2 : (B,) array or None
        Of the residuals under the stated noise alone, where there is one.
    """

    parameters: Array
    u: Array
    dof: Array
    rms: Array
    residuals: tuple[Array, ...]
    inverse: Array
    sound: NDArray[np.bool_]
    chi2: Array | None = None


def share_design(
    model: Model, reference: Array, environment: Mapping[str, Array]
) -> SharedDesign | None:
    """Return what units share, or None where a batch would not be as good as one fit.

    Parameters
    ----------
    model : Model
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
        Other columns that the model uses.

    Raises
    ------
    RankError
        The positions cannot separate the parameters; the fit of one unit says it better.
    """
    n = len(reference)
    basis = model.basis(reference, environment)
    designs: list[Array] = []
    inverses: list[Array] = []
    cofactors: list[Array] = []
    known: dict[tuple[int, ...], int] = {}
    for output, columns in enumerate(model.columns):
        same = known.setdefault(tuple(columns.tolist()), output)
        if same < output:
            designs.append(designs[same])
            inverses.append(inverses[same])
            cofactors.append(cofactors[same])
            continue
        design = np.ascontiguousarray(basis[:, columns])
        found = solve(design, np.zeros(n), floor=FLOOR, names=model.names[model.slices[output]])
        if found.dof == 0 or found.condition > _WORST:
            return None
        Q, R = np.linalg.qr(design)
        designs.append(design)
        inverses.append(np.linalg.inv(R) @ Q.T)
        cofactors.append(np.diag(found.cofactor))
    used = {name: environment[name] for name in model.environment}
    return SharedDesign(model, reference, used, tuple(designs), tuple(inverses), tuple(cofactors))


def estimate_batch(
    shared: SharedDesign, values: Sequence[Array], *, pool: bool = False
) -> Estimates:
    """Fit B units by least squares, eqs. (1) and (2).

    Parameters
    ----------
    shared : SharedDesign
    values : sequence of M (B, n) arrays
        Readings of each output.
    pool : bool
        One residual variance for all outputs of a unit.
    """
    model = shared.model
    count, n = values[0].shape
    parameters = np.empty((count, len(model.keys)))
    squares = np.empty((len(values), count))
    residuals = []
    sound = np.ones(count, dtype=np.bool_)
    for i, y in enumerate(values):
        b, r = fit_output(shared.designs[i], shared.inverses[i], y)
        parameters[:, model.slices[i]] = b
        residuals.append(r)
        squares[i] = np.einsum("bn,bn->b", r, r)
        sound &= squares[i] > ROUNDING**2 * np.einsum("bn,bn->b", y, y)
    dof = np.array([n - design.shape[1] for design in shared.designs], dtype=np.float64)
    variance = squares / dof[:, None]
    if pool:
        variance[:] = squares.sum(axis=0) / dof.sum()
        dof[:] = dof.sum()
    u = np.empty_like(parameters)
    for i, cofactor in enumerate(shared.cofactors):
        u[:, model.slices[i]] = np.sqrt(variance[i][:, None] * cofactor)
    rms, inverse, inverted = rms_of(shared, parameters, values, residuals)
    sound &= inverted & (np.abs(parameters).max(axis=1) <= LARGEST)
    return Estimates(
        parameters, u, per_parameter(model, dof), rms, tuple(residuals), inverse, sound
    )


def fit_output(design: Array, inverse: Array, y: Array) -> tuple[Array, Array]:
    """Return coefficients (B, p) and exact residuals (B, n) of one output, eq. (2).

    Parameters
    ----------
    design, inverse : (n, p), (p, n) arrays
    y : (B, n) array
    """
    shift = np.frexp(np.abs(design).max(axis=0))[1]  # columns below 1 by powers of two: exact
    scaled = np.ldexp(design, -shift)
    high = np.ldexp(np.rint(np.ldexp(scaled, _SPLIT)), -_SPLIT)
    b = np.ldexp(y @ inverse.T, shift)
    grid = np.frexp(np.abs(b).max(axis=1, keepdims=True))[1] - _COARSE
    coarse = np.ldexp(np.rint(np.ldexp(b, -grid)), grid)
    r = y - coarse @ high.T
    r -= np.hstack((coarse, b - coarse)) @ np.hstack((scaled - high, scaled)).T
    step = r @ inverse.T
    r -= step @ design.T
    return np.ldexp(b, -shift) + step, r


def rms_of(
    shared: SharedDesign, parameters: Array, values: Sequence[Array], residuals: Sequence[Array]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return what is left after compensation (B,) [g], inverses (B, K, M), and where they are."""
    model = shared.model
    theta = model_coefficients(model, parameters)
    if model.is_linear:
        inverse, inverted = _invert(model, shared.environment, theta)
        return _rms(inverse, residuals), inverse, inverted
    left = compensated(model, shared.environment, shared.reference, theta, values, residuals)
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / len(shared.reference))
    return rms, left.inverse, left.sound


def join_estimates(parts: Sequence[Estimates]) -> Estimates:
    """Return estimates of some units after others."""
    if len(parts) == 1:
        return parts[0]

    def joined(name: str) -> Any:
        return np.concatenate([getattr(part, name) for part in parts])

    residuals = zip(*(part.residuals for part in parts), strict=True)
    return Estimates(
        joined("parameters"),
        joined("u"),
        np.concatenate([np.broadcast_to(part.dof, part.u.shape) for part in parts]),
        joined("rms"),
        tuple(np.concatenate(each) for each in residuals),
        joined("inverse"),
        joined("sound"),
        None if parts[0].chi2 is None else joined("chi2"),
    )


def model_coefficients(model: Model, parameters: Array) -> Array:
    """Return the coefficients (B, M, T) of parameters (B, p), as `Model.coefficients` of one."""
    outputs, columns, copies = model.rows
    theta = np.zeros((len(parameters), len(model.outputs), len(model.basis_terms)))
    theta[:, outputs, columns] = parameters
    for parameter, output, column in copies:
        theta[:, output, column] = parameters[:, parameter]
    return theta


def force_slopes(
    model: Model, environment: Mapping[str, Array], theta: Array, force: Array
) -> Array:
    """Return dh/df (M, 3, B, n) of parameters (B, p) at forces (3, B, n) [g]."""
    _, count, n = force.shape
    coefficients = model_coefficients(model, theta)
    columns = {name: np.tile(column, count) for name, column in environment.items()}
    variables = model.variables(force.reshape(3, -1).T, columns)
    result = np.zeros((len(model.outputs), 3, count, n))
    for column, axis, factor, lower in model.slopes:
        if lower is None:
            slope = model.basis_terms[column].derivative(variables, COMPONENTS[axis])
        else:
            slope = factor * np.asarray(lower.evaluate(variables), dtype=np.float64)
        slope = np.broadcast_to(slope, (count * n,)).reshape(count, n) if np.ndim(slope) else slope
        for output in range(len(result)):
            mine = coefficients[:, output, column]
            if mine.any():
                result[output, axis] += mine[:, None] * slope
    return result


def _invert(
    model: Model, environment: Mapping[str, Array], theta: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverse (B, K, M) of the sensitivities, and of which units there is one."""
    sensed = list(sensed_axes(model))
    matrix = _linear_part(model, environment, theta)[:, :, sensed]
    inverted = _can_be_inverted(matrix)
    matrix[~inverted] = np.eye(*matrix.shape[1:])
    square = len(sensed) == matrix.shape[1]
    return np.asarray(np.linalg.inv(matrix) if square else np.linalg.pinv(matrix)), inverted


def _rms(inverse: Array, residuals: Sequence[Array]) -> Array:
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
    """What is left of readings after compensation.

    Attributes
    ----------
    force : (B, n, K) array [g]
        Compensated less reference, of the K components that the sensor has.
    inverse : (B, K, M) array
        Of the sensitivities.
    sound : (B,) array of bool
        Where there is an inverse, and the compensation came to its end.
    """

    force: Array
    inverse: Array
    sound: NDArray[np.bool_]


def compensated(
    model: Model,
    environment: Mapping[str, Array],
    reference: Array,
    theta: Array,
    values: Sequence[Array],
    residuals: Sequence[Array],
) -> Compensated:
    """Return what is left after compensation by steps of the inverse sensitivities.

    Parameters
    ----------
    model : Model
    environment : mapping of str to (n,) array
    reference : (n, 3) or (B, n, 3) array [g]
    theta : (B, M, T) array
        Coefficients.
    values, residuals : M arrays (B, n)
    """
    count, n = values[0].shape
    inverse, sound = _invert(model, environment, theta)
    sensed = list(sensed_axes(model))
    misfit = np.stack(list(residuals), axis=2)
    if model.is_linear:
        return Compensated(misfit @ inverse.transpose(0, 2, 1), inverse, sound)
    left = np.zeros((count, n, len(sensed)))
    if len(sensed) != len(values):  # then the steps below would end at another force
        return Compensated(left * np.nan, inverse, np.zeros(count, dtype=np.bool_))
    raw = np.stack(list(values), axis=2)
    force = np.array(np.broadcast_to(reference, (count, n, 3)))
    start = force[:, :, sensed]
    size = np.full(count, np.inf)
    columns = {name: np.tile(column, count) for name, column in environment.items()}
    for _ in range(_STEPS):
        step = misfit @ inverse.transpose(0, 2, 1)
        left += step
        size = np.abs(step).max(axis=(1, 2))
        if not (size > _XTOL).any():
            break
        force[:, :, sensed] = start + left
        basis = model.basis(force.reshape(-1, 3), columns).reshape(count, n, -1)
        misfit = raw - basis @ theta.transpose(0, 2, 1)
    return Compensated(left, inverse, sound & (size <= 10.0 * _XTOL))


_AT_ONCE = 12_000  # readings of an output, so that what they need stays small
_TURNS = 2  # of eq. (3), the second for what the first one rounded


def estimate_stated(
    shared: SharedDesign,
    values: Sequence[Array],
    stated: Sequence[Array],
    claimed: Sequence[Array],
    *,
    pool: bool = False,
) -> Estimates:
    """Fit B units by weighted least squares, eq. (3), with the scatter beside what they state.

    Parameters
    ----------
    shared : SharedDesign
    values, stated : sequences of M arrays (B, n)
        Readings of each output, and their standard uncertainties u.
    claimed : sequence of M arrays (B, n), or of none
        Degrees of freedom of u.
    pool : bool
        One scatter for all outputs of a unit.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    factors = [_factor(design) for design in shared.designs]
    parts = []
    for first in range(0, count, step):
        rows = slice(first, first + step)
        mine = [tuple(each[rows] for each in arrays) for arrays in (values, stated, claimed)]
        parts.append(_estimate(shared, factors, *mine, pool=pool))
    return join_estimates(parts)


class _Factors(NamedTuple):
    """A design as Q (n, p) R (p, p), and the products of the columns of Q (n, p²)."""

    Q: Array
    R: Array
    squares: Array


def _factor(design: Array) -> _Factors:
    Q, R = np.linalg.qr(design)
    return _Factors(Q, R, (Q[:, :, None] * Q[:, None, :]).reshape(len(Q), -1))


def _estimate(
    shared: SharedDesign,
    factors: Sequence[_Factors],
    values: Sequence[Array],
    stated: Sequence[Array],
    claimed: Sequence[Array],
    *,
    pool: bool,
) -> Estimates:
    model = shared.model
    u, dof, sound = take_claims(stated, claimed)
    floor = u**2
    designs = zip(shared.designs, shared.inverses, values, strict=True)
    plain = [fit_output(design, inverse, y) for design, inverse, y in designs]
    for (_, r), y in zip(plain, values, strict=True):
        sound &= np.einsum("bn,bn->b", r, r) > ROUNDING**2 * np.einsum("bn,bn->b", y, y)
    first = _weigh(factors, plain, floor)
    residuals = np.stack([r for _, r in first], axis=2)
    found = find_scatter(shared.designs, residuals, floor, pool=pool)
    second = _weigh(factors, plain, floor + found.variance[:, None])
    parameters = np.concatenate([b for b, _ in second], axis=1)
    moves = parameters - np.concatenate([b for b, _ in first], axis=1)
    known = per_parameter(model, found.dof)
    own = found.standard_uncertainty(moves, known)
    if dof is not None:
        known = per_parameter(model, carried_dof(found.dof, floor, dof, found.variance))
    rms, inverse, inverted = rms_of(shared, parameters, values, [r for _, r in second])
    sound &= inverted & (np.abs(parameters).max(axis=1) <= LARGEST)
    left = tuple(r for _, r in plain)
    chi2 = np.sum(residuals**2 / floor, axis=(1, 2))
    return Estimates(parameters, own, known, rms, left, inverse, sound, chi2)


def _weigh(
    factors: Sequence[_Factors], plain: Sequence[tuple[Array, Array]], variances: Array
) -> list[tuple[Array, Array]]:
    """Return coefficients (B, p) and residuals (B, n) of every output, eq. (3)."""
    weighed = []
    for i, ((Q, R, squares), (b, r)) in enumerate(zip(factors, plain, strict=True)):
        weight = 1.0 / variances[:, :, i]
        if not np.ptp(weight, axis=1).any():  # alike: as the plain fit
            weighed.append((b, r))
            continue
        p = len(R)
        information = (weight @ squares).reshape(-1, p, p)
        d = np.zeros((len(b), p))
        left = r
        for _ in range(_TURNS):
            d += np.linalg.solve(information, ((weight * left) @ Q)[:, :, None])[:, :, 0]
            left = r - d @ Q.T
        weighed.append((b + np.linalg.solve(R, d.T).T, left))
    return weighed

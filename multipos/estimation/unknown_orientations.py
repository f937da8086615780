"""Unknown orientations of triads: where searches start, and B units at once.

`estimate_unknown` fits B units of which `share_sphere` is what they share, by the search of
`multipos.estimation.descent`. `fit_ellipsoids` are where searches start, as `linear_parameters`,
and `symmetric_root` is a square root of M M'.

Units share the form of the equations and nothing else. Each starts on the ellipsoid on which its
readings lie: with y = b + M d and |d| = g,

    (y − b)' (M M')⁻¹ (y − b) = g²,                                                         (1)

a quadric. With S₀ a symmetric matrix of trace zero, it is one that is linear in its unknowns,

    |y|² = y'S₀y + 2 v'y + w,      B = I − S₀,    b = B⁻¹v,    ρ² = w + v'B⁻¹v,             (2)

and (y − b)'B(y − b) = ρ². It is fitted to centred, scaled readings by least squares, so that
neither a unit nor a guess is needed. M M' = (ρ²/g²) B⁻¹ then, and M is its lower triangular
(Cholesky) or symmetric square root: any other differs by a rotation, which no reading at rest can
show. What the positions do not determine stays zero in S₀, as on a sphere. Noise can make the
quadric something else than an ellipsoid; then cross terms are left out of S₀, and last all of it.

Stated noise is a lower bound: its excess is integrated over. Where nothing is stated, u allows for
axes of unequal noise (both in `multipos.estimation.variances`).

`estimate_unknown` leaves a unit to the fit of one where the ellipsoid needs more care than least
squares, where a search has not ended, where S is badly conditioned, where noise might hide a
parameter, or where stated uncertainties cannot be weights.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from multipos.estimation.batches import Estimates, compensated, join_estimates
from multipos.estimation.descent import maximise
from multipos.estimation.identifiability import plausible_range
from multipos.estimation.known import ROUNDING
from multipos.estimation.likelihood import linearise
from multipos.estimation.problem import State
from multipos.estimation.stated_uncertainty import StatedNoise, combined_jointly, taken_by_blocks
from multipos.estimation.units import Units, by_unit, pose_units, solution_of, state_of
from multipos.estimation.variances import StatedComponents, estimate, with_unequal_outputs
from multipos.files.records import LARGEST
from multipos.numerics.arrays import COMPONENTS, Array, Mask, median
from multipos.numerics.quantiles import coverage_factors
from multipos.numerics.rotations import directions
from multipos.results import frozen
from multipos.sensor.model import Model


@frozen
class SharedSphere:
    """What units of unknown orientation share.

    Attributes
    ----------
    model : Model
        With its gauge.
    size : float [g]
        Of the reference.
    environment : mapping of str to (n,) array
        Other columns of the model.
    """

    model: Model
    size: float
    environment: Mapping[str, Array]


_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_STILL = 1e-6  # relative change of an output below which it may be none
_SPREAD = 1e-3  # ratio of squared extents of the readings, below which they may be flat
_SEEN = 1e-6  # relative eigenvalue below which a coefficient is not seen in the positions
_SHOWN = 1e-5  # the same, below which it may not be
_FLATTEST = 4e-4  # squared ratio of semi-axes below which a quadric is no ellipsoid
_ROUND = 0.01  # the same, below which it may not be one
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_CLEAR = 200.0  # of the readings: information beyond which no noise hides a parameter


def share_sphere(
    model: Model, size: float, environment: Mapping[str, Array]
) -> SharedSphere | None:
    """Return what units share, or None where a batch does not do the fit of one does."""
    own = model.axes == model.inputs == COMPONENTS and len(model.own_scales) == len(COMPONENTS)
    if not own or not model.has_all_linear:
        return None
    return SharedSphere(model, size, {name: environment[name] for name in model.environment})


def estimate_unknown(
    shared: SharedSphere,
    values: Sequence[Array],
    stated: Sequence[Array] = (),
    stated_dof: Sequence[Array] = (),
) -> Estimates:
    """Fit B units of unknown orientation.

    Parameters
    ----------
    shared : SharedSphere
    values : 3 arrays (B, n)
        Readings of each output.
    stated, stated_dof : 3 arrays (B, n), or none
        Their standard uncertainties, and the degrees of freedom of those.
    """
    parts = []
    for y, noise in taken_by_blocks(values, stated, stated_dof, _AT_ONCE):
        with np.errstate(all="ignore"):  # a trial may run away, and is then left out
            parts.append(_estimate(shared, y, noise))
    return join_estimates(parts)


def _estimate(shared: SharedSphere, values: Array, noise: StatedNoise | None) -> Estimates:
    model, (_, count, n) = shared.model, values.shape
    variance = np.ones_like(values) if noise is None else np.moveaxis(noise.u**2, 2, 0).copy()
    clear, theta, centre = _start(shared, values)
    where = np.tile([shared.size, 0.0, 0.0], (n, 1)), np.full(n, np.inf)
    problem = pose_units(model, *where, shared.environment, values, variance)
    found = maximise(problem, state_of(problem, theta, centre))
    information = linearise(problem, found.state, found.point).information
    factor = np.asarray(found.point.objective) / float(n - len(model.keys))
    valid = clear & found.converged & _is_identifiable(shared, found.state, information, factor)
    units, chi2 = Units(problem, problem, found, stated=noise is not None), None
    u, dof = np.full((2, *theta.shape), np.nan)
    if noise is None:
        valid &= _inverse(information).valid
        some = np.flatnonzero(valid)
        if len(some):
            u[some], dof[some] = with_unequal_outputs(units.linear().of(some))
    else:
        chi2 = np.array(found.point.objective)
        u, dof, valid = _with_excess(units, noise, valid, u)
    theta, point = units.optimum.state.theta, units.optimum.point
    residuals, force = by_unit(point.residuals, count), by_unit(point.force, count)
    valid &= (np.abs(theta) <= LARGEST).all(axis=1)
    valid &= (theta[:, list(model.own_scales)] > 0.0).all(axis=1)
    squares = np.einsum("mbn,mbn->b", residuals, residuals)
    valid &= squares > ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    there, coefficients = force.transpose(1, 2, 0), model.coefficients(theta)
    left = compensated(model, shared.environment, there, coefficients, values, residuals)
    length = np.linalg.norm(there + left.force, axis=2)
    rms = np.sqrt(np.mean((length - shared.size) ** 2, axis=1))
    valid &= left.inverted.sound
    estimates = Estimates(theta, u, dof, rms, residuals, *left.inverted[:2], valid, chi2)
    return estimates._replace(solutions=(solution_of(units.problem, units.optimum),))


def _with_excess(
    units: Units, noise: StatedNoise, valid: Mask, nothing: Array
) -> tuple[Array, Array, Mask]:
    """Return u and degrees of freedom (B, p) with the excess variance of stated noise."""
    try:
        found = estimate(units, valid & noise.sound, StatedComponents(True, "exact"))
    except np.linalg.LinAlgError:  # some unit is as good as singular
        return nothing, nothing, np.zeros_like(valid)
    u = found.U / coverage_factors(0.95, found.dof)
    return u, combined_jointly(found.dof, noise, found.noise), found.valid


def _start(shared: SharedSphere, values: Array) -> tuple[Mask, Array, Array]:
    """Return which units have an ellipsoid, parameters (B, p) and directions (B n, 3) there."""
    model = shared.model
    crossed = any("cross_" in name for name in model.names)
    found = fit_ellipsoids(values.transpose(1, 0, 2), crossed=crossed)
    matrix = found.lower / shared.size
    if model.gauge == "symmetric":
        matrix = symmetric_root(matrix)
    linear = np.concatenate([found.bias[:, :, None], matrix], axis=2)
    centred = values.transpose(1, 0, 2) - found.bias[:, :, None]
    force = np.linalg.solve(matrix, centred).transpose(1, 0, 2).reshape(3, -1)
    centre = directions(np.asarray(force.T, dtype=np.float64))
    return found.clear, linear_parameters(model, linear), centre


def linear_parameters(model: Model, linear: Array) -> Array:
    """Return parameters (B, p) with constants and slopes (B, M, 4) of each output, others 0."""
    theta = np.zeros((len(linear), len(model.keys)))
    for i, (output, term) in enumerate(model.keys):
        column = {"1": 0, "x": 1, "y": 2, "z": 3}.get(str(term))
        if column is not None:
            theta[:, i] = linear[:, model.outputs.index(output), column]
    return theta


def symmetric_root(lower: Array) -> Array:
    """Return the symmetric square roots of L L' (…, 3, 3)."""
    left, singular, _ = np.linalg.svd(lower)
    return np.asarray((left * singular[..., None, :]) @ np.swapaxes(left, -1, -2))


class Ellipsoids(NamedTuple):
    """Ellipsoids of the readings of B units.

    Attributes
    ----------
    bias : (B, 3) array
    lower : (B, 3, 3) array
        Lower triangular M times g.
    change, thickness : (B,) arrays
        The least root mean square of an output about its mean, relative to the largest reading,
        and the ratio of the squared extents of the cloud of readings.
    clear : (B,) array of bool
        Which least squares give well, of readings that spread.
    """

    bias: Array
    lower: Array
    change: Array
    thickness: Array
    clear: Mask


def fit_ellipsoids(values: Array, *, crossed: bool) -> Ellipsoids:
    """Return the ellipsoids on which readings (B, 3, n) lie, eqs. (1), (2).

    Without cross terms in M, six coefficients are fitted instead of nine.
    """
    n = values.shape[2]
    centre = values.sum(axis=2) / n
    y = values - centre[:, :, None]
    square = y @ y.transpose(0, 2, 1)
    size = np.sqrt(np.einsum("bii->bi", square) / n)
    largest = np.abs(values).max(axis=(1, 2))
    change = size.min(axis=1) / np.where(largest > 0.0, largest, 1.0)
    size = np.where(size > 0.0, size, 1.0)
    extent = np.linalg.eigvalsh(square)
    thickness = extent[:, 0] / np.where(extent[:, -1] > 0.0, extent[:, -1], 1.0)
    points = y / size[:, :, None]
    found = _quadrics(points, crossed=crossed)
    clear = found.clear & (change > _STILL) & (thickness > _SPREAD)
    bias, square, good = found.bias, found.square, found.good
    for quadrics in (_quadrics, _spheres):
        bad = np.flatnonzero(~good)
        if not len(bad):
            break
        simpler = quadrics(points[bad], crossed=False)
        bias[bad], square[bad], good[bad] = simpler.bias, simpler.square, simpler.good
    lower = size[:, :, None] * np.linalg.cholesky(square)
    return Ellipsoids(centre + size * bias, lower, change, thickness, clear)


class _Quadrics(NamedTuple):
    bias: Array  # b, (B, 3)
    square: Array  # ρ² B⁻¹, (B, 3, 3)
    good: Mask  # that are ellipsoids
    clear: Mask  # far from anything else


def _quadrics(points: Array, *, crossed: bool) -> _Quadrics:
    """Return the quadrics of eq. (2) of points (B, 3, n)."""
    x, y, z = np.moveaxis(points, 1, 0)
    columns = [x * x - z * z, y * y - z * z, 2 * x, 2 * y, 2 * z, np.ones_like(x)]
    if crossed:
        columns += [2 * x * y, 2 * x * z, 2 * y * z]
    c, weakest = _least_squares(columns, points)
    form = np.zeros((len(points), 3, 3))
    form[:, 0, 0], form[:, 1, 1], form[:, 2, 2] = 1.0 - c[0], 1.0 - c[1], 1.0 + c[0] + c[1]
    if crossed:
        for place, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), start=6):
            form[:, i, j] = form[:, j, i] = -c[place]
    axes = np.linalg.eigvalsh(form)
    good = axes[:, 0] > _FLATTEST * axes[:, -1]
    form[~good] = np.eye(3)
    inverse = np.asarray(np.linalg.inv(form), dtype=np.float64)
    bias = np.einsum("bij,jb->bi", inverse, c[2:5])
    radius = c[5] + np.einsum("jb,bj->b", c[2:5], bias)
    good &= radius > 0.0
    square = inverse * np.where(good, radius, 1.0)[:, None, None]
    clear = good & (weakest > _SHOWN) & (axes[:, 0] > _ROUND * axes[:, -1])
    return _Quadrics(bias, square, good, clear)


def _spheres(points: Array, *, crossed: bool) -> _Quadrics:
    """Return the same of spheres, which are ellipsoids always."""
    x, y, z = np.moveaxis(points, 1, 0)
    c, _ = _least_squares([2 * x, 2 * y, 2 * z, np.ones_like(x)], points)
    radius = np.maximum(c[3] + np.sum(c[:3] ** 2, axis=0), 1.0)
    good = np.ones(len(points), dtype=np.bool_)
    square = np.asarray(radius[:, None, None] * np.eye(3), dtype=np.float64)
    return _Quadrics(c[:3].T, square, good, good)


def _least_squares(columns: list[Array], points: Array) -> tuple[Array, Array]:
    """Return the coefficients (c, B) of |y|², zero where the positions do not determine them.

    With them the least eigenvalue (B,) of their information, relative to the largest.
    """
    design = np.stack(columns, axis=1)
    square = np.einsum("bin,bin->bn", points, points)
    values, vectors = np.linalg.eigh(design @ design.transpose(0, 2, 1))
    kept = values > _SEEN * values[:, -1:]
    turned = np.einsum("bcq,bc->bq", vectors, (design @ square[:, :, None])[:, :, 0])
    turned *= kept / np.where(kept, values, 1.0)
    return np.einsum("bcq,bq->cb", vectors, turned), values[:, 0] / values[:, -1]


class _Inverse(NamedTuple):
    """Inverses of matrices (B, p, p), and which of these are well conditioned."""

    matrix: Array
    valid: Mask


def _inverse(information: Array) -> _Inverse:
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    valid = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~valid] = np.eye(scaled.shape[1])
    sizes = np.linalg.eigvalsh(scaled)
    valid &= sizes[:, 0] > _WORST * sizes[:, -1]
    scaled[~valid] = np.eye(scaled.shape[1])
    return _Inverse(np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :]), valid)


def _is_identifiable(shared: SharedSphere, state: State, information: Array, factor: Array) -> Mask:
    """Return which units determine every parameter far beyond what noise alone could explain."""
    model = shared.model
    typical = median(state.theta, axis=0)
    limit = plausible_range(model, typical, shared.size)
    if limit is None:
        return np.zeros(len(factor), dtype=np.bool_)
    relative = information * np.outer(limit, limit) / factor[:, None, None]
    valid = np.isfinite(relative).all(axis=(1, 2))
    relative[~valid] = 0.0
    n = len(state.centre) // len(state.theta)
    return np.asarray(valid & (np.linalg.eigvalsh(relative)[:, 0] > _CLEAR * n))

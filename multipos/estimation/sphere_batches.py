"""Many units of unknown orientation: the search of `multipos.estimation.sphere`, all at once.

Every unit has a problem of its own, with its own directions, so that nothing but the form of the
equations is shared. With the residuals r = y − h(f), G = dh/df and the normal m of the surface
that the readings of all directions form,

    m = n/|n|,    n = det(G) G⁻ᵀ f,    a = A'm,    S = Σ a a',    S d = Σ a m'r,             (1)
    df = G⁻¹ (x − m m'x),    x = r − A d,    f'df = 0,                                      (2)

which is `multipos.estimation.sphere` for readings that are equally noisy. A unit starts on the
ellipsoid of its readings (`multipos.estimation.ellipsoid`), takes damped steps until the next one
would take less than 10⁻¹⁶ off F = Σ r'r, and is then left out of what follows. At the end

    cov = S⁻¹ F/ν,    ν = n − p.                                                            (3)

A unit is left to `fit` where the ellipsoid needs more care than least squares, where a search has
not ended, where S is badly conditioned, or where noise might hide a parameter.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import (
    Estimates,
    compensated,
    force_slopes,
    join_estimates,
    model_coefficients,
)
from multipos.estimation.identifiability import plausible_range
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.model import Model

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]  # the other two axes, in cyclic order
_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_ITERATIONS = 60
_DAMPING = 1e-4
_DECREMENT = 1e-16  # of F, by the next step
_LAST_STEPS = 2  # whatever F says, whose last digits are the rounding of the readings
_FLAT = 1e-15  # of F, below which a step is lost in the rounding of F
_XTOL = 1e-13  # relative step that is only rounding
_STUCK = 1e12  # damping beyond which nothing moves
_SPREAD = 1e-3  # ratio of squared extents of the readings, below which they may be flat
_SHOWN = 1e-5  # eigenvalue of the scaled quadric's information below which it may not be shown
_ROUND = 0.01  # squared ratio of semi-axes below which the ellipsoid may not be one
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_TOLD = 200.0  # of the readings: information beyond which no noise hides a parameter
_ROUNDING = 1e-9  # residuals below this part of the readings are left to the fit of one unit


@dataclass(frozen=True, eq=False)
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


def share_sphere(
    model: Model, size: float, environment: Mapping[str, Array]
) -> SharedSphere | None:
    """Return what units share, or None where a batch does not do what `fit` does."""
    own = model.axes == model.inputs == COMPONENTS and len(model.own_scales) == len(COMPONENTS)
    if not own or not model.has_all_linear:
        return None
    return SharedSphere(model, size, {name: environment[name] for name in model.environment})


def estimate_spheres(shared: SharedSphere, values: tuple[Array, ...]) -> Estimates:
    """Fit B units of unknown orientation, eqs. (1)–(3).

    Parameters
    ----------
    shared : SharedSphere
    values : 3 arrays (B, n)
        Readings of each output.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    with np.errstate(all="ignore"):  # a trial may run away, and is then left out
        parts = [
            _estimate(shared, np.stack([y[first : first + step] for y in values]))
            for first in range(0, count, step)
        ]
    return join_estimates(parts)


class _Place(NamedTuple):
    """Units (B) at a point of their search; positions run fastest in memory."""

    theta: Array  # (B, p)
    force: Array  # (3, B, n) [g]
    phi: Array  # (T, B, n)
    residuals: Array  # (3, B, n)
    objective: Array  # (B,)

    def of(self, units: NDArray[Any]) -> "_Place":
        """Return some of the units."""
        return _Place(
            self.theta[units],
            self.force[:, units],
            self.phi[:, units],
            self.residuals[:, units],
            self.objective[units],
        )

    def put(self, units: NDArray[np.intp], other: "_Place") -> None:
        """Put other units in places of these."""
        self.theta[units] = other.theta
        self.force[:, units] = other.force
        self.phi[:, units] = other.phi
        self.residuals[:, units] = other.residuals
        self.objective[units] = other.objective


class _Surface(NamedTuple):
    """The normal equations, eq. (1)."""

    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    cofactors: Array  # (3, 3, B, n), of G
    determinant: Array  # (B, n)
    normal: Array  # m, (3, B, n)
    excess: Array  # (B, n), how far outside a reading lies, relative to the force


def _estimate(shared: SharedSphere, values: Array) -> Estimates:
    model = shared.model
    n, p = values.shape[2], len(model.keys)
    started, theta, force = _start(shared, values)
    place, ended = _descend(shared, values, _at(shared, values, theta, force))
    for _ in range(_LAST_STEPS):
        surface = _linearise(shared, place)
        none = np.zeros(len(place.theta))
        move = _step(place.theta, surface, none)[0]
        place = _moved(shared, values, place, surface, move, none)
    surface = _linearise(shared, place)
    nu = float(n - p)
    factor = place.objective / nu
    told, inverse = _inverse(surface.information)
    u = np.sqrt(np.einsum("bpp->bp", inverse) * factor[:, None])
    sound = started & ended & told & (np.abs(place.theta).max(axis=1) <= LARGEST)
    sound &= place.objective > _ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    sound &= (place.theta[:, list(model.own_scales)] > 0.0).all(axis=1)
    sound &= _is_told(shared, place, surface.information, factor)
    coefficients = model_coefficients(model, place.theta)
    residuals = tuple(place.residuals)
    left = compensated(
        model,
        shared.environment,
        place.force.transpose(1, 2, 0),
        coefficients,
        tuple(values),
        residuals,
    )
    length = np.linalg.norm(place.force.transpose(1, 2, 0) + left.force, axis=2)
    rms = np.sqrt(np.mean((length - shared.size) ** 2, axis=1))
    dof = np.full(p, nu)
    sound &= left.sound
    return Estimates(place.theta, u, dof, rms, residuals, left.inverse, sound)


def _start(shared: SharedSphere, values: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which units have an ellipsoid, parameters (B, p) and forces (3, B, n) there."""
    model = shared.model
    sound, bias, matrix = _ellipsoids(values, any("cross_" in name for name in model.names))
    matrix = matrix / shared.size
    if model.gauge == "symmetric":
        left, sizes, _ = np.linalg.svd(matrix)
        matrix = (left * sizes[:, None, :]) @ left.transpose(0, 2, 1)
    theta = np.zeros((values.shape[1], len(model.keys)))
    linear = np.concatenate([bias[:, :, None], matrix], axis=2)
    for i, (output, term) in enumerate(model.keys):
        column = {"1": 0, "x": 1, "y": 2, "z": 3}.get(str(term))
        if column is not None:
            theta[:, i] = linear[:, model.outputs.index(output), column]
    centred = values.transpose(1, 0, 2) - bias[:, :, None]
    force = np.linalg.solve(matrix, centred).transpose(1, 0, 2)
    return sound, theta, force * (shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force)))


def _ellipsoids(values: Array, crossed: bool) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which units lie on an ellipsoid, its centre (B, 3) and lower root (B, 3, 3)."""
    centre = values.mean(axis=2)
    y = values - centre[:, :, None]
    size = np.sqrt(np.mean(y**2, axis=2))
    sound = (size > 1e-6 * np.abs(values).max(axis=(0, 2))).all(axis=0)
    size = np.where(sound, size, 1.0)
    extent = np.linalg.eigvalsh(np.einsum("ibn,jbn->bij", y, y))
    sound &= extent[:, 0] > _SPREAD * extent[:, -1]
    x, y, z = y / size[:, :, None]
    columns = [x * x - z * z, y * y - z * z, 2 * x, 2 * y, 2 * z, np.ones_like(x)]
    if crossed:
        columns += [2 * x * y, 2 * x * z, 2 * y * z]
    design = np.stack(columns, axis=1)
    square = x * x + y * y + z * z
    information = design @ design.transpose(0, 2, 1)
    values_of = np.linalg.eigvalsh(information)
    sound &= values_of[:, 0] > _SHOWN * values_of[:, -1]
    information[~sound] = np.eye(len(columns))
    c = np.linalg.solve(information, (design @ square[:, :, None]))[:, :, 0].T
    form = np.zeros((x.shape[0], 3, 3))
    form[:, 0, 0], form[:, 1, 1], form[:, 2, 2] = 1.0 - c[0], 1.0 - c[1], 1.0 + c[0] + c[1]
    if crossed:
        for place, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), start=6):
            form[:, i, j] = form[:, j, i] = -c[place]
    axes = np.linalg.eigvalsh(form)
    sound &= axes[:, 0] > _ROUND * axes[:, -1]
    form[~sound] = np.eye(3)
    inverse = np.linalg.inv(form)
    bias = np.einsum("bij,jb->bi", inverse, c[2:5])
    radius = c[5] + np.einsum("jb,bj->b", c[2:5], bias)
    sound &= radius > 0.0
    lower = np.linalg.cholesky(inverse) * np.sqrt(np.where(sound, radius, 1.0))[:, None, None]
    return sound, (centre + size * bias.T).T, size.T[:, :, None] * lower


def _at(shared: SharedSphere, values: Array, theta: Array, force: Array) -> _Place:
    model = shared.model
    _, count, n = force.shape
    columns = {name: np.tile(column, count) for name, column in shared.environment.items()}
    phi = model.basis(force.reshape(3, -1).T, columns).T.reshape(-1, count, n)
    residuals = values - np.einsum("bmt,tbn->mbn", model_coefficients(model, theta), phi)
    return _Place(theta, force, phi, residuals, np.einsum("mbn,mbn->b", residuals, residuals))


def _linearise(shared: SharedSphere, place: _Place) -> _Surface:
    G = force_slopes(shared.model, shared.environment, place.theta, place.force)
    upper, lower = G[_NEXT], G[_LAST]
    cofactors = upper[:, _NEXT] * lower[:, _LAST] - upper[:, _LAST] * lower[:, _NEXT]
    determinant = np.einsum("ibn,ibn->bn", G[0], cofactors[0])
    normal = np.einsum("mibn,ibn->mbn", cofactors, place.force)
    height = np.einsum("mbn,mbn->bn", normal, place.residuals)
    excess = height / (determinant * shared.size**2)
    root = 1.0 / np.sqrt(np.einsum("mbn,mbn->bn", normal, normal))
    normal *= root
    outputs, columns, copies = shared.model.rows
    rows = normal[outputs] * place.phi[columns]
    for parameter, output, column in copies:
        rows[parameter] += normal[output] * place.phi[column]
    rows = np.ascontiguousarray(rows.transpose(1, 0, 2))
    return _Surface(
        rows @ rows.transpose(0, 2, 1),
        (rows @ (height * root)[:, :, None])[:, :, 0],
        cofactors,
        determinant,
        normal,
        excess,
    )


def _moved(
    shared: SharedSphere, values: Array, place: _Place, surface: _Surface, move: Array, by: Array
) -> _Place:
    """Return places after steps (B, p) of the parameters, damped by (B,), eq. (2)."""
    change = model_coefficients(shared.model, move)
    left = place.residuals - np.einsum("bmt,tbn->mbn", change, place.phi)
    left -= surface.normal * np.einsum("mbn,mbn->bn", surface.normal, left)
    turn = np.einsum("mibn,mbn->ibn", surface.cofactors, left) / surface.determinant
    ease = (1.0 + by[:, None]) * (1.0 + np.maximum(surface.excess, 0.0))
    force = place.force + turn / ease
    force *= shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force))
    return _at(shared, values, place.theta + move, force)


def _descend(
    shared: SharedSphere, values: Array, place: _Place
) -> tuple[_Place, NDArray[np.bool_]]:
    """Return where every unit's search ends, and of which units it does.

    A step that is not taken is tried again with ten times the damping.
    """
    count = len(place.theta)
    ended = np.zeros(count, dtype=np.bool_)
    damping, before = np.full(count, _DAMPING), np.full(count, np.inf)
    units = np.flatnonzero(np.isfinite(place.objective))
    for _ in range(_ITERATIONS):
        if not len(units):
            break
        here = place.of(units)
        surface = _linearise(shared, here)
        move, decrement, relative = _step(here.theta, surface, damping[units])
        trial = _moved(shared, values[:, units], here, surface, move, damping[units])
        taken = trial.objective <= here.objective
        place.put(units[taken], trial.of(taken))
        flat = ~taken & (decrement <= _FLAT * here.objective)
        shrink = np.minimum(np.where(np.isinf(before[units]), 1.0, decrement / before[units]), 1.0)
        enough = (decrement * shrink <= _DECREMENT * trial.objective) | (relative <= _XTOL)
        ended[units] = flat | (taken & enough)
        before[units] = np.where(taken, decrement, before[units])
        damping[units] *= np.where(taken, 0.1, 10.0)
        units = units[~ended[units] & (damping[units] <= _STUCK)]
    return place, ended


def _step(theta: Array, surface: _Surface, damping: Array) -> tuple[Array, Array, Array]:
    """Return damped steps (B, p), what each should take off F, and its size relative to theta."""
    information = surface.information
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scale = np.where(scale > 0.0, scale, 1.0)
    damped = information / (scale[:, :, None] * scale[:, None, :])
    places = np.arange(scale.shape[1])
    damped[:, places, places] += np.maximum(damping, 1e-15)[:, None]
    damped[~np.isfinite(damped).all(axis=(1, 2))] = np.eye(len(places))
    scaled = np.linalg.solve(damped, (surface.gradient / scale)[:, :, None])[:, :, 0]
    move = scaled / scale
    size = np.maximum(np.abs(theta * scale).max(axis=1), 1e-300)
    decrement = np.einsum("bp,bp->b", move, surface.gradient)
    return move, decrement, np.abs(scaled).max(axis=1) / size


def _inverse(information: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which matrices (B, p, p) are well conditioned, and their inverses."""
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~sound] = np.eye(scaled.shape[1])
    sizes = np.linalg.eigvalsh(scaled)
    sound &= sizes[:, 0] > _WORST * sizes[:, -1]
    scaled[~sound] = np.eye(scaled.shape[1])
    return sound, np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])


def _is_told(
    shared: SharedSphere, place: _Place, information: Array, factor: Array
) -> NDArray[np.bool_]:
    """Tell which units show every parameter far beyond what noise could pretend."""
    model = shared.model
    typical = median(place.theta, axis=0)
    limit = plausible_range(model, typical, shared.size)
    if limit is None:
        return np.zeros(len(factor), dtype=np.bool_)
    relative = information * np.outer(limit, limit) / factor[:, None, None]
    sound = np.isfinite(relative).all(axis=(1, 2))
    relative[~sound] = 0.0
    n = place.force.shape[2]
    return np.asarray(sound & (np.linalg.eigvalsh(relative)[:, 0] > _TOLD * n))

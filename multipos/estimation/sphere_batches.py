"""Many units of unknown orientation: the searches of `multipos.estimation.sphere_batches`.

A unit starts on the ellipsoid of its readings (`multipos.estimation.starts`) and searches from
there. Where nothing is stated of the noise, the end of the search has with S and F of eq. (1) there

    cov = S⁻¹ F/ν,    ν = n − p,                                                            (1)

and u allows for axes of unequal noise (`multipos.estimation.unequal_axes`).

A stated noise is a floor: what readings scatter beside it, τ², is integrated over
(`multipos.estimation.orientation_variance`) and searched on from, in turn until it settles, as
`multipos.estimation.noise` has it for one unit. Uncertainties with degrees of freedom go through
`multipos.estimation.stated_uncertainty` on their way in and out.

A unit is left to `fit` where the ellipsoid needs more care than least squares, where a search has
not ended, where S is badly conditioned, where noise might hide a parameter, or where what is stated
cannot be weights.

The search for unknown orientations of many units: `multipos.estimation.sphere`, all at once.

Every unit has a problem of its own, with its own directions, so that nothing but the form of the
equations is shared. With the residuals r = y − h(f), of variances Σ, G = dh/df and the normal m of
the surface that the readings of all directions form,

    m = n/√(n'Σn),  n = det(G) G⁻ᵀ f,    a = A'm,    S = Σ a a',    S d = Σ a m'r,           (2)
    df = G⁻¹ (x − Σ m m'x),    x = r − A d,    f'df = 0,                                    (3)

of which a unit takes damped steps until the next one would take less than 10⁻¹⁶ off F = Σ r'Σ⁻¹r,
and is then left out of what follows.
"""

from collections.abc import Mapping, Sequence
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
from multipos.estimation.known import DENIED, ROUNDING
from multipos.estimation.orientation_variance import (
    SETTLED,
    Judged,
    Normals,
    integrate_along,
    judge_in_turn,
    typical,
)
from multipos.estimation.posteriors import standard_uncertainty
from multipos.estimation.stated_uncertainty import Claims, carried_jointly, take_claims
from multipos.estimation.unequal_axes import allow_for_axes
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array, Places, median
from multipos.numerics.factoring import cofactors_of
from multipos.numerics.quantiles import chi2_quantile
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.model import Model

_ITERATIONS = 60
_DAMPING = 1e-4
_DECREMENT = 1e-16  # of F, by the next step
_LAST_STEPS = 2  # whatever F says, whose last digits are the rounding of the readings
_FLAT = 1e-15  # of F, below which a step is lost in the rounding of F
_XTOL = 1e-13  # relative step that is only rounding
_STUCK = 1e12  # damping beyond which nothing moves


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


class Place(NamedTuple):
    """Units (B) at a point of their search; positions run fastest in memory."""

    theta: Array  # (B, p)
    force: Array  # (3, B, n) [g]
    phi: Array  # (T, B, n)
    residuals: Array  # (3, B, n)
    objective: Array  # (B,)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        return Place(
            self.theta[units],
            self.force[:, units],
            self.phi[:, units],
            self.residuals[:, units],
            self.objective[units],
        )

    def put(self, units: NDArray[np.intp], other: "Place") -> None:
        """Put other units in places of these."""
        self.theta[units] = other.theta
        self.force[:, units] = other.force
        self.phi[:, units] = other.phi
        self.residuals[:, units] = other.residuals
        self.objective[units] = other.objective


class Surface(NamedTuple):
    """The normal equations, eq. (2)."""

    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    rows: Array  # a, (B, p, n)
    height: Array  # m'r, (B, n)
    cofactors: Array  # (3, 3, B, n), of G
    determinant: Array  # (B, n)
    normal: Array  # m, (3, B, n)
    across: Array  # Σm, (3, B, n)
    excess: Array  # (B, n), how far outside a reading lies, relative to the force


def place_at(
    shared: SharedSphere, values: Array, variance: Array, theta: Array, force: Array
) -> Place:
    """Return units at parameters (B, p) and forces (3, B, n); variances are (3, B, n)."""
    model = shared.model
    _, count, n = force.shape
    columns = {name: np.tile(column, count) for name, column in shared.environment.items()}
    phi = model.basis(force.reshape(3, -1).T, columns).T.reshape(-1, count, n)
    residuals = values - np.einsum("bmt,tbn->mbn", model_coefficients(model, theta), phi)
    return Place(theta, force, phi, residuals, _objective(residuals, variance))


def _objective(residuals: Array, variance: Array) -> Array:
    return np.asarray(np.einsum("mbn,mbn->b", residuals, residuals / variance))


def linearise(shared: SharedSphere, place: Place, variance: Array) -> Surface:
    """Return the normal equations, eq. (2)."""
    G = force_slopes(shared.model, shared.environment, place.theta, place.force)
    cofactors = cofactors_of(G)
    determinant = np.einsum("ibn,ibn->bn", G[0], cofactors[0])
    normal = np.einsum("mibn,ibn->mbn", cofactors, place.force)
    across = variance * normal
    height = np.einsum("mbn,mbn->bn", normal, place.residuals)
    excess = height / (determinant * shared.size**2)
    root = 1.0 / np.sqrt(np.einsum("mbn,mbn->bn", normal, across))
    normal *= root
    across *= root
    height *= root
    outputs, columns, copies = shared.model.rows
    rows = normal.take(outputs, axis=0) * place.phi.take(columns, axis=0)
    for parameter, output, column in copies:
        rows[parameter] += normal[output] * place.phi[column]
    rows = np.ascontiguousarray(rows.transpose(1, 0, 2))
    return Surface(
        rows @ rows.transpose(0, 2, 1),
        (rows @ height[:, :, None])[:, :, 0],
        rows,
        height,
        cofactors,
        determinant,
        normal,
        across,
        excess,
    )


def search(
    shared: SharedSphere, values: Array, variance: Array, place: Place
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where every unit's search ends, and of which units it does.

    Parameters
    ----------
    shared : SharedSphere
    values, variance : (3, B, n) arrays
    place : Place
        Where it begins, whatever the variances were there.
    """
    place = place._replace(objective=_objective(place.residuals, variance))
    place, ended = _descend(shared, values, variance, place)
    for _ in range(_LAST_STEPS):
        surface = linearise(shared, place, variance)
        none = np.zeros(len(place.theta))
        move = _step(place.theta, surface, none)[0]
        place = _moved(shared, values, variance, place, surface, move, none)
    return place, ended


def _moved(
    shared: SharedSphere,
    values: Array,
    variance: Array,
    place: Place,
    surface: Surface,
    move: Array,
    by: Array,
) -> Place:
    """Return places after steps (B, p) of the parameters, damped by (B,), eq. (3)."""
    change = model_coefficients(shared.model, move)
    left = place.residuals - np.einsum("bmt,tbn->mbn", change, place.phi)
    left -= surface.across * np.einsum("mbn,mbn->bn", surface.normal, left)
    turn = np.einsum("mibn,mbn->ibn", surface.cofactors, left) / surface.determinant
    ease = (1.0 + by[:, None]) * (1.0 + np.maximum(surface.excess, 0.0))
    force = place.force + turn / ease
    force *= shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force))
    return place_at(shared, values, variance, place.theta + move, force)


def _descend(
    shared: SharedSphere, values: Array, variance: Array, place: Place
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where the steps of every unit end, and of which units they do; `place` follows.

    A step that is not taken is tried again with ten times the damping.
    """
    count = len(place.theta)
    ended = np.zeros(count, dtype=np.bool_)
    damping, before = np.full(count, _DAMPING), np.full(count, np.inf)
    units = np.flatnonzero(np.isfinite(place.objective))
    for _ in range(_ITERATIONS):
        if not len(units):
            break
        here, known = place.of(units), variance[:, units]
        surface = linearise(shared, here, known)
        move, decrement, relative = _step(here.theta, surface, damping[units])
        trial = _moved(shared, values[:, units], known, here, surface, move, damping[units])
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


def _step(theta: Array, surface: Surface, damping: Array) -> tuple[Array, Array, Array]:
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


_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_SPREAD = 1e-3  # ratio of squared extents of the readings, below which they may be flat
_SHOWN = 1e-5  # eigenvalue of the scaled quadric's information below which it may not be shown
_ROUND = 0.01  # squared ratio of semi-axes below which the ellipsoid may not be one
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_TOLD = 200.0  # of the readings: information beyond which no noise hides a parameter


def share_sphere(
    model: Model, size: float, environment: Mapping[str, Array]
) -> SharedSphere | None:
    """Return what units share, or None where a batch does not do what `fit` does."""
    own = model.axes == model.inputs == COMPONENTS and len(model.own_scales) == len(COMPONENTS)
    if not own or not model.has_all_linear:
        return None
    return SharedSphere(model, size, {name: environment[name] for name in model.environment})


def estimate_spheres(
    shared: SharedSphere,
    values: Sequence[Array],
    stated: Sequence[Array] = (),
    claimed: Sequence[Array] = (),
) -> Estimates:
    """Fit B units of unknown orientation.

    Parameters
    ----------
    shared : SharedSphere
    values : 3 arrays (B, n)
        Readings of each output.
    stated, claimed : 3 arrays (B, n), or none
        Their standard uncertainties, and the degrees of freedom of those.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    parts = []
    for first in range(0, count, step):
        rows = slice(first, first + step)
        y, u, dof = ([each[rows] for each in arrays] for arrays in (values, stated, claimed))
        with np.errstate(all="ignore"):  # a trial may run away, and is then left out
            parts.append(_estimate(shared, np.stack(y), take_claims(u, dof) if u else None))
    return join_estimates(parts)


class _Noise(NamedTuple):
    """What the search takes as known of B units."""

    variance: Array  # of the readings, (3, B, n)

    def of(self, units: NDArray[Any]) -> "_Noise":
        """Return some of the units."""
        return _Noise(self.variance[:, units])

    def put(self, units: Places, other: "_Noise") -> None:
        """Put what is known of other units in places of these."""
        self.variance[:, units] = other.variance


class _Worth(NamedTuple):
    """Where the searches of B units ended, and what their parameters are worth."""

    place: Place
    u: Array  # (B, p)
    dof: Array  # (B,)
    sound: NDArray[np.bool_]


def _estimate(shared: SharedSphere, values: Array, claims: Claims | None) -> Estimates:
    model = shared.model
    n, p = values.shape[2], len(model.keys)
    variance = np.ones_like(values) if claims is None else np.moveaxis(claims.u**2, 2, 0).copy()
    sound, theta, force = _start(shared, values)
    place, ended = search(
        shared, values, variance, place_at(shared, values, variance, theta, force)
    )
    surface = linearise(shared, place, variance)
    nu = float(n - p)
    factor = place.objective / nu
    sound &= ended & _is_told(shared, place, surface.information, factor)
    chi2 = None
    if claims is None:
        inverse = _inverse(surface.information)
        loose = np.moveaxis(surface.normal**2, 0, 1)
        inverse = inverse._replace(
            matrix=allow_for_axes(surface.rows, surface.height, loose, inverse.matrix)
        )
        u = np.sqrt(np.einsum("bpp->bp", inverse.matrix) * factor[:, None])
        found = _Worth(place, u, np.full(len(u), nu), sound & inverse.sound)
    else:
        chi2 = place.objective.copy()
        found = _beside_stated(shared, values, place, _Noise(variance), claims, sound)
    place, sound = found.place, found.sound & (np.abs(found.place.theta).max(axis=1) <= LARGEST)
    sound &= (place.theta[:, list(model.own_scales)] > 0.0).all(axis=1)
    squares = np.einsum("mbn,mbn->b", place.residuals, place.residuals)
    sound &= squares > ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    force = place.force.transpose(1, 2, 0)
    left = compensated(
        model,
        shared.environment,
        force,
        model_coefficients(model, place.theta),
        tuple(values),
        tuple(place.residuals),
    )
    length = np.linalg.norm(force + left.force, axis=2)
    rms = np.sqrt(np.mean((length - shared.size) ** 2, axis=1))
    dof = np.broadcast_to(found.dof[:, None], found.u.shape)
    residuals = tuple(place.residuals)
    return Estimates(
        place.theta, found.u, dof, rms, residuals, left.inverse, sound & left.sound, chi2
    )


def _beside_stated(
    shared: SharedSphere,
    values: Array,
    place: Place,
    noise: _Noise,
    claims: Claims,
    sound: NDArray[np.bool_],
) -> _Worth:
    """Return the solutions with what readings scatter beside the noise that they state."""
    floor = claims.u**2
    n, p = values.shape[2], len(shared.model.keys)
    size, before = typical(floor), np.zeros(len(floor))
    denied = np.flatnonzero(place.objective > chi2_quantile(DENIED, float(n - p)))

    def judge(units: Places, here: Place, known: _Noise) -> Judged[_Noise]:
        surface = linearise(shared, here, known.variance)
        weighted = here.objective * (size[units] + before[units])
        plain = np.einsum("mbn,mbn->b", here.residuals, here.residuals)
        posterior = integrate_along(_along(surface), floor[units], float(n - p), (weighted, plain))
        tau2 = posterior.summary[0]
        settled = np.abs(tau2 - before[units]) <= SETTLED * (size[units] + before[units])
        before[units] = tau2
        following = np.moveaxis(floor[units], 2, 0) + tau2[:, None]
        return Judged(posterior, _Noise(following), settled)

    def search_on(units: Places, here: Place, known: _Noise) -> tuple[Place, NDArray[np.bool_]]:
        return search(shared, values[:, units], known.variance, here)

    try:
        found = judge_in_turn(place, noise, sound & claims.sound, p, judge, search_on)
    except np.linalg.LinAlgError:  # some unit is as good as singular
        nothing = np.full(place.theta.shape, np.nan)
        return _Worth(place, nothing, nothing[:, 0], np.zeros_like(sound))
    surface = linearise(shared, found.place, found.noise.variance)
    inverse = _inverse(surface.information)
    u = standard_uncertainty(found.U, np.broadcast_to(found.dof[:, None], found.U.shape))
    if denied.size:
        scatter = np.maximum(found.noise.variance - np.moveaxis(floor, 2, 0), 0.0)
        loose = np.moveaxis(surface.normal**2 * scatter, 0, 1)
        known = (surface.rows, surface.height, loose, inverse.matrix)
        wider = allow_for_axes(*(each[denied] for each in known))
        formal = np.einsum("bpp->bp", inverse.matrix[denied])
        u[denied] *= np.sqrt(np.einsum("bpp->bp", wider) / formal)
    dof = carried_jointly(found.dof, claims, before)
    return _Worth(found.place, u, dof, found.sound & inverse.sound)


def _along(surface: Surface) -> Normals:
    """Return the linear models of what lies along the normals, of length one."""
    length = np.sqrt(np.einsum("mbn,mbn->bn", surface.normal, surface.normal))
    return Normals(
        surface.height / length,
        surface.rows.transpose(0, 2, 1) / length[:, :, None],
        np.moveaxis(surface.normal / length, 0, 2),
    )


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


class _Inverse(NamedTuple):
    """Inverses of matrices (B, p, p), and which of these are well conditioned."""

    matrix: Array
    sound: NDArray[np.bool_]


def _inverse(information: Array) -> _Inverse:
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~sound] = np.eye(scaled.shape[1])
    sizes = np.linalg.eigvalsh(scaled)
    sound &= sizes[:, 0] > _WORST * sizes[:, -1]
    scaled[~sound] = np.eye(scaled.shape[1])
    return _Inverse(np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :]), sound)


def _is_told(
    shared: SharedSphere, place: Place, information: Array, factor: Array
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

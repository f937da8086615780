"""Many units at uncertain orientations, on positions that they share.

Each unit goes the way of `multipos.estimation.uncertain`, all of them in step: the search for
parameters and positions (`multipos.estimation.uncertain_batches`) with the noise that is stated,
or one of any size, and from there as `multipos.estimation.noise` has it,

- a noise that nobody stated gets the least floor that could matter;
- with stated orientation sds the scatter τ² is integrated over, then searched on from, in turn
  until it settles (`multipos.estimation.orientation_variance`, the posteriors of all units at once
  by `multipos.estimation.orientation_variance`);
- where their size is to be estimated, the same of τ² and the common factor F on their squares.

A unit that has settled is left out of the turns that follow. One is left to `fit` where a search
has not ended, where no scatter explains the residuals beside a stated noise, or where stated noise
is unlike and placement to be estimated; where the positions separate parameters badly or noise
leaves scale factors open, where a position sticks out, and where readings are too loud.

The search for parameters and positions of many units at uncertain orientations, all at once.

Every unit has the problem of `multipos.estimation.likelihood` at positions that all of them share,

    F = Σ_k r_k'Σ_k⁻¹r_k + |t_k|²/s_k²,     r_k = y_k − h(theta, ±g E(u_k, t_k)),           (1)

and takes the steps of its eqs. (5) and (6) from the listed directions, undamped: positions that are
off by little bend F by little, and each step leaves a small share of the one before. A unit has
come to its end when a step takes less than 10⁻¹⁶ off F; one that has not in a few steps is left to
the search of `multipos.estimation.descent`.
"""

from collections.abc import Callable, Mapping, Sequence
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
from multipos.estimation.known import ROUNDING, share_design
from multipos.estimation.likelihood import eliminate
from multipos.estimation.noise import STILL
from multipos.estimation.orientation_variance import (
    LEAST,
    LEAST_TOLD,
    SETTLED,
    SETTLED_BOTH,
    TELLING,
    About,
    Alternated,
    Judged,
    are_alike,
    integrate_scatter,
    integrate_scatter_and_placement,
    judge_in_turn,
    typical,
)
from multipos.estimation.posteriors import standard_uncertainty
from multipos.estimation.problem import RELATIVE_NOISE
from multipos.estimation.starts import WIDE
from multipos.estimation.stated_uncertainty import Claims, carried_jointly, take_claims
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import chi2_quantile
from multipos.numerics.rotations import (
    directions,
    step_derivative,
    step_on_sphere,
    tangent_basis,
)
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.fit_diagnostics import find_outlying_positions
from multipos.sensor.model import Model

_ITERATIONS = 15
_DECREMENT = 1e-16  # of F
_OUTPUTS = 3


class Positions(NamedTuple):
    """What is listed of the positions.

    Attributes
    ----------
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
    """

    reference: Array
    environment: Mapping[str, Array]


class Place(NamedTuple):
    """Units (B) at a point of their search."""

    theta: Array  # (B, p)
    step: Array  # t, (B, n, 2) [rad]
    force: Array  # (B, n, 3) [g]
    design: Array  # A, (B, n, 3, p)
    residuals: Array  # (B, n, 3)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        return Place(*(each[units] for each in self))

    def put(self, units: NDArray[np.intp], other: "Place") -> None:
        """Put other units in places of these."""
        for mine, new in zip(self, other, strict=True):
            mine[units] = new


class Noise(NamedTuple):
    """What the search takes as known of B units."""

    variance: Array  # of the readings, (B, n, 3)
    orientation_sd: Array  # (B, n) [rad]

    def of(self, units: NDArray[Any]) -> "Noise":
        """Return some of the units."""
        return Noise(*(each[units] for each in self))

    def put(self, units: NDArray[np.intp], other: "Noise") -> None:
        """Put what is known of other units in places of these."""
        for mine, new in zip(self, other, strict=True):
            mine[units] = new


def place_at(model: Model, listed: Positions, values: Array, theta: Array, step: Array) -> Place:
    """Return units at parameters (B, p) and steps (B, n, 2)."""
    count, n, _ = values.shape
    centre, basis, size = _centres(listed, count)
    force = size * step_on_sphere(centre, basis, step.reshape(-1, 2))
    columns = {name: np.tile(column, count) for name, column in listed.environment.items()}
    phi = model.basis(force, columns).reshape(count, n, -1)
    design = np.zeros((count, n, _OUTPUTS, theta.shape[1]))
    for output, (part, own) in enumerate(zip(model.slices, model.columns, strict=True)):
        design[:, :, output, part] = phi[:, :, own]
    residuals = values - phi @ model_coefficients(model, theta).transpose(0, 2, 1)
    return Place(theta, step, force.reshape(count, n, 3), design, residuals)


def turns(model: Model, listed: Positions, place: Place) -> Array:
    """Return what a turn of each position does to its reading, J (B, n, 3, 2)."""
    count, n, _ = place.force.shape
    centre, basis, size = _centres(listed, count)
    moves = size[:, :, None] * step_derivative(centre, basis, place.step.reshape(-1, 2))
    force = np.ascontiguousarray(place.force.transpose(2, 0, 1))
    slopes = force_slopes(model, listed.environment, place.theta, force)
    by_force = slopes.reshape(_OUTPUTS, 3, -1).transpose(2, 0, 1)
    return (by_force @ moves).reshape(count, n, _OUTPUTS, 2)


def objective(place: Place, noise: Noise) -> Array:
    """Return F (B,) of eq. (1)."""
    return np.asarray(misfits(place, noise).sum(axis=1))


def misfits(place: Place, noise: Noise) -> Array:
    """Return what each position adds to F, (B, n)."""
    squares = np.einsum("bni,bni->bn", place.residuals**2, 1.0 / noise.variance)
    off = np.einsum("bni,bni->bn", place.step, place.step)
    return np.asarray(squares + off * _prior(noise))


def search(
    model: Model, listed: Positions, values: Array, place: Place, noise: Noise
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where every unit's search ends, and of which units it does.

    Parameters
    ----------
    model : Model
    listed : Positions
    values : (B, n, 3) array
    place : Place
        Where it begins.
    noise : Noise
    """
    place = Place(*(each.copy() for each in place))
    ended = np.zeros(len(values), dtype=np.bool_)
    units = np.flatnonzero(np.isfinite(objective(place, noise)))
    for _ in range(_ITERATIONS):
        if not len(units):
            break
        here, known = place.of(units), noise.of(units)
        following, decrement = _moved(model, listed, values[units], here, known)
        place.put(units, following)
        enough = decrement <= _DECREMENT * objective(following, known)
        ended[units] = enough
        units = units[~enough & np.isfinite(decrement)]
    return place, ended


def information_of(model: Model, listed: Positions, place: Place, noise: Noise) -> Array:
    """Return the information S (B, p, p) of the parameters, positions eliminated."""
    return _equations(model, listed, place, noise).information


class _Equations(NamedTuple):
    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    pull: Array  # (B n, 2)
    weighted: Array  # Σ⁻¹J, (B n, 3, 2)
    inverse: Array  # H⁻¹, (B n, 2, 2)


def _equations(model: Model, listed: Positions, place: Place, noise: Noise) -> _Equations:
    count, p = place.theta.shape
    J = turns(model, listed, place).reshape(-1, _OUTPUTS, 2)
    precision = (1.0 / noise.variance).reshape(-1, _OUTPUTS)
    weighted = precision[:, :, None] * J
    prior = _prior(noise).ravel()
    sd = noise.orientation_sd.ravel()
    own = eliminate(
        precision[:, :, None] * np.eye(_OUTPUTS),
        J,
        weighted,
        prior,
        sd == 0.0,
        np.zeros(len(sd), dtype=np.bool_),
    )
    r = place.residuals.reshape(-1, _OUTPUTS)
    pull = np.einsum("nmi,nm->ni", weighted, r) - prior[:, None] * place.step.reshape(-1, 2)
    push = precision * r - np.einsum("nmi,ni->nm", own.gain, pull)
    A = place.design.reshape(-1, _OUTPUTS, p)
    WA = (own.marginal @ A).reshape(count, -1, p)
    At = place.design.reshape(count, -1, p).transpose(0, 2, 1)
    gradient = (At @ push.reshape(count, -1, 1))[:, :, 0]
    return _Equations(At @ WA, gradient, pull, weighted, own.inverse)


def _moved(
    model: Model, listed: Positions, values: Array, place: Place, noise: Noise
) -> tuple[Place, Array]:
    """Return places after a step, and what it should take off F (B,)."""
    count, n, _ = values.shape
    found = _equations(model, listed, place, noise)
    scale = np.sqrt(np.einsum("bpp->bp", found.information))
    relative = found.information / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(relative).all(axis=(1, 2))
    relative[~sound] = np.eye(relative.shape[1])  # its step is none
    move = np.linalg.solve(relative, (found.gradient / scale)[:, :, None])[:, :, 0] / scale
    move[~sound] = np.nan
    follows = (place.design.reshape(count, -1, move.shape[1]) @ move[:, :, None]).reshape(-1, 3)
    back = found.pull - np.einsum("nmi,nm->ni", found.weighted, follows)
    own = np.einsum("nij,nj->ni", found.inverse, back).reshape(count, n, 2)
    decrement = np.einsum("bp,bp->b", move, found.gradient)
    theta, step = place.theta + move, place.step + own
    return place_at(model, listed, values, theta, step), decrement


def _prior(noise: Noise) -> Array:
    """Return 1/s² (B, n); exact positions get 0 here, as nothing of theirs is a step."""
    sd = noise.orientation_sd
    return np.where(sd > 0.0, 1.0 / np.where(sd > 0.0, sd, 1.0) ** 2, 0.0)


def _centres(listed: Positions, count: int) -> tuple[Array, Array, Array]:
    """Return the listed directions (B n, 3), bases (B n, 3, 2) and sizes (B n, 1) [g]."""
    centre = directions(listed.reference)
    size = np.linalg.norm(listed.reference, axis=1)[:, None]
    whole = (count, 1)
    return (
        np.tile(centre, whole),
        np.tile(tangent_basis(centre), (*whole, 1)),
        np.tile(size, whole),
    )


_AT_ONCE = 1500  # readings of an output, so that what they need stays small
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_LOUD = 0.01  # of a scale factor: noise or U from which on a unit is looked at

_Found = Alternated[Place, Noise]


@dataclass(frozen=True, eq=False)
class SharedPlacement:
    """What units at uncertain orientations share.

    Attributes
    ----------
    model : Model
    reference : (n, 3) array [g]
        As listed.
    orientation_sd : (n,) array [rad]
    environment : mapping of str to (n,) array
        Other columns of the model.
    estimated : bool
        The size of the orientation sds is to be estimated.
    inverses : tuple of M (p_i, n) arrays
        Of the designs at the listed positions.
    """

    model: Model
    reference: Array
    orientation_sd: Array
    environment: Mapping[str, Array]
    estimated: bool
    inverses: tuple[Array, ...]

    @property
    def dof(self) -> float:
        """Degrees of freedom that the parameters leave."""
        return float(len(COMPONENTS) * len(self.reference) - len(self.model.keys))

    @property
    def listed(self) -> Positions:
        """The positions."""
        return Positions(self.reference, self.environment)


def share_placement(
    model: Model,
    reference: Array,
    orientation_sd: Array,
    environment: Mapping[str, Array],
    *,
    estimated: bool,
) -> SharedPlacement | None:
    """Return what units share, or None where a batch does not do what `fit` does.

    Parameters
    ----------
    model : Model
    reference : (n, 3) array [g]
        As listed.
    orientation_sd : (n,) array [rad]
    environment : mapping of str to (n,) array
        Other columns that the model uses.
    estimated : bool
        The size of the orientation sds is to be estimated.

    Raises
    ------
    RankError
        The positions cannot separate the parameters.
    """
    triad = sorted(model.axes) == list(COMPONENTS) and model.inputs == COMPONENTS
    placed = (orientation_sd <= WIDE).all() and orientation_sd.any()
    if not (triad and placed and model.has_all_linear):
        return None
    design = share_design(model, reference, environment)
    spare = len(reference) - len(model.keys)
    if not design.well_posed or (spare < TELLING and not orientation_sd.all()):
        return None
    return SharedPlacement(
        model, reference, orientation_sd, design.environment, estimated, tuple(design.inverses)
    )


def estimate_placed(
    shared: SharedPlacement,
    values: Sequence[Array],
    stated: Sequence[Array],
    claimed: Sequence[Array],
) -> Estimates:
    """Fit B units at uncertain orientations.

    Parameters
    ----------
    shared : SharedPlacement
    values : sequence of 3 arrays (B, n)
        Readings of each output.
    stated : sequence of 3 arrays (B, n), or of none
        Their standard uncertainties.
    claimed : sequence of 3 arrays (B, n), or of none
        Degrees of freedom of those.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    parts, carried = [], []
    for first in range(0, count, step):
        rows = slice(first, first + step)
        y, u, dof = ([each[rows] for each in arrays] for arrays in (values, stated, claimed))
        claims = take_claims(u, dof) if u else None
        with np.errstate(all="ignore"):  # a unit may run away, and is then left out
            part, scatter = _estimate(shared, np.stack(y, axis=2), claims)
            own = part.dof[:, 0]
            carried.append(own if claims is None else carried_jointly(own, claims, scatter))
        parts.append(part)
    found = join_estimates(parts)
    each = np.broadcast_to(np.concatenate(carried)[:, None], found.u.shape)
    return found._replace(u=standard_uncertainty(found.u, found.dof), dof=each)


def _estimate(
    shared: SharedPlacement, values: Array, claims: Claims | None
) -> tuple[Estimates, Array]:
    """Return estimates, whose u are yet U at 95 %, and what readings scatter, τ² (B,)."""
    model, listed = shared.model, shared.listed
    count, n, _ = values.shape
    sound = (np.ptp(values, axis=1) > 0.0).all(axis=1)
    if claims is not None:
        sound &= claims.sound
    variance = _any_noise(values) if claims is None else claims.u**2
    noise = Noise(variance, np.tile(shared.orientation_sd, (count, 1)))
    theta = np.concatenate(
        [values[:, :, i] @ inverse.T for i, inverse in enumerate(shared.inverses)], axis=1
    )
    start = place_at(model, listed, values, theta, np.zeros((count, n, 2)))
    least = ROUNDING**2 * np.einsum("bni,bni->b", values, values)
    sound &= np.einsum("bni,bni->b", *[start.residuals] * 2) > least
    place, ended = search(model, listed, values, start, noise)
    sound &= ended
    chi2 = None if claims is None else objective(place, noise)  # under the stated noise alone
    try:
        judge = _judge_both if shared.estimated else _judge_scatter
        found = judge(shared, values, place, noise, sound, stated=claims is not None)
    except np.linalg.LinAlgError:  # some unit is as good as singular
        nothing = np.full(theta.shape, np.nan)
        found = Alternated(place, noise, nothing, nothing[:, 0], np.zeros_like(sound))
    sound = found.sound
    theta, residuals = found.place.theta, tuple(np.moveaxis(found.place.residuals, 2, 0))
    left = compensated(
        model,
        shared.environment,
        found.place.force,
        model_coefficients(model, theta),
        tuple(np.moveaxis(values, 2, 0)),
        residuals,
    )
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / n)
    sound &= left.sound & (np.abs(theta).max(axis=1) <= LARGEST)
    sound &= np.einsum("bni,bni->b", *[found.place.residuals] * 2) > least
    if sound.any():
        sound[sound] = _are_clear(shared, found, sound)
    dof = np.broadcast_to(found.dof[:, None], theta.shape)
    scatter = (found.noise.variance - variance).mean(axis=(1, 2))
    return Estimates(theta, found.U, dof, rms, residuals, left.inverse, sound, chi2), scatter


def _any_noise(values: Array) -> Array:
    """Return variances (B, n, 3) of any size, as the search takes them where none are stated."""
    spread = values - values.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(spread**2, axis=(1, 2)))
    return np.broadcast_to((RELATIVE_NOISE * size[:, None, None]) ** 2, values.shape).copy()


def _judge_scatter(
    shared: SharedPlacement,
    values: Array,
    place: Place,
    noise: Noise,
    sound: NDArray[np.bool_],
    *,
    stated: bool,
) -> _Found:
    """Return the solutions with the scatter that was found, orientation sds as stated."""
    first = noise
    if not stated:
        first = _least_floor(shared, values, place, noise)
        place, ended = search(shared.model, shared.listed, values, place, first)
        sound = sound & ended
    size, before = typical(first.variance), np.zeros(len(values))

    def judge(units: Places, here: Place, known: Noise) -> Judged[Noise]:
        floor, least = first.variance[units], size[units]
        weighted = objective(here, known) * (least + before[units])
        plain = np.einsum("bni,bni->b", here.residuals, here.residuals)
        posterior = integrate_scatter(
            _about(shared, here, known), floor, shared.dof, (weighted, plain), believed=stated
        )
        tau2 = posterior.summary[0]
        settled = np.abs(tau2 - before[units]) <= SETTLED * (least + before[units])
        before[units] = tau2
        return Judged(posterior, Noise(floor + tau2[:, None, None], known.orientation_sd), settled)

    found = _in_turn(shared, values, place, first, sound, judge)
    if not stated:
        return found
    # beyond that, placement is a floor as well
    explained = objective(found.place, found.noise) <= chi2_quantile(STILL, shared.dof)
    return found._replace(sound=found.sound & explained)


def _judge_both(
    shared: SharedPlacement,
    values: Array,
    place: Place,
    noise: Noise,
    sound: NDArray[np.bool_],
    *,
    stated: bool,
) -> _Found:
    """Return the solutions with the scatter and the placement that were found."""
    first = noise if stated else _least_floor(shared, values, place, noise)
    size, before = typical(first.variance), np.zeros((2, len(values)))

    def judge(units: Places, here: Place, _: Noise) -> Judged[Noise]:
        known = first.of(units)
        both = integrate_scatter_and_placement(
            _about(shared, here, known), known.variance, shared.dof, believed=stated
        )
        tau2, factor = both.posterior.summary[0], both.factor
        now = np.log([size[units] + tau2, factor])
        settled = np.abs(now - before[:, units]).max(axis=0) <= SETTLED_BOTH
        before[:, units] = now
        following = Noise(
            known.variance + tau2[:, None, None],
            known.orientation_sd * np.sqrt(factor)[:, None],
        )
        return Judged(both.posterior, following, settled)

    # where readings are unlike, axes would move with the placement
    sound = sound & _tells_apart(shared, place) & are_alike(first.variance)
    return _in_turn(shared, values, place, first, sound, judge)


def _in_turn(
    shared: SharedPlacement,
    values: Array,
    place: Place,
    first: Noise,
    sound: NDArray[np.bool_],
    judge: Callable[[Places, Place, Noise], Judged[Noise]],
) -> _Found:
    """Judge the noise and search on from there, in turn until it settles; `place` follows."""

    def search_on(units: Places, here: Place, known: Noise) -> tuple[Place, NDArray[np.bool_]]:
        return search(shared.model, shared.listed, values[units], here, known)

    noise = Noise(*(each.copy() for each in first))
    return judge_in_turn(place, noise, sound, len(shared.model.keys), judge, search_on)


def _least_floor(shared: SharedPlacement, values: Array, place: Place, noise: Noise) -> Noise:
    """Return a noise so small that it changes nothing, as `placed_scatter.least_floor`."""
    spread = _about(shared, place, noise).spread
    share = np.where(_tells_apart(shared, place), LEAST_TOLD, LEAST)
    size = share**2 * np.einsum("bnij,bnij->b", spread, spread) / values[0].size
    rounding = np.finfo(float).eps * np.abs(values).max(axis=(1, 2))
    floor = np.maximum(size, rounding**2)
    whole = np.broadcast_to(floor[:, None, None], values.shape).copy()
    return Noise(whole, noise.orientation_sd)


def _tells_apart(shared: SharedPlacement, place: Place) -> NDArray[np.bool_]:
    """Tell of which units readings tell scatter from placement, as `placed_scatter.tells_apart`."""
    count, n, _, p = place.design.shape
    if n - p >= TELLING:  # contrasts are as many at least
        return np.ones(count, dtype=np.bool_)
    J = turns(shared.model, shared.listed, place)
    normal = np.cross(J[..., 0], J[..., 1])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    left = np.einsum("bni,bnip->bnp", normal, place.design)
    left /= np.linalg.norm(place.design, axis=(1, 2))[:, None]
    whole = np.isfinite(left).all(axis=(1, 2))
    left[~whole] = 0.0
    return np.asarray(whole & (n - np.linalg.matrix_rank(left) >= TELLING))


def _about(shared: SharedPlacement, place: Place, noise: Noise) -> About:
    """Return the linear models about solutions, with the turns that `noise` states."""
    J = turns(shared.model, shared.listed, place)
    error = place.residuals + np.einsum("bnij,bnj->bni", J, place.step)
    return About(error, place.design, noise.orientation_sd[:, :, None, None] * J)


def _are_clear(
    shared: SharedPlacement, found: _Found, units: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Tell of which of some units nothing need be doubted that residuals and U tell."""
    place, noise = found.place.of(units), found.noise.of(units)
    information = information_of(shared.model, shared.listed, place, noise)
    scale = np.sqrt(np.einsum("bpp->bp", information))
    sizes = np.linalg.eigvalsh(information / (scale[:, :, None] * scale[:, None, :]))
    clear = sizes[:, 0] > _WORST * sizes[:, -1]
    own = list(shared.model.own_scales)
    length = np.abs(place.theta[:, own])
    clear &= (found.U[units][:, own] < _LOUD * length).all(axis=1)
    clear &= (np.sqrt(noise.variance.mean(axis=1)) < _LOUD * length.min(axis=1)[:, None]).all(
        axis=1
    )
    q = misfits(place, noise)
    n = q.shape[1]
    labels, degrees = [""] * n, np.full(n, float(len(COMPONENTS)))
    for unit in np.flatnonzero(q.max(axis=1) > 4.0 * degrees[0]).tolist():
        clear[unit] &= not find_outlying_positions(q[unit], degrees, shared.dof, labels)
    return np.asarray(clear)

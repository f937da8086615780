"""Uncertain orientations, off by a few degrees at most: B units on positions that they share.

Every unit has the problem of `multipos.estimation.likelihood` at the listed positions,

    F = Σ_k r_k'Σ_k⁻¹r_k + |t_k|²/s_k²,     r_k = y_k − h(θ, ±g E(u_k, t_k)),               (1)

and takes the steps of its eqs. (5) and (6) from the listed directions u_k, undamped at first:
angles t_k of a few degrees bend F by little, and each step leaves a small part of the one before.

`estimate_uncertain` fits many units, all of them in step, with the noise that is stated, or with
one so small that it could only just matter. Excess variance, or with orientation sds to be
estimated excess variance and their common factor, are then integrated over
(`multipos.estimation.orientation_variance`). A unit is left to the fit of one where a search has
not ended, where no excess variance explains the residuals of stated noise, where the positions
separate parameters badly or noise leaves scale factors open, where a position sticks out, and where
readings are too noisy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import (
    ROUNDING,
    Estimates,
    compensated,
    force_slopes,
    join_estimates,
    model_coefficients,
    share_design,
)
from multipos.estimation.likelihood import eliminate
from multipos.estimation.orientation_variance import (
    SEPARATING,
    Block,
    Components,
    Linear,
    contrasts,
    find_both,
    find_excess,
    harmonic_mean,
    least_variance,
)
from multipos.estimation.posteriors import standard_uncertainty
from multipos.estimation.problem import RELATIVE_NOISE, Point, Problem, State
from multipos.estimation.stated_uncertainty import Claims, carried_jointly, take_claims
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array, Places
from multipos.numerics.levenberg_marquardt import Rules, descend
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

STILL = 0.99  # χ² point beyond which an excess variance does not explain residuals
WIDE = np.radians(5.0)  # beyond it the listed directions alone are not trusted for a start
_RULES = Rules(iterations=30, damping=0.0)


class Positions(NamedTuple):
    """What is listed of the positions, repeated for each of B units.

    Attributes
    ----------
    centre : (B n, 3) array
        Listed directions.
    basis : (B n, 3, 2) array
    size : (B n, 1) array [g]
    environment : mapping of str to (n,) array
    """

    centre: Array
    basis: Array
    size: Array
    environment: Mapping[str, Array]

    @classmethod
    def listed(cls, reference: Array, environment: Mapping[str, Array]) -> "Positions":
        """Return those of one unit, from the reference (n, 3) [g]."""
        centre = directions(reference)
        size = np.linalg.norm(reference, axis=1)[:, None]
        return cls(centre, tangent_basis(centre), size, environment)

    def of(self, count: int) -> "Positions":
        """Return those of one unit for `count` units."""
        if count == 1:
            return self
        arrays = (np.concatenate([each] * count) for each in self[:3])
        return Positions(*arrays, self.environment)


class Place(NamedTuple):
    """Units (B) at a point of their search."""

    theta: Array  # (B, p)
    step: Array  # t, (B, n, 2) [rad]
    force: Array  # (B, n, 3) [g]
    design: Array  # A, (B, n, M, p)
    residuals: Array  # (B, n, M)
    q: Array  # what each position adds to F, (B, n)
    objective: Array  # F, (B,)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        return Place(*(each[units] for each in self))

    def put(self, units: Places, other: "Place") -> None:
        """Put other units in places of these."""
        for mine, new in zip(self, other, strict=True):
            mine[units] = new


class _Equations(NamedTuple):
    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    pull: Array  # m of `likelihood`, (B n, 2)
    weighted: Array  # Σ⁻¹J, (B n, M, 2)
    inverse: Array  # H⁻¹, (B n, 2, 2)


@dataclass(frozen=True, eq=False)
class UncertainSearch:
    """What a step of the search needs.

    Attributes
    ----------
    model : Model
    listed : Positions
        Of one unit.
    values, variance : (B, n, M) arrays
        Readings, and Σ.
    orientation_sd : (B, n) array [rad]
    """

    model: Model
    listed: Positions
    values: Array
    variance: Array
    orientation_sd: Array

    rules = _RULES

    @staticmethod
    def fits(problem: Problem) -> bool:
        """Tell whether a problem is one of these: a plain one, of readings of a few degrees."""
        sd = problem.orientation_sd
        return bool(
            problem.robust is None
            and problem.precision.ndim == 2
            and not problem.shared
            and problem.rolls is None
            and type(problem.model) is Model
            and (sd <= WIDE).all()
            and sd.any()
        )

    @classmethod
    def of_problem(cls, problem: Problem) -> Self:
        """Return the search of a problem that `fits`, a batch of one."""
        columns = {name: problem.environment[name] for name in problem.model.environment}
        return cls(
            problem.model,
            Positions.listed(problem.reference, columns),
            problem.values[None],
            1.0 / problem.precision[None],
            problem.orientation_sd[None],
        )

    def begin(self, state: State) -> Place:
        """Return the place of a state."""
        return self.at(state.theta[None], state.step[None])

    def end(self, place: Place, state: State) -> tuple[State, Point]:
        """Return state and point of a place, from the state of the beginning."""
        found = replace(state, theta=place.theta[0], step=place.step[0])
        design = place.design[0]
        blocks = tuple(
            (places, design[:, output, places])
            for output, (_, places) in enumerate(self.model.contributions)
        )
        point = Point(
            place.force[0], blocks, place.residuals[0], place.q[0], float(place.objective[0])
        )
        return found, point

    def of(self, units: Places) -> Self:
        """Return the search of some of the units."""
        return replace(
            self,
            values=self.values[units],
            variance=self.variance[units],
            orientation_sd=self.orientation_sd[units],
        )

    def at(self, theta: Array, step: Array) -> Place:
        """Return units at parameters (B, p) and steps (B, n, 2)."""
        model = self.model
        count, n, m = self.values.shape
        listed = self.listed.of(count)
        force = listed.size * step_on_sphere(listed.centre, listed.basis, step.reshape(-1, 2))
        columns = {name: np.tile(column, count) for name, column in listed.environment.items()}
        phi = model.basis(force, columns).reshape(count, n, -1)
        design = np.zeros((count, n, m, theta.shape[1]))
        for output, (part, own) in enumerate(zip(model.slices, model.columns, strict=True)):
            design[:, :, output, part] = phi[:, :, own]
        residuals = self.values - phi @ model_coefficients(model, theta).transpose(0, 2, 1)
        place = Place(theta, step, force.reshape(count, n, 3), design, residuals, theta, theta)
        return self.under_noise(place)

    def under_noise(self, place: Place) -> Place:
        """Return a place with the misfits that this noise makes of it."""
        q = np.einsum("bni,bni->bn", place.residuals**2, 1.0 / self.variance)
        q += np.einsum("bni,bni->bn", place.step, place.step) * self._prior
        return place._replace(q=q, objective=q.sum(axis=1))

    def linearise(self, place: Place) -> _Equations:
        """Return the normal equations."""
        count, p = place.theta.shape
        m = self.values.shape[2]
        J = self.turns(place).reshape(-1, m, 2)
        precision = (1.0 / self.variance).reshape(-1, m)
        weighted = precision[:, :, None] * J
        prior = self._prior.ravel()
        exact = self.orientation_sd.ravel() == 0.0
        full = precision[:, :, None] * np.eye(m)
        own = eliminate(full, J, weighted, prior, exact, np.zeros_like(exact))
        r = place.residuals.reshape(-1, m)
        pull = np.einsum("nmi,nm->ni", weighted, r) - prior[:, None] * place.step.reshape(-1, 2)
        push = precision * r - np.einsum("nmi,ni->nm", own.gain, pull)
        A = place.design.reshape(-1, m, p)
        WA = (own.marginal @ A).reshape(count, -1, p)
        At = place.design.reshape(count, -1, p).transpose(0, 2, 1)
        gradient = (At @ push.reshape(count, -1, 1))[:, :, 0]
        return _Equations(At @ WA, gradient, pull, weighted, own.inverse)

    def move(self, place: Place, equations: _Equations, step: Array, damping: Array) -> Place:
        """Return places after steps (B, p) of the parameters, each position following."""
        count, n, m = self.values.shape
        design = place.design.reshape(count, -1, step.shape[1])
        follows = (design @ step[:, :, None]).reshape(-1, m)
        back = equations.pull - np.einsum("nmi,nm->ni", equations.weighted, follows)
        own = np.einsum("nij,nj->ni", equations.inverse, back).reshape(count, n, 2)
        own /= (1.0 + damping)[:, None, None]
        return self.at(place.theta + step, place.step + own)

    def turns(self, place: Place) -> Array:
        """Return what the angles of each position do to its reading, J (B, n, M, 2)."""
        count, n, m = self.values.shape
        listed = self.listed.of(count)
        moves = step_derivative(listed.centre, listed.basis, place.step.reshape(-1, 2))
        force = np.ascontiguousarray(place.force.transpose(2, 0, 1))
        slopes = force_slopes(self.model, listed.environment, place.theta, force)
        by_force = slopes.reshape(m, 3, -1).transpose(2, 0, 1)
        return (by_force @ (listed.size[:, :, None] * moves)).reshape(count, n, m, 2)

    @property
    def _prior(self) -> Array:
        """1/s² (B, n); exact positions get 0 here, as nothing of theirs is a step."""
        sd = self.orientation_sd
        return np.where(sd > 0.0, 1.0 / np.where(sd > 0.0, sd, 1.0) ** 2, 0.0)

    def linear(self, place: Place) -> Linear:
        """Return the linear models about places, with this noise."""
        J = self.turns(place)
        error = place.residuals + np.einsum("bnij,bnj->bni", J, place.step)
        spread = self.orientation_sd[:, :, None, None] * J
        return Linear((Block(error, place.design, spread, self.variance),))


def search(start: UncertainSearch, place: Place) -> tuple[Place, NDArray[np.bool_]]:
    """Return where the searches of units end, and of which they do."""
    largest = np.sqrt((start.values**2 / start.variance).max(axis=(1, 2)))
    found, ended = descend(start, place, _RULES, largest)
    return found, ended.converged


class _Units:
    """Units at the end of their searches, whose noise is estimated."""

    def __init__(self, stated: UncertainSearch, search: UncertainSearch, place: Place) -> None:
        self.stated, self.search, self.found = stated, search, place

    @classmethod
    def under_stated(cls, stated: UncertainSearch, place: Place) -> Self:
        """Return units under the stated noise, which changes from here on."""
        sd, variance = stated.orientation_sd.copy(), stated.variance.copy()
        return cls(stated, replace(stated, variance=variance, orientation_sd=sd), place)

    @property
    def size(self) -> Array:
        return harmonic_mean(self.stated.variance)

    def of(self, units: Places) -> "_Units":
        return _Units(self.stated.of(units), self.search.of(units), self.found.of(units))

    def put(self, units: Places, other: "_Units") -> None:
        self.search.variance[units] = other.search.variance
        self.search.orientation_sd[units] = other.search.orientation_sd
        self.found.put(units, other.found)

    def linear(self) -> Linear:
        return self.stated.linear(self.found)

    def squares(self) -> tuple[Array, Array]:
        residuals = self.found.residuals
        return self.found.objective, np.einsum("bni,bni->b", residuals, residuals)

    def searched(self, excess: Array, factor: Array | None) -> tuple["_Units", NDArray[np.bool_]]:
        stated = self.stated
        sd = stated.orientation_sd
        if factor is not None:
            sd = sd * np.sqrt(factor)[:, None]
        variance = stated.variance + excess[:, None, None]
        following = replace(stated, variance=variance, orientation_sd=sd)
        place, ended = search(following, following.under_noise(self.found))
        return _Units(stated, following, place), ended


_AT_ONCE = 1500  # readings of an output, so that what they need stays small
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_NOISY = 0.01  # of a scale factor: noise or U from which on a unit is fitted singly


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
        return Positions.listed(self.reference, self.environment)


def share_placement(
    model: Model,
    reference: Array,
    orientation_sd: Array,
    environment: Mapping[str, Array],
    *,
    estimated: bool,
) -> SharedPlacement | None:
    """Return what units share, or None where a batch does not do what the fit of one does.

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
    uncertain = (orientation_sd <= WIDE).all() and orientation_sd.any()
    if not (triad and uncertain and model.has_all_linear):
        return None
    design = share_design(model, reference, environment)
    spare = len(reference) - len(model.keys)
    if design is None or (spare < SEPARATING and not orientation_sd.all()):
        return None
    return SharedPlacement(
        model, reference, orientation_sd, design.environment, estimated, design.inverses
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
    """Return estimates, whose u are yet U at 95 %, and the excess variance, τ² (B,)."""
    model = shared.model
    count, n, _ = values.shape
    valid = (np.ptp(values, axis=1) > 0.0).all(axis=1)
    if claims is not None:
        valid &= claims.sound
    variance = _any_noise(values) if claims is None else claims.u**2
    sd = np.tile(shared.orientation_sd, (count, 1))
    start = UncertainSearch(model, shared.listed, values, variance, sd)
    theta = np.concatenate(
        [values[:, :, i] @ inverse.T for i, inverse in enumerate(shared.inverses)], axis=1
    )
    place = start.at(theta, np.zeros((count, n, 2)))
    least = ROUNDING**2 * np.einsum("bni,bni->b", values, values)
    valid &= np.einsum("bni,bni->b", *[place.residuals] * 2) > least
    place, ended = search(start, place)
    valid &= ended
    chi2 = None if claims is None else place.objective.copy()  # under the stated noise alone
    try:
        units, found = _with_noise(shared, start, place, valid, stated=claims is not None)
        valid, U, tail, excess = found.valid, found.U, found.dof, found.excess
    except np.linalg.LinAlgError:  # some unit is as good as singular
        units, valid = _Units.under_stated(start, place), np.zeros_like(valid)
        U, tail, excess = np.full(theta.shape, np.nan), *np.full((2, count), np.nan)
    place = units.found
    theta, residuals = place.theta, tuple(np.moveaxis(place.residuals, 2, 0))
    left = compensated(
        model,
        shared.environment,
        place.force,
        model_coefficients(model, theta),
        tuple(np.moveaxis(values, 2, 0)),
        residuals,
    )
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / n)
    valid &= left.sound & (np.abs(theta).max(axis=1) <= LARGEST)
    valid &= np.einsum("bni,bni->b", *[place.residuals] * 2) > least
    some = np.flatnonzero(valid)
    if len(some):
        valid[some] = _are_clear(shared, units.of(some), U[some])
    dof = np.broadcast_to(tail[:, None], theta.shape)
    return Estimates(theta, U, dof, rms, residuals, left.inverse, valid, chi2), excess


def _any_noise(values: Array) -> Array:
    """Return variances (B, n, 3) of any size, as the search takes them where none are stated."""
    spread = values - values.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(spread**2, axis=(1, 2)))
    return np.broadcast_to((RELATIVE_NOISE * size[:, None, None]) ** 2, values.shape).copy()


def _with_noise(
    shared: SharedPlacement,
    start: UncertainSearch,
    place: Place,
    valid: NDArray[np.bool_],
    *,
    stated: bool,
) -> tuple[_Units, Components]:
    """Return the solutions under the noise that is found, and its components."""
    p, dof = len(shared.model.keys), shared.dof
    separated = np.ones_like(valid)
    # where fewer readings are left than that, contrasts are as many at least
    if (shared.estimated or not stated) and len(shared.reference) - p < SEPARATING:
        separated = contrasts(start.linear(place)) >= SEPARATING
    first = start
    if not stated:
        least = least_variance(start.linear(place).spreads, start.values, separated)
        variance = np.broadcast_to(least[:, None, None], start.values.shape).copy()
        first = replace(start, variance=variance)
    if shared.estimated:
        units = _Units.under_stated(first, first.under_noise(place))
        return units, find_both(units, valid & separated, p, dof, stated=stated)
    if not stated:
        place, ended = search(first, first.under_noise(place))
        valid = valid & ended
    units = _Units.under_stated(first, place)
    found = find_excess(units, valid, p, dof, stated=stated)
    if stated:  # beyond that, the stated orientation sds are too small as well
        found.valid &= units.found.objective <= chi2_quantile(STILL, dof)
    return units, found


def _are_clear(shared: SharedPlacement, units: _Units, U: Array) -> NDArray[np.bool_]:
    """Tell of which units nothing need be doubted that residuals and U (B, p) show."""
    place, variance = units.found, units.search.variance
    information = units.search.linearise(place).information
    scale = np.sqrt(np.einsum("bpp->bp", information))
    sizes = np.linalg.eigvalsh(information / (scale[:, :, None] * scale[:, None, :]))
    clear = sizes[:, 0] > _WORST * sizes[:, -1]
    own = list(shared.model.own_scales)
    length = np.abs(place.theta[:, own])
    clear &= (U[:, own] < _NOISY * length).all(axis=1)
    sd = np.sqrt(variance.mean(axis=1))
    clear &= (sd < _NOISY * length.min(axis=1)[:, None]).all(axis=1)
    q = place.q
    n = q.shape[1]
    labels, degrees = [""] * n, np.full(n, float(len(COMPONENTS)))
    for unit in np.flatnonzero(q.max(axis=1) > 4.0 * degrees[0]).tolist():
        clear[unit] &= not find_outlying_positions(q[unit], degrees, shared.dof, labels)
    return np.asarray(clear)

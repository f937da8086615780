"""Uncertain orientations, off by a few degrees at most: B units on positions that they share.

`share_orientations` is what units share, and `estimate_uncertain` fits them.

Every unit has the problem of `multipos.estimation.likelihood` at the listed positions,

    F = Σ_k r_k'Σ_k⁻¹r_k + |t_k|²/s_k²,     r_k = y_k − h(θ, ±g E(u_k, t_k)),               (1)

and takes the steps of its eqs. (5) and (6) from the listed directions u_k, hardly damped at first:
angles t_k of a few degrees bend F by little, and each step leaves a small part of the one before.

`estimate_uncertain` fits many units, all of them in step; their variance components are integrated
over (`multipos.estimation.variances`). A unit is left to the fit of one where a search has not
ended, where the positions separate parameters badly or noise leaves scale factors open, where a
position sticks out, and where readings are too noisy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from multipos.estimation.batches import (
    Estimates,
    Solution,
    compensated,
    join_estimates,
    model_coefficients,
)
from multipos.estimation.known import ROUNDING, share_design
from multipos.estimation.likelihood import eliminate, full
from multipos.estimation.problem import RELATIVE_NOISE, Point, Problem, State
from multipos.estimation.stated_uncertainty import StatedNoise, combined_jointly, taken_by_blocks
from multipos.estimation.unknown_orientations import Place, SearchedUnits, combined, search
from multipos.estimation.variances import SEPARATING, Block, Linear, StatedComponents, estimate
from multipos.files.records import LARGEST
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.numerics.levenberg_marquardt import Rules
from multipos.numerics.quantiles import coverage_factors
from multipos.numerics.rotations import directions, step_derivative, step_on_sphere, tangent_basis
from multipos.results import frozen
from multipos.sensor.model import Model
from multipos.sensor.studentised import find_outlying_positions, square_beyond, studentised_squares

WIDE = np.radians(5.0)  # beyond it the listed directions alone are not trusted for a start
_STICKS_OUT = 5e-4  # probability that chance makes the largest residual of an output as large
_FREE = 3.0  # degrees of freedom without which none sticks out
_RULES = Rules(iterations=30, damping=1e-6)


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
        centre = np.asfortranarray(directions(reference))
        size = np.linalg.norm(reference, axis=1)[:, None]
        return cls(centre, tangent_basis(centre), size, environment)

    def of(self, count: int) -> "Positions":
        """Return those of one unit for `count` units."""
        if count == 1:
            return self
        centre, basis, size = (np.tile(each.T, count).T for each in self[:3])
        return Positions(centre, basis, size, self.environment)


class _Equations(NamedTuple):
    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    angle_gradient: Array  # m of `likelihood`, (B n, 2)
    weighted: Array  # Σ⁻¹J, (B n, M, 2)
    inverse: Array  # H⁻¹, (B n, 2, 2)
    marginal: Array  # W, (M, M, B, n)


@frozen
class UncertainSearch:
    """What a step of the search needs.

    Attributes
    ----------
    model : Model
    listed : Positions
        Of one unit.
    values, variance : (M, B, n) arrays
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
        """Return whether a problem is one of these: plain, and off by a few degrees at most."""
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
        columns = {name: problem.environment[name] for name in problem.model.fitted_columns}
        return cls(
            problem.model,
            Positions.listed(problem.reference, columns),
            problem.values.T[:, None],
            1.0 / problem.precision.T[:, None],
            problem.orientation_sd[None],
        )

    def begin(self, state: State) -> Place:
        """Return the place of a state."""
        return self.at(state.theta[None], state.step.T[:, None])

    def end(self, place: Place, state: State) -> tuple[State, Point]:
        """Return state and point of a place, from the state of the beginning."""
        found = replace(state, theta=place.theta[0], step=place.step[:, 0].T)
        return found, place.point(self.model)

    def of(self, units: Places) -> Self:
        """Return the search of some of the units."""
        return replace(
            self,
            values=self.values[:, units],
            variance=self.variance[:, units],
            orientation_sd=self.orientation_sd[units],
        )

    def at(self, theta: Array, step: Array) -> Place:
        """Return units at parameters (B, p) and steps (2, B, n)."""
        return self._at(theta, model_coefficients(self.model, theta), step)

    def _at(self, theta: Array, coefficients: Array, step: Array) -> Place:
        _, count, n = step.shape
        listed = self.listed.of(count)
        moved = step_on_sphere(listed.centre, listed.basis, step.reshape(2, -1).T)
        force = np.ascontiguousarray((listed.size * moved).T)
        columns = {name: np.tile(column, count) for name, column in listed.environment.items()}
        phi = self.model.basis(force.T, columns).T.reshape(-1, count, n)
        residuals = self.values - combined(coefficients, phi)
        misfits = self._misfits(residuals, step)
        force = force.reshape(3, count, n)
        return Place(theta, coefficients, *misfits, step, force, phi, residuals)

    def under_noise(self, place: Place) -> Place:
        """Return a place with the misfits that this noise makes of it."""
        q, objective = self._misfits(place.residuals, place.step)
        return place._replace(q=q, objective=objective)

    def _misfits(self, residuals: Array, step: Array) -> tuple[Array, Array]:
        q = np.einsum("mbn,mbn->bn", residuals, residuals / self.variance)
        q += np.einsum("ibn,ibn->bn", step, step) * self._prior
        return q, q.sum(axis=1)

    def linearise(self, place: Place) -> _Equations:
        """Return the normal equations."""
        shape = self.values.shape
        m = shape[0]
        jacobian = self.jacobian(place).reshape(m, 2, -1).transpose(2, 0, 1)
        precision = (1.0 / self.variance).reshape(m, -1).T
        weighted = precision[:, :, None] * jacobian
        prior, exact = self._prior.ravel(), self.orientation_sd.ravel() == 0.0
        own = eliminate(full(precision), jacobian, weighted, prior, exact, np.zeros_like(exact))
        residuals = place.residuals.reshape(m, -1).T
        angle_gradient = np.einsum("nmi,nm->ni", weighted, residuals)
        angle_gradient -= prior[:, None] * place.step.reshape(2, -1).T
        reduced = precision * residuals - np.einsum("nmi,ni->nm", own.gain, angle_gradient)
        marginal = own.marginal.transpose(1, 2, 0).reshape(m, *shape)
        found = self._assembled(place, marginal, reduced.T.reshape(shape))
        return _Equations(*found, angle_gradient, weighted, own.inverse, marginal)

    def _assembled(self, place: Place, marginal: Array, reduced: Array) -> tuple[Array, Array]:
        """Return S and g of W (M, M, B, n) and what pushes the outputs (M, B, n)."""
        (count, p), (m, width) = place.theta.shape, (len(reduced), len(place.phi))
        phi = np.ascontiguousarray(place.phi.transpose(1, 2, 0))
        pairs = (phi[:, :, :, None] * phi[:, :, None]).reshape(*phi.shape[:2], -1)
        both = marginal.reshape(m * m, count, -1).transpose(1, 0, 2) @ pairs
        both = both.reshape(count, m, m, width, width).transpose(0, 1, 3, 2, 4)
        both = both.reshape(count, m * width, m * width)
        along = (reduced.transpose(1, 0, 2) @ phi).reshape(count, -1)
        own, places = self._columns
        both, along = both[:, own[:, None], own], along[:, own]
        if len(places) == p:
            order = np.argsort(places)
            return both[:, order[:, None], order], along[:, order]
        shared = np.eye(p)[places]  # a parameter of several columns
        return shared.T @ both @ shared, along @ shared

    @property
    def _columns(self) -> tuple[Places, Places]:
        """Return the columns that outputs use, among those of all outputs, and their parameters."""
        width, each = len(self.model.basis_terms), self.model.contributions
        own = [output * width + columns for output, (columns, _) in enumerate(each)]
        return np.concatenate(own), np.concatenate([places for _, places in each])

    def move(self, place: Place, equations: _Equations, step: Array, damping: Array) -> Place:
        """Return places after steps (B, p) of the parameters, each position following."""
        change = model_coefficients(self.model, step)
        follows = combined(change, place.phi).reshape(len(self.values), -1).T
        back = equations.angle_gradient - np.einsum("nmi,nm->ni", equations.weighted, follows)
        own = np.einsum("nij,nj->in", equations.inverse, back).reshape(place.step.shape)
        steps = place.step + own / (1.0 + damping)[:, None]
        return self._at(place.theta + step, place.coefficients + change, steps)

    def jacobian(self, place: Place) -> Array:
        """Return what the angles of each position do to its reading, J (M, 2, B, n)."""
        _, count, n = place.step.shape
        listed = self.listed.of(count)
        moves = step_derivative(listed.centre, listed.basis, place.step.reshape(2, -1).T)
        moves = (listed.size[:, :, None] * moves).transpose(1, 2, 0).reshape(3, 2, count, n)
        by_force = self.model.force_slopes(place.coefficients, place.force, listed.environment)
        return np.asarray(np.einsum("mkbn,kibn->mibn", by_force, moves))

    def solution(self, place: Place, equations: _Equations) -> Solution:
        """Return units about places."""
        outputs, columns, copies = self.model.rows
        marginal = equations.marginal
        slopes = marginal.take(outputs, axis=1) * place.phi.take(columns, axis=0)
        for parameter, output, column in copies:
            slopes[:, parameter] += marginal[:, output] * place.phi[column]
        push = place.residuals / self.variance
        of_units = marginal, slopes, equations.information, push, self.variance, place.force
        return Solution(*of_units, place.objective)

    @property
    def _prior(self) -> Array:
        """1/s² (B, n); exact positions get 0 here, as nothing of theirs is a step."""
        sd = self.orientation_sd
        return np.where(sd > 0.0, 1.0 / np.where(sd > 0.0, sd, 1.0) ** 2, 0.0)

    def linear(self, place: Place) -> Linear:
        """Return the linear models about places, with this noise."""
        m, count, n = self.values.shape
        jacobian = self.jacobian(place)
        error = place.residuals + np.einsum("mibn,ibn->mbn", jacobian, place.step)
        spread = (self.orientation_sd * jacobian).transpose(2, 3, 0, 1)
        design = np.zeros((count, n, m, place.theta.shape[1]))
        for output, (columns, places) in enumerate(self.model.contributions):
            design[:, :, output, places] = place.phi.take(columns, axis=0).transpose(1, 2, 0)
        variance = np.moveaxis(self.variance, 0, 2)
        return Linear((Block(np.moveaxis(error, 0, 2), design, spread, variance),))


class _Units(SearchedUnits):
    @classmethod
    def under_stated(cls, first: UncertainSearch, place: Place, *, stated: bool) -> Self:
        """Return units under the first noise, which changes from here on."""
        sd, variance = first.orientation_sd.copy(), first.variance.copy()
        search = replace(first, variance=variance, orientation_sd=sd)
        return cls(first, search, place, stated=stated)

    def put(self, units: Places, other: Self) -> None:
        super().put(units, other)
        self.search.orientation_sd[units] = other.search.orientation_sd

    def linear(self) -> Linear:
        found: Linear = self.first.linear(self.found)
        return found if self.stated else found.without_noise()

    def searched(self, noise: Array, factor: Array | None) -> tuple[Self, Mask]:
        sd = self.first.orientation_sd
        if factor is not None:
            sd = sd * np.sqrt(factor)[:, None]
        return self.under(variance=self.with_noise(noise), orientation_sd=sd)


_AT_ONCE = 3000  # readings of an output, so that what they need stays small
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_NOISY = 0.01  # of a scale factor: noise or U from which on a unit is fitted singly


@frozen
class SharedOrientations:
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
    leverage : (M, n) array
        There.
    """

    model: Model
    reference: Array
    orientation_sd: Array
    environment: Mapping[str, Array]
    estimated: bool
    inverses: tuple[Array, ...]
    leverage: Array

    @property
    def dof(self) -> float:
        """Degrees of freedom that the parameters leave."""
        return float(len(COMPONENTS) * len(self.reference) - len(self.model.keys))

    def given(self, *, stated: bool) -> StatedComponents:
        """Return what is stated of the noise."""
        few = len(self.reference) < SEPARATING
        return StatedComponents(stated, "free" if self.estimated else "centre", few)

    @property
    def listed(self) -> Positions:
        """The positions."""
        return Positions.listed(self.reference, self.environment)


def share_orientations(
    model: Model,
    reference: Array,
    orientation_sd: Array,
    environment: Mapping[str, Array],
    *,
    estimated: bool,
) -> SharedOrientations | None:
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
    spare = len(COMPONENTS) * len(reference) - len(model.keys)
    if not design.well_posed or spare < 1 or len(reference) < SEPARATING:
        return None
    inverses = tuple(design.inverses)
    leverage = np.array(
        [np.einsum("np,pn->n", *each) for each in zip(design.designs, inverses, strict=True)]
    )
    return SharedOrientations(
        model, reference, orientation_sd, design.environment, estimated, inverses, leverage
    )


def estimate_uncertain(
    shared: SharedOrientations,
    values: Sequence[Array],
    stated: Sequence[Array],
    stated_dof: Sequence[Array],
) -> Estimates:
    """Fit B units at uncertain orientations.

    Parameters
    ----------
    shared : SharedOrientations
    values : sequence of 3 arrays (B, n)
        Readings of each output.
    stated : sequence of 3 arrays (B, n), or of none
        Their standard uncertainties.
    stated_dof : sequence of 3 arrays (B, n), or of none
        Degrees of freedom of those.
    """
    parts = []
    for y, noise in taken_by_blocks(values, stated, stated_dof, _AT_ONCE):
        with np.errstate(all="ignore"):  # a unit may run away, and is then left out
            part, scatter = _estimate(shared, y, noise)
            u = part.u / coverage_factors(0.95, part.dof)
            if noise is not None:
                part = part._replace(dof=combined_jointly(part.dof, noise, scatter))
        parts.append(part._replace(u=u))
    return join_estimates(parts)


def _estimate(
    shared: SharedOrientations, values: Array, noise: StatedNoise | None
) -> tuple[Estimates, Array]:
    """Return estimates, whose u are yet U at 95 %, and the noise beside what is stated (B, M)."""
    model = shared.model
    _, count, n = values.shape
    valid = (np.ptp(values, axis=2) > 0.0).all(axis=0)
    if noise is not None:
        valid &= noise.sound
    variance = _any_noise(values) if noise is None else np.moveaxis(noise.u**2, 2, 0).copy()
    sd = np.tile(shared.orientation_sd, (count, 1))
    start = UncertainSearch(model, shared.listed, values, variance, sd)
    theta = np.concatenate(
        [y @ inverse.T for y, inverse in zip(values, shared.inverses, strict=True)], axis=1
    )
    place = start.at(theta, np.zeros((2, count, n)))
    valid &= ~_stick_out(shared, place.residuals)
    least = ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    valid &= np.einsum("mbn,mbn->b", *[place.residuals] * 2) > least
    place, ended = search(start, place)
    valid &= ended
    chi2 = None
    units = _Units.under_stated(start, place, stated=noise is not None)
    try:
        found = estimate(units, valid, shared.given(stated=noise is not None))
        valid, U, dof, excess = found.valid, found.U, found.dof, found.noise
        if noise is not None:  # of what the stated noise alone leaves
            same = units.of(np.arange(count))  # which a search would move
            chi2 = same.searched(np.zeros_like(excess), found.factor)[0].found.objective
    except np.linalg.LinAlgError:  # some unit is as good as singular
        valid = np.zeros_like(valid)
        U, dof, excess = np.full(theta.shape, np.nan), *np.full((2, *theta.shape), np.nan)
    place = units.found
    theta, residuals = place.theta, place.residuals
    left = compensated(
        model,
        shared.environment,
        place.force.transpose(1, 2, 0),
        model_coefficients(model, theta),
        values,
        residuals,
    )
    rms = np.sqrt(np.einsum("bnk,bnk->b", left.force, left.force) / n)
    valid &= left.inverted.sound & (np.abs(theta).max(axis=1) <= LARGEST)
    valid &= np.einsum("mbn,mbn->b", *[place.residuals] * 2) > least
    some, equations = np.flatnonzero(valid), units.search.linearise(place)
    if len(some):
        valid[some] = _are_clear(shared, units.of(some), U[some], equations.information[some])
    of_units = Estimates(theta, U, dof, rms, residuals, *left.inverted[:2], valid, chi2)
    return of_units._replace(solutions=(units.search.solution(place, equations),)), excess


def _stick_out(shared: SharedOrientations, residuals: Array) -> Mask:
    """Return of which units (B,) a reading sticks out from those at the positions as listed.

    Where positions are better than was stated they would take up what it is off.
    """
    sd, h = shared.orientation_sd, shared.leverage
    dof = np.rint(h.shape[1] - h.sum(axis=1))[:, None]
    if np.ptp(sd) > 0.0 or dof.min() < _FREE:
        return np.zeros(residuals.shape[1], dtype=np.bool_)
    most = [[square_beyond(_STICKS_OUT / h.size, nu)] for nu in dof[:, 0].tolist()]
    largest = studentised_squares(residuals, h[:, None], dof[:, None]).max(axis=2)
    return np.asarray((largest > most).any(axis=0))


def _any_noise(values: Array) -> Array:
    """Return variances (3, B, n) of any size, as the search takes them where none are stated."""
    spread = values - values.mean(axis=2, keepdims=True)
    size = np.sqrt(np.mean(spread**2, axis=(0, 2)))
    return np.broadcast_to((RELATIVE_NOISE * size[:, None]) ** 2, values.shape).copy()


def _are_clear(shared: SharedOrientations, units: _Units, U: Array, information: Array) -> Mask:
    """Return of which units residuals, U (B, p) and S (B, p, p) raise no doubt."""
    place, variance = units.found, units.search.variance
    scale = np.sqrt(np.einsum("bpp->bp", information))
    sizes = np.linalg.eigvalsh(information / (scale[:, :, None] * scale[:, None, :]))
    clear = sizes[:, 0] > _WORST * sizes[:, -1]
    own = list(shared.model.own_scales)
    length = np.abs(place.theta[:, own])
    clear &= (U[:, own] < _NOISY * length).all(axis=1)
    sd = np.sqrt(variance.mean(axis=2))
    clear &= (sd < _NOISY * length.min(axis=1)).all(axis=0)
    q = place.q
    n = q.shape[1]
    labels, degrees = [""] * n, np.full(n, float(len(COMPONENTS)))
    for unit in np.flatnonzero(q.max(axis=1) > 4.0 * degrees[0]).tolist():
        clear[unit] &= not find_outlying_positions(q[unit], degrees, shared.dof, labels)
    return np.asarray(clear)

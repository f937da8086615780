"""Units at the end of their searches: as linear models, and under another noise.

`Units` are what `multipos.estimation.variances` estimates the noise of, one or many, and
`linear_model` are the linear models about an optimum. `pose_units` is the problem of many units and
`state_of` a point of its search; `by_unit` parts rows, and `solution_of` is what tests of many
units begin from. Where nothing is known of any position and three outputs see it, W of
`multipos.estimation.likelihood` is what lies along the normal of the surface that the readings of
all directions form: with G = dh/df,

    W = m m',      m = n/√(n'Σn),      n = det(G) G⁻ᵀ f.                                    (1)
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from multipos.estimation import descent, likelihood
from multipos.estimation.batches import Solution
from multipos.estimation.problem import Optimum, Point, Problem, State, with_units
from multipos.estimation.variances import Block, Linear
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.numerics.rotations import cross_matrix, tangent_basis
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model

FINEST = 1e-15  # of the largest reading, below which no noise is
WIDEST = 1.0  # [rad], beyond which an orientation is as good as unknown
_RANK = 1e-7  # of the largest singular value, scaled, below which nothing is determined


class Units:
    """Units whose searches have ended: with the noise stated first, or one of any size."""

    def __init__(self, first: Problem, problem: Problem, optimum: Optimum, *, stated: bool) -> None:
        """Take the problem under the first noise, and under the present one."""
        self.first, self.problem, self.optimum, self.stated = first, problem, optimum, stated

    def of(self, units: Places) -> "Units":
        """Return some of the units."""
        if len(units) == self.first.units:
            return Units(self.first, self.problem, self.optimum, stated=self.stated)
        parts = self.first.of(units), self.problem.of(units), self.optimum.of(units)
        return Units(*parts, stated=self.stated)

    def put(self, units: Places, other: "Units") -> None:
        """Put other units in places of these."""
        if len(units) == self.first.units:
            self.problem, self.optimum = other.problem, other.optimum
            return
        self.problem = self.problem.under_noise_of(units, other.problem)
        mine, theirs = ((each.state, each.point) for each in (self.optimum, other.optimum))
        state, point = with_units(mine, units, theirs)
        self.optimum = replace(self.optimum, state=state, point=point)

    def linear(self) -> Linear:
        """Return the linear models about the solutions, with the stated noise and spreads."""
        found = linear_model(self.first, self.optimum)
        return found if self.stated else found.without_noise()

    def searched(self, noise: Array, factor: Array | None) -> tuple["Units", Mask]:
        """Return units under noise (B, M) beside what is stated and F (B,), and which ended."""
        n = len(self.first.values) // self.first.units
        problem = replace(self.first, precision=self._precision(np.repeat(noise, n, axis=0)))
        if factor is not None:
            sd = self.first.orientation_sd * np.repeat(np.sqrt(factor), n)
            sd = np.where(np.isfinite(sd), np.minimum(sd, WIDEST), sd)
            problem = replace(problem, orientation_sd=sd)
        optimum = descent.resume(problem, self.optimum)
        one = optimum.state.theta.ndim == 1
        ended = np.ones(1, dtype=np.bool_) if one else optimum.converged
        return Units(self.first, problem, optimum, stated=self.stated), ended

    def _precision(self, noise: Array) -> Array:
        """Return the precision of readings of noise (n, M) beside what is stated of them."""
        first = self.first
        if not self.stated:
            least = (FINEST * float(np.abs(first.values).max())) ** 2
            return 1.0 / np.maximum(noise, least)
        if first.precision.ndim == 2:
            return np.asarray(1.0 / (1.0 / first.precision + noise))
        eye = np.eye(noise.shape[1])
        return np.asarray(np.linalg.inv(_covariances(first) + noise[:, :, None] * eye))


def linear_model(problem: Problem, optimum: Optimum) -> Linear:
    """Return the linear models about an optimum, with the variances that `problem` states.

    Positions are taken by how many combinations of their readings no free angle moves.
    """
    state, point, units = optimum.state, optimum.point, problem.units
    normal = likelihood.linearise(problem, state, point)
    theta = likelihood.parameters_of(problem, state)
    slopes = parameter_jacobian(problem.model, theta, point.force, problem.environment)
    error = point.residuals + np.einsum("nmi,ni->nm", normal.jacobian, state.step)
    design = np.concatenate([slopes, normal.shared], axis=2)
    sd = np.where(problem.tied, problem.orientation_sd, 0.0)[:, None, None]
    spread = sd * normal.jacobian * np.where(problem.rolled[:, None, None], [0.0, 1.0], 1.0)
    plain = problem.precision.ndim == 2
    variance = 1.0 / problem.precision if plain else _covariances(problem)
    turned = _turned_by_labels(problem, optimum) if problem.repeats else None
    blocks = []
    free = np.where(problem.unknown, 2, np.where(problem.rolled, 1, 0))
    for count in (0, 1, 2):
        rows = free == count
        if rows.any():
            block = (error[rows], design[rows], spread[rows], variance[rows])
            part = _without_free(*block, normal.jacobian[rows, :, :count], units)
            if turned is not None and not count:
                label = None if problem.label is None else problem.label[rows]
                part = part._replace(turned=turned[None, rows], label=label)
            blocks.append(part)
    return _identifiable(problem, theta, tuple(blocks))


def _turned_by_labels(problem: Problem, optimum: Optimum) -> Array:
    """Return what a rotation of a position by one sd of its orientation does (n, M, 3)."""
    state, force = optimum.state, optimum.point.force
    by_force = problem.model.force_jacobian(state.theta, force, problem.environment)
    sd = np.where(problem.tied, problem.orientation_sd, 0.0)
    return np.asarray(-sd[:, None, None] * (by_force @ cross_matrix(force)))


def _without_free(
    error: Array, design: Array, spread: Array, variance: Array, free: Array, units: int
) -> Block:
    """Return a block of combinations of its readings that free angles (k, M, c) do not move."""

    def of_units(rows: Array) -> Array:
        """Return rows (B k, …) by unit (B, k, …)."""
        return rows.reshape(units, -1, *rows.shape[1:])

    if not free.shape[2]:
        return Block(of_units(error), of_units(design), of_units(spread), of_units(variance))
    axes = np.linalg.svd(free)[0].transpose(0, 2, 1)[:, free.shape[2] :]
    full = variance if variance.ndim == 3 else variance[:, :, None] * np.eye(len(axes[0, 0]))
    left = axes @ full @ axes.transpose(0, 2, 1)
    error = np.einsum("krm,km->kr", axes, error)
    rest = of_units(axes @ design), of_units(axes @ spread), of_units(left)
    return Block(of_units(error), *rest, of_units(axes))


def _identifiable(problem: Problem, theta: Array, blocks: tuple[Block, ...]) -> Linear:
    """Return the linear model with priors, without combinations that nothing determines.

    Such as a rotation about the only direction of a group.
    """
    p, P = theta.shape[-1], blocks[0].design.shape[3]
    tied = problem.has_parameter_prior or problem.level_sd > 0.0
    if p == P and not tied:
        return Linear(blocks)
    prior, gradient, penalty = np.zeros(P), np.zeros(P), 0.0
    if problem.has_parameter_prior:
        excess, slope = problem.model.belief(theta)
        prior[:p], gradient[:p], penalty = slope**2, -slope * excess, float(excess @ excess)
    if problem.level_sd > 0.0:
        prior[-2:] = 1.0 / problem.level_sd**2
    if p == P:
        return Linear(blocks, np.diag(prior), gradient, penalty)
    sd = 1.0 / np.sqrt(
        median(
            problem.precision
            if problem.precision.ndim == 2
            else np.einsum("nmm->nm", problem.precision)
        )
    )
    rows = [block.design.reshape(-1, P) / sd for block in blocks]
    whole = np.concatenate([*rows, np.diag(np.sqrt(prior))])
    scale = np.linalg.norm(whole, axis=0)
    scale = 1.0 / np.where(scale > 0.0, scale, 1.0)
    _, sizes, vectors = np.linalg.svd(whole * scale, full_matrices=False)
    outer = scale[:, None] * vectors[sizes > _RANK * sizes[0]].T
    reduced = tuple(block._replace(design=block.design @ outer) for block in blocks)
    information = outer.T @ (prior[:, None] * outer)
    return Linear(reduced, information, outer.T @ gradient, penalty, outer[:p])


def pose_units(
    model: Model,
    reference: Array,
    orientation_sd: Array,
    environment: Mapping[str, Array],
    values: Array,
    variance: Array,
) -> Problem:
    """Return the problem of units that share their positions.

    Parameters
    ----------
    model : Model
    reference : (n, 3) array [g]
    orientation_sd : (n,) array [rad]
    environment : mapping of str to (n,) array
    values, variance : (M, B, n) arrays
        Readings, and the variances that weigh them.
    """
    m, count, n = values.shape
    columns = {name: environment[name] for name in model.fitted_columns}
    return Problem(
        model=model,
        values=values.reshape(m, -1).T,
        environment={name: np.tile(column, count) for name, column in columns.items()},
        precision=(1.0 / variance).reshape(m, -1).T,
        reference=np.tile(reference.T, count).T,
        orientation_sd=np.tile(orientation_sd, count),
        group=np.full(count * n, -1),
        weight=np.ones(count * n),
        units=count,
    )


def state_of(problem: Problem, theta: Array, centre: Array) -> State:
    """Return units at parameters (B, p) and directions (B n, 3)."""
    none = np.zeros((0, 3, 3)), np.zeros(2), np.zeros(0)
    step = np.zeros((len(centre), 2), order="F")
    return State(theta, centre, tangent_basis(centre), step, *none)


def by_unit(rows: Array, units: int) -> Array:
    """Return rows (B n, k) as (k, B, n)."""
    return rows.T.reshape(rows.shape[1], units, -1)


def solution_of(problem: Problem, optimum: Optimum) -> Solution:
    """Return units about an optimum."""
    state, point, units = optimum.state, optimum.point, problem.units
    normal = likelihood.linearise(problem, state, point)
    A = parameter_jacobian(problem.model, state.theta, point.force, problem.environment)
    W = normal.marginal
    weights = W.transpose(1, 2, 0).reshape(*W.shape[1:], units, -1)
    slopes = (W @ A).transpose(1, 2, 0).reshape(*A.shape[1:], units, -1)
    normals = rows = None
    if problem.unknown.all() and A.shape[1] == 3:
        m = _normals(problem, state, point, W)
        normals = by_unit(m, units)
        rows = by_unit(np.einsum("nm,nmp->np", m, A), units).swapaxes(0, 1)
    return Solution(
        weights,
        slopes,
        normal.information,
        push=by_unit(point.residuals * problem.precision, units),
        variance=by_unit(1.0 / problem.precision, units),
        force=by_unit(point.force, units),
        objective=np.asarray(point.objective),
        normal=normals,
        rows=rows,
    )


def _normals(problem: Problem, state: State, point: Point, W: Array) -> Array:
    """Return m (n, M) of eq. (1), from W itself."""
    rows, largest = np.arange(len(W)), np.einsum("nmm->nm", W).argmax(axis=1)
    m = W[rows, :, largest] / np.sqrt(W[rows, largest, largest])[:, None]
    by_force = problem.model.force_jacobian(state.theta, point.force, problem.environment)
    outward = np.einsum("nm,nmi,ni->n", m, by_force, point.force)
    return np.asarray(m * np.copysign(1.0, outward)[:, None])


def _covariances(problem: Problem) -> Array:
    """Return the stated covariance of each position (n, M, M)."""
    if problem.precision.ndim == 3:
        return np.asarray(np.linalg.inv(problem.precision))
    return np.asarray((1.0 / problem.precision)[:, :, None] * np.eye(problem.values.shape[1]))

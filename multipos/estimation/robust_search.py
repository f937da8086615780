"""The search under a robust loss at known orientations, of one unit or of many at once.

From the plain fit b₀ of an output with exact residuals r₀ (`multipos.estimation.batches`) the
residuals at b₀ + d are r = r₀ − X d, whose rounding is relative to them, and d takes the steps of
`multipos.estimation.descent`,

    (S + λ diag S) Δ = X'W r,    S = X'W X,    W = diag ρ'(q_k)/σ_k²,    q_k = r_k²/σ_k²,  (1)

until the next one would take less than 10⁻¹⁴ off F = Σ ρ(q_k). As ρ bends down, no such step leads
up but by rounding, where a search has come to its end. A unit that has ended is left out of the
steps that follow, so that it takes the same ones alone and among others.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.known import fit_output
from multipos.estimation.problem import Optimum, Point, Problem, State
from multipos.numerics.arrays import Array, Places
from multipos.numerics.losses import Loss, loss, loss_weight
from multipos.sensor.model import Model

_ITERATIONS = 2000  # weights that change with the step make convergence linear
_DAMPING = 1e-4
_DECREMENT = 1e-14  # of F, by the next step
_XTOL = 1e-13  # relative step that is only rounding
_ROUNDING = 1e-8  # of F: what rounding can do
_LAST_STEPS = 2  # where it does, towards where the slope of F vanishes
_ALONE = np.zeros(1, dtype=np.intp)  # the one unit of a batch of one


@dataclass(frozen=True, eq=False)
class Linear:
    """One output of B units at known positions.

    Attributes
    ----------
    design : (n, p) array
    plain : (B, p) array
        Parameters of the plain fit.
    residuals : (B, n) array
        Of the plain fit.
    """

    design: Array
    plain: Array
    residuals: Array

    @cached_property
    def squares(self) -> Array:
        """Products of the columns of the design (n, p²)."""
        products = self.design[:, :, None] * self.design[:, None, :]
        return products.reshape(len(self.design), -1)

    @cached_property
    def degrees(self) -> Array:
        """Degrees of freedom of each reading."""
        return np.ones(len(self.design))

    def information(self, weight: Array) -> Array:
        """Return S of weights (B, n)."""
        if len(weight) == 1:
            return np.asarray((self.design.T * weight) @ self.design)[None]
        p = self.design.shape[1]
        return (weight @ self.squares).reshape(-1, p, p)


class Ended(NamedTuple):
    """Where the searches of B units ended, and how."""

    moves: Array  # d, from the plain fit (B, p)
    residuals: Array  # (B, n)
    converged: NDArray[np.bool_]
    iterations: Places
    last_step: Array  # relative, (B,)
    decrement: Array  # (B,)


def search_linear(
    linear: Linear, moves: Array, variance: Array, units: Places, name: Loss
) -> Ended:
    """Return where the searches of some units end, eq. (1); the others stay.

    Parameters
    ----------
    linear : Linear
    moves : (B, p) array
        From the plain fit, where they begin.
    variance : (B, n) array
    units : array of int
    name : str
        Of the loss.
    """
    count = len(moves)
    moves = moves.copy()
    converged, stuck = np.zeros((2, count), dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.intp)
    last_step, decrement = np.full((2, count), np.inf)
    here = _Spot.of(linear, moves, variance, units, name)
    before, damping = np.zeros(len(units)), _DAMPING
    for turn in range(_ITERATIONS):
        if not len(units):
            break
        step = _step(linear, here, damping, name)
        trial = here.moved(linear, step.moves, name)
        up = trial.objective > here.objective
        following = step.decrement * np.fmin(step.decrement / before, 1.0)
        over = up | (following <= _DECREMENT * trial.objective) | (step.relative <= _XTOL)
        before = step.decrement
        damping *= 0.1
        if over.any():
            mine, lost = units[over], up[over]
            moves[mine] = np.where(up[:, None], here.moves, trial.moves)[over]
            stuck[mine] = lost & (before <= _ROUNDING * here.objective)[over]
            converged[mine] = stuck[mine] | ~lost
            iterations[mine] = turn + 1
            last_step[mine], decrement[mine] = step.relative[over], before[over]
            units, before, trial = units[~over], before[~over], trial.some(~over)
        here = trial
    units = np.flatnonzero(stuck)
    for _ in range(_LAST_STEPS if len(units) else 0):
        here = _Spot.of(linear, moves, variance, units, name)
        moves[units] += _step(linear, here, 0.0, name).moves
    residuals = linear.residuals - moves @ linear.design.T
    return Ended(moves, residuals, converged, iterations, last_step, decrement)


class _Spot(NamedTuple):
    """Some units at a point of their search."""

    plain: Array  # b₀, (B, p)
    first: Array  # r₀, (B, n)
    variance: Array  # (B, n)
    moves: Array  # d, (B, p)
    residuals: Array  # r, (B, n)
    q: Array  # (B, n)
    objective: Array  # F, (B,)

    @classmethod
    def of(
        cls, linear: Linear, moves: Array, variance: Array, units: Places, name: Loss
    ) -> "_Spot":
        """Return some of the units at moves (B, p)."""
        first = linear.residuals[units]
        empty = np.zeros(0)
        start = cls(linear.plain[units], first, variance[units], moves[units], empty, empty, empty)
        return start.moved(linear, np.zeros_like(start.moves), name)

    def moved(self, linear: Linear, by: Array, name: Loss) -> "_Spot":
        """Return the units after steps (B, p)."""
        moves = self.moves + by
        r = self.first - moves @ linear.design.T
        q = r * r / self.variance
        F = loss(name, q, linear.degrees).sum(axis=1)
        return _Spot(self.plain, self.first, self.variance, moves, r, q, F)

    def some(self, which: NDArray[np.bool_]) -> "_Spot":
        """Return some of the units."""
        return _Spot(*(each[which] for each in self))


class _Step(NamedTuple):
    moves: Array  # Δ, (B, p)
    decrement: Array  # what it should take off F, (B,)
    relative: Array  # its size, (B,)


def _step(linear: Linear, here: _Spot, damping: float, name: Loss) -> _Step:
    """Return damped steps from where units are."""
    weight = loss_weight(name, here.q, linear.degrees) / here.variance
    information = linear.information(weight)
    gradient = (weight * here.residuals) @ linear.design
    scale = np.sqrt(np.einsum("bpp->bp", information))
    damped = information / (scale[:, :, None] * scale[:, None, :])
    p = scale.shape[1]
    damped.reshape(-1, p * p)[:, :: p + 1] += max(damping, 1e-15)
    whole = np.isfinite(damped).all(axis=(1, 2))
    if not whole.all():
        damped[~whole] = np.eye(p)
    scaled = np.linalg.solve(damped, (gradient / scale)[:, :, None])[:, :, 0]
    step = scaled / scale
    size = np.abs((here.plain + here.moves) * scale).max(axis=1)
    relative = np.abs(scaled).max(axis=1) / np.maximum(size, 1e-300)
    return _Step(step, np.einsum("bp,bp->b", step, gradient), relative)


def fits(problem: Problem) -> bool:
    """Tell whether a problem is one output under a loss, linear and at exact positions."""
    exact = bool(problem.exact.all()) and not problem.shared and not problem.has_parameter_prior
    alone = problem.values.shape[1] == 1 and problem.precision.ndim == 2
    return problem.robust is not None and exact and alone and type(problem.model) is Model


def search_alone(problem: Problem, state: State) -> Optimum:
    """Return where the search of a problem that `fits` ends, as a batch of one."""
    assert problem.robust is not None
    force = np.asfortranarray(problem.magnitude[:, None] * state.centre)
    _, blocks = problem.model.respond(state.theta, force, problem.environment)
    _, X = blocks[0]
    Q, R = np.linalg.qr(X)
    b, r = fit_output(X, np.linalg.inv(R) @ Q.T, problem.values.T)
    variance = 1.0 / problem.precision.T
    ended = search_linear(Linear(X, b, r), state.theta - b, variance, _ALONE, problem.robust)
    residuals = ended.residuals.T
    q = residuals[:, 0] ** 2 / variance[0]
    total = float(loss(problem.robust, q, problem.degrees).sum())
    return Optimum(
        replace(state, theta=(b + ended.moves)[0]),
        Point(force, blocks, residuals, q, total),
        bool(ended.converged[0]),
        int(ended.iterations[0]),
        float(ended.last_step[0]),
        float(np.sqrt(max(ended.decrement[0], 0.0))),
    )

"""The minimum of F, eq. (4) of `multipos.estimation.likelihood`, by the search that fits a problem.

`maximise` searches from a state and `resume` from an optimum whose noise has changed.

All go the steps of `multipos.numerics.levenberg_marquardt`, and differ in their normal equations:

- all positions unknown: one number a position (`multipos.estimation.unknown_orientations`);
- all listed, uncertain by a few degrees: `multipos.estimation.uncertain_orientations`;
- all exact, of any model: with residuals r_i of output i, their slopes A_i by the parameters,
  weights W_i = diag(w/σ_i²), w of a robust loss, and priors of precision b about m,

      S = Σ_i A_i' W_i A_i + diag(b),    g = Σ_i A_i' W_i r_i − b (p − m),                  (1)

  which are eqs. (5), (6) of `likelihood` with no angles to eliminate;
- everything else, and where the second finds no end: those equations themselves.

The first two are the searches of many units, here of one.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.likelihood import evaluate, linearise, moved, recentred
from multipos.estimation.problem import Normal, Optimum, Point, Problem, State
from multipos.estimation.uncertain_orientations import UncertainSearch
from multipos.estimation.unknown_orientations import UnknownSearch
from multipos.numerics.arrays import Array, Places
from multipos.numerics.levenberg_marquardt import ROBUST, STRICT, Ended, Rules, descend
from multipos.numerics.losses import loss, loss_weight
from multipos.sensor.model import Block


def maximise(problem: Problem, state: State, decrement: float = STRICT) -> Optimum:
    """Maximise the likelihood from a state; parameters with bounds by what has none."""
    model = problem.model
    if model.bounded:
        inner = replace(problem, model=model.unbounded())
        found = _maximise(inner, replace(state, theta=model.inward(state.theta)), decrement)
        back = replace(found.state, theta=model.outward(found.state.theta)[0])
        return replace(found, state=back, point=evaluate(problem, back))
    return _maximise(problem, state, decrement)


def resume(problem: Problem, optimum: Optimum, decrement: float = STRICT) -> Optimum:
    """Search on from an optimum, after the noise of the problem was changed."""
    found = maximise(problem, optimum.state, decrement)
    return replace(found, iterations=optimum.iterations + found.iterations)


def _maximise(problem: Problem, state: State, decrement: float) -> Optimum:
    largest = np.array([_largest(problem)])
    rules = Rules(decrement=decrement) if problem.robust is None else ROBUST
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a trial may run away
        if UnknownSearch.fits(problem):
            unknown = UnknownSearch.of_problem(problem)
            place, ended = descend(unknown, unknown.begin(state), rules, largest, problem.held)
            return _optimum(*unknown.end(place, state), ended)
        if UncertainSearch.fits(problem):
            uncertain = UncertainSearch.of_problem(problem)
            own = uncertain.rules._replace(decrement=decrement)
            at, ended = descend(uncertain, uncertain.begin(state), own, largest, problem.held)
            if ended.converged[0]:
                return _optimum(*uncertain.end(at, state), ended)
        one = _Exact(problem) if _Exact.fits(problem) else _General(problem)
        there, ended = descend(one, one.begin(state), rules, largest, problem.held)
        return _optimum(there.state, there.point, ended)


def _optimum(state: State, point: Point, ended: Ended) -> Optimum:
    return Optimum(
        state,
        point,
        bool(ended.converged[0]),
        int(ended.iterations[0]),
        float(ended.last_step[0]),
        float(ended.gradient[0]),
    )


def _largest(problem: Problem) -> float:
    """Return the largest reading in units of its noise."""
    precision = problem.precision
    if precision.ndim == 3:
        precision = np.einsum("nii->ni", precision)
    return float(np.sqrt((problem.values**2 * precision).max()))


@dataclass(eq=False)
class _At:
    """A state with the model there, as a batch of one."""

    state: State
    point: Point

    @property
    def theta(self) -> Array:
        return self.state.theta[None]

    @property
    def objective(self) -> Array:
        return np.array([self.point.objective])

    def of(self, units: NDArray[Any]) -> Self:
        return self

    def put(self, units: Places, other: Self) -> None:
        if len(units):
            self.state, self.point = other.state, other.point


class _Equations(NamedTuple):
    """The normal equations of one problem."""

    information: Array  # (1, P, P)
    gradient: Array  # (1, P)
    normal: Normal | None = None


class _General:
    """What a step needs of any problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def of(self, units: Places) -> Self:
        return self

    def begin(self, state: State) -> _At:
        return _At(state, evaluate(self.problem, state))

    def linearise(self, at: _At) -> _Equations:
        normal = linearise(self.problem, at.state, at.point)
        information = self._bent(at, normal.information, normal.gradient)
        return _Equations(information[None], normal.gradient[None], normal)

    def _bent(self, at: _At, information: Array, gradient: Array) -> Array:
        """Return S (P, P) with the curvature of bounds that parameters are searched within."""
        model, p = self.problem.model, len(at.state.theta)
        bent = model.bend(at.state.theta, gradient[:p])
        if bent.any():
            information = information.copy()
            information.flat[: p * len(information) : len(information) + 1] += bent
        return information

    def move(self, at: _At, equations: _Equations, step: Array, damping: Array) -> _At:
        assert equations.normal is not None
        by = float(damping[0])
        state = moved(self.problem, at.state, at.point, equations.normal, step[0], by)
        return self.begin(recentred(self.problem, state))


class _Exact(_General):
    """What a step needs where all positions are exact, and outputs uncorrelated: eq. (1)."""

    @staticmethod
    def fits(problem: Problem) -> bool:
        exact = bool(problem.exact.all()) and not problem.shared
        return exact and problem.precision.ndim == 2

    def begin(self, state: State) -> _At:
        problem, theta = self.problem, state.theta
        force = np.asfortranarray(problem.magnitude[:, None] * state.centre)
        return self._at(state, theta, force)

    def linearise(self, at: _At) -> _Equations:
        problem, theta, point = self.problem, at.state.theta, at.point
        information, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        weights = problem.precision
        if problem.robust is not None:
            weights = weights * loss_weight(problem.robust, point.q, problem.degrees)[:, None]
        for output, (places, slopes) in enumerate(point.blocks):
            weighted = slopes.T * weights[:, output]
            information[places[:, None], places] += weighted @ slopes
            gradient[places] += weighted @ point.residuals[:, output]
        if problem.has_parameter_prior:
            excess, slope = problem.model.belief(theta)
            information.flat[:: len(theta) + 1] += slope**2
            gradient -= slope * excess
        return _Equations(self._bent(at, information, gradient)[None], gradient[None])

    def move(self, at: _At, equations: _Equations, step: Array, damping: Array) -> _At:
        return self._at(at.state, at.state.theta + step[0], at.point.force)

    def _at(self, state: State, theta: Array, force: Array) -> _At:
        problem = self.problem
        blocks: tuple[Block, ...]
        outputs, blocks = problem.model.respond(theta, force, problem.environment)
        residuals = problem.values - outputs
        q = np.einsum("nm,nm->n", residuals, problem.precision * residuals)
        total = q if problem.robust is None else loss(problem.robust, q, problem.degrees)
        objective = float(np.sum(total))
        if problem.has_parameter_prior:
            objective += float(np.sum(problem.model.belief(theta)[0] ** 2))
        return _At(replace(state, theta=theta), Point(force, blocks, residuals, q, objective))

"""Levenberg and Marquardt's search for the minimum of F, eq. (4) of `likelihood`.

Each step d solves the normal equations with the diagonal of S, scaled to one, raised by the
damping; it is taken if F falls, and tried again with ten times the damping if not. What a step
should take off F is g'd, its decrement. The search has converged when the decrement of the
*next* step, judged by how the last two shrank, is below 1e-16 F: a step of 1e-8 u or less.

The search where every orientation is exact: Gauss and Newton's, with nothing to eliminate.

With residuals r_i of output i, their slopes A_i by the parameters, weights W_i = diag(w/σ_i²), w of
a robust loss, and priors b,

    S = Σ_i A_i' W_i A_i + diag(b),    g = Σ_i A_i' W_i r_i − b (p − m),                     (1)

which are eqs. (5), (6) of `multipos.estimation.likelihood` with no t_k in them: what costs most
there, the elimination of every position, is nothing here.

References
----------
K. Levenberg 1944; D. Marquardt 1963.
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, Protocol

import numpy as np

from multipos.estimation import robust_search
from multipos.estimation.likelihood import evaluate, linearise, moved, recentred
from multipos.estimation.losses import loss, loss_weight
from multipos.estimation.problem import Normal, Optimum, Point, Problem, State
from multipos.estimation.sphere import SphereSearch, Surface
from multipos.numerics.arrays import Array
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Block


@dataclass(frozen=True, eq=False)
class Spot:
    """Parameters with the model there."""

    theta: Array
    point: Point

    @property
    def objective(self) -> float:
        """F, what is made least."""
        return self.point.objective


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations (1)."""

    information: Array
    gradient: Array


class ExactSearch:
    """What a step of the search needs, for problems that `fits` accepts."""

    def __init__(self, problem: Problem, state: State) -> None:
        self.problem = problem
        self.force = np.asfortranarray(problem.magnitude[:, None] * state.centre)

    @staticmethod
    def fits(problem: Problem) -> bool:
        """Tell whether all positions are exact, and the outputs uncorrelated."""
        exact = bool(problem.exact.all()) and not problem.shared
        return exact and problem.precision.ndim == 2

    def begin(self, state: State) -> Spot:
        """Return the spot of a state."""
        return self._at(state.theta)

    def end(self, spot: Spot, state: State) -> tuple[State, Point]:
        """Return the state and point of a spot."""
        return replace(state, theta=spot.theta), spot.point

    def linearise(self, spot: Spot) -> Equations:
        """Return eq. (1)."""
        problem, theta, point = self.problem, spot.theta, spot.point
        information, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        weights = problem.precision
        if problem.robust is not None:
            weights = weights * loss_weight(problem.robust, point.q, problem.degrees)[:, None]
        for output, (places, slopes) in enumerate(point.blocks):
            weighted = slopes.T * weights[:, output]
            information[places[:, None], places] += weighted @ slopes
            gradient[places] += weighted @ point.residuals[:, output]
        if problem.believed:
            excess, slope = problem.model.belief(theta)
            information.flat[:: len(theta) + 1] += slope**2
            gradient -= slope * excess
        return Equations(information, gradient)

    def move(self, spot: Spot, equations: Equations, step: Array, damping: float) -> Spot:
        """Return the spot a step away."""
        return self._at(spot.theta + step)

    def _at(self, theta: Array) -> Spot:
        problem = self.problem
        blocks: tuple[Block, ...]
        outputs, blocks = problem.model.respond(theta, self.force, problem.environment)
        residuals = problem.values - outputs
        q = np.einsum("nm,nm->n", residuals, problem.precision * residuals)
        total = q if problem.robust is None else loss(problem.robust, q, problem.degrees)
        objective = float(np.sum(total))
        if problem.believed:
            objective += float(np.sum(problem.model.belief(theta)[0] ** 2))
        return Spot(theta, Point(self.force, blocks, residuals, q, objective))


_ITERATIONS = 200
_DECREMENT = 1e-16  # of F
# Weights that change with the step make convergence linear, and slow where few positions are more
# than there are parameters.
_ITERATIONS_ROBUST = 2000
_DECREMENT_ROBUST = 1e-14
_XTOL = 1e-13  # relative step that is only rounding
_DAMPING = 1e-4
_STUCK = 1e12  # damping beyond which nothing moves
_FLAT = 1e-15  # of F, below which a step is lost in the rounding of F
_SMALL = 1e-6  # of theta: no step into what the positions cannot tell is as short
_LAST_STEPS = 2
_NO_RISE = 1e-12  # of F: what its rounding may do at least, in which an undamped step is lost
_DIGITS = 8.0 * np.finfo(float).eps  # of a reading, which its residual may be off
_ROUNDING = 1e-8  # of F, or of theta: what the last digits of the readings can do


def maximise(problem: Problem, state: State) -> Optimum:
    """Maximise the likelihood from a state; parameters with bounds by what has none."""
    model = problem.model
    if isinstance(model, ExpressionModel) and model.bounded:
        inner = replace(problem, model=replace(model, inner=True))
        found = _maximise(inner, replace(state, theta=model.inward(state.theta)))
        back = replace(found.state, theta=model.outward(found.state.theta)[0])
        return replace(found, state=back, point=evaluate(problem, back))
    return _maximise(problem, state)


def _maximise(problem: Problem, state: State) -> Optimum:
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a trial may run away
        if SphereSearch.fits(problem):
            sphere = SphereSearch(problem)
            place, end = _descend(sphere, sphere.begin(state), problem)
            state, point = sphere.end(place, state)
        elif robust_search.fits(problem):
            return robust_search.search_alone(problem, state)
        elif ExactSearch.fits(problem):
            exact = ExactSearch(problem, state)
            spot, end = _descend(exact, exact.begin(state), problem)
            state, point = exact.end(spot, state)
        else:
            everywhere = _Search(problem)
            at, end = _descend(everywhere, everywhere.begin(state), problem)
            state, point = at.state, at.point
        return Optimum(state, point, *end)


def resume(problem: Problem, optimum: Optimum) -> Optimum:
    """Search on from an optimum, after the noise of the problem was changed."""
    found = maximise(problem, optimum.state)
    return replace(found, iterations=optimum.iterations + found.iterations)


class _Steps(Protocol):
    """What the search asks for: places with `theta` and `objective`, equations with S and g."""

    def linearise(self, place: Any) -> Any: ...

    def move(self, place: Any, equations: Any, step: Array, damping: float) -> Any: ...


def _descend(
    steps: _Steps, place: Any, problem: Problem
) -> tuple[Any, tuple[bool, int, float, float]]:
    """Return where the search ends: converged, iterations, last step, gradient in units of u."""
    damping, decrement, last_step = _DAMPING, np.inf, np.inf
    plain = problem.robust is None
    enough = _DECREMENT if plain else _DECREMENT_ROBUST
    most = _ITERATIONS if plain else _ITERATIONS_ROBUST
    held, size = list(problem.held), _largest(problem)
    converged, iterations, refused = False, 0, False
    while iterations < most and not converged:
        iterations += 1
        before = decrement
        equations = steps.linearise(place)
        while True:
            step, decrement, last_step = _step(place.theta, equations, damping, held)
            trial = steps.move(place, equations, step, damping)
            if trial.objective <= place.objective or damping > _STUCK:
                break
            refused = True
            flat = decrement <= _FLAT * place.objective  # a shorter step has less to take off
            if plain and not flat:  # of a robust loss small steps add up
                whole = _step(place.theta, equations, 0.0, held)[1]
                flat = whole <= _rise(size, place)
            damping = 10.0 * _STUCK if flat else max(damping * 10.0, 1e-10)
        if damping > _STUCK:  # no descent is left: rounding, or a point that is no minimum
            _, decrement, last_step = _step(place.theta, equations, 0.0, held)
            converged = decrement <= _ROUNDING * place.objective or last_step <= _ROUNDING
            break
        place = trial
        damping *= 0.1
        following = decrement if np.isinf(before) else decrement * min(decrement / before, 1.0)
        converged = following <= enough * place.objective or last_step <= _XTOL
    if converged and refused and last_step <= _SMALL:
        place = _settled(steps, place, held, size)
    return place, (converged, iterations, last_step, float(np.sqrt(max(decrement, 0.0))))


def _largest(problem: Problem) -> float:
    """Return the largest reading in units of its noise."""
    precision = problem.precision
    if precision.ndim == 3:
        precision = np.einsum("nii->ni", precision)
    return float(np.sqrt((problem.values**2 * precision).max()))


def _rise(size: float, place: Any) -> float:
    """Return how far F may rise by rounding where the largest reading has a size."""
    F = float(place.objective)
    return max(_NO_RISE * F, _DIGITS * size * sqrt(F))


def _settled(steps: _Steps, place: Any, held: list[int], size: float) -> Any:
    """Return the place where the slope of F vanishes, of which F itself tells half the digits."""
    for _ in range(_LAST_STEPS):
        equations = steps.linearise(place)
        trial = steps.move(place, equations, _step(place.theta, equations, 0.0, held)[0], 0.0)
        if not trial.objective <= place.objective + _rise(size, place):
            break  # into what nothing tells, as a parameter that is at its bound
        place = trial
    return place


def _step(
    theta: Array, equations: Normal | Surface | Equations, damping: float, held: list[int]
) -> tuple[Array, float, float]:
    """Return the damped step, what it should take off F, and its size relative to theta."""
    information, gradient = equations.information, equations.gradient
    if held:  # no step along these, and the others as if these had no columns
        information, gradient = information.copy(), gradient.copy()
        information[held, :] = information[:, held] = 0.0
        information[held, held], gradient[held] = 1.0, 0.0
    scale = np.sqrt(information.diagonal())
    if not scale.all():
        scale = np.where(scale > 0.0, scale, 1.0)
    damped = information / (scale * scale[:, None])
    # A ridge of rounding size, so that what the positions cannot tell is left where it is.
    damped.flat[:: len(scale) + 1] += max(damping, 1e-15)
    scaled = np.linalg.solve(damped, gradient / scale)
    step = scaled / scale
    size = np.abs(theta * scale[: len(theta)]).max()
    relative = float(np.abs(scaled).max() / max(float(size), 1e-300))
    return step, float(step @ gradient), relative


@dataclass(frozen=True)
class _At:
    """A state with the model there."""

    state: State
    point: Point

    @property
    def theta(self) -> Array:
        return self.state.theta

    @property
    def objective(self) -> float:
        return self.point.objective


class _Search:
    """What a step of the search needs, for any problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def begin(self, state: State) -> _At:
        return _At(state, evaluate(self.problem, state))

    def linearise(self, place: _At) -> Normal:
        return linearise(self.problem, place.state, place.point)

    def move(self, place: _At, normal: Normal, step: Array, damping: float) -> _At:
        state = moved(self.problem, place.state, place.point, normal, step, damping)
        return self.begin(recentred(self.problem, state))

"""The search where every orientation is exact: Gauss and Newton's, with nothing to eliminate.

With residuals r_i of output i, their slopes A_i by the parameters, weights W_i = diag(w/σ_i²), w of
a robust loss, and priors b,

    S = Σ_i A_i' W_i A_i + diag(b),    g = Σ_i A_i' W_i r_i − b (p − m),                     (1)

which are eqs. (5), (6) of `multipos.estimation.likelihood` with no t_k in them: what costs most
there, the elimination of every position, is nothing here.
"""

from dataclasses import dataclass, replace

import numpy as np

from multipos.estimation.losses import loss, loss_weight
from multipos.estimation.problem import Point, Problem, State
from multipos.numerics.arrays import Array
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

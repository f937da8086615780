"""Unknown orientation of a triad: the search of `likelihood` with one number a position.

Where nothing is known of any position and three outputs see it, what is left of a reading after
its two angles are eliminated is its part along the normal of the surface that the readings of
all directions form. With G = dh/df at the force f,

    W = m m',      m = n/sqrt(n' Sigma n),      n = det(G) G^-T f,                          (1)
    S = sum a a',  a = A' m,                    S d = sum a m'r,                            (2)

and the direction follows along the surface, which no projection is needed for:

    df = G^-1 (x − Sigma m m'x),                x = r − A d,        f'df = 0.               (3)

That is `multipos.estimation.likelihood` at s = inf to the digit, in a fifth of its operations; a
test holds the two together. Arrays here are (3, n), positions last.
"""

from dataclasses import dataclass, replace

import numpy as np

from multipos.estimation.losses import loss, loss_weight
from multipos.estimation.problem import Point, Problem, State
from multipos.numerics.arrays import Array
from multipos.numerics.factoring import cofactors_of
from multipos.numerics.rotations import step_on_sphere, tangent_basis
from multipos.sensor.model import Model


@dataclass(frozen=True, eq=False)
class Place:
    """The model and objective at a point of the search."""

    theta: Array  # (p,)
    force: Array  # (3, n) [g]
    phi: Array  # (T, n), terms of the model
    residuals: Array  # (3, n)
    q: Array  # (n,)
    objective: float


@dataclass(frozen=True, eq=False)
class Surface:
    """The normal equations at a place, eqs. (1), (2)."""

    information: Array  # (p, p)
    gradient: Array  # (p,)
    rows: Array  # a, (p, n)
    height: Array  # m'r, (n,)
    cofactors: Array  # (3, 3, n), of G
    determinant: Array  # (n,)
    normal: Array  # m, (3, n)
    across: Array  # Sigma m, (3, n)
    excess: Array  # (n,), how far outside a reading lies, relative to the force


def is_along_force(problem: Problem) -> bool:
    """Tell whether all positions of a triad are unknown and its outputs uncorrelated: one row each.

    W is then that of eq. (1).
    """
    return bool(
        problem.unknown.all()
        and problem.precision.ndim == 2
        and problem.values.shape[1] == 3
        and not problem.shared
    )


class SphereSearch:
    """What a step of the search needs, for problems that `fits` accepts."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.values, self.precision = problem.values.T, problem.precision.T
        self.variance = 1.0 / self.precision

    @staticmethod
    def fits(problem: Problem) -> bool:
        """Tell whether all positions of a triad are unknown and its outputs uncorrelated."""
        return is_along_force(problem) and type(problem.model) is Model

    def begin(self, state: State) -> Place:
        """Return the place of a state."""
        direction = step_on_sphere(state.centre, state.basis, state.step)
        return self._at(state.theta, self.problem.magnitude * direction.T)

    def place(self, state: State, point: Point) -> Place:
        """Return the place of a state at which the model is known."""
        phi = self.problem.model.basis(point.force, self.problem.environment).T
        residuals = point.residuals.T
        return Place(state.theta, point.force.T, phi, residuals, point.q, point.objective)

    def end(self, place: Place, state: State) -> tuple[State, Point]:
        """Return state and point of a place, from the state of the beginning."""
        centre = (place.force / self.problem.magnitude).T
        found = replace(
            state,
            theta=place.theta,
            centre=centre,
            basis=tangent_basis(centre),
            step=np.zeros_like(state.step),
        )
        return found, self.point(place)

    def point(self, place: Place) -> Point:
        """Return a place as other searches have it."""
        blocks = tuple(
            (places, place.phi.take(columns, axis=0).T)
            for columns, places in self.problem.model.contributions
        )
        return Point(place.force.T, blocks, place.residuals.T, place.q, place.objective)

    def linearise(self, place: Place) -> Surface:
        """Return the normal equations of eqs. (1), (2), weighted by the loss."""
        problem = self.problem
        slopes = problem.model.force_jacobian(place.theta, place.force.T, problem.environment)
        G = slopes.transpose(1, 2, 0)
        cofactors = cofactors_of(G)
        determinant = np.einsum("in,in->n", G[0], cofactors[0])
        normal = np.einsum("min,in->mn", cofactors, place.force)
        across = self.variance * normal
        height = np.einsum("mn,mn->n", normal, place.residuals)
        excess = height / (determinant * problem.magnitude**2)
        root = 1.0 / np.sqrt(np.einsum("mn,mn->n", normal, across))
        normal = normal * root
        outputs, columns, copies = problem.model.rows
        rows = normal.take(outputs, axis=0) * place.phi.take(columns, axis=0)
        for parameter, output, column in copies:
            rows[parameter] += normal[output] * place.phi[column]
        height = height * root
        weighted = rows
        if problem.robust is not None:
            weighted = rows * loss_weight(problem.robust, place.q, problem.degrees)
        return Surface(
            weighted @ rows.T,
            weighted @ height,
            rows,
            height,
            cofactors,
            determinant,
            normal,
            across * root,
            excess,
        )

    def move(self, place: Place, surface: Surface, step: Array, damping: float) -> Place:
        """Return the place after a step of the parameters, directions following by eq. (3)."""
        change = self.problem.model.coefficients(step)
        left = place.residuals - change @ place.phi
        left -= surface.across * np.einsum("mn,mn->n", surface.normal, left)
        turn = np.einsum("min,mn->in", surface.cofactors, left) / surface.determinant
        # as in `multipos.estimation.likelihood`: damped like the rest, and eased far outside the
        # sphere
        force = place.force + turn / ((1.0 + damping) * (1.0 + np.maximum(surface.excess, 0.0)))
        force *= self.problem.magnitude / np.sqrt(np.einsum("in,in->n", force, force))
        return self._at(place.theta + step, force)

    def _at(self, theta: Array, force: Array) -> Place:
        problem, model = self.problem, self.problem.model
        phi = model.basis(force.T, problem.environment).T
        residuals = self.values - model.coefficients(theta) @ phi
        q = np.einsum("mn,mn->n", residuals, self.precision * residuals)
        total = q if problem.robust is None else loss(problem.robust, q, problem.degrees)
        return Place(theta, force, phi, residuals, q, float(total.sum()))

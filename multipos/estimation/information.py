"""The Fisher information at a state, and the sums that judge parameters which were not fitted.

`information_at` returns it for a problem. Uncertainties, leverages and tests of terms that a model
lacks are functions of a few sums at the solution. With W_k and S of
`multipos.estimation.likelihood`, A_k the slopes of the readings by all unknowns, and Z_k those by
anything else, they are

    A'WA = S,   Z'WZ,   A'WZ,   A'Σ⁻¹r,   Z'Σ⁻¹r,   diag(W A C A'),   W,   W A.             (1)

Where nothing is known of any position of a triad (`UnknownSearch.fits`), W_k is m_k m_k' of
`multipos.estimation.unknown_orientations`, and Σ_k⁻¹r_k is W_k r_k at the solution: each position
is one row A_k'm_k then, and the sums are products of these rows. A test compares the two ways.
"""

from typing import NamedTuple, Protocol

import numpy as np

from multipos.estimation.likelihood import assemble, evaluate, linearise, weigh
from multipos.estimation.problem import Point, Problem, State
from multipos.estimation.unknown_orientations import UnknownSearch, is_along_force
from multipos.numerics.arrays import Array, Places
from multipos.numerics.losses import loss_weight


class OtherSlopes(NamedTuple):
    """The sums of eq. (1) with other slopes Z, q columns, in them."""

    gram: Array  # Z'WZ, (q, q)
    cross: Array  # A'WZ, (p + shared, q)
    own: Array  # A'Σ⁻¹r, (p + shared,)
    score: Array  # Z'Σ⁻¹r, (q,)


class FisherInformation(Protocol):
    """The sums of eq. (1) at a point."""

    point: Point
    information: Array  # S with priors, (p + shared, p + shared)

    def with_slopes(self, columns: Array, output_of: Places) -> OtherSlopes:
        """Return the sums with slopes Z (q, n), each of one output."""

    def leverage(self, covariance: Array) -> Array:
        """Return the diagonal of W A C A' (n, M), C (p, p) of the parameters."""

    def weighted(self) -> tuple[Array, Array]:
        """Return W (M, M, n) and W A (M, p + shared, n)."""


def information_at(problem: Problem, state: State, point: Point | None = None) -> FisherInformation:
    """Return the sums at a state; the model is evaluated there unless its point is given."""
    kind = _OneRow if UnknownSearch.fits(problem) else _General
    return kind(problem, state, point)


class _OneRow:
    """The sums for a triad of unknown orientation, each position by its part along the normal m."""

    def __init__(self, problem: Problem, state: State, point: Point | None) -> None:
        sphere = UnknownSearch.of_problem(problem)
        place = sphere.begin(state) if point is None else sphere.place(state, point)
        self.point = place.point(problem.model) if point is None else point
        with np.errstate(all="ignore"):  # as the search: dh/df may have no inverse somewhere
            surface = sphere.linearise(place)
        self.information, self.gradient = surface.information[0], surface.gradient[0]
        self.normal, self.rows, self.height = (
            surface.normal[:, 0],
            surface.rows[0],
            surface.height[0],
        )
        self.precision = problem.precision
        if problem.robust is not None:
            root = np.sqrt(loss_weight(problem.robust, place.q[0], problem.degrees))
            self.normal, self.rows, self.height = (
                root * each for each in (self.normal, self.rows, self.height)
            )

    def with_slopes(self, columns: Array, output_of: Places) -> OtherSlopes:
        rows = self.normal.take(output_of, axis=0) * columns
        return OtherSlopes(rows @ rows.T, self.rows @ rows.T, self.gradient, rows @ self.height)

    def leverage(self, covariance: Array) -> Array:
        moved = covariance @ self.rows
        own = [np.einsum("np,pn->n", slopes, moved[places]) for places, slopes in self.point.blocks]
        return np.asarray((self.normal * own).T)

    def weighted(self) -> tuple[Array, Array]:
        return self.normal[:, None] * self.normal, self.normal[:, None] * self.rows


class _General:
    """The sums for any problem, by the marginal weights W of every position."""

    def __init__(self, problem: Problem, state: State, point: Point | None) -> None:
        self.point = evaluate(problem, state) if point is None else point
        with np.errstate(all="ignore"):  # a search may have ended beyond all numbers
            normal = linearise(problem, state, self.point)
        self.information, self.shared = normal.information, normal.shared
        self.marginal = normal.marginal
        self.weighted_residuals = weigh(problem.precision, self.point.residuals)
        self.p = len(state.theta)
        self.along_force = is_along_force(problem)
        self.precision = problem.precision

    def with_slopes(self, columns: Array, output_of: Places) -> OtherSlopes:
        p, end = self.p, self.p + len(columns)
        blocks = []
        for output, (places, slopes) in enumerate(self.point.blocks):
            mine = np.flatnonzero(output_of == output)
            both = np.concatenate([slopes.T, columns[mine]]).T
            blocks.append((np.concatenate([places, p + mine]), both))
        whole, right = assemble(end, blocks, self.marginal, self.weighted_residuals, self.shared)
        unknown = np.r_[:p, end : len(right)]
        other = slice(p, end)
        return OtherSlopes(whole[other, other], whole[unknown, other], right[unknown], right[other])

    def leverage(self, covariance: Array) -> Array:
        result = np.zeros(self.weighted_residuals.shape)
        for i, (places, mine) in enumerate(self.point.blocks):
            for j, (targets, other) in enumerate(self.point.blocks):
                moved = other @ covariance[targets[:, None], places]
                result[:, i] += self.marginal[:, i, j] * np.einsum("np,np->n", moved, mine)
        return result

    def weighted(self) -> tuple[Array, Array]:
        n, m = self.weighted_residuals.shape
        A = np.zeros((n, m, len(self.information)))
        for output, (places, slopes) in enumerate(self.point.blocks):
            A[:, output, places] = slopes
        A[:, :, self.p :] = self.shared
        return self.marginal.transpose(1, 2, 0), (self.marginal @ A).transpose(1, 2, 0)

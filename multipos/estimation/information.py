"""The Fisher information at a state, and the sums that judge parameters which were not fitted.

`FisherInformation` has them for a problem. Uncertainties, leverages and tests of terms that a model
lacks are functions of a few sums at the solution. With W_k and S of
`multipos.estimation.likelihood`, A_k the slopes of the readings by all unknowns, and Z_k those by
anything else, they are

    A'WA = S,   Z'WZ,   A'WZ,   A'Σ⁻¹r,   Z'Σ⁻¹r,   diag(W A C A'),   W,   W A.             (1)
"""

from typing import NamedTuple

import numpy as np

from multipos.estimation.likelihood import assemble, evaluate, linearise, weigh
from multipos.estimation.problem import Point, Problem, State
from multipos.numerics.arrays import Array, Places


class OtherSlopes(NamedTuple):
    """The sums of eq. (1) with other slopes Z, q columns, in them."""

    gram: Array  # Z'WZ, (q, q)
    cross: Array  # A'WZ, (p + shared, q)
    own: Array  # A'Σ⁻¹r, (p + shared,)
    score: Array  # Z'Σ⁻¹r, (q,)


class FisherInformation:
    """The sums of eq. (1) at a point."""

    def __init__(self, problem: Problem, state: State, point: Point | None = None) -> None:
        """Take the sums at a state; the model is evaluated there unless its point is given."""
        self.point = evaluate(problem, state) if point is None else point
        with np.errstate(all="ignore"):  # a search may have ended beyond all numbers
            normal = linearise(problem, state, self.point)
        self.information, self.shared = normal.information, normal.shared
        self.marginal = normal.marginal
        self.weighted_residuals = weigh(problem.precision, self.point.residuals)
        self.p = len(state.theta)

    def with_slopes(self, columns: Array, output_of: Places) -> OtherSlopes:
        """Return the sums with slopes Z (q, n), each of one output."""
        p, end = self.p, self.p + len(columns)
        blocks = []
        for output, (places, slopes) in enumerate(self.point.blocks):
            mine = np.flatnonzero(output_of == output)
            both = np.concatenate([slopes.T, columns[mine]]).T
            blocks.append((np.concatenate([places, p + mine]), both))
        sums = assemble(end, blocks, self.marginal, self.weighted_residuals, self.shared)
        whole, right = (each[0] for each in sums)
        unknown = np.r_[:p, end : len(right)]
        other = slice(p, end)
        return OtherSlopes(whole[other, other], whole[unknown, other], right[unknown], right[other])

    def leverage(self, covariance: Array) -> Array:
        """Return the diagonal of W A C A' (n, M), C (p, p) of the parameters."""
        result = np.zeros(self.weighted_residuals.shape)
        for i, (places, mine) in enumerate(self.point.blocks):
            for j, (targets, other) in enumerate(self.point.blocks):
                moved = other @ covariance[targets[:, None], places]
                result[:, i] += self.marginal[:, i, j] * np.einsum("np,np->n", moved, mine)
        return result

    def weighted(self) -> tuple[Array, Array]:
        """Return W (M, M, n) and W A (M, p + shared, n)."""
        n, m = self.weighted_residuals.shape
        A = np.zeros((n, m, len(self.information)))
        for output, (places, slopes) in enumerate(self.point.blocks):
            A[:, output, places] = slopes
        A[:, :, self.p :] = self.shared
        return self.marginal.transpose(1, 2, 0), (self.marginal @ A).transpose(1, 2, 0)

"""Junctions: by how much segments that were fitted apart differ where they meet.

At the edge e of the segment variable the model jumps by

    d = x(e)' (b_above − b_below),      u²(d) = x(e)' (C_above + C_below) x(e),             (1)

x(e) the terms with the segment variable at the edge and the others as they are. It is given at
the row where it is largest among those near the edge, a twentieth of the rows beside it.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor
from multipos.regression.hysteresis import branch_of
from multipos.regression.observations import Data, Rows
from multipos.regression.segment import Segment
from multipos.results import Result, frozen

_NEAR = 0.05  # of the rows of a branch


@frozen
class Junction(Result):
    """The largest jump at an edge, in the unit of the response.

    Attributes
    ----------
    edge : float
    branch : str or None
    jump, u, U : float
        From below to above.
    """

    edge: float
    branch: str | None
    jump: float
    u: float
    U: float

    @property
    def clear(self) -> bool:
        """Whether the jump is larger than its U."""
        return bool(abs(self.jump) > self.U)


def find_junctions(
    segments: Sequence[Segment],
    data: Data,
    variable: str | None,
    edges: Sequence[float],
    branch_column: str | None,
    confidence: float,
) -> tuple[Junction, ...]:
    """Return the jump at every edge of every branch, eq. (1)."""
    if variable is None:
        return ()
    branch = np.zeros(len(data), dtype=np.intp)
    if branch_column is not None:
        branch = branch_of(data.columns[branch_column], data.run)
    found = []
    for b in range(len(segments) // (len(edges) + 1)):
        rows = np.flatnonzero(branch == b)
        mine = segments[b * (len(edges) + 1) :]
        for i, edge in enumerate(edges):
            far = np.abs(data.columns[variable][rows] - edge)
            near = rows[np.argsort(far, kind="stable")[: max(int(_NEAR * len(rows)), 1)]]
            at = {**data.columns, variable: np.full(len(data), edge)}
            found.append(_junction(mine[i], mine[i + 1], at, near, edge, confidence))
    return tuple(found)


def _junction(
    below: Segment,
    above: Segment,
    columns: Mapping[str, Array],
    rows: Rows,
    edge: float,
    confidence: float,
) -> Junction:
    jump, variance = np.zeros(len(rows)), np.zeros(len(rows))
    for sign, s in ((-1.0, below), (1.0, above)):
        X = s.design(columns, rows)
        C = s.covariance if s.robust is None else s.robust.covariance
        jump += sign * (X @ s.values)
        variance += np.einsum("ij,jk,ik->i", X, C, X)
    i = int(np.argmax(np.abs(jump)))
    u = float(np.sqrt(variance[i]))
    nu = min(float(s.dof[1]) if s.robust is None else s.robust.t_dof for s in (below, above))
    return Junction(edge, below.branch, float(jump[i]), u, coverage_factor(confidence, nu) * u)

"""Junctions: by how much segments that were fitted apart differ where they meet.

`find_junctions` returns the jump at every edge. At the edge e of the segment variable the model
jumps by

    d = x(e)' (b_above − b_below),      u²(d) = x(e)' (C_above + C_below) x(e),             (1)

x(e) the terms with the segment variable at the edge and the others as they are. It is given at
the row where it is largest among those near the edge, a twentieth of the rows beside it.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor
from multipos.regression.observations import Data, Rows
from multipos.regression.segment import Branch, Segment, Size, combined_variance
from multipos.results import Result, frozen

_NEAR = 0.05  # of the rows


@frozen
class Junction(Result):
    """The largest jump at an edge, in the unit of the response.

    Attributes
    ----------
    edge : float
    jump, u, U : float
        From below to above.
    branch : str or None
        That of its segments.
    """

    edge: float
    jump: float
    u: Size
    U: Size
    branch: Branch | None = None

    @property
    def clear(self) -> bool:
        """Whether the jump is larger than its U."""
        return bool(abs(self.jump) > self.U)


def find_junctions(
    segments: Sequence[Segment],
    data: Data,
    variable: str | None,
    edges: Sequence[float],
    confidence: float,
) -> tuple[Junction, ...]:
    """Return the jump at every edge, eq. (1)."""
    if variable is None:
        return ()
    found = []
    count = max(int(_NEAR * len(data)), 1)
    for edge, (below, above) in zip(edges, pairwise(segments), strict=True):
        far = np.abs(data.columns[variable] - edge)
        near = np.argsort(far, kind="stable")[:count]
        at = {**data.columns, variable: np.full(len(data), edge)}
        found.append(_junction(below, above, at, near, edge, confidence))
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
        jump += sign * (X @ s.values)
        variance += combined_variance(X, s.robust_covariance)
    i = int(np.argmax(np.abs(jump)))
    u = float(np.sqrt(variance[i]))
    nu = min(below.robust_dof, above.robust_dof)
    return Junction(edge, float(jump[i]), u, coverage_factor(confidence, nu) * u)

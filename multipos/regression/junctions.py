"""Junctions: by how much segments that were fitted apart differ where they meet.

At the edge e of the segment variable the model jumps by

    d = x(e)' (b_above − b_below),      u²(d) = x(e)' (C_above + C_below) x(e),             (1)

x(e) the terms with the segment variable at the edge and the others as they are. It is given at
the row where it is largest among those near the edge, a twentieth of the rows beside it.

Heating and cooling: rows by the sign of a rate, and whether the two differ.

A sensor that is heated is not where its thermometer is; cooled, it is on the other side. With rss_1
of one model for both branches and rss_2 of one for each, d coefficients more and p_2 in all,

    F = ((rss_1 − rss_2)/d) / (rss_2/(n − p_2)) · n_eff/n                                    (2)

on d and n_eff − p_2 degrees of freedom, n_eff the effective rows where rows are correlated in time.

Sources: G. C. Chow, Econometrica 28, 1960.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import coverage_factor, f_tail
from multipos.numerics.terms import Term, evaluate_terms
from multipos.regression.correlation import effective_size
from multipos.regression.observations import Data, Rows, rows_of_runs
from multipos.regression.robust import within_runs
from multipos.regression.segment import Segment, combined_variance
from multipos.regression.segmentation import segment_of
from multipos.results import Result, frozen

BRANCHES = ("heating", "cooling")


def branch_of(rate: Array, run: Places | None = None) -> Places:
    """Return 0 where it heats and 1 where it cools.

    A row without change is as the one before in its run; before the first change it heats.
    """
    if run is not None:
        branch = np.empty(len(rate), dtype=np.intp)
        for rows in rows_of_runs(run):
            branch[rows] = branch_of(rate[rows])
        return branch
    sign = np.sign(rate)
    moving = np.concatenate(([0], np.flatnonzero(sign)))
    last = np.searchsorted(moving, np.arange(len(rate)), side="right") - 1
    return (sign[moving[last]] < 0.0).astype(np.intp)


def compare_branches(
    terms: Sequence[Term],
    data: Data,
    column: str,
    variable: str | None,
    edges: Sequence[float],
    confidence: float,
) -> dict[str, Any]:
    """Test whether heating and cooling need models of their own, eq. (2).

    Parameters
    ----------
    terms : sequence of Term
    data : Data
    column : str
        The rate.
    variable, edges
        Segments, each with a model of its own in both hypotheses.
    confidence : float

    Returns
    -------
    dict
        {column, F, dof, p, significant}

    Raises
    ------
    MultiposError
        The rate has one sign only, or a branch of a segment has too few rows.
    """
    sign = branch_of(data.columns[column], data.run)
    if sign.min() == sign.max():
        raise MultiposError(
            f"column '{column}' has one sign only, so there are no branches; leave out --branches."
        )
    design, data = within_runs(evaluate_terms(terms, data.columns, len(data)), data)
    scale = np.linalg.norm(design, axis=0)
    X, n, p = design / np.where(scale > 0.0, scale, 1.0), len(data), len(terms)
    place = np.zeros(n, dtype=np.intp)
    if variable is not None:
        place = segment_of(data.columns[variable], edges)
    joint, apart = np.empty(n), np.empty(n)
    for number in range(len(edges) + 1):
        inside = np.flatnonzero(place == number)
        joint[inside] = _residual(X[inside], data.response[inside])
        for branch, name in enumerate(BRANCHES):
            rows = inside[sign[inside] == branch]
            if len(rows) <= p:
                raise MultiposError(
                    f"{name} in segment {number + 1} has {len(rows)} rows for {p} terms; give "
                    "more rows, fewer terms or leave out --branches."
                )
            apart[rows] = _residual(X[rows], data.response[rows])
    d = p * (len(edges) + 1)
    one, two = float(joint @ joint), float(apart @ apart)
    size = float(n) if data.order is None else effective_size(apart, data.order)
    F = (one - two) / d / (two / (n - 2 * d)) * (size / n) if two > 0.0 else np.inf
    nu = size - 2 * d
    p_value = f_tail(F, d, nu)
    return {
        "column": column,
        "F": F,
        "dof": [d, nu],
        "p": p_value,
        "significant": bool(p_value < 1.0 - confidence),
    }


def _residual(X: Array, y: Array) -> Array:
    """Residuals of all columns, of which some may say the same here."""
    return np.asarray(y - X @ np.linalg.lstsq(X, y, rcond=1e-10)[0])


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
        variance += combined_variance(X, C)
    i = int(np.argmax(np.abs(jump)))
    u = float(np.sqrt(variance[i]))
    nu = min(float(s.dof[1]) if s.robust is None else s.robust.t_dof for s in (below, above))
    return Junction(edge, below.branch, float(jump[i]), u, coverage_factor(confidence, nu) * u)

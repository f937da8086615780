"""The region that the rows of a segment fill: where a prediction is within what was measured.

`region_factor` returns the factor G of a `Region`, `largest_leverage` its limit.

A box of limits holds corners that no row came near: rate 0 between −1 and +1, the ambient far from
the case. A row is inside where each variable lies within the limits **and** its leverage is no
larger than the largest of the rows of the fit,

    h(x) = Σ_i (Σ_j G_ij φ_j(x))² ≤ max h(rows).                                            (1)

For the q terms kept, G'G = (X'X)⁻¹ with X their columns: h is then the leverage xᵀCx of least
squares. A term that was left out because it varied too little (`multipos.regression.variation`)
adds what it has beyond the kept ones, z = φ − P_K φ, over its length on the rows,

    (z/max(|z|, ℓ))²,      ℓ² = 1e-4 n v(φ),                                                (2)

so that it may differ from what was measured by a hundredth of its spread in the table, or as the
rows do. Segments that join share their terms: x is made of those of the whole fit, the maximum is
over all its rows.

A segment reaches to its edges, where no row need be: the row next to an edge counts as if it stood
there as well.

The sums of (1) are formed in one order, j and then i ascending, entries of G that are zero left
out, by Python and by the exported C, so that both flag the same rows.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from multipos.files.records import (
    ANY_TEXT,
    AnyOf,
    Entries,
    Flag,
    Listed,
    NotNegative,
    Numbers,
    Whole,
)
from multipos.files.schema import As
from multipos.numerics.arrays import Array
from multipos.numerics.factors import factor_from_list, factor_to_list
from multipos.numerics.selection import compress
from multipos.numerics.terms import Term
from multipos.results import Result, frozen

_SAME = 1e-9  # what a processor that rounds otherwise may add
_FUNCTION = AnyOf((ANY_TEXT, Flag()))  # which are known is said in `numerics.factors`
_POWER = Whole(0, 300)  # a power is so many multiplications in every row
TERM = As(
    Listed(Entries((ANY_TEXT, _POWER, _FUNCTION))),
    lambda factors: Term(tuple(map(factor_from_list, factors))),
    lambda term: list(map(factor_to_list, term.factors)),
)


@frozen
class Region(Result):
    """What rows of a fit fill, eq. (1).

    Attributes
    ----------
    terms : tuple of q Term
        The segment's, and behind them those left out for want of variation.
    factor : (r, q) array
        G.
    limit : float
        The largest leverage of the rows of the fit.
    """

    terms: Annotated[tuple[Term, ...], Listed(TERM, 1)]
    factor: Annotated[Array, Numbers(2)]
    limit: NotNegative

    @classmethod
    def _from_file(cls, **values: Any) -> "Region":
        """Return the region that a file describes, its rows as long as it has terms."""
        found = cls(**values)
        if found.factor.shape[1] != len(found.terms) or not found.factor.any(axis=1).all():
            raise ValueError("the factor of a segment's region does not fit its terms")
        return found

    def leverage(self, columns: Mapping[str, Array], n: int) -> Array:
        """Return h (n,) of eq. (1) at the rows of columns."""
        values = [np.broadcast_to(term.evaluate(columns), n) for term in self.terms]
        h = np.zeros(n)
        for row in self.factor.tolist():
            entries = [(g, values[j]) for j, g in enumerate(row) if g]
            part = entries[0][0] * entries[0][1]
            for g, value in entries[1:]:
                part = part + g * value
            h = h + part * part
        return h


def region_factor(kept: Array, left_out: Array, shortest: Array, L: Array | None = None) -> Array:
    """Return G of eqs. (1) and (2).

    Parameters
    ----------
    kept : (n, q) array
        Columns of the fit.
    left_out : (n, m) array
        Those that varied too little.
    shortest : (m,) array
        ℓ of eq. (2).
    L : (r, q) array, optional
        How the coefficients of a segment's terms are made of those of the fit, where these are
        shared: columns x of the fit are L'x of the segment's terms.

    Returns
    -------
    (r + m, r + m) array, of fewer rows where terms share a column
    """
    q, m = kept.shape[1], left_out.shape[1]
    scale = np.linalg.norm(kept, axis=0)
    R = compress(np.column_stack([kept / scale, left_out]), np.zeros(len(kept))).R[:, :-1]
    inverse = np.linalg.inv(R[:q, :q]).T / scale  # of the kept: coordinates of unit length
    if L is not None:
        inverse = inverse @ L.T
    rest = np.linalg.norm(R[q:, q:], axis=0)
    length = np.maximum(rest, shortest)
    beyond = -(R[:q, q:].T @ inverse) / length[:, np.newaxis]
    if L is not None:  # a triangle again: a row of G costs as many products as it has entries
        triangle: Array = np.asarray(np.linalg.qr(inverse[:, ::-1], mode="r"))
        inverse = triangle[::-1, ::-1]
        inverse = inverse[inverse.any(axis=1)]  # terms that share one column of the fit
    rows = [np.hstack([inverse, np.zeros((len(inverse), m))])]
    rows.append(np.hstack([beyond, np.diag(1.0 / length)]))
    return np.tril(np.vstack(rows)) if L is None else np.vstack(rows)


def largest_leverage(regions: Sequence[tuple[Region, Mapping[str, Array], int]]) -> float:
    """Return the largest leverage of rows, each group of them by its own segment's region."""
    largest = max(float(r.leverage(columns, n).max()) for r, columns, n in regions if n)
    return largest * (1.0 + _SAME)

"""All subsets of a list of columns: the residual sum of every one, from one factor.

R of [X y] (`multipos.numerics.selection`) is triangular. Of its first column two things can be
said. It is in the model: then the triangle without its first row and column holds the part of the
others that is orthogonal to it. Or it is out: then R without that column is brought back to a
triangle by Givens rotations of neighbouring rows, and its last row falls away. Either way a
triangle one smaller is left, so after m columns 2^m numbers are left, each the root of one residual
sum. All triangles of one size are rotated together. No sum of squares is formed before the last, so
a residual sum is as good as that of a QR of its own; the work is some 10 · 2^m operations, not 2^m
fits.

A subset in which a column has less than 1e-5 of its length outside those before it is left out.

Criteria of a model with q coefficients and residual sum rss on n rows, counting the variance
(the smaller the better; adjusted R² with its sign turned):

    AICc = n ln(rss/n) + 2 K + 2 K (K + 1)/(n − K − 1),   K = q + 1,
    BIC = n ln(rss/n) + K ln n,         1 − R²_adj = (rss/(n − q)) / (tss/(n − 1)).

Sources: G. M. Furnival, R. W. Wilson, Technometrics 16, 1974 (the binary tree of subsets);
C. M. Hurvich, C.-L. Tsai, Biometrika 76, 1989 (AICc).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.selection import COLLINEAR, NOTHING, Triangle
from multipos.results import Result

SubsetCriterion = Literal["aicc", "bic", "adjusted_r2"]
CRITERIA: tuple[SubsetCriterion, ...] = get_args(SubsetCriterion)
MOST_TERMS = 20  # a million subsets; beyond it stepwise is the way
_LISTED = 256  # subsets that are listed whole
_BEST = 5  # of each size beyond that


@dataclass(frozen=True, eq=False)
class Subset(Result):
    """One subset of the terms, with its columns and criteria."""

    columns: tuple[int, ...]
    rss: float
    r2: float
    adjusted_r2: float
    aicc: float
    bic: float


def residual_sums(triangle: Triangle, forced: Sequence[int] = ()) -> Array:
    """Return the residual sum of squares of every subset of the columns that are not forced.

    Parameters
    ----------
    triangle : Triangle
        With p columns and the response.
    forced : sequence of int
        Columns that are in every subset.

    Returns
    -------
    (2^m,) array
        Bit j of the index says whether the j-th of the m free columns is in; inf where columns
        are collinear.
    """
    p = triangle.R.shape[1] - 1
    free = [j for j in range(p) if j not in forced]
    order = [*forced, *free, p]
    R: Array = np.asarray(np.linalg.qr(triangle.R[:, order], mode="r"))
    if len(R) < p + 1:  # fewer rows than columns: zeros below
        R = np.vstack((R, np.zeros((p + 1 - len(R), p + 1))))
    k = len(forced)
    T = np.ascontiguousarray(R[k:, k:, np.newaxis])
    lengths = np.linalg.norm(T[:, :, 0], axis=0)
    least = np.maximum(COLLINEAR * lengths, NOTHING * np.linalg.norm(R[:, k:], axis=0))
    bad = np.zeros(1, dtype=bool)
    for length in least[:-1]:
        collinear = bad | (np.abs(T[0, 0]) <= length)
        T = np.concatenate((_without_first(T), T[1:, 1:]), axis=2)
        bad = np.concatenate((bad, collinear))
    rss = np.where(bad, np.inf, T[0, 0] ** 2)
    return np.asarray(rss)


def _without_first(T: Array) -> Array:
    """Triangles (m, m, batch) without their first column, triangular again, one row less."""
    H = T[:, 1:].copy()
    for i in range(len(H) - 1):
        a, b = H[i, i], H[i + 1, i]
        size = np.hypot(a, b)
        safe = np.where(size > 0.0, size, 1.0)
        c, s = np.where(size > 0.0, a / safe, 1.0), b / safe
        upper, lower = H[i, i:], H[i + 1, i:]
        rotated = c * upper + s * lower
        lower *= c
        lower -= s * upper
        H[i, i:] = rotated
    return H[:-1]


def all_subsets(
    triangle: Triangle,
    *,
    forced: Sequence[int] = (),
    requires: Sequence[frozenset[int]] | None = None,
    criterion: SubsetCriterion = "aicc",
) -> tuple[Subset, ...]:
    """Return the subsets worth looking at, the best by the criterion first.

    Parameters
    ----------
    triangle : Triangle
    forced : sequence of int
        Columns in every subset; the first of them is taken for the constant of R².
    requires : sequence of p sets of int, optional
        Columns that must be in with a column.
    criterion : str
        'aicc', 'bic' or 'adjusted_r2'.

    Returns
    -------
    tuple of Subset
        All of them up to 256, beyond that the five best of each size.

    Raises
    ------
    UsageError
        More than 20 free columns, or an unknown criterion.
    MultiposError
        No subset leaves a row over.
    """
    p = triangle.R.shape[1] - 1
    free = [j for j in range(p) if j not in forced]
    if criterion not in CRITERIA:
        raise UsageError(f"--criterion takes {', '.join(CRITERIA)}, got '{criterion}'.")
    if len(free) > MOST_TERMS:
        raise UsageError(
            f"{len(free)} terms have {2 ** len(free)} subsets; all subsets are for {MOST_TERMS} "
            "terms at most, use --stepwise."
        )
    rss = residual_sums(triangle, forced)
    index = np.arange(len(rss))
    member = (index[:, np.newaxis] >> np.arange(len(free))) & 1 == 1
    allowed = np.isfinite(rss)
    if requires:
        allowed &= _stand_on_theirs(member, free, forced, requires)
    size = member.sum(axis=1) + len(forced)
    allowed &= size < triangle.rows
    if not allowed.any():
        raise MultiposError(
            f"every subset of the terms takes up all that the rows tell ({triangle.rows} beside "
            "what runs take), so that nothing is left to compare them by; give more rows, or "
            "fewer runs."
        )
    index = index[allowed]
    if len(index) > _LISTED:
        ranked = index[np.lexsort((rss[index], size[index]))]
        first = np.searchsorted(size[ranked], size[ranked])
        index = ranked[np.arange(len(ranked)) - first < _BEST]
    total = float(rss[0])
    found = [
        _describe(
            tuple(sorted([*forced, *(free[j] for j in np.flatnonzero(member[i]))])),
            float(rss[i]),
            total,
            triangle.rows,
            len(forced),
        )
        for i in index.tolist()
    ]
    return tuple(sorted(found, key=lambda s: _badness(s, criterion)))


def _stand_on_theirs(
    member: NDArray[np.bool_],
    free: Sequence[int],
    forced: Sequence[int],
    requires: Sequence[frozenset[int]],
) -> NDArray[np.bool_]:
    """Tell of each subset whether every column in it has the columns that it requires."""
    result = np.ones(len(member), dtype=bool)
    for place, j in enumerate(free):
        for needed in requires[j].difference(forced):
            result &= ~member[:, place] | member[:, free.index(needed)]
    return result


def _badness(subset: Subset, criterion: str) -> float:
    return -subset.adjusted_r2 if criterion == "adjusted_r2" else float(getattr(subset, criterion))


def _describe(columns: tuple[int, ...], rss: float, total: float, n: int, always: int) -> Subset:
    q = len(columns)
    aicc, bic = criteria(rss, n, q)
    lost = rss / total if total > 0.0 else float("nan")
    return Subset(columns, rss, 1.0 - lost, 1.0 - lost * (n - always) / (n - q), aicc, bic)


def criteria(rss: float, n: int, coefficients: int) -> tuple[float, float]:
    """Return AICc and BIC of a model; AICc is inf where there are too few rows for it."""
    if not rss > 0.0:
        return -inf, -inf
    K = coefficients + 1
    fit = n * log(rss / n)
    aicc = fit + 2 * K + 2 * K * (K + 1) / (n - K - 1) if n > K + 1 else inf
    return aicc, fit + K * log(n)

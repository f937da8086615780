"""What the rows of a design can separate, whatever the response.

`separability` returns rank and null space of a design, `name_combinations` the null space as sums
of the names of parameters, and `join_combinations` such sums in one sentence.

The rank is decided with the columns scaled to unit length (`multipos.numerics.factoring`), which
alone would promote a column that is nothing but rounding, cos 90° = 6e-17, to a full member: a
column whose norm does not exceed `least_norm` is zero. References in g have a least norm of 1e-9;
columns of a regression have units of their own and no least norm. The null space is in reduced
echelon form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from multipos.numerics.arrays import Array, Places
from multipos.numerics.factoring import (
    RANK,
    Covariance,
    column_norms,
    column_scales,
    design_matrix,
    factor,
    singular_values,
)


@dataclass(frozen=True, eq=False, slots=True)
class Separability:
    """What the rows of a design can separate.

    Attributes
    ----------
    rank, parameters : int
    condition : float
        As in `LinearFit`; infinite where the rank is short.
    null : (p, p − rank) array
        Combinations of coefficients that no row sees: adding a multiple of a column to the
        coefficients changes nothing. In units of the coefficients, in reduced echelon form.
    """

    rank: int
    parameters: int
    condition: float
    null: Array


def separability(
    design: ArrayLike,
    *,
    least_norm: float = 0.0,
    covariance: ArrayLike | None = None,
    least: float = RANK,
) -> Separability:
    """What the rows of a design can separate, whatever the response.

    Parameters
    ----------
    design : (n, p) array
        May have fewer rows than columns; the rank is then n at most.
    least_norm, covariance
        As in `multipos.numerics.least_squares.solve`. The covariance bears on the condition; what
        rows of finite variance can tell apart does not depend on it.
    least : float
        Singular value of the scaled design, as a part of the largest, that is no separation.

    Returns
    -------
    Separability
    """
    X = design_matrix(design)
    n, p = X.shape
    V = Covariance(covariance, n)
    dead = column_norms(X) <= least_norm
    if dead.any():
        X = np.where(dead, 0.0, X)
    R = factor(V, X)[1] if n >= p else V.whitened(X)
    # Whitening by a full covariance rounds enough to hide a dependence; by variances it does not.
    judged = R if V.full is None else X
    scales = column_scales(judged)
    _, singular, Vt = np.linalg.svd(judged / scales, full_matrices=n < p)
    rank = int((singular > least * singular[0]).sum())
    null = _echelon(Vt[rank:]).T
    for v in null.T:
        used = np.flatnonzero(v)
        v[used] *= scales[used[-1]] / scales[used] / v[used[-1]]
    whole = np.rint(null)
    condition = np.inf
    if rank == p:
        values = singular if V.full is None else singular_values(R)
        condition = float(values[0] / values[-1])
    return Separability(
        rank=rank,
        parameters=p,
        condition=condition,
        null=np.where(np.abs(null - whole) <= 1e-10 * np.abs(null), whole, null),
    )


def _echelon(N: Array) -> Array:
    """Reduced row echelon form of orthonormal rows (m, p), pivots from the right.

    From the right, so that later terms are explained by earlier ones. Columns are scaled, so
    entries compare; rows are good to 1e-13 or better, and 1e-8 is no part of a combination.
    """
    N = N.copy()
    row = len(N)  # rows from here on have their pivot
    for column in reversed(range(N.shape[1])):
        pivot = int(np.abs(N[:row, column]).argmax()) if row else 0
        if row == 0 or abs(N[pivot, column]) <= 1e-8:
            continue
        row -= 1
        N[[row, pivot]] = N[[pivot, row]]
        N[row] /= N[row, column]
        others = np.arange(len(N)) != row
        N[others] -= np.outer(N[others, column], N[row])
    N[np.abs(N) <= 1e-8 * np.abs(N).max(axis=1, keepdims=True, initial=0.0)] = 0.0
    return N


def name_combinations(
    null: Array, names: Sequence[str], *, rows: str = "positions"
) -> tuple[str, ...]:
    """What cannot be separated, one sentence for each column of `null`.

    Where X v = 0, the terms with positive v do together exactly what those with negative v do.
    The side of fewer terms is named first, the earlier one where they are equal, and its first
    term has factor one.

    Parameters
    ----------
    null : (p, m) array
        As in `Separability`.
    names : sequence of p str
    rows : str
        What rows of the design are called.

    Returns
    -------
    tuple of m str

    Examples
    --------
    >>> import numpy as np
    >>> name_combinations(np.array([[-1.0], [1.0], [1.0]]), ["bias", "cos²", "sin²"])
    ('`bias` cannot be separated from `cos² + sin²`',)
    """
    return tuple(_sentence(v, names, rows) for v in np.asarray(null, dtype=np.float64).T)


def join_combinations(combinations: Sequence[str], most: int = 3) -> str:
    """Return the first combinations as one phrase, and how many more there are."""
    more = len(combinations) - most
    return "; ".join(combinations[:most]) + (f"; and {more} more" if more > 0 else "")


def _sentence(v: Array, names: Sequence[str], rows: str) -> str:
    used = np.flatnonzero(v)
    if len(used) == 1:
        return f"`{names[used[0]]}` has no effect at these {rows}"
    left, right = used[v[used] > 0.0], used[v[used] < 0.0]
    if len(left) == 0 or len(right) == 0:  # one does what the others undo
        left, right = used[:1], used[1:]
    if (len(right), right[0]) < (len(left), left[0]):
        left, right = right, left
    v = v / v[left[0]]
    return f"`{_sum(v, left, names)}` cannot be separated from `{_sum(-v, right, names)}`"


def _sum(v: Array, used: Places, names: Sequence[str]) -> str:
    text = ""
    for j in used:
        size = f"{abs(v[j]):.3g}"
        sign = "-" if v[j] < 0.0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        text += names[j] if size == "1" else f"{size} {names[j]}"
    return text

"""A design whitened and factored, L⁻¹ X = Q R, for every linear problem.

The rows of a design X (n, p) have the covariance V = L L': the unit matrix, the variances of the
rows, or a full covariance. Householder QR of the whitened rows never squares the condition of X.

**Rank.** Columns may be in any unit, so R is judged with its columns scaled to unit length:
singular values below `RANK` of the largest count as zero. Columns dependent but for rounding leave
1e-16 to 1e-15; the hardest problem known that is solved (NIST's Filip) leaves 2e-10. `RANK` =
1e-13 lies between, with two and three decades to either side.

**Size.** Many rows are factored in small blocks and the triangles again: as stable as one
Householder QR, several times faster, and Q is the only array as large as X that is made.

Source: J. Demmel, L. Grigori, M. Hoemmen, J. Langou, SIAM J. Sci. Comput. 34, 2012 (QR by blocks of
rows).

Sums of products as if in twice the working precision.

Iterative refinement (`least_squares`) lives on two residuals that are small differences of large
numbers,

    f = y − r − X b,    g = c − X' r,

and in plain double precision they are rounding noise just where they are needed. Here each sum is
taken over exact parts and rounded once, at the end. A product is split without error into its
rounded value and the rest, which is a double as well,

    a b = p + e                          (TwoProduct, Dekker, with Veltkamp's split),

and n numbers t_k into a high part, all on one grid so coarse that their sum is exact in double
precision, and a low part:

    h_k = fl(fl(σ + t_k) − σ),   l_k = t_k − h_k exactly,   σ a power of two >= n max|t_k|

(ExtractVector). What is left is of the size n ε max|t|, so that its plain sum is good to about
ε + (n ε)² Σ|t| / |s| of the result s, ε = 1.1e-16: a sum that cancels to 1e-16 of its terms still
has its leading digits (S. M. Rump, T. Ogita, S. Oishi, SIAM J. Sci. Comput. 31, 2008, algorithm
ExtractVector; the same authors, 26, 2005, algorithm Dot2, for the bound).

Rejected: `numpy.longdouble`, which is 80 bits on one platform, 64 on another and software on a
third. The split overflows beyond 1e300, where there are no readings.

Rows are taken in blocks that stay in cache, so working memory does not grow with their number.

Cofactors of 3 × 3 matrices, many at a time.

    C_ij = G_i+1,j+1 G_i+2,j+2 − G_i+1,j+2 G_i+2,j+1,    indices modulo 3,

so that G' C = det(G) I. They exist where G has no inverse.

What the rows can separate, whatever the response, is decided after that scaling, which alone would
promote a column that is nothing but rounding, cos 90° = 6e-17, to a full member: a column whose
norm does not exceed `least_norm` is zero. References in g have a least norm of 1e-9; columns of a
regression have units of their own and no least norm. What cannot be separated is named by the null
space in reduced echelon form, as sums of the names of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array, Places

RANK = 1e-13  # singular values of the scaled design below this part of the largest are zero
BLOCK = 8192  # numbers factored at once: in cache, and below the size that BLAS starts threads for

_PRODUCTS = 250_000  # of one matrix product, below which BLAS starts no threads


class Covariance:
    """V as unit matrix, variances or full; what whitens with it and colours again.

    `a`, `s`, `y`, `X` and `b` are the matrices of one problem, or of a stack of one.
    """

    def __init__(self, covariance: ArrayLike | None, n: int) -> None:
        self.sd: Array | None = None
        self.full: Array | None = None
        self.variances: Array | None = None
        if covariance is None:
            return
        V = np.asarray(covariance, dtype=np.float64)
        if V.shape == (n,):
            if not (np.isfinite(V).all() and (V > 0.0).all()):
                raise MultiposError("`covariance` must be positive and finite in every row.")
            self.variances = V
            self.sd = np.sqrt(V)
        elif V.shape == (n, n):
            # ten digits: a covariance computed as J S J' is symmetric to rounding, not exactly
            if not np.abs(V - V.T).max() <= 1e-10 * np.abs(V).max():
                raise MultiposError("`covariance` must be symmetric and finite.")
            try:
                self.L = np.linalg.cholesky(V)
            except np.linalg.LinAlgError:
                raise MultiposError("`covariance` must be positive definite.") from None
            self.inverse = np.linalg.inv(self.L)
            self.full = (V + V.T) / 2.0
        else:
            raise MultiposError(
                f"`covariance` must have shape ({n},) or ({n}, {n}), got {V.shape}; "
                "give one variance per row, or the covariance of the rows."
            )

    def whitened(self, a: Array, rows: slice = slice(None)) -> Array:
        """L⁻¹ a, where `a` holds the given rows."""
        if self.full is not None:
            return np.asarray(self.inverse[rows] @ a)
        return a if self.sd is None else a / self.sd[..., rows, np.newaxis]

    def multiplier(self, s: Array) -> Array:
        """λ = V⁻¹ r = L⁻ᵀ s, from whitened residuals s."""
        if self.full is not None:
            return np.asarray(self.inverse.T @ s)
        return self.whitened(s)

    def coloured(self, s: Array) -> Array:
        """Residuals r = L s = V λ."""
        if self.full is not None:
            return np.asarray(self.L @ s)
        return s if self.sd is None else s * self.sd[..., np.newaxis]

    def residual(self, y: Array, X: Array, b: Array, multiplier: Array) -> Array:
        """`y − V λ − X b` in twice the working precision."""
        if self.full is not None:
            full = np.broadcast_to(self.full, (*X.shape[:-1], len(self.full)))
            both = np.concatenate((full, X), axis=-1)
            coefficients = np.concatenate((multiplier, b), axis=-2)
            return residual(y, both, coefficients, np.zeros_like(y))
        return residual(y, X, b, multiplier, self.variances)


def factor(V: Covariance, X: Array) -> tuple[Array, Array]:
    """Q (n, p) and R (p, p) of the whitened design, or of each of a stack.

    Columns are not scaled beforehand: Householder QR commutes with that, and R is cheaper to scale.
    """
    *stack, n, p = X.shape
    limit = max(2 * p, BLOCK // p)
    if V.full is not None or n <= limit:
        Q, R = np.linalg.qr(V.whitened(X))
        return Q, R
    edges = np.linspace(0, n, -(-n // limit) + 1).astype(int)
    blocks = [slice(i, j) for i, j in pairwise(edges)]
    Q = np.empty(X.shape)
    triangles = np.empty((*stack, len(blocks), p, p))
    for i, block in enumerate(blocks):
        white = V.whitened(X[..., block, :], block)
        Q[..., block, :], triangles[..., i, :, :] = np.linalg.qr(white)
    top, R = factor(Covariance(None, 0), triangles.reshape(*stack, -1, p))
    turns = top.reshape(triangles.shape)
    for i, block in enumerate(blocks):
        Q[..., block, :] = Q[..., block, :] @ turns[..., i, :, :]
    return Q, R


def gram(X: Array) -> Array:
    """Return X'X, by pieces so small that BLAS starts no threads for one of them."""
    n, p = X.shape
    rows = max(_PRODUCTS // p**2, 1)
    whole = n - n % rows
    pieces = X[:whole].reshape(-1, rows, p)
    rest = X[whole:]
    return np.asarray(np.matmul(pieces.transpose(0, 2, 1), pieces).sum(axis=0) + rest.T @ rest)


def column_norms(X: Array) -> Array:
    """Euclidean norms of the columns."""
    return np.asarray(np.sqrt(np.einsum("...ij,...ij->...j", X, X)))


def column_scales(R: Array) -> Array:
    """Norms of the columns, one for a column of zeros: what scales them to unit length."""
    norms = column_norms(R)
    norms[norms == 0.0] = 1.0
    return norms


def singular_values(R: Array) -> Array:
    """Singular values of the columns scaled to unit length, the largest first."""
    scaled = R / column_scales(R)[..., np.newaxis, :]
    return np.asarray(np.linalg.svd(scaled, compute_uv=False))


_REGULAR = 1e-6  # determinant of entries up to one, whose smallest singular value has digits


def is_regular(matrix: Array) -> bool:
    """Tell whether a determinant shows a small square matrix to have full rank; others may too."""
    size = float(np.abs(matrix).max())  # no singular value is beyond size times the number of rows
    if matrix.shape[0] != matrix.shape[1] or not 0.0 < size < np.inf:
        return False
    return bool(abs(np.linalg.det(matrix / size)) > _REGULAR)


def log_determinant(matrices: Array) -> tuple[Array, Array]:
    """Return sign and logarithm of the determinant (…), 0 and −inf of a singular matrix."""
    with np.errstate(divide="ignore"):  # libraries may divide by its zero pivot
        sign, size = np.linalg.slogdet(matrices)
    return np.asarray(sign), np.asarray(size)


def design_matrix(design: ArrayLike) -> Array:
    """Return a design as an array (n, p), or refuse it."""
    X = np.asarray(design, dtype=np.float64)
    if X.ndim != 2 or X.shape[1] == 0:
        raise MultiposError(f"`design` must have shape (n, p) with p > 0, got {X.shape}.")
    if not np.isfinite(X).all():
        raise MultiposError("`design` has a number that is not finite.")
    return X


_SPLIT = 134217729.0  # 2^27 + 1: halves a significand so that products of halves are exact
_BLOCK = 1 << 15  # products held at once, in some ten arrays of this size


def split(a: Array) -> tuple[Array, Array]:
    """Two halves of 26 bits with a = high + low exactly."""
    t = _SPLIT * a
    high = t - (t - a)
    return high, a - high


def two_product(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded product and its error: a b = p + e exactly. The arguments broadcast."""
    ah, al = split(a)
    bh, bl = split(b)
    p = a * b
    return p, ((ah * bh - p) + ah * bl + al * bh) + al * bl


def fold(t: Array, e: Array) -> tuple[Array, Array]:
    """Sum t + e along the first axis: the exact sum of the high parts, and the rest."""
    # frexp's exponent is that of a power of two above its argument: sigma is at most 4 n max|t|.
    sigma = np.ldexp(1.0, np.frexp(len(t) * np.abs(t).max(axis=0))[1] + 1)
    high = (sigma + t) - sigma
    return high.sum(axis=0), ((t - high) + e).sum(axis=0)


def residual(y: Array, X: Array, b: Array, r: Array, v: Array | None = None) -> Array:
    """`y − r − X b`, or `y − v r − X b`, rounded once.

    Parameters
    ----------
    y, r : (n, k) array
    X : (n, p) array
    b : (p, k) array
    v : (n,) array, optional
        Multiplies the rows of `r`.

    Returns
    -------
    (n, k) array
        All of them may be stacks, with more axes in front.
    """
    n, p = X.shape[-2:]
    out = np.empty(y.shape)
    step = max(1, _BLOCK * n // ((p + 2) * y.size))
    columns = _axis_first(X, -1)[..., np.newaxis]
    minus_b = -_axis_first(b, -2)[..., np.newaxis, :]
    for i in range(0, n, step):
        rows = slice(i, i + step)
        here = y[..., rows, :]
        s = np.empty((p + 2, *here.shape))
        e = np.zeros_like(s)
        s[0] = here
        if v is None:
            np.negative(r[..., rows, :], out=s[1])
        else:
            s[1], e[1] = two_product(-r[..., rows, :], v[..., rows, np.newaxis])
        s[2:], e[2:] = two_product(columns[..., rows, :], minus_b)
        total, rest = fold(s, e)
        np.add(total, rest, out=out[..., rows, :])
    return out


def _axis_first(a: Array, axis: int) -> Array:
    """Return an array with one axis, counted from the last, in front of the others."""
    axes = list(range(a.ndim))
    axes.insert(0, axes.pop(axis))
    return a.transpose(axes)


def product(X: Array, b: Array) -> Array:
    """`X b`, rounded once; X is (n, p), b is (p, k)."""
    zero = np.zeros((1, 1))
    shape = (len(X), b.shape[1])
    return residual(np.broadcast_to(zero, shape), X, -b, np.broadcast_to(zero, shape))


def cross_residual(X: Array, r: Array, c: Array | None = None) -> Array:
    """`c − Xᵀ r`, rounded once; X is (n, p), r is (n, k), c is (p, k) and zero where not given.

    All of them may be stacks, with more axes in front.
    """
    n, p = X.shape[-2:]
    step = max(2, _BLOCK * n // (p * r.size))
    left = _axis_first(X, -2)[..., np.newaxis]
    right = -_axis_first(r, -2)[..., np.newaxis, :]
    sums = [] if c is None else [(c, np.zeros_like(c))]
    for i in range(0, n, step):
        rows = slice(i, i + step)
        sums.append(fold(*two_product(left[rows], right[rows])))
    if len(sums) == 1:
        total, rest = sums[0]
    else:
        total, rest = fold(np.array([s for s, _ in sums]), np.array([e for _, e in sums]))
    return np.asarray(total + rest)


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # the other two axes, in cyclic order


def _places(row: Places, column: Places) -> Places:
    """Return where G_row,column stands among nine numbers, (9,)."""
    return (3 * row[:, None] + column).ravel()


_FIRST = _places(_NEXT, _NEXT), _places(_LAST, _LAST)
_SECOND = _places(_NEXT, _LAST), _places(_LAST, _NEXT)


def cofactors_of(matrices: Array) -> Array:
    """Return the cofactors (3, 3, ...) of matrices (3, 3, ...).

    Examples
    --------
    >>> cofactors_of(np.diag([2.0, 3.0, 5.0])).tolist()
    [[15.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 6.0]]
    """
    nine = matrices.reshape(9, *matrices.shape[2:])
    a, b, c, d = (nine.take(place, axis=0) for place in (*_FIRST, *_SECOND))
    return np.asarray(a * b - c * d).reshape(matrices.shape)


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

"""A design whitened and factored, L⁻¹ X = Q R, for every linear problem.

`factor` gives Q and R of a design, `Covariance` what whitens its rows, and `design_matrix` the
design as an array, or refuses it. `column_norms` and `column_scales` are the lengths of columns,
`singular_values` those of the columns at unit length. `gram` is X'X in pieces; `is_regular` and
`log_determinant` judge small square matrices.

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
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.numerics.exact_sums import residual

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

"""Sums of products as if in twice the working precision.

`residual` is y − r − X b, `cross_residual` c − X' r and `product` X b, each rounded once. They are
made of `split`, which halves the digits of a number, `two_product`, a product and its error, and
`fold`, a sum and what its rounding left.

Iterative refinement (`multipos.numerics.least_squares`) lives on two residuals that are small
differences of large numbers,

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
"""

from __future__ import annotations

import numpy as np

from multipos.numerics.arrays import Array

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

"""Sums of products as if in twice the working precision.

Iterative refinement (`least_squares`) lives on two residuals that are small differences of large
numbers,

    f = y − r − X b,    g = c − X' r,

and in plain double precision they are rounding noise just where they are needed. Here each sum is
taken over exact parts and rounded once, at the end. The parts are error-free transformations: for
doubles a and b

    a + b = s + e   (TwoSum, Knuth),    a b = p + e   (TwoProduct, Dekker, with Veltkamp's split),

where s = fl(a + b), p = fl(a b), and e is a double as well. A sum is folded in halves with its
errors carried beside it. The relative error of a sum s of n terms t is at most about
ε + (n ε)² Σ|t| / |s| with ε = 1.1e-16: a sum that cancels to 1e-16 of its terms still has its
leading digits (T. Ogita, S. M. Rump, S. Oishi, SIAM J. Sci. Comput. 26, 2005, algorithm Dot2).

Rejected: `numpy.longdouble`, which is 80 bits on one platform, 64 on another and software on a
third. The split overflows beyond 1e300, where there are no readings.

Rows are taken in blocks that stay in cache, so working memory does not grow with their number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SPLIT = 134217729.0  # 2^27 + 1: halves a significand so that products of halves are exact
_BLOCK = 1 << 15  # products held at once, in some ten arrays of this size


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded sum and its error: a + b = s + e exactly."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


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


def fold(s: Array, e: Array) -> tuple[Array, Array]:
    """Sum s + e along the first axis by halves; returns the sum and what rounding left of it."""
    n = len(s)
    while n > 1:
        half = n // 2
        t, d = two_sum(s[:half], s[half : 2 * half])
        d += e[:half] + e[half : 2 * half]
        if n % 2:
            t = np.concatenate((t, s[-1:]))
            d = np.concatenate((d, e[-1:]))
        s, e, n = t, d, n - half
    return s[0], e[0]


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
    """
    n, p = X.shape
    k = b.shape[1]
    out = np.empty((n, k))
    step = max(1, _BLOCK // ((p + 2) * k))
    minus_b = -b[:, np.newaxis, :]
    for i in range(0, n, step):
        rows = slice(i, i + step)
        s = np.empty((p + 2, len(y[rows]), k))
        e = np.zeros_like(s)
        s[0] = y[rows]
        if v is None:
            np.negative(r[rows], out=s[1])
        else:
            s[1], e[1] = two_product(-r[rows], v[rows, np.newaxis])
        s[2:], e[2:] = two_product(X[rows].T[:, :, np.newaxis], minus_b)
        total, rest = fold(s, e)
        np.add(total, rest, out=out[rows])
    return out


def product(X: Array, b: Array) -> Array:
    """`X b`, rounded once; X is (n, p), b is (p, k)."""
    zero = np.zeros((1, 1))
    shape = (len(X), b.shape[1])
    return residual(np.broadcast_to(zero, shape), X, -b, np.broadcast_to(zero, shape))


def cross_residual(X: Array, r: Array, c: Array | None = None) -> Array:
    """`c − Xᵀ r`, rounded once; X is (n, p), r is (n, k), c is (p, k) and zero where not given."""
    n, p = X.shape
    k = r.shape[1]
    step = max(2, _BLOCK // (p * k))
    sums = [] if c is None else [(c, np.zeros_like(c))]
    for i in range(0, n, step):
        rows = slice(i, i + step)
        sums.append(fold(*two_product(X[rows, :, np.newaxis], -r[rows, np.newaxis, :])))
    if len(sums) == 1:
        total, rest = sums[0]
    else:
        total, rest = fold(np.array([s for s, _ in sums]), np.array([e for _, e in sums]))
    return np.asarray(total + rest)

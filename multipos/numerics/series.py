"""Recursions of the first order, z_k = w_k + a z_{k−1}, of any number of runs and columns at once.

They are the forward substitution of a matrix with two diagonals, for which LAPACK has a routine,
by SciPy where it is installed; `scipy.signal`, which has them too, takes half a second to import.
Of few rows, as a session has them, they are a product with that matrix's inverse, for SciPy takes
longer to import than such a fit.

Sample rates that a log may have.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.errors import UsageError
from multipos.numerics.arrays import Array

_FEW = 128  # rows


def recur(w: Array, a: float, first: NDArray[np.bool_] | None = None) -> Array:
    """Return z (n,) or (n, p) with z_k = w_k + a z_{k−1}, and z_k = w_k where a run begins.

    Parameters
    ----------
    w : (n,) or (n, p) array
    a : float
    first : (n,) array of bool, optional
        Rows where a run begins, beside the first.
    """
    if len(w) <= _FEW:
        return np.asarray((_powers(len(w), a, first) @ w.reshape(len(w), -1)).reshape(w.shape))
    try:
        from scipy.linalg.lapack import dtbtrs
    except ImportError:
        return _recur_by_rows(w, a, first)
    bands = np.ones((2, len(w)))
    bands[1, :-1] = -a if first is None else np.where(first[1:], 0.0, -a)
    z, _ = dtbtrs(bands, w.reshape(len(w), -1), uplo="L", diag="U")
    return np.asarray(z.reshape(w.shape))


def _powers(n: int, a: float, first: NDArray[np.bool_] | None) -> Array:
    """Return a^(k−j) for j up to k in one run, else 0: the inverse of the two diagonals (n, n)."""
    run = np.zeros(n) if first is None else np.cumsum(first)
    apart = np.subtract.outer(np.arange(n), np.arange(n))
    together = (apart >= 0) & (run[:, None] == run)
    return np.where(together, a ** np.maximum(apart, 0), 0.0)


def _recur_by_rows(w: Array, a: float, first: NDArray[np.bool_] | None) -> Array:
    z = np.array(w, dtype=np.float64)
    begins = np.zeros(len(w), dtype=np.bool_) if first is None else first
    for k in (np.flatnonzero(~begins[1:]) + 1).tolist():
        z[k] += a * z[k - 1]
    return z


SLOWEST, FASTEST = 1e-12, 1e7  # [Hz]


def require_rate(rate: float) -> None:
    """Refuse a rate [Hz] out of range.

    Raises
    ------
    UsageError
        The message begins with the option.
    """
    if not SLOWEST <= rate <= FASTEST:
        raise UsageError(
            f"--rate must be above 0, from {SLOWEST:g} to {FASTEST:g} Hz, got {rate:g}."
        )

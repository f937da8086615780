"""Recursions of the first order, z_k = w_k + a z_{k−1}, of any number of runs and columns at once.

They are the forward substitution of a matrix with two diagonals, for which LAPACK has a routine,
by SciPy where it is installed; `scipy.signal`, which has them too, takes half a second to import.
Of few rows, as a session has them, sums of 1, 2, 4 … rows are doubled, for SciPy takes longer to
import than such a fit:

    z ← z + a^m z_{k−m},      m = 1, 2, 4, …, n,                                            (1)

where row k − m is of the same run.

Sample rates that a log may have.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.errors import UsageError
from multipos.numerics.arrays import Array

_FEW = 1024  # rows
_NOTHING = 1e-20  # of a row, what a sum does not hold


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
        return _doubled(w, a, first)
    try:
        from scipy.linalg.lapack import dtbtrs
    except ImportError:
        return _recur_by_rows(w, a, first)
    bands = np.ones((2, len(w)))
    bands[1, :-1] = -a if first is None else np.where(first[1:], 0.0, -a)
    z, _ = dtbtrs(bands, w.reshape(len(w), -1), uplo="L", diag="U")
    return np.asarray(z.reshape(w.shape))


def _doubled(w: Array, a: float, first: NDArray[np.bool_] | None) -> Array:
    """Return z by eq. (1)."""
    z = np.array(w, dtype=np.float64)
    runs = None if first is None or not first[1:].any() else np.cumsum(first)
    lag, factor = 1, float(a)
    while lag < len(z) and abs(factor) > _NOTHING:
        earlier = factor * z[:-lag]
        if runs is not None:
            earlier[runs[lag:] != runs[:-lag]] = 0.0
        z[lag:] += earlier
        lag, factor = 2 * lag, factor * factor
    return z


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

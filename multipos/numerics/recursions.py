"""Recursions of the first order, of any number of runs and columns at once.

`recur` returns z_k = w_k + a z_{k−1}. Sums of 1, 2, 4 … rows are doubled, in blocks of m rows that
stay in cache,

    z ← z + a^m z_{k−m},      m = 1, 2, 4, …,                                               (1)

where row k − m is of the same run; the last row of a block enters the next by powers of a. It is as
fast as LAPACK's substitution of two diagonals, whose import takes longer than most fits.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array

_BLOCK = 16_384  # numbers of a block
_FEWEST = 1024  # rows of a block
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
    rows = max(_FEWEST, _BLOCK * len(w) // max(w.size, 1))
    if len(w) <= rows:
        return _doubled(w, a, first)
    z = np.empty(w.shape)
    powers = (float(a) ** np.arange(1.0, rows + 1.0)).reshape(-1, *[1] * (w.ndim - 1))
    powers = powers[: np.count_nonzero(np.abs(powers) > _NOTHING)]
    for begin in range(0, len(w), rows):
        block = slice(begin, begin + rows)
        runs = None if first is None else first[block]
        z[block] = _doubled(w[block], a, runs)
        if begin:
            same = len(w) - begin if runs is None or not runs.any() else int(np.argmax(runs))
            carried = powers[:same]
            z[begin : begin + len(carried)] += carried * z[begin - 1]
    return z


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

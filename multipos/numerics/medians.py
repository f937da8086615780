"""The median, as NumPy's, which imports all of its masked arrays at the first call."""

import numpy as np
from numpy.typing import ArrayLike

from multipos.numerics.arrays import Array


def median(values: ArrayLike, *, axis: int | None = None) -> Array:
    """Return the median of all values, or along an axis; NaN where one is, or where none is there.

    Examples
    --------
    >>> float(median([3.0, 1.0, 2.0, 10.0]))
    2.5
    """
    array = np.asarray(values, dtype=np.float64)
    array = array.ravel() if axis is None else np.moveaxis(array, axis, 0)
    count = len(array)
    if not count:
        return np.asarray(np.full(array.shape[1:], np.nan))
    middle = [(count - 1) // 2, count // 2]
    low, high = np.partition(array, middle, axis=0)[middle]
    return np.where(np.isnan(array).any(axis=0), np.nan, (low + high) / 2.0)

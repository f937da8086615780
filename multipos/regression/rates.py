"""Rates of change from a time column: the slope of a short line through each row.

Differences of neighbouring samples turn the resolution of a thermometer into noise of the rate.
Instead, the line of least squares through all rows within half a window w of row k gives

    rate_k = Σ (t_i − t̄)(v_i − v̄) / Σ (t_i − t̄)²,     |t_i − t_k| ≤ w/2,                  (1)

which is exact for a steady ramp at any spacing of the rows, and passes what is slower than the
window. At the ends of the log, and beside a gap, the window has rows on one side only. With r rows
of noise s in a window, the rate has noise √12 s / (w √r): wide windows are quiet and late.

Sources: A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1964 (first degree, first derivative), here
for any spacing of the rows.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import SMALLEST, Array

_WINDOW_ROWS = 20  # of the default window: quiet enough to be of use, short beside a soak


def default_window(time: ArrayLike) -> float:
    """Return twenty times the median interval between rows, in the unit of `time`; NaN of one."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    return _WINDOW_ROWS * float(np.median(steps)) if len(steps) else np.nan


def smoothed_rate(time: ArrayLike, values: ArrayLike, *, window: float | None = None) -> Array:
    """Return the rate of change of a column by a smoothed derivative, eq. (1).

    Parameters
    ----------
    time : (n,) array
        Increasing.
    values : (n,) array
    window : float, optional
        Width w in the unit of `time`; `default_window` if not given.

    Returns
    -------
    (n,) array [unit of `values` per unit of `time`]

    Raises
    ------
    MultiposError
        Time does not increase, or by nothing to speak of, or a window holds one row only.
    UsageError
        The window is not above 0.
    """
    t = np.asarray(time, dtype=np.float64)
    v = np.asarray(values, dtype=np.float64)
    still = np.flatnonzero(~(np.diff(t) > 0.0))
    if len(t) < 2 or len(still):
        row = int(still[0]) + 2 if len(still) else 1
        raise MultiposError(
            f"the time column does not increase at row {row}, so there is no rate; "
            "sort the rows by time, or give a column with the rate."
        )
    if (shortest := float(np.diff(t).min())) < SMALLEST:
        raise MultiposError(
            f"the time column steps by {shortest:g}, too little to be squared, so there is no "
            "rate; give the time in another unit."
        )
    width = default_window(t) if window is None else window
    if not width > 0.0:
        raise UsageError(f"--rate-window must be above 0, got {width:g}.")
    first = np.searchsorted(t, t - width / 2.0, side="left")
    end = np.searchsorted(t, t + width / 2.0, side="right")
    lonely = end - first < 2
    if lonely.any():
        row = int(np.argmax(lonely)) + 1
        raise MultiposError(
            f"no other row lies within the rate window of {width:g} about row {row}; "
            "give a longer --rate-window."
        )
    return _slopes(t, v, first, end)


def _slopes(t: Array, v: Array, first: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    """Slopes of the rows first … end, from running sums of products."""
    # Running sums over a long log cancel where a window's own spread is small beside the mean;
    # sums about a centre near the window keep their digits, so rows are taken in pieces.
    slopes = np.empty(len(t))
    longest = int((end - first).max())
    step = max(4 * longest, 256)
    for start in range(0, len(t), step):
        rows = slice(start, min(start + step, len(t)))
        low, high = int(first[rows].min()), int(end[rows].max())
        x, y = t[low:high] - t[start], v[low:high] - v[start]
        sums = [
            np.concatenate(([0.0], np.cumsum(column)))
            for column in (np.ones_like(x), x, y, x * x, x * y)
        ]
        i, j = first[rows] - low, end[rows] - low
        n, sx, sy, sxx, sxy = (s[j] - s[i] for s in sums)
        slopes[rows] = (sxy - sx * sy / n) / (sxx - sx * sx / n)
    return slopes

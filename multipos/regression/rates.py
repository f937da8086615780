"""Rates of change from a time column: the slope of a short line through each row.

Differences of neighbouring samples turn the resolution of a thermometer into noise of the rate.
Instead, the line of least squares through all rows within half a window w of row k gives

    rate_k = Σ (t_i − t̄)(v_i − v̄) / Σ (t_i − t̄)²,     |t_i − t_k| ≤ w/2,                  (1)

which is exact for a steady ramp at any spacing of the rows, and passes what is slower than the
window. At the ends of the log, and beside a gap, the window has rows on one side only. With r rows
of noise s in a window, the rate has noise √12 s / (w √r): wide windows are quiet and late.

**Causal.** A device that corrects as it runs has no rows after this one. There each row moves a
value s that follows v, and a rate r that follows the steps of s, by two low passes of T = w/4,

    s ← s + (v − s) Δt/(T + Δt),      r ← r + (Δs − r Δt)/(T + Δt),                       (2)

with s = v and r = 0 in the first row of a run. It is exact for a steady ramp at any spacing of the
rows once the run is older than the window, late by 2T = w/2 as a line through the last w would be,
and of noise s √Δt/(2 T^1.5), 15 % above that of (1). v − s is kept instead of s: it is small, so
that single precision loses nothing of a slow rate in a fast log.

Sources: A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1964 (first degree, first derivative), here
for any spacing of the rows. (2): two first-order lags by implicit steps, p/(1 + pT)².
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import SMALLEST, Array
from multipos.numerics.medians import median

_WINDOW_ROWS = 20  # of the default window: quiet enough to be of use, short beside a soak


def default_window(time: ArrayLike) -> float:
    """Return twenty times the median interval between rows, in the unit of `time`; NaN of one."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    return _WINDOW_ROWS * float(median(steps)) if len(steps) else np.nan


def form_rate(
    time: Array, values: Array, *, window: float, causal: bool, run: NDArray[np.intp] | None
) -> Array:
    """Return the rate of a column by eq. (1) or (2), run by run.

    Parameters
    ----------
    time : (n,) array
        Increasing within every run.
    values : (n,) array
    window : float
    causal : bool
    run : (n,) array of int or None
        Which switch-on each row belongs to; None is one.

    Raises
    ------
    MultiposError, UsageError
        As `smoothed_rate`; the row is that of the table.
    """
    rate = np.empty(len(time))
    for rows in [np.arange(len(time))] if run is None else rows_of_runs(run):
        _require_rising(time[rows], rows, "" if run is None else " of its run")
        if causal:
            rate[rows] = causal_rate(time[rows], values[rows], window=window)
        else:
            rate[rows] = smoothed_rate(time[rows], values[rows], window=window)
    return rate


def rows_of_runs(run: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the rows of each run, in their order."""
    order = np.argsort(run, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(run[order])) + 1)


def filter_time(window: float) -> float:
    """Return T of eq. (2), which makes it as late as a line through the last `window`."""
    return window / 4.0


def causal_rate(time: ArrayLike, values: ArrayLike, *, window: float | None = None) -> Array:
    """Return the rate of change of a column from the rows up to each, eq. (2).

    Parameters
    ----------
    time : (n,) array
        Increasing; the first row begins the run.
    values : (n,) array
    window : float, optional
        Width w in the unit of `time`; `default_window` if not given.

    Returns
    -------
    (n,) array [unit of `values` per unit of `time`]

    Raises
    ------
    MultiposError
        Time does not increase.
    UsageError
        The window is not above 0.
    """
    t = np.asarray(time, dtype=np.float64)
    v = np.asarray(values, dtype=np.float64)
    _require_rising(t, np.arange(len(t)), "")
    T = filter_time(_width(t, window))
    behind = rate = 0.0  # behind is v − s
    rates = [0.0] * len(t)
    steps = zip(np.diff(t).tolist(), np.diff(v).tolist(), strict=True)
    for row, (dt, moved) in enumerate(steps, start=1):
        inverse = 1.0 / (T + dt)
        ahead = behind + moved
        followed = ahead * dt * inverse
        behind = ahead - followed
        rate += (followed - rate * dt) * inverse
        rates[row] = rate
    return np.array(rates)


def _require_rising(t: Array, rows: NDArray[np.intp], where: str) -> None:
    """Refuse a time that does not increase, by the row of the table."""
    still = np.flatnonzero(~(np.diff(t) > 0.0))
    if len(still):
        raise MultiposError(
            f"the time column does not increase at row {int(rows[still[0] + 1]) + 1}{where}, so "
            "there is no rate; sort the rows by time, name the column of the runs with --run, or "
            "give a column with the rate."
        )


def _width(t: Array, window: float | None) -> float:
    """Return the window that is asked for, or the default one."""
    width = default_window(t) if window is None else window
    if not width > 0.0:
        raise UsageError(f"--rate-window must be above 0, got {width:g}.")
    return width


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
    _require_rising(t, np.arange(len(t)), "")
    if len(t) < 2:
        raise MultiposError(
            "the time column does not increase at row 1: one row alone has no rate; give more "
            "rows, or a column with the rate."
        )
    if (shortest := float(np.diff(t).min())) < SMALLEST:
        raise MultiposError(
            f"the time column steps by {shortest:g}, too little to be squared, so there is no "
            "rate; give the time in another unit."
        )
    width = _width(t, window)
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

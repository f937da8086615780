"""Rates of change from a time column: the slope of a short line through each row.

`form_rate` returns the rate of a column run by run: `smoothed_rate` of rows on both sides, or
`causal_rate` of past rows, whose filters have the time constant `filter_time`. `default_window` is
the width where none is given, `rows_of_runs` the rows of each switch-on.

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
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import SMALLEST, Array, Places, median

_WINDOW_ROWS = 20  # of the default window: quiet enough to be of use, short beside a soak


def default_window(time: ArrayLike) -> float:
    """Return twenty times the median interval between rows, in the unit of `time`; NaN of one."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    return _WINDOW_ROWS * float(median(steps)) if len(steps) else np.nan


def form_rate(
    time: Array, values: Array, *, window: float, causal: bool, run: Places | None
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


def rows_of_runs(run: Places) -> list[Places]:
    """Return the rows of each run, in their order."""
    order = np.argsort(run, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(run[order])) + 1)


def filter_time(window: float) -> float:
    """Return T of eq. (2), which makes it as late as a line through the last `window`."""
    return window / 4.0


def causal_rate(time: Array, values: Array, *, window: float) -> Array:
    """Return the rate of change of a column from the rows up to each, eq. (2).

    Parameters
    ----------
    time : (n,) array
        Increasing; the first row begins the run.
    values : (n,) array
    window : float
        Width w in the unit of `time`.

    Returns
    -------
    (n,) array [unit of `values` per unit of `time`]

    Raises
    ------
    UsageError
        The window is not above 0.
    """
    _require_window(window)
    T = filter_time(window)
    behind = rate = 0.0  # behind is v − s
    rates = [0.0] * len(time)
    steps = zip(np.diff(time).tolist(), np.diff(values).tolist(), strict=True)
    for row, (dt, moved) in enumerate(steps, start=1):
        inverse = 1.0 / (T + dt)
        ahead = behind + moved
        followed = ahead * dt * inverse
        behind = ahead - followed
        rate += (followed - rate * dt) * inverse
        rates[row] = rate
    return np.array(rates)


def _require_rising(t: Array, rows: Places, where: str) -> None:
    """Refuse a time that does not increase, by the row of the table."""
    still = np.flatnonzero(~(np.diff(t) > 0.0))
    if len(still):
        raise MultiposError(
            f"the time column does not increase at row {int(rows[still[0] + 1]) + 1}{where}, so "
            "there is no rate; sort the rows by time, name the column of the runs with --run, or "
            "give a column with the rate."
        )


def _require_window(window: float) -> None:
    if not window > 0.0:
        raise UsageError(f"--rate-window must be above 0, got {window:g}.")


def smoothed_rate(time: Array, values: Array, *, window: float) -> Array:
    """Return the rate of change of a column by a smoothed derivative, eq. (1).

    Parameters
    ----------
    time : (n,) array
        Increasing.
    values : (n,) array
    window : float
        Width w in the unit of `time`.

    Returns
    -------
    (n,) array [unit of `values` per unit of `time`]

    Raises
    ------
    MultiposError
        Time increases by nothing to speak of, or a window holds one row only.
    UsageError
        The window is not above 0.
    """
    if len(time) < 2:
        raise MultiposError(
            "the time column does not increase at row 1: one row alone has no rate; give more "
            "rows, or a column with the rate."
        )
    if (shortest := float(np.diff(time).min())) < SMALLEST:
        raise MultiposError(
            f"the time column steps by {shortest:g}, too little to be squared, so there is no "
            "rate; give the time in another unit."
        )
    _require_window(window)
    first = np.searchsorted(time, time - window / 2.0, side="left")
    end = np.searchsorted(time, time + window / 2.0, side="right")
    lonely = end - first < 2
    if lonely.any():
        row = int(np.argmax(lonely)) + 1
        raise MultiposError(
            f"no other row lies within the rate window of {window:g} about row {row}; "
            "give a longer --rate-window."
        )
    return _slopes(time, values, first, end)


def _slopes(t: Array, v: Array, first: Places, end: Places) -> Array:
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

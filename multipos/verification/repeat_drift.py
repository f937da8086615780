"""Drift of repeated calibrations: the slope of the straight line through them, and per what it is.

- `find_drift` returns the slope of each parameter, a `Drift`, with its u and p.
- `since_1970` returns the dates of calibrations, where their readings have them.

The times of readings indicate when a calibration was made only if they share a clock. They do where
they are absolute, seconds since an epoch, or where they are ordered: no calibration begins before
another has ended; the slope is then per second. Four logs that each start at 0 s have a clock of
their own each, and only the order is left in which the calibrations were given: per run. The slope
is judged by Student's t on R − 2 degrees of freedom.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import t_tail
from multipos.sensor.calibration import Calibration

ABSOLUTE, ORDERED, GIVEN = "absolute", "ordered", "as given"
_EPOCH = 1e8  # s: three years, longer than any log; seconds since 1970 are beyond it


class Drift(NamedTuple):
    """Slope of each parameter per second or per run, its u and p; NaN where nothing is left.

    Attributes
    ----------
    drift, drift_u, drift_p : (p,) arrays
    per : str
        'time', in seconds, or 'run'.
    times : str
        'absolute', 'ordered' or, per run, 'as given'.
    """

    drift: Array
    drift_u: Array
    drift_p: Array
    per: str
    times: str


def find_drift(calibrations: Sequence[Calibration], values: Array) -> Drift:
    """Return the slopes of the parameters (R, p) of R calibrations."""
    at, times = _clock(calibrations)
    per = "run" if times == GIVEN else "time"
    centred = at - at.mean()
    square = float(centred @ centred)
    slope = centred @ values / square
    dof = len(values) - 2
    if dof <= 0:
        unknown = np.full(values.shape[1], math.nan)
        return Drift(slope, unknown, unknown.copy(), per, times)
    left = values - values.mean(axis=0) - centred[:, None] * slope
    u = np.sqrt(np.sum(left**2, axis=0) / dof / square)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = slope / u
    p = np.array([t_tail(value, dof) if math.isfinite(value) else math.nan for value in t.tolist()])
    return Drift(slope, u, p, per, times)


def _clock(calibrations: Sequence[Calibration]) -> tuple[Array, str]:
    """Return when each calibration was made, and by what clock."""
    nothing = np.array([math.nan])
    known = [c.readings.environment.get("time", nothing) for c in calibrations]
    at = np.array([time.mean() for time in known])
    if np.isfinite(at).all() and np.ptp(at) > 0.0:
        if min(float(time.min()) for time in known) >= _EPOCH:
            return at, ABSOLUTE
        if _are_apart(known):
            return at, ORDERED
    return np.arange(1.0, len(known) + 1.0), GIVEN


def since_1970(calibrations: Sequence[Calibration]) -> Array | None:
    """Return when the readings were taken [s since 1970], where their times say it."""
    at, times = _clock(calibrations)
    return at if times == ABSOLUTE else None


def _are_apart(times: Sequence[Array]) -> bool:
    """Tell whether none begins before another has ended."""
    spans = sorted((float(time.min()), float(time.max())) for time in times)
    return all(end < begin for (_, end), (begin, _) in pairwise(spans))

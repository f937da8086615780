"""Is it still the same instrument? Changes of a recalibration, their rate, and the next due date.

- `find_changes` returns the `Change` of each parameter, with its `Rate`.
- `find_drift` returns the slope of each parameter, a `Drift`, with its u and p.
- `dates_of` returns when calibrations were made.
- `expanded_apart` returns the U of what they do not share.

Of a parameter p with values p₁ of the first calibration and p_R of the last, each with the expanded
uncertainty U of what they do not share (gravity taken out, and level and what else the bench budget
states where both are of one day),

    change = p_R − p₁,    U² = U₁² + U_R²,    E_n = |change| / U,                             (1)

E_n ≤ 1 says that both agree (ISO/IEC 17043 uses it between laboratories). Of m parameters one is
beyond 1 by chance more often: with the p of the largest change over its u by Student's t, the
chance that any of them is as large is 1 − (1 − p)^m at most (Šidák). Over the time T between
two calibrations the rate is change / T with U / T. For three and more it is the slope of the
weighted straight line, w = 1/u²,

    rate = S_w(t − t̄)p / S_w(t − t̄)²,    u² = max(1, χ²/(R − 2)) / S_w(t − t̄)²,             (2)

U with the k of the calibrations, or, where χ² rejects a straight line at 5 %, with Student's on
R − 2 degrees of freedom. With a
limit on the change, or on the value, the next calibration is due when the value that the rate
predicts, or the end of its U, reaches the limit,

    |change + rate Δ| + U_rate Δ = limit,                                                    (3)

Δ from the last calibration: the drift method, the simplest of ILAC-G24 / OIML D 10 that uses the
measured rate of this instrument. Beyond ten years no date is given.

**Drift** is the slope of the straight line through all repeats alike, judged by Student's t on
R − 2 degrees of freedom. The times of readings indicate when a calibration was made only if they
share a clock. They do where they are absolute, seconds since an epoch, or where they are ordered:
no calibration begins before another has ended; the slope is then per second. Four logs that each
start at 0 s have a clock of their own each, and only the order is left in which the calibrations
were given: per run.

References
----------
ILAC-G24:2022 / OIML D 10:2022 (recalibration intervals); ISO/IEC 17043 (E_n).
"""

import math
import re
from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import UsageError
from multipos.files.limits import Limit, read_limits
from multipos.files.numbers import pretty_unit, readable_unit
from multipos.files.spelling import StrPath, near
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile, coverage_factor, coverage_factors, t_tail
from multipos.results import Keyed, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import in_tesla
from multipos.uncertainty.propagation import evaluate_budget, welch_satterthwaite

LimitsSource = StrPath | dict[str, Any]
Stated = float | tuple[float | None, float | None]  # a limit on |change|, or the two of the value
DAY = 86400.0  # s
YEAR = 365.25 * DAY  # s
_LEVEL = 0.05  # at which χ² rejects a straight line
_LONGEST = 10.0  # years to a due date
_SHORTEST = 1.0 / 365.25  # years between calibrations, below which there is no rate
_STATED = re.compile(r"^(?P<value>[\d.]+(?:[eE][+-]?\d+)?)\s*(?P<unit>.*)$")
_OF_G = {"g": 1.0, "mg": 1e-3, "ug": 1e-6, "µg": 1e-6, "μg": 1e-6}
ABSOLUTE, ORDERED, GIVEN = "absolute", "ordered", "as given"  # of the times of calibrations
_EPOCH = 1e8  # s: three years, longer than any log; seconds since 1970 are beyond it
_RELATIVE = {"%": 1e-2, "ppm": 1e-6, "mrad": 1e-3}


class Rate(NamedTuple):
    """Change per year, and its expanded uncertainty."""

    value: float
    U: float


@frozen
class Change(Keyed):
    """What became of one parameter between the first and the last calibration.

    Attributes
    ----------
    output, term, name : str
    change, U, En : float
        Eq. (1); U and En are NaN where a calibration has no degrees of freedom.
    p : float
        Chance of as large a change, of this parameter alone.
    per_year : Rate or None
        Eq. (2); None where the dates are not a day apart.
    limit : float, or pair of float or None, or None
        On |change|, or [lower, upper] of the value.
    within : bool or None
        None without a limit.
    due : str or None
        ISO date by eq. (3); None without a rate or a limit, or beyond ten years.
    """

    output: str
    term: str
    name: str
    change: float
    U: float
    En: float
    p: float
    per_year: Rate | None
    limit: Stated | None
    within: bool | None
    due: str | None


def dates_of(found: Sequence[Calibration]) -> Array:
    """Return when calibrations were made [s since 1970]: by their readings, else by their files."""
    at, times = _clock(found)
    return at if times == ABSOLUTE else np.array([_seconds(c.created) for c in found])


def find_changes(found: Sequence[Calibration], limits: LimitsSource | None) -> tuple[Change, ...]:
    """Return the changes of every parameter, eqs. (1) to (3).

    Parameters
    ----------
    found : R calibrations, in the order of time
    limits : path, mapping, or text such as 'bias=1mg,scale=500ppm', optional
        A file or mapping limits the value, a text |change| by name or kind.
    """
    last = found[-1]
    at = dates_of(found)
    years, day = (at - at[0]) / YEAR, at // DAY
    values = np.array([c.parameters for c in found])
    ends = [_apart(c, same_day=bool(day[0] == day[-1])) for c in (found[0], last)]
    change = values[-1] - values[0]
    both = np.hypot(*(expanded(c, *of) for c, of in zip((found[0], last), ends, strict=True)))
    tails = _tails(change, *ends)
    rates = None
    if np.ptp(years) >= _SHORTEST:
        rates = _rates(years, values, expanded_apart(found, day), last)
    stated = _stated_limits(limits, last)
    changes = []
    for i, (name, (output, term)) in enumerate(zip(last.names, last.model.keys, strict=True)):
        rate = None if rates is None else Rate(*rates[:, i].tolist())
        low, high, value = _bounds(stated.get(name), values[0, i], values[-1, i])
        limited = stated.get(name) is not None
        changes.append(
            Change(
                output=output,
                term=str(term),
                name=name,
                change=float(change[i]),
                U=float(both[i]),
                En=float(abs(change[i]) / both[i]) if both[i] > 0.0 else math.nan,
                p=tails[i],
                per_year=rate,
                limit=stated.get(name),
                within=bool(low <= value <= high) if limited else None,
                due=_due(value, rate, low, high, float(at[-1])) if limited else None,
            )
        )
    return tuple(changes)


def expanded_apart(found: Sequence[Calibration], day: Array) -> Array:
    """Return U (R, p) of what calibrations do not all share, each of its day."""
    same = bool((day == day[0]).all())
    return np.array([expanded(c, *_apart(c, same_day=same)) for c in found])


def expanded(c: Calibration, u: Array, dof: Array) -> Array:
    """Return U (p,) at the confidence of a calibration."""
    return np.asarray(coverage_factors(c.confidence, dof) * u)


def _apart(c: Calibration, *, same_day: bool) -> tuple[Array, Array]:
    """Return u and degrees of freedom (p,) of what a calibration does not share with another."""
    budget = evaluate_budget(c).apart(same_day=same_day)
    u = np.sqrt(np.diag(budget.covariance))
    alone = np.isclose(u**2, c.u**2, rtol=1e-9, atol=0.0)
    stated = any(row.common for row in budget.rows)
    return u, np.where(alone, c.parameter_dof, budget.dof if stated else c.dof_of_outputs)


def _tails(change: Array, *ends: tuple[Array, Array]) -> list[float]:
    """Return the chance of each change, by Student's t on the degrees of freedom of both u."""
    u = np.array([of[0] for of in ends])
    dof = welch_satterthwaite(u, np.array([of[1] for of in ends]))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = change / np.hypot(*u)
    pairs = zip(t.tolist(), dof.tolist(), strict=True)
    return [
        t_tail(value, nu) if math.isfinite(value) and nu > 0 else math.nan for value, nu in pairs
    ]


def _seconds(created: str) -> float:
    try:
        made = datetime.fromisoformat(created)
    except ValueError:
        return 0.0  # a file of another hand: no rate
    return (made if made.tzinfo else made.replace(tzinfo=UTC)).timestamp()


def _rates(years: Array, values: Array, U: Array, c: Calibration) -> Array:
    """Return rate and U (2, p) per year, eq. (2); of two calibrations the difference over time."""
    if len(years) == 2:
        span = years[1] - years[0]
        return np.asarray(np.array([values[1] - values[0], np.hypot(U[0], U[1])]) / span)
    k = coverage_factors(c.confidence, c.parameter_dof)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.where(U > 0.0, (k / U) ** 2, 1.0)
    mean = (w * years[:, None]).sum(axis=0) / w.sum(axis=0)
    t = years[:, None] - mean
    square = (w * t**2).sum(axis=0)
    slope = (w * t * values).sum(axis=0) / square
    left = values - (w * values).sum(axis=0) / w.sum(axis=0) - slope * t
    excess = (w * left**2).sum(axis=0) / (len(years) - 2)
    dof = len(years) - 2.0
    rejected = excess * dof > chi2_quantile(1.0 - _LEVEL, dof)
    factor = np.where(rejected, coverage_factor(c.confidence, dof), k)
    return np.asarray([slope, factor * np.sqrt(np.maximum(excess, 1.0) / square)])


def _bounds(limit: Stated | None, first: float, last: float) -> tuple[float, float, float]:
    """Return the lower and upper bound of what is limited, and where it is now."""
    if isinstance(limit, tuple):
        low, high = limit
        return -math.inf if low is None else low, math.inf if high is None else high, last
    return (-math.inf, math.inf, last) if limit is None else (-limit, limit, last - first)


def _due(value: float, rate: Rate | None, low: float, high: float, at: float) -> str | None:
    """Return the date on which the rate, or the end of its U, reaches a bound, eq. (3)."""
    if rate is None or not math.isfinite(rate.U):
        return None
    years = 0.0
    if low <= value <= high:
        up, down = rate.value + rate.U, rate.U - rate.value
        reached = [(high - value) / up] if up > 0.0 else []
        reached += [(value - low) / down] if down > 0.0 else []
        years = min(reached, default=math.inf)
    if not years <= _LONGEST:
        return None
    day = date(1970, 1, 1) + timedelta(seconds=at)
    return (day + timedelta(days=365.25 * years)).isoformat()


def _stated_limits(limits: LimitsSource | None, c: Calibration) -> dict[str, Stated]:
    """Return the limit of each parameter that has one."""
    if limits is None:
        return {}
    if isinstance(limits, str) and "=" in limits:
        return _of_changes(limits, c)
    known = {one.name: one for one in read_limits(limits)}
    strange = [name for name in known if name not in c.names]
    if strange:
        raise UsageError(
            f"--limits: there is no parameter '{strange[0]}'{near(strange[0], c.names)}"
        )
    return {name: _pair(one) for name, one in known.items()}


def _pair(limit: Limit) -> tuple[float | None, float | None]:
    low, high = (side if math.isfinite(side) else None for side in (limit.lsl, limit.usl))
    return low, high


def _of_changes(text: str, c: Calibration) -> dict[str, Stated]:
    """Return limits on |change|, by name or kind, of a text as 'bias=1mg,scale=500ppm'."""
    found: dict[str, Stated] = {}
    kinds = [name.partition("_")[0] for name in c.names]
    for part in text.split(","):
        name, _, stated = (piece.strip() for piece in part.partition("="))
        match = _STATED.match(stated)
        meant = [n for n, kind in zip(c.names, kinds, strict=True) if name in (n, kind)]
        if not meant:
            offered = near(name, (*dict.fromkeys(kinds), *c.names))
            raise UsageError(f"--limits: there is no parameter nor kind '{name}'{offered}")
        if match is None:
            raise UsageError(f"--limits: '{part.strip()}' is no limit; write one as in bias=1mg.")
        for each in meant:
            found[each] = _in_unit(float(match["value"]), match["unit"], each, c)
    return found


def _in_unit(value: float, unit: str, name: str, c: Calibration) -> float:
    """Return a limit in the unit of a parameter; g and ppm are of the output's own scale."""
    i = c.names.index(name)
    own = c.model.units[i]
    if unit in ("", own):
        return value
    output = c.model.keys[i][0]
    scales: dict[str, float] = dict(zip(c.names, np.abs(c.parameters).tolist(), strict=True))
    scale = scales.get(f"scale_{output}", 1.0)
    factor = _OF_G.get(unit) if name.startswith("bias_") else None
    factor = _RELATIVE.get(unit) if factor is None else factor
    if factor is None and name.startswith("bias_") and in_tesla(unit) and in_tesla(own):
        return value * (in_tesla(unit) or 1.0) / (in_tesla(own) or 1.0)
    if factor is not None:
        return value * factor * scale
    printed = _printed_units(own)
    named = pretty_unit(unit.replace("μ", "µ"))
    for one in (named, re.sub(r"^u", "µ", named)):
        if one in printed:
            return value / printed[one]
    known = (own, *_RELATIVE, *(_OF_G if name[:4] == "bias" else ()), *printed)
    listed = ", ".join(dict.fromkeys(known))
    raise UsageError(f"--limits: '{unit}' is no unit of {name}; give one of {listed}.")


def _printed_units(own: str) -> dict[str, float]:
    """Return the units that a quantity may be printed in, each with its factor."""
    shown = (readable_unit(10.0**exponent, own) for exponent in range(-15, 10))
    return {unit: factor for factor, unit in shown}


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


def _are_apart(times: Sequence[Array]) -> bool:
    """Tell whether none begins before another has ended."""
    spans = sorted((float(time.min()), float(time.max())) for time in times)
    return all(end < begin for (_, end), (begin, _) in pairwise(spans))

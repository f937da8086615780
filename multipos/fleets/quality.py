"""Quality figures of a line: yield, capability, spread without the measurement, wrong verdicts.

- `describe` returns what is said of one number of all units.
- `proportion` is a share with its interval, a `CoveredFigure`; `spread_of` the `UnitSpread` of
  values, `capability` its Cpk or Ppk, `wrong_verdicts` the two risks.

For x of n units with mean m, limits L and U, and σ a standard deviation,

    C = min(m − L, U − m) / 3σ,                                                             (1)

Cpk with σ within stations (ν = n − S degrees of freedom), Ppk with σ over all units (ν = n − 1).
Both hold what the measurement adds: with u_j the standard uncertainty of unit j, less what all
have in common, σ_true² = σ² − mean u_j², and Ppk of σ_true is that of the units themselves. Their
intervals are normal ones,

    var C = σ² / 9nσ_C² + C² (σ²/σ_C²)² / 2ν,    σ_C the σ that C is taken with,            (2)

which for σ_C = σ is Bissell's. A yield of k in n lies between the quantiles of beta laws (Clopper
and Pearson), which cover at least what they say.

With true values N(m, σ_true²) and measured ones N(true, u²), the share of units that pass although
they are outside (consumer's risk) and that fail although they are inside (producer's risk) is

    ∫ φ(t) P(measured on the other side | t) dt   over t outside, and inside, the limits.   (3)

Sources: A. F. Bissell, Applied Statistics 39, 1990, 331–340. NIST/SEMATECH e-Handbook of
Statistical Methods, section 6.1.6. JCGM 106:2012, section 9.5 (global risk).
"""

from typing import Any, NamedTuple

import numpy as np

from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import beta_quantile, erf, normal_quantile

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_GRID = 2001  # of eq. (3): its error is below 1e-6
_REACH = 8.0  # standard deviations that it goes to


class CoveredFigure(NamedTuple):
    """A figure and the interval that covers it."""

    value: float
    low: float
    high: float


def proportion(successes: int, trials: int, confidence: float = 0.95) -> CoveredFigure:
    """Return a proportion with the interval of Clopper and Pearson."""
    tail = (1.0 - confidence) / 2.0
    left = trials - successes
    low = beta_quantile(tail, successes, left + 1.0) if successes else 0.0
    high = beta_quantile(1.0 - tail, successes + 1.0, left) if left else 1.0
    return CoveredFigure(successes / trials, low, high)


class UnitSpread(NamedTuple):
    """How the values of n units spread, over all, within stations, and without measurement."""

    n: int
    mean: float
    sd: float
    within: float
    dof_within: float
    true: float  # NaN where the measurement explains all


def spread_of(values: Array, u: Array | None, stations: Places) -> UnitSpread:
    """Return how values (n,) spread.

    Parameters
    ----------
    values : (n,) array
    u : (n,) array or None
        Standard uncertainties, without what all units have in common.
    stations : (n,) array of int
    """
    count = len(values)
    if count < 2:
        mean = float(values.mean()) if count else np.nan
        return UnitSpread(count, mean, np.nan, np.nan, 0.0, np.nan)
    mean, variance = float(values.mean()), float(values.var(ddof=1))
    _, place = np.unique(stations, return_inverse=True)
    means = np.bincount(place, values) / np.bincount(place)
    dof = count - len(means)
    within = float(np.sum((values - means[place]) ** 2)) / dof if dof else np.nan
    added = np.nan if u is None else float(np.mean(u**2))
    true = np.sqrt(variance - added) if variance > added else np.nan
    return UnitSpread(count, mean, np.sqrt(variance), np.sqrt(within), float(dof), float(true))


def capability(
    spread: UnitSpread, lsl: float, usl: float, which: str, confidence: float = 0.95
) -> CoveredFigure | None:
    """Return Cpk ('within'), Ppk ('sd') or Ppk of the units themselves ('true'), eqs. (1), (2).

    None where there is no limit or no spread.
    """
    sigma = float(getattr(spread, which))
    side = min(spread.mean - lsl, usl - spread.mean)
    dof = spread.dof_within if which == "within" else spread.n - 1.0
    if not (np.isfinite(side) and sigma > 0.0 and dof > 0.0):
        return None
    value = side / (3.0 * sigma)
    ratio = (spread.sd / sigma) ** 2
    by_sigma = ratio if which == "true" else 1.0
    variance = ratio / (9.0 * spread.n) + value**2 * by_sigma**2 / (2.0 * dof)
    half = normal_quantile(0.5 + confidence / 2.0) * np.sqrt(variance)
    return CoveredFigure(value, value - half, value + half)


def wrong_verdicts(spread: UnitSpread, u: float, lsl: float, usl: float) -> dict[str, float] | None:
    """Return consumer's and producer's risk, shares of all units, eq. (3)."""
    if not (spread.true > 0.0 and u > 0.0):
        return None
    t = np.linspace(-_REACH, _REACH, _GRID)
    weight = np.exp(-0.5 * t**2)
    weight /= weight.sum()
    true = spread.mean + spread.true * t
    root = u * np.sqrt(2.0)
    accepted = 0.5 * (erf((usl - true) / root) - erf((lsl - true) / root))
    inside = (true >= lsl) & (true <= usl)
    return {
        "consumer": float(np.sum(weight * accepted * ~inside)),
        "producer": float(np.sum(weight * (1.0 - accepted) * inside)),
    }


def describe(
    name: str,
    unit: str,
    values: Array,
    u: Array | None,
    stations: Places,
    limits: tuple[float, float] | None,
    confidence: float,
) -> dict[str, Any]:
    """Return what is said of one number of all units; values may be NaN."""
    finite = np.isfinite(values)
    x, at = values[finite], stations[finite]
    own = None if u is None else u[finite]
    spread = spread_of(x, own, at)
    said: dict[str, Any] = {
        "name": name,
        "unit": unit,
        "count": spread.n,
        "mean": spread.mean,
        "sd": spread.sd,
        "quantiles": {f"{p:g}": float(np.quantile(x, p)) for p in QUANTILES} if len(x) else {},
        "sd_within": spread.within,
        "sd_true": spread.true,
        "u": np.nan if own is None or not len(x) else float(np.sqrt(np.mean(own**2))),
    }
    return said | _against_limits(spread, said["u"], limits, confidence)


def _against_limits(
    spread: UnitSpread, u: float, limits: tuple[float, float] | None, confidence: float
) -> dict[str, Any]:
    """Return capability and wrong verdicts; None where a number has no limit."""
    lsl, usl = (-np.inf, np.inf) if limits is None else limits
    said: dict[str, Any] = {
        "lsl": lsl if np.isfinite(lsl) else None,
        "usl": usl if np.isfinite(usl) else None,
    }
    for key, which in (("cpk", "within"), ("ppk", "sd"), ("ppk_true", "true")):
        found = capability(spread, lsl, usl, which, confidence)
        said[key] = None if found is None else found._asdict()
    limited = said["lsl"] is not None or said["usl"] is not None
    said["risk"] = wrong_verdicts(spread, u, lsl, usl) if limited else None
    return said

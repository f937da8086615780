"""Whether a station moved: steps and trends of its units' parameters in the order of time.

- `find_drift` returns the parameters that moved, by station.
- `normal_scores` and `find_step` are the test of one.

The n values of a parameter at one station, in their order, are replaced by the normal scores of
their ranks, so that a few bad units count no more than their place. For a step after the k-th,

    Z_k = |S_k − k S_n/n| / √(k (n − k)/n),    S_k the sum of the first k scores,             (1)

and the step is put where Z is largest, over the middle nine tenths. Its chance without a step is

    P(max Z ≥ b) ≈ φ(b) [(b − 1/b) ln((t₁ (1 − t₀))/(t₀ (1 − t₁))) + 4/b],   t₀ = 1 − t₁,     (2)

which errs to the safe side, as it is for a path that is looked at between units too. What is as
well or better described by a straight line is a trend. Of all parameters and stations those are
named of which at most one in a hundred is so by chance.

Sources: R. Miller, D. Siegmund, Biometrics 38, 1982, 1011–1016, eq. (8).
"""

from typing import Any

import numpy as np

from multipos.fleets.outlying_units import discoveries
from multipos.fleets.pictures import line_order
from multipos.fleets.stations import near_median
from multipos.fleets.unit_results import Units
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import normal_quantiles

_EDGE = 0.05  # of the units at either end, in which no step is looked for
_FEWEST = 20  # units of a station


def find_drift(units: Units, counted: Mask) -> list[dict[str, Any]]:
    """Return the parameters that moved, by station, the surest first.

    Parameters
    ----------
    units : Units
    counted : (B,) array of bool
        Units whose numbers count.
    """
    stations = np.array(units.station)
    order, timed = line_order(units)
    tests: list[tuple[str, int, Places, int, float]] = []
    for station in dict.fromkeys(units.station):
        mine = order[(counted & (stations == station))[order]]
        if len(mine) < _FEWEST:
            continue
        for place in range(len(units.names)):
            finite = mine[np.isfinite(units.parameters[mine, place])]
            if len(finite) < _FEWEST:
                continue
            after, chance = find_step(normal_scores(units.parameters[finite, place]))
            tests.append((station, place, finite, after, chance))
    if not tests:
        return []
    found = discoveries(np.array([test[-1] for test in tests]))
    return [_said(units, timed, *tests[each]) for each in found.tolist()]


def normal_scores(values: Array) -> Array:
    """Return the normal scores of the ranks of values (n,), with variance one."""
    order = np.argsort(values, kind="stable")
    ranks = np.empty(len(values))
    ranks[order] = np.arange(1, len(values) + 1)
    same, place = np.unique(values, return_inverse=True)
    if len(same) < len(values):  # equal values share their mean rank
        ranks = (np.bincount(place, ranks) / np.bincount(place))[place]
    scores = normal_quantiles((ranks - 0.5) / len(values))
    spread = float(scores.std())
    return scores / spread if spread > 0.0 else scores


def find_step(scores: Array) -> tuple[int, float]:
    """Return after how many of n scores a step is likeliest, and its chance without one."""
    n = len(scores)
    k = np.arange(1, n)
    partial = np.cumsum(scores)[:-1] - k * scores.mean()
    z = np.abs(partial) / np.sqrt(k * (n - k) / n)
    edge = max(int(np.ceil(_EDGE * n)), 2)
    inside = (k >= edge) & (k <= n - edge)
    after = int(k[inside][np.argmax(z[inside])])
    b = float(z[inside].max())
    if b < 1.0:
        return after, 1.0
    t0 = edge / n
    log = 2.0 * np.log((1.0 - t0) / t0)
    density = np.exp(-0.5 * b**2) / np.sqrt(2.0 * np.pi)
    return after, float(min(density * ((b - 1.0 / b) * log + 4.0 / b), 1.0))


def _said(
    units: Units, timed: bool, station: str, place: int, mine: Places, after: int, chance: float
) -> dict[str, Any]:
    values = units.parameters[mine, place]
    same = np.zeros(len(mine), dtype=np.intp)
    kept = near_median(values, np.isfinite(values), same)
    before, behind = values[:after][kept[:after]], values[after:][kept[after:]]
    x = np.arange(len(mine)) / (len(mine) - 1.0) - 0.5
    slope = float(np.sum(x[kept] * values[kept]) / np.sum(x[kept] ** 2))
    centred = values[kept] - values[kept].mean()
    by_line = float(np.sum((centred - slope * (x[kept] - x[kept].mean())) ** 2))
    by_step = float(np.sum((before - before.mean()) ** 2) + np.sum((behind - behind.mean()) ** 2))
    trend = by_line <= by_step
    variance = min(by_line, by_step) / (len(centred) - 2)
    if trend:
        size, u = slope, np.sqrt(variance / np.sum(x[kept] ** 2))
    else:
        size = float(behind.mean() - before.mean())
        u = np.sqrt(variance * (1.0 / len(before) + 1.0 / len(behind)))
    first = int(mine[after])
    return {
        "station": station,
        "name": units.names[place],
        "kind": "trend" if trend else "step",
        "from_unit": units.unit[first],
        "time": float(units.time[first]) if timed else None,
        "value": size,
        "u": float(u),
        "p": chance,
        "order": "time" if timed else "rows",
    }

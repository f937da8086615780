"""Units that do not belong to the others: far from them in all parameters together.

- `find_outliers` returns them, the farthest first.
- `discoveries` returns which of many p values are below a false discovery rate.

With θ_j what is known of unit j, its parameters and the cube root of its mean squared residual
(which is nearly normal, after Wilson and Hilferty), less the median of its station, p numbers in
all, and S their covariance,

    T² = θ_j' (S + D_j)⁻¹ θ_j,    T² (n − p)/(p (n − 1)) ~ F(p, n − p),                     (1)

D_j what the unit was measured worse than others, u_j² less its median, where that is positive, so
that a poor measurement is not taken for another kind of unit. S comes from the units nearest to
the median, repeated until they stay the same, scaled so that as many as expected lie within: a
hundredth of bad ones does not widen it. Of many units some are far by chance; those are named of
which at most one in a hundred is so (false discovery rate of Benjamini and Hochberg).

Fewer than 3 (p + 1) units do not give S. There each number is judged alone: the farthest units are
taken away one after another, up to a quarter of all, and with m and s of the k that are left

    t² = (x_j − m)²/(s² (1 + 1/k) + D_jj) ~ F(1, k − 1).                                    (2)

All are named up to the last whose chance, times the units and numbers that are looked at, is below
a hundredth, so that two that are off do not hide each other.

Sources: H. Hotelling 1931, Ann. Math. Statist. 2. P. J. Rousseeuw, K. Van Driessen, Technometrics
41, 1999 (concentration steps). Y. Benjamini, Y. Hochberg, J. R. Stat. Soc. B 57, 1995. B. Rosner,
Technometrics 25, 1983, 165–172 (few units).
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from multipos.fleets.stations import NORMAL
from multipos.fleets.unit_results import Units
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.numerics.quantiles import chi2_quantile, f_tail

RATE = 0.01  # of false discoveries
_KEPT = 0.975  # share of a normal law that S is taken from
_STEPS = 10
_FEW = 3  # times as many units as parameters give their covariance
_PART = 4  # of few units one in so many may be off
_LEAST = -3.0  # sds of a residual: estimated orientation errors may take up noise, and no fault
_SHOWN = 3  # parameters that are named of a unit
_ROWS = 50_000  # units that are worked on at once

_Excess = Callable[[Places], Array]  # D of eq. (1), of rows


def find_outliers(units: Units, counted: Mask) -> list[dict[str, Any]]:
    """Return the units that do not belong, the farthest first.

    Parameters
    ----------
    units : Units
    counted : (B,) array of bool
        Units whose numbers count.
    """
    mine = np.flatnonzero(counted & np.isfinite(units.parameters).all(axis=1))
    mine = mine[np.isfinite(units.rms[mine])]
    n, p = len(mine), len(units.names) + 1
    if p == 1 or n < _PART:
        return []
    theta = np.empty((n, p))  # column by column, as there may be millions of rows
    for place in range(p - 1):
        theta[:, place] = units.parameters[mine, place]
    theta[:, -1] = np.cbrt(units.rms[mine] ** 2)
    _, station = np.unique(np.array(units.station)[mine], return_inverse=True)
    for place in np.unique(station).tolist():
        theta[station == place] -= median(theta[station == place], axis=0)
    scale = NORMAL * np.array([median(np.abs(column)) for column in theta.T])
    if not (scale > 0.0).all():
        return []  # as many units are exactly alike, nothing tells how units differ
    theta /= scale
    theta[:, -1] = np.maximum(theta[:, -1], _LEAST)
    judged = _each_alone if n < _FEW * (p + 1) else _together
    found, distance, p_values, sd = judged(theta, lambda rows: _excess(units, mine, rows, scale))
    return [
        {
            "unit": units.unit[mine[row]],
            "station": units.station[mine[row]],
            "statistic": float(distance[row]),
            "p": float(p_values[row]),
            "parameters": _farthest(units, theta[row] / sd, int(mine[row])),
        }
        for row in sorted(found.tolist(), key=lambda row: -distance[row])
    ]


def _excess(units: Units, mine: Places, rows: Places, scale: Array) -> Array:
    """Return D (k, p) of eq. (1) of some rows, on the scale of the numbers."""
    excess = np.zeros((len(rows), len(scale)))
    for place in range(len(scale) - 1):
        u2 = (units.u[mine, place] / scale[place]) ** 2
        excess[:, place] = np.maximum(u2[rows] - median(u2), 0.0)
    return excess


def _together(theta: Array, excess: _Excess) -> tuple[Places, Array, Array, Array]:
    """Return the units that are far in all numbers together, T² and p (n,), and sds (p,)."""
    covariance = _concentrated(theta)
    distance = _squared(theta, covariance)
    p_values = _tail(distance, *theta.shape)
    near = np.flatnonzero(p_values < RATE)
    for row, added in zip(near.tolist(), excess(near), strict=True):
        if added.any():
            worse = covariance + np.diag(added)
            distance[row] = float(theta[row] @ np.linalg.solve(worse, theta[row]))
    p_values[near] = _tail(distance[near], *theta.shape)
    return discoveries(p_values), distance, p_values, np.sqrt(np.diag(covariance))


def _each_alone(theta: Array, excess: _Excess) -> tuple[Places, Array, Array, Array]:
    """Return the units that are far in a number, its t² and p (n,), and sds (p,), eq. (2)."""
    n, p = theta.shape
    distance, p_values, sd = np.zeros(n), np.ones(n), np.empty(p)
    for place, (x, added) in enumerate(zip(theta.T, excess(np.arange(n)).T, strict=True)):
        kept, away, named = np.ones(n, dtype=np.bool_), [], 0
        for _ in range(n // _PART):
            row = int(np.argmax(np.where(kept, np.abs(x - x[kept].mean()), -1.0)))
            kept[row] = False
            away.append(row)
            if p * (n - len(away) + 1) * _alone(x[kept], x[row], added[row])[1] < RATE:
                named = len(away)
        kept[away[named:]] = True
        sd[place] = x[kept].std(ddof=1)
        for row in away[:named]:
            t2, chance = _alone(x[kept], x[row], added[row])
            distance[row] = max(distance[row], t2)
            p_values[row] = min(p_values[row], n * p * chance)
    return np.flatnonzero(p_values < RATE), distance, p_values, sd


def _alone(kept: Array, x: float, added: float) -> tuple[float, float]:
    """Return t² of eq. (2), and its chance."""
    t2 = (x - kept.mean()) ** 2 / (kept.var(ddof=1) * (1.0 + 1.0 / len(kept)) + added)
    return float(t2), f_tail(float(t2), 1.0, len(kept) - 1.0)


def _concentrated(theta: Array) -> Array:
    """Return the covariance (p, p) of the bulk of (n, p) numbers about zero."""
    p = theta.shape[1]
    limit = chi2_quantile(_KEPT, float(p))
    middle = chi2_quantile(0.5, float(p))
    kept = np.maximum(theta.max(axis=1), -theta.min(axis=1)) <= np.sqrt(limit)
    if kept.sum() <= 2 * p:
        kept = np.ones(len(theta), dtype=np.bool_)
    covariance = np.eye(p)
    for _ in range(_STEPS):
        covariance = _covariance(theta, kept)
        distance = _squared(theta, covariance)
        covariance *= median(distance) / middle
        before, kept = kept, distance <= limit * median(distance) / middle
        if np.array_equal(before, kept):
            break
    return covariance


def _squared(theta: Array, covariance: Array) -> Array:
    half = np.linalg.inv(np.linalg.cholesky(covariance)).T
    distance = np.empty(len(theta))
    for rows in _blocks(len(theta)):
        white = theta[rows] @ half
        distance[rows] = np.einsum("np,np->n", white, white)
    return distance


def _covariance(theta: Array, kept: Mask) -> Array:
    """Return the covariance (p, p) of the rows of (n, p) that are kept."""
    count, mean = int(kept.sum()), np.mean(theta, axis=0, where=kept[:, None])
    square = np.zeros((len(mean), len(mean)))
    for rows in _blocks(len(theta)):
        left = theta[rows][kept[rows]] - mean
        square += left.T @ left
    return square / (count - 1)


def _blocks(count: int) -> Iterator[slice]:
    """Yield rows, few enough at a time for their copies to be nothing."""
    for first in range(0, count, _ROWS):
        yield slice(first, first + _ROWS)


def _tail(distance: Array, n: int, p: int) -> Array:
    ratios = distance * (n - p) / (p * (n - 1.0))
    return np.array([f_tail(ratio, float(p), float(n - p)) for ratio in ratios.tolist()])


def discoveries(p_values: Array) -> Places:
    """Return which p values are so small that of all these at most `RATE` are so by chance."""
    order = np.argsort(p_values)
    allowed = RATE * np.arange(1, len(order) + 1) / len(order)
    below = np.flatnonzero(p_values[order] <= allowed)
    return order[: below[-1] + 1] if len(below) else order[:0]


def _farthest(units: Units, away: Array, unit: int) -> list[dict[str, Any]]:
    order = np.argsort(-np.abs(away))[:_SHOWN]
    return [
        {
            "name": (*units.names, "rms")[i],
            "value": float((*units.parameters[unit], units.rms[unit])[i]),
            "deviation": float(away[i]),
        }
        for i in order.tolist()
    ]

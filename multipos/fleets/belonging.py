"""Units that do not belong to the others: far from them in all parameters together.

With θ_j what is known of unit j, its parameters and the cube root of its mean squared residual
(which is nearly normal, after Wilson and Hilferty), less the median of its station, p numbers in
all, and S their covariance,

    T² = θ_j' (S + D_j)⁻¹ θ_j,    T² (n − p)/(p (n − 1)) ~ F(p, n − p),                     (1)

D_j what the unit was measured worse than others, u_j² less its median, where that is positive, so
that a poor measurement is not taken for another kind of unit. S comes from the units nearest to
the median, repeated until they stay the same, scaled so that as many as expected lie within: a
hundredth of bad ones does not widen it. Of many units some are far by chance; those are named of
which at most one in a hundred is so (false discovery rate of Benjamini and Hochberg).

Sources: H. Hotelling 1931, Ann. Math. Statist. 2. P. J. Rousseeuw, K. Van Driessen, Technometrics
41, 1999 (concentration steps). Y. Benjamini, Y. Hochberg, J. R. Stat. Soc. B 57, 1995.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.fleets.stations import NORMAL
from multipos.fleets.units import Units
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median

RATE = 0.01  # of false discoveries
_KEPT = 0.975  # share of a normal law that S is taken from
_STEPS = 10
_FEW = 3  # times as many units as parameters are needed
_SHOWN = 3  # parameters that are named of a unit
_ROWS = 50_000  # units that are worked on at once


def find_outliers(units: Units, counted: NDArray[np.bool_]) -> list[dict[str, Any]]:
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
    if p == 1 or n < _FEW * (p + 1):
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
    covariance = _concentrated(theta)
    distance = _squared(theta, covariance)
    p_values = _tail(distance, n, p)
    near = np.flatnonzero(p_values < RATE)
    excess = np.zeros((len(near), p))
    for place in range(p - 1):
        u2 = (units.u[mine, place] / scale[place]) ** 2
        excess[:, place] = np.maximum(u2[near] - median(u2), 0.0)
    for place, row in enumerate(near.tolist()):
        if excess[place].any():
            worse = covariance + np.diag(excess[place])
            distance[row] = float(theta[row] @ np.linalg.solve(worse, theta[row]))
    p_values[near] = _tail(distance[near], n, p)
    found = discoveries(p_values)
    sd = np.sqrt(np.diag(covariance))
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


def _concentrated(theta: Array) -> Array:
    """Return the covariance (p, p) of the bulk of (n, p) numbers about zero."""
    from scipy.special import chdtri

    p = theta.shape[1]
    limit = float(chdtri(p, 1.0 - _KEPT))
    middle = float(chdtri(p, 0.5))
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


def _covariance(theta: Array, kept: NDArray[np.bool_]) -> Array:
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
    from scipy.special import fdtrc

    return np.asarray(fdtrc(p, n - p, distance * (n - p) / (p * (n - 1.0))))


def discoveries(p_values: Array) -> NDArray[np.intp]:
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

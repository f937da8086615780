"""What the figures of a fleet are drawn from: counts and means, as few for a million as for ten.

Control charts of one number of units in their order: individual values and their EWMA.

With the moving range R_t = |x_t − x_{t−1}| and d₂ = 2/√π, of two normal values,

    centre x̄,    limits x̄ ± 3 mean(R)/d₂                                                    (1)

of individual values; what is slow does not widen them, as it does a standard deviation. Small moves
that last show in z_t = λ x_t + (1 − λ) z_{t−1}, z_0 the target, with the limits

    target ± 3 s √(λ/(2 − λ)).                                                              (2)

Sources: NIST/SEMATECH e-Handbook of Statistical Methods, sections 6.3.2.2 and 6.3.2.4.
"""

from typing import Any, NamedTuple

import numpy as np

from multipos.fleets.stations import NORMAL
from multipos.fleets.unit_results import Units
from multipos.numerics.arrays import Array, Mask, Places, median

_D2 = 2.0 / np.sqrt(np.pi)
_SIGMAS = 3.0
_NOTHING = 1e-17  # weight of values that lie too far back to be seen
WEIGHT = 0.3  # λ: a move of one standard deviation shows after ten units


class Limits(NamedTuple):
    """Centre and control limits."""

    centre: float
    lcl: float
    ucl: float


def individual_limits(values: Array) -> Limits:
    """Return centre and limits of individual values (n,), eq. (1)."""
    centre = float(np.mean(values))
    half = _SIGMAS * float(np.mean(np.abs(np.diff(values)))) / _D2
    return Limits(centre, centre - half, centre + half)


def ewma(values: Array, target: float, weight: float = WEIGHT) -> Array:
    """Return the exponentially weighted moving average (n,) of values, from a target on."""
    length = min(len(values), int(np.ceil(np.log(_NOTHING) / np.log1p(-weight))))
    kernel = weight * (1.0 - weight) ** np.arange(length)
    return np.asarray(target + np.convolve(values - target, kernel)[: len(values)])


def ewma_limits(target: float, sd: float, weight: float = WEIGHT) -> Limits:
    """Return the limits of an EWMA in the long run, eq. (2)."""
    half = _SIGMAS * sd * np.sqrt(weight / (2.0 - weight))
    return Limits(target, target - half, target + half)


def judge_control(values: Array) -> dict[str, Any]:
    """Return the limits of values (n,) in their order, and how many are beyond either chart's."""
    limits = individual_limits(values)
    sd = (limits.ucl - limits.centre) / _SIGMAS
    slow = ewma_limits(limits.centre, sd)
    smooth = ewma(values, limits.centre)
    beyond = (values < limits.lcl) | (values > limits.ucl)
    drifted = (smooth < slow.lcl) | (smooth > slow.ucl)
    return {
        "centre": limits.centre,
        "lcl": limits.lcl,
        "ucl": limits.ucl,
        "beyond": int(beyond.sum()),
        "ewma_lcl": slow.lcl,
        "ewma_ucl": slow.ucl,
        "ewma_beyond": int(drifted.sum()),
    }


_BINS = 40
_REACH = 6.0  # robust standard deviations that a histogram goes to at most
_POINTS = 40  # of a station's line
_FEWEST = 5  # units of a point


def histogram(values: Array) -> dict[str, Any] | None:
    """Return counts of values (n,) between low and high, and how many are beyond."""
    finite = values[np.isfinite(values)]
    finest = _BINS * float(np.spacing(np.max(np.abs(finite), initial=0.0)))
    if len(finite) < 2 or np.ptp(finite) <= finest:
        return None  # alike but for rounding
    middle = float(median(finite))
    reach = _REACH * NORMAL * float(median(np.abs(finite - middle)))
    low, high = float(finite.min()), float(finite.max())
    if reach > finest:
        low, high = max(low, middle - reach), min(high, middle + reach)
    counts, _ = np.histogram(finite, bins=_BINS, range=(low, high))
    return {
        "low": low,
        "high": high,
        "counts": counts.tolist(),
        "below": int(np.sum(finite < low)),
        "above": int(np.sum(finite > high)),
    }


def line_order(units: Units) -> tuple[Places, bool]:
    """Return the units in the order of time, else of their rows, and whether it is of time."""
    timed = bool(np.isfinite(units.time).all())
    return np.argsort(units.time if timed else units.first, kind="stable"), timed


def charts(units: Units, counted: Mask) -> list[list[dict[str, Any]]]:
    """Return of every parameter the lines of its stations: medians of consecutive units."""
    order, _ = line_order(units)
    stations = np.array(units.station, dtype=np.str_)
    result: list[list[dict[str, Any]]] = [[] for _ in units.names]
    for station in dict.fromkeys(units.station):
        places = np.flatnonzero((counted & (stations == station))[order])
        groups = min(_POINTS, len(places) // _FEWEST)
        if groups < 2:
            continue
        parts = np.array_split(places, groups)
        share = [float(np.mean(part)) / len(order) for part in parts]
        table = np.array([median(units.parameters[order[part]], axis=0) for part in parts])
        mine = order[places]
        for place, lines in enumerate(result):
            line = {"station": station, "place": share, "median": table[:, place].tolist()}
            lines.append(line | {"control": judge_control(units.parameters[mine, place])})
    return result

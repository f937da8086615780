"""What the figures of a fleet are drawn from: counts and means, as few for a million as for ten.

- `histogram` returns the counts of a number, `charts` the medians of every station's units in the
  order of `line_order`.
"""

from typing import Any

import numpy as np

from multipos.fleets.control_charts import judge_control
from multipos.fleets.stations import NORMAL
from multipos.fleets.unit_results import Units
from multipos.numerics.arrays import Array, Mask, Places, median

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

"""Trials of a gauge study in the rows of a fleet: positions that come again for a unit.

Where rows of a unit at a station name each of its `position` labels r times, the first rows of all
labels are its first trial, the second ones its second. A study is of all units that were at the
same stations, at least twice at each; what some of them have more is left out of it, as (1) of
`multipos.fleets.gauge` wants as many of all.
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.fleets.grouping import Grouped
from multipos.fleets.labels import Codes, Labels
from multipos.fleets.sources import Rows
from multipos.numerics.arrays import Array, Places

_LEAST = 2  # units, stations and trials


class Trials(NamedTuple):
    """The trials as units of their own, those of a unit and its stations together."""

    grouped: Grouped
    units: tuple[str, ...]
    stations: tuple[str, ...]
    repeats: int


@dataclass(frozen=True, eq=False)
class GaugeStudy:
    """What the trials of p units at s stations gave.

    Attributes
    ----------
    units : tuple of p str
    stations : tuple of s str
    values : (p, s, r, K) array
        Parameters of every trial.
    """

    units: tuple[str, ...]
    stations: tuple[str, ...]
    values: Array


def find_trials(rows: Rows, grouped: Grouped) -> Trials | None:
    """Return the trials of a gauge study, None where the rows hold none."""
    several = np.bincount(grouped.unit.codes)[grouped.unit.codes] >= _LEAST
    if not several.any() or "position" not in rows.columns:
        return None
    try:
        labels = rows.labels("position").codes
    except MultiposError:
        return None  # which the fit of each unit says better
    visits = np.flatnonzero(several & _come_again(labels, grouped)).tolist()
    trials = {visit: _trials_of(grouped.rows(visit), labels) for visit in visits}
    repeated = {visit: found for visit, found in trials.items() if len(found) >= _LEAST}
    cells: dict[int, dict[int, int]] = {}
    for visit in repeated:
        unit, station = int(grouped.unit.codes[visit]), int(grouped.station.codes[visit])
        cells.setdefault(unit, {})[station] = visit
    kinds = Counter(frozenset(at) for at in cells.values() if len(at) >= _LEAST)
    if not kinds:
        return None
    # the largest study that there is, of those as large the one with the first stations
    most = max(kinds, key=lambda kind: (len(kind) * _fitting(kind, kinds), sorted(kind)[::-1]))
    stations = sorted(most)
    units = [unit for unit, at in cells.items() if most <= set(at)]
    if len(units) < _LEAST:
        return None
    places = [cells[unit][station] for unit in units for station in stations]
    repeats = min(len(repeated[place]) for place in places)
    parts = [part for place in places for part in repeated[place][:repeats]]
    of_trial = np.repeat(places, repeats)
    return Trials(
        Grouped(
            np.concatenate(parts),
            np.cumsum([0, *map(len, parts)]),
            Labels(grouped.unit.codes[of_trial], grouped.unit.names),
            Labels(grouped.station.codes[of_trial], grouped.station.names),
        ),
        tuple(grouped.unit.names[unit] for unit in units),
        tuple(grouped.station.names[station] for station in stations),
        repeats,
    )


def _come_again(labels: Codes, grouped: Grouped) -> NDArray[np.bool_]:
    """Tell in which visits (B,) the first label comes again, without a look at each."""
    column, starts = grouped.arranged(labels), grouped.starts[:-1]
    same = column == np.repeat(column[starts], grouped.counts)
    return np.asarray(np.add.reduceat(same, starts, dtype=np.intp) >= _LEAST)


def _fitting(kind: frozenset[int], kinds: "Counter[frozenset[int]]") -> int:
    """Return how many units were at all stations of a kind."""
    return sum(count for other, count in kinds.items() if kind <= other)


def _trials_of(rows: Places, labels: Codes) -> list[Places]:
    """Return the rows of each trial; none where a label comes more often than another."""
    mine = labels[rows]
    order = np.argsort(mine, kind="stable")
    _, starts, counts = np.unique(mine[order], return_index=True, return_counts=True)
    if counts.min() != counts.max():
        return []
    rank = np.empty(len(rows), dtype=np.intp)
    rank[order] = np.arange(len(rows)) - np.repeat(starts, counts)
    return [rows[rank == trial] for trial in range(int(counts[0]))]


def gather_study(trials: Trials, parameters: Array, usable: NDArray[np.bool_]) -> GaugeStudy | None:
    """Return the study of trials that are solved; a unit with a trial that is not usable is out.

    Parameters
    ----------
    trials : Trials
    parameters : (T, K) array
    usable : (T,) array of bool
    """
    shape = (len(trials.units), len(trials.stations), trials.repeats)
    kept = np.flatnonzero(usable.reshape(shape).all(axis=(1, 2)))
    if len(kept) < _LEAST:
        return None
    values = parameters.reshape(*shape, -1)[kept]
    return GaugeStudy(tuple(trials.units[i] for i in kept.tolist()), trials.stations, values)

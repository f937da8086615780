"""What stations do to their units: level, zero, and how well that can be identified.

- `describe_stations` returns what is said of every station, `find_off` its findings.
- `station_effects` returns θ of eq. (1) with its covariance, `linear_parts` the sensitivities that
  eq. (2) takes, `near_median` the units that are near enough to count.
- `is_off` says whether the angle of a position is beyond what it is known to.

Units are allotted to stations at random; that is what these figures rest on. A number y of unit j
at station s is

    y_js = θ_s + b_j + e_js,    b ~ (0, σ_b²),  e ~ (0, σ_w²),                               (1)

and θ is its weighted least squares with σ_b², what units differ by, in its covariance: two stations
of a thousand units differ by chance however well each unit was measured. A unit that was at several
stations is in it with all its rows and so compares them within itself; σ_w² then comes from what is
left within units, and is not needed where there are none; where too few of them tell it, each row
counts as a unit. Where every unit was at one station, θ_s is the mean of its units and its variance
(σ_b² + σ_w²)/n_s.

The level of station s is the rotation ω_s that turns its listed references into the true ones,
f_true = f + ω_s × f. With A the mean sensitivities of all units, the sensitivities A_j that a unit
shows under listed references are A (1 + [ω]×), so that

    ω_j = axial vector of the antisymmetric part of A⁻¹ A_j.                                (2)

A station's shift is that of the bias. Both are against the mean of all stations, since nothing in
a fleet shows what these have in common.

All levels and shifts of all stations, m in number, are one test at 1 %: one is off where

    |value| > u t_{1 − .01/2m}(ν),    ν units less stations,                                (3)

and where it matters: a level from 0.02°, a shift from a tenth of what units differ by.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.finding import Finding, Findings
from multipos.fleets.station_fixtures import describe_fixtures
from multipos.fleets.unit_results import Units
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, median
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import CONSTANT, linear_term
from multipos.sensor.model import Model

_OFF = 0.1  # [deg] from which a station is said to be off,
_CLEAR = 5.0  # where it is so many times its u
_ALARM, _LEVEL, _OF_UNITS = 0.01, 0.02, 0.1  # of eq. (3); [deg], and of what units differ by


_FAR = 6.0  # robust standard deviations beyond which a unit tells nothing of its station
_LEAST = 1e-12  # of the whole variance: what is left within units, where rounding is all there is
NORMAL = 1.482602218505602  # standard deviation over median absolute deviation, of a normal law
_AT_ONCE = 50_000  # units that are worked on at once

Codes = Places


def describe_stations(units: Units, counted: Mask) -> list[dict[str, Any]]:
    """Return what is said of every station.

    Parameters
    ----------
    units : Units
    counted : (B,) array of bool
        Units whose numbers count.
    """
    names = tuple(dict.fromkeys(units.station))
    places = {name: place for place, name in enumerate(names)}
    stations = np.array([places[name] for name in units.station], dtype=np.intp)
    who = units.unit.codes.astype(np.intp)
    identifiable = units.model is not None and len(names) > 1
    levels = _levels(units, counted, stations, who, len(names)) if identifiable else None
    shifts = _shifts(units, counted, stations, who, len(names)) if identifiable else None
    fixtures = describe_fixtures(units.fixtures)
    described: list[dict[str, Any]] = [
        {
            "station": name,
            "units": int(np.sum(stations == place)),
            "level_deg": None if levels is None else levels[place],
            "shift": None if shifts is None else shifts[place],
            **fixtures.get(place, {"positions_deg": [], "correction": None}),
        }
        for place, name in enumerate(names)
    ]
    figures = [figure for each in described for _, _, figure in _figures(each) if figure]
    dof = max(int(counted.sum()) - len(names), 1)
    k = coverage_factor(1.0 - _ALARM / max(len(figures), 1), float(dof))
    unit = "" if units.model is None else f" {units.model.unit}"
    beyond = _beyond(described, k)
    return [
        each | {"findings": [found.to_dict() for found in find_off(each, mine, unit)]}
        for each, mine in zip(described, beyond, strict=True)
    ]


def _beyond(described: Sequence[Mapping[str, Any]], k: float) -> list[set[tuple[str, str]]]:
    """Return the figures of each station, by kind and name, that are off, eq. (3).

    One that is off moves the mean of all, and with it the others: it is left out before they are
    looked at, where there are three stations or more.
    """
    beyond: list[set[tuple[str, str]]] = [set() for _ in described]
    for kind, name, _ in _figures(described[0]):
        figures = [(each[kind] or {}).get(name) for each in described]
        if any(figure is None for figure in figures):
            continue
        value = np.array([figure["value"] for figure in figures if figure])
        z = np.array([figure["u"] for figure in figures if figure]) * k
        left = list(range(len(value)))
        while left:
            far = left[int(np.argmax(np.abs(value[left]) / np.maximum(z[left], 1e-300)))]
            if abs(value[far]) <= z[far]:
                break
            beyond[far].add((kind, name))
            left.remove(far)
            if len(described) > 2 and left:
                value[left] -= value[left].mean()
    return beyond


def _figures(station: Mapping[str, Any]) -> list[tuple[str, str, Mapping[str, float] | None]]:
    """Return what is compared of a station, eq. (3): kind, axis or output, value and u."""
    return [
        (kind, name, figure)
        for kind in ("level_deg", "shift")
        for name, figure in (station[kind] or {}).items()
    ]


def find_off(station: Mapping[str, Any], beyond: set[tuple[str, str]], unit: str) -> Findings:
    """Return warnings of a station whose level or zero, or a position of it, is off.

    Parameters
    ----------
    station : mapping
        As of `describe_stations`.
    beyond : set of (kind, name)
        The levels and shifts that are off, eq. (3).
    unit : str
        Of the readings.
    """
    name, found = station["station"], []
    root = float(np.sqrt(station["units"]))
    angles: list[tuple[float, str, str, float, tuple[str, ...]]] = []
    shifts: list[tuple[float, str, Mapping[str, float]]] = []
    for kind, what, figure in _figures(station):
        if figure is None or (kind, what) not in beyond:
            continue
        size, u = abs(figure["value"]), figure["u"]
        if kind == "level_deg" and size >= _LEVEL:
            angles.append((size, "level", what, u, ()))
        elif kind == "shift" and size >= _OF_UNITS * root * u:
            shifts.append((size / u if u else np.inf, what, figure))
    for each in station["positions_deg"]:
        angles += [
            (
                abs(each[axis]["value"]),
                f"position {each['position']}",
                axis,
                each[axis]["u"],
                (str(each["position"]),),
            )
            for axis in COMPONENTS
            if is_off(each.get(axis))
        ]
    if angles:
        size, what, axis, u, rows = max(angles, key=lambda each: each[0])
        more = f", and {len(angles) - 1} more" if len(angles) > 1 else ""
        at = f" of station {name}" if name else ""
        text = f"{what}{at} is off by {size:.2g} degrees about {axis} (u = {u:.2g}){more}"
        action = "Correct the fixture, or use its correction."
        found.append(Finding("station", "warning", text, action, rows=rows))
    if shifts:
        _, what, figure = max(shifts, key=lambda each: each[0])
        more = f", and {len(shifts) - 1} more" if len(shifts) > 1 else ""
        text = (
            f"zero of {what} at station {name} is off by {figure['value']:.2g}{unit} "
            f"(u = {figure['u']:.2g}){more}"
        )
        action = "Look for what moves it there: supply, temperature, warm-up."
        found.append(Finding("station", "warning", text, action, outputs=(what,)))
    return tuple(found)


def is_off(angle: Mapping[str, float] | None) -> bool:
    """Return whether an angle (`value` and `u` [deg]) of a station is clearly not zero."""
    return angle is not None and abs(angle["value"]) > max(_OFF, _CLEAR * angle["u"])


def _levels(
    units: Units, counted: Mask, stations: Codes, who: Codes, count: int
) -> list[dict[str, Any] | None] | None:
    matrix = None if units.model is None else linear_parts(units.model, units.parameters)
    if matrix is None:
        return None
    usable = counted & np.isfinite(matrix).all(axis=(1, 2))
    if not usable.any():
        return None
    typical = np.array([[median(matrix[usable, i, j]) for j in range(3)] for i in range(3)])
    rows, columns = [2, 0, 1], [1, 2, 0]
    turned = np.empty((len(matrix), len(COMPONENTS)))
    for first in range(0, len(matrix), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        known = np.where(usable[some, None, None], matrix[some], np.eye(3))
        relative = np.linalg.solve(typical, known)
        turned[some] = np.degrees((relative[:, rows, columns] - relative[:, columns, rows]) / 2.0)
    found = {
        axis: _against_mean(turned[:, place], usable, stations, who, count)
        for place, axis in enumerate(COMPONENTS)
    }
    return _by_station(found, count)


def linear_parts(model: Model, parameters: Array) -> Array | None:
    """Return the linear part (B, 3, 3) of a triad's parameters, None where a term is missing."""
    places = []
    if sorted(model.axes) != sorted(COMPONENTS) or model.gauge is not None:
        return None
    for axis in COMPONENTS:
        output = model.outputs[model.axes.index(axis)]
        keys = [(output, linear_term(other)) for other in COMPONENTS]
        if any(key not in model.keys for key in keys):
            return None
        places.append([model.keys.index(key) for key in keys])
    return parameters[:, np.array(places)]


def _shifts(
    units: Units, counted: Mask, stations: Codes, who: Codes, count: int
) -> list[dict[str, Any] | None] | None:
    model = units.model
    assert model is not None
    found = {}
    for output in model.outputs:
        if (output, CONSTANT) in model.keys:
            values = units.parameters[:, model.keys.index((output, CONSTANT))]
            usable = counted & np.isfinite(values)
            found[output] = _against_mean(values, usable, stations, who, count)
    return _by_station(found, count) if found else None


def _by_station(
    found: dict[str, list[dict[str, float]] | None], count: int
) -> list[dict[str, Any] | None]:
    """Return {name: {value, u}} of every station, None where one of them is not identifiable."""
    return [
        None
        if any(each is None for each in found.values())
        else {name: each[place] for name, each in found.items() if each is not None}
        for place in range(count)
    ]


def _against_mean(
    values: Array, usable: Mask, stations: Codes, who: Codes, count: int
) -> list[dict[str, float]] | None:
    """Return every station's effect against the mean of all, None where a station has no unit."""
    kept = usable & near_median(values, usable, stations)
    present = np.bincount(stations[kept], minlength=count)
    if not (present > 0).all() or kept.sum() <= count:
        return None
    _, mine = np.unique(who[kept], return_inverse=True)
    effect, covariance = station_effects(values[kept], stations[kept], mine)
    contrast = np.eye(count) - 1.0 / count
    u = np.sqrt(np.diag(contrast @ covariance @ contrast.T))
    return [
        {"value": value, "u": each}
        for value, each in zip((contrast @ effect).tolist(), u.tolist(), strict=True)
    ]


def near_median(values: Array, usable: Mask, stations: Codes) -> Mask:
    """Tell which values are not far from the median of their station."""
    near = np.zeros(len(values), dtype=np.bool_)
    for station in np.unique(stations[usable]).tolist():
        mine = np.flatnonzero(usable & (stations == station))
        away = np.abs(values[mine] - median(values[mine]))
        spread = NORMAL * float(median(away))
        near[mine] = away <= _FAR * spread if spread > 0.0 else True
    return near


def station_effects(values: Array, stations: Codes, who: Codes) -> tuple[Array, Array]:
    """Return the effects θ (S,) of eq. (1) and their covariance.

    Parameters
    ----------
    values : (n,) array
    stations, who : (n,) arrays of int
        Station and unit of each value, both 0, 1, …, with none left out.
    """
    count, times = int(stations.max()) + 1, np.bincount(who)
    seen = np.bincount(stations)
    means = np.bincount(stations, values) / seen
    total = float(np.sum((values - means[stations]) ** 2)) / (len(values) - count)
    if times.max() == 1:
        return means, np.diag(total / seen)
    several = times[who] > 1
    rows, units = _centred(values[several], stations[several], who[several], count)
    variance = _within(rows, units, int(several.sum()) - len(np.unique(who[several])))
    if variance is None:
        return means, np.diag(total / seen)
    within = max(variance, _LEAST * total, 1e-300)
    between = max(total - within, 0.0)
    information = np.zeros((count, count))
    right = np.zeros(count)
    for k in np.unique(times).tolist():
        mine = times[who] == k
        share = between / (within + k * between)
        y, s = values[mine], stations[mine]
        _, place = np.unique(who[mine], return_inverse=True)
        visits = np.zeros((int(place.max()) + 1, count))
        np.add.at(visits, (place, s), 1.0)
        sums = np.bincount(place, y)
        information += np.diag(np.bincount(s, minlength=count)) - share * visits.T @ visits
        right += np.bincount(s, y, minlength=count) - share * visits.T @ sums
    covariance = within * np.linalg.inv(information)
    return covariance @ right / within, np.asarray(covariance)


def _centred(values: Array, stations: Codes, who: Codes, count: int) -> tuple[Array, Array]:
    """Return values and station columns, less their means within units."""
    _, place = np.unique(who, return_inverse=True)
    times = np.bincount(place)
    columns = np.eye(count)[stations]
    means = np.zeros((len(times), count))
    np.add.at(means, place, columns)
    centred = columns - (means / times[:, None])[place]
    return values - (np.bincount(place, values) / times)[place], centred


def _within(values: Array, columns: Array, dof: int) -> float | None:
    """Return σ_w² from what stations leave of centred values; None where they leave nothing."""
    effect, _, rank, _ = np.linalg.lstsq(columns, values, rcond=1e-10)
    left = values - columns @ effect
    rest = dof - int(rank)
    return float(left @ left) / rest if rest > 0 else None

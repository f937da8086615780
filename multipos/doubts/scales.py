"""Doubts about sizes: the unit of the readings, that of one output, and gravity.

A sensor in a unit that is known responds to one g by what that unit says: 1 in g, 9.80665 in
m/s², 1000 in mg; by half as much again or half, if it was never adjusted. Outputs of one triad
respond alike within a factor. What is beyond that is another unit, and where the ratio is near
9.80665, 1000 or pi/180 it says which.
"""

import math
from collections.abc import Sequence

import numpy as np

from multipos.doubt import Doubt
from multipos.doubts.directions import is_triad
from multipos.doubts.repairs import FACTORS
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

_ONE_G = {
    "g": 1.0,
    "mg": 1e3,
    "ug": 1e6,
    "m/s^2": STANDARD_GRAVITY,
    "mm/s^2": 1e3 * STANDARD_GRAVITY,
}
_NEVER_ADJUSTED = 3.0  # times more or less than the unit says
_ONE_TRIAD = 4.0  # times between outputs of one triad
_NAMED = 1.6  # a ratio so near to a known one is called by its name
_EARTH = (9.75, 9.85)  # [m/s²] from the equator's mountains to the poles' seas, and a little more


def unit(c: Calibration, sensitivity: Array) -> Doubt | None:
    """Find readings that are in another unit than the one stated."""
    one_g = _ONE_G.get(c.model.unit)
    size = np.linalg.norm(sensitivity, axis=1)
    if one_g is None or not size.all():
        return None
    ratio = float(np.exp(np.log(size / one_g).mean()))
    if _alike(size) and 1.0 / _NEVER_ADJUSTED < ratio < _NEVER_ADJUSTED:
        return None
    if not _alike(size):
        return None  # one output is to be mended first
    near = [name for name, value in _ONE_G.items() if _is_near(ratio * one_g, value)]
    way_out = f"they look like {near[0]}: --unit {near[0]}" if near else "state the right one"
    return Doubt(
        "unit",
        "implausible",
        f"the readings are not in {c.model.unit}: one g makes {ratio * one_g:.4g} of them, where "
        f"it should be {one_g:g}; {way_out}, or leave --unit away where the unit has no name",
    )


def output_unit(c: Calibration, sensitivity: Array) -> Doubt | None:
    """Find an output that is in another unit than the others."""
    size = np.linalg.norm(sensitivity, axis=1)
    if len(size) < 2 or not size.all() or (is_triad(c) and _alike(size)):
        return None
    middle = _usual(c, size)
    wrong = [
        (output, float(own / middle))
        for output, own in zip(c.outputs, size.tolist(), strict=True)
        if _stands_apart(own / middle, lone=not is_triad(c))
    ]
    if not wrong:
        return None
    said = ", ".join(f"{output} {_times(ratio)}" for output, ratio in wrong)
    return Doubt(
        "output-unit",
        "implausible",
        f"outputs differ in unit: {said} as sensitive as the others; bring the columns to one unit",
        outputs=tuple(output for output, _ in wrong),
    )


def gravity(c: Calibration) -> Doubt | None:
    """Find a gravity that is none of this earth."""
    stated = c.gravity
    if stated is None or _EARTH[0] - stated.u <= stated.value <= _EARTH[1] + stated.u:
        return None
    feet = _is_near(stated.value, STANDARD_GRAVITY / 0.3048, 1.01)
    looks = "; it looks like feet per second squared, of which m/s^2 are .3048" if feet else ""
    return Doubt(
        "gravity",
        "implausible",
        f"gravity is {stated.value:g} m/s^2, and on the surface of the earth between 9.764 and "
        f"9.834{looks}; correct --gravity, or give --latitude and --height",
    )


def factor_in_words(factor: float) -> str:
    """Return a factor between units with what it stands for, where it is a known one."""
    near = [known for known in FACTORS if _is_near(factor, known, 1.001)]
    value = near[0] if near else factor
    names = {
        STANDARD_GRAVITY: "m/s^2 for g",
        1.0 / STANDARD_GRAVITY: "g for m/s^2",
        1000.0: "a thousandth for the unit",
        1e-3: "the unit for a thousandth",
        180.0 / np.pi: "degrees for radians",
        np.pi / 180.0: "radians for degrees",
    }
    named = next((f" ({name})" for known, name in names.items() if _is_near(value, known)), "")
    return f"{value:.4g}{named}"


def are_of_unit(sizes: Sequence[float], unit: str) -> bool:
    """Tell whether outputs respond alike, and as a unit says, so that no more need be asked."""
    one_g = _ONE_G.get(unit)
    low, high = min(sizes), max(sizes)
    if high > _ONE_TRIAD * low:
        return False
    return one_g is None or one_g / _NEVER_ADJUSTED < low <= high < one_g * _NEVER_ADJUSTED


def _alike(size: Array) -> bool:
    return float(size.max()) < _ONE_TRIAD * float(size.min())


def _usual(c: Calibration, size: Array) -> float:
    """Return what the other outputs respond: by the unit where it is known, else the median."""
    one_g = _ONE_G.get(c.model.unit)
    near = [] if one_g is None else [s for s in size.tolist() if _is_near(s, one_g, 3.0)]
    return float(median(near)) if near else float(median(size))


def _stands_apart(ratio: float, *, lone: bool) -> bool:
    """Tell whether an output is in a unit of its own; of sensors of several kinds only by name."""
    if lone:
        return any(_is_near(ratio, known, 1.15) for known in FACTORS)
    return not 1.0 / _ONE_TRIAD < ratio < _ONE_TRIAD


def _times(ratio: float) -> str:
    known = _nearest(ratio, FACTORS)
    looks = f", as by a factor {factor_in_words(known)}" if _is_near(ratio, known) else ""
    return f"{ratio:.3g} times{looks}"


def _nearest(value: float, known: Sequence[float]) -> float:
    return min(known, key=lambda each: abs(math.log(value / each)))


def _is_near(value: float, known: float, within: float = _NAMED) -> bool:
    return 1.0 / within < value / known < within

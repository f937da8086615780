"""Findings about sizes and directions: the unit of the readings, gravity, and the axes of outputs.

`unit`, `output_unit` and `gravity` find sizes of another unit or place, which `factor_in_words`
names; `are_of_unit` tells where none need be asked. `turned` and `reversed_or_permuted` find
outputs that face elsewhere: `facing` is the axis that each output faces, `cosines` how well it
faces one of `expected_directions`, and `is_triad` tells of three.

A sensor in a unit that is known responds to one g by what that unit says: 1 in g, 9.80665 in
m/s², 1000 in mg; by half as much again or half, if it was never adjusted. Outputs of one triad
respond alike within a factor. What is beyond that is another unit, and where the ratio is near
9.80665, 1000 or pi/180 it says which.

**Directions.** A triad responds by K (M, 3), one row an output. Turned as a whole, as a chip
soldered sideways is, it is K = S R with a rotation R; no turning changes the sign of det K. So a
negative determinant means that one output is reversed, or two interchanged, and the nearest signed
permutation

    P = argmax sum over i of  s_i K_i,pi(i)/|K_i|                                           (1)

says which. All three reversed is the other convention, which a fit says by itself: such
a calibration compensates correctly. One or two outputs can be turned any way.
"""

import math
from collections.abc import Sequence
from itertools import permutations

import numpy as np

from multipos.diagnostics.repairs import FACTORS
from multipos.files.spelling import quoted
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, median
from multipos.numerics.rotations import align, rotation_vector
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

CLEAR = 0.75  # cosine of an output's direction with its own axis, 41°
_SLANTED = 0.9  # cosine, 26°: beyond it a sensor was turned, not merely mounted badly
_TRIAD = 3


@frozen(eq=True)
class Facing:
    """The case axis that each output responds to most, with its sign, by eq. (1).

    Attributes
    ----------
    axes : tuple of M int
    signs : tuple of M float
    least : float
        The smallest cosine of an output with its axis.
    """

    axes: tuple[int, ...]
    signs: tuple[float, ...]
    least: float

    @property
    def text(self) -> str:
        """As `--axes` takes it."""
        pairs = zip(self.signs, self.axes, strict=True)
        return ",".join(("-" if sign < 0.0 else "") + COMPONENTS[axis] for sign, axis in pairs)


def expected_directions(c: Calibration) -> Array:
    """Return the unit vectors (M, 3) that the outputs are said to sense."""
    axes = np.eye(3)[[COMPONENTS.index(axis) for axis in c.model.axes]]
    if c.facing is not None:
        axes *= np.array([[-1.0 if axis.startswith("-") else 1.0] for axis in c.facing])
    return axes


def cosines(sensitivity: Array, expected: Array) -> Array:
    """Return the cosine of each output's direction with the one that it should have (M,)."""
    size = np.linalg.norm(sensitivity, axis=1)
    return np.asarray(np.sum(sensitivity * expected, axis=1) / np.where(size > 0.0, size, 1.0))


def facing(sensitivity: Array) -> Facing:
    """Return which axis each output faces, no two the same; of outputs as many as axes or fewer."""
    size = np.linalg.norm(sensitivity, axis=1, keepdims=True)
    unit = sensitivity / np.where(size > 0.0, size, 1.0)
    outputs = np.arange(len(unit))
    best = max(
        permutations(range(3), len(unit)), key=lambda axes: float(np.abs(unit[outputs, axes]).sum())
    )
    along = unit[outputs, list(best)]
    return Facing(best, tuple(np.where(along < 0.0, -1.0, 1.0).tolist()), float(abs(along).min()))


def is_triad(c: Calibration) -> bool:
    """Tell whether the outputs are three, one for each axis."""
    return len(c.outputs) == _TRIAD and sorted(c.model.axes) == list(COMPONENTS)


def reversed_or_permuted(c: Calibration, sensitivity: Array) -> Finding | None:
    """Find a triad that no turning of the sensor gives."""
    if not is_triad(c) or not np.linalg.norm(sensitivity, axis=1).all():
        return None
    expected = expected_directions(c)
    handed = np.linalg.det(sensitivity) * np.linalg.det(expected)
    along = cosines(sensitivity, expected)
    if c.facing is not None:  # what was said is to be so, turned or not
        if (along > CLEAR).all():
            return None
    elif handed > 0.0 or (along < -CLEAR).all():
        return None
    face = facing(sensitivity)
    own = tuple(COMPONENTS.index(axis) for axis in c.model.axes)
    known = (
        "which contradicts --axes"
        if c.facing is not None
        else "which no rotation of the sensor explains"
    )
    if face.axes == own:
        wrong = [o for o, cosine in zip(c.outputs, along.tolist(), strict=True) if cosine < 0.0]
        return Finding(
            "sign",
            "error",
            (
                f"{quoted(wrong)} decreases where it should increase, {known}: the output is "
                "reversed, or positions are interchanged"
            ),
            f"Check the wiring and the list, or confirm with --axes {face.text}.",
            outputs=tuple(wrong),
        )
    wrong = [o for o, a, b in zip(c.outputs, face.axes, own, strict=True) if a != b]
    senses = ", ".join(
        f"{output} senses {axis}"
        for output, axis in zip(c.outputs, face.text.split(","), strict=True)
        if output in wrong
    )
    return Finding(
        "permuted-outputs",
        "error",
        f"outputs are interchanged: {senses}, {known}",
        f"Correct the names of the columns, or confirm with --axes {face.text}.",
        outputs=tuple(wrong),
    )


def turned(c: Calibration, sensitivity: Array) -> Finding | None:
    """Find a sensor that is turned as a whole, or an output of one or two that faces elsewhere."""
    expected = expected_directions(c)
    if len(c.outputs) > _TRIAD or (cosines(sensitivity, expected) > _SLANTED).all():
        return None
    if (cosines(sensitivity, -expected) > _SLANTED).all() and len(c.outputs) != 2:
        return None  # the other convention, which the fit says by itself
    face = facing(sensitivity)
    words = "Mount it square in its case."
    if face.least > _SLANTED:
        words = f"Confirm with --axes {face.text}."
    how = ", ".join(
        f"{output} senses {axis}"
        for output, axis in zip(c.outputs, face.text.split(","), strict=True)
    )
    if is_triad(c):
        # nearest to K, from the axes that the outputs should have
        unit = sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
        vector = rotation_vector(align(expected, unit))
        if math.cos(float(np.linalg.norm(vector))) > _SLANTED:
            return None  # axes that are not square, and no turn of the whole
        how = f"{_rotation_in_words(vector)}: {how}"
    return Finding(
        "turned",
        "warning",
        f"the sensor is mounted rotated in its case, {how}; results are in case axes",
        words,
        outputs=c.outputs,
    )


def _rotation_in_words(vector: Array) -> str:
    angle = float(np.linalg.norm(vector))
    axis = ", ".join(f"{part:.2f}" for part in (np.round(vector / angle, 2) + 0.0).tolist())
    return f"by {np.degrees(angle):.0f} degrees about ({axis})"


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


def unit(c: Calibration, sensitivity: Array) -> Finding | None:
    """Find readings that are in another unit than the one stated."""
    one_g = _ONE_G.get(c.model.unit)
    size = np.linalg.norm(sensitivity, axis=1)
    if one_g is None or not size.all():
        return None
    ratio = float(np.exp(np.log(size / one_g).mean()))
    # of unequal outputs one is to be mended first
    if not _alike(size) or 1.0 / _NEVER_ADJUSTED < ratio < _NEVER_ADJUSTED:
        return None
    near = [name for name, value in _ONE_G.items() if _is_near(ratio * one_g, value)]
    way_out = f"State --unit {near[0]}." if near else "State the right unit, or no --unit."
    return Finding(
        "unit",
        "error",
        (
            f"readings are not in {c.model.unit}: 1 g reads {ratio * one_g:.4g}, where "
            f"{one_g:g} is expected"
        ),
        way_out,
    )


def output_unit(c: Calibration, sensitivity: Array) -> Finding | None:
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
    return Finding(
        "output-unit",
        "error",
        f"outputs differ in unit: {said} as sensitive as the others",
        "Convert the columns to one unit.",
        outputs=tuple(output for output, _ in wrong),
    )


def gravity(c: Calibration) -> Finding | None:
    """Find a gravity that is none of this earth."""
    stated = c.gravity
    if (
        stated is None
        or c.field.kind != "gravity"
        or _EARTH[0] - stated.u <= stated.value <= _EARTH[1] + stated.u
    ):
        return None
    feet = _is_near(stated.value, STANDARD_GRAVITY / 0.3048, 1.01)
    looks = "; it looks like feet per second squared (1 ft = 0.3048 m)" if feet else ""
    return Finding(
        "gravity",
        "error",
        (
            f"gravity is {stated.value:g} m/s^2, but 9.764 to 9.834 at the surface of the "
            f"earth{looks}"
        ),
        "Correct --gravity, or give --latitude and --height.",
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
    known = min(FACTORS, key=lambda each: abs(math.log(ratio / each)))
    looks = f", as by a factor {factor_in_words(known)}" if _is_near(ratio, known) else ""
    return f"{ratio:.3g} times{looks}"


def _is_near(value: float, known: float, within: float = _NAMED) -> bool:
    return 1.0 / within < value / known < within

"""Which way the outputs respond, held against the axes that they are said to have.

A triad responds by K (M, 3), one row an output. Turned as a whole, as a chip soldered sideways is,
it is K = S R with a rotation R; no turning changes the sign of det K. So a negative determinant
means that one output is reversed, or two interchanged, and the nearest signed permutation

    P = argmax sum over i of  s_i K_i,pi(i)/|K_i|                                           (1)

says which. All three reversed is the other convention, which a fit says by itself: such
a calibration compensates correctly. One or two outputs can be turned any way.
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from multipos.doubt import Doubt
from multipos.files.lists import quoted
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import align, rotation_vector
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration

CLEAR = 0.75  # cosine of an output's direction with its own axis, 41°
_SLANTED = 0.9  # cosine, 26°: beyond it a sensor was turned, not merely mounted badly
_TRIAD = 3


@dataclass(frozen=True)
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


def reversed_or_permuted(c: Calibration, sensitivity: Array) -> Doubt | None:
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
        "and that contradicts --axes"
        if c.facing is not None
        else "and no turning of the sensor does that"
    )
    if face.axes == own:
        wrong = [o for o, cosine in zip(c.outputs, along.tolist(), strict=True) if cosine < 0.0]
        return Doubt(
            "sign",
            "implausible",
            f"{quoted(wrong)} falls where it should rise as its axis turns, {known}: the output "
            "is reversed, or positions are listed for each other; where the sensor is made so, say "
            f"it with --axes {face.text}",
            outputs=tuple(wrong),
        )
    wrong = [o for o, a, b in zip(c.outputs, face.axes, own, strict=True) if a != b]
    senses = ", ".join(
        f"{output} to {axis}"
        for output, axis in zip(c.outputs, face.text.split(","), strict=True)
        if output in wrong
    )
    return Doubt(
        "permuted-outputs",
        "implausible",
        f"outputs are interchanged: {senses} is how they respond, {known}; name the columns "
        f"rightly, or say with --axes {face.text} that it is so",
        outputs=tuple(wrong),
    )


def turned(c: Calibration, sensitivity: Array) -> Doubt | None:
    """Find a sensor that is turned as a whole, or an output of one or two that faces elsewhere."""
    expected = expected_directions(c)
    if len(c.outputs) > _TRIAD or (cosines(sensitivity, expected) > _SLANTED).all():
        return None
    if (cosines(sensitivity, -expected) > _SLANTED).all() and len(c.outputs) != 2:
        return None  # the other convention, which the fit says by itself
    face = facing(sensitivity)
    words = f"; --axes {face.text} says so" if face.least > CLEAR else ""
    how = ", ".join(
        f"{output} senses {axis}"
        for output, axis in zip(c.outputs, face.text.split(","), strict=True)
    )
    if is_triad(c):
        how = f"{_rotation_in_words(sensitivity, expected)}: {how}"
    return Doubt(
        "turned",
        "caution",
        f"the sensor stands turned in its case, {how}; compensated forces are along the axes of "
        f"the case all the same{words}",
        outputs=c.outputs,
    )


def _rotation_in_words(sensitivity: Array, expected: Array) -> str:
    """Return the rotation nearest to K, from the axes that the outputs should have."""
    unit = sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
    vector = rotation_vector(align(expected, unit))
    angle = float(np.linalg.norm(vector))
    axis = ", ".join(f"{part:.2f}" for part in (np.round(vector / angle, 2) + 0.0).tolist())
    return f"by {np.degrees(angle):.0f} degrees about ({axis})"

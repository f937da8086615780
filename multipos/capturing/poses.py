"""Poses: rests offered to the session, the direction each shows, and why one is refused.

What a rest reads shows its direction as soon as the sensor is roughly known: by the calibration of
the poses so far; before there is one, by a sphere through their means,

    |y|² = 2 c·y + (r² − c·c),                                                              (1)

linear in the centre c; and before that by the size of gravity in a known unit. A rest is refused
that moved, is cut off, reads gravity in another unit, or repeats a direction within 5°.
"""

from dataclasses import dataclass, replace

import numpy as np

from multipos.logs.log_faults import is_factor
from multipos.logs.rest_faults import at_one_value
from multipos.logs.still import Still
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.positions.attitudes import Convention
from multipos.results import Result
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model
from multipos.units import STANDARD_GRAVITY

REPEAT_DEG = 5.0
_SPREAD = 30.0  # condition of eq. (1) up to which the centre is told
_SIGNIFICANT = 5.0  # times its standard uncertainty, of a drift
_ONE_G = (1.0, STANDARD_GRAVITY, 1000.0)
_NEAR = 0.15  # relative: how far a bias moves the size of gravity


@dataclass(frozen=True, eq=False)
class Pose(Result):
    """A rest that was offered.

    Attributes
    ----------
    position : str
        Its number among all rests, or the position of the scheme.
    still : Still
    accepted : bool
    reason : str or None
        Why it is not accepted.
    undone : bool
        Whether the user took it back.
    """

    position: str
    still: Still
    accepted: bool
    reason: str | None
    undone: bool = False

    def taken_back(self, reason: str) -> "Pose":
        """Return the pose as the user took it back."""
        return replace(self, accepted=False, undone=True, reason=reason)

    def restored(self) -> "Pose":
        """Return the pose as it was before it was taken back."""
        return replace(self, accepted=True, undone=False, reason=None)


@dataclass(frozen=True, eq=False)
class Frame:
    """How readings show directions: f = (y − centre)/size, or a calibration."""

    centre: Array
    size: float
    order: tuple[int, ...]  # output of x, y, z
    sign: float
    calibration: Calibration | None = None

    def force(self, means: Array) -> Array:
        """Return the forces (n, 3) that readings (n, M) show, in case axes, about 1 in size."""
        if self.calibration is not None:
            return self.calibration.compensate(means)
        return np.asarray((means - self.centre)[:, list(self.order)] / self.size)

    def force_size(self, means: Array) -> Array:
        """Return the size (n,) of these forces."""
        return np.asarray(np.linalg.norm(self.force(means), axis=1))

    def up(self, means: Array) -> Array:
        """Return the up vectors (n, 3) that readings (n, M) show, in case axes."""
        force = self.sign * self.force(means)
        return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def find_frame(
    means: Array, axes: tuple[int, ...], convention: Convention, calibration: Calibration | None
) -> Frame | None:
    """Return how readings (n, M) show directions, as far as the poses so far tell."""
    sign = -1.0 if convention == "gravity" else 1.0
    order = tuple(int(i) for i in np.argsort(axes))
    if calibration is not None and _is_plain_triad(calibration.model):
        return Frame(np.zeros(3), 1.0, order, sign, calibration)
    if len(axes) != 3 or not len(means):
        return None
    centre = _centre(means)
    if centre is not None:
        return Frame(centre, float(median(_sizes(means, centre))), order, sign)
    zero = np.zeros(3)
    size = float(median(_sizes(means, zero)))
    if any(abs(size / one - 1.0) < _NEAR for one in _ONE_G):
        return Frame(zero, size, order, sign)
    return None


def _is_plain_triad(model: Model) -> bool:
    """Tell whether a model has three outputs and asks for no other column."""
    return len(model.axes) == 3 and not model.environment


def _centre(means: Array) -> Array | None:
    """Return the centre (3,) of the sphere that readings (n, 3) lie on; None where few tell it."""
    if len(means) < 4:
        return None
    scale = float(np.abs(means).max())
    rows = np.column_stack([2.0 * means / scale, np.ones(len(means))])
    if not np.linalg.cond(rows) < _SPREAD:
        return None
    found = np.linalg.lstsq(rows, (means**2).sum(axis=1) / scale, rcond=None)[0]
    return np.asarray(found[:3])


def _sizes(means: Array, centre: Array) -> Array:
    return np.asarray(np.linalg.norm(means - centre, axis=1))


def refuse_rest(still: Still, outputs: tuple[str, ...], threshold: float | None) -> str | None:
    """Return what makes the rest alone none that can be used."""
    found = still.found
    for j, output in enumerate(outputs):
        if found.n > 1 and found.sd[j] == 0.0 and float(found.sd.max()) > 0.0:
            value = float(found.low[j])
            return f"saturated or stuck: {at_one_value(output, 'held', value, found.n, found.n)}"
    if still.saturated:
        return f"saturated: {still.saturated[0]}"
    limit = np.inf if threshold is None else threshold
    told = np.abs(found.drift) > _SIGNIFICANT * found.drift_u
    far = np.flatnonzero(told & (np.abs(found.drift) > limit)).tolist()
    if far:
        j = far[0]
        return (
            f"moving: '{outputs[j]}' drifted by {found.drift[j]:+.3g} while it lay still, more "
            f"than the threshold of {limit:.3g}"
        )
    return None


def refuse_unit(still: Still, frame: Frame | None, means: Array) -> str | None:
    """Return what is said where gravity has another size than at the poses taken (n, M)."""
    if frame is None or len(means) < 2:
        return None
    size = float(frame.force_size(still.found.mean[np.newaxis])[0])
    usual = float(median(frame.force_size(means)))
    if size > 0.0 and usual > 0.0 and is_factor(size / usual):
        return f"another unit: it reads gravity {size / usual:.3g} times as large as before"
    return None


def refuse_repeat(up: Array, taken: Array, labels: list[str]) -> str | None:
    """Return what is said where a direction (3,) is within 5° of one that was taken (n, 3)."""
    if not len(taken):
        return None
    chord = np.linalg.norm(taken - up, axis=1)
    angle = np.degrees(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))
    i = int(np.argmin(angle))
    if angle[i] > REPEAT_DEG:
        return None
    return f"repeats pose {labels[i]}, {angle[i]:.1f} degrees away; turn the sensor further"

"""Poses: rests offered to the session, the direction each shows, and why one is refused.

What a rest reads shows its direction as soon as the sensor is roughly known: by the calibration of
the poses so far; before there is one, by a sphere through their means,

    |y|² = 2 c·y + (r² − c·c),                                                              (1)

linear in the centre c; and before that by the size of gravity in a known unit, or in a session by
that of the first rest, where it shows a face. `find_frame` finds that `Frame`. `refuse_rest`
refuses a rest that moved or is cut off, `refuse_unit` one that reads gravity in another unit, and
`refuse_repeat` one within 5° (`apart_deg`) of a direction taken; `is_in_space` tells whether
directions determine a turn.

How the outputs stand in the case, mirrored and turned boards among them, is what was asked for
against what was shown (`find_turn`): the signed permutation Q, of 48, whose Q a_i are nearest to
the directions s_i, where these are within 30° of three in four. Fewer than three pairs in space
are met by some Q whatever was done, and of three or four all must be; the board as it is named goes
first, and stands until then.
"""

import math
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cache
from itertools import permutations, product

import numpy as np

from multipos.logs.faults import at_one_value, is_factor
from multipos.logs.still import Still
from multipos.numerics.arrays import COMPONENTS, Array, median
from multipos.positions.attitudes import Convention
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.units import unit_of_gravity

REPEAT_DEG = 5.0
_HAND_DEG = 30.0  # a hand that is asked for a direction comes nearer than that,
_FOLLOWED = 0.75  # at so many of the poses, and at four
_IN_SPACE = 0.3  # smallest singular value of directions that are in no plane
_SPREAD = 30.0  # condition of eq. (1) up to which the centre is identifiable
_SIGNIFICANT = 5.0  # times its standard uncertainty, of a drift


@frozen
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
    asked : (3,) array or None
        The direction, in case axes, that was asked for when it began.
    """

    position: str
    still: Still
    accepted: bool
    reason: str | None
    undone: bool = False
    asked: Array | None = None

    def taken_back(self, reason: str) -> "Pose":
        """Return the pose as the user took it back."""
        return replace(self, accepted=False, undone=True, reason=reason)

    def restored(self) -> "Pose":
        """Return the pose as it was before it was taken back."""
        return replace(self, accepted=True, undone=False, reason=None)


@frozen
class Frame:
    """How readings show directions: f = (y − centre)/size, or a calibration."""

    centre: Array
    size: float
    order: tuple[int, ...]  # output of x, y, z
    sign: float
    calibration: Calibration | None = None
    turn: Array = field(default_factory=lambda: np.eye(3))  # from the case to the outputs

    def force(self, means: Array) -> Array:
        """Return the forces (n, 3) that readings (n, M) show, in case axes, about 1 in size."""
        if self.calibration is not None:
            return self.calibration.compensate(means)
        size = self.size or np.nan  # readings that are all the same show no direction
        return np.asarray((means - self.centre)[:, list(self.order)] / size)

    def force_size(self, means: Array) -> Array:
        """Return the size (n,) of these forces."""
        return np.asarray(np.linalg.norm(self.force(means), axis=1))

    def up(self, means: Array) -> Array:
        """Return the up vectors (n, 3) that readings (n, M) show, in the axes of the outputs."""
        force = self.sign * self.force(means)
        size = np.linalg.norm(force, axis=1, keepdims=True)
        return np.asarray(force / np.where(size == 0.0, np.nan, size))

    def in_case(self, up: Array) -> Array:
        """Return up vectors (n, 3) in case axes."""
        return np.asarray(up @ self.turn)

    def in_outputs(self, up: Array) -> Array:
        """Return up vectors (n, 3) in the axes of the outputs."""
        return np.asarray(up @ self.turn.T)


def find_frame(
    means: Array,
    axes: tuple[int, ...],
    convention: Convention,
    calibration: Calibration | None,
    asked: "Sequence[Array | None]" = (),
) -> Frame | None:
    """Return how readings (n, M) show directions, as far as the poses so far tell.

    Parameters
    ----------
    asked : sequence of (3,) array or None
        What was asked for at each pose, in case axes.
    """
    sign = -1.0 if convention == "gravity" else 1.0
    blank = Frame(np.zeros(3), 1.0, tuple(int(i) for i in np.argsort(axes)), sign)
    frame = _find_frame(means, blank, calibration)
    pairs = [i for i, up in enumerate(asked) if up is not None]
    if not pairs or len(axes) != len(COMPONENTS):
        return frame
    seen = frame or replace(blank, size=float(median(np.linalg.norm(means, axis=1))))
    wanted = np.array([asked[i] for i in pairs])
    turn = find_turn(wanted, seen.up(means[pairs]))
    if turn is not None:
        return replace(seen, turn=turn)
    return seen if _shows_a_face(means[0]) else frame


def _shows_a_face(mean: Array) -> bool:
    """Tell whether a reading (3,) is one output's alone, so that its size is that of gravity."""
    return bool(np.abs(mean).max() > math.cos(math.radians(_HAND_DEG)) * np.linalg.norm(mean))


@cache
def _turns() -> Array:
    """Return the signed permutations (48, 3, 3): the identity, other rotations, mirrors."""
    every = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array(sorted(every, key=lambda turn: (-np.linalg.det(turn).round(), -np.trace(turn))))


def find_turn(asked: Array, shown: Array) -> Array | None:
    """Return how outputs stand in the case; None where nothing shows it.

    Parameters
    ----------
    asked : (n, 3) array
        Up vectors in case axes.
    shown : (n, 3) array
        In the axes of the outputs.
    """
    if not is_in_space(asked):
        return None
    near = np.einsum("tij,nj,ni->tn", _turns(), asked, shown)
    followed = (near >= math.cos(math.radians(_HAND_DEG))).sum(axis=1)
    if followed.max() < max(_FOLLOWED * len(asked), min(len(asked), 4)):
        return None
    if followed[0] == followed.max():
        return np.eye(3)
    score = np.where(followed == followed.max(), near.mean(axis=1), -np.inf)
    return np.asarray(_turns()[int(np.argmax(np.round(score, 6)))])


def is_in_space(directions: Array) -> bool:
    """Tell whether directions (n, 3) are three at least, and in no plane."""
    if len(directions) < len(COMPONENTS):
        return False
    return bool(np.linalg.svd(directions, compute_uv=False)[-1] > _IN_SPACE)


def _find_frame(means: Array, blank: Frame, calibration: Calibration | None) -> Frame | None:
    """Return how readings (n, M) show directions by themselves."""
    model = None if calibration is None else calibration.model
    if model is not None and len(model.axes) == 3 and not model.environment:
        return replace(blank, calibration=calibration)
    if len(blank.order) != 3 or not len(means):
        return None
    centre = _centre(means)
    if centre is not None:
        size = float(median(np.linalg.norm(means - centre, axis=1)))
        return replace(blank, centre=centre, size=size)
    size = float(median(np.linalg.norm(means, axis=1)))
    return None if unit_of_gravity(size) is None else replace(blank, size=size)


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
    significant = np.abs(found.drift) > _SIGNIFICANT * found.drift_u
    far = np.flatnonzero(significant & (np.abs(found.drift) > limit)).tolist()
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


def apart_deg(directions: Array, up: Array) -> Array:
    """Return the angles (n,) [degrees] between unit vectors (n, 3) and another (3,)."""
    chord = np.linalg.norm(directions - up, axis=1)
    return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))


def refuse_repeat(up: Array, taken: Array, labels: list[str]) -> str | None:
    """Return what is said where a direction (3,) is within 5° of one that was taken (n, 3)."""
    if not len(taken):
        return None
    angle = apart_deg(taken, up)
    i = int(np.argmin(angle))
    if angle[i] > REPEAT_DEG:
        return None
    return f"repeats pose {labels[i]}, {angle[i]:.1f} degrees away; turn the sensor further"

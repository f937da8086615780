"""One dividing head for all rolls: its circle identified by how the case is mounted in it.

`find_head` returns the mountings of a head that identify its circle, and `find_in_head` says which
rolls do not take part.

The circle of a head is off by the same at the same angle h of the head, in whatever mounting,

    e(h) = c_1 cos h + s_1 sin h + c_2 cos 2h + s_2 sin 2h,                                 (1)

while the case stands at t = ±h + t_0 + e_0, each mounting with a sense, a start t_0 and a zero e_0
of its own. The readings move by

    dy = M (du/dt) (e_0 ± e(h)),                                                            (2)

u and M as in `multipos.uncertainty.turntable`. Against h = t, what c_1 does is the product of
two components, what s_1 does is second order with bias; in a mounting that goes round the other
way c_1 does the opposite, in one turned by half a turn both do. So one further roll, mounted
otherwise, separates the circle from all that is second order in every output, also in those that
it does not turn. What stays are the misalignments, for which the e_0 of each mounting pass. Level
and wobble of the shaft are of each mounting.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.finding import Finding
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.positions.harmonics import Roll, find_rolls
from multipos.positions.readings import Readings

HEAD = "head_deg"


_SAME = 1e-3  # [rad] by which angles of one mounting may differ, as files round them


_FEWEST = 5  # rows of a mounting: three fit a head that turns twice as far


_MOST = 24  # mountings of a roll


class Mounting(NamedTuple):
    """Rows of a roll taken in one mounting: the case stands at `sense` times the head, and start.

    `roll` has these rows alone; `head` is the angle of the head [rad].
    """

    roll: Roll
    sense: float
    head: Array

    @property
    def name(self) -> str:
        """The plane, the sense and the start in degrees: ``xy+0``."""
        start = float(np.degrees(median(_wrap(self.roll.angle - self.sense * self.head))))
        return f"{self.roll.plane}{'+' if self.sense > 0.0 else '-'}{round(start) % 360}"


def find_head(readings: Readings) -> tuple[Mounting, ...]:
    """Return the mountings of rolls whose head is read; none where its angle fits no rolls."""
    mounted = tuple(_mounted(readings))
    return () if _unused(mounted) else mounted


def find_in_head(readings: Readings) -> list[Finding]:
    """Say where the angle of the head is missing, or turns otherwise than the roll."""
    return _unused(_mounted(readings))


def _unused(mounted: Iterable[Mounting]) -> list[Finding]:
    said = []
    for one in mounted:
        row = int(one.roll.rows[0]) + 1
        if not np.isfinite(one.head).all():
            text = f"readings of the roll about {one.roll.axis} lack `{HEAD}`; it is not used"
            said.append(Finding("head-unused", "warning", text, f"Complete `{HEAD}`."))
        elif len(one.head) < _FEWEST:
            text = (
                f"reading {row}: `{HEAD}` does not follow the angle of the roll about "
                f"{one.roll.axis}; it is not used"
            )
            said.append(Finding("head-unused", "warning", text, f"Correct `{HEAD}`."))
    return said


def _mounted(readings: Readings) -> list[Mounting]:
    if readings.up is None or HEAD not in readings.environment:
        return []
    head = np.radians(readings.environment[HEAD])
    found: list[Mounting] = []
    for roll in find_rolls(readings):
        turned = head[roll.rows]
        if not np.isfinite(turned).all():
            found.append(Mounting(roll, 1.0, turned))
            continue
        for sense, rows in _mountings(roll, turned):
            part = replace(roll, rows=roll.rows[rows], angle=roll.angle[rows])
            found.append(Mounting(part, sense, turned[rows]))
    return found


def _wrap(angle: Array) -> Array:
    """Return angles between −π and π."""
    return np.asarray(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


def _mountings(roll: Roll, head: Array) -> list[tuple[float, Places]]:
    """Return the sense and the places of the rows of each mounting of a roll.

    Of a head that turns by itself a single row, which is no mounting.
    Rows that fit two mountings, as at the start and half a turn on, go with their neighbours.
    """
    starts = {sense: roll.angle - sense * head for sense in (1.0, -1.0)}
    left = np.ones(len(head), dtype=bool)
    fits: list[tuple[float, Mask]] = []
    while left.any():
        row = int(np.argmax(left))
        if len(fits) == _MOST:
            return [(1.0, np.array([row]))]
        both = [(s, np.abs(_wrap(start - start[row])) < _SAME) for s, start in starts.items()]
        best = max(both, key=lambda one: int((one[1] & left).sum()))
        fits.append(best)
        left &= ~best[1]
    fitting = np.array([rows for _, rows in fits])
    clear = np.flatnonzero(fitting.sum(axis=0) == 1)
    place = np.argmax(fitting, axis=0)
    for row in np.flatnonzero(fitting.sum(axis=0) > 1).tolist():
        near = clear[fitting[place[clear], row]]
        if len(near):
            far = 2 * np.abs(near - row) + (near < row)  # of two as near, the one that follows
            place[row] = place[near[np.argmin(far)]]
    found = [(sense, np.flatnonzero(place == i)) for i, (sense, _) in enumerate(fits)]
    return [one for one in found if len(one[1])]

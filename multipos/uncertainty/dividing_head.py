"""One dividing head for all rolls: its circle told from the sensor by how the case is mounted.

The circle of a head is off by the same at the same angle h of the head, in whatever mounting,

    e(h) = c_1 cos h + s_1 sin h + c_2 cos 2h + s_2 sin 2h,                                 (1)

while the case stands at t = ±h + t_0 + e_0, each mounting with a sense, a start t_0 and a zero e_0
of its own. The readings move by

    dy = M (du/dt) (e_0 ± e(h)),                                                            (2)

u and M as in `multipos.uncertainty.table_motion`. Against h = t, what c_1 does is the product of
two components, what s_1 does is second order with bias; in a mounting that goes round the other
way c_1 does the opposite, in one turned by half a turn both do. So one further roll, mounted
otherwise, tells the circle from all that is second order in every output, also in those that
it does not turn. What stays are the misalignments, for which the e_0 of each mounting pass.

Level and wobble of the shaft, eq. (3) there, are of each mounting.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.known import FLOOR
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.numerics.separability import separability
from multipos.numerics.terms import COMPONENTS
from multipos.positions.harmonics import Roll, find_rolls
from multipos.positions.readings import Readings
from multipos.sensor.tilt import magnitude_of
from multipos.uncertainty.bench_columns import Bench, Sizes, separable, solve_beside
from multipos.uncertainty.table_findings import TableError, TableErrors
from multipos.uncertainty.table_motion import QUANTITIES, SHAFT, turn_of

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


def said_of_head(readings: Readings) -> list[str]:
    """Say where the angle of the head is missing, or turns otherwise than the roll."""
    return _unused(_mounted(readings))


def _unused(mounted: Iterable[Mounting]) -> list[str]:
    said = []
    for one in mounted:
        row = int(one.roll.rows[0]) + 1
        if not np.isfinite(one.head).all():
            said.append(f"some readings of the roll about {one.roll.axis} have no `{HEAD}`: unused")
        elif len(one.head) < _FEWEST:
            said.append(
                f"reading {row}: `{HEAD}` does not turn with the angle of the roll about "
                f"{one.roll.axis}, one way or the other: unused"
            )
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


def _mountings(roll: Roll, head: Array) -> list[tuple[float, NDArray[np.intp]]]:
    """Return the sense and the places of the rows of each mounting of a roll.

    Of a head that turns by itself a single row, which is no mounting.
    Rows that fit two mountings, as at the start and half a turn on, go with their neighbours.
    """
    starts = {sense: roll.angle - sense * head for sense in (1.0, -1.0)}
    left = np.ones(len(head), dtype=bool)
    fits: list[tuple[float, NDArray[np.bool_]]] = []
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


def head_errors(bench: Bench, mounted: tuple[Mounting, ...]) -> TableErrors:
    """Return the sensor beside the head, what the head is off by, and the zero of each mounting."""
    names, columns = _columns(bench, mounted, bench.linear)
    nominal = _columns(bench, mounted, bench.own)[1]
    free = separable(bench.sensor, nominal)
    free = [free[i] for i in separable(bench.sensor, columns[:, free])]
    design = np.column_stack([bench.sensor, columns[:, free]])
    null = separability(np.column_stack([bench.sensor, nominal]), floor=FLOOR).null
    told = (null == 0.0).all(axis=1)
    p = len(bench.keys)
    values: Sizes = {}
    beside = None
    if free and len(design) > design.shape[1]:
        beside, sizes = solve_beside(bench, design, told[:p])
        places = enumerate(free, start=p)
        values = {column: sizes[place] for place, column in places if told[p + column]}
    every = [*bench.names, *(f"{quantity} in {plane}" for plane, quantity in names)]
    errors = []
    for column, (plane, quantity) in enumerate(names):
        value, u_deg, U = (
            np.degrees(values[column]).tolist() if column in values else (None, None, None)
        )
        together = null[:, null[p + column] != 0.0]
        others = [
            every[j] for j in np.flatnonzero(together.any(axis=1)).tolist() if j != p + column
        ]
        errors.append(TableError(plane, quantity, value, u_deg, U, tuple(others)))
    felt = np.abs(nominal).max(axis=0, initial=0.0) > FLOOR
    angle = tuple(error for error in errors if error.quantity in QUANTITIES)
    shaft = tuple(e for e, seen in zip(errors, felt, strict=True) if seen and e.quantity in SHAFT)
    return TableErrors(angle, (), 0.0 if beside is None else beside.dof, shaft, beside)


def _columns(
    bench: Bench, mounted: tuple[Mounting, ...], linear: Array
) -> tuple[list[tuple[str, str]], Array]:
    """Return plane and quantity of each column, and what it does to the readings per radian.

    The circle is the four columns before those of each mounting: its zero, level and wobble.
    """
    n, m = len(bench.first.readings), len(linear)
    circle = np.zeros((n, m, 4))
    own = np.zeros((n, m, 4 * len(mounted)))
    size = bench.first.sign * magnitude_of(bench.first)
    names = [("head", quantity) for quantity in QUANTITIES[1:]]
    for place, one in enumerate(mounted):
        rows, h = one.roll.rows, one.head
        moved = turn_of(bench.first, one.roll) @ linear.T
        waves = np.column_stack([np.cos(h), np.sin(h), np.cos(2.0 * h), np.sin(2.0 * h)])
        circle[rows] = one.sense * moved[:, :, None] * waves[:, None, :]
        along = size * linear[:, COMPONENTS.index(one.roll.axis)]
        own[rows, :, 4 * place] = moved
        nods = np.column_stack([np.ones(len(h)), waves[:, :2]])
        own[rows, :, 4 * place + 1 : 4 * place + 4] = along[None, :, None] * nods[:, None, :]
        names += [(one.name, quantity) for quantity in (QUANTITIES[0], *SHAFT)]
    return names, np.concatenate([circle, own], axis=2).reshape(n * m, -1)

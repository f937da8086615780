"""Rolls of open angle: the sensor turned about one case axis by an angle that nobody read.

`read_open_rolls` returns them of a table, to which `with_angles` gives a column of angles where it
has none; `gather_open_rolls` returns them of readings as `OpenRolls`, `refuse_open_rolls` refuses
them where positions have to be known, and `across` gives a direction of their circle.

About a level case axis a, up lies on a circle, about one that leans it lies on a cone:

    u = sin(beta) a + cos(beta) c(t),      c(t) a unit vector across a, t open,              (1)

with c(t) as in the named rolls: (0, cos t, sin t) about x. Each position has its own t. The
inclination beta of the axis is 0, or unknown and shared by the rolls of one `group`: a pointer that
is aimed at one mark and turned about itself between the shots. Such rolls say along which line of
the case the sensor's axes lie, which positions of wholly unknown orientation do not.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.positions.attitudes import rows_without_angle
from multipos.positions.readings import Readings
from multipos.results import frozen


@frozen
class OpenRolls:
    """Which positions are rolls of open angle.

    Attributes
    ----------
    axis : (n,) array of int
        Number of the case axis, −1 for a position that is none.
    cone : (n,) array of int
        Number of the inclination that it shares, −1 where the axis is level.
    """

    axis: Places
    cone: Places

    @property
    def rows(self) -> Mask:
        """Positions that are rolls of open angle, (n,)."""
        return np.asarray(self.axis >= 0)

    @property
    def cones(self) -> int:
        """Number of unknown inclinations."""
        return int(self.cone.max(initial=-1)) + 1

    @property
    def vectors(self) -> Array:
        """The axes (n, 3), zero for a position that is none."""
        return np.concatenate([np.eye(3), np.zeros((1, 3))])[self.axis]

    @property
    def axes(self) -> tuple[str, ...]:
        """The case axes that rolls are about."""
        return tuple(COMPONENTS[i] for i in sorted(set(self.axis[self.rows].tolist())))


def across(axis: Array) -> Array:
    """Return a unit vector across each case axis (n, 3): any of its circle, the same everywhere."""
    return np.roll(axis, 1, axis=1)


def with_angles(table: Table) -> Table:
    """Return a table whose rolls have a column of angles, empty where it had none."""
    if "roll_axis" not in table or "angle_deg" in table:
        return table
    return replace(table, columns={**table.columns, "angle_deg": [""] * table.rows})


def read_open_rolls(table: Table, findings: list[Finding]) -> tuple[str, ...] | None:
    """Return the axis of each roll of open angle (n,), '' elsewhere; None without such rolls."""
    open_ = rows_without_angle(table)
    if not open_.any():
        return None
    rows = ", ".join(str(row + 1) for row in np.flatnonzero(open_)[:6].tolist())
    text = (
        f"roll angles of row {rows}{' and more' if open_.sum() > 6 else ''} are estimated; their "
        "axis is taken as level, or as equally inclined within a group"
    )
    findings.append(Finding("open-roll", "note", text))
    return tuple(
        axis if one else "" for axis, one in zip(table.text("roll_axis"), open_, strict=True)
    )


def gather_open_rolls(readings: Readings, group: Sequence[str], unknown: Mask) -> OpenRolls | None:
    """Return the rolls of open angle among positions; None where there are none.

    Parameters
    ----------
    readings : Readings
        Whose `open_roll` is as `read_open_rolls` returns it.
    group : n str
        Label of the group, '' for none.
    unknown : (n,) array of bool
        Positions of which nothing is known, whatever they are said to be.

    Raises
    ------
    MultiposError
        A group has rolls about two axes, or rolls of open angle beside other positions.
    """
    axes = readings.open_roll
    if axes is None or not any(axes):
        return None
    axis = np.array([COMPONENTS.index(one) if one else -1 for one in axes])
    axis = np.where(unknown, -1, axis)
    if (axis < 0).all():
        return None
    first: dict[str, int] = {}
    cone = np.full(len(axis), -1)
    number = {label: i for i, label in enumerate(dict.fromkeys(_grouped(axis, group)))}
    for row, label in enumerate(group):
        if not label:
            continue
        if axis[first.setdefault(label, row)] != axis[row]:
            raise MultiposError(
                f"position '{readings.labels[row]}': group '{label}' has rolls of open angle about "
                "one axis and other positions; rolls of one group share the inclination of one "
                "axis, so give the others a group of their own."
            )
        cone[row] = number.get(label, -1)
    return OpenRolls(axis, cone)


def _grouped(axis: Places, group: Sequence[str]) -> list[str]:
    """Return the groups of rolls of open angle, in their order."""
    return [label for one, label in zip(axis, group, strict=True) if label and one >= 0]


def refuse_open_rolls(readings: Readings) -> None:
    """Refuse rolls of open angle, where positions have to be known."""
    if readings.rolled.any():
        label = readings.labels[int(np.argmax(readings.rolled))]
        raise MultiposError(
            f"{readings.source or 'the readings'}: position '{label}' is a roll of open angle, "
            "which is no known position; write its angle_deg, or leave the position out."
        )

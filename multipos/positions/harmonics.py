"""Rolls and their harmonics: the Fourier view of a signal against the angle of a turn.

`find_rolls` finds the rolls among readings, `find_level_zero` angles that begin level; `series` and
`residual_series` give their harmonics, up to the `highest_order` that their angles distinguish,
`transform` and `power` those of one roll, `beyond_chance` and `strange_harmonics` what stands out
among them.

A roll is a set of positions with one case axis horizontal; its angle t runs from the first of the
two other axes to the second, so that up = (cos t, sin t) on them. A signal at N angles is

    y(t) = m + sum_h (c_h cos ht + s_h sin ht),    h = 1 … N/2,                             (1)

eq. (3) of docs/theory/tumble.md. Where the N angles are even steps of a turn, this is the discrete
Fourier transform,

    m = mean y,    c_h = 2/N sum y cos ht,    s_h = 2/N sum y sin ht,                       (2)

with 1/N at h = N/2, where the sampled cosine and sine are one and the same function and the
shorter of all answers is given. Elsewhere (1) is fitted by least squares, up to the highest order
at which cosines and sines are still distinguished.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.files.numbers import p_in_words
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.numerics.quantiles import f_tail
from multipos.positions.headers import named_axes
from multipos.positions.readings import Readings
from multipos.results import Result, frozen

_SAME = 1e-9  # [rad or g], below which two angles are one and a component is zero
_HIGHEST_UNEVEN = 24
_SIGNIFICANT = 0.01  # chance that a clean roll has a residual harmonic named
_LITTLE = 0.2  # of the response across, of an output that does not follow its own axis
_APART = 10.0  # condition up to which unevenly spaced cosines and sines are distinguished


@frozen
class Roll(Result):
    """Positions that share a horizontal case axis.

    Attributes
    ----------
    plane : str
        The two other axes, such as 'xy': the angle runs from the first to the second.
    axis : str
        The horizontal one.
    rows : (n,) array of int
        Positions, in order.
    angle : (n,) array [rad]
        0 to 2 pi.
    """

    plane: str
    axis: str
    rows: Places
    angle: Array

    @property
    def distinct(self) -> Array:
        """The different angles (N,), rising [rad]."""
        rising = np.sort(self.angle)
        result: Array = rising[np.append(True, np.diff(rising) > _SAME)]
        return result

    @property
    def gap(self) -> float:
        """The widest stretch of the turn without a position [rad]."""
        angles = self.distinct
        return float(np.diff(np.append(angles, angles[0] + 2.0 * np.pi)).max())

    @property
    def spans_a_turn(self) -> bool:
        """Whether no more than half a turn is without a position."""
        return self.gap <= np.pi + 1e-6

    @property
    def even(self) -> bool:
        """Whether the angles are even steps of a turn."""
        return bool(abs(self.gap - 2.0 * np.pi / len(self.distinct)) < 1e-6)

    @property
    def groups(self) -> Places:
        """Which of the distinct angles each position has (n,)."""
        after = np.searchsorted(self.distinct, self.angle + _SAME) - 1
        return np.asarray(np.maximum(after, 0))

    def average(self, values: Array) -> Array:
        """Return the means (N, …) over positions of one angle of values (n, …)."""
        groups = self.groups
        total = np.zeros((len(self.distinct), *values.shape[1:]))
        np.add.at(total, groups, values)
        counts = np.bincount(groups).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(total / counts)


@frozen
class Harmonic(Result):
    """A coefficient pair of a Fourier series, in reading units; order 0 is the mean in `cos`.

    `u_cos` and `u_sin` are what the noise of a reading makes of them, None where it is not known.
    For residuals `p` is the chance of as much where neither table nor model has this harmonic;
    None where the model explains it whatever it is.
    """

    plane: str
    order: int
    cos: float
    sin: float
    u_cos: float | None = None
    u_sin: float | None = None
    p: float | None = None

    @property
    def amplitude(self) -> float:
        """Square root of cos² + sin²."""
        return math.hypot(self.cos, self.sin)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as JSON carries it, without p."""
        return {
            "plane": self.plane,
            "order": self.order,
            "cos": self.cos,
            "sin": self.sin,
            "amplitude": self.amplitude,
        }


def find_rolls(readings: Readings, first: str = "x", sign: float = 1.0) -> tuple[Roll, ...]:
    """Return the rolls of oriented readings with at least three angles each.

    A position along an axis lies in two planes: in that of its attitude where the heading is
    known, else in that of its neighbours in the list, the next before the last.

    Parameters
    ----------
    readings : Readings
    first : str
        The axis that an angle is counted from, where it is in the plane.
    sign : float
        −1 counts it from the axis that points down.
    """
    if readings.up is None:
        return ()
    up = readings.up
    level = (np.abs(up) < _SAME) & ~readings.forced[:, None]  # at rest, not on a centrifuge
    if not level.any():
        return ()
    horizontal = _horizontal(readings, level)
    found = []
    for axis in dict.fromkeys(horizontal.tolist()):
        if axis < 0:
            continue
        rows = np.flatnonzero(horizontal == axis)
        names = [name for i, name in enumerate(COMPONENTS) if i != axis]
        names.sort(key=lambda name: name != first)
        along, across = (sign * up[rows, COMPONENTS.index(name)] for name in names)
        angle = np.remainder(np.arctan2(across, along), 2.0 * np.pi)
        angle[angle > 2.0 * np.pi - _SAME] = 0.0
        roll = Roll("".join(names), COMPONENTS[axis], rows, angle)
        if len(roll.distinct) >= 3:
            found.append(roll)
    return tuple(found)


def find_level_zero(readings: Readings) -> list[Finding]:
    """Say where outputs follow the sine of a roll's angle, which is then counted from level."""
    slopes = []
    for roll in find_rolls(readings):
        up = np.asarray(readings.up)[roll.rows]
        for values, axis in zip(
            readings.values[roll.rows].T, named_axes(readings.outputs), strict=True
        ):
            if COMPONENTS[axis] in roll.plane:
                across = COMPONENTS.index(roll.plane.replace(COMPONENTS[axis], ""))
                columns = np.column_stack([np.ones(len(up)), up[:, axis], up[:, across]])
                slopes.append(np.linalg.lstsq(columns, values, rcond=None)[0][1:].tolist())
    if not slopes or any(abs(own) > _LITTLE * other for own, other in slopes):
        return []
    text = "readings follow the sine of the angle, as where it is counted from level"
    return [Finding("table", "warning", text, "Add --angle-zero level.")]


def _horizontal(readings: Readings, level: Mask) -> Places:
    """Return the horizontal axis of every position, −1 where it is on no roll."""
    result = np.full(len(level), -1)
    clear = level.sum(axis=1) == 1
    result[clear] = np.argmax(level[clear], axis=1)
    planes = set(result[clear].tolist())
    often = level.sum(axis=0)
    along = np.flatnonzero(level.sum(axis=1) == 2).tolist()
    for row in along:
        east = -1 if readings.rotation is None else _along(readings.rotation[row][:, 0])
        result[row] = _turned_about(np.flatnonzero(level[row]), often, planes, east)
    decided = np.flatnonzero(result >= 0).tolist()
    open_rows = [row for row in along if result[row] < 0]
    for row in open_rows:
        # Of two neighbours as near, the one that follows: a roll begins along an axis.
        near = [k for k in decided if level[row, result[k]]]
        if near:
            result[row] = result[min(near, key=lambda k: (abs(k - row), k < row))]
    return result


def _turned_about(possible: Places, often: Places, planes: set[int], east: int) -> int:
    """Return the one of two horizontal axes that a position was turned about, −1 if open.

    `often` says how many positions each axis is horizontal in, `planes` are the axes of the rolls
    that are known, and `east` is the axis that points there.
    """
    if east in possible:
        return east
    rolled = [axis for axis in possible.tolist() if axis in planes]
    if len(rolled) == 1:
        return int(rolled[0])
    most = possible[often[possible] == often[possible].max()]
    return int(most[0]) if not planes and len(most) == 1 else -1


def _along(vector: Array) -> int:
    """Return the axis that a vector points along, −1 for none."""
    axis = int(np.argmax(np.abs(np.nan_to_num(vector))))
    return axis if abs(abs(float(vector[axis])) - 1.0) < _SAME else -1


def highest_order(roll: Roll) -> int:
    """Return the highest order of eq. (1) that the angles of a roll tell apart."""
    count = len(roll.distinct)
    if roll.even:
        return count // 2
    order = min((count - 1) // 2, _HIGHEST_UNEVEN)
    while order > 0:
        singular = np.linalg.svd(_basis(roll.distinct, order), compute_uv=False)
        if singular[0] <= _APART * singular[-1]:
            break
        order -= 1
    return order


def transform(roll: Roll) -> Array:
    """Return the matrix (1 + 2 H, N) of the transform: m, c_1, s_1, … c_H, s_H by eq. (2)."""
    basis = _basis(roll.distinct, highest_order(roll))
    if not roll.even:
        return np.asarray(np.linalg.pinv(basis))
    result: Array = 2.0 * basis.T / len(basis)
    result[0] /= 2.0
    if basis.shape[1] > len(basis):  # N is even, and h = N/2 among the orders
        result[-2:] /= 2.0
    return result


def series(rolls: Sequence[Roll], signal: Array, sd: float | None = None) -> tuple[Harmonic, ...]:
    """Return the harmonics of a signal (n,) on every roll that spans a turn.

    Parameters
    ----------
    rolls : sequence of Roll
    signal : (n,) array
    sd : float, optional
        Standard deviation of a reading, for the uncertainties.
    """
    found = []
    for roll in rolls:
        if not roll.spans_a_turn:
            continue
        weights = transform(roll)
        values = (weights @ roll.average(signal[roll.rows])).tolist()
        u = [None] * len(values)
        if sd is not None:
            u = (sd * np.sqrt((weights**2 / np.bincount(roll.groups)).sum(axis=1))).tolist()
        found.append(Harmonic(roll.plane, 0, values[0], 0.0, u[0], None if sd is None else 0.0))
        for k in range(1, len(values), 2):
            found.append(Harmonic(roll.plane, (k + 1) // 2, *values[k : k + 2], *u[k : k + 2]))
    return tuple(found)


def residual_series(
    rolls: Sequence[Roll], residual: Array, design: Array, rounding: float
) -> tuple[Harmonic, ...]:
    """Return the harmonics of residuals (n,), each with an F test against all the others.

    A harmonic is tested by what it explains beyond the model: its cosine and sine less their
    projections on the design (n, p). Residuals of no more than `rounding` are not tested.
    """
    Q, _ = np.linalg.qr(design)
    rss = float(residual @ residual)
    n, dof = len(residual), len(residual) - design.shape[1]
    angles = {roll.plane: roll for roll in rolls}
    result = []
    for h in series(rolls, residual):
        roll = angles[h.plane]
        waves = np.zeros((n, 2))
        phase = h.order * roll.angle
        waves[roll.rows] = np.column_stack([np.cos(phase), np.sin(phase)])
        directions, size, _ = np.linalg.svd(waves - Q @ (Q.T @ waves), full_matrices=False)
        directions = directions[:, size > 1e-6 * math.sqrt(n)]
        d = directions.shape[1]
        explained = float(((residual @ directions) ** 2).sum())
        p = None
        if d and dof > d and rss > n * rounding**2 and rss > explained:
            p = f_tail(explained / d / ((rss - explained) / (dof - d)), d, dof - d)
        result.append(replace(h, p=p))
    return tuple(result)


def beyond_chance(residual: Sequence[Harmonic]) -> list[Harmonic]:
    """Return the residual harmonics beyond chance, of all those tested together."""
    tested = [h for h in residual if h.p is not None]
    return [h for h in tested if h.p is not None and h.p < _SIGNIFICANT / len(tested)]


def strange_harmonics(residual: Sequence[Harmonic]) -> list[Finding]:
    """Name the residual harmonics beyond chance."""
    return [
        Finding(
            "harmonic-left",
            "warning",
            (
                f"residuals contain harmonic {h.order} in plane {h.plane}, amplitude "
                f"{h.amplitude:.2g} ({p_in_words(h.p)})"
            ),
            "Check the table, or add a term to the model.",
            p=h.p,
        )
        for h in beyond_chance(residual)
    ]


def _basis(angle: Array, order: int) -> Array:
    multiples = np.outer(angle, np.arange(1, order + 1))
    columns = np.stack([np.cos(multiples), np.sin(multiples)], axis=2)
    columns[np.abs(columns) < _SAME] = 0.0  # a sine that no angle sees is no sine of 1e-16
    return np.column_stack([np.ones(len(angle)), columns.reshape(len(angle), -1)])

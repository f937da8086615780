"""Hysteresis of a tumble: readings at an angle that is come to from below, and from above.

- `find_hysteresis` returns the `Hysteresis` of every roll that was passed both ways.

A pass runs forward where the angle of the roll, as a scheme lists it, grows from one reading to the
next, and backward where it falls. At the N angles that were come to both ways the difference of the
means is d_k, and

    h = (1/N) sum d_k,      u(h) = s(d)/√N on N − 1 degrees of freedom,                     (1)

forward less backward, in g. What shifts from angle to angle is in s(d); a zero that drifts evenly
through both passes is in h, for the backward pass comes later. The first reading of a roll, and one
at the angle of the reading before, belong to the pass that follows.
"""

from collections.abc import Sequence

import numpy as np

from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import coverage_factor
from multipos.positions.harmonics import Roll
from multipos.results import Result, frozen

_STILL = 1e-9  # [rad], a turn that is none
_FEWEST = 2  # angles come to both ways, without which there is no spread


@frozen
class Hysteresis(Result):
    """Mean of forward less backward readings at the same angles of a roll, by eq. (1)."""

    value: float
    u: float
    U: float
    unit: str
    dof: float
    angles: int


def find_hysteresis(
    rolls: Sequence[Roll], signal: Array, confidence: float
) -> dict[str, Hysteresis]:
    """Return the hysteresis of every roll that was passed both ways, by its plane.

    Parameters
    ----------
    rolls : sequence of Roll
    signal : (n,) array [g]
        The readings over K1, in the order in which they were taken.
    confidence : float
    """
    found = {}
    for roll in rolls:
        # An angle of plane 'yx' falls where that of the roll, from x to y, grows.
        sense = 1 if roll.plane == "".join(sorted(roll.plane)) else -1
        way, values, groups = sense * _passes(roll.angle), signal[roll.rows], roll.groups
        differences = []
        for group in range(len(roll.distinct)):
            here = groups == group
            forward, backward = values[here & (way > 0)], values[here & (way < 0)]
            if len(forward) and len(backward):
                differences.append(float(forward.mean() - backward.mean()))
        count = len(differences)
        if count < _FEWEST:
            continue
        u = float(np.std(differences, ddof=1)) / np.sqrt(count)
        U = coverage_factor(confidence, count - 1.0) * u
        value = float(np.mean(differences))
        found[roll.plane] = Hysteresis(value, float(u), float(U), "g", count - 1.0, count)
    return found


def _passes(angle: Array) -> Places:
    """Return +1 for readings (n,) of a forward pass, −1 of a backward one, 0 where none shows."""
    turned = np.remainder(np.diff(angle) + np.pi, 2.0 * np.pi) - np.pi
    way = np.sign(np.where(np.abs(turned) < _STILL, 0.0, turned))
    way[np.abs(np.abs(turned) - np.pi) < _STILL] = 0.0  # half a turn goes either way
    result = np.concatenate([[0.0], way])
    for row in range(len(result) - 2, -1, -1):
        if result[row] == 0.0:
            result[row] = result[row + 1]
    return result.astype(np.intp)

"""How a turntable that is not where it says moves the readings of a roll.

The table says t and stands at t + e(t), on each roll with its own

    e(t) = e_0 + c_1 cos t + s_1 sin t + c_2 cos 2t + s_2 sin 2t,                           (1)

a zero offset of the encoder and two harmonics of its circle. A reading then moves by

    dy = M (du/dt) e(t),    u = (cos t, sin t) in the plane of the roll,                    (2)

M the linear part of the model.

The shaft a itself may stand off the horizon by l, and nod as it turns,

    f_a = ±g (l + w_c cos t + w_s sin t).                                                   (3)

Eqs. (10) and (11) of docs/theory/tumble.md.
"""

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.positions.harmonics import Roll
from multipos.sensor.calibration import Calibration
from multipos.sensor.tilt import magnitude_of

QUANTITIES = ("zero_offset", "first_cos", "first_sin", "second_cos", "second_sin")
SHAFT = ("level", "wobble_cos", "wobble_sin")


def turn_of(calibration: Calibration, roll: Roll) -> Array:
    """Return df/dt (n, 3) [g] of a roll."""
    first, second = (COMPONENTS.index(name) for name in roll.plane)
    result = np.zeros((len(roll.rows), 3))
    result[:, first], result[:, second] = -np.sin(roll.angle), np.cos(roll.angle)
    return calibration.sign * magnitude_of(calibration) * result


def table_effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return eq. (2) per radian of each quantity of each roll (n M, 5 rolls)."""
    n, m = len(calibration.readings), len(linear)
    result = np.zeros((n, m, len(QUANTITIES) * len(rolls)))
    for place, roll in enumerate(rolls):
        t = roll.angle
        waves = (np.ones(len(t)), np.cos(t), np.sin(t), np.cos(2.0 * t), np.sin(2.0 * t))
        moved = turn_of(calibration, roll) @ linear.T
        for number_, wave in enumerate(waves):
            result[roll.rows, :, len(QUANTITIES) * place + number_] = wave[:, None] * moved
    return result.reshape(n * m, -1)


def shaft_effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return what eq. (3) does to the readings per radian of each quantity (n M, 3 rolls)."""
    n, m = len(calibration.readings), len(linear)
    result = np.zeros((n, m, len(SHAFT) * len(rolls)))
    size = calibration.sign * magnitude_of(calibration)
    for place, roll in enumerate(rolls):
        along = size * linear[:, COMPONENTS.index(roll.axis)]
        waves = (np.ones(len(roll.angle)), np.cos(roll.angle), np.sin(roll.angle))
        for number_, wave in enumerate(waves):
            result[roll.rows, :, len(SHAFT) * place + number_] = np.outer(wave, along)
    return result.reshape(n * m, -1)

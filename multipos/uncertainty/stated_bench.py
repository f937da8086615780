"""A bench whose errors are stated: readings with the covariance that its table gives them.

The quantities of eqs. (3) and (5) of `multipos.uncertainty.turntable`, each with a standard
deviation u_q, and a zero that drifts by u_z from roll to roll, move readings together:

    V = s² I + sum over rolls [u_z² 1 1' + sum_q u_q² Δy_q Δy_q'] + u_t² sum_k Δy_k Δy_k',       (1)

eq. (13) of docs/theory/tumble.md, s the noise of a reading and u_t the table at each position by
itself.
"""

from dataclasses import replace

import numpy as np

from multipos.positions.harmonics import find_rolls
from multipos.positions.readings import Readings
from multipos.results import require
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.turntable import shaft_effects, table_effects, turn_of


def state_bench(
    calibration: Calibration,
    *,
    reading_sd: float,
    zero_drift: float = 0.0,
    angle_sd_deg: float = 0.0,
    offset_sd_deg: float = 0.0,
    first_sd_deg: float = 0.0,
    second_sd_deg: float = 0.0,
    level_sd_deg: float = 0.0,
    wobble_sd_deg: float = 0.0,
) -> Readings:
    """Return a calibration's readings with the covariance that a stated bench gives them.

    Fitted again, they give the best estimate on that bench and an uncertainty with all of it in.

    Parameters
    ----------
    calibration : Calibration
        A first fit, for the scale factors that turn angles into readings.
    reading_sd : float
        Standard uncertainty of an averaged reading, in reading units.
    zero_drift : float
        Standard deviation of each output's zero from roll to roll, in reading units.
    angle_sd_deg : float
        Error of the table at each position by itself.
    offset_sd_deg, first_sd_deg, second_sd_deg : float
        Of e_0, and of each coefficient of the first and second harmonic, on every roll.
    level_sd_deg, wobble_sd_deg : float
        Of the shaft from the horizon, and of each coefficient of its nodding, on every roll.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> first = mp.fit(readings, axes="x", inputs="x,y")
    >>> known = mp.state_bench(first, reading_sd=5e-5, angle_sd_deg=0.01)
    >>> known.covariance.shape, bool(known.covariance[0, 0] < known.covariance[3, 3])
    ((12, 12), True)
    """
    require(calibration, Calibration)
    model, readings = calibration.model, calibration.readings
    rolls = find_rolls(readings)
    linear = model.linear_part(calibration.parameters, calibration.mean_environment)[:, 1:]
    n, m = readings.values.shape
    covariance = np.eye(n * m) * reading_sd**2
    for roll in rolls:
        for output in range(m):
            member = np.zeros((n, m))
            member[roll.rows, output] = zero_drift
            covariance += np.outer(member, member)
        turned = np.zeros((n, m, n))
        turned[roll.rows, :, roll.rows] = turn_of(calibration, roll) @ linear.T
        turned = turned.reshape(n * m, n) * np.radians(angle_sd_deg)
        covariance += turned @ turned.T
    sds = np.radians([offset_sd_deg, *[first_sd_deg] * 2, *[second_sd_deg] * 2])
    nods = np.radians([level_sd_deg, *[wobble_sd_deg] * 2])
    for effect, each in (
        (table_effects(calibration, rolls, linear), sds),
        (shaft_effects(calibration, rolls, linear), nods),
    ):
        moved = effect * np.tile(each, len(rolls))
        covariance += moved @ moved.T
    return replace(readings, u=None, covariance=covariance)

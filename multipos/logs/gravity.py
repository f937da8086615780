"""Which columns of a log without names show gravity.

Three columns in a row that sense gravity turn with the sensor and keep their size; a gyro at rest
shows its bias, which neither turns nor means anything, and in motion any size. So blocks of rows
are taken in which nothing moves, the quietest third, and the triad is looked for whose size varies
least there while its direction changes.
"""

import numpy as np

from multipos.logs.rests import LARGEST_SAMPLE
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median

_BLOCK = 32  # rows
_FEWEST = 12  # blocks
_VARIES = 0.15  # relative: by a bias of so many g the size of gravity does, over the directions
_TURNS = 0.5  # of its size: how far a component goes when the sensor is turned
_CLEAR = 3.0  # times the variation of the next: a magnetometer turns too


def triad_of_gravity(log: Log, names: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the three columns in a row that show gravity; None where that is not clear."""
    if len(names) % 3:
        return None
    table = next(iter(log.read((), names, lenient=True))).table
    data = np.array([table.columns[name] for name in names], dtype=np.float64)
    data = data[:, (np.abs(data) <= LARGEST_SAMPLE).all(axis=0)]  # and no NaN
    count = data.shape[1] // _BLOCK
    if count < _FEWEST:
        return None
    blocks = data[:, : count * _BLOCK].reshape(len(names), count, _BLOCK)
    mean, sd = blocks.mean(axis=2), blocks.std(axis=2)
    usual = median(sd, axis=1)[:, None]
    moves = (sd / np.where(usual > 0.0, usual, 1.0)).max(axis=0)
    quiet = mean[:, moves <= np.quantile(moves, 1.0 / 3.0)]
    varies = [_variation(quiet[i : i + 3]) for i in range(0, len(names), 3)]
    order = np.argsort(varies)
    best = int(order[0])
    if varies[best] > _VARIES or _CLEAR * varies[best] > varies[int(order[1])]:
        return None
    return names[3 * best : 3 * best + 3]


def _variation(means: Array) -> float:
    """Return how the size of means (3, n) varies, relatively; infinite where they do not turn."""
    size = np.linalg.norm(means, axis=0)
    usual = float(median(size))
    if not usual or float(np.ptp(means, axis=1).max()) < _TURNS * usual:
        return np.inf
    low, high = np.quantile(size, [0.1, 0.9]).tolist()
    return float(high - low) / usual

"""The noise that readings state: as standard uncertainties, as variances, and by an option.

`Readings.noise` has it as variances (n M,) where outputs are independent, else as their covariance
(n M, n M), output running fastest.
"""

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import LARGEST, SMALLEST, Array
from multipos.positions.readings import Readings


def stated_sd(readings: Readings) -> Array | None:
    """Return the stated standard uncertainty of each reading (n, M), or None."""
    if readings.covariance is not None:
        return np.asarray(np.sqrt(np.diag(readings.covariance)).reshape(readings.values.shape))
    return readings.u


def diagonal(noise: Array) -> Array:
    """Return the variances (n M,) of noise as `Readings.noise` has it."""
    return noise if noise.ndim == 1 else np.diag(noise)


def add_variances(noise: Array, variances: Array) -> Array:
    """Return noise, as `Readings.noise` has it, with independent variances (n M,) added."""
    return noise + (variances if noise.ndim == 1 else np.diag(variances))


def spread_reading_sd(reading_sd: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return --reading-sd, one number or one an output, as that of every reading (n, M).

    Raises
    ------
    UsageError
        Another number of values, or one that is not above 0 or cannot be squared.
    """
    sd = np.asarray(reading_sd, dtype=np.float64).ravel()
    if len(sd) not in (1, shape[1]):
        raise UsageError(f"--reading-sd takes 1 or {shape[1]} values, got {len(sd)}.")
    if not ((sd >= SMALLEST) & (sd <= LARGEST)).all():
        raise UsageError(
            f"--reading-sd must be above 0, from {SMALLEST:g} to {LARGEST:g}, got "
            f"{', '.join(f'{each:g}' for each in sd.tolist())}."
        )
    return np.broadcast_to(sd, shape)

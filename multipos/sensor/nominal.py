"""The nominal conversion: what a data sheet makes of a reading, before any calibration.

- `read_nominal` takes one, `nominal_force` converts readings by it.

    f = (raw − bias)/scale                                                                  (1)

with one bias [reading] and one scale factor [reading/g] for every output; outputs of one axis are
averaged. It is what a calibration is compared with.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array, as_numbers
from multipos.sensor.model import Model


class Nominal(NamedTuple):
    """Bias [reading] and scale factor [reading/g] of eq. (1)."""

    bias: float
    scale: float


def read_nominal(given: Sequence[float]) -> Nominal:
    """Return a nominal conversion, refusing one that converts nothing."""
    stated = as_numbers(given, "--nominal", UsageError).ravel()
    if len(stated) != 2 or not (np.abs(stated) <= LARGEST).all() or not abs(stated[1]) >= SMALLEST:
        raise UsageError(
            f"--nominal takes BIAS,SCALE in reading units, up to {LARGEST:g}, the scale from "
            f"{SMALLEST:g} on."
        )
    return Nominal(*stated.tolist())


def nominal_force(model: Model, values: Array, nominal: Nominal) -> Array:
    """Return the force (n, K) [g] that readings (n, M) are by eq. (1)."""
    converted = (values - nominal.bias) / nominal.scale
    own = np.array(model.axes)
    axes = [COMPONENTS[i] for i in model.sensed_axes]
    return np.column_stack([converted[:, own == axis].mean(axis=1) for axis in axes])

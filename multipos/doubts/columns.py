"""Doubts that a column raises by itself, whatever the positions were.

A dead output: one that stands still, to the last digit, while its own axis turned from one side
of the horizon to the other. A sensor at rest scatters and quantises, but over an own reference
that spans more than half of what was applied it does not repeat one number.

A temperature in kelvin: all of it between 200 and 400, where a temperature in degrees Celsius at
which a sensor is calibrated stays below that.
"""

import numpy as np

from multipos.numerics.terms import COMPONENTS
from multipos.positions.readings import quoted
from multipos.sensor.calibration import Calibration
from multipos.sensor.doubt import Doubt

_SPAN = 0.5  # of the own reference [g], below which an output may well stand still
_KELVIN = (200.0, 400.0)


def dead_output(c: Calibration) -> Doubt | None:
    """Find outputs that gave one number while gravity moved along their axis."""
    dead = [
        output
        for output, axis, values in zip(c.outputs, c.model.axes, c.readings.values.T, strict=True)
        if np.ptp(values) == 0.0 and np.ptp(c.reference[:, COMPONENTS.index(axis)]) > _SPAN
    ]
    if not dead:
        return None
    return Doubt(
        "dead-output",
        "implausible",
        f"{quoted(dead)} read the same number at all {len(c.readings)} positions: the output is "
        "not connected, or the column is another one; mend it, or leave it out with --outputs",
        outputs=tuple(dead),
    )


def temperature_kelvin(c: Calibration) -> Doubt | None:
    """Find a temperature that the model uses and that looks like kelvin."""
    column = c.readings.environment.get("temperature")
    if column is None or "temperature" not in c.model.environment:
        return None
    low, high = float(column.min()), float(column.max())
    if not _KELVIN[0] <= low <= high <= _KELVIN[1]:
        return None
    return Doubt(
        "temperature-kelvin",
        "caution",
        f"the temperature, {low:g} to {high:g}, looks like kelvin: coefficients are for degrees "
        "Celsius, and the bias is that at 0; subtract 273.15 from the column",
    )

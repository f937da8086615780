"""PX4 [1]_: ``CAL_ACC0_XOFF`` … and ``CAL_ACC0_XSCALE`` …, in the form of QGroundControl.

corrected = (raw − OFF) SCALE axis by axis, raw in m/s², so that OFF = o and SCALE = T_ii.

References
----------
.. [1] PX4-Autopilot, ``sensor_calibration/Accelerometer.hpp``, ``Correct``.
"""

from functools import partial

from multipos.compensation.laws import DIAGONAL, Law
from multipos.compensation.parameters import (
    diagonal_values,
    gives,
    origin,
    parameter_target,
    read_diagonal,
)
from multipos.sensor.calibration import Calibration

_NAMES = tuple(f"CAL_ACC0_{axis}{kind}" for kind in ("OFF", "SCALE") for axis in "XYZ")
_REAL32 = 9  # MAV_PARAM_TYPE


def _write(calibration: Calibration, law: Law) -> tuple[str, list[str]]:
    values = diagonal_values(calibration, law, _NAMES)
    lines = [
        *(f"# {line}" for line in origin(calibration)),
        "# corrected = (raw - OFF) SCALE, in m/s^2",
        "#",
        "# Vehicle-Id Component-Id Name Value Type",
        *(f"1\t1\t{n}\t{v!r}\t{_REAL32}" for n, v in zip(_NAMES, values, strict=True)),
    ]
    return "\n".join(lines) + "\n", []


PX4 = parameter_target(
    "px4",
    DIAGONAL,
    raw_in_metres=True,
    write=_write,
    recognises=partial(gives, "CAL_ACC0_"),
    read=partial(read_diagonal, _NAMES),
    suffix=".params",
)

"""ArduPilot [1]_: ``INS_ACCOFFS_X`` … and ``INS_ACCSCAL_X`` …, in the form of Mission Planner.

corrected = (raw − OFFS) SCAL axis by axis, raw in m/s², so that OFFS = o and SCAL = T_ii.

References
----------
.. [1] ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
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

_NAMES = tuple(f"INS_ACC{kind}_{axis}" for kind in ("OFFS", "SCAL") for axis in "XYZ")
# What the ground stations accept, offset [m/s²] and scale.
_LIMITS = (3.5, (0.8, 1.2))


def _write(calibration: Calibration, law: Law) -> tuple[str, list[str]]:
    values = diagonal_values(calibration, law, _NAMES)
    offset, (low, high) = _LIMITS
    bad = [n for n, v in zip(_NAMES[:3], values[:3], strict=True) if abs(v) > offset]
    bad += [n for n, v in zip(_NAMES[3:], values[3:], strict=True) if not low <= v <= high]
    notes = [f"{', '.join(bad)} beyond what ArduPilot accepts"] if bad else []
    lines = [
        *(f"# {line}" for line in origin(calibration)),
        "# corrected = (raw - OFFS) SCAL, in m/s^2",
        *(f"{n},{v!r}" for n, v in zip(_NAMES, values, strict=True)),
    ]
    return "\n".join(lines) + "\n", notes


ARDUPILOT = parameter_target(
    "ardupilot",
    DIAGONAL,
    raw_in_metres=True,
    write=_write,
    recognises=partial(gives, "INS_ACC"),
    read=partial(read_diagonal, _NAMES),
    suffix=".parm",
)

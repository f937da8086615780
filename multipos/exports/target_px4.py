"""PX4 [1]_: ``CAL_ACC0_XOFF`` … and ``CAL_ACC0_XSCALE`` …, in the form of QGroundControl.

corrected = (raw − OFF − thermal offset) SCALE axis by axis, raw in m/s², so that OFF = o at the
mean temperature and SCALE = T_ii. The thermal offset [2]_ is Σ X_k (t − TREF)^k, k = 0 to 3, with t
held to TMIN … TMAX, so that ``TC_A0_X1_0`` … are c_1 … of the x axis and X0 is 0.

PX4 looks a calibration up by the ID of the sensor's device: what stands under another ID, or none,
is not used.

References
----------
.. [1] PX4-Autopilot, ``sensor_calibration/Accelerometer.hpp``, ``Correct``, and
   ``Accelerometer.cpp``, ``ParametersUpdate``.
.. [2] PX4-Autopilot, ``TemperatureCompensation.cpp``, ``calc_thermal_offsets_3D``.
"""

import re

import numpy as np

from multipos.exports.laws import DIAGONAL, Correction, Drift, Law
from multipos.exports.parameters import (
    diagonal_values,
    origin,
    parameter_target,
    read_named,
    require_instance,
)
from multipos.exports.target import Wish
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration

REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE
_INSTANCES = range(4)
_GIVEN = re.compile(r"^(?!#).*\bCAL_ACC(?P<instance>\d)_[XYZ]", re.MULTILINE)


def _names(instance: int) -> tuple[str, ...]:
    kinds = ("OFF", "SCALE")
    return tuple(f"CAL_ACC{instance}_{axis}{kind}" for kind in kinds for axis in "XYZ")


def _slopes(instance: int) -> tuple[str, ...]:
    return tuple(f"TC_A{instance}_X{power}_{axis}" for power in (1, 2, 3) for axis in range(3))


def _limits(instance: int) -> tuple[str, ...]:
    return tuple(f"TC_A{instance}_{name}" for name in ("TREF", "TMIN", "TMAX"))


def _write(calibration: Calibration, law: Law, wish: Wish) -> tuple[str, list[Finding]]:
    instance = require_instance(wish, "px4", _INSTANCES)
    names = _names(instance)
    values = diagonal_values(calibration, law, names)
    found: list[tuple[str, float | int, int]] = []
    if wish.device_id is not None:
        found.append((f"CAL_ACC{instance}_ID", wish.device_id, INT32))
    found += [(name, value, REAL32) for name, value in zip(names, values, strict=True)]
    thermal = ""
    if law.drift is not None:
        found += _thermal(law.drift, instance, wish.device_id)
        thermal = f" - sum of X_k (t - {law.drift.reference:.6g})^k"
    head = [*origin(calibration), f"corrected = (raw - OFF{thermal}) SCALE, in m/s^2"]
    return params_text(head, found), without_id(f"CAL_ACC{instance}_ID", wish)


def params_text(head: list[str], found: list[tuple[str, float | int, int]]) -> str:
    """Return a file of parameters in the form of QGroundControl: name, value and MAV_PARAM_TYPE."""
    lines = [
        *(f"# {line}" for line in head),
        "#",
        "# Vehicle-Id Component-Id Name Value Type",
        *(f"1\t1\t{name}\t{value!r}\t{kind}" for name, value, kind in found),
    ]
    return "\n".join(lines) + "\n"


def _thermal(
    drift: Drift, instance: int, device_id: int | None
) -> list[tuple[str, float | int, int]]:
    zeros = [(f"TC_A{instance}_X0_{axis}", 0.0) for axis in range(3)]
    slopes = zip(_slopes(instance), drift.slopes.ravel().tolist(), strict=True)
    limits = zip(_limits(instance), (drift.reference, drift.low, drift.high), strict=True)
    sensor = [] if device_id is None else [(f"TC_A{instance}_ID", device_id, INT32)]
    return [
        ("TC_A_ENABLE", 1, INT32),
        *sensor,
        *((name, value, REAL32) for name, value in (*zeros, *slopes, *limits)),
    ]


def without_id(sensor: str, wish: Wish) -> list[Finding]:
    """Return the finding that the parameter of a sensor's ID was not stated."""
    if wish.device_id is not None:
        return []
    text = f"{sensor} is missing; PX4 will ignore the file"
    return [Finding("no-device-id", "warning", text, "Add --device-id.")]


def _read(path: str, text: str) -> Correction:
    instance = min(int(found["instance"]) for found in _GIVEN.finditer(text))
    numbers = read_named(path, text, _names(instance))
    drift = None
    if any(name in text for name in _slopes(instance)):
        slopes = read_named(path, text, _slopes(instance)).reshape(3, 3)
        drift = Drift(slopes, *read_named(path, text, _limits(instance)).tolist())
    return Correction(np.diag(numbers[3:]), numbers[:3], drift)


PX4 = parameter_target(
    "px4",
    DIAGONAL,
    raw="m/s^2",
    write=_write,
    recognises=lambda text: _GIVEN.search(text) is not None,
    read=_read,
    suffix=".params",
    thermal=True,
    takes=("instance", "device_id"),
)

"""ArduPilot [1]_: ``INS_ACCOFFS_X`` … and ``INS_ACCSCAL_X`` …, in the form of Mission Planner.

corrected = (raw − p(t) + p(CALTEMP) − OFFS) SCAL axis by axis, raw in m/s², so that OFFS = o at the
temperature CALTEMP and SCAL = T_ii. The drift [2]_ is

    p(t) = 1e-6 [ACC1 (t − 35) + ACC2 (t − 35)² + ACC3 (t − 35)³],                          (1)

t in °C and held to TMIN … TMAX.

ArduPilot takes an accelerometer for calibrated where the saved ``INS_ACC_ID`` is that of its
device [3]_.

References
----------
.. [1] ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
.. [2] ArduPilot, ``AP_InertialSensor_tempcal.cpp``, ``correct_sensor``.
.. [3] ArduPilot, ``AP_InertialSensor::accel_calibrated_ok_all``.
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

# What the ground stations accept, offset [m/s²] and scale.
_LIMITS = (3.5, (0.8, 1.2))
_REFERENCE = 35.0  # [°C], t of eq. (1) is counted from it
_UNIT = 1e-6
_INSTANCES = range(1, 4)
_GIVEN = re.compile(r"^(?!#).*\bINS_ACC(?P<instance>[23]?)(?:OFFS|SCAL)_", re.MULTILINE)


def _names(instance: int) -> tuple[str, ...]:
    number = "" if instance == 1 else instance  # the first has none
    return tuple(f"INS_ACC{number}{kind}_{axis}" for kind in ("OFFS", "SCAL") for axis in "XYZ")


def _slopes(instance: int) -> tuple[str, ...]:
    return tuple(f"INS_TCAL{instance}_ACC{power}_{axis}" for power in (1, 2, 3) for axis in "XYZ")


def _limits(instance: int) -> tuple[str, ...]:
    names = tuple(f"INS_TCAL{instance}_{name}" for name in ("TMIN", "TMAX"))
    return (f"INS_ACC{instance}_CALTEMP", *names)


def _write(calibration: Calibration, law: Law, wish: Wish) -> tuple[str, list[Finding]]:
    instance = require_instance(wish, "ardupilot", _INSTANCES)
    names = _names(instance)
    values = diagonal_values(calibration, law, names)
    offset, (low, high) = _LIMITS
    bad = [n for n, v in zip(names[:3], values[:3], strict=True) if abs(v) > offset]
    bad += [n for n, v in zip(names[3:], values[3:], strict=True) if not low <= v <= high]
    findings = []
    if bad:
        text = f"{', '.join(bad)} exceed what ArduPilot accepts"
        action = "Check the unit and the convention."
        findings.append(Finding("beyond-target", "warning", text, action))
    found: list[tuple[str, float | int]] = list(zip(names, values, strict=True))
    sensor = f"INS_ACC{'' if instance == 1 else instance}_ID"
    findings += without_id(sensor, wish)
    if wish.device_id is not None:
        found.insert(0, (sensor, wish.device_id))
    thermal = ""
    if law.drift is not None:
        found += _thermal(law.drift, instance)
        thermal = " - p(t) + p(CALTEMP)"
    head = [*origin(calibration), f"corrected = (raw - OFFS{thermal}) SCAL, in m/s^2"]
    return parm_text(head, found), findings


def parm_text(head: list[str], found: list[tuple[str, float | int]]) -> str:
    """Return a file of parameters in the form of Mission Planner: name and value."""
    lines = [*(f"# {line}" for line in head), *(f"{name},{value!r}" for name, value in found)]
    return "\n".join(lines) + "\n"


def without_id(sensor: str, wish: Wish) -> list[Finding]:
    """Return the finding that the parameter of a sensor's ID was not stated."""
    if wish.device_id is not None:
        return []
    text = f"{sensor} is missing; ArduPilot will ask for a calibration"
    return [Finding("no-device-id", "warning", text, "Add --device-id.")]


def _thermal(drift: Drift, instance: int) -> list[tuple[str, float | int]]:
    """Return the parameters of eq. (1); the offset is that at the drift's own reference."""
    _, about = drift.about(_REFERENCE)
    slopes = (about.slopes / _UNIT).ravel().tolist()
    limits = (drift.reference, drift.low, drift.high)
    return [
        (f"INS_TCAL{instance}_ENABLE", 1),
        *zip(_limits(instance), limits, strict=True),
        *zip(_slopes(instance), slopes, strict=True),
    ]


def _read(path: str, text: str) -> Correction:
    instance = min(int(found["instance"] or 1) for found in _GIVEN.finditer(text))
    numbers = read_named(path, text, _names(instance))
    offset, drift = numbers[:3], None
    if any(name in text for name in _slopes(instance)):
        slopes = read_named(path, text, _slopes(instance)).reshape(3, 3) * _UNIT
        at, low, high = read_named(path, text, _limits(instance)).tolist()
        drift = Drift(slopes, _REFERENCE, low, high)
        offset = offset - drift.offset(at)
    return Correction(np.diag(numbers[3:]), offset, drift)


ARDUPILOT = parameter_target(
    "ardupilot",
    DIAGONAL,
    raw="m/s^2",
    write=_write,
    recognises=lambda text: _GIVEN.search(text) is not None,
    read=_read,
    suffix=".parm",
    thermal=True,
    takes=("instance", "device_id"),
)

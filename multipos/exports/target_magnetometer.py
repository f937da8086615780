"""Magnetometers of PX4, ArduPilot and ROS: hard iron, and the symmetric root of soft iron.

PX4 [1]_, in gauss: corrected = S (raw − OFF), and ArduPilot [2]_, in milligauss and after the turn
of its board: corrected = S (raw + OFS), so that OFF = o and OFS = −o, with

    S = [[SCALE_x, ODIAG_x, ODIAG_y], [·, SCALE_y, ODIAG_z], [·, ·, SCALE_z]],             (1)

which ArduPilot calls DIA and ODI. imu_filter_madgwick [3]_ of ROS, in tesla, corrects hard iron
alone: raw − mag_bias. Both autopilots look a calibration up by the ID of the sensor's device.

References
----------
.. [1] PX4-Autopilot, ``sensor_calibration/Magnetometer.hpp``, ``Correct``, and
   ``Magnetometer.cpp``, ``ParametersUpdate``.
.. [2] ArduPilot, ``AP_Compass_Backend.cpp``, ``correct_field``; limits: ``CompassCalibrator.cpp``,
   ``fit_acceptable``, and ``COMPASS_OFFS_MAX``.
.. [3] github.com/CCNYRoboticsLab/imu_tools, ``imu_filter_ros.cpp``, ``imuMagCallback``.
"""

import re
from collections.abc import Callable

import numpy as np

from multipos.exports import target_ardupilot, target_px4
from multipos.exports.laws import LINEAR, Correction, Law
from multipos.exports.parameters import (
    origin,
    parameter_target,
    read_named,
    require_instance,
    require_writable,
)
from multipos.exports.target import Wish
from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_GAUSS, _MILLIGAUSS, _TESLA = 1e-4, 1e-7, 1.0
_UPPER = ((0, 1), (0, 2), (1, 2))  # of eq. (1), where x, y, z of the off-diagonals stand
_OFFSET, _DIAGONAL, _BESIDE = 1800.0, (0.2, 5.0), 1.0  # that ArduPilot accepts
_PX4_GIVEN = re.compile(r"^(?!#).*\bCAL_MAG(?P<instance>\d)_[XYZ]", re.MULTILINE)
_ARDUPILOT_GIVEN = re.compile(
    r"^(?!#).*\bCOMPASS_(?:OFS|DIA|ODI)(?P<instance>[23]?)_", re.MULTILINE
)
_BIAS = tuple(f"mag_bias_{axis}" for axis in "xyz")


def _px4_names(instance: int) -> tuple[str, ...]:
    kinds = ("OFF", "SCALE", "ODIAG")
    return tuple(f"CAL_MAG{instance}_{axis}{kind}" for kind in kinds for axis in "XYZ")


def _ardupilot_names(instance: int) -> tuple[str, ...]:
    number = "" if instance == 1 else instance  # the first has none
    kinds = ("OFS", "DIA", "ODI")
    return tuple(f"COMPASS_{kind}{number}_{axis}" for kind in kinds for axis in "XYZ")


def _values(
    calibration: Calibration, law: Law, names: tuple[str, ...], sign: float
) -> list[tuple[str, float]]:
    """Return offset, diagonal and off-diagonals by name, that single precision is to hold."""
    beside = [law.matrix[place] for place in _UPPER]
    values = np.concatenate([sign * law.offset, np.diag(law.matrix), beside]).tolist()
    for name, value in zip(names, values, strict=True):
        if value or "ODI" not in name:
            require_writable(calibration, name, value, np.finfo(np.float32))
    return list(zip(names, values, strict=True))


def _correction(numbers: Array, sign: float) -> Correction:
    matrix = np.diag(numbers[3:6])
    for (i, j), value in zip(_UPPER, numbers[6:].tolist(), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return Correction(matrix, sign * numbers[:3])


def _turned(calibration: Calibration, law: Law) -> list[str]:
    """Return what is said of the turn that a symmetric matrix leaves open."""
    if np.allclose(law.turn, np.eye(3)):
        return []
    return ["the matrix is the symmetric root: orientations were unknown, and so is a turn"]


def _write_px4(calibration: Calibration, law: Law, wish: Wish) -> tuple[str, list[Finding]]:
    instance = require_instance(wish, "px4", range(4))
    sensor = f"CAL_MAG{instance}_ID"
    found: list[tuple[str, float | int, int]] = [
        (*pair, target_px4.REAL32) for pair in _values(calibration, law, _px4_names(instance), 1.0)
    ]
    if wish.device_id is not None:
        found.insert(0, (sensor, wish.device_id, target_px4.INT32))
    equation = "corrected = S (raw - OFF), in gauss, S = SCALE on its diagonal, ODIAG off it"
    head = [*origin(calibration), *_turned(calibration, law), equation]
    return target_px4.params_text(head, found), target_px4.without_id(sensor, wish)


def _write_ardupilot(calibration: Calibration, law: Law, wish: Wish) -> tuple[str, list[Finding]]:
    instance = require_instance(wish, "ardupilot", range(1, 4))
    found: list[tuple[str, float | int]] = [
        *_values(calibration, law, _ardupilot_names(instance), -1.0)
    ]
    low, high = _DIAGONAL
    bad = [name for name, value in found[:3] if abs(value) > _OFFSET]
    bad += [name for name, value in found[3:6] if not low <= value <= high]
    bad += [name for name, value in found[6:] if abs(value) >= _BESIDE]
    said = []
    if bad:
        text = f"{', '.join(bad)} exceed what ArduPilot accepts"
        action = "Check the unit and the axes."
        said.append(Finding("beyond-target", "warning", text, action))
    sensor = f"COMPASS_DEV_ID{'' if instance == 1 else instance}"
    said += target_ardupilot.without_id(sensor, wish)
    if wish.device_id is not None:
        found.insert(0, (sensor, wish.device_id))
    equation = "corrected = S (raw + OFS), in milligauss, S = DIA on its diagonal, ODI off it"
    head = [*origin(calibration), *_turned(calibration, law), equation]
    return target_ardupilot.parm_text(head, found), said


def _write_ros(calibration: Calibration, law: Law, _: Wish) -> tuple[str, list[Finding]]:
    for name, value in zip(_BIAS, law.offset.tolist(), strict=True):
        require_writable(calibration, name, value, np.finfo(np.float64))
    lines = [
        *(f"# {line}" for line in origin(calibration)),
        "# imu_filter_madgwick: corrected = raw - mag_bias, in tesla; soft iron is not corrected",
        "/**:",
        "  ros__parameters:",
        *(f"    {name}: {v!r}" for name, v in zip(_BIAS, law.offset.tolist(), strict=True)),
    ]
    return "\n".join(lines) + "\n", []


def _reader(
    given: "re.Pattern[str]", names: Callable[[int], tuple[str, ...]], sign: float
) -> Callable[[str, str], Correction]:
    """Return what reads a file of an autopilot."""

    def read(path: str, text: str) -> Correction:
        instance = min(int(found["instance"] or 1) for found in given.finditer(text))
        return _correction(read_named(path, text, names(instance)), sign)

    return read


def _read_ros(path: str, text: str) -> Correction:
    return Correction(np.eye(3), read_named(path, text.replace(":", " "), _BIAS))


PX4_MAGNETOMETER = parameter_target(
    "px4",
    LINEAR,
    raw="m/s^2",
    write=_write_px4,
    recognises=lambda text: _PX4_GIVEN.search(text) is not None,
    read=_reader(_PX4_GIVEN, _px4_names, 1.0),
    suffix=".params",
    takes=("instance", "device_id"),
    tesla=_GAUSS,
)
ARDUPILOT_MAGNETOMETER = parameter_target(
    "ardupilot",
    LINEAR,
    raw="m/s^2",
    write=_write_ardupilot,
    recognises=lambda text: _ARDUPILOT_GIVEN.search(text) is not None,
    read=_reader(_ARDUPILOT_GIVEN, _ardupilot_names, -1.0),
    suffix=".parm",
    takes=("instance", "device_id"),
    tesla=_MILLIGAUSS,
)
ROS_MAGNETOMETER = parameter_target(
    "ros",
    LINEAR,
    raw="m/s^2",
    write=_write_ros,
    recognises=lambda text: all(re.search(rf"^\s*{name}:", text, re.MULTILINE) for name in _BIAS),
    read=_read_ros,
    suffix=".yaml",
    tesla=_TESLA,
    offset_alone=True,
)

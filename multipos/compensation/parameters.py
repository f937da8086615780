"""Parameter files: the ROS package imu_calib, PX4 and ArduPilot.

- ``ros-imu-calib`` [1]_: YAML with ``SM`` (9, by rows) and ``bias`` (3); corrected = SM raw − bias,
  so that SM = T and bias = T o.
- ``px4`` [2]_: ``CAL_ACC0_XOFF`` … and ``CAL_ACC0_XSCALE`` …, corrected = (raw − OFF) SCALE axis
  by axis, so that OFF = o and SCALE = T_ii.
- ``ardupilot`` [3]_: ``INS_ACCOFFS_X`` … and ``INS_ACCSCAL_X`` …, the same law.

References
----------
.. [1] github.com/dpkoch/imu_calib, ``AccelCalib::applyCalib``.
.. [2] PX4-Autopilot, ``sensor_calibration/Accelerometer.hpp``, ``Correct``.
.. [3] ArduPilot, ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
"""

import re
from itertools import pairwise
from typing import Any

import numpy as np

from multipos.compensation.laws import DIAGONAL, LINEAR, Law, in_metres, reduce_to
from multipos.errors import MultiposError
from multipos.files.characters import visible
from multipos.files.tables import to_json
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_REAL32 = 9  # MAV_PARAM_TYPE
PX4 = tuple(f"CAL_ACC0_{axis}{kind}" for kind in ("OFF", "SCALE") for axis in "XYZ")
ARDUPILOT = tuple(f"INS_ACC{kind}_{axis}" for kind in ("OFFS", "SCAL") for axis in "XYZ")
# What the ground stations accept, offset [m/s²] and scale.
_ARDUPILOT_LIMITS = (3.5, (0.8, 1.2))


def write_ros(calibration: Calibration, *, allow_lossy: bool) -> tuple[str, Law, list[str]]:
    """Return the YAML of imu_calib, its law in the unit of the readings, and notes."""
    law = reduce_to(calibration, LINEAR, "ros-imu-calib", allow_lossy=allow_lossy)
    matrix, bias = law.matrix, law.matrix @ law.offset
    for key, array in (("SM", matrix), ("bias", bias)):
        for value in array.ravel().tolist():
            _require_writable(calibration, key, value, np.finfo(np.float64))
    lines = [
        *(f"# {line}" for line in _origin(calibration)),
        f"# corrected = SM raw - bias in m/s^2, raw in {visible(_unit(calibration))}",
        f"SM: {matrix.ravel().tolist()}",
        f"bias: {bias.tolist()}",
    ]
    return "\n".join(lines) + "\n", law, []


def write_px4(calibration: Calibration, *, allow_lossy: bool) -> tuple[str, Law, list[str]]:
    """Return PX4 parameters in the form of QGroundControl, their law, and notes."""
    law, values = _diagonal(calibration, "px4", allow_lossy=allow_lossy)
    lines = [
        *(f"# {line}" for line in _origin(calibration)),
        "# corrected = (raw - OFF) SCALE, in m/s^2",
        "#",
        "# Vehicle-Id Component-Id Name Value Type",
        *(f"1\t1\t{n}\t{v!r}\t{_REAL32}" for n, v in zip(PX4, values, strict=True)),
    ]
    return "\n".join(lines) + "\n", law, []


def write_ardupilot(calibration: Calibration, *, allow_lossy: bool) -> tuple[str, Law, list[str]]:
    """Return ArduPilot parameters in the form of Mission Planner, their law, and notes."""
    law, values = _diagonal(calibration, "ardupilot", allow_lossy=allow_lossy)
    offset, (low, high) = _ARDUPILOT_LIMITS
    bad = [n for n, v in zip(ARDUPILOT[:3], values[:3], strict=True) if abs(v) > offset]
    bad += [n for n, v in zip(ARDUPILOT[3:], values[3:], strict=True) if not low <= v <= high]
    notes = [f"{', '.join(bad)} beyond what ArduPilot accepts"] if bad else []
    lines = [
        *(f"# {line}" for line in _origin(calibration)),
        "# corrected = (raw - OFFS) SCAL, in m/s^2",
        *(f"{n},{v!r}" for n, v in zip(ARDUPILOT, values, strict=True)),
    ]
    return "\n".join(lines) + "\n", law, notes


def read_ros(path: str, text: str) -> tuple[Array, Array]:
    """Return T and o from the YAML of imu_calib, as its law uses them."""
    found = {}
    for key, count in (("SM", 9), ("bias", 3)):
        block = re.search(rf"^{key}:\s*\[([^\]]*)\]", text, re.MULTILINE)
        cells = re.findall(r"[^\s,]+", block[1]) if block else []
        found[key] = _numbers(path, key, cells, count)
    matrix = found["SM"].reshape(3, 3)
    try:
        return matrix, np.asarray(np.linalg.solve(matrix, found["bias"]))
    except np.linalg.LinAlgError:
        raise MultiposError(f"{path}: SM has no inverse; export again.") from None


def read_parameters(path: str, text: str, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Return T and o from the parameters of an autopilot, in m/s²."""
    values: dict[str, str] = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        cells = re.split(r"[\s,]+", line.strip())
        for name, value in pairwise(cells):
            if name not in names:
                continue
            if values.get(name, value) != value:
                raise MultiposError(
                    f"{path}: parameter {name} is given twice, as {values[name]!r:.40} and "
                    f"{value!r:.40}; leave one."
                )
            values[name] = value
    missing = [name for name in names if name not in values]
    if missing:
        raise MultiposError(f"{path}: parameter {missing[0]} is missing; export again.")
    numbers = _numbers(path, names[0], [values[name] for name in names], 6)
    return np.diag(numbers[3:]), numbers[:3]


def _diagonal(
    calibration: Calibration, target: str, *, allow_lossy: bool
) -> tuple[Law, list[float]]:
    metres = in_metres(calibration, target)
    law = reduce_to(calibration, DIAGONAL, target, allow_lossy=allow_lossy)
    names = PX4 if target == "px4" else ARDUPILOT
    scale = (np.diag(law.matrix) / metres).tolist()
    values = [*(law.offset * metres).tolist(), *scale]
    for name, value in zip(names, values, strict=True):
        _require_writable(calibration, name, value, np.finfo(np.float32))
    return law, values


def _require_writable(
    calibration: Calibration, name: str, value: float, precision: np.finfo[Any]
) -> None:
    """Refuse, by name, a number that the consumer's precision cannot hold, or a scale it loses."""
    least = float(precision.tiny) if "SCAL" in name else 0.0
    if not least <= abs(value) <= float(precision.max):
        raise MultiposError(
            f"{name} would be {value:.3g}, which the consumer cannot hold; fit readings in a unit "
            f"nearer to their size than '{calibration.model.unit}'."
        )


def _unit(calibration: Calibration) -> str:
    unit = calibration.model.unit
    return "the unit of the readings" if unit == "reading" else unit


def _origin(calibration: Calibration) -> list[str]:
    """Return what a file is of, as lines of comments: each stays on its line."""
    source = to_json(calibration.readings.source or "readings").strip()
    lines = [
        f"Accelerometer calibration of {source}, model {calibration.model.text}",
        f"made {calibration.created} by multipos {calibration.version}",
    ]
    if calibration.gravity is None:
        lines.append("one g of the calibration, the local gravity, is taken as 9.80665 m/s^2")
    return [visible(line) for line in lines]


def _numbers(path: str, key: str, cells: list[str], count: int) -> Array:
    try:
        values = np.array([float(cell) for cell in cells])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise MultiposError(f"{path}: {key} needs {count} numbers; export again.")
    return values

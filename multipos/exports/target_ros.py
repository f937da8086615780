"""The ROS package imu_calib [1]_: YAML with ``SM`` (9, by rows) and ``bias`` (3).

corrected = SM raw − bias, in the unit of the readings, so that SM = T and bias = T o.

References
----------
.. [1] github.com/dpkoch/imu_calib, ``AccelCalib::applyCalib``.
"""

import re

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.laws import LINEAR, Correction, Law
from multipos.exports.parameters import (
    origin,
    parameter_target,
    read_numbers,
    require_writable,
)
from multipos.exports.target import Wish
from multipos.files.spelling import visible
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration


def _write(calibration: Calibration, law: Law, _: Wish) -> tuple[str, list[Finding]]:
    matrix, bias = law.matrix, law.matrix @ law.offset
    for key, array in (("SM", matrix), ("bias", bias)):
        for value in array.ravel().tolist():
            require_writable(calibration, key, value, np.finfo(np.float64))
    unit = calibration.model.unit
    raw = "the unit of the readings" if unit == "reading" else unit
    lines = [
        *(f"# {line}" for line in origin(calibration)),
        f"# corrected = SM raw - bias in m/s^2, raw in {visible(raw)}",
        f"SM: {matrix.ravel().tolist()}",
        f"bias: {bias.tolist()}",
    ]
    return "\n".join(lines) + "\n", []


def _recognises(text: str) -> bool:
    return all(re.search(rf"^{key}:", text, re.MULTILINE) for key in ("SM", "bias"))


def _read(path: str, text: str) -> Correction:
    """Return T and o from the YAML of imu_calib, as its law uses them."""
    found = {}
    for key, count in (("SM", 9), ("bias", 3)):
        block = re.search(rf"^{key}:\s*\[([^\]]*)\]", text, re.MULTILINE)
        cells = re.findall(r"[^\s,]+", block[1]) if block else []
        found[key] = read_numbers(path, key, cells, count)
    matrix = found["SM"].reshape(3, 3)
    try:
        return Correction(matrix, np.asarray(np.linalg.solve(matrix, found["bias"])))
    except np.linalg.LinAlgError:
        raise MultiposError(f"{path}: SM has no inverse; export again.") from None


ROS = parameter_target(
    "ros-imu-calib",
    LINEAR,
    raw="readings",
    write=_write,
    recognises=_recognises,
    read=_read,
    suffix=".yaml",
)

"""The ROS package imu_calib [1]_: YAML with ``SM`` (9, by rows) and ``bias`` (3).

corrected = SM raw − bias, in the unit of the readings, so that SM = T and bias = T o.

References
----------
.. [1] github.com/dpkoch/imu_calib, ``AccelCalib::applyCalib``.

The noise of an accelerometer as other programs ask for it: Kalibr's imu.yaml and ROS's Imu.

With white noise N [m/s²/√Hz] and random walk K [m/s³/√Hz] of `multipos.stability`, the largest of
the outputs, Kalibr takes [1]_

    accelerometer_noise_density = N,      accelerometer_random_walk = K,                    (1)

and a message of ROS at the sample rate f [Hz] has the variances

    linear_acceleration_covariance = diag(N_i² f),                                          (2)

with −1 as the first element of the covariances of what an accelerometer does not measure [2]_.

References
----------
.. [1] github.com/ethz-asl/kalibr, wiki, *IMU Noise Model*.
.. [2] ROS, ``sensor_msgs/Imu``.
"""

import re

import numpy as np

from multipos.bias_stability.stability_result import Stability
from multipos.errors import MultiposError, UsageError
from multipos.exports.laws import LINEAR, Correction, Law
from multipos.exports.parameters import (
    origin,
    parameter_target,
    read_numbers,
    require_writable,
)
from multipos.exports.target import Exported, Wish
from multipos.exports.target_kalibr import white_noise
from multipos.files.spelling import visible
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration
from multipos.units import MICRO_G, STANDARD_GRAVITY

NOISE_TARGETS = ("kalibr", "ros")


def write_noise(stability: Stability, to: str) -> Exported:
    """Return the noise parameters of a static record for Kalibr or ROS.

    Raises
    ------
    UsageError
        Another target.
    MultiposError
        The record is neither in g nor in m/s², or shows no white noise.
    """
    if to not in NOISE_TARGETS:
        raise UsageError(f"noise parameters go --to {' or '.join(NOISE_TARGETS)}, got '{to}'.")
    if stability.unit not in MICRO_G:
        raise MultiposError(
            f"the stability is in '{stability.unit}', but {to} takes m/s^2; give stability the "
            "calibration with --calibration."
        )
    metres = MICRO_G[stability.unit] * 1e-6 * STANDARD_GRAVITY
    white = [metres * each for each in white_noise(stability, stability.outputs)]
    walk = [float(metres * each.random_walk.value) for each in stability.outputs.values()]
    rate = float(stability.sample_rate)
    if to == "kalibr":
        lines = [
            "# of the accelerometer; gyroscopes are not measured in static positions",
            f"accelerometer_noise_density: {max(white)!r}  # m/s^2/sqrt(Hz)",
            f"accelerometer_random_walk: {max(walk)!r}  # m/s^3/sqrt(Hz)",
            f"update_rate: {rate!r}  # Hz",
        ]
        return Exported("kalibr", "\n".join(lines) + "\n")
    if len(white) != 3:
        raise MultiposError(
            f"a message of ROS has three accelerations, but the stability is of {len(white)} "
            "outputs; give stability all three."
        )
    diagonal = [0.0] * 9
    diagonal[::4] = [value**2 * rate for value in white]
    unknown = [-1.0, *[0.0] * 8]
    lines = [
        f"# sensor_msgs/Imu, of one message at {rate:g} Hz; -1: not measured",
        f"linear_acceleration_covariance: {diagonal}  # (m/s^2)^2",
        f"angular_velocity_covariance: {unknown}",
        f"orientation_covariance: {unknown}",
    ]
    return Exported("ros", "\n".join(lines) + "\n")


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

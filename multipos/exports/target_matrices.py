"""Consumers of a matrix and an offset: Kalibr, ROS and the Python package imucal.

`write_noise` writes the noise of a static record for Kalibr or ROS; `densities` returns white noise
and random walk of it.

Kalibr [1]_: YAML of an IMU, with its scale-misalignment matrix and noise densities.
raw = M C a + b in m/s², with the specific force a in case axes. Kalibr takes the axes of its sensor
from the accelerometer, so that its M is lower triangular and its readers take six numbers of it:

    K = T⁻¹ = M C,    M lower triangular, C a rotation,                                    (1)

with a diagonal of M above zero, or below it where the three outputs are left-handed; b = o. Kalibr
lets b move with time, so that its own files have none: ``bias`` and ``C_i_case``, named as Kalibr
names ``C_gyro_i``, are there for those who read the file. A consumer finds C a = M⁻¹ (raw − b).

The noise densities are those of `multipos stability`: white noise N [m/s²/√Hz] with σ(τ) = N/√τ
and random walk K [m/s³/√Hz] with σ(τ) = K √(τ/3), the largest of the three axes, since Kalibr has
one for all. By themselves, as other programs ask for them, they are [2]_

    accelerometer_noise_density = N,      accelerometer_random_walk = K,                    (2)

and a message of ROS at the sample rate f [Hz] has the variances

    linear_acceleration_covariance = diag(N_i² f),                                          (3)

with −1 as the first element of the covariances of what an accelerometer does not measure [3]_.

The ROS package imu_calib [4]_: YAML with ``SM`` (9, by rows) and ``bias`` (3). It takes
corrected = SM raw − bias, in the unit of the readings, so that SM = T and bias = T o. Of a
magnetometer imu_filter_madgwick [5]_ of ROS, in tesla, corrects hard iron alone: raw − mag_bias.

The Python package imucal [6]_: JSON of a ``FerrarisCalibrationInfo``. It takes
corrected = R_a⁻¹ K_a⁻¹ (raw − b_a), in m/s² from the unit of the readings, so that K_a R_a = T⁻¹
and b_a = o. K_a is diagonal, and the rows of R_a are of unit length. The gyroscope is not
calibrated here: its matrices leave it as it is, and its units stay open.

References
----------
.. [1] ethz-asl/kalibr, ``IccScaledMisalignedImu`` and the page "IMU Noise Model".
.. [2] github.com/ethz-asl/kalibr, wiki, *IMU Noise Model*.
.. [3] ROS, ``sensor_msgs/Imu``.
.. [4] github.com/dpkoch/imu_calib, ``AccelCalib::applyCalib``.
.. [5] github.com/CCNYRoboticsLab/imu_tools, ``imu_filter_ros.cpp``, ``imuMagCallback``.
.. [6] mad-lab-fau/imucal, ``FerrarisCalibrationInfo._calibrate_acc``, and
   ``CalibrationInfo.from_json_file``, format 2.0.0.
"""

from collections.abc import Iterable

import numpy as np

from multipos.bias_stability.stability_result import Stability
from multipos.errors import MultiposError, UsageError
from multipos.exports import parameters
from multipos.exports.laws import LINEAR, Correction, in_metres
from multipos.exports.target import Exported, Wish
from multipos.files.spelling import visible
from multipos.files.trees import to_json
from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import rotation_vector
from multipos.sensor.calibration import Calibration
from multipos.units import MICRO_G, STANDARD_GRAVITY

_NO_NOISE = Finding(
    "no-noise-density",
    "warning",
    "the file lacks the noise densities that Kalibr needs",
    "Add the result of multipos stability with --stability.",
)


def _write_kalibr(calibration: Calibration, law: Correction, wish: Wish) -> parameters.Written:
    response, turn = _in_own_axes(np.asarray(np.linalg.inv(law.matrix), dtype=np.float64))
    for key, array in (("M", response), ("bias", law.offset)):
        parameters.require_writable(calibration, key, array, np.finfo(np.float64))
    findings = []
    turned: list[str] = []
    if not np.array_equal(turn, np.eye(3)):
        angle = np.degrees(np.linalg.norm(rotation_vector(turn)))
        text = f"M is in accelerometer axes; C_i_case turns case axes into them, by {angle:.2g}°"
        action = "Apply its transpose to forces that are needed in case axes."
        findings.append(Finding("full-matrix", "note", text, action))
        turned = ["    C_i_case:", *(f"    - {row}" for row in turn.tolist())]
    noise: list[str] = []
    if wish.stability is None:
        findings.append(_NO_NOISE)
    else:
        found = _noise_lines(*densities(calibration, wish.stability), wish.stability)
        noise = [f"  {line}" for line in found]
    lines = [
        *(f"# {line}" for line in parameters.origin(calibration)),
        f"# raw = M {'C_i_case ' * bool(turned)}a + bias in m/s^2; Kalibr has no constant bias",
        "imu0:",
        "  model: scale-misalignment",
        "  accelerometers:",
        "    M:",
        *(f"    - {row}" for row in response.tolist()),
        *turned,
        f"    bias: {law.offset.tolist()}",
        *noise,
    ]
    return "\n".join(lines) + "\n", findings


def _noise_lines(white: float, walk: float, stability: Stability) -> list[str]:
    """Return eq. (2) and the sample rate as Kalibr names them."""
    return [
        f"accelerometer_noise_density: {white!r}  # m/s^2/sqrt(Hz)",
        f"accelerometer_random_walk: {walk!r}  # m/s^3/sqrt(Hz)",
        f"update_rate: {float(stability.sample_rate)!r}  # Hz",
    ]


def _in_own_axes(response: Array) -> tuple[Array, Array]:
    """Return M and C of eq. (1)."""
    Q, R = np.linalg.qr(response.T)
    sign = np.copysign(1.0, np.diag(R)) * np.copysign(1.0, np.linalg.det(response))
    return np.tril(R.T * sign), Q.T * sign[:, None]


def densities(calibration: Calibration, stability: Stability) -> tuple[float, float]:
    """Return white noise [m/s²/√Hz] and random walk [m/s³/√Hz], the largest of the outputs.

    Parameters
    ----------
    calibration : Calibration
    stability : Stability
        Of its outputs, or of compensated force in g.

    Raises
    ------
    MultiposError
        It is of other outputs, or of another unit.
    """
    forces = [name for name in ("f_x", "f_y", "f_z") if name in stability.outputs]
    names = forces or list(calibration.outputs)
    missing = [name for name in names if name not in stability.outputs]
    if missing:
        raise MultiposError(
            f"the stability is of {', '.join(stability.outputs)}, but this calibration has "
            f"'{missing[0]}'; give stability the same outputs, or CAL.json with --calibration."
        )
    if stability.unit in MICRO_G:
        metres = MICRO_G[stability.unit] * 1e-6 * STANDARD_GRAVITY
    elif not forces and stability.unit == calibration.model.unit:
        metres = in_metres(calibration, "kalibr")
    else:
        raise MultiposError(
            f"the stability is in '{stability.unit}', but Kalibr takes m/s^2; give stability "
            "CAL.json with --calibration."
        )
    white, walk = _noise(stability, names, metres)
    return max(white), max(walk)


def _noise(
    stability: Stability, names: Iterable[str], metres: float
) -> tuple[list[float], list[float]]:
    """Return white noise and random walk of outputs, `metres` of whose unit are one m/s².

    Raises
    ------
    MultiposError
        Noise of another kind hides that of an output: a density of zero is none.
    """
    outputs = [(name, stability.outputs[name]) for name in names]
    for name, each in outputs:
        if not each.white_noise.value > 0.0:
            raise MultiposError(
                f"slow noise hides the white noise of '{name}', and a density of zero is none; "
                "record the sensor at rest, where nothing moves it."
            )
    white = [float(metres * each.white_noise.value) for _, each in outputs]
    return white, [float(metres * each.random_walk.value) for _, each in outputs]


KALIBR = parameters.parameter_target(
    "kalibr", ".yaml", parameters.Form(LINEAR, _write_kalibr), takes=("stability",)
)


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
    white, walk = _noise(stability, stability.outputs, metres)
    if to == "kalibr":
        head = "# of the accelerometer; gyroscopes are not measured in static positions"
        lines = [head, *_noise_lines(max(white), max(walk), stability)]
        return Exported("kalibr", "\n".join(lines) + "\n")
    if len(white) != 3:
        raise MultiposError(
            f"a message of ROS has three accelerations, but the stability is of {len(white)} "
            "outputs; give stability all three."
        )
    rate = float(stability.sample_rate)
    diagonal = np.diag([value**2 * rate for value in white]).ravel().tolist()
    unknown = [-1.0, *[0.0] * 8]
    lines = [
        f"# sensor_msgs/Imu, of one message at {rate:g} Hz; -1: not measured",
        f"linear_acceleration_covariance: {diagonal}  # (m/s^2)^2",
        f"angular_velocity_covariance: {unknown}",
        f"orientation_covariance: {unknown}",
    ]
    return Exported("ros", "\n".join(lines) + "\n")


def _write_imu_calib(calibration: Calibration, law: Correction, _: Wish) -> parameters.Written:
    matrix, bias = law.matrix, law.matrix @ law.offset
    for key, array in (("SM", matrix), ("bias", bias)):
        parameters.require_writable(calibration, key, array, np.finfo(np.float64))
    unit = calibration.model.unit
    raw = "the unit of the readings" if unit == "reading" else unit
    lines = [
        *(f"# {line}" for line in parameters.origin(calibration)),
        f"# corrected = SM raw - bias in m/s^2, raw in {visible(raw)}",
        f"SM: {matrix.ravel().tolist()}",
        f"bias: {bias.tolist()}",
    ]
    return "\n".join(lines) + "\n", []


ROS = parameters.parameter_target(
    "ros-imu-calib", ".yaml", parameters.Form(LINEAR, _write_imu_calib, raw="readings")
)


_FORMAT = "2.0.0"
_RAW = "a.u."  # how imucal calls a unit of its own


def _write_imucal(calibration: Calibration, law: Correction, _: Wish) -> parameters.Written:
    response = np.linalg.inv(law.matrix)
    scale = np.linalg.norm(response, axis=1)
    found = {
        "K_a": np.diag(scale),
        "R_a": response / scale[:, None],
        "b_a": law.offset,
    }
    for key, array in found.items():
        parameters.require_writable(calibration, key, array, np.finfo(np.float64))
    unit = calibration.model.unit
    nothing = np.zeros(3)
    content = {
        "acc_unit": "m/s^2",
        "gyr_unit": None,
        "from_acc_unit": _RAW if unit == "reading" else visible(unit),
        "from_gyr_unit": None,
        "comment": "; ".join(parameters.origin(calibration)),
        **found,
        "K_g": np.eye(3),
        "R_g": np.eye(3),
        "K_ga": np.zeros((3, 3)),
        "b_g": nothing,
        "cal_type": "Ferraris",
        "_format_version": _FORMAT,
    }
    text = "the gyroscope part is the identity, as imucal requires one"
    return to_json(content), [Finding("gyroscope-unchanged", "note", text)]


IMUCAL = parameters.parameter_target(
    "imucal", ".json", parameters.Form(LINEAR, _write_imucal, raw="readings")
)


# --- magnetometers of ROS

_MAG_BIAS = tuple(f"mag_bias_{axis}" for axis in "xyz")


def _write_magnetometer(calibration: Calibration, law: Correction, _: Wish) -> parameters.Written:
    for name, value in zip(_MAG_BIAS, law.offset, strict=True):
        parameters.require_writable(calibration, name, value, np.finfo(np.float64))
    lines = [
        *(f"# {line}" for line in parameters.origin(calibration)),
        "# imu_filter_madgwick: corrected = raw - mag_bias, in tesla; soft iron is not corrected",
        "/**:",
        "  ros__parameters:",
        *(f"    {name}: {v!r}" for name, v in zip(_MAG_BIAS, law.offset.tolist(), strict=True)),
    ]
    return "\n".join(lines) + "\n", []


ROS_MAGNETOMETER = parameters.parameter_target(
    "ros",
    ".yaml",
    parameters.Form(LINEAR, _write_magnetometer, tesla=1.0, offset_alone=True),
)

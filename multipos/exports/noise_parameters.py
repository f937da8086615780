"""The noise of an accelerometer as other programs ask for it: Kalibr's imu.yaml and ROS's Imu.

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

from multipos.bias_stability.stability_result import Stability
from multipos.errors import MultiposError, UsageError
from multipos.exports.target import Exported
from multipos.units import MICRO_G, STANDARD_GRAVITY

NOISE_TARGETS = ("kalibr", "ros")


def write_noise(stability: Stability, to: str) -> Exported:
    """Return the noise parameters of a static record for Kalibr or ROS.

    Raises
    ------
    UsageError
        Another target.
    MultiposError
        The record is neither in g nor in m/s².
    """
    if to not in NOISE_TARGETS:
        raise UsageError(f"noise parameters go --to {' or '.join(NOISE_TARGETS)}, got '{to}'.")
    if stability.unit not in MICRO_G:
        raise MultiposError(
            f"the stability is in '{stability.unit}', but {to} takes m/s^2; give stability the "
            "calibration with --calibration."
        )
    metres = MICRO_G[stability.unit] * 1e-6 * STANDARD_GRAVITY
    white = [float(metres * each.white_noise.value) for each in stability.outputs.values()]
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

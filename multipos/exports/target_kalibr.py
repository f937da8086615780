"""Kalibr [1]_: YAML of an IMU, with its scale-misalignment matrix and noise densities.

raw = M C a + b in m/s², with the specific force a in case axes. Kalibr takes the axes of its sensor
from the accelerometer, so that its M is lower triangular and its readers take six numbers of it:

    K = T⁻¹ = M C,    M lower triangular, C a rotation,                                    (1)

with a diagonal of M above zero, or below it where the three outputs are left-handed; b = o. Kalibr
lets b move with time, so that its own files have none: ``bias`` and ``C_i_case``, named as Kalibr
names ``C_gyro_i``, are there for those who read the file. A consumer finds C a = M⁻¹ (raw − b).

The noise densities are those of `multipos stability`: white noise N [m/s²/√Hz] with σ(τ) = N/√τ
and random walk K [m/s³/√Hz] with σ(τ) = K √(τ/3), the largest of the three axes, since Kalibr has
one for all.

References
----------
.. [1] ethz-asl/kalibr, ``IccScaledMisalignedImu`` and the page "IMU Noise Model".
"""

import re
from collections.abc import Iterable

import numpy as np

from multipos.bias_stability.stability_result import Stability
from multipos.errors import MultiposError
from multipos.exports.laws import LINEAR, Correction, Law, in_metres
from multipos.exports.parameters import (
    origin,
    parameter_target,
    read_numbers,
    require_writable,
)
from multipos.exports.target import Wish
from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import rotation_vector
from multipos.sensor.calibration import Calibration
from multipos.units import MICRO_G, STANDARD_GRAVITY

_ROW = r"\[[^\]\n]*\]"
_M = re.compile(rf"^ +M:\s*\n((?:\s*- {_ROW}\s*\n){{3}})", re.MULTILINE)
_C = re.compile(rf"^ +C_i_case:\s*\n((?:\s*- {_ROW}\s*\n){{3}})", re.MULTILINE)
_BIAS = re.compile(rf"^ +bias: ({_ROW})", re.MULTILINE)
_NO_NOISE = Finding(
    "no-noise-density",
    "warning",
    "the file lacks the noise densities that Kalibr needs",
    "Add the result of multipos stability with --stability.",
)


def _write(calibration: Calibration, law: Law, wish: Wish) -> tuple[str, list[Finding]]:
    response, turn = _in_own_axes(np.asarray(np.linalg.inv(law.matrix), dtype=np.float64))
    for key, array in (("M", response), ("bias", law.offset)):
        for value in array.ravel().tolist():
            require_writable(calibration, key, value, np.finfo(np.float64))
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
        white, walk = densities(calibration, wish.stability)
        noise = [
            f"  accelerometer_noise_density: {white!r}  # m/s^2/sqrt(Hz)",
            f"  accelerometer_random_walk: {walk!r}  # m/s^3/sqrt(Hz)",
            f"  update_rate: {float(wish.stability.sample_rate)!r}  # Hz",
        ]
    lines = [
        *(f"# {line}" for line in origin(calibration)),
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
    walk = max(stability.outputs[name].random_walk.value for name in names)
    return float(metres * max(white_noise(stability, names))), float(metres * walk)


def white_noise(stability: Stability, names: Iterable[str]) -> list[float]:
    """Return the white noise of outputs, in the unit of a static record.

    Raises
    ------
    MultiposError
        Noise of another kind hides that of an output: a density of zero is none.
    """
    white = {name: float(stability.outputs[name].white_noise.value) for name in names}
    for name, value in white.items():
        if not value > 0.0:
            raise MultiposError(
                f"slow noise hides the white noise of '{name}', and a density of zero is none; "
                "record the sensor at rest, where nothing moves it."
            )
    return list(white.values())


def _read(path: str, text: str) -> Correction:
    matrix, turn, bias = _M.search(text), _C.search(text), _BIAS.search(text)
    response = _cells(path, "M", matrix[1] if matrix else "", 9).reshape(3, 3)
    if turn is not None:
        response = response @ _cells(path, "C_i_case", turn[1], 9).reshape(3, 3)
    offset = _cells(path, "bias", bias[1] if bias else "", 3)
    try:
        return Correction(np.asarray(np.linalg.inv(response)), offset)
    except np.linalg.LinAlgError:
        raise MultiposError(f"{path}: M has no inverse; export again.") from None


def _cells(path: str, key: str, text: str, count: int) -> Array:
    cells = [cell for row in re.findall(_ROW, text) for cell in re.findall(r"[^\s,\[\]]+", row)]
    return read_numbers(path, key, cells, count)


KALIBR = parameter_target(
    "kalibr",
    LINEAR,
    raw="m/s^2",
    write=_write,
    recognises=lambda text: re.search(r"^ +accelerometers:", text, re.MULTILINE) is not None,
    read=_read,
    suffix=".yaml",
    takes=("stability",),
)

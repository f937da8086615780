"""INAV [1]_ and Betaflight [2]_: lines for the command line of the flight controller.

INAV finds g = (raw − acczero) accgain/(4096 · 1G) axis by axis, raw in counts of the sensor, whole
numbers all of them, with 1G the counts that its driver takes for a g; so that acczero = o and
accgain = 4096 · 1G · T_ii, T_ii in g per count. 1G is that of the known drivers which is nearest
to the calibrated scale factor, and is said; where a nominal conversion is stated, its
scale, and raw counts from its bias. Rounding leaves up to half a count and 1/8192 g.

Betaflight has an offset alone: ``acc_calibration`` is o, in the axes of the board.

References
----------
.. [1] iNavFlight/inav, ``sensors/acceleration.c``, ``applyAccelerationZero``.
.. [2] betaflight, ``sensors/acceleration.c``, ``applyAccelerationTrims``.
"""

import re

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.laws import DIAGONAL, Correction, scale_per_g
from multipos.exports.parameters import Written, origin, parameter_target, read_named
from multipos.exports.target import Wish
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

_UNITY = 4096  # accgain of a sensor that needs none
_GAINS = range(1, 8193)
_ZEROS = range(-(2**15), 2**15)
# Counts of a g in the drivers: powers of two, and 1365 of a sensor of 24 g.
_ONE_G = (256, 512, 1024, 1365, 2048, 4096, 8192, 16384)
_FEWEST = 100.0  # counts of a g; less is no unit of counts
_NAMES = tuple(f"acc{kind}_{axis}" for kind in ("zero", "gain") for axis in "xyz")
_NOMINAL = re.compile(r"^# 1G = (?P<counts>\d+) counts", re.MULTILINE)


def _nominal(calibration: Calibration) -> int:
    """Return what the driver of the flight controller takes for a g."""
    scale = scale_per_g(calibration)
    if calibration.model.unit not in ("reading", "count", "counts", "LSB") or scale < _FEWEST:
        raise MultiposError(
            f"inav holds raw values in counts of the sensor, but the readings are in "
            f"'{calibration.model.unit}' with a scale factor of {scale:.4g} per g; log counts, "
            "with acczero 0 and accgain 4096, or state --unit count in fit."
        )
    if calibration.nominal is not None:
        return round(abs(calibration.nominal.scale))
    return min(_ONE_G, key=lambda counts: abs(np.log(scale / counts)))


def _write(calibration: Calibration, law: Correction, _: Wish) -> Written:
    counts = _nominal(calibration)
    slopes = np.diag(law.matrix) / STANDARD_GRAVITY
    zeros, gains = np.rint(law.offset), np.rint(_UNITY * counts * slopes)
    values = [*zeros.tolist(), *gains.tolist()]
    for name, value in zip(_NAMES, values, strict=True):
        allowed = _ZEROS if "zero" in name else _GAINS
        if not allowed.start <= value < allowed.stop:
            raise MultiposError(
                f"{name} would be {value:.6g}, but inav takes {allowed.start} to "
                f"{allowed.stop - 1}; an axis that is reversed or far from its nominal scale has "
                "no place there."
            )
    whole = [int(value) for value in values]
    lines = [
        *(f"# {line}" for line in origin(calibration)),
        f"# 1G = {counts} counts, corrected = (raw - acczero) accgain / (4096 1G) in g",
        *(f"set {name} = {value}" for name, value in zip(_NAMES, whole, strict=True)),
        "save",
        f"# Betaflight, offsets alone: set acc_calibration = {','.join(map(str, whole[:3]))},1",
    ]
    if calibration.nominal is not None:
        return "\n".join(lines) + "\n", []
    text = (
        f"1 g of the flight controller is taken as {counts} counts; forces are wrong by the ratio "
        "if its driver uses another number"
    )
    return "\n".join(lines) + "\n", [Finding("assumed-counts", "note", text)]


def _read(path: str, text: str) -> Correction:
    nominal = _NOMINAL.search(text)
    if nominal is None:
        raise MultiposError(f"{path}: the line '# 1G = … counts' is missing; export again.")
    given = re.sub(r"^\s*set\s+(\w+)\s*=", r"\1 ", text, flags=re.MULTILINE)
    numbers = read_named(path, given, _NAMES)
    gain = numbers[3:] / (_UNITY * int(nominal["counts"]))
    return Correction(np.diag(gain * STANDARD_GRAVITY), numbers[:3])


def _rounding(calibration: Calibration) -> float:
    """Return the force [g] that half a step of zero and gain is, with room for its own rounding."""
    largest = float(np.abs(calibration.reference).max())
    return 0.51 / _nominal(calibration) + 0.51 * largest / _UNITY * 1.5


INAV = parameter_target(
    "inav",
    DIAGONAL,
    raw="counts",
    write=_write,
    recognises=lambda text: re.search(r"^\s*set acczero_x", text, re.MULTILINE) is not None,
    read=_read,
    suffix=".txt",
    same=_rounding,
)

"""The Python package imucal [1]_: JSON of a ``FerrarisCalibrationInfo``.

corrected = R_a⁻¹ K_a⁻¹ (raw − b_a), in m/s² from the unit of the readings, so that K_a R_a = T⁻¹
and b_a = o. K_a is diagonal, and the rows of R_a are of unit length. The gyroscope is not
calibrated here: its matrices leave it as it is, and its units stay open.

References
----------
.. [1] mad-lab-fau/imucal, ``FerrarisCalibrationInfo._calibrate_acc``, and
   ``CalibrationInfo.from_json_file``, format 2.0.0.
"""

import json

import numpy as np

from multipos.errors import MultiposError
from multipos.exports.laws import LINEAR, Correction, Law
from multipos.exports.parameters import origin, parameter_target, require_writable
from multipos.exports.target import Wish
from multipos.files.spelling import visible
from multipos.files.trees import to_json
from multipos.finding import Finding
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_FORMAT = "2.0.0"
_RAW = "a.u."  # how imucal calls a unit of its own
_ACCELERATION = {"K_a": (3, 3), "R_a": (3, 3), "b_a": (3,)}


def _write(calibration: Calibration, law: Law, _: Wish) -> tuple[str, list[Finding]]:
    response = np.linalg.inv(law.matrix)
    scale = np.linalg.norm(response, axis=1)
    found = {
        "K_a": np.diag(scale),
        "R_a": response / scale[:, None],
        "b_a": law.offset,
    }
    for key, array in found.items():
        for value in array.ravel().tolist():
            require_writable(calibration, key, value, np.finfo(np.float64))
    unit = calibration.model.unit
    nothing = np.zeros(3)
    content = {
        "acc_unit": "m/s^2",
        "gyr_unit": None,
        "from_acc_unit": _RAW if unit == "reading" else visible(unit),
        "from_gyr_unit": None,
        "comment": "; ".join(origin(calibration)),
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


def _recognises(text: str) -> bool:
    return text.lstrip().startswith("{") and all(f'"{key}"' in text for key in _ACCELERATION)


def _read(path: str, text: str) -> Correction:
    try:
        held = json.loads(text)
    except ValueError:
        raise MultiposError(f"{path}: not valid JSON; export again.") from None
    version = held.get("_format_version")
    if version != _FORMAT:
        raise MultiposError(
            f"{path}: the format of imucal is {version!r}, but '{_FORMAT}' is read here; export "
            "again."
        )
    scale, rotation, bias = (_numbers(path, held, key) for key in _ACCELERATION)
    try:
        return Correction(np.linalg.inv(rotation) @ np.linalg.inv(scale), bias)
    except np.linalg.LinAlgError:
        raise MultiposError(f"{path}: K_a or R_a has no inverse; export again.") from None


def _numbers(path: str, held: dict[str, object], key: str) -> Array:
    try:
        values = np.array(held[key], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        values = np.empty(0)
    if values.shape != _ACCELERATION[key] or not np.isfinite(values).all():
        size = " by ".join(map(str, _ACCELERATION[key]))
        raise MultiposError(f"{path}: {key} needs {size} numbers; export again.")
    return values


IMUCAL = parameter_target(
    "imucal",
    LINEAR,
    raw="readings",
    write=_write,
    recognises=_recognises,
    read=_read,
    suffix=".json",
)

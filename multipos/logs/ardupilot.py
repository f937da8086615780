"""DataFlash, the log of ArduPilot [1]_: the first IMU.

What stands in ``IMU`` has been corrected by (raw − OFFS) SCAL with the parameters that the log
holds; they are undone, unless the board is turned (``AHRS_ORIENTATION``), because then their axes
are others.

References
----------
.. [1] ArduPilot, ``AP_Logger`` and ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.logs.extras import NOTES

_AXES = "XYZ"
_NAMES = ("INS_ACCOFFS_", "INS_ACCSCAL_")
# The fields that are taken, with what stands behind their names in a header.
_UNITS = (
    {"TimeUS": " (us)", "T": ""}
    | {f"Acc{axis}": " (m/s^2)" for axis in _AXES}
    | {f"Gyr{axis}": " (rad/s)" for axis in _AXES}
)


def load_dataflash(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of the first IMU, in the board's axes and without corrections."""
    from pymavlink.DFReader import DFReader_binary

    log = DFReader_binary(os.fspath(path))
    parameters: dict[str, float] = {}
    rows: list[list[float]] = []
    names: Sequence[str] = ()
    while (message := log.recv_match(type=["IMU", "PARM"])) is not None:
        if message.get_type() == "PARM":
            parameters.setdefault(message.Name, float(message.Value))
        elif getattr(message, "I", 0) == 0:
            names = names or [name for name in message.get_fieldnames() if name in _UNITS]
            rows.append([float(getattr(message, name)) for name in names])
    if not rows:
        raise ValueError("no IMU message in it")
    found = dict(zip(names, np.array(rows).T, strict=True))
    said = _undo(found, parameters)
    columns = {f"{name}{_UNITS[name]}": column for name, column in found.items()}
    return {**columns, NOTES: np.array(said)}


def _undo(found: dict[str, Any], parameters: Mapping[str, float]) -> list[str]:
    """Undo corrections in place, and return what is to be said."""
    offset = [parameters.get(f"{_NAMES[0]}{axis}", 0.0) for axis in _AXES]
    scale = [parameters.get(f"{_NAMES[1]}{axis}", 1.0) for axis in _AXES]
    plain = offset == [0.0] * 3 and scale == [1.0] * 3
    said = ["taken from IMU, the first of the log"]
    if plain:
        return said
    if parameters.get("AHRS_ORIENTATION", 0.0) or not all(scale):
        return [f"{said[0]}; INS_ACCOFFS and INS_ACCSCAL were applied to it and are not undone"]
    for axis, o, s in zip(_AXES, offset, scale, strict=True):
        found[f"Acc{axis}"] = found[f"Acc{axis}"] / s + o
    return [f"{said[0]}; INS_ACCOFFS and INS_ACCSCAL, which were applied to it, are undone"]

"""DataFlash, the log of ArduPilot [1]_: the first IMU.

What stands in ``IMU`` has been corrected by (raw − OFFS) SCAL with the parameters that the log
holds; they are undone, unless the board is turned (``AHRS_ORIENTATION``), because then their axes
are others.

ULog, the log of PX4 [2]_: the first accelerometer.

``sensor_accel`` is what the sensor said; ``sensor_combined``, where there is nothing else, has been
corrected with the parameters ``CAL_ACC…`` that the autopilot had, and that is said.

Bags of ROS 1 and ROS 2: the topic with the most messages of ``sensor_msgs/Imu`` [3]_.

References
----------
.. [1] ArduPilot, ``AP_Logger`` and ``AP_InertialSensor_Backend::_rotate_and_correct_accel``.
.. [2] PX4 user guide, "ULog File Format".
.. [3] ROS, ``sensor_msgs/Imu``: linear acceleration in m/s², with gravity.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
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


_TOPICS = {
    "sensor_accel": ("x", "y", "z"),
    "sensor_combined": tuple(f"accelerometer_m_s2[{i}]" for i in range(3)),
}
_CORRECTED = "which PX4 had corrected with its CAL_ACC parameters: reset them, or add the two"


def load_ulog(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of the first accelerometer."""
    from pyulog import ULog

    log = ULog(os.fspath(path), list(_TOPICS))
    for topic, axes in _TOPICS.items():
        found = {each.multi_id: each.data for each in log.data_list if each.name == topic}
        if not found:
            continue
        first = min(found)
        data = found[first]
        note = f"taken from {topic}, instance {first} of {len(found)}"
        columns = {"timestamp (us)": data["timestamp"]}
        columns |= {
            f"accel_{axis} (m/s^2)": data[name] for axis, name in zip("xyz", axes, strict=True)
        }
        if "temperature" in data:
            columns["temperature"] = data["temperature"]
        said = note if topic == "sensor_accel" else f"{note}, {_CORRECTED}"
        return {**columns, NOTES: np.array([said])}
    raise ValueError(f"no {' or '.join(_TOPICS)} in it")


_IMU = "sensor_msgs/msg/Imu"
_FIELDS = {"linear_acceleration": "m/s^2", "angular_velocity": "rad/s"}


def load_bag(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return stamps, accelerations and rates of the topic with the most messages."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Files of older releases of ROS 2 do not say how their messages are made.
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        topics = [each for each in bag.connections if each.msgtype == _IMU]
        if not topics:
            kinds = sorted({each.msgtype for each in bag.connections})
            raise ValueError(f"no topic of {_IMU}, but of {', '.join(kinds) or 'nothing'}")
        taken = max(topics, key=lambda each: each.msgcount)
        messages = bag.messages(connections=[taken])
        rows = [_row(bag.deserialize(raw, topic.msgtype)) for topic, _, raw in messages]
    data = np.array(rows, dtype=np.float64).T
    columns = {"time (s)": data[0] + 1e-9 * data[1]}
    names = [f"{name}.{axis} ({unit})" for name, unit in _FIELDS.items() for axis in "xyz"]
    columns |= dict(zip(names, data[2:], strict=True))
    return {**columns, NOTES: np.array([f"taken from topic {taken.topic}, of {len(topics)}"])}


def _row(message: Any) -> list[float]:
    stamp, row = message.header.stamp, []
    for name in _FIELDS:
        vector = getattr(message, name)
        row += [vector.x, vector.y, vector.z]
    return [stamp.sec, stamp.nanosec, *row]

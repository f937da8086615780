"""Bags of ROS 1 and ROS 2: the topic with the most messages of ``sensor_msgs/Imu`` [1]_.

References
----------
.. [1] ROS, ``sensor_msgs/Imu``: linear acceleration in m/s², with gravity.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from multipos.logs.extras import NOTES

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

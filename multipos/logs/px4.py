"""ULog, the log of PX4 [1]_: the first accelerometer.

``sensor_accel`` is what the sensor said; ``sensor_combined``, where there is nothing else, has been
corrected with the parameters ``CAL_ACC…`` that the autopilot had, and that is said.

References
----------
.. [1] PX4 user guide, "ULog File Format".
"""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.logs.extras import NOTES

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

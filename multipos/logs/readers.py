"""The formats of logs that are not text, one reader each.

`reader_of` returns what reads a file, `formats_read` lists the formats; `load_dataflash`,
`read_dataflash_text`, `load_ulog` and `load_bag` read those of autopilots and robots.

DataFlash, the log of ArduPilot [1]_, as it is or as text: the first IMU.

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
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.files import handed
from multipos.files.handed import unpack
from multipos.files.pipes import GZIP, UTF_16, lines_of, unpack_text
from multipos.logs import array_logs
from multipos.logs.array_logs import loaded
from multipos.logs.extras import NOTES, reader_with_extra

_AXES = "XYZ"
_OF_KINDS = {"Acc": " (m/s^2)", "Gyr": " (rad/s)"}
_NAMES = ("INS_ACCOFFS_", "INS_ACCSCAL_")
_FMT = 4  # fields of FMT before the names: type, length, name, format
_DATAFLASH_TEXT = re.compile(rb"\s*FMT, ?\d+, ?\d+, ?\w+, ?\w+, ?\w+,")
# The fields that are taken, with what stands behind their names in a header.
_UNITS = {"TimeUS": " (us)", "T": ""}
_UNITS |= {f"{kind}{axis}": unit for kind, unit in _OF_KINDS.items() for axis in _AXES}


def load_dataflash(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the columns of the first IMU, in the board's axes and without corrections."""
    from pymavlink.DFReader import DFReader_binary

    log = DFReader_binary(os.fspath(path))
    messages = iter(partial(log.recv_match, type=["IMU", "PARM"]), None)
    return _first_imu((each.get_type(), each.to_dict()) for each in messages)


def read_dataflash_text(path: os.PathLike[str]) -> Mapping[str, Any]:
    """Return the same of the text that ArduPilot's tools make of a log, a message a line."""
    return loaded(path, lambda: _first_imu(_messages(path)))  # type: ignore[no-any-return]


def _messages(path: os.PathLike[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the kind and the fields of the messages that are taken, whose names stand in FMT."""
    names: dict[str, list[str]] = {}
    for line in lines_of(path):
        kind, *cells = map(str.strip, line.split(","))
        if kind == "FMT" and len(cells) > _FMT:
            names[cells[2]] = cells[_FMT:]
        elif kind in ("IMU", "PARM") and len(cells) == len(names.get(kind, ())):
            yield kind, dict(zip(names[kind], cells, strict=True))


def _first_imu(messages: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the columns of the first IMU of messages, each its kind and its fields."""
    parameters: dict[str, float] = {}
    rows: list[list[float]] = []
    names: Sequence[str] = ()
    for kind, message in messages:
        if kind == "PARM":
            parameters.setdefault(message["Name"], float(message["Value"]))
        elif int(message.get("I", 0)) == 0:
            names = names or [name for name in message if name in _UNITS]
            rows.append([float(message[name]) for name in names])
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


LoadColumns = Callable[[os.PathLike[str]], Mapping[str, Any]]


class Reader(NamedTuple):
    """How one kind of file is distinguished from others, and opened.

    One of `columns` and `unpack` is there.
    """

    listed: str  # named to users as read
    suffixes: tuple[str, ...]
    magic: bytes
    columns: LoadColumns | None
    unpack: Callable[[os.PathLike[str]], os.PathLike[str]] | None = None  # to a file of a kind
    member: str = ""  # the ending of a name in a zip archive that tells this kind
    holds: Callable[[bytes], bool] = bool  # of the first bytes

    def takes(self, path: os.PathLike[str], head: bytes) -> bool:
        """Tell by its first bytes whether a file is of this kind."""
        if not head.startswith(self.magic) or not self.holds(head):
            return False
        return not self.member or any(name.endswith(self.member) for name in handed.members(path))


_read_hdf = reader_with_extra("an HDF5 file", "h5py", "hdf5", array_logs.load_hdf)
_read_mat73 = reader_with_extra("a MATLAB 7.3 file", "h5py", "hdf5", array_logs.load_hdf)
_read_parquet = reader_with_extra("a Parquet file", "pyarrow", "parquet", handed.read_arrow)
_read_feather = reader_with_extra("a Feather file", "pyarrow", "parquet", handed.read_arrow)
read_bag: LoadColumns = reader_with_extra("a ROS bag", "rosbags", "ros", load_bag)
_read_ulog = reader_with_extra("a ULog of PX4", "pyulog", "px4", load_ulog)
_read_dataflash = reader_with_extra(
    "a DataFlash log of ArduPilot", "pymavlink", "ardupilot", load_dataflash
)

# The first that takes a file reads it.
READERS = (
    Reader(".gz", (".gz",), GZIP, None, unpack),
    Reader(".xz", (".xz",), handed.XZ, None, unpack),
    Reader(".zst", (".zst",), handed.ZSTD, None, unpack),
    Reader(
        ".json", (".json", ".jsonl", ".ndjson"), b"", array_logs.read_records, holds=handed.is_json
    ),
    Reader("text in UTF-16", (), UTF_16[0], None, unpack_text),
    Reader("text in UTF-16, big-endian", (), UTF_16[1], None, unpack_text),
    Reader(".npy", (".npy",), b"\x93NUMPY", array_logs.read_npy),
    Reader(".xlsx", (".xlsx",), handed.ZIP, None, handed.unpack_workbook, handed.WORKBOOK),
    Reader(".xls", (".xls",), handed.OLE, None, handed.unpack_workbook),
    Reader(".zip of a phone", (".zip",), handed.ZIP, None, array_logs.unpack_phone, ".csv"),
    Reader(".npz", (".npz",), handed.ZIP, array_logs.read_npz),
    Reader(".mat", (".mat",), b"MATLAB 5.0 MAT-file", array_logs.read_mat),
    Reader(".mat 7.3", (".mat",), b"MATLAB 7.3 MAT-file", _read_mat73),
    Reader(".h5", (".h5", ".hdf5"), b"\x89HDF", _read_hdf),
    Reader(".parquet", (".parquet",), b"PAR1", _read_parquet),
    Reader(".feather", (".feather", ".arrow"), b"ARROW1", _read_feather),
    Reader(".ulg", (".ulg",), b"ULog\x01\x12\x35", _read_ulog),
    Reader(".bin of ArduPilot", (".bin",), b"\xa3\x95\x80", _read_dataflash),
    Reader(
        ".log of ArduPilot",
        (),
        b"",
        read_dataflash_text,
        holds=lambda head: _DATAFLASH_TEXT.match(head) is not None,
    ),
    Reader(".bag", (".bag",), b"#ROSBAG V2.0", read_bag),
    Reader(".db3", (".db3",), b"SQLite format 3\0", read_bag),
    Reader(".mcap", (".mcap",), b"\x89MCAP0\r\n", read_bag),
)


def reader_of(path: os.PathLike[str], head: bytes) -> Reader | None:
    """Return what reads a file, by its first bytes or else its suffix; None of a text."""
    by_content = [reader for reader in READERS if reader.takes(path, head)]
    suffix = Path(os.fspath(path)).suffix.lower()
    by_suffix = [reader for reader in READERS if suffix in reader.suffixes]
    return next(iter(by_content or (by_suffix if b"\0" in head else ())), None)


def formats_read() -> str:
    """Return the formats that are read besides text, for messages and help."""
    return ", ".join(reader.listed for reader in READERS)

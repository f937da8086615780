"""Logs as other programs write them, of a session with known truth."""

import struct
import zipfile

import numpy as np

OUTPUTS = ("ax", "ay", "az")


def write_ulog(path, topics):
    """A ULog: magic, version and time; flag bits; a format, a subscription and data a topic.

    `topics` holds (name, instance, columns) with columns of numbers, timestamps in µs first.
    """

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    for name in dict.fromkeys(name for name, _, _ in topics):
        columns = next(columns for each, _, columns in topics if each == name)
        fields = ";".join(_declared(columns))
        parts.append(message("F", f"{name}:{fields};".encode()))
    for number, (name, instance, _) in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
    for number, (_, _, columns) in enumerate(topics):
        for row in zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True):
            data = struct.pack(f"<HQ{len(row) - 1}f", number, int(row[0]), *row[1:])
            parts.append(message("D", data))
    path.write_bytes(b"".join(parts))
    return path


def _declared(columns):
    names = dict.fromkeys(name.partition("[")[0] for name in columns)
    for name in names:
        count = sum(each.partition("[")[0] == name for each in columns)
        kind = "uint64_t" if name == "timestamp" else "float"
        yield f"{kind}[{count}] {name}" if count > 1 else f"{kind} {name}"


def write_dataflash(path, parameters, columns):
    """A DataFlash log: messages that say how messages are made, parameters, and the IMU's."""
    head = b"\xa3\x95"
    kinds = {
        128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89),
        129: ("PARM", "QNf", "TimeUS,Name,Value", 3 + 8 + 16 + 4),
        130: ("IMU", "QBfffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T", 3 + 8 + 1 + 28),
    }
    parts = [
        head + struct.pack("<BBB4s16s64s", 128, kind, size, *map(str.encode, (name, form, names)))
        for kind, (name, form, names, size) in kinds.items()
    ]
    parts += [
        head + struct.pack("<BQ16sf", 129, 1, name.encode(), value)
        for name, value in parameters.items()
    ]
    rows = np.column_stack(list(columns.values())).tolist()
    for time, *numbers in rows:
        for instance in (0, 1):  # the second reads nonsense
            values = numbers if instance == 0 else [9.0] * len(numbers)
            parts.append(head + struct.pack("<BQB7f", 130, int(time), instance, *values))
    path.write_bytes(b"".join(parts))
    return path


def write_dataflash_text(path, parameters, columns):
    """The same as ArduPilot's tools write it: a message a line, the names of its fields in FMT."""
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 129, 31, PARM, QNf, TimeUS,Name,Value",
        "FMT, 130, 40, IMU, QBfffffff, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T",
        "FMT, 131, 40, MODE, QMBB, TimeUS,Mode,ModeNum,Rsn",
        *(f"PARM, 1, {name}, {float(value)!r}" for name, value in parameters.items()),
        "MODE, 1, STABILIZE, 0, 1",
    ]
    for time, *numbers in np.column_stack(list(columns.values())).tolist():
        lines.append(f"IMU, {int(time)}, 0, {', '.join(map(repr, numbers))}")
        lines.append(f"IMU, {int(time)}, 1, {', '.join(['9.0'] * len(numbers))}")
    path.write_text("\n".join(lines) + "\n")
    return path


def imu(store, i, force, ros2):
    """One message of sensor_msgs/Imu, a sample every 10 ms."""
    kinds = store.types
    vector, quaternion = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    stamp = kinds["builtin_interfaces/msg/Time"](sec=5 + i // 100, nanosec=(i % 100) * 10**7)
    header = kinds["std_msgs/msg/Header"](
        stamp=stamp, frame_id="imu", **({} if ros2 else {"seq": i})
    )
    return kinds["sensor_msgs/msg/Imu"](
        header=header,
        orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(x=0.0, y=0.0, z=0.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(**dict(zip("xyz", map(float, force), strict=True))),
        linear_acceleration_covariance=np.zeros(9),
    )


def write_bag(path, force):
    """A bag of ROS 1 (.bag) or 2 (.db3, .mcap in a folder of its own) with two topics of an IMU."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    form, kind = path.suffix, "sensor_msgs/msg/Imu"
    ros2 = form != ".bag"
    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    if ros2:
        plugin = rosbag2.StoragePlugin
        chosen = plugin.SQLITE3 if form == ".db3" else plugin.MCAP
        bag = rosbag2.Writer(path.with_suffix(""), version=9, storage_plugin=chosen)
        path = path.with_suffix("") / path.name
    else:
        bag = rosbag1.Writer(path)
    serialize = store.serialize_cdr if ros2 else store.serialize_ros1
    with bag:
        topics = [bag.add_connection(name, kind, typestore=store) for name in ("/few", "/imu")]
        for i, row in enumerate(force):
            for topic in topics[0 if i < 5 else 1 :]:
                stamp = 5 * 10**9 + i * 10**7
                bag.write(topic, stamp, serialize(imu(store, i, row, ros2), kind))
    return path


def archive(path, files):
    with zipfile.ZipFile(path, "w") as target:
        for name, text in files.items():
            target.writestr(name, text)
    return path


def csv_of(log, names, header):
    rows = zip(*(log[name].tolist() for name in names), strict=True)
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows)]) + "\n"


def write_phyphox(path, log):
    """The archive of phyphox: one experiment, and what phone it was."""
    size = np.linalg.norm([log[name] for name in OUTPUTS], axis=0)
    columns = [f"Acceleration {axis} (m/s^2)" for axis in "xyz"]
    header = ",".join(f'"{n}"' for n in ("Time (s)", *columns, "Absolute acceleration (m/s^2)"))
    text = csv_of(log | {"size": size}, ("time", *OUTPUTS, "size"), header)
    beside = {"meta/device.csv": "a,b\n1,2\n", "meta/time.csv": "a\n1\n"}
    return archive(path, {"Raw Data.csv": text, **beside})


def write_xsens(path, log):
    """The text export of MT Manager: a preamble behind //, tabs, a clock in 100 µs."""
    changed = log | {"n": np.arange(len(log["time"])), "fine": np.round(1e4 * log["time"])}
    rows = zip(*(changed[name].tolist() for name in ("n", "fine", *OUTPUTS)), strict=True)
    head = "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n"
    head += "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\n"
    path.write_text(head + "".join("\t".join(map(repr, row)) + "\t\n" for row in rows))
    return path


def write_actigraph(path, force, header):
    """The raw CSV of ActiLife: ten lines of preamble that tell the rate."""
    made = "Data File Created By ActiGraph GT3X+ ActiLife v6.13.3 Firmware v1.9.2"
    lines = [
        f"------------ {made} date format M/d/yyyy at 100 Hz  Filter Normal -----------",
        "Serial Number: TAS1D48140206",
        "Start Time 16:00:00",
        "Start Date 7/6/2024",
        "Epoch Period (hh:mm:ss) 00:00:00",
        "Download Time 08:37:52",
        "Download Date 7/8/2024",
        "Current Memory Address: 0",
        "Current Battery Voltage: 4.07     Mode = 12",
        "--------------------------------------------------",
    ]
    rows = "\n".join(",".join(map(repr, row)) for row in force.tolist())
    path.write_text("\n".join(lines) + f"\n{header}{rows}\n")
    return path


def write_geneactiv(path, log):
    """A hundred lines of keys, then rows that begin with a date, milliseconds behind a colon."""
    stamps = np.datetime64("2024-05-01T12:00:00.000") + np.round(1e3 * log["time"]).astype(int)
    keys = [f"Key {i},value {i}" for i in range(99)] + ["Measurement Frequency,100.0 Hz"]
    cells = [str(stamp).replace("T", " ").replace(".", ":") for stamp in stamps]
    force = np.column_stack([log[name] for name in OUTPUTS]).tolist()
    rows = [
        f"{cell},{','.join(map(repr, row))},0,0,24.5"
        for cell, row in zip(cells, force, strict=True)
    ]
    path.write_text("\n".join([*keys, *rows]) + "\n")
    return path


def write_flight(path, log, parameters):
    """The log of a flight controller at rest: ULog, or DataFlash."""
    stamps = np.round(1e6 * log["time"])
    if path.suffix == ".ulg":
        axes = dict(zip("xyz", (log[name] for name in OUTPUTS), strict=True))
        return write_ulog(path, [("sensor_accel", 0, {"timestamp": stamps, **axes})])
    gyro = dict.fromkeys(("GyrX", "GyrY", "GyrZ"), 0.0 * stamps)
    force = dict(zip(("AccX", "AccY", "AccZ"), (log[name] for name in OUTPUTS), strict=True))
    return write_dataflash(path, parameters, {"TimeUS": stamps, **gyro, **force, "T": 0.0 * stamps})


def write_workbook(path, log):
    """A sheet with a title above the table."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Board 7, by hand"])
    book.active.append(["t [s]", *(f"{name} [m/s²]" for name in OUTPUTS)])
    for row in zip(*(log[name].tolist() for name in ("time", *OUTPUTS)), strict=True):
        book.active.append(row)
    book.save(path)
    return path

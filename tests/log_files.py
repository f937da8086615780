"""Logs of autopilots, as their formats are published; no library writes them from nothing."""

import struct

import numpy as np


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

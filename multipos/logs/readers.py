"""The formats of logs that are not text, one reader each."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from multipos.files.encodings import UTF_16, unpack_text
from multipos.files.handed import XZ, ZSTD, is_json, read_arrow, unpack
from multipos.files.pipes import GZIP
from multipos.files.workbooks import ZIP, unpack_workbook
from multipos.logs.array_logs import (
    load_hdf,
    read_mat,
    read_npy,
    read_npz,
    read_records,
    unpack_phone,
)
from multipos.logs.extras import reader_with_extra
from multipos.logs.flight_logs import load_bag, load_dataflash, load_ulog

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
        return not self.member or any(name.endswith(self.member) for name in _members(path))


def _members(path: os.PathLike[str]) -> list[str]:
    from zipfile import BadZipFile, ZipFile

    # ValueError: a name in it is no text
    with suppress(BadZipFile, OSError, NotImplementedError, ValueError), ZipFile(path) as archive:
        return archive.namelist()
    return []


_read_hdf = reader_with_extra("an HDF5 file", "h5py", "hdf5", load_hdf)
_read_mat73 = reader_with_extra("a MATLAB 7.3 file", "h5py", "hdf5", load_hdf)
_read_parquet = reader_with_extra("a Parquet file", "pyarrow", "parquet", read_arrow)
_read_feather = reader_with_extra("a Feather file", "pyarrow", "parquet", read_arrow)
read_bag: LoadColumns = reader_with_extra("a ROS bag", "rosbags", "ros", load_bag)
_read_ulog = reader_with_extra("a ULog of PX4", "pyulog", "px4", load_ulog)
_read_dataflash = reader_with_extra(
    "a DataFlash log of ArduPilot", "pymavlink", "ardupilot", load_dataflash
)

# The first that takes a file reads it.
READERS = (
    Reader(".gz", (".gz",), GZIP, None, unpack),
    Reader(".xz", (".xz",), XZ, None, unpack),
    Reader(".zst", (".zst",), ZSTD, None, unpack),
    Reader(".json", (".json", ".jsonl", ".ndjson"), b"", read_records, holds=is_json),
    Reader("text in UTF-16", (), UTF_16[0], None, unpack_text),
    Reader("text in UTF-16, big-endian", (), UTF_16[1], None, unpack_text),
    Reader(".npy", (".npy",), b"\x93NUMPY", read_npy),
    Reader(".xlsx", (".xlsx",), ZIP, None, unpack_workbook, "xl/workbook.xml"),
    Reader(".zip of a phone", (".zip",), ZIP, None, unpack_phone, ".csv"),
    Reader(".npz", (".npz",), ZIP, read_npz),
    Reader(".mat", (".mat",), b"MATLAB 5.0 MAT-file", read_mat),
    Reader(".mat 7.3", (".mat",), b"MATLAB 7.3 MAT-file", _read_mat73),
    Reader(".h5", (".h5", ".hdf5"), b"\x89HDF", _read_hdf),
    Reader(".parquet", (".parquet",), b"PAR1", _read_parquet),
    Reader(".feather", (".feather", ".arrow"), b"ARROW1", _read_feather),
    Reader(".ulg", (".ulg",), b"ULog\x01\x12\x35", _read_ulog),
    Reader(".bin of ArduPilot", (".bin",), b"\xa3\x95\x80", _read_dataflash),
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

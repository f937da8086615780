"""The formats of logs that are not text, one reader each."""

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from multipos.logs.arrays import read_mat, read_npy, read_npz, refuse_hdf


class Reader(NamedTuple):
    """How one kind of file is told from others, and opened."""

    listed: str  # what users are told is read, '' for what is refused
    suffixes: tuple[str, ...]
    magic: bytes
    columns: Callable[[os.PathLike[str]], Mapping[str, Any]]


READERS = (
    Reader(".npy", (".npy",), b"\x93NUMPY", read_npy),
    Reader(".npz", (".npz",), b"PK\x03\x04", read_npz),
    Reader(".mat up to v7", (".mat",), b"MATLAB 5.0 MAT-file", read_mat),
    Reader("", (".h5", ".hdf5"), b"\x89HDF", refuse_hdf),
)


def formats_read() -> str:
    """Return the formats that are read besides text, for messages and help."""
    return ", ".join(reader.listed for reader in READERS if reader.listed)

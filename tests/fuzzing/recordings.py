"""Recordings as other programs pack or write them, damaged as bytes, outside or inside.

Each kind is made once, from one session at six faces, by the writers of `log_files` or of the
library that reads it; where that library is missing, there is no such kind.
"""

import bz2
import functools
import gzip
import io
import json
import lzma
import random
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from . import raw

Log = dict[str, np.ndarray]
OUTPUTS = ("ax", "ay", "az")
PARAMETERS = {"INS_ACCOFFS_X": 0.1, "INS_ACCSCAL_X": 1.01}


def _log() -> Log:
    """Six faces [m/s²] of two seconds each, at 100 Hz."""
    draws = np.random.default_rng(6)
    faces = np.repeat(np.vstack([np.eye(3), -np.eye(3)]), 200, axis=0)
    force = 9.81 * (faces + draws.normal(0.0, 1e-3, faces.shape))
    time = np.arange(len(force)) / 100
    return {"time": time, **dict(zip(OUTPUTS, force.T, strict=True))}


def _text(log: Log) -> bytes:
    rows = zip(*(column.tolist() for column in log.values()), strict=True)
    return "\n".join([",".join(log), *(",".join(map(repr, row)) for row in rows)]).encode()


def _of(name: str) -> Callable[[Path, Log], object]:
    """A writer of `log_files`, found when it is called: it stands beside this package."""

    def write(path: Path, log: Log) -> object:
        import log_files

        force = np.column_stack([log[each] for each in OUTPUTS])
        if name == "write_flight":
            return log_files.write_flight(path, log, PARAMETERS)
        if name == "write_bag":
            return log_files.write_bag(path, force)
        if name == "write_actigraph":
            return log_files.write_actigraph(path, force, "")
        return getattr(log_files, name)(path, log)

    return write


def _frame(method: str) -> Callable[[Path, Log], object]:
    def write(path: Path, log: Log) -> object:
        import pandas as pd

        return getattr(pd.DataFrame(log), method)(path)

    return write


def _hdf(path: Path, log: Log) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.update(log)


def _records(path: Path, log: Log) -> None:
    rows = zip(*(column.tolist() for column in log.values()), strict=True)
    path.write_text(json.dumps([dict(zip(log, row, strict=True)) for row in rows]))


WRITERS: dict[str, Callable[[Path, Log], object]] = {
    "rec.ulg": _of("write_flight"),
    "rec.bin": _of("write_flight"),
    "rec.bag": _of("write_bag"),
    "rec.db3": _of("write_bag"),
    "rec.mcap": _of("write_bag"),
    "rec.xlsx": _of("write_workbook"),
    "rec.zip": _of("write_phyphox"),
    "rec.txt": _of("write_xsens"),
    "actigraph.csv": _of("write_actigraph"),
    "geneactiv.csv": _of("write_geneactiv"),
    "rec.parquet": _frame("to_parquet"),
    "rec.feather": _frame("to_feather"),
    "rec.h5": _hdf,
    "rec.json": _records,
}
PACKED: dict[str, Callable[[bytes], bytes]] = {
    "rec.csv.gz": functools.partial(gzip.compress, mtime=0),
    "rec.csv.xz": lzma.compress,
    "rec.csv.bz2": bz2.compress,
}
TEXTS = (".txt", ".csv", ".json")
NAMES = (*WRITERS, *PACKED)


@functools.cache
def made(name: str) -> bytes:
    """Return the valid file of this name; empty where what writes it is not installed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            written: Any = WRITERS[name](path, _log())
        except ImportError:
            return b""
        return (written if isinstance(written, Path) else path).read_bytes()


def draw(rng: random.Random, name: str) -> bytes:
    """Return a file of this name, damaged outside or inside, or now and then as it was made."""
    damages = raw.DAMAGES if name.endswith(TEXTS) else raw.BINARY_DAMAGES
    if name in PACKED:
        data = PACKED[name](_damaged(rng, _text(_log()), raw.DAMAGES))
    else:
        data = made(name)
        if zipfile.is_zipfile(io.BytesIO(data)) and rng.random() < 0.6:
            return _inside(rng, data)
    return _damaged(rng, data, damages)


def _damaged(rng: random.Random, data: bytes, damages: tuple[raw.Damage, ...]) -> bytes:
    for _ in range(rng.choice((0, 1, 1, 2))):
        data = raw.damage(rng, data, damages)
    return data


def _inside(rng: random.Random, data: bytes) -> bytes:
    """Damage one member of an archive, whose checksum is right then."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(stream, "w") as target:
        names = source.namelist()
        spoilt = rng.choice(names)
        for name in names:
            inside = source.read(name)
            changed = raw.damage(rng, inside) if name == spoilt else inside
            target.writestr(zipfile.ZipInfo(name), changed, zipfile.ZIP_DEFLATED)
    return stream.getvalue()

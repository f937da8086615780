"""Logs as arrays: .npy, .npz and .mat, of every shape and type, then damaged as bytes."""

import io
import random
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from . import raw

ROWS = (0, 1, 50, *[900] * 6)
SCALES = (1.0, 1.0, 1.0, 1e308, 1e30, 1e-320, 1e4)
NAMES = ("acc", "ax", "data", "log", "x y", "é", "time", "n" * 31)
RECORDS = (
    *([("time", "f8"), ("ax", "f8")], [("a", "i4"), ("b", "f8", 2)], [("a", "S3"), ("b", "O")]),
    *([("é", "f4")], [("p", [("q", "f8")])]),
)
TYPES = ("f4", "f8", ">f8", "f2", "i2", ">i2", "u8", "i8", "c16", "?", "S8", "U4", "M8[s]", "O")


def log(rng: random.Random) -> np.ndarray:
    """A log of three outputs: rests of three seconds at 100 Hz, one an axis."""
    rows = rng.choice(ROWS)
    draws = np.random.default_rng(rng.randrange(2**32))
    up = np.eye(3)[(np.arange(rows) // 300) % 3]
    return (up + draws.normal(0.0, 1e-3, (rows, 3))) * rng.choice(SCALES)


def _plain(_: random.Random, samples: np.ndarray) -> Any:
    return samples


def _with_time(_: random.Random, samples: np.ndarray) -> Any:
    return np.column_stack([np.arange(len(samples)) * 0.01, samples])


def _typed(rng: random.Random, samples: np.ndarray) -> Any:
    kind = rng.choice(TYPES)
    with np.errstate(all="ignore"):
        if kind == "M8[s]":
            return np.arange(len(samples)).astype(kind)
        whole = np.dtype(kind).kind in "iu"
        return (np.clip(samples, -1e4, 1e4) if whole else samples).astype(kind)


def _shaped(rng: random.Random, samples: np.ndarray) -> Any:
    forms = (
        *(samples[:, 0], samples.T, samples[None], samples[:, :0], samples[:0], samples[..., None]),
        *(samples.ravel(order="F"), np.asfortranarray(samples), samples[:, :, None, None]),
        np.float64(3.0),
    )
    return rng.choice(forms)


def _structured(rng: random.Random, samples: np.ndarray) -> Any:
    return np.zeros(len(samples), dtype=rng.choice(RECORDS))


def _spoilt(rng: random.Random, samples: np.ndarray) -> Any:
    spoilt = samples.copy()
    if spoilt.size:
        spoilt.flat[:: rng.choice((1, 7, 100))] = rng.choice((np.nan, np.inf, 1e30, -1e308, 0.0))
    return spoilt


FORMS: tuple[Callable[[random.Random, np.ndarray], Any], ...] = (
    *(_plain, _plain, _plain, _with_time, _structured),
    *(_typed, _typed, _shaped, _shaped, _spoilt, _spoilt),
)


def _npy(_: random.Random, array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def _named(rng: random.Random, array: Any) -> dict[str, Any]:
    others = {
        "t": np.arange(np.size(array) // 3) * 0.01,
        "scalar": np.float64(1.0),
        "text": np.array("note"),
        "other": np.zeros((2, 2)),
    }
    chosen = {name: others[name] for name in rng.sample(sorted(others), rng.randrange(3))}
    if np.ndim(array) == 2 and np.shape(array)[1] in (3, 4) and rng.random() < 0.6:
        columns = dict(zip(("ax", "ay", "az", "time"), np.transpose(array), strict=False))
        return columns | {rng.choice(sorted(columns)): array[: rng.choice((None, -1)), 0]}
    return {rng.choice(NAMES): array} | chosen


def _npz(rng: random.Random, array: Any) -> bytes:
    stream = io.BytesIO()
    way = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", way) as archive:
        for name, column in _named(rng, array).items():
            inside = _npy(rng, column)  # damaged here, its checksum is right
            if rng.random() < 0.1:
                inside = raw.damage(rng, inside, raw.BINARY_DAMAGES)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), inside, way)
    return stream.getvalue()


def _mat(rng: random.Random, array: Any) -> bytes:
    from scipy.io import savemat

    content = _named(rng, array)
    if rng.random() < 0.2:
        cell = np.empty(2, dtype=object)
        cell[:] = [np.zeros((2, 3)), "text"]
        content["cell"] = rng.choice((cell, {"a": np.zeros((3, 1)), "b": {"c": 1.0}}))
    form, compressed = rng.choice("555554"), rng.random() < 0.5
    stream = io.BytesIO()
    try:
        savemat(stream, content, format=form, do_compression=compressed)
    except (ValueError, TypeError):  # this form cannot hold that array
        stream = io.BytesIO()
        savemat(stream, {"acc": np.zeros((20, 3))}, do_compression=compressed)
    data = stream.getvalue()
    if not data.startswith(b"MATLAB"):
        return data
    return b"MATLAB 5.0 MAT-file, of no date".ljust(116) + data[116:]


WRITERS: dict[str, Callable[[random.Random, Any], bytes]] = {
    ".npy": _npy,
    ".npz": _npz,
    ".mat": _mat,
}


def draw(rng: random.Random, suffix: str) -> bytes:
    """Return a file of this kind, one in two of them damaged in its bytes too."""
    array = rng.choice(FORMS)(rng, log(rng))
    data = WRITERS[suffix](rng, array)
    for _ in range(rng.choice((0, 0, 1, 2))):
        data = raw.damage(rng, data, raw.BINARY_DAMAGES)
    return data

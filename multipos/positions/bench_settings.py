"""How a bench is set for a position: the label and the angles that the bench itself was given by.

A design is made of up vectors, which nobody sets a bench by. Each position that comes from a bench
is found again in it, and what the bench calls it goes along: columns of a file as they stand there,
the tilt and roll of a two-axis head, the axis and angle of a roll, the number in a named scheme.
Benches that are fine sets of directions, such as ``sphere``, have no such names.
"""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from multipos.files.pipes import is_file
from multipos.files.tables import Source, read_table
from multipos.numerics.arrays import Array
from multipos.positions.benches import AS_SCHEMES, read_bench
from multipos.positions.scheme import Scheme, read_scheme

_ANGLES = (
    "direction",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "roll_axis",
    "angle_deg",
    "qw",
    "qx",
    "qy",
    "qz",
)
_TWO_AXIS = re.compile(r"two-axis-.*")
_ROLL = re.compile(r"roll-\d.*-([xyz]+)")
_FINE = re.compile(r"near-faces-.*|tilt-.*|sphere|fibonacci-.*")
_SAME = 1e-6  # [rad], to which a position of a bench is found again


def bench_settings(source: "Source | Scheme", up: Array) -> tuple[dict[str, Any], ...]:
    """Return how a bench is set at each of some up vectors (n, 3); empty where it does not say.

    Parameters
    ----------
    source : as of `multipos.positions.benches.read_bench`
    up : (n, 3) array
    """
    known: list[tuple[Array, dict[str, Any]]] = []
    if isinstance(source, str) and not is_file(source):
        for part in source.split("+"):
            known += _of_name(part.strip())
    else:
        known = _of_table(source)
    if not known:
        return tuple({} for _ in up)
    reached = np.array([vector for vector, _ in known])
    found = []
    for vector in up:
        apart = np.linalg.norm(reached - vector, axis=1)
        nearest = int(np.argmin(apart))
        found.append(known[nearest][1] if apart[nearest] < _SAME else {})
    return tuple(found)


def _of_name(name: str) -> list[tuple[Array, dict[str, Any]]]:
    if _FINE.fullmatch(name):
        return []
    up = read_bench(name)
    if _TWO_AXIS.fullmatch(name):
        tilt = np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))
        roll = np.degrees(np.arctan2(up[:, 1], up[:, 0])) % 360.0
        roll[np.hypot(up[:, 0], up[:, 1]) < _SAME] = 0.0
        angles = zip(tilt.tolist(), roll.tolist(), strict=True)
        return [
            (vector, {"tilt_deg": round(a, 6), "roll_deg": round(b, 6) % 360.0})
            for vector, (a, b) in zip(up, angles, strict=True)
        ]
    match = _ROLL.fullmatch(name)
    if match:
        return _of_rolls(name, match[1])
    name = AS_SCHEMES.get(name, name)
    scheme = read_scheme(name)
    return [
        (vector, {"scheme": name, "number": label})
        for vector, label in zip(scheme.up, scheme.names, strict=True)
    ]


def _of_rolls(name: str, axes: str) -> list[tuple[Array, dict[str, Any]]]:
    found = []
    for axis in axes:
        i = "xyz".index(axis)
        first, second = (1, 2) if i == 0 else (0, 2) if i == 1 else (0, 1)  # as in roll-x-N …
        for vector in read_bench(f"{name.rpartition('-')[0]}-{axis}"):
            angle = np.degrees(np.arctan2(vector[second], vector[first])) % 360.0
            setting = {"roll_axis": axis, "angle_deg": round(float(angle), 6) % 360.0}
            found.append((vector, setting))
    return found


def _set_by(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that a bench is set by: those that multipos knows, and its own angles."""
    there = list(columns)
    own = [n for n in there if n.endswith("_deg") and n not in (*_ANGLES, "orientation_sd_deg")]
    return (*(name for name in _ANGLES if name in there), *own)


def _of_table(source: "Source | Scheme") -> list[tuple[Array, dict[str, Any]]]:
    table = None if isinstance(source, Scheme) else read_table(source, what="bench")
    scheme = read_scheme(source if table is None else table)
    settings: list[dict[str, Any]] = [{} for _ in range(len(scheme))]
    if scheme.labels is not None:
        settings = [{"position": label} for label in scheme.labels]
    if table is not None:
        for name in _set_by(table.columns):
            for setting, value in zip(settings, table.text(name), strict=True):
                setting[name] = _plain(value)
    return list(zip(scheme.up, settings, strict=True))


def _plain(cell: str) -> Any:
    """Return a cell as a number where it is one."""
    try:
        return float(cell)
    except ValueError:
        return cell

"""Benches: the positions that a holder of the sensor can reach, as candidates for a scheme.

`read_bench` returns the up vectors of one, `bench_settings` how it is set for some of them, and
`read_once` what can be read twice. A bench is written like a scheme and joined by ``+`` like one;
every scheme name and file is a bench too. Up vectors that come twice are kept once. Angles are
degrees.

- ``two-axis-A`` or ``two-axis-AxB``: a dividing head that tilts in steps of A and rolls the case
  about its z axis in steps of B, u = (sin a cos b, sin a sin b, cos a);
- ``roll-A-xyz``: one horizontal roll axis in steps of A, and a fixture that lays the case axes
  named along it one after another (``roll-15-x`` is one mounting, ``roll-15-xyz`` three);
- ``cube``, ``dodecahedron``: blocks laid on each of their faces;
- ``near-faces-D``: held by hand, each face up to within D;
- ``tilt-D``, ``tilt-D-x``: within D of z (or of the axis named) up, a vehicle on a ramp;
- ``sphere``: any direction, as a fine set.

A design is made of up vectors, which nobody sets a bench by. Each position that comes from a bench
is found again in it, and what the bench calls it goes along: columns of a file as they stand there,
the tilt and roll of a two-axis head, the axis and angle of a roll, the number in a named scheme.
Benches that are fine sets of directions, such as ``sphere``, have no such names.
"""

import os
import re
from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np

from multipos.errors import UsageError
from multipos.files.pipes import is_file
from multipos.files.tables import Source, read_table
from multipos.numerics.arrays import Array
from multipos.positions import attitudes
from multipos.positions.scheme import Scheme, read_scheme
from multipos.units import cos_deg, sin_deg

_NUMBER = r"\d+(?:\.\d+)?"
_TWO_AXIS = re.compile(rf"two-axis-({_NUMBER})(?:x({_NUMBER}))?")
_ROLL = re.compile(rf"roll-({_NUMBER})-([xyz]+)")
_NEAR = re.compile(rf"near-faces-({_NUMBER})")
_TILT = re.compile(rf"tilt-({_NUMBER})(?:-([xyz]))?")
AS_SCHEMES = {
    "cube": "faces-6",
    "dodecahedron": "icosahedron-12",
    "sphere": "all-26+fibonacci-3000",
}
_SAME = 9  # decimals to which equal directions agree
_RINGS = 6  # of a cap, beside its middle
_SPOKES = 24  # directions of a ring

NAMES = "two-axis-A, two-axis-AxB, roll-A-xyz, cube, dodecahedron, near-faces-D, tilt-D, sphere"


def read_bench(source: "Source | Scheme") -> Array:
    """Return the up vectors (n, 3) that a bench reaches, each once.

    Parameters
    ----------
    source : str, path, columns or Scheme
        Names of benches and schemes joined by ``+``, or what `multipos.read_scheme` takes.

    Raises
    ------
    UsageError
        No such name, or a step that does not divide the turn.
    MultiposError
        A file that cannot be read.
    """
    if not isinstance(source, str):
        return _once(read_scheme(source).up)
    return _once(np.concatenate([_reach(part.strip())[0] for part in source.split("+")]))


def _reach(name: str) -> tuple[Array, list[dict[str, Any]]]:
    """Return up vectors (n, 3) that a bench reaches, and how it is set for each, where it says."""
    if match := _TWO_AXIS.fullmatch(name):
        tilt, turn = _turn(name, match[1]), _turn(name, match[2] or match[1])
        pairs = product(tilt.tolist(), turn.tolist())
        set_by = [{"tilt_deg": round(a, 6), "roll_deg": round(b, 6)} for a, b in pairs]
        return _two_axis(tilt, turn), set_by
    if match := _ROLL.fullmatch(name):
        steps = _turn(name, match[1])
        rolls = [read_scheme(f"roll-{axis}-{len(steps)}").up for axis in match[2]]
        turns = product(match[2], steps.tolist())
        return np.concatenate(rolls), [
            {"roll_axis": axis, "angle_deg": round(angle, 6)} for axis, angle in turns
        ]
    if match := _NEAR.fullmatch(name):
        return _at_faces(_cap(_within(name, match[1], 45.0))), []
    if match := _TILT.fullmatch(name):
        shift = "zxy".index(match[2] or "z")
        return np.roll(_cap(_within(name, match[1], 180.0)), shift, axis=1), []
    called = AS_SCHEMES.get(name, name)
    try:
        scheme = read_scheme(called)
    except UsageError as error:
        raise UsageError(f"{str(error)[:-1]}; or a bench: {NAMES}.") from None
    fine = _FINE.fullmatch(name) is not None
    return scheme.up, [{"scheme": called, "number": each} for each in scheme.names if not fine]


def _turn(name: str, text: str) -> Array:
    """Return the angles [degrees] of a whole turn in equal steps."""
    step = float(text)
    count = round(360.0 / step) if step > 0.0 else 0
    if count < 2 or abs(count * step - 360.0) > 1e-9 or count > 3600:
        raise UsageError(f"bench '{name}': a step of {text} degrees does not divide the turn.")
    return np.arange(count) * 360.0 / count


def _within(name: str, text: str, largest: float) -> float:
    angle = float(text)
    if not 0.0 < angle <= largest:
        raise UsageError(
            f"bench '{name}': the angle must be above 0 and at most {largest:g} degrees."
        )
    return angle


def _two_axis(tilt: Array, turn: Array) -> Array:
    a, b = (grid.ravel() for grid in np.meshgrid(tilt, turn, indexing="ij"))
    return np.column_stack([sin_deg(a) * cos_deg(b), sin_deg(a) * sin_deg(b), cos_deg(a)])


def _cap(angle: float) -> Array:
    """Return directions within an angle [degrees] of z: rings no more than 5 degrees apart."""
    rings = np.linspace(0.0, angle, max(_RINGS, int(np.ceil(angle / 5.0))) + 1)
    return _two_axis(rings, np.arange(_SPOKES) * 360.0 / _SPOKES)


def _at_faces(cap: Array) -> Array:
    """Return a cap about z turned to each face."""
    return np.concatenate(
        [sign * np.roll(cap, shift, axis=1) for shift in range(3) for sign in (1, -1)]
    )


def _once(up: Array) -> Array:
    _, first = np.unique(np.round(up, _SAME) + 0.0, axis=0, return_index=True)
    return np.asarray(up[np.sort(first)])


_ANGLES = (
    *attitudes.FORMS["direction"],
    *attitudes.FORMS["roll and pitch"],
    "yaw_deg",
    *attitudes.FORMS["roll about an axis"],
    *attitudes.FORMS["quaternion"],
)
_FINE = re.compile(r"sphere|fibonacci-.*")
_NEAR_ENOUGH = 1e-6  # [rad], to which a position of a bench is found again


def read_once(source: "Source | Scheme | None") -> "Source | Scheme | None":
    """Return what can be read again: of an open file or a stream the table that it holds."""
    if source is None or isinstance(source, str | os.PathLike | Scheme | np.ndarray):
        return source
    return read_table(source, what="bench")


def bench_settings(source: "Source | Scheme", up: Array) -> tuple[dict[str, Any], ...]:
    """Return how a bench is set at each of some up vectors (n, 3); empty where it does not say.

    Parameters
    ----------
    source : as of `read_bench`
    up : (n, 3) array
    """
    known: list[tuple[Array, dict[str, Any]]] = []
    if isinstance(source, str) and not is_file(source):
        for part in source.split("+"):
            vectors, set_by = _reach(part.strip())
            known += zip(vectors, set_by, strict=False)  # a fine set has no names
    else:
        known = _of_table(source)
    if not known:
        return tuple({} for _ in up)
    reached = np.array([vector for vector, _ in known])
    found = []
    for vector in up:
        apart = np.linalg.norm(reached - vector, axis=1)
        nearest = int(np.argmin(apart))
        found.append(known[nearest][1] if apart[nearest] < _NEAR_ENOUGH else {})
    return tuple(found)


def _set_by(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that a bench is set by: those that multipos knows, and its own angles."""
    there = list(columns)
    own = [n for n in there if n.endswith("_deg") and n not in (*_ANGLES, "orientation_sd_deg")]
    return (*(name for name in _ANGLES if name in there), *own)


def _of_table(source: "Source | Scheme") -> list[tuple[Array, dict[str, Any]]]:
    bare = isinstance(source, Scheme | np.ndarray)
    table = None if bare else read_table(source, what="bench")
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

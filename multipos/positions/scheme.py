"""Schemes: the ordered set of positions of a calibration, named, from a file, or joined.

`read_scheme` returns one from whatever names or holds it, `lay_scheme` as it is to be measured,
`join` several in order; `named_schemes` and `of_size` are the names for messages. A scheme gives
each position its up vector `u` (unit, in case axes) and, where it is known, the whole attitude (see
`multipos.positions.attitudes`). The named schemes, ``song-qin-6`` [1]_ among them, are the entries
of `SCHEMES`.

References
----------
.. [1] Song Lijun, Qin Yongyuan, *Six-position testing of MEMS accelerometer*, 2009, table 1.
"""

import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.pipes import is_file
from multipos.files.spelling import numbered, visible
from multipos.files.tables import Source, read_table
from multipos.numerics.arrays import Array, Places
from multipos.positions import attitudes, forces, headers
from multipos.positions.attitudes import roll
from multipos.positions.order import Order, check_order, lay_out
from multipos.results import Drawn, Result, Tabular, frozen

LARGEST = 1_000_000  # positions; a typing slip in fibonacci-N should not fill the memory
_AS_PRINTED = ("song-qin-6",)  # whose order is part of the paper
_LONGEST = 40  # digits of an N that are read and shown


@frozen
class Scheme(Result, Drawn, Tabular):
    """The positions of a calibration, in order.

    Attributes
    ----------
    name : str
    up : (n, 3) array
        Unit vectors pointing up, in case axes.
    rotation : (n, 3, 3) array
        Level (ENU) to case, NaN where the heading is open.
    labels : tuple of str or None
        Position labels, unique; None where the source has none.
    force : (n, 3) array or None [g]
        Known specific force, NaN at positions that are at rest in gravity.

    Examples
    --------
    >>> import multipos as mp
    >>> scheme = mp.read_scheme("roll-x-8")
    >>> len(scheme), scheme.labels[:3]
    (8, ('1', '2', '3'))
    >>> scheme.up[1].round(4)
    array([0.    , 0.7071, 0.7071])
    """

    name: str
    up: Array
    rotation: Array
    labels: tuple[str, ...] | None
    force: Array | None = None

    def columns(self) -> dict[str, Any]:
        """Return the positions as `read_scheme` takes them: label, and up vector or known force."""
        found: dict[str, Any] = {"position": self.names}
        if self.force is None:
            return found | dict(zip(attitudes.UP, self.up.T, strict=True))
        forced = forces.known_rows(self.force)
        if not forced.all():
            up = np.where(forced[:, None], np.nan, self.up)
            found |= dict(zip(attitudes.UP, up.T, strict=True))
        return found | dict(zip(forces.FORCE, self.force.T, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """The position labels, or 1, 2, … where the scheme has none."""
        return self.labels or numbered(len(self))

    @property
    def reference(self) -> Array:
        """The force (n, 3) at each position: as known, else of 1 g along `up`."""
        if self.force is None:
            return self.up
        return np.where(np.isfinite(self.force), self.force, self.up)

    def __len__(self) -> int:
        return len(self.up)


def read_scheme(source: "Source | Scheme", *, order: Order = "paper") -> Scheme:
    """Return a scheme from a name, names joined by ``+``, a file, columns or a data frame.

    Parameters
    ----------
    source : name, path, mapping of columns, data frame, (n, 3) array of up vectors, or Scheme
    order : str
        'paper': as published or written; 'spread': so that a drift is absorbed as little as can
        be; 'travel': short ways (`multipos.positions.order`). Labels stay with their directions,
        and the scheme of a paper keeps its order.

    Raises
    ------
    UsageError
        No such name, or no such order.
    MultiposError
        A file that is missing or holds no orientation, or labels that appear twice.

    Examples
    --------
    >>> import multipos as mp
    >>> [len(mp.read_scheme(name)) for name in ("faces-6", "faces-6+corners-8", "fibonacci-24")]
    [6, 14, 24]
    >>> mp.read_scheme({"roll_deg": [180.0, 0.0], "pitch_deg": [0.0, 0.0]}).up.round(6) + 0.0
    array([[ 0.,  0.,  1.],
           [ 0.,  0., -1.]])
    """
    check_order(order)
    if isinstance(source, Scheme):
        found = source
    elif isinstance(source, str) and not is_file(source):
        parts = [_named_or_file(part) for part in source.split("+")]
        found = parts[0] if len(parts) == 1 else join(source, parts)
    else:
        found = _from_table(source)
    if order == "paper" or found.name in _AS_PRINTED:
        return found
    return _taken(found, lay_out(found.reference, order))


def lay_scheme(source: "Source | Scheme", order: Order | None) -> Scheme:
    """Return a scheme as it is to be measured: a named one spread, others as they were written.

    Parameters
    ----------
    source : name, path, mapping of columns, data frame, or Scheme
    order : str, optional
        As for `read_scheme`; it decides where it is given.
    """
    named = isinstance(source, str) and not is_file(source)
    return read_scheme(source, order=order or ("spread" if named else "paper"))


def _taken(scheme: Scheme, rows: Places) -> Scheme:
    """Return the positions of a scheme in another order, each with its label."""
    return Scheme(
        scheme.name,
        scheme.up[rows],
        scheme.rotation[rows],
        tuple(scheme.names[row] for row in rows.tolist()),
        None if scheme.force is None else scheme.force[rows],
    )


def join(name: str, parts: list[Scheme]) -> Scheme:
    """Return the positions of several schemes in order; named positions are numbered through."""
    labels: list[str] = []
    for part in parts:
        own = part.labels or ()
        goes_on = own == numbered(len(part))
        labels += numbered(len(part), start=len(labels) + 1) if goes_on else own
    labelled = all(part.labels is not None for part in parts)
    up = np.concatenate([part.up for part in parts])
    rotation = np.concatenate([part.rotation for part in parts])
    force = _joined_forces(parts)
    known = tuple(labels) if labelled else None
    _refuse_twice(name, known)
    return Scheme(name, up, rotation, known, force)


def _joined_forces(parts: list[Scheme]) -> Array | None:
    if all(part.force is None for part in parts):
        return None
    none = [np.full(part.up.shape, np.nan) for part in parts]
    forces = [n if p.force is None else p.force for p, n in zip(parts, none, strict=True)]
    return np.concatenate(forces)


def named_schemes() -> tuple[str, ...]:
    """Return the names of the schemes, the open ones with the N that users know."""
    return tuple(
        name if scheme.shown is None else f"{name.removesuffix('N')}{scheme.shown}"
        for name, scheme in SCHEMES.items()
    )


def of_size(count: int) -> str:
    """Return the names of the schemes of so many positions, for messages."""
    fixed = [name for name, each in SCHEMES.items() if each.shown is None]
    same = [name for name in fixed if len(SCHEMES[name].positions().up) == count]
    return ", ".join([*same, f"fibonacci-{count}"])


def _named_or_file(text: str) -> Scheme:
    name = text.strip()
    if name in SCHEMES and SCHEMES[name].shown is None:
        return _scheme(name, SCHEMES[name].positions())
    family, _, digits = name.rpartition("-")
    if f"{family}-N" in SCHEMES and re.fullmatch(r"\d+", digits):
        count = int(digits) if len(digits) <= _LONGEST else LARGEST + 1
        if not 1 <= count <= LARGEST:
            raise UsageError(
                f"scheme '{name}': N must lie between 1 and {LARGEST}, got {digits:.{_LONGEST}}."
            )
        return _scheme(name, SCHEMES[f"{family}-N"].positions(count))
    if is_file(name):
        return _from_table(name)
    if Path(name).suffix or os.sep in name:
        raise MultiposError(f"{name}: no such file; check the path of the scheme.")
    raise UsageError(
        f"unknown scheme '{name}'; give a file or one of {', '.join(SCHEMES)}, joined by +."
    )


def _from_table(source: Source) -> Scheme:
    table, units = headers.plain_names(
        read_table(source, what="scheme", outputs=attitudes.FORMS["up vector"])
    )
    rows = attitudes.rows_with_orientation(table)
    stated = forces.states_forces(table, rows)
    force = forces.read_forces(forces.in_standard_g(table, units), rows) if stated else None
    known = None if force is None else forces.known_rows(force)
    listed = attitudes.read_attitudes(table, known)
    if listed is None and force is None:
        raise MultiposError(
            f"{table.source}: no orientation columns; give direction, up_x up_y up_z, "
            "roll_deg pitch_deg, qw qx qy qz, roll_axis angle_deg, or a known force f_x f_y f_z."
        )
    labels = table.text("position") if "position" in table else None
    _refuse_twice(table.source, labels)
    if listed is None:
        listed = attitudes.open_attitudes(table.rows)
    up = listed.up if force is None else forces.along_forces(force, listed.up)
    return Scheme(visible(table.source), up, listed.rotation, labels, force)


def _refuse_twice(name: str, labels: tuple[str, ...] | None) -> None:
    if labels is not None and len(set(labels)) < len(labels):
        twice = next(label for label, count in Counter(labels).items() if count > 1)
        raise MultiposError(
            f"{name}: position '{twice}' appears twice; give every position its own label "
            "(readings repeat a position, a scheme names it once)."
        )


def _scheme(name: str, listed: attitudes.Attitudes) -> Scheme:
    return Scheme(name, listed.up, listed.rotation, numbered(len(listed.up)))


def _song_qin() -> attitudes.Attitudes:
    triples = ("东天南", "东北天", "地东南", "西地南", "天西南", "南西地")
    return attitudes.from_rotation([attitudes.parse_direction(triple) for triple in triples])


def _faces() -> attitudes.Attitudes:
    return attitudes.from_up([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


def _corners() -> attitudes.Attitudes:
    return attitudes.from_up(_CUBE)


def _edges() -> attitudes.Attitudes:
    pairs = [(a, b) for a in (1, -1) for b in (1, -1)]
    return attitudes.from_up(
        [[a, b, 0] for a, b in pairs]
        + [[a, 0, b] for a, b in pairs]
        + [[0, a, b] for a, b in pairs]
    )


_CUBE: list[list[float]] = [[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)]
_GOLDEN = (1.0 + 5.0**0.5) / 2.0


def _rectangles(short: float) -> list[list[float]]:
    """Return the corners of three rectangles, each across one axis, of one short side."""
    pairs = [(a * short, b * _GOLDEN) for a in (1, -1) for b in (1, -1)]
    across = [[0.0, a, b] for a, b in pairs]
    return across + [[a, b, 0.0] for a, b in pairs] + [[b, 0.0, a] for a, b in pairs]


def _icosahedron() -> attitudes.Attitudes:
    return attitudes.from_up(_rectangles(1.0))


def _dodecahedron() -> attitudes.Attitudes:
    return attitudes.from_up([*_CUBE, *_rectangles(1.0 / _GOLDEN)])


def _fibonacci(count: int) -> attitudes.Attitudes:
    k = np.arange(count)
    height = 1.0 - (2.0 * k + 1.0) / count
    azimuth = 2.0 * np.pi * k / _GOLDEN**2
    level = np.sqrt(1.0 - height**2)
    return attitudes.from_up(
        np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), height])
    )


def _roll(axis: str) -> Callable[[int], attitudes.Attitudes]:
    # k·360/N, not k·(360/N): quarter turns stay exact whatever N.
    return lambda count: roll(axis, np.arange(count) * 360.0 / count)


def _joined(*parts: attitudes.Attitudes) -> attitudes.Attitudes:
    return attitudes.Attitudes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _dual_axis() -> attitudes.Attitudes:
    return _joined(_roll("y")(24), _roll("x")(24))


def _all() -> attitudes.Attitudes:
    return _joined(_faces(), _edges(), _corners())


class NamedScheme(NamedTuple):
    """A named scheme, or a family of them whose name ends in N."""

    description: str  # its positions in words
    positions: Callable[..., attitudes.Attitudes]  # of nothing, or of the N of a family
    shown: int | None = None  # the N of a family that the list of schemes shows


SCHEMES = {
    "song-qin-6": NamedScheme("table 1 of the six-position paper, in its order", _song_qin),
    "faces-6": NamedScheme("up along the faces of a cube", _faces),
    "corners-8": NamedScheme("up along the corners of a cube", _corners),
    "edges-12": NamedScheme("up along the edges of a cube", _edges),
    "icosahedron-12": NamedScheme("up along the corners of an icosahedron", _icosahedron),
    "faces-corners-14": NamedScheme(
        "faces-6, then corners-8", lambda: _joined(_faces(), _corners())
    ),
    "faces-edges-18": NamedScheme("faces-6, then edges-12", lambda: _joined(_faces(), _edges())),
    "dodecahedron-20": NamedScheme("up along the corners of a dodecahedron", _dodecahedron),
    "all-26": NamedScheme("faces-6, then edges-12, then corners-8", _all),
    "dual-axis-48": NamedScheme("roll-y-24, then roll-x-24", _dual_axis),
    "fibonacci-N": NamedScheme("N nearly even directions on the golden spiral", _fibonacci, 24),
    "roll-x-N": NamedScheme("N even steps of a turn about x, held horizontal", _roll("x"), 24),
    "roll-y-N": NamedScheme("N even steps of a turn about y, held horizontal", _roll("y"), 24),
    "roll-z-N": NamedScheme("N even steps of a turn about z, held horizontal", _roll("z"), 24),
    "tumble-N": NamedScheme("the same as roll-z-N", _roll("z"), 12),
}

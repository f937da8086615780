"""Attitudes of the case in the forms people write them, and the up vectors they give.

`read_attitudes` reads those of a table, of which `rows_with_orientation` and `rows_without_angle`
tell the rows that have one; `parse_direction` and `parse_axis_up` read one text, `are_directions`
a column of them. `from_up`, `from_rotation` and `roll` return attitudes of arrays,
`open_attitudes` those of which nothing is known, `unit_vectors` vectors of length one,
`pose_words` one in words; `check_convention` refuses a convention that is none.

The level frame is east, north, up (ENU). An attitude is the matrix `C` that turns level
components into case components, ``v_case = C v_level``, so that its third column is the unit
vector pointing up, in case axes: ``u = C e_U``. Written as

- a direction triple, where x, y and z point: the rows of `C` are those directions;
- roll φ, pitch θ, yaw ψ (aerospace Z-Y-X, level is z down):
  ``u = (sin θ, -sin φ cos θ, -cos φ cos θ)``, and with ψ the whole of `C`;
- a Hamilton quaternion, scalar first, ``v_level = q v q*``;
- an angle t about a horizontal axis that points east: about x ``u = (0, cos t, sin t)``,
  about y ``(cos t, 0, sin t)``, about z ``(cos t, sin t, 0)``;
- an up vector of any length but zero, which leaves the heading open: `C` is then NaN.

Exact angles give exact zeros: a stray cos 90° = 6e-17 would pass for a tilt.
"""

import math
import re
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import quoted
from multipos.files.tables import Table
from multipos.numerics.arrays import COMPONENTS, Array, Mask, as_numbers
from multipos.units import cos_deg, sin_deg

Convention = Literal["specific-force", "gravity"]  # which sign the axis that points up has
AngleZero = Literal["up", "level"]  # where the axis that is read stands at angle 0
CONVENTIONS: tuple[Convention, ...] = get_args(Convention)

_SIGNS = str.maketrans("−–＋－", "--+-")
_E, _N, _U = np.eye(3)
_LETTERS = {"E": _E, "N": _N, "U": _U, "W": -_E, "S": -_N, "D": -_U}
_CHINESE = {"东": "E", "東": "E", "北": "N", "天": "U", "西": "W", "南": "S", "地": "D"}

UP = ("up_x", "up_y", "up_z")
FORMS: dict[str, tuple[str, ...]] = {
    "direction": ("direction",),
    "up vector": UP,
    "roll and pitch": ("roll_deg", "pitch_deg"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "roll about an axis": ("roll_axis", "angle_deg"),
}
COLUMNS = frozenset(name for names in FORMS.values() for name in names) | {"yaw_deg"}


class Attitudes(NamedTuple):
    """Up vectors (n, 3) and level-to-case matrices (n, 3, 3), NaN where the heading is open."""

    up: Array
    rotation: Array


def open_attitudes(n: int) -> Attitudes:
    """Return attitudes of which nothing is known yet."""
    return Attitudes(np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan))


_LEVEL_DEG = 3.0  # nothing a hand can tell
_SMALL_SHARE = 0.35  # of the lean, below which an axis is not named
_EMPTY = ("", "nan")  # of a cell, in a file and in a data frame


def check_convention(convention: str) -> None:
    """Refuse a convention that is none."""
    if convention not in CONVENTIONS:
        raise UsageError(f"unknown convention '{convention}'; give specific-force or gravity.")


def rows_with_orientation(table: Table) -> Mask | None:
    """Return which rows (n,) give an orientation at all; None without orientation columns."""
    form = _form(table)
    if form is None:
        return None
    cells = zip(*(table.text(name) for name in FORMS[form]), strict=True)
    given = np.array([any(cell not in _EMPTY for cell in row) for row in cells])
    return given & ~rows_without_angle(table)


def rows_without_angle(table: Table) -> Mask:
    """Return the rows (n,) that name the axis of a roll and leave its angle open."""
    if not all(name in table for name in FORMS["roll about an axis"]):
        return np.zeros(table.rows, dtype=bool)
    axes, angles = table.text("roll_axis"), table.text("angle_deg")
    return np.array(
        [axis in COMPONENTS and a in _EMPTY for axis, a in zip(axes, angles, strict=True)]
    )


def read_attitudes(table: Table, unknown: Mask | None = None) -> Attitudes | None:
    """Return the attitudes a table holds, or None where it has no orientation columns.

    Rows marked `unknown` (n,) may leave their orientation empty; it is NaN then.

    Raises
    ------
    MultiposError
        Two forms at once, a form with a column missing, or an impossible orientation.
    """
    form = _form(table)
    if form is None:
        return None
    if unknown is None:
        return _READERS[form](table)
    given = rows_with_orientation(table)
    assert given is not None
    skipped = unknown & ~given
    result = open_attitudes(table.rows)
    if not skipped.all():
        found = _READERS[form](table.select(np.flatnonzero(~skipped).tolist()))
        result.up[~skipped], result.rotation[~skipped] = found
    return result


def _form(table: Table) -> str | None:
    """Return in which form a table says its orientations, or None."""
    found = [form for form, names in FORMS.items() if any(name in table for name in names)]
    if not found:
        if "yaw_deg" not in table:
            return None
        raise MultiposError(f"{table.source}: 'yaw_deg' needs 'roll_deg' and 'pitch_deg' as well.")
    if len(found) > 1:
        raise MultiposError(
            f"{table.source}: the orientation is given as {' and as '.join(found)}; keep one."
        )
    names = FORMS[found[0]]
    missing = [name for name in names if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: column {quoted(missing)} is missing; an orientation given as "
            f"{found[0]} needs {quoted(names)}."
        )
    return found[0]


def from_up(up: ArrayLike, where: str = "`up`") -> Attitudes:
    """Return attitudes of open heading from up vectors (n, 3) of any length but zero."""
    unit = unit_vectors(up, where)
    return Attitudes(unit, np.full((len(unit), 3, 3), np.nan))


def unit_vectors(up: ArrayLike, where: str = "`up`") -> Array:
    """Return up vectors (n, 3) of any length but zero as unit vectors."""
    vectors = np.atleast_2d(as_numbers(up, where))
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise MultiposError(
            f"{where} must have shape (n, 3), got {vectors.shape}; give one row per position."
        )
    # Scaled by the largest component first, so that neither 1e-200 nor 1e200 loses the length.
    columns = np.ascontiguousarray(vectors.T)
    largest = np.abs(columns).max(axis=0)
    bad = ~(np.isfinite(largest) & (largest > 0.0))
    if bad.any():
        raise MultiposError(
            f"{where}: the up vector of row {int(np.argmax(bad)) + 1} is zero or not finite; "
            "it must point somewhere."
        )
    columns = columns / largest
    length = np.sqrt(np.einsum("in,in->n", columns, columns))
    # What is a unit vector to rounding stays as it is, so that reading it back changes nothing.
    already = np.abs(largest * length - 1.0) < 4.0 * np.finfo(float).eps
    return np.where(already[:, None], vectors, (columns / length).T) + 0.0


def from_rotation(rotation: ArrayLike) -> Attitudes:
    """Return attitudes from level-to-case matrices (n, 3, 3)."""
    matrix = as_numbers(rotation, "`rotation`")
    return Attitudes(matrix[:, :, 2].copy(), matrix)


def parse_direction(text: str) -> Array:
    """Return the level-to-case matrix (3, 3) of a triple: ``E-U-S``, ``EUS`` or ``东天南``.

    Raises
    ------
    MultiposError
        Not three of E N W S U D, not perpendicular, or left-handed.
    """
    letters = _three_letters(text)
    x, y, z = (_LETTERS[mark] for mark in letters)
    handed = np.cross(x, y)
    if (handed == z).all():
        return np.array([x, y, z]) + 0.0
    if not handed.any():
        raise MultiposError(
            f"direction '{text}' is impossible: x and y must be perpendicular, "
            f"but point {letters[0]} and {letters[1]}."
        )
    right = next(mark for mark, vector in _LETTERS.items() if (vector == handed).all())
    fault = "left-handed" if (handed == -z).all() else "impossible"
    raise MultiposError(
        f"direction '{text}' is {fault}: with x {letters[0]} and y {letters[1]}, z points {right}."
    )


def _three_letters(text: str) -> list[str]:
    letters = [_CHINESE.get(mark, mark.upper()) for mark in text if mark not in "-–— ,/\t"]
    if len(letters) != 3 or not _LETTERS.keys() >= set(letters):
        raise MultiposError(
            f"direction '{text}' is not a triple; name where x, y and z point with three of "
            "E N W S U D or 东北西南天地, as in E-N-U, or the axis that is up, as in +X."
        )
    return letters


def roll(axis: str, angle_deg: ArrayLike) -> Attitudes:
    """Return the attitudes of a roll about a horizontal case axis, angles [degrees] (n,)."""
    angle = np.array(angle_deg, dtype=np.float64, ndmin=1)
    along = "xyz".index(axis)
    first, second = (index for index in range(3) if index != along)
    up = np.zeros((len(angle), 3))
    up[:, first], up[:, second] = cos_deg(angle), sin_deg(angle)
    east = np.broadcast_to(np.eye(3)[along], up.shape)
    return from_rotation(np.stack([east, np.cross(up, east) + 0.0, up], axis=2))


_UPWARD = ("up", "upward", "upwards", "top", "oben", "haut", "上", "朝上", "向上", "↑")
_DOWNWARD = ("down", "downward", "downwards", "bottom", "unten", "bas", "下", "朝下", "向下", "↓")
_PLUS = ("+", "p", "pos", "plus", "positive")
_MINUS = ("-", "n", "m", "neg", "minus", "negative")
_HYPHEN = re.compile(r"(?<=[^\W\d_])-(?=[^\W\d_])")  # between words, as in x-up: no sign
_IGNORED = ("axis", "face", "side", "轴")
_SIGN_OF = dict.fromkeys(_PLUS + _UPWARD, 1.0) | dict.fromkeys(_MINUS + _DOWNWARD, -1.0)
_KNOWN = sorted((*_SIGN_OF, *COMPONENTS, *_IGNORED), key=len, reverse=True)
_WORDS = re.compile("|".join([*map(re.escape, _KNOWN), r"[^\W\d_]+"]))  # glued ones too, as in xup


def parse_axis_up(text: str) -> Array | None:
    """Return the up vector (3,) of a label such as ``+X``, ``Z+``, ``y down``, None of other text.

    An axis with a sign, a word for up or down, or both, in any order: ``-x up``, ``pos Z``,
    ``X_neg``, ``z 朝下``.
    """
    plain = _HYPHEN.sub(" ", text.translate(_SIGNS).casefold())
    words = [word for word in _WORDS.findall(plain) if word not in _IGNORED]
    axes = [word for word in words if word in COMPONENTS]
    signs = [word for word in words if word in _PLUS + _MINUS]
    ways = [word for word in words if word in _UPWARD + _DOWNWARD]
    kinds = (len(axes), len(signs), len(ways))
    if kinds not in ((1, 1, 0), (1, 0, 1), (1, 1, 1)) or sum(kinds) != len(words):
        return None
    up = np.zeros(3)
    up[COMPONENTS.index(axes[0])] = math.prod(_SIGN_OF[word] for word in (*signs, *ways))
    return up


def are_directions(cells: Sequence[str]) -> bool:
    """Tell whether all cells of a column of text say where the case points."""
    return bool(cells) and all(_is_direction(cell) for cell in dict.fromkeys(_as_axes(cells)))


def _as_axes(cells: Sequence[str]) -> Sequence[str]:
    """Return labels; ``up`` and ``down`` alone are those of z where all are one of them."""
    alone = {cell.strip().casefold() for cell in cells}
    return [f"z {cell}" for cell in cells] if alone <= {*_UPWARD, *_DOWNWARD} else cells


def _is_direction(text: str) -> bool:
    if parse_axis_up(text) is not None:
        return True
    try:
        parse_direction(text)
    except MultiposError:
        return False
    return True


def _read_direction(table: Table) -> Attitudes:
    found = open_attitudes(table.rows)
    for row, text in enumerate(_as_axes(table.text("direction"))):
        axis = parse_axis_up(text)
        if axis is not None:
            found.up[row] = axis
            continue
        try:
            found.rotation[row] = parse_direction(text)
        except MultiposError as error:
            raise MultiposError(f"{table.where(row, 'direction')}: {error}") from None
        found.up[row] = found.rotation[row, :, 2]
    return found


def _read_up(table: Table) -> Attitudes:
    return from_up(
        np.column_stack([table.number(name) for name in FORMS["up vector"]]), table.source
    )


def _read_roll_pitch(table: Table) -> Attitudes:
    roll_deg, pitch_deg = table.number("roll_deg"), table.number("pitch_deg")
    sr, cr, sp, cp = sin_deg(roll_deg), cos_deg(roll_deg), sin_deg(pitch_deg), cos_deg(pitch_deg)
    up = np.column_stack([sp, -sr * cp, -cr * cp]) + 0.0
    if "yaw_deg" not in table:
        return Attitudes(up, np.full((len(up), 3, 3), np.nan))
    yaw_deg = table.number("yaw_deg")
    sy, cy = sin_deg(yaw_deg), cos_deg(yaw_deg)
    # v_case = Rx(φ) Ry(θ) Rz(ψ) v_NED; the columns are its images of north, east and -down.
    north = np.column_stack([cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy])
    east = np.column_stack([cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy])
    return from_rotation(np.stack([east, north, up], axis=2) + 0.0)


def _read_quaternion(table: Table) -> Attitudes:
    q = np.column_stack([table.number(name) for name in FORMS["quaternion"]])
    largest = np.abs(q).max(axis=1)
    if (largest == 0.0).any():
        row = int(np.argmax(largest == 0.0))
        raise MultiposError(f"{table.where(row, 'qw')}: the quaternion is zero; normalise it.")
    q = np.ldexp(q, -np.frexp(largest)[1][:, None])  # exactly; of 1e160 the square is no number
    square = np.einsum("ni,ni->n", q, q)
    w, x, y, z = q.T
    # Homogeneous form: exact for the quarter and third turns, whatever the length of q.
    case_to_level = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    matrix = np.moveaxis(case_to_level, 2, 0).transpose(0, 2, 1) / square[:, None, None]
    # sqrt(1/2) is not exact: what rounding leaves of a zero is snapped.
    matrix[np.abs(matrix) < 4.0 * np.finfo(float).eps] = 0.0
    return from_rotation(matrix)


def _read_roll_axis(table: Table) -> Attitudes:
    axes = table.text("roll_axis")
    for row, axis in enumerate(axes):
        if axis not in ("x", "y", "z"):
            raise MultiposError(
                f"{table.where(row, 'roll_axis')}: '{axis}' is not an axis; write x, y or z."
            )
    angles = table.number("angle_deg")
    up, rotation = np.empty((len(axes), 3)), np.empty((len(axes), 3, 3))
    for axis in sorted(set(axes)):
        rows = np.array([name == axis for name in axes])
        up[rows], rotation[rows] = roll(axis, angles[rows])
    return Attitudes(up, rotation)


_READERS = {
    "direction": _read_direction,
    "up vector": _read_up,
    "roll and pitch": _read_roll_pitch,
    "quaternion": _read_quaternion,
    "roll about an axis": _read_roll_axis,
}


def pose_words(up: Array, towards: str = "up") -> str:
    """Return an up vector (3,) in words: "+z up, leaning 35° so that −x rises".

    The largest component names the axis to point up; what is left is a lean by acos|u_largest|
    towards the axes that rise with it. Of a magnetometer it is the field that points there,
    `towards` is "field".
    """
    main = max(range(3), key=lambda i: abs(round(float(up[i]), 9)))
    lean = math.degrees(math.acos(min(1.0, abs(float(up[main])))))
    axis = _axis(main, float(up[main]))
    if lean < _LEVEL_DEG:
        return f"{axis} along the field" if towards == "field" else f"{axis} straight up"
    rest = [i for i in range(3) if i != main]
    size = math.hypot(*(float(up[i]) for i in rest))
    named = [i for i in rest if abs(float(up[i])) >= _SMALL_SHARE * size]
    named.sort(key=lambda i: -abs(round(float(up[i]), 9)))
    risen = " and ".join(_axis(i, float(up[i])) for i in named)
    if towards == "field":
        return f"the field {lean:.0f}° from {axis} towards {risen}"
    rise = "rises" if len(named) == 1 else "rise"
    return f"{axis} up, leaning {lean:.0f}° so that {risen} {rise}"


def _axis(i: int, value: float) -> str:
    return f"{'+' if value >= 0.0 else '−'}{'xyz'[i]}"

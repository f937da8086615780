"""The field that a triad senses: gravity or magnetic, its size, and what its uncertainty does.

A triad turned in a field of constant size reads y = b + K f, |f| the size: known, or one where it
is not. What is said of the field stands in one object, `Field`: its kind, its size and the unit of
that, and with them the unit of the reference (g; the unit of the field; none of a field of unknown
size, which is one). Estimation sees a vector of a size and nothing else.

An uncertain size scales the reference of every position at rest alike. Where all are, a
coefficient of degree d in force is proportional to g^-d, so that its sensitivity (of every case:
`multipos.estimation.gains`) and the covariance that all parameters share are

    c_j = d_j p_j / g,       cov p += c c' u_g²,                                            (1)

with infinite degrees of freedom; the effective ones of the sum are Welch and Satterthwaite's,

    ν_eff = ν (u_c² / u_A²)²,     u_A from the readings, u_c combined.                      (2)

Under gravity the reference is the specific force, +1 along the axis that points up; a magnetic
reference is the field b itself, whose direction columns ``b_x, b_y, b_z`` state.

References
----------
JCGM 100:2008, clause 5.1 and G.4.1.
"""

import math
import re
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from multipos.errors import UsageError
from multipos.files.numbers import in_unit
from multipos.numerics.arrays import LARGEST, Array
from multipos.positions.headers import MAGNETIC_UNITS, field_of_outputs, unit_of
from multipos.results import frozen
from multipos.units import gravity_ratio, normal_gravity

FieldKind = Literal["gravity", "magnetic"]
FIELD_KINDS: tuple[FieldKind, ...] = get_args(FieldKind)


@frozen(eq=True)
class Field:
    """What a triad senses.

    Attributes
    ----------
    kind : str
        'gravity' or 'magnetic'.
    size, u : float or None, float
        Its size and standard uncertainty, in `size_unit`; None where it is not known: a gravity of
        one g, a magnetic field of one.
    size_unit : str
        'm/s^2', or of a magnetic field T, mT, uT, nT, G or mG.
    """

    kind: FieldKind = "gravity"
    size: float | None = None
    u: float = 0.0
    size_unit: str = "m/s^2"

    @property
    def magnetic(self) -> bool:
        """Whether it is a magnetic field."""
        return self.kind == "magnetic"

    @property
    def value(self) -> float:
        """The size, as equations (1) take it."""
        return 1.0 if self.size is None else self.size

    @property
    def magnitude(self) -> float:
        """The size of the reference, in `unit`."""
        return self.value if self.magnetic else gravity_ratio(self.size)

    @property
    def full_scale(self) -> float:
        """The size that percentages are of: one g, or the magnetic field itself."""
        return self.value if self.magnetic else 1.0

    @property
    def unit(self) -> str:
        """The unit of the reference: g, that of the size, or none."""
        if not self.magnetic:
            return "g"
        return "" if self.size is None else self.size_unit

    @property
    def printed(self) -> str:
        """The unit of the reference for tables, 1 where it has none."""
        return self.unit or "1"

    @property
    def sensor(self) -> str:
        """What senses it."""
        return "Magnetometer" if self.magnetic else "Accelerometer"

    @property
    def symbol(self) -> str:
        """What a component is called in columns: f of forces, b of magnetic fields."""
        return "b" if self.magnetic else "f"

    @property
    def text(self) -> str:
        """Its size in words."""
        if self.size is None:
            return "size unknown, taken as one" if self.magnetic else "local, one g"
        return f"{self.size:.10g} {self.size_unit}, u = {self.u:.3g} {self.size_unit}"

    def shown(self, size: float) -> str:
        """Return a size in the unit of the reference as people read it, 2 mg, 120 nT or .3 %."""
        return in_unit(size, self.unit) if self.unit else f"{100.0 * size:.3g} %"

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON carries of a magnetic field."""
        unit = self.size_unit if self.size is not None else None
        return {"kind": self.kind, "size": self.size, "u": self.u, "unit": unit}


# What is said of force in the sentences of all sensors, and what that is of a magnetic field; the
# option --force, names in braces and what stands in quotes stay.
_WORDS = (
    (r"output of ([\w.{}]+) at zero specific force", r"hard iron of \1"),
    (r"of bias", "of hard iron"),
    (r"specific force", "field"),
    (r"at rest in one gravity", "in one field"),
    (r"in addition to gravity", "of another size"),
    (r"(?:local )?gravity reads", "the field reads"),
    (r"respond to gravity", "respond to the field"),
    (r"in gravity", "in the magnetic field"),
    (r"Gravity", "Field"),
    (r"the reference in g", "the reference"),
    (r"readings in g", "readings in its unit"),
    (r"local gravity|(?<!--)(?<!\{)gravity", "the field"),
    (r"forces", "fields"),
    (r"Forces", "Fields"),
    (r"force and(?: of)? tilt|force and tilt", "field"),
    (r"(?<!--)(?<!\{)force", "field"),
    (r"Force", "Field"),
    (r"Accelerometer", "Magnetometer"),
    (r"accelerometer", "magnetometer"),
    (r"accelerations?", "field"),
    (r"one g", "the field"),
    (r"Offset of", "Hard iron of"),
    (r"Which way was up", "Where the field pointed"),
    (r"which way was up", "where the field pointed"),
    (r"up vectors?", "field direction"),
    (r"Up vector", "Field direction"),
    (r"up in case axes", "field in case axes"),
    (r"hand-held position", "reading in all directions"),
    (r"upside down", "reversed"),
)
_PERCENT = {"g": 100.0, "mg": 0.1, "µg": 1e-4}  # of a relative field
_CHINESE = (
    *(("−1 g 至 +1 g", "磁场范围"), ("1 g 的", "磁场的")),
    *(("比力", "磁场"), ("加速度计", "磁力计"), ("加速度", "磁场"), ("重力场", "磁场")),
    *(("重力", "磁场"), ("受力", "磁场"), ("力的大小", "磁场的大小"), ("补偿后力", "补偿后磁场")),
    ("向上矢量", "磁场方向"),
    ("中的“上”", "中的磁场"),
    *(("为单位的力", "为单位的磁场"), ("零偏", "硬磁偏置"), ("力以", "磁场以"), ("与倾角", "")),
)
_TABLE = tuple((re.compile(rf"(?<![\w-]){old}(?!\w)"), new) for old, new in _WORDS)
_SIZE = re.compile(r"(?<![\w.])([-+]?[\d.]+(?:e[-+]?\d+)?) (mg|µg|g)(?![\w/^])")


def worded(text: str, field: Field) -> str:
    """Return a sentence as it is said of a sensor of a field; of accelerometers as it stands.

    Sizes in g are those of the relative field.
    """
    if not field.magnetic:
        return text
    text = text.replace("−1 g to +1 g", "the field's range")
    text = _SIZE.sub(lambda m: f"{_PERCENT[m[2]] * float(m[1]):.3g} % of the field", text)
    for pattern, new in _TABLE:
        text = pattern.sub(new, text)
    return text


def worded_chinese(text: str) -> str:
    """Return a Chinese sentence as it is said of a magnetometer."""
    for old, new in _CHINESE:
        text = text.replace(old, new)
    return text


GRAVITY = Field()
MAGNETIC = Field("magnetic", size_unit="uT")


@frozen(eq=True)
class StatedBench:
    """What is stated of a bench: the field, limits of its readings, and the probability of U.

    Attributes are the options of `multipos.fit`: `gravity`, `gravity_u` [m/s²], `latitude`
    [degrees] and `height` [m]; `field`, `field_size` and `field_size_u` of a magnetometer; `range`;
    `confidence`.
    """

    gravity: float | None = None
    gravity_u: float | None = None
    latitude: float | None = None
    height: float | None = None
    field: FieldKind | None = None
    field_size: float | str | None = None
    field_size_u: float | str | None = None
    range: Sequence[float] | None = None
    confidence: float = 0.95

    def local_gravity(self) -> Field | None:
        """Return the local gravity [m/s²] that is stated, or None.

        Raises
        ------
        UsageError
            Options that contradict each other, or a number that is no gravity on Earth.
        """
        gravity, u = self.gravity, self.gravity_u
        if gravity is not None and self.latitude is not None:
            raise UsageError("--gravity and --latitude both state the gravity; give one.")
        if self.height is not None and self.latitude is None:
            raise UsageError("--height needs --latitude.")
        if u is not None and gravity is None:
            raise UsageError("--gravity-u needs --gravity.")
        if self.latitude is not None:
            try:
                return Field(size=normal_gravity(self.latitude, self.height or 0.0))
            except ValueError as error:
                raise UsageError(str(error)) from None
        if gravity is None:
            return None
        if u is not None and not 0.0 <= u <= LARGEST:
            raise UsageError(
                f"--gravity-u must be 0 or more, and no more than {LARGEST:g}, got {u}."
            )
        if not 1.0 <= gravity <= 100.0:
            raise UsageError(f"--gravity must be in m/s², such as 9.81, got {gravity}.")
        return Field(size=gravity, u=u or 0.0)

    def field_of(self, outputs: tuple[str, ...], unit: str, gravity: Field | None) -> Field:
        """Return the field that is stated, or that names and unit of the outputs show.

        Parameters
        ----------
        outputs : tuple of str
        unit : str
            Of the readings, and of a size of the field that is a number.
        gravity : Field or None
            The local gravity, where one is stated.

        Raises
        ------
        UsageError
            An unknown kind, a unit of the other kind, or a size that is none.
        """
        size, size_u = self.field_size, self.field_size_u
        check_field_kind(self.field)
        known = None if gravity is None else "gravity"
        if field_of_outputs(outputs, unit, known, self.field) == "gravity":
            if size is not None or size_u is not None:
                raise UsageError(
                    "--field-size is of a magnetic field; give --field magnetic, or the local "
                    "gravity with --gravity."
                )
            return gravity or GRAVITY
        if gravity is not None:
            raise UsageError(
                "--gravity and --latitude are of accelerometers; a magnetic field has --field-size."
            )
        if size is None:
            if size_u is not None:
                raise UsageError("--field-size-u needs --field-size.")
            return MAGNETIC
        return _magnetic_field(size, size_u, unit)


def _magnetic_field(size: float | str, size_u: float | str | None, unit: str) -> Field:
    value, own = _quantity(size, "--field-size", unit)
    if not 0.0 < value <= LARGEST:
        raise UsageError(f"--field-size must be above 0, such as 48.6uT, got {size}.")
    if size_u is None:
        return Field("magnetic", value, 0.0, own)
    u, other = _quantity(size_u, "--field-size-u", unit)
    u *= 10.0 ** (_POWERS[other] - _POWERS[own])
    if not 0.0 <= u < value:
        raise UsageError(f"--field-size-u must be 0 or more and below the size, got {size_u}.")
    return Field("magnetic", value, u, own)


_POWERS = {"T": 0, "mT": -3, "uT": -6, "nT": -9, "G": -4, "mG": -7}  # of ten, in tesla
_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\D*)\s*")


def check_field_kind(kind: str | None) -> None:
    """Refuse a kind of field that is none."""
    if kind is not None and kind not in FIELD_KINDS:
        raise UsageError(f"--field takes gravity or magnetic, got '{kind}'.")


def in_tesla(unit: str) -> float | None:
    """Return a unit of magnetic fields in tesla, None of any other."""
    return 10.0 ** _POWERS[unit] if unit in _POWERS else None


def _quantity(given: float | str, option: str, readings: str) -> tuple[float, str]:
    """Return number and unit of what was given, the readings' where it has none."""
    found = _QUANTITY.fullmatch(str(given))
    try:
        value = float(found[1]) if found else math.nan
    except ValueError:
        value = math.nan
    written = found[2].strip() if found else ""
    unit = unit_of(written) if written else readings
    if math.isnan(value) or unit not in MAGNETIC_UNITS:
        raise UsageError(
            f"{option} takes a number and a unit of {', '.join(MAGNETIC_UNITS)}, such as 48.6uT, "
            f"got '{given}'" + ("." if written else f", and the readings are in '{readings}'.")
        )
    return value, unit


def signed_size(field: Field | None, convention: str) -> float:
    """Return the magnitude of the reference, negative under the gravity convention."""
    size = (field or GRAVITY).magnitude
    return -size if convention == "gravity" else size


def add_gravity(
    covariance: Array, dof: Array, gravity: Field, sensitivity: Array
) -> tuple[Array, Array]:
    """Return covariance and degrees of freedom with the common term of the size, eqs. (1), (2).

    Parameters
    ----------
    covariance, dof : (p, p), (p,) arrays
    gravity : Field
    sensitivity : (p,) array
        c of eq. (1).
    """
    combined = covariance + np.outer(sensitivity, sensitivity) * gravity.u**2
    before, after = np.diag(covariance), np.diag(combined)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        effective = np.where(before > 0.0, dof * (after / before) ** 2, np.inf)
    effective[effective > LARGEST] = np.inf
    return combined, np.where(np.isnan(before), dof, effective)

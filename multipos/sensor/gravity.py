"""The field that a triad senses: gravity or magnetic, its size, and what its uncertainty does.

A triad turned in a field of constant size reads y = b + K f, |f| the size: known, or one where it
is not. What is said of the field stands in one object, a `Field`, which is gravity, or of another
kind of `KINDS`, a `MagneticField`: its words, the unit of the reference (g; the unit of
the field; none of a field of unknown size, which is one), what files and options say of its size.
Estimation sees a vector of a size and nothing else. `field_sensed` takes the kind from outputs and
their unit, `field_of_file` from a calibration file, `check_field_kind` refuses one that is none;
`in_tesla` converts the units of magnetic fields, `signed_size` gives the reference its sign, and
`add_gravity` the covariance its common term.

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
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, Literal

import numpy as np

from multipos.errors import UsageError
from multipos.files.numbers import in_unit
from multipos.files.spelling import packaged_pairs
from multipos.numerics.arrays import LARGEST, Array
from multipos.positions.headers import field_of_outputs
from multipos.results import frozen
from multipos.units import gravity_ratio

FieldKind = Literal["gravity", "magnetic"]


@frozen(eq=True)
class Field:
    """What a triad senses: gravity, as accelerometers sense it, and what every other kind answers.

    Attributes
    ----------
    size, u : float or None, float
        Its size and standard uncertainty, in `size_unit`; None where it is not known: a gravity of
        one g, a magnetic field of one.
    size_unit : str
        'm/s^2', or of a magnetic field T, mT, uT, nT, G or mG.
    kind : str
        As files name it: 'gravity' or 'magnetic'.
    sensor, quantity, symbol : str
        What senses it, what a sensor gives of it, and what columns call a component of that.
    towards, angle : str
        What a direction is of, 'up' or 'field', and what compensated columns give beside the
        vector: 'tilt' or 'heading'.
    nominal_unit : str
        The unit of the reference that a nominal conversion is in.
    same_everywhere : bool
        Whether its size is the same at every place, but for a part in a hundred.
    in_c : str
        What the result is called in C.
    beyond : tuple of float
        Larger sizes that a sensor at work meets.
    """

    size: float | None = None
    u: float = 0.0
    size_unit: str = "m/s^2"

    kind: ClassVar[FieldKind] = "gravity"
    sensor: ClassVar[str] = "Accelerometer"
    quantity: ClassVar[str] = "force"
    symbol: ClassVar[str] = "f"
    towards: ClassVar[str] = "up"
    angle: ClassVar[str] = "tilt"
    nominal_unit: ClassVar[str] = "g"
    same_everywhere: ClassVar[bool] = True
    in_c: ClassVar[str] = "accel"
    beyond: ClassVar[tuple[float, ...]] = (2.0, 5.0)

    @property
    def value(self) -> float:
        """The size, as equations (1) take it."""
        return 1.0 if self.size is None else self.size

    @property
    def magnitude(self) -> float:
        """The size of the reference, in `unit`."""
        return gravity_ratio(self.size)

    @property
    def full_scale(self) -> float:
        """The size that percentages are of: one g, or the magnetic field itself."""
        return 1.0

    @property
    def unit(self) -> str:
        """The unit of the reference: g, that of the size, or none."""
        return "g"

    @property
    def printed(self) -> str:
        """The unit of the reference for tables, 1 where it has none."""
        return self.unit or "1"

    @property
    def relative(self) -> "Field":
        """The field of size one that one of stated size is relative to; gravity is in g."""
        return self

    @property
    def text(self) -> str:
        """Its size in words."""
        if self.size is None:
            return "local, one g"
        return f"{self.size:.10g} {self.size_unit}, u = {self.u:.3g} {self.size_unit}"

    def vector(self, convention: str) -> str:
        """Return what the compensated vector is called under a convention."""
        return "specific force" if convention == "specific-force" else "gravity"

    def lines(self, convention: str) -> list[tuple[str, str]]:
        """Return what a summary says of the field: names and values."""
        return [("convention", convention), ("gravity", self.text)]

    def shown(self, size: float, form: str = "", unit: str = "") -> str:
        """Return a size in the unit of the reference as people read it, 2 mg, 120 nT or .3 %.

        A size of force is given in a form and a unit, mg or µg, where a table has one.
        """
        return f"{_PER_G[unit] * size:{form}} {unit}" if unit else in_unit(size, self.unit)

    def worded(self, text: str) -> str:
        """Return a sentence about accelerometers as it is said of a sensor of the field."""
        return text

    def row(self, position: str) -> str:
        """Return what a row of readings is called, given what its position is."""
        return position

    def level_angle(self, size: float) -> str:
        """Return the tilt near level that a size of force [g] is; of other fields nothing."""
        return in_unit(math.degrees(size), "deg")

    def zero(self, force: Any, reading: Any) -> Any:
        """Return what states the zero of an output: its offset as a force, or as a reading."""
        return force

    def stated(self) -> dict[str, Any]:
        """Return the options of a bench, as `multipos.fit` takes them, that state its size."""
        return {"field": self.kind, "gravity": self.size}

    @property
    def of_gravity(self) -> dict[str, Any] | None:
        """What a calibration file says of gravity; None where it has no stated size."""
        return None if self.size is None else {"value": self.size, "u": self.u}

    @property
    def of_field(self) -> dict[str, Any] | None:
        """What a calibration file says of another field; None of gravity."""
        return None


@frozen(eq=True)
class MagneticField(Field):
    """A magnetic field, as magnetometers sense it."""

    size_unit: str = "uT"

    kind = "magnetic"
    sensor = "Magnetometer"
    quantity = "field"
    symbol = "b"
    towards = "field"
    angle = "heading"
    nominal_unit = "uT"
    same_everywhere = False
    in_c = "field"
    beyond = ()

    @property
    def magnitude(self) -> float:
        """The size of the reference, in `unit`."""
        return self.value

    @property
    def full_scale(self) -> float:
        """The magnetic field itself."""
        return self.value

    @property
    def unit(self) -> str:
        """The unit of the reference: that of the size, none where it is not known."""
        return "" if self.size is None else self.size_unit

    @property
    def relative(self) -> Field:
        """The field of size one."""
        return self if self.size is None else MAGNETIC

    @property
    def text(self) -> str:
        """Its size in words."""
        return "size unknown, taken as one" if self.size is None else super().text

    def vector(self, convention: str) -> str:
        """Return what the compensated vector is called."""
        return "magnetic field"

    def lines(self, convention: str) -> list[tuple[str, str]]:
        """Return the size; a magnetic field has no convention."""
        return [("field", self.text)]

    def shown(self, size: float, form: str = "", unit: str = "") -> str:
        """Return a size in its unit, in percent of a field of size one."""
        return in_unit(size, self.unit) if self.unit else f"{100.0 * size:.3g} %"

    def worded(self, text: str) -> str:
        """Return a sentence as it is said of a magnetometer.

        Sizes in g are those of the relative field.
        """
        text = text.replace("−1 g to +1 g", "the field's range")
        text = _SIZE.sub(lambda m: f"{_PERCENT[m[2]] * float(m[1]):.3g} % of the field", text)
        for pattern, new in _words():
            text = pattern.sub(new, text)
        return text

    def row(self, position: str) -> str:
        """Return 'reading', however it was held."""
        return "reading"

    def level_angle(self, size: float) -> str:
        """Return nothing: a field's direction is not level."""
        return ""

    def zero(self, force: Any, reading: Any) -> Any:
        """Return hard iron, which is of the readings."""
        return reading

    def stated(self) -> dict[str, Any]:
        """Return the options that state its size."""
        size = None if self.size is None else f"{self.size}{self.size_unit}"
        return {"field": self.kind, "field_size": size}

    @property
    def of_gravity(self) -> None:
        """Nothing: a calibration file says this of gravity."""

    @property
    def of_field(self) -> dict[str, Any] | None:
        """What a calibration file says of the field."""
        unit = self.size_unit if self.size is not None else None
        return {"kind": self.kind, "size": self.size, "u": self.u, "unit": unit}


def field_of_file(
    of_gravity: Mapping[str, Any] | None, of_field: Mapping[str, Any] | None = None
) -> Field:
    """Return the field that a calibration file states: gravity where it says nothing of one."""
    if of_field is not None:
        kind = KINDS[of_field["kind"]]
        return kind(of_field["size"], of_field["u"], of_field["unit"] or kind().size_unit)
    return GRAVITY if of_gravity is None else Field(of_gravity["value"], of_gravity["u"])


def field_sensed(outputs: Sequence[str], unit: str, asked: str | None = None) -> Field:
    """Return the field of unstated size that outputs sense, by what is asked, unit and names."""
    return KINDS[field_of_outputs(outputs, unit, None, asked)]()


KINDS: dict[str, type[Field]] = {each.kind: each for each in (Field, MagneticField)}
GRAVITY = Field()
MAGNETIC = MagneticField()
POWERS = {"T": 0, "mT": -3, "uT": -6, "nT": -9, "G": -4, "mG": -7}  # of ten, in tesla
_PER_G = {"mg": 1e3, "µg": 1e6}


# What is said of force in the sentences of all sensors, and what that is of a magnetic field; the
# option --force, names in braces and what stands in quotes stay.
@cache
def _words() -> tuple[tuple[re.Pattern[str], str], ...]:
    words = packaged_pairs(__file__, "magnetic_words.csv")
    return tuple((re.compile(rf"(?<![\w-]){old}(?!\w|\.\w)"), new) for old, new in words.items())


_PERCENT = {"g": 100.0, "mg": 0.1, "µg": 1e-4}  # of a relative field
_SIZE = re.compile(r"(?<![\w.])([-+]?[\d.]+(?:e[-+]?\d+)?) (mg|µg|g)(?![\w/^])")


def check_field_kind(kind: str | None) -> None:
    """Refuse a kind of field that is none."""
    if kind is not None and kind not in KINDS:
        raise UsageError(f"--field takes gravity or magnetic, got '{kind}'.")


def in_tesla(unit: str) -> float | None:
    """Return a unit of magnetic fields in tesla, None of any other."""
    return 10.0 ** POWERS[unit] if unit in POWERS else None


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

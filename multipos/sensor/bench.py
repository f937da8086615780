"""What is stated of a bench: the field with its size, limits of its readings, the probability of U.

`StatedBench` holds the options as users give them; `local_gravity` and `field_of` make of them the
field that was sensed, `multipos.sensor.gravity.Field`, and refuse what contradicts. How a size with
its unit is read, such as 48.6uT, stands here alone.
"""

import math
import re
from collections.abc import Sequence
from numbers import Real
from typing import TypedDict

from multipos.errors import UsageError
from multipos.files.written_units import MAGNETIC_UNITS, unit_of
from multipos.numerics.arrays import LARGEST
from multipos.positions.headers import field_of_outputs
from multipos.results import frozen
from multipos.sensor.gravity import (
    GRAVITY,
    MAGNETIC,
    POWERS,
    Field,
    FieldKind,
    MagneticField,
    check_field_kind,
)
from multipos.units import normal_gravity


class BenchOptions(TypedDict, total=False):
    """The options of `multipos.fit` that state the bench."""

    gravity: float | None
    gravity_u: float | None
    latitude: float | None
    height: float | None
    field: FieldKind | None
    field_size: float | str | None
    field_size_u: float | str | None
    range: Sequence[float] | None
    confidence: float


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

    def __post_init__(self) -> None:
        """Refuse numbers that are none."""
        require_numbers(self, "gravity", "gravity_u", "latitude", "height", "confidence")

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
        check_field_kind(self.field)
        known = None if gravity is None else "gravity"
        return _STATED[field_of_outputs(outputs, unit, known, self.field)](self, unit, gravity)


def require_numbers(options: object, *names: str) -> None:
    """Refuse options that are given and are no numbers.

    Raises
    ------
    UsageError
    """
    for name in names:
        value = getattr(options, name)
        if value is not None and not isinstance(value, Real):
            raise UsageError(f"--{name.replace('_', '-')} takes a number, got {value!r:.40}.")


def _gravity(bench: StatedBench, unit: str, gravity: Field | None) -> Field:
    """Return the gravity that is stated; one g without a size."""
    if bench.field_size is not None or bench.field_size_u is not None:
        raise UsageError(
            "--field-size is of a magnetic field; give --field magnetic, or the local "
            "gravity with --gravity."
        )
    return gravity or GRAVITY


def _magnetic_field(bench: StatedBench, unit: str, gravity: Field | None) -> Field:
    """Return the magnetic field that is stated, of size one where it is not."""
    size, size_u = bench.field_size, bench.field_size_u
    if gravity is not None:
        raise UsageError(
            "--gravity and --latitude are of accelerometers; a magnetic field has --field-size."
        )
    if size is None:
        if size_u is not None:
            raise UsageError("--field-size-u needs --field-size.")
        return MAGNETIC
    value, own = _quantity(size, "--field-size", unit)
    if not 0.0 < value <= LARGEST:
        raise UsageError(f"--field-size must be above 0, such as 48.6uT, got {size}.")
    if size_u is None:
        return MagneticField(value, 0.0, own)
    u, other = _quantity(size_u, "--field-size-u", unit)
    u *= 10.0 ** (POWERS[other] - POWERS[own])
    if not 0.0 <= u < value:
        raise UsageError(f"--field-size-u must be 0 or more and below the size, got {size_u}.")
    return MagneticField(value, u, own)


_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\D*)\s*")


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


_STATED = {"gravity": _gravity, "magnetic": _magnetic_field}  # by kind, from the options

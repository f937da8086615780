"""The names of columns: the units in their brackets, what they measure, and along which axis.

A header may carry units, ``ax (m/s^2)`` or ``Time [ms]``; what is in the brackets is one only where
it is known as such: in ``accelerometer_m_s2[0]`` it is a number. A name that ends in x, y or z,
or in a number in brackets, is a component of what stands before it.
"""

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from multipos.numerics.terms import COMPONENTS

# As a header may write a unit, without blanks and in small letters, and as it is called here.
_WRITTEN = {
    "m/s^2": "m/s^2 m/(s^2) m/s2 m/s² m/s/s m/s**2 ms-2 ms^-2 m*s^-2 m·s⁻² ms⁻² m/sec^2 m_s2 mps2",
    "g": "g gs gn g0 gee",
    "mg": "mg",
    "ug": "ug µg μg",
    "count": "count counts lsb adc digit digits raw",
    "V": "v volt volts",
    "mV": "mv",
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millis millisecond milliseconds",
    "us": "us µs μs usec micros microsecond microseconds",
    "ns": "ns nsec nanos nanosecond nanoseconds",
    "deg/s": "deg/s °/s dps deg/sec",
    "rad/s": "rad/s rad/sec",
    "deg": "deg ° degree degrees",
    "rad": "rad",
    "°C": "°c c degc deg_c celsius ℃",
    "K": "k",
    "uT": "ut µt μt",
    "G": "gauss",
    "hPa": "hpa mbar",
    "Pa": "pa",
    "Hz": "hz",
    "m": "m",
    "m/s": "m/s",
    "%": "%",
}
UNITS = {written: unit for unit, all_ in _WRITTEN.items() for written in all_.split()}
_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(]\s*([^\[\]()]+?)\s*[\])]")
_COMPONENT = re.compile(
    r"(.*?)[\s_.\-]*(?:([xyz])|\[([0-2])\])((?:_(?:cal|uncal|raw))?)", re.IGNORECASE
)
_ACCELERATION = re.compile(r"(.* )?a|[a-z ]*acc([^a-z].*|el.*)?|[a-z ]*acceleration.*|acc[a-z]?raw")
_ELSEWHERE = re.compile(
    r"(.* )?[gwmbh]|omega|[a-z ]*(gyr|mag|rate|rot|angular|velocity|field|gravity|orient|quat).*"
)
_WITHOUT_GRAVITY = re.compile(r".*(free|user) ?acc.*")


def unit_of(written: str) -> str | None:
    """Return the unit that a text is, None where it is none that is known."""
    return UNITS.get(written.replace(" ", "").casefold())


def split_unit(name: str) -> tuple[str, str | None]:
    """Return a name without the unit in brackets behind it, and the unit."""
    found = _BRACKETS.fullmatch(name)
    unit = unit_of(found[2]) if found else None
    return (found[1], unit) if found and unit and found[1] else (name, None)


class NameParts(NamedTuple):
    """A name cut into what it measures and along which axis."""

    stem: str
    axis: int  # -1 where it names none
    acceleration: bool
    elsewhere: bool  # another sensor


def component(name: str) -> NameParts:
    """Return a name cut into its parts."""
    found = _COMPONENT.fullmatch(name)
    stem, axis = (name, -1) if found is None else (found[1], _axis(found[2] or found[3]))
    plain = re.sub(r"[^a-z]+", " ", stem.casefold()).strip()
    acceleration = _ACCELERATION.fullmatch(plain) is not None
    return NameParts(
        stem if found is None else f"{stem}{found[4]}",
        axis,
        acceleration and axis >= 0 and not _WITHOUT_GRAVITY.fullmatch(plain),
        not acceleration and _ELSEWHERE.fullmatch(plain) is not None,
    )


def _axis(written: str) -> int:
    return int(written) if written.isdigit() else "xyz".index(written.casefold())


def triads_of(names: Sequence[str], kinds: Mapping[str, NameParts]) -> list[tuple[str, ...]]:
    """Return the triads among the names, each in the order x, y, z."""
    by_stem: dict[str, dict[int, str]] = {}
    for name in names:
        if kinds[name].axis >= 0:
            by_stem.setdefault(kinds[name].stem.casefold(), {})[kinds[name].axis] = name
    return [tuple(axes[i] for i in range(3)) for axes in by_stem.values() if len(axes) == 3]


@lru_cache(maxsize=64)
def axes_by_name(outputs: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the axis that each output names, where all name one; else None.

    One output names its axis where it is of acceleration by its name; several have one prefix in
    common, or make complete triads.
    """
    kinds = {name: component(name) for name in outputs}
    axes = [each.axis for each in kinds.values()]
    if not axes or min(axes) < 0:
        return None
    named = tuple(COMPONENTS[axis] for axis in axes)
    if len(outputs) == 1:
        return named if kinds[outputs[0]].acceleration else None
    return named if _is_one_sensor(kinds) or _are_triads(kinds) else None


def _is_one_sensor(kinds: Mapping[str, NameParts]) -> bool:
    """Tell whether names have one stem, and no axis twice."""
    axes = {each.axis for each in kinds.values()}
    return len({each.stem.casefold() for each in kinds.values()}) == 1 and len(axes) == len(kinds)


def _are_triads(kinds: Mapping[str, NameParts]) -> bool:
    """Tell whether names make several triads, and none is left."""
    whole = triads_of(tuple(kinds), kinds)
    return len(whole) > 1 and 3 * len(whole) == len(kinds)


def named_axes(outputs: Sequence[str]) -> list[int]:
    """Return the axis, 0 to 2, that each output names, where all do; else in order."""
    named = axes_by_name(tuple(outputs))
    return [*range(len(outputs))] if named is None else [COMPONENTS.index(axis) for axis in named]

"""The names of a log's columns: their units, the axes they sense, and which are outputs.

A header may carry units, ``ax (m/s^2)`` or ``Time [ms]``; what is in the brackets is one only where
it is known as such: in ``accelerometer_m_s2[0]`` it is a number. The outputs are the columns that
a log names as acceleration, where it names other sensors beside them.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from multipos.errors import MultiposError, UsageError
from multipos.logs.gravity import triad_of_gravity
from multipos.logs.table import Log
from multipos.positions.reading_tables import is_environment

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


def name_columns(
    source: str, header: Sequence[str] | None, width: int, given: Sequence[str] | None
) -> tuple[str, ...]:
    """Return the names of the columns: as given, by the header, or 1, 2, 3, ….

    A column that the header leaves without a name has its number.

    Raises
    ------
    UsageError
        Not as many names are given as there are columns.
    MultiposError
        A name appears twice.
    """
    if given is not None:
        if len(given) != width:
            raise UsageError(
                f"--columns names {len(given)} columns, but {source} has {width}; name each."
            )
        header = given
    names = tuple(name or str(i + 1) for i, name in enumerate(header or [""] * width))
    for i, name in enumerate(names):
        if name in names[:i]:
            raise MultiposError(
                f"{source}: column '{name}' appears twice; rename one or give --columns."
            )
    return names


class Named(NamedTuple):
    """The columns of a log: their names, without units, and how the header has them."""

    columns: tuple[str, ...]
    header: tuple[str, ...]
    nameless: frozenset[str]
    headless: bool


def name_header(
    source: str, header: Sequence[str] | None, width: int, given: Sequence[str] | None
) -> Named:
    """Return the columns that a header names, units in brackets aside, or those given for it.

    Raises
    ------
    UsageError, MultiposError
        As of `name_columns`.
    """
    if given is not None or header is None:
        columns = name_columns(source, None, width, given)
        return Named(columns, columns, frozenset(), given is None)
    bare = [split_unit(name)[0] for name in header]
    unlike = len(set(bare)) == len(bare)  # else the units tell the columns apart
    columns = name_columns(source, bare if unlike else header, width, None)
    pairs = list(zip(columns, header, strict=True))
    nameless = frozenset(name for name, cell in pairs if not cell)
    return Named(columns, tuple(cell or name for name, cell in pairs), nameless, False)


class _Component(NamedTuple):
    """A name cut into what it measures and along which axis."""

    stem: str
    axis: int  # -1 where it names none
    acceleration: bool
    elsewhere: bool  # another sensor


def _component(name: str) -> _Component:
    found = _COMPONENT.fullmatch(name)
    stem, axis = (name, -1) if found is None else (found[1], _axis(found[2] or found[3]))
    plain = re.sub(r"[^a-z]+", " ", stem.casefold()).strip()
    acceleration = _ACCELERATION.fullmatch(plain) is not None
    return _Component(
        stem if found is None else f"{stem}{found[4]}",
        axis,
        acceleration and axis >= 0 and not _WITHOUT_GRAVITY.fullmatch(plain),
        not acceleration and _ELSEWHERE.fullmatch(plain) is not None,
    )


def _axis(written: str) -> int:
    return int(written) if written.isdigit() else "xyz".index(written.casefold())


def named_axes(outputs: Sequence[str]) -> list[int]:
    """Return the axis, 0 to 2, that each output names, where all do and alike; else in order."""
    found = [_component(name) for name in outputs]
    axes = [each.axis for each in found]
    alike = len({each.stem.casefold() for each in found}) == 1
    if alike and min(axes) >= 0 and len(set(axes)) == len(axes):
        return axes
    return list(range(len(outputs)))


class Outputs(NamedTuple):
    """The columns that are outputs, and what is to be said of the choice."""

    names: tuple[str, ...]
    notes: tuple[str, ...]


def choose_outputs(log: Log, given: Sequence[str] | None, clocks: Sequence[str]) -> Outputs:
    """Return the outputs of a log: as given, or by their names.

    Parameters
    ----------
    log : Log
    given : names, optional
    clocks : names
        Columns that tell the time, or a label.

    Raises
    ------
    MultiposError
        There is no such column, none can be an output, or one that is named as one holds text.
    UsageError
        More than three could be.
    """
    if given is not None:
        return Outputs(tuple(map(log.find, given)), ())
    apart = {*clocks, *log.nameless, *filter(is_environment, log.numeric)}
    names = [name for name in log.numeric if name not in apart]
    kinds = {name: _component(name) for name in log.columns}
    chosen, by = _by_name(names, kinds), "their names"
    if len(chosen) > 3 and log.headless:
        chosen, by = triad_of_gravity(log, chosen) or chosen, "what they show of gravity"
    _refuse_text(log, chosen, kinds)
    if not chosen:
        raise MultiposError(f"{log.source}: no numeric column can be an output; see --columns.")
    if len(chosen) > 3:
        raise UsageError(
            f"{log.source}: {len(chosen)} columns could be outputs: {', '.join(chosen)}; name "
            "them with --outputs."
        )
    return Outputs(chosen, _said(chosen, names, by))


def _by_name(names: Sequence[str], kinds: dict[str, _Component]) -> tuple[str, ...]:
    """Return the outputs among numeric columns: the triad of acceleration, where there is one."""
    named = [name for name in names if kinds[name].acceleration]
    triads = _triads(named, kinds)
    if len(triads) == 1:
        return triads[0]
    if triads or (named and any(kinds[name].elsewhere for name in names)):
        return tuple(named)
    whole = _triads(names, kinds) if len(names) == 3 else []
    return whole[0] if whole else tuple(names)


def _triads(names: Sequence[str], kinds: dict[str, _Component]) -> list[tuple[str, ...]]:
    """Return the triads among the names, each in the order x, y, z."""
    by_stem: dict[str, dict[int, str]] = {}
    for name in names:
        if kinds[name].axis >= 0:
            by_stem.setdefault(kinds[name].stem.casefold(), {})[kinds[name].axis] = name
    return [tuple(axes[i] for i in range(3)) for axes in by_stem.values() if len(axes) == 3]


def _refuse_text(log: Log, chosen: Sequence[str], kinds: dict[str, _Component]) -> None:
    stems = {kinds[name].stem.casefold() for name in chosen if kinds[name].axis >= 0}
    for name in log.columns:
        kind = kinds[name]
        if name not in log.numeric and kind.axis >= 0 and kind.stem.casefold() in stems:
            raise MultiposError(
                f"{log.source}: column '{name}' is an output by its name, but holds no number in "
                "its first rows; correct it, or name the outputs with --outputs."
            )


def _said(chosen: tuple[str, ...], names: Sequence[str], by: str) -> tuple[str, ...]:
    notes = []
    others = [name for name in names if name not in chosen]
    if others:
        notes.append(
            f"outputs are {', '.join(chosen)}, by {by}; {', '.join(others)} beside them "
            f"{'is no output' if len(others) == 1 else 'are none'}"
        )
    elif [name for name in names if name in chosen] != list(chosen):
        notes.append(f"outputs are taken in the order {', '.join(chosen)}, by their names")
    return tuple(notes)

"""What a header says: units in its brackets, what a column measures, and along which axis.

`component` cuts a name into what it measures and its axis; `triads_of`, `axes_by_name` and
`named_axes` find axes among several, `is_beside`, `is_environment`, `is_without_gravity` and
`idle_columns` what is no output, `field_of_outputs` which field is sensed.
`plain_names`, `under_names` and `find_column` match columns with names; `with_first_named`,
`with_direction`, `with_angle`, `from_level` and `in_plane` give a table the columns that its own
stand for.
`unit_as_known`, `unit_of_outputs`, `in_celsius` and `require_units` keep units consistent,
`unused_columns` and `find_others` say what is left out, which `refuse_text` refuses of some.

A name that ends in x, y or z, or in a number in brackets, is a component of what stands before
it. Outputs are in the unit that their header says. A column in a unit of temperature, time
or pressure is about the surroundings and no output. Temperatures are in degrees Celsius everywhere;
a header in kelvin is taken as such, and

    t/°C = T/K − 273.15.                                                                    (1)
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import listed, packaged_pairs
from multipos.files.tables import Column, Table
from multipos.files.written_units import MAGNETIC_UNITS, PER_G, split_unit, unit_of
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.positions import attitudes
from multipos.positions.forces import FORCE, REFERENCE_U
from multipos.units import cos_deg, sin_deg

_COMPONENT = re.compile(
    r"(.*?)[\s_.\-]*(?:([xyz])|\[([0-2])\])((?:_(?:cal|uncal|raw))?)", re.IGNORECASE
)
_ACCELERATION = re.compile(
    r"(.* )?ac?|[a-z ]*acc([^a-z].*|el.*)?|[a-z ]*acceleration.*|acc([a-z]?raw|smooth)"
)
_ELSEWHERE = re.compile(
    r"(.* )?[gwmbh]|omega|[a-z ]*(gyr?|mag|rate|rot|angular|velocity|field|gravity|orient|quat).*"
)
_MAGNETIC = re.compile(r"(.* )?m|[a-z ]*(mag|field|compass).*")
_FOREIGN = packaged_pairs(__file__, "foreign_names.csv")
# What stands beside a triad of acceleration and is none: counters, times, surroundings.
_BESIDE = re.compile(
    r"(soak|run|cycle|chamber|lage|pos(ition)?|unit|nr|no|num|id|i|n|index|row|step|count(er)?|date"
    r"|t|time.*|.*time|timestamp.*|temp.*|.*temp|位置|序号|编号|时间|温度)",
    re.IGNORECASE,
)
_WITHOUT_GRAVITY = re.compile(r".*(free|user) ?acc.*")
_LINEAR = re.compile(r"linear acceleration", re.IGNORECASE)  # of phyphox; ROS writes linear_acc…


class NameParts(NamedTuple):
    """A name cut into what it measures and along which axis."""

    stem: str
    axis: int  # -1 where it names none
    acceleration: bool
    elsewhere: bool  # another sensor
    magnetic: bool = False


@lru_cache(1 << 16)  # asked of every column many times
def component(name: str) -> NameParts:
    """Return a name cut into its parts."""
    found = _COMPONENT.fullmatch(name)
    stem, axis = (name, -1) if found is None else (found[1], _axis(found[2] or found[3]))
    plain = stem.casefold()
    for foreign, english in _FOREIGN.items():
        plain = plain.replace(foreign, english)
    plain = re.sub(r"[^a-z]+", " ", plain).strip()
    acceleration = _ACCELERATION.fullmatch(plain) is not None
    return NameParts(
        stem if found is None else f"{stem}{found[4]}",
        axis,
        acceleration and axis >= 0 and not is_without_gravity(stem),
        not acceleration and _ELSEWHERE.fullmatch(plain) is not None,
        not acceleration and axis >= 0 and _MAGNETIC.fullmatch(plain) is not None,
    )


def is_without_gravity(stem: str) -> bool:
    """Tell whether a column is of acceleration from which gravity has been taken, by its name."""
    plain = re.sub(r"[^a-z]+", " ", stem.casefold()).strip()
    return bool(_LINEAR.fullmatch(stem) or _WITHOUT_GRAVITY.fullmatch(plain))


def field_of_outputs(
    outputs: Sequence[str], unit: str, stated: str | None, asked: str | None = None
) -> str:
    """Return what outputs sense, 'gravity' or 'magnetic', by what is asked, their unit and names.

    Parameters
    ----------
    outputs, unit
        Names of the outputs, and the unit of their readings.
    stated : str or None
        What other options are of, where names and unit say nothing else.
    asked : str or None
        By --field.

    Raises
    ------
    UsageError
        The unit is one of the other field.
    """
    kinds = [component(name) for name in outputs]
    magnetic = unit in MAGNETIC_UNITS
    if asked == "gravity" or (asked is None and any(kind.acceleration for kind in kinds)):
        if magnetic:
            gauss = ", which is gauss," if unit in ("G", "mG") else ""
            raise UsageError(
                f"the unit {unit}{gauss} is of a magnetic field; give accelerations in g, mg or "
                "m/s^2, or --field magnetic."
            )
        return "gravity"
    if asked == "magnetic":
        if unit in PER_G:
            raise UsageError(
                f"the unit {unit} is of accelerations; give --unit {', '.join(MAGNETIC_UNITS)} or "
                "count, or leave --field magnetic away."
            )
        return asked
    named = bool(kinds) and all(kind.magnetic for kind in kinds) and stated is None
    return "magnetic" if magnetic or (named and unit not in PER_G) else "gravity"


def is_beside(name: str) -> bool:
    """Tell whether a column beside named acceleration is none by its name."""
    return _BESIDE.fullmatch(name) is not None


def _axis(written: str) -> int:
    return int(written) if written.isdigit() else "xyz".index(written.casefold())


def triads_of(names: Sequence[str], kinds: Mapping[str, NameParts]) -> list[tuple[str, ...]]:
    """Return the triads among the names, each in the order x, y, z."""
    by_stem: dict[str, dict[int, str]] = {}
    for name in names:
        if kinds[name].axis >= 0:
            by_stem.setdefault(kinds[name].stem.casefold(), {})[kinds[name].axis] = name
    return [tuple(axes[i] for i in range(3)) for axes in by_stem.values() if len(axes) == 3]


def idle_columns(
    names: Sequence[str],
    kinds: Mapping[str, NameParts],
    values: Callable[[Sequence[str]], Iterable[Array]],
) -> list[str]:
    """Return columns that only count rows, or never change, beside others that may be outputs.

    Parameters
    ----------
    names : sequence of str
    kinds : mapping of str to NameParts
    values : callable
        Gives the cells (n,) of columns.
    """
    stems = {name[:-1].casefold() for name in names if kinds[name].axis >= 0}
    open_ = [n for n in names if kinds[n].axis < 0 and n[:-1].casefold() not in stems]
    if not open_ or (not stems and len(names) <= len(COMPONENTS)):
        return []
    idle = [n for n, cells in zip(open_, values(open_), strict=True) if _is_idle(cells)]
    return idle if len(idle) < len(names) else []


def _is_idle(values: Array) -> bool:
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 1 and steps[0] in (0.0, 1.0) and bool((steps == steps[0]).all())


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


# Columns of a readings file that have a meaning of their own and are no outputs.
TEMPERATURE = "temperature"
RESERVED = attitudes.COLUMNS | {"position", "n", "orientation_sd_deg", "group", *REFERENCE_U}
OF_SURROUNDINGS = frozenset({"K", "°C", "s", "ms", "us", "ns", "hPa", "Pa", "Hz", "%"})
_WITH_LABEL = 4  # columns of a table without names: a label or time, and three outputs
_NOTED = 12  # columns not used that have a note each
_KELVIN = "K"
_ZERO = 273.15  # [K] at 0 °C


def plain_names(table: Table) -> tuple[Table, dict[str, str]]:
    """Return a table whose names have no unit in brackets and known names their own case.

    Returns
    -------
    (Table, {column: unit})
    """
    bare = {name: split_unit(name) for name in table.columns}
    if len({name for name, _ in bare.values()}) < len(bare):
        bare = {name: (name, None) for name in table.columns}  # the units tell columns apart
    known = _own_case([name for name, _ in bare.values()])
    renamed, units = {}, {}
    for name, (written, unit) in bare.items():
        plain = known[written]
        renamed[plain] = table.columns[name]
        if unit is not None:
            units[plain] = unit
    return _in_one_unit(*_in_degrees(replace(table, columns=renamed), units))


def _in_one_unit(table: Table, units: dict[str, str]) -> tuple[Table, dict[str, str]]:
    """Return a table whose uncertainties are in the unit of what they are of."""
    columns = dict(table.columns)
    for name in [*units]:
        prefix, _, own = name.partition("_")
        wanted = "g" if name in REFERENCE_U else units.get(own) if prefix in ("u", "sd") else None
        if wanted is None or units[name] == wanted:
            continue
        if not {units[name], wanted} <= {*PER_G}:
            said = f"'{name}' is in {units[name]} by its header, and '{own}' in {wanted}"
            raise MultiposError(f"{table.source}: {said}; give both in one unit.")
        columns[name] = table.number(name, empty=True) * (PER_G[wanted] / PER_G[units[name]])
        del units[name]
    return replace(table, columns=columns), units


_ANGLES = {name.removesuffix("_deg"): name for name in attitudes.COLUMNS if name.endswith("_deg")}


def _in_degrees(table: Table, units: dict[str, str]) -> tuple[Table, dict[str, str]]:
    """Return a table whose angles, `Roll [deg]` or `pitch [rad]`, have their own names and unit."""
    columns = dict[str, Column]()
    for name, column in table.columns.items():
        own = name if name.endswith("_deg") else _ANGLES.get(name.casefold(), "")
        taken = own != name and own in table
        if not own or taken or units.get(name) not in ("deg", "rad"):
            columns[name] = column
        else:
            columns[own] = column if units.pop(name) == "deg" else np.degrees(table.number(name))
    return replace(table, columns=columns), units


def under_names(table: Table, wanted: Iterable[str]) -> tuple[Table, dict[str, str]]:
    """Return a table whose columns have the names that are wanted, and its units in brackets.

    A column answers to a name whatever its case and the unit behind it, where it alone does.
    """
    there = {found: name for name in wanted if (found := find_column(table, name)) in table}
    units = {name: unit for found, name in there.items() if (unit := split_unit(found)[1])}
    return table.renamed(there), units


def with_first_named(table: Table) -> Table:
    """Return a table without names whose first of four columns counts rows, or goes up, as such."""
    if [*table.columns] != [str(i + 1) for i in range(_WITH_LABEL)]:
        return table
    steps = np.diff(table.numbers("1"))
    if not len(steps) or not (steps > 0.0).all():
        return table
    name = "position" if (steps == 1.0).all() else "time"
    return table.renamed({"1": name})


def with_angle(table: Table) -> Table:
    """Return a table whose column `angle`, where it alone tells the position, is `angle_deg`."""
    stated = (*attitudes.COLUMNS, *FORCE)
    folded = {name.casefold(): name for name in table.columns}
    if "angle" not in folded or any(name in table for name in stated):
        return table
    return table.renamed({folded["angle"]: "angle_deg"})


def from_level(table: Table) -> Table:
    """Return a table whose angles, counted from level, are counted from up."""
    if "angle_deg" not in table:
        raise UsageError(f"{table.source}: --angle-zero is of tables with a column angle_deg.")
    angles = 90.0 - table.number("angle_deg", empty=True)
    return replace(table, columns={**table.columns, "angle_deg": angles})


def in_plane(table: Table, outputs: Sequence[str]) -> tuple[Table, tuple[str, ...]]:
    """Return a table whose angles are a roll, and the two axes that turn in it; () of any other.

    Angles t alone, of one or two outputs, turn about the axis that is missing: the first output
    senses cos t, the second sin t.
    """
    if "angle_deg" not in table or "roll_axis" in table or len(outputs) > 2:
        return table, ()
    first, *rest = named_axes(outputs)
    second = rest[0] if rest else (first + 1) % len(COMPONENTS)
    plane = tuple(sorted((COMPONENTS[first], COMPONENTS[second])))
    columns = dict(table.columns)
    if first < second:
        missing = next(axis for axis in COMPONENTS if axis not in plane)
        columns["roll_axis"] = [missing] * table.rows
    else:
        angles = table.number("angle_deg")
        del columns["angle_deg"]
        up = np.zeros((table.rows, len(COMPONENTS)))
        up[:, first], up[:, second] = cos_deg(angles), sin_deg(angles)
        columns |= dict(zip(attitudes.UP, up.T, strict=True))
    return replace(table, columns=columns), plane


def with_direction(table: Table) -> Table:
    """Return a table in which the first column of text whose cells are all directions is one.

    A column ``position`` stays the label of its rows as well.
    """
    stated = (*attitudes.COLUMNS, *FORCE)
    if any(name in table for name in stated):
        return table
    for name in table.columns:
        if component(name).acceleration or not table.is_text(name):
            continue
        if attitudes.are_directions(table.unchecked(name)):
            turned, labels = table.renamed({name: "direction"}), {"position": table.columns[name]}
            known = "position" in table and name != "position"
            return turned if known else replace(turned, columns=labels | dict(turned.columns))
    return table


def _own_case(names: Sequence[str]) -> dict[str, str]:
    """Return names as they are known here; those that differ in case alone stay as written."""
    known = {name.casefold(): name for name in (*RESERVED, TEMPERATURE, "time")}
    if "time" not in map(str.casefold, names):
        known["zeit"] = "time"
    known |= _forces(names)
    if "position" not in map(str.casefold, names):
        known |= {"lage": "position", "位置": "position"}
    beside = {f"{p}_{name}".casefold(): f"{p}_{name}" for p in ("u", "sd") for name in names}
    folded = Counter(name.casefold() for name in names)

    def own(name: str) -> str:
        if folded[name.casefold()] > 1:
            return name
        return known.get(name.casefold()) or beside.get(name.casefold()) or _as_environment(name)

    return {name: own(name) for name in names}


def _forces(names: Sequence[str]) -> dict[str, str]:
    """Return what f_x, f_y, f_z are called here, where named acceleration stands beside them."""
    folded = {name.casefold() for name in names}
    called = {text: name for name in FORCE for text in (name, name.replace("_", ""))}
    called = {text: name for text, name in called.items() if text in folded}
    if sorted(called.values()) != sorted(FORCE):
        return {}
    beside = (component(name) for name in names if name.casefold() not in called)
    return called if any(each.acceleration for each in beside) else {}


def _as_environment(name: str) -> str:
    """Return a name of the surroundings in small letters, where it is one in any."""
    folded = name.casefold()
    return folded if is_environment(folded) and not is_environment(name) else name


def find_column(table: Table, name: str) -> str:
    """Return the name that a column has, whatever the case and the unit it is asked for with."""
    if name in table:
        return name
    folded = split_unit(name)[0].casefold()
    equal = [own for own in table.columns if split_unit(own)[0].casefold() == folded]
    return equal[0] if len(equal) == 1 else name


def unused_columns(texts: Iterable[str], idle: Iterable[str] = ()) -> list[Finding]:
    """Return a note of each column that is not used; of many, of a dozen and how many there are.

    Of columns that are `idle` their names suffice.
    """
    said = (f"column '{name}' counts rows or never changes and is not used" for name in idle)
    every = [*texts, *said]
    if len(every) > _NOTED + 1:
        every[_NOTED:] = [f"{len(every) - _NOTED} more columns are not used"]
    return [Finding("unused-column", "note", text) for text in every]


def refuse_text(
    source: str, chosen: Sequence[str], texts: Iterable[str], kinds: Mapping[str, NameParts]
) -> None:
    """Refuse columns of text of which one is an output by its name."""
    stems = {kinds[name].stem.casefold() for name in chosen if kinds[name].axis >= 0}
    for name in texts:
        kind = kinds[name]
        if kind.acceleration or (kind.axis >= 0 and kind.stem.casefold() in stems):
            raise MultiposError(
                f"{source}: column '{name}' is an output by its name, but holds no number; correct "
                "it, or name the outputs with --outputs."
            )


def find_others(chosen: Sequence[str], names: Sequence[str], by: str) -> list[Finding]:
    """Return a note of which columns are the outputs, where others might be."""
    others = [name for name in names if name not in chosen]
    if not others:
        return []
    whose = "is not used" if len(others) == 1 else "are not used"
    text = f"outputs are {', '.join(chosen)}, by {by}; {listed(others, 12)} {whose}"
    return [Finding("outputs-by-name", "note", text)]


def unit_as_known(unit: str) -> str:
    """Return a unit as it is called here: m/s2, mps2 and m/s**2 are m/s^2, µT is uT.

    Raises
    ------
    UsageError
        It is of mass, amount or light, which no such sensor puts out.
    """
    if unit in ("kg", "mol", "mmol", "cd", "lm", "lx"):
        raise UsageError(f"{unit} is of mass, amount or light; give the unit of the readings.")
    known = unit_of(unit)
    return known if known in (*PER_G, *MAGNETIC_UNITS) else unit


def unit_of_outputs(
    table: Table, names: tuple[str, ...], units: Mapping[str, str], stated: str | None
) -> str:
    """Return the unit of the outputs, of their header or as stated.

    Raises
    ------
    MultiposError
        The outputs differ in unit, or the header contradicts what is stated.
    """
    written = {name: units[name] for name in names if name in units}
    kinds = sorted(set(written.values()))
    if len(kinds) > 1:
        said = ", ".join(f"{name} in {unit}" for name, unit in written.items())
        raise MultiposError(f"{table.source}: outputs differ in unit, {said}; give them in one.")
    if stated is None:
        return kinds[0] if kinds else "reading"
    asked = unit_as_known(stated)
    if kinds and kinds[0] != asked and kinds[0] != unit_of(asked):
        given = f"{table.source}: the header gives column '{next(iter(written))}' in {kinds[0]}"
        raise MultiposError(f"{given}, and --unit states {stated}; correct one, or drop --unit.")
    return asked


TURN_RATE = "turn_rate"  # of rows of a log that never rests
RUN = "run"  # a label of rows between a switch-on, or a mounting, and the next
SOAKS = ("soak", RUN, "cycle", "chamber")  # beside a temperature: labels of stays at one


def is_environment(name: str) -> bool:
    """Tell whether a column is about the surroundings by its name."""
    surroundings = (TEMPERATURE, "time", "approach", "head_deg")  # the last, of a dividing head
    return name in surroundings or name.startswith(("ambient", "approach_")) or name[-5:] == "_rate"


def in_celsius(table: Table, units: Mapping[str, str], findings: list[Finding]) -> Table:
    """Return a table whose columns in kelvin, by their header, are in degrees Celsius; eq. (1)."""
    kelvin = [n for n, unit in units.items() if unit == _KELVIN and not table.is_text(n)]
    if not kelvin:
        return table
    texts = [f"column '{name}' is in K by its header; 273.15 was subtracted" for name in kelvin]
    findings += [Finding("kelvin", "note", text) for text in texts]
    moved = {name: table.number(name, empty=True) - _ZERO for name in kelvin}
    return replace(table, columns={**table.columns, **moved})


def require_units(
    source: str, units: Mapping[str, str], outputs: Sequence[str], columns: Sequence[str], unit: str
) -> None:
    """Refuse data whose header says another unit than a calibration is in.

    Parameters
    ----------
    source : str
        The data, for the message.
    units : mapping of str to str
        What the header says, by column.
    outputs, columns : sequences of str
        The outputs of the calibration, and the other columns that its model uses.
    unit : str
        That of its readings; where it is none that is known, no header contradicts it.

    Raises
    ------
    MultiposError
    """
    own = unit_of(unit)
    for name in outputs:
        if own is not None and units.get(name, own) != own:
            raise MultiposError(
                f"{source}: the header gives column '{name}' in {units[name]}, and the calibration "
                f"is in {unit}; convert the column, or take a calibration in its unit."
            )
    for name in columns:
        if units.get(name) == _KELVIN:
            raise MultiposError(
                f"{source}: the header gives column '{name}' in K, and the calibration takes "
                "degrees Celsius; subtract 273.15."
            )

"""Readings from tables: which columns are outputs, and what stands beside them.

A CSV file, a mapping of columns or a data frame; its columns are listed in
`docs/reference/formats`.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, listed, quoted, require_columns, split_names
from multipos.files.tables import Source, Table, read_table
from multipos.files.written_units import MAGNETIC_UNITS, PER_G
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array, Mask
from multipos.positions import attitudes, forces, headers
from multipos.positions.harmonics import find_level_zero
from multipos.positions.open_rolls import read_open_rolls, with_angles
from multipos.positions.readings import Readings, select_outputs


def read_readings(
    source: "Source | Readings",
    *,
    outputs: Names | None = None,
    unit: str | None = None,
    environment: Sequence[str] = (),
    field: str | None = None,
    angle_zero: attitudes.AngleZero = "up",
) -> Readings:
    """Return readings from whatever `multipos.read_table` takes.

    Parameters
    ----------
    source : path, open file, mapping of name to (n,) array, data frame, array, or Readings
    outputs : names, optional
        The columns that are outputs, of an array all; otherwise every numeric column without
        another meaning.
    unit : str, optional
        Unit of the readings, for names and reports.
    environment : names, optional
        Columns that are not outputs, beside those whose name says so.
    field : str, optional
        'gravity' or 'magnetic': which sensor's columns are the outputs where there are several,
        and what orientation columns are of; otherwise by names and unit.
    angle_zero : str
        'up' or 'level': how an output stands at `angle_deg` 0.

    Returns
    -------
    Readings

    Raises
    ------
    MultiposError
        A file that is missing, empty, ragged or holds a bad cell, which is named by file, row
        and column; an output that is not there.
    UsageError
        `angle_zero` is another word, or of a table without angles.

    Examples
    --------
    >>> import multipos as mp
    >>> columns = {"direction": ["E-U-S", "E-D-N"], "ay": [1.002, -0.998]}
    >>> columns["temperature"] = [21.5, 21.6]
    >>> readings = mp.read_readings(columns, unit="g")
    >>> readings.up.round(1).tolist()
    [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
    >>> readings.environment["temperature"]
    array([21.5, 21.6])
    """
    names = None if outputs is None else split_names(outputs, "--outputs")
    if isinstance(source, Readings):
        return _named_otherwise(source, names, unit, environment)
    table, units = headers.plain_names(read_table(source, what="readings", outputs=names))
    table = headers.with_angle(headers.with_direction(headers.with_first_named(table)))
    if angle_zero not in get_args(attitudes.AngleZero):
        raise UsageError(f"--angle-zero takes up or level, got '{angle_zero}'.")
    table = headers.from_level(table) if angle_zero == "level" else table
    _refuse_pairs(table)
    findings = [] if not table.read_as else [Finding("log-source", "note", table.read_as)]
    findings += _commented(table)
    names = None if names is None else tuple(headers.find_column(table, name) for name in names)
    if field != "gravity":
        table, names = _of_magnetic_field(table, names, units, unit, field)
    beside = [*environment, *_of_surroundings(units, names or (), environment, findings)]
    names = _outputs(table, names, beside, findings)
    table = headers.in_celsius(table, _used(units, names, environment), findings)
    spread = _orientation_sd(table)
    # what is an output is no position, whatever its name
    outputs_only = frozenset(names)
    others = {n: column for n, column in table.columns.items() if n not in outputs_only}
    free, plane = headers.in_plane(replace(table, columns=others), names)
    free = with_angles(free)
    rolls = read_open_rolls(free, findings)
    oriented, force, reference_u = _where_it_stood(free, units, spread, rolls, findings)
    columns = _environment(table, names, environment, findings)
    found = Readings(
        values=np.column_stack([table.number(name, largest=LARGEST) for name in names]),
        outputs=names,
        positions=table.text("position") if "position" in table else None,
        up=None if oriented is None else oriented.up,
        rotation=None if oriented is None else oriented.rotation,
        u=_beside(table, "u", names, findings),
        dof=_beside(table, "dof", names, findings),
        sd=_beside(table, "sd", names, findings),
        samples=nonnegative_column(table, "n", largest=LARGEST) if "n" in table else None,
        orientation_sd=spread,
        group=table.text("group") if "group" in table else None,
        force=force,
        reference_u=reference_u,
        environment=columns,
        unit=headers.unit_of_outputs(table, names, units, unit),
        source=None if table.sha256 is None else table.source,
        sha256=table.sha256,
        findings=tuple(findings),
        open_roll=rolls,
        plane=plane,
    )
    if angle_zero == "level" or "angle_deg" not in table:
        return found
    return replace(found, findings=(*found.findings, *find_level_zero(found)))


def _commented(table: Table) -> list[Finding]:
    """Name the lines that begin as comments and are like rows."""
    if not table.commented:
        return []
    lines = listed([*map(str, table.commented)], 6)
    text = f"line {lines} begins as a comment but is like a row, and is left out"
    return [Finding("commented-row", "warning", text, "Write its label without the mark.")]


_PAIR = re.compile(r"[+-]?\s*1\s*g", re.IGNORECASE)


def _refuse_pairs(table: Table) -> None:
    """Refuse a table of three axes, each at +1 g and −1 g: it has no other output's reading."""
    pairs = [name for name in table.columns if _PAIR.fullmatch(name.replace("−", "-"))]
    axes = {cell.casefold() for name in table.columns for cell in table.unchecked(name)}
    if len(pairs) != 2 or table.rows != len(COMPONENTS) or not axes >= {*COMPONENTS}:
        return
    name = Path(table.source).name
    raise MultiposError(
        f"{table.source}: three axes at +1 g and -1 g, one reading each; a fit needs every output "
        "in every position: write six rows under face,ax,ay,az, the first +X,AX,AY,AZ, and type "
        f"multipos fit {name}."
    )


def _of_magnetic_field(
    table: Table,
    names: tuple[str, ...] | None,
    units: Mapping[str, str],
    unit: str | None,
    field: str | None,
) -> tuple[Table, tuple[str, ...] | None]:
    """Return a magnetometer's table with the field's direction as up vectors, and its outputs.

    Any other table is returned as it is.

    Raises
    ------
    MultiposError
        Columns that say where up is, which is not where the field points.
    """
    apart = {*forces.OF_FIELD, *forces.FORCE, *headers.RESERVED}
    named = [n for n in table.columns if n not in apart and headers.component(n).magnetic]
    others = [n for n in table.columns if headers.component(n).acceleration]
    if field is None:
        kinds = {units.get(name) for name in names or named} | {headers.unit_as_known(unit or "")}
        shown = bool(kinds.intersection(MAGNETIC_UNITS)) and not others
        alone = len(named) == len(COMPONENTS) and not others
        if names is not None:
            alone = all(headers.component(name).magnetic for name in names)
        if not (shown or alone) or headers.unit_as_known(unit or "") in PER_G:
            return table, names
    whole = headers.triads_of(named, {name: headers.component(name) for name in named})
    if field == "magnetic" and names is None and len(whole) == 1:
        names = whole[0]
    kept = table.columns if names is None else {n for n in table.columns if n not in names}
    wrong = [n for n in attitudes.COLUMNS if n in kept and n not in attitudes.UP]
    if wrong:
        raise MultiposError(
            f"{table.source}: column {quoted(sorted(wrong))} states where up is, which is not "
            "where "
            "a magnetic field points; give its direction as b_x, b_y, b_z, or leave it out."
        )
    forms = [form for form in (forces.OF_FIELD, forces.FORCE) if all(name in kept for name in form)]
    if not forms or forces.left_by_apply(table) or any(name in kept for name in attitudes.UP):
        return replace(
            table, columns=_without(table, names, (*forces.OF_FIELD, *forces.FORCE))
        ), names
    renamed = dict(zip(forms[0], attitudes.UP, strict=True))
    columns = _without(table, names, () if len(forms) == 1 else forms[1])
    return replace(table, columns=columns).renamed(renamed), names


def _without(table: Table, outputs: tuple[str, ...] | None, names: Sequence[str]) -> dict[str, Any]:
    """Return the columns without some, outputs among them kept."""
    return {n: c for n, c in table.columns.items() if n not in names or n in (outputs or ())}


def _where_it_stood(
    free: Table,
    units: Mapping[str, str],
    spread: Array | None,
    rolls: tuple[str, ...] | None,
    findings: list[Finding],
) -> tuple[attitudes.Attitudes | None, Array | None, Array | None]:
    """Return attitudes, known forces and the uncertainty of the reference, as far as given.

    Parameters
    ----------
    free : Table
        Without the columns that are outputs.
    """
    rows = attitudes.rows_with_orientation(free)
    stated = forces.states_forces(free, rows)
    force = forces.read_forces(forces.in_standard_g(free, units), rows) if stated else None
    if force is not None:
        findings += forces.find_likely_m_s2(force, units)
    elif all(name in free for name in forces.FORCE):
        why = "were added by apply" if forces.left_by_apply(free) else "accompany an orientation"
        text = f"columns {quoted(forces.FORCE)} {why} and are not used as positions"
        findings.append(Finding("unused-column", "note", text))
    oriented = attitudes.read_attitudes(free, _without_attitude(free, spread, rolls, force))
    up = attitudes.FORMS["up vector"]
    if oriented is not None and up[0] in free:
        findings += forces.find_lengths(free, up)
    return oriented, force, forces.read_reference_u(free, force)


def _without_attitude(
    free: Table, spread: Array | None, rolls: tuple[str, ...] | None, force: Array | None
) -> Mask | None:
    """Return the rows (n,) that need no attitude: unknown, a roll of open angle, a known force."""
    open_ = None if rolls is None else np.array([axis != "" for axis in rolls])
    forced = None if force is None else forces.known_rows(force)
    if open_ is not None and forced is not None and (open_ & forced).any():
        row = int(np.argmax(open_ & forced))
        raise MultiposError(
            f"{free.where(row, 'roll_axis')}: the row states a force and a roll; keep one."
        )
    unknown = None if spread is None else np.isnan(spread)
    kinds = [rows for rows in (unknown, open_, forced) if rows is not None]
    return np.logical_or.reduce(kinds) if kinds else None


def _named_otherwise(
    readings: Readings, names: tuple[str, ...] | None, unit: str | None, environment: Sequence[str]
) -> Readings:
    """Return readings with the outputs that are asked for, in a unit."""
    if names is None and not set(environment).isdisjoint(readings.outputs):
        names = tuple(name for name in readings.outputs if name not in environment)
    readings = readings if names is None else select_outputs(readings, names)
    return readings if unit is None else replace(readings, unit=headers.unit_as_known(unit))


def _outputs(
    table: Table, names: tuple[str, ...] | None, environment: Sequence[str], findings: list[Finding]
) -> tuple[str, ...]:
    """Return the columns that are outputs, noting what is not used."""
    candidates = _candidates(table, environment)
    if names is None:
        return _numeric(table, candidates, findings)
    require_columns(names, table.columns, table.source)
    beside = _averaged_along(tuple(candidates), table)
    others = (name for name in candidates if name not in names and name not in beside)
    findings += headers.unused_columns(
        f"column '{name}' is not among the outputs and is not used" for name in others
    )
    return names


def _candidates(table: Table, environment: Sequence[str]) -> list[str]:
    """Return the columns that may be outputs."""
    apart = {*environment, *forces.left_by_apply(table)}
    every = [name for name in table.columns if name not in apart and _may_be_output(name, table)]
    if not all(name in table for name in forces.FORCE):
        return every
    # Forces are references, unless nothing else could be what the sensor said.
    others = [name for name in every if name not in forces.FORCE]
    return every if all(map(table.is_text, others)) else others


def _of_surroundings(
    units: Mapping[str, str], outputs: Sequence[str], used: Sequence[str], findings: list[Finding]
) -> list[str]:
    """Return columns that are no outputs by the unit in their header, said where it is news."""
    found = [n for n, unit in units.items() if unit in headers.OF_SURROUNDINGS and n not in outputs]
    findings += [
        Finding(
            "unused-column",
            "note",
            f"column '{name}' is in {units[name]} by its header, thus not an output",
        )
        for name in found
        if name not in headers.RESERVED and name not in used and not headers.is_environment(name)
    ]
    return found


def _used(units: Mapping[str, str], outputs: Sequence[str], used: Sequence[str]) -> dict[str, str]:
    """Return the units of columns that are surroundings of the readings."""
    kept = ((name, unit) for name, unit in units.items() if name not in outputs)
    return {name: unit for name, unit in kept if name in used or headers.is_environment(name)}


def _numeric(table: Table, candidates: list[str], findings: list[Finding]) -> tuple[str, ...]:
    """Return the candidates that hold numbers and are no companions of an average."""
    text = dict.fromkeys(name for name in candidates if table.is_text(name))
    numeric = tuple(name for name in candidates if name not in text)
    if not numeric:
        raise MultiposError(
            f"{table.source}: no numeric column can be an output; "
            f"the columns are {quoted(table.columns)}."
        )
    beside = frozenset(_averaged_along(numeric, table))  # as `average` writes them: no word
    kinds = {name: headers.component(name) for name in candidates}
    left = tuple(name for name in numeric if name not in beside)
    chosen = _of_acceleration(left, kinds)
    idle = headers.idle_columns(chosen, kinds, partial(map, table.numbers))
    chosen, left = (tuple(n for n in names if n not in idle) for names in (chosen, left))
    headers.refuse_text(table.source, chosen, text, kinds)
    texts = (f"column '{name}' holds text and is not used" for name in text)
    findings += headers.unused_columns(texts, idle)
    findings += headers.find_others(chosen, left, "their names")
    return chosen


def _of_acceleration(
    names: tuple[str, ...], kinds: Mapping[str, headers.NameParts]
) -> tuple[str, ...]:
    """Return the columns named as acceleration, where others are named as rate or field."""
    named = tuple(name for name in names if kinds[name].acceleration)
    elsewhere = any(kinds[name].elsewhere and kinds[name].axis >= 0 for name in names)
    if len(headers.triads_of(named, kinds)) == 1:
        names = tuple(name for name in names if name in named or not headers.is_beside(name))
    if not named or not elsewhere:
        return names
    return tuple(name for name in names if name in named or not kinds[name].elsewhere)


def _may_be_output(name: str, table: Table) -> bool:
    if name in headers.RESERVED or headers.is_environment(name) or _is_soak(name, table):
        return False
    return not any(_stands_beside(name, prefix, table) for prefix in ("u", "dof", "sd"))


def _is_soak(name: str, table: Table) -> bool:
    """Tell whether a column is a label of runs, or beside a temperature of soaks, by its name."""
    known = headers.SOAKS if headers.TEMPERATURE in table else (headers.RUN,)
    return name.casefold() in known


def _averaged_along(names: tuple[str, ...], table: Table) -> list[str]:
    """Return columns that an average of a log carries beside its outputs."""
    # Only an average has n and, for every output, sd_….
    if "n" not in table or not any(f"sd_{name}" in table for name in names):
        return []
    return [name for name in names if f"sd_{name}" not in table and f"u_{name}" not in table]


def _environment(
    table: Table, outputs: tuple[str, ...], used: Sequence[str], findings: list[Finding]
) -> dict[str, Array]:
    columns = {}
    for name in table.columns:
        if name in used:
            columns[name] = table.number(name, largest=LARGEST)
            continue
        if _is_soak(name, table) and name not in outputs:  # numbered as they come
            labels = {label: i for i, label in enumerate(dict.fromkeys(table.text(name)))}
            columns[name.casefold()] = np.array(
                [float(labels[label]) for label in table.text(name)]
            )
            continue
        if not headers.is_environment(name) or name in outputs:
            continue
        try:
            columns[name] = table.number(name, empty=True, largest=LARGEST)
        except MultiposError as error:  # a date in `time`, say: an error only if it is used
            text = f"column '{name}' is not used: {error}"
            findings.append(Finding("unused-column", "note", text))
    return columns


def _beside(
    table: Table, prefix: str, outputs: tuple[str, ...], findings: list[Finding]
) -> Array | None:
    """Return what stands beside every output in columns of a prefix (n, M), or None."""
    names = [f"{prefix}_{output}" for output in outputs]
    known = {*names, *outputs}
    findings += headers.unused_columns(
        f"column '{name}' belongs to no output and is not used"
        for name in table.columns
        if name not in known and _stands_beside(name, prefix, table)
    )
    present = [name for name in names if name in table and name not in outputs]
    if not present:
        return None
    missing = [name for name in names if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: column {quoted(missing)} is missing next to {quoted(present)}; "
            "give it for every output or for none."
        )
    return np.column_stack([nonnegative_column(table, name, zero=prefix == "sd") for name in names])


def _stands_beside(name: str, prefix: str, table: Table) -> bool:
    """Tell whether a column is that of a prefix beside another column."""
    return name.startswith(f"{prefix}_") and name.partition("_")[2] in table.columns


def nonnegative_column(
    table: Table, name: str, *, zero: bool = False, empty: bool = False, largest: float = math.inf
) -> Array:
    """Return a column of numbers above 0, or with `zero` of 0 or more; `empty` cells are NaN."""
    values = table.number(name, empty=empty, largest=largest)
    bad = values < 0.0 if zero else values <= 0.0
    if bad.any():
        row = int(np.argmax(bad))
        need = "0 or more" if zero else "above 0"
        raise MultiposError(f"{table.where(row, name)}: {values[row]:g} is not {need}.")
    return values


def _orientation_sd(table: Table) -> Array | None:
    if "orientation_sd_deg" not in table:
        return None
    return np.radians(nonnegative_column(table, "orientation_sd_deg", zero=True, empty=True))

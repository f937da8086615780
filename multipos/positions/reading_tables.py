"""Readings from tables: which columns are outputs, and what stands beside them.

A CSV file, a mapping of columns or a data frame; its columns are listed in
`docs/reference/formats`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.files.lists import Names, split_names
from multipos.files.tables import Source, Table, read_table
from multipos.numerics.arrays import LARGEST, Array
from multipos.positions import attitudes
from multipos.positions.forces import (
    FORCE,
    REFERENCE_U,
    known_rows,
    left_by_apply,
    read_forces,
    read_reference_u,
    said_of_lengths,
    states_forces,
)
from multipos.positions.readings import Readings, quoted, require_columns, select_outputs

_RESERVED = attitudes.COLUMNS | {"position", "n", "orientation_sd_deg", "group", *REFERENCE_U}


def read_readings(
    source: "Source | Readings",
    *,
    outputs: Names | None = None,
    unit: str | None = None,
    environment: Sequence[str] = (),
) -> Readings:
    """Return readings from a CSV file, a mapping of columns or a data frame.

    Parameters
    ----------
    source : path, mapping of name to (n,) array, data frame, or Readings
    outputs : names, optional
        The columns that are outputs; otherwise every numeric column without another meaning.
    unit : str, optional
        Unit of the readings, for names and reports.
    environment : names, optional
        Columns that are not outputs, beside those whose name says so.

    Returns
    -------
    Readings

    Raises
    ------
    MultiposError
        A file that is missing, empty, ragged or holds a bad cell, which is named by file, row
        and column; an output that is not there.
    """
    names = None if outputs is None else split_names(outputs, "--outputs")
    if isinstance(source, Readings):
        return _named_otherwise(source, names, unit, environment)
    table = read_table(source, what="readings")
    notes: list[str] = []
    names = _outputs(table, names, environment, notes)
    spread = _orientation_sd(table)
    spread = _with_open_rolls(table, names, spread, notes)
    oriented, force, reference_u = _where_it_stood(table, names, spread, notes)
    columns = _environment(table, names, environment, notes)
    return Readings(
        values=np.column_stack([table.number(name, largest=LARGEST) for name in names]),
        outputs=names,
        positions=table.text("position") if "position" in table else None,
        up=None if oriented is None else oriented.up,
        rotation=None if oriented is None else oriented.rotation,
        u=_beside(table, "u", names, notes),
        dof=_beside(table, "dof", names, notes),
        sd=_beside(table, "sd", names, notes),
        samples=nonnegative_column(table, "n") if "n" in table else None,
        orientation_sd=spread,
        group=table.text("group") if "group" in table else None,
        force=force,
        reference_u=reference_u,
        environment=columns,
        unit=unit or "reading",
        source=None if table.sha256 is None else table.source,
        sha256=table.sha256,
        notes=tuple(notes),
    )


def _where_it_stood(
    table: Table, names: tuple[str, ...], spread: Array | None, notes: list[str]
) -> tuple[attitudes.Attitudes | None, Array | None, Array | None]:
    """Return attitudes, known forces and the uncertainty of the reference, as far as given."""
    others = {name: column for name, column in table.columns.items() if name not in names}
    free = replace(table, columns=others)  # what is an output is no position, whatever its name
    rows = attitudes.rows_with_orientation(free)
    force = read_forces(free, rows) if states_forces(free, rows) else None
    unknown = None if spread is None else np.isnan(spread)
    if force is not None:
        forced = known_rows(force)
        unknown = forced if unknown is None else np.asarray(unknown | forced)
    elif all(name in free for name in FORCE):
        why = "were added by apply" if left_by_apply(free) else "stand beside an orientation"
        notes.append(f"columns {quoted(FORCE)} {why} and are no positions")
    oriented = attitudes.read_attitudes(free, unknown)
    up = attitudes.FORMS["up vector"]
    if oriented is not None and up[0] in free:
        notes += said_of_lengths(free, up)
    return oriented, force, read_reference_u(free, force)


def _with_open_rolls(
    table: Table, names: tuple[str, ...], spread: Array | None, notes: list[str]
) -> Array | None:
    """Return the orientation sds, with positions whose angle of a roll is open as unknown."""
    free = replace(table, columns={k: v for k, v in table.columns.items() if k not in names})
    open_ = attitudes.rows_without_angle(free)
    if not open_.any():
        return spread
    rows = ", ".join(str(row + 1) for row in np.flatnonzero(open_)[:6].tolist())
    notes.append(
        f"row {rows}{' and more' if open_.sum() > 6 else ''}: the angle of the roll is open; the "
        "position counts as unknown, that its axis lies level is not used"
    )
    return np.where(open_, np.nan, np.zeros(table.rows) if spread is None else spread)


def _named_otherwise(
    readings: Readings,
    names: tuple[str, ...] | None,
    unit: str | None,
    environment: Sequence[str],
) -> Readings:
    """Return readings with the outputs that are asked for, in a unit."""
    if names is None and not set(environment).isdisjoint(readings.outputs):
        names = tuple(name for name in readings.outputs if name not in environment)
    readings = readings if names is None else select_outputs(readings, names)
    return readings if unit is None else replace(readings, unit=unit)


def _outputs(
    table: Table, names: tuple[str, ...] | None, environment: Sequence[str], notes: list[str]
) -> tuple[str, ...]:
    """Return the columns that are outputs, noting what is not used."""
    applied = left_by_apply(table)
    every = [
        name
        for name in table.columns
        if _may_be_output(name, table) and name not in environment and name not in applied
    ]
    # Forces are references, unless nothing else could be what the sensor said.
    whole = all(name in table for name in FORCE)
    candidates = [name for name in every if not (whole and name in FORCE)]
    if not any(not table.is_text(name) for name in candidates):
        candidates = every
    if names is None:
        return _numeric(table, candidates, notes)
    require_columns(names, table.columns, table.source)
    others = (name for name in candidates if name not in names)
    notes += [f"column '{name}' is not among the outputs and is not used" for name in others]
    return names


def _numeric(table: Table, candidates: list[str], notes: list[str]) -> tuple[str, ...]:
    """Return the candidates that hold numbers and are no companions of an average."""
    text = [name for name in candidates if table.is_text(name)]
    numeric = tuple(name for name in candidates if name not in text)
    if not numeric:
        raise MultiposError(
            f"{table.source}: no numeric column can be an output; "
            f"the columns are {quoted(table.columns)}."
        )
    notes += [f"column '{name}' holds text and is not used" for name in text]
    beside = _averaged_along(numeric, table)
    if beside:
        notes.append(f"no sd_… beside column {quoted(beside)}, as outputs have; not used")
    return tuple(name for name in numeric if name not in beside)


def _may_be_output(name: str, table: Table) -> bool:
    if name in _RESERVED or is_environment(name):
        return False
    return not any(_stands_beside(name, prefix, table) for prefix in ("u", "dof", "sd"))


def _averaged_along(names: tuple[str, ...], table: Table) -> list[str]:
    """Return columns that an average of a log carries beside its outputs."""
    # Only an average has n and, for every output, sd_….
    if "n" not in table or not any(f"sd_{name}" in table for name in names):
        return []
    return [name for name in names if f"sd_{name}" not in table and f"u_{name}" not in table]


def is_environment(name: str) -> bool:
    """Tell whether a column is about the surroundings by its name."""
    return name in ("temperature", "time") or name.startswith("ambient") or name.endswith("_rate")


def _environment(
    table: Table, outputs: tuple[str, ...], used: Sequence[str], notes: list[str]
) -> dict[str, Array]:
    columns = {}
    for name in table.columns:
        if name in used:
            columns[name] = table.number(name, largest=LARGEST)
            continue
        if not is_environment(name) or name in outputs:
            continue
        try:
            columns[name] = table.number(name, empty=True, largest=LARGEST)
        except MultiposError as error:  # a date in `time`, say: an error only if it is used
            notes.append(f"column '{name}' is not used: {error}")
    return columns


def _beside(table: Table, prefix: str, outputs: tuple[str, ...], notes: list[str]) -> Array | None:
    """Return what stands beside every output in columns of a prefix (n, M), or None."""
    names = [f"{prefix}_{output}" for output in outputs]
    known = {*names, *outputs}
    notes += [
        f"column '{name}' belongs to no output and is not used"
        for name in table.columns
        if name not in known and _stands_beside(name, prefix, table)
    ]
    present = [name for name in names if name in table and name not in outputs]
    if not present:
        return None
    missing = [name for name in names if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: column {quoted(missing)} is missing beside {quoted(present)}; "
            "give it for every output or for none."
        )
    return np.column_stack([nonnegative_column(table, name, zero=prefix == "sd") for name in names])


def _stands_beside(name: str, prefix: str, table: Table) -> bool:
    """Tell whether a column is that of a prefix beside another column."""
    return name.startswith(f"{prefix}_") and name.partition("_")[2] in table.columns


def nonnegative_column(
    table: Table, name: str, *, zero: bool = False, empty: bool = False
) -> Array:
    """Return a column of numbers above 0, or with `zero` of 0 or more; `empty` cells are NaN."""
    values = table.number(name, empty=empty)
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

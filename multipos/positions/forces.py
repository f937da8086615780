"""Columns of known specific forces, beside those of orientations.

A centrifuge, a shaker, a scale of weights: where the sensor is not at rest in gravity alone, a row
states the specific force itself. `states_forces` tells whether columns do, `read_forces` and
`read_reference_u` read them, `in_standard_g` by the units of their header; `known_rows` and
`along_forces` are what they give for a row, `left_by_apply` names columns that only look so,
`find_lengths` and `find_likely_m_s2` say where somebody may have meant something else.

Forces are in case axes and standard g, of any size. Each row of a table is one of

    f = f_stated  (columns f_x, f_y, f_z),        f = (gravity/9.80665) u                   (1)

and a reference is +f, or −f under the convention 'gravity'. A stated force is taken as it stands:
local gravity and its uncertainty scale the rows of u alone. ``reference_u_x`` … are the standard
uncertainties of its components, independent from row to row.

Columns of these names are not always positions: `apply` writes its compensated force under them,
and a sensor may call its outputs so. They are none where the caller names them as outputs, where
``apply`` left its column ``outside`` beside them, where every row has its orientation in another
form, and where no other column could be an output.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.files.written_units import PER_G
from multipos.finding import Finding
from multipos.numerics.arrays import LARGEST, Array, Mask
from multipos.units import STANDARD_GRAVITY

FORCE = ("f_x", "f_y", "f_z")


OF_FIELD = ("b_x", "b_y", "b_z")  # a magnetic field, as its direction or as `apply` adds it


REFERENCE_U = ("reference_u_x", "reference_u_y", "reference_u_z")


_APPLIED = re.compile(r"([uU]_)?([fb]_[xyz]|tilt_[xyz]_deg)|heading_deg|outside|parity|fault")


_LIKELY = 0.02  # of standard gravity: what g is on Earth, and an acceleration beside it


_LENGTHS = 0.01  # by which up vectors, rounded for print, are longer or shorter than one


def left_by_apply(table: Table) -> tuple[str, ...]:
    """Return the columns that `apply` added to a table, by its mark ``outside``."""
    if "outside" not in table or not any(name in table for name in (*FORCE, *OF_FIELD)):
        return ()
    return tuple(name for name in table.columns if _APPLIED.fullmatch(name))


def states_forces(table: Table, oriented: Mask | None) -> bool:
    """Tell whether the columns f_x, f_y, f_z state forces, and not what was compensated.

    Parameters
    ----------
    table : Table
        Without the columns that are outputs.
    oriented : (n,) array of bool, optional
        Rows that have their orientation in another form.
    """
    if not all(name in table for name in FORCE) or left_by_apply(table):
        return False
    return oriented is None or not oriented.all()


def known_rows(force: Array) -> Mask:
    """Return the rows (n,) of forces (n, 3) that are known."""
    return np.asarray(np.isfinite(force).all(axis=1))


def read_forces(table: Table, oriented: Mask | None) -> Array:
    """Return the forces (n, 3) [g] that a table states, NaN in rows that state none.

    Raises
    ------
    MultiposError
        A cell is missing or no number, or a row has an orientation as well.
    """
    empty = oriented is not None
    force = np.column_stack([table.number(name, empty=empty, largest=LARGEST) for name in FORCE])
    given = np.isfinite(force)
    partly = np.asarray(given.any(axis=1) & ~given.all(axis=1))
    if partly.any():
        row = int(np.argmax(partly))
        missing = FORCE[int(np.argmin(given[row]))]
        raise MultiposError(f"{table.where(row, missing)}: empty; a force has three components.")
    if oriented is not None:
        both = known_rows(force) & oriented
        if both.any():
            row = int(np.argmax(both))
            raise MultiposError(
                f"{table.where(row, FORCE[0])}: the row states a force and an orientation; "
                "keep one of them."
            )
    return force


def along_forces(force: Array, up: Array | None) -> Array:
    """Return up vectors (n, 3), where a force is known along it, NaN where it has no size."""
    result = np.full(force.shape, np.nan) if up is None else up.copy()
    rows = known_rows(force)
    size = np.linalg.norm(force[rows], axis=1)[:, None]
    result[rows] = np.where(size > 0.0, force[rows] / np.where(size > 0.0, size, 1.0), np.nan)
    return result


def read_reference_u(table: Table, force: Array | None) -> Array | None:
    """Return the standard uncertainty (n, 3) [g] of the reference, 0 where a row states none.

    Raises
    ------
    MultiposError
        A column of the three is missing, a cell is negative, or empty beside a force.
    """
    present = [name for name in REFERENCE_U if name in table]
    if not present:
        return None
    missing = [name for name in REFERENCE_U if name not in present]
    if missing:
        raise MultiposError(
            f"{table.source}: column '{missing[0]}' is missing next to '{present[0]}'; give the "
            "uncertainty of all three components, 0 where one is exact."
        )
    u = np.column_stack([table.number(name, empty=True, largest=LARGEST) for name in REFERENCE_U])
    known = np.zeros(len(u), dtype=bool) if force is None else known_rows(force)
    _refuse_cells(table, np.asarray(u < 0.0), "negative; a standard uncertainty is 0 or more")
    empty = np.isnan(u) & known[:, None]
    _refuse_cells(table, empty, "empty for a known force; write 0 where it is exact")
    return np.nan_to_num(u)


def _refuse_cells(table: Table, bad: Mask, fault: str) -> None:
    if bad.any():
        row, i = np.argwhere(bad)[0].tolist()
        raise MultiposError(f"{table.where(row, REFERENCE_U[i])}: {fault}.")


def find_lengths(table: Table, names: Iterable[str]) -> tuple[Finding, ...]:
    """Say where up vectors have lengths that somebody may have meant as forces."""
    up = np.column_stack([table.number(name, empty=True) for name in names])
    size = np.hypot.reduce(up, axis=1)  # of any size, without their squares
    size = size[np.isfinite(size)]
    if not len(size) or np.abs(size - 1.0).max() <= _LENGTHS:
        return ()
    low, high = (f"{end:.4g}" for end in (size.min(), size.max()))
    lengths = low if low == high else f"{low} to {high}"
    text = f"up vectors have lengths of {lengths}; only their directions are used"
    action = f"Name the columns {', '.join(FORCE)} if they are forces in g."
    return (Finding("up-length", "warning", text, action),)


def find_likely_m_s2(force: Array, units: Mapping[str, str]) -> tuple[Finding, ...]:
    """Say where known forces (n, 3) without a unit all have the size of gravity in m/s²."""
    size = np.hypot.reduce(force[known_rows(force)], axis=1)
    if set(FORCE) & set(units) or not len(size):
        return ()
    if np.abs(size / STANDARD_GRAVITY - 1.0).max() > _LIKELY:
        return ()
    text = f"known forces have a size of {size.max():.3g} without a unit and are read as g"
    action = "If they are in m/s², write f_x [m/s^2] in the header."
    return (Finding("likely-unit", "warning", text, action),)


def in_standard_g(table: Table, units: Mapping[str, str]) -> Table:
    """Return a table whose forces f_x, f_y, f_z are in standard g, by the units of their header."""
    moved = {
        name: table.number(name, empty=True) / PER_G[units[name]]
        for name in FORCE
        if units.get(name, "g") in PER_G and units.get(name, "g") != "g"
    }
    strange = [name for name in FORCE if units.get(name, "g") not in PER_G]
    if strange:
        raise MultiposError(
            f"{table.source}: column '{strange[0]}' is in {units[strange[0]]} by its header; known "
            f"forces are in {', '.join(PER_G)}."
        )
    return replace(table, columns={**table.columns, **moved}) if moved else table

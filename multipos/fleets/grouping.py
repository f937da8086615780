"""Units out of rows: which rows are whose, and which units were read under the same conditions.

- `group_rows` returns the units of rows, `Grouped`; `Conditions` what each was read under.
- `put_together` brings the rows of a unit together where they are text.

The conditions of a unit are what a fit reads beside its outputs: labels, orientations, stated
uncertainties, columns of the model. Units with the same share one design and are solved together.
They are found by a sum of products modulo 2⁶⁴ of every unit's cells with random odd numbers, which
two units of different conditions share once in 10¹⁹ pairs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.files.csv_columns import Cells, arrange_cells
from multipos.fleets.labels import Codes, Labels
from multipos.fleets.sources import Owners, Rows
from multipos.numerics.arrays import LARGEST, SMALLEST, Array, Mask, Places, places_of_kinds
from multipos.positions import attitudes
from multipos.positions.forces import FORCE
from multipos.positions.headers import RUN, TEMPERATURE
from multipos.results import frozen

_LABELLED = ("position", "group", "direction", "roll_axis")  # all other conditions are numbers
_STRETCH = 1 << 20  # rows that are numbered at a time
_SEED = 20261  # of the random numbers: any serve, and the same ones every time
ONE_TEMPERATURE = 1.0  # [K] of a unit, within which it need not share temperature with its batch

AnyArray = NDArray[Any]


@frozen
class Grouped:
    """The units of a fleet, in the order in which they first come.

    A unit that was at several stations is one at each of them.

    Attributes
    ----------
    order : (N,) array of int or None
        Rows of the table, those of a unit together and in their order; None: as they stand.
    starts : (B + 1,) array of int
        Where each unit begins in `order`.
    unit, station : Labels
        Of every unit (B,).
    """

    order: Places | None
    starts: Places
    unit: Labels
    station: Labels

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> Places:
        """Rows of every unit (B,)."""
        return np.diff(self.starts)

    def rows(self, unit: int) -> Places:
        """Return the rows of the table that are of a unit."""
        places = slice(self.starts[unit], self.starts[unit + 1])
        return np.arange(places.start, places.stop) if self.order is None else self.order[places]

    @property
    def firsts(self) -> Places:
        """The first row of every unit (B,)."""
        heads = self.starts[:-1]
        return heads if self.order is None else self.order[heads]

    def arranged(self, column: AnyArray) -> AnyArray:
        """Return a column of the table in the order of the units."""
        return column if self.order is None else column[self.order]


def group_rows(owners: Owners) -> Grouped:
    """Return the units of rows."""
    unit, station = owners.unit.codes, owners.station.codes
    changes = unit[1:] != unit[:-1]
    changes |= station[1:] != station[:-1]
    starts = np.concatenate(([0], changes.nonzero()[0] + 1, [len(unit)]))
    heads, order = starts[:-1], None
    in_order = (unit[heads] == np.arange(len(heads))).all()  # of coming, as names are numbered
    if not in_order and len(np.unique(_keys(unit[heads], owners.station, heads))) < len(heads):
        appeared = _appeared(_keys(unit, owners.station, slice(None)))
        order = np.argsort(appeared, kind="stable")
        starts = np.concatenate(([0], np.cumsum(np.bincount(appeared))))
    firsts = starts[:-1] if order is None else order[starts[:-1]]
    return Grouped(
        order,
        starts,
        Labels(owners.unit.codes[firsts], owners.unit.names),
        Labels(owners.station.codes[firsts], owners.station.names),
    )


def _keys(unit: Codes, station: Labels, rows: Places | slice) -> NDArray[np.integer[Any]]:
    """Return a number of unit and station that no other pair has."""
    most = (int(unit.max()) + 1) * len(station.names)
    # rows of a large fleet by the hundred million: four bytes each where these do
    kind = np.int32 if most < 1 << 31 else np.int64
    keys: NDArray[np.integer[Any]] = unit.astype(kind)
    keys *= len(station.names)
    keys += station.codes[rows]
    return keys


def _appeared(keys: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Return keys as 0, 1, … in the order in which they first come."""
    different = np.unique(keys)
    places = np.empty(len(keys), dtype=np.int32)
    first = np.full(len(different), len(keys))
    for start in range(0, len(keys), _STRETCH):
        stretch = np.searchsorted(different, keys[start : start + _STRETCH])
        places[start : start + _STRETCH] = stretch
        np.minimum.at(first, stretch, np.arange(start, start + len(stretch)))
    rank = np.empty(len(different), dtype=np.int32)
    rank[np.argsort(first)] = np.arange(len(different), dtype=np.int32)
    return rank[places]


def put_together(rows: Rows, grouped: Grouped) -> tuple[Rows, Grouped]:
    """Return rows of which those of a unit are together in every text, and their units.

    A text is split piece by piece, and a unit whose rows stand apart would take many of them.
    """
    if grouped.order is None:
        return rows, grouped
    of_table = np.searchsorted(rows.starts, grouped.order, side="right") - 1
    tables, place = list(rows.tables), np.arange(rows.count)
    for i, places in places_of_kinds(of_table, len(tables)):
        table, mine = tables[i], grouped.order[places] - rows.starts[i]
        cells: Any = table.columns
        if isinstance(next(iter(cells.values())), Cells):
            lines = None if table.lines is None else np.asarray(table.lines)[mine]
            tables[i] = replace(table, columns=arrange_cells(cells, mine), lines=lines)
            place[rows.starts[i] + mine] = rows.starts[i] + np.arange(len(mine))
    order = place[grouped.order]
    in_order = (order == np.arange(len(order))).all()
    grouped = replace(grouped, order=None if in_order else order)
    return replace(rows, tables=tuple(tables)), grouped


class Conditions:
    """The outputs of every row, and under which conditions its unit was read.

    Attributes
    ----------
    values, stated, stated_dof : lists of M (N,) arrays
        Outputs, and where they are stated of all of them their u and its degrees of freedom,
        which units need not share; in the order of the units.
    temperature : list of one (N,) array
        Of which the residuals are asked where no term of the model takes it; empty elsewhere.
    """

    def __init__(
        self, rows: Rows, grouped: Grouped, outputs: Sequence[str], used: Sequence[str]
    ) -> None:
        """Read the columns that are used; `used` are those of the model's formula."""
        self._grouped = grouped
        self.values = self._columns(rows, [rows.written(name) for name in outputs])
        self.stated = self._of_all(rows, outputs, "u")
        self.stated_dof = self._of_all(rows, outputs, "dof") if self.stated else []
        self._sound = self._sound_units(rows)
        kinds = ("u",) * bool(self.stated) + ("dof",) * bool(self.stated_dof)
        apart = {f"{kind}_{output}" for kind in kinds for output in outputs}
        self._cells = [
            self._cells_of(rows, name)
            for name in rows.columns
            if _is_used(name, outputs, used) and name not in apart
        ]
        asked = TEMPERATURE in rows.columns and TEMPERATURE not in used
        self.temperature = [self._whole(rows.numbers(TEMPERATURE))] if asked else []
        if asked:
            self._cells.append(self._over_temperature(self.temperature[0]))

    def groups(self) -> Iterator[Places]:
        """Yield units that share all conditions; one whose cells are at fault comes alone."""
        for n in np.unique(self._grouped.counts).tolist():
            units = np.flatnonzero(self._grouped.counts == n)
            sound = self._sound[units]
            yield from units[~sound][:, None]
            yield from self._alike(units[sound], n)

    def of(self, columns: Sequence[Array], units: Places, n: int) -> tuple[Array, ...]:
        """Return columns of units of n rows, (B, n) each."""
        starts = self._grouped.starts[units]
        if len(units) and starts[-1] - starts[0] == n * (len(units) - 1):
            piece = slice(starts[0], starts[0] + n * len(units))
            return tuple(column[piece].reshape(len(units), n) for column in columns)
        places = starts[:, None] + np.arange(n)
        return tuple(column[places] for column in columns)

    def _columns(self, rows: Rows, names: Sequence[str]) -> list[Array]:
        return [self._grouped.arranged(rows.numbers(name)) for name in names]

    def _of_all(self, rows: Rows, outputs: Sequence[str], kind: str) -> list[Array]:
        """Return what is stated of every output; none where it is not of all, or no condition."""
        names = [f"{kind}_{output}" for output in outputs]
        return self._columns(rows, names) if set(names) <= set(rows.columns) else []

    def _sound_units(self, rows: Rows) -> Mask:
        """Tell of which units all cells can be what a fit takes."""
        bad = np.zeros(self._grouped.starts[-1], dtype=np.bool_)
        for column in self.values:
            bad |= ~(np.abs(column) <= LARGEST)
        for name in rows.columns:
            if name == "n" or name.startswith("sd_"):
                cells = self._grouped.arranged(rows.numbers(name))
                bad |= ~((cells > 0.0) if name == "n" else (cells >= 0.0))
        starts = self._grouped.starts[:-1]
        for name in rows.columns:
            if name.casefold() == RUN:  # several runs are a random effect, which a batch lacks
                runs = self._grouped.arranged(rows.conditions(name).codes)
                bad |= runs != np.repeat(runs[starts], self._grouped.counts)
        sound = ~np.logical_or.reduceat(bad, starts)
        for column in self.values:
            sound &= ~(np.maximum.reduceat(np.abs(column), starts) < SMALLEST)
        return sound

    def _cells_of(self, rows: Rows, name: str) -> AnyArray:
        """Return a column of conditions, as numbers whose bits tell all values apart."""
        numbers = None if name in _LABELLED and rows.is_text(name) else rows.numbers(name)
        if numbers is None or np.isnan(numbers).any():
            return self._grouped.arranged(rows.conditions(name).codes)
        return self._grouped.arranged((numbers + 0.0).view(np.uint64))

    def _whole(self, column: Array) -> Array:
        """Return a column in the order of the units, 0 where a unit lacks a number of it."""
        arranged = self._grouped.arranged(column)
        bad = ~(np.abs(arranged) <= LARGEST)
        lacking = np.logical_or.reduceat(bad, self._grouped.starts[:-1])
        return np.where(np.repeat(lacking, self._grouped.counts), 0.0, arranged)

    def _over_temperature(self, column: Array) -> AnyArray:
        """Return temperature where a unit was at several, as the tests of its residuals ask it."""
        starts = self._grouped.starts[:-1]
        spread = np.maximum.reduceat(column, starts) - np.minimum.reduceat(column, starts)
        several = np.repeat(spread > ONE_TEMPERATURE, self._grouped.counts)
        return np.asarray(np.where(several, column, 0.0).view(np.uint64))

    def _alike(self, units: Places, n: int) -> Iterator[Places]:
        rng = np.random.default_rng(_SEED)
        starts = self._grouped.starts[units]
        total = np.zeros(len(units), dtype=np.uint64)
        for cells in self._cells:
            for row in range(n):
                factor = rng.integers(0, 2**63, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
                total += cells[starts + row].astype(np.uint64) * factor
        _, first, inverse = np.unique(total, return_index=True, return_inverse=True)
        by_group = np.argsort(inverse, kind="stable")
        ends = np.cumsum(np.bincount(inverse, minlength=len(first)))[:-1]
        for alike in np.split(by_group, ends):
            if len(alike):
                yield units[alike]


def _is_used(name: str, outputs: Sequence[str], used: Sequence[str]) -> bool:
    """Tell whether a column bears on the fit of a unit beside its outputs."""
    if name in outputs:
        return False
    beside = {f"{kind}_{output}" for kind in ("u", "dof") for output in outputs}
    known = {*attitudes.COLUMNS, *FORCE, "position", "group", "orientation_sd_deg"} | beside
    return name in known or name in used or name.startswith("reference_u_")

"""The rows of a fleet: tables in files, folders and patterns, one row per unit and position.

A file is CSV, packed by gzip or not, or Parquet by the extra ``parquet``; a folder stands for all
such files in it, a pattern (``line-*.csv``) for those it fits, in the order of their names. Only
the columns of unit and station are read at once, the others piece by piece.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from glob import glob, has_magic
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.csv_columns import Cells, FileBytes
from multipos.files.pipes import GZIP, is_folder, is_there, rereadable, unpack_gzip
from multipos.files.spelling import near, quoted
from multipos.files.tables import Column, Source, Table, open_table, read_table
from multipos.files.whole import first_bytes
from multipos.fleets.labels import Labels, joined_columns, joined_labels, labels_of
from multipos.fleets.parquet import is_in_file, is_parquet, read_parquet
from multipos.numerics.arrays import Array

_ENDINGS = (".csv", ".parquet")


@dataclass(frozen=True)
class Rows:
    """All rows of a fleet, in one or several tables that have the same columns.

    Attributes
    ----------
    tables : tuple of Table
        Without the columns of unit and station.
    starts : tuple of int
        First row of each table, and the number of all.
    unit, station : Labels
        Of every row; a single station '' where no column names them.
    counted : bool
        Units are whole numbers in the tables, and not texts that look like some.
    """

    tables: tuple[Table, ...]
    starts: tuple[int, ...]
    unit: Labels
    station: Labels
    counted: bool

    @property
    def count(self) -> int:
        """How many rows there are."""
        return self.starts[-1]

    @property
    def largest(self) -> int:
        """The most rows that a file gives only together."""
        return max(
            (c.largest for t in self.tables for c in t.columns.values() if is_in_file(c)), default=1
        )

    def piece(self, start: int, stop: int) -> "Rows":
        """Return the rows from start to stop, read, without whose they are."""
        parts = []
        for table, first in zip(self.tables, self.starts[:-1], strict=True):
            low, high = max(start - first, 0), min(stop - first, table.rows)
            if low < high:
                parts.append(_loaded(table, low, high))
        return self.of_tables(parts)

    def of_tables(self, tables: Sequence[Table]) -> "Rows":
        """Return some of the rows, in tables of their own, without whose they are."""
        loaded = tuple(_loaded(table, 0, table.rows) for table in tables)
        starts = np.cumsum([0, *(table.rows for table in tables)]).tolist()
        return Rows(loaded, tuple(starts), _NOBODY, _NOBODY, self.counted)

    def without_labels(self) -> "Rows":
        """Return the rows without whose they are, which takes memory and is known by units."""
        return replace(self, unit=_NOBODY, station=_NOBODY)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that are left."""
        return tuple(self.tables[0].columns)

    def select(self, rows: Sequence[int]) -> Table:
        """Return some rows as a table; messages still name file and line where it is one file."""
        places = np.searchsorted(self.starts, rows, side="right") - 1
        parts = [
            self.tables[place].select(
                [row - self.starts[place] for row in _at(rows, places, place)]
            )
            for place in dict.fromkeys(places.tolist())
        ]
        if len(parts) == 1:
            only: Table = parts[0]
            return only
        columns = {
            name: joined_columns([part.columns[name] for part in parts]) for name in self.columns
        }
        source = " and ".join(part.source for part in parts)
        return Table(source, columns, sum(part.rows for part in parts))

    def numbers(self, name: str) -> Array:
        """Return a column as numbers, NaN where a cell is none."""
        parts = [table.numbers(name) for table in self.tables]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def is_text(self, name: str) -> bool:
        """Tell whether a column is kept as text, in any of the tables."""
        columns = [table.columns[name] for table in self.tables]
        return not all(isinstance(c, np.ndarray) and c.dtype.kind in "fiub" for c in columns)

    def labels(self, name: str) -> Labels:
        """Return a column as labels, read where it still is in its file."""
        columns = [{name: _part(table.columns[name], 0, table.rows)} for table in self.tables]
        tables = [replace(t, columns=c) for t, c in zip(self.tables, columns, strict=True)]
        return joined_labels([labels_of(table, name) for table in tables])


_NOBODY = Labels(np.zeros(0, dtype=np.int32), ())


def _loaded(table: Table, low: int, high: int) -> Table:
    """Return some rows of a table, in memory but for the cells of CSV."""
    columns = {name: _part(column, low, high) for name, column in table.columns.items()}
    lines = None if table.lines is None else table.lines[low:high]
    return replace(table, columns=columns, rows=high - low, lines=lines)


def _part(column: Column, low: int, high: int) -> Column:
    return column.part(low, high) if isinstance(column, Cells) else column[low:high]


def _at(rows: Sequence[int], places: Any, place: int) -> list[int]:
    return [row for row, at in zip(rows, places.tolist(), strict=True) if at == place]


def read_rows(
    sources: Sequence[Source],
    unit_column: str,
    station_column: str | None = None,
    only: str | None = None,
) -> Rows:
    """Return the rows of tables.

    Parameters
    ----------
    sources : paths, folders, patterns, mappings of columns, or data frames
    unit_column, station_column : str
        Which columns name the unit and the station.
    only : str, optional
        A unit, of which at least all rows are returned; of Parquet no others.

    Raises
    ------
    MultiposError
        No such file or column, a table that cannot be read, or one whose columns differ from
        those of the first; a row without a unit.
    """
    kept = None if only is None else (unit_column, only)
    apart = {unit_column, station_column}
    tables = [_read(source, apart, kept) for source in _expanded(sources)]
    if only is not None:
        tables = [table for table in tables if table.rows]
        if not tables:
            raise MultiposError(f"no unit '{only}' in column '{unit_column}'; look at units.csv.")
    for table in tables:
        _require_columns(table, tables[0], unit_column, station_column)
    unit = joined_labels([labels_of(table, unit_column) for table in tables])
    _require_units(tables, unit, unit_column)
    station = Labels(np.broadcast_to(np.int32(0), len(unit)), ("",))
    if station_column is not None:
        station = joined_labels([labels_of(table, station_column) for table in tables])
    starts = np.cumsum([0, *(table.rows for table in tables)]).tolist()
    left = tuple(_without(table, apart) for table in tables)
    return Rows(left, tuple(starts), unit, station, _are_counted(tables, unit_column))


def _require_columns(table: Table, first: Table, unit: str, station: str | None) -> None:
    """Refuse a table without the columns that name units, or with others than the first."""
    for name in (unit, station):
        if name is not None and name not in table:
            raise MultiposError(
                f"{table.source}: no column '{name}'{near(name, list(table.columns))} The "
                f"columns are {quoted(table.columns)}."
            )
    if set(table.columns) != set(first.columns):
        odd = set(table.columns) ^ set(first.columns)
        raise MultiposError(
            f"{table.source}: column {quoted(sorted(odd))} is not in both it and "
            f"{first.source}; give tables with the same columns."
        )


def _are_counted(tables: Sequence[Table], name: str) -> bool:
    columns = [table.columns[name] for table in tables]
    arrays = [column for column in columns if isinstance(column, np.ndarray)]
    whole = all(a.dtype.kind in "iu" and np.can_cast(a.dtype, np.int64) for a in arrays)
    return whole and len(arrays) == len(columns)


def _require_units(tables: Sequence[Table], unit: Labels, column: str) -> None:
    """Refuse a row that says no unit: nobody could tell whose it is."""
    if "" not in unit.names:
        return
    row = int(np.argmax(unit.codes == unit.names.index("")))
    for table in tables:
        if row < table.rows:
            raise MultiposError(
                f"{table.where(row, column)}: the cell is empty; every row needs its unit."
            )
        row -= table.rows


def _without(table: Table, names: set[str | None]) -> Table:
    columns = {name: column for name, column in table.columns.items() if name not in names}
    if not columns:
        raise MultiposError(f"{table.source}: no column is left beside the unit's.")
    return replace(table, columns=columns)


def _expanded(sources: Sequence[Source]) -> list[Source]:
    """Return sources with folders and patterns replaced by the files they stand for."""
    found: list[Source] = []
    for source in sources:
        found += _files(source) if isinstance(source, str | os.PathLike) else [source]
    if not found:
        raise MultiposError("no table; give at least one.")
    return found


def _files(source: str | os.PathLike[str]) -> Sequence[Source]:
    """Return the files that a path, a folder or a pattern stands for."""
    name = os.fspath(source)
    if is_folder(name):
        files = [path for path in sorted(Path(name).iterdir()) if _is_table(path)]
        if not files:
            raise MultiposError(f"{name}: the folder has no .csv or .parquet files.")
        return files
    if has_magic(name) and not is_there(name):
        fitting = sorted(glob(name, recursive=True))  # noqa: PTH207 – any path, not one below
        if not fitting:
            raise MultiposError(f"{name}: no file fits the pattern; check the path.")
        return fitting
    return [rereadable(source)]


def _is_table(path: Path) -> bool:
    name = Path(path.stem) if path.suffix == ".gz" else path
    return name.suffix in _ENDINGS


def _read(source: Source, apart: set[str | None], kept: tuple[str, str] | None) -> Table:
    if not isinstance(source, str | os.PathLike):
        return read_table(source, what="table")
    path = source
    if first_bytes(source, len(GZIP)) == GZIP:
        path = unpack_gzip(Path(source) if isinstance(source, str) else source)
    table = read_parquet(path, apart, kept) if is_parquet(path) else open_table(path)
    if path is not source:  # what people compare is the file that they have
        table = replace(table, sha256=FileBytes(source, "table").sha256())
    return table

"""The rows of a fleet: tables in files, folders and patterns, one row per unit and position.

A file is CSV, or Parquet by the extra ``parquet``; a folder stands for all such files in it, a
pattern (``line-*.csv``) for those it fits, in the order of their names. Parquet is read in this
process, other than a log (`multipos.logs.isolation`): its texts stay what they are in the file, a
dictionary and numbers, which is what lets twenty million rows stay in memory.
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from glob import glob, has_magic
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.lists import near, quoted
from multipos.files.pipes import is_folder, is_there, rereadable
from multipos.files.tables import Column, Source, Table, read_table
from multipos.fleets.labels import Labels, joined_columns, joined_labels, labels_of
from multipos.logs.extras import require_extra
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
        """Return a column as labels."""
        return joined_labels([labels_of(table, name) for table in self.tables])


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
    tables = [_read(source, kept) for source in _expanded(sources)]
    if only is not None:
        tables = [table for table in tables if table.rows]
        if not tables:
            raise MultiposError(f"no unit '{only}' in column '{unit_column}'; look at units.csv.")
    for table in tables:
        _require_columns(table, tables[0], unit_column, station_column)
    unit = joined_labels([labels_of(table, unit_column) for table in tables])
    _require_units(tables, unit, unit_column)
    station = Labels(np.zeros(len(unit), dtype=np.int32), ("",))
    if station_column is not None:
        station = joined_labels([labels_of(table, station_column) for table in tables])
    starts = np.cumsum([0, *(table.rows for table in tables)]).tolist()
    apart = {unit_column, station_column}
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
        files = [path for path in sorted(Path(name).iterdir()) if path.suffix in _ENDINGS]
        if not files:
            raise MultiposError(f"{name}: the folder has no {' or '.join(_ENDINGS)} files.")
        return files
    if has_magic(name) and not is_there(name):
        fitting = sorted(glob(name, recursive=True))  # noqa: PTH207 – any path, not one below
        if not fitting:
            raise MultiposError(f"{name}: no file fits the pattern; check the path.")
        return fitting
    return [rereadable(source)]


def _read(source: Source, kept: tuple[str, str] | None) -> Table:
    if isinstance(source, str | os.PathLike) and _is_parquet(source):
        return _read_parquet(source, kept)
    return read_table(source, what="table")


def _is_parquet(path: str | os.PathLike[str]) -> bool:
    try:
        with Path(path).open("rb") as stream:
            return stream.read(4) == b"PAR1"
    except OSError:
        return False  # what cannot be read is refused where it is read


def _read_parquet(path: str | os.PathLike[str], kept: tuple[str, str] | None) -> Table:
    require_extra(Path(path), "a Parquet file", "pyarrow", "parquet")
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Column] = {}
    try:
        schema = parquet.read_schema(path)
        texts = [
            field.name
            for field in schema
            if pa.types.is_string(field.type) or pa.types.is_large_string(field.type)
        ]
        for name in schema.names:  # one by one, so that only one is there twice
            table = parquet.read_table(
                path, columns=[name], read_dictionary=texts, filters=_filter(schema, kept)
            )
            columns[name] = _column(table.column(0), str(path), name)
            del table
            pa.default_memory_pool().release_unused()
    except (pa.ArrowException, OSError) as error:
        said = " ".join(str(error).split())[:200]
        raise MultiposError(
            f"{path}: cannot be read as Parquet ({said}); write it again."
        ) from None
    rows = max(map(len, columns.values()), default=0)
    if not rows and kept is None:
        raise MultiposError(f"{path}: no rows; give one row per unit and position.")
    return Table(str(path), columns, rows, sha256=_sha256(path))


def _filter(schema: Any, kept: tuple[str, str] | None) -> Any:
    """Return what keeps the rows of one unit, whose name may be a number in the file."""
    import pyarrow as pa
    from pyarrow import compute

    if kept is None or kept[0] not in schema.names:
        return None  # a column that is not there is refused with the others named
    name, unit = kept
    return compute.field(name).cast(pa.string()) == unit


def _column(chunked: Any, source: str, name: str) -> Column:
    import pyarrow as pa

    kind = chunked.type
    if not len(chunked):
        return np.zeros(0)
    if pa.types.is_dictionary(kind) and not pa.types.is_floating(kind.value_type):
        return joined_labels([_labels(part) for part in chunked.chunks])
    try:
        return np.asarray(chunked.to_numpy())
    except (pa.ArrowException, ValueError):
        raise MultiposError(
            f"{source}: column '{name}' holds {kind}, which is no number and no text; leave it out."
        ) from None


def _labels(part: Any) -> Labels:
    """Return a dictionary of Arrow as labels; what is missing is ''."""
    names = ["" if text is None else str(text) for text in part.dictionary.to_pylist()]
    indices = part.indices
    if indices.null_count:
        indices = indices.fill_null(len(names))
        names.append("")
    return Labels(indices.to_numpy(zero_copy_only=False).astype(np.int32), names)


def _sha256(path: str | os.PathLike[str]) -> str:
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

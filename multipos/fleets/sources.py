"""The rows of a fleet: tables in files, folders and patterns, one row per unit and position.

- `read_rows` returns the `Rows` of tables and whose they are, `Owners`.
- `average_logs` returns the means of raw logs, by how `Averaging` says.

A file is CSV or JSON, packed or not, or Parquet by the extra ``parquet``; a folder stands for all
such files in it, a pattern (``line-*.csv``) for those it fits, in the order of their names. Where
no column names the unit, several files are one unit each, by their names; one that cannot be read
is a failed unit. Raw logs are averaged first, each one unit: `average_logs`.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property, partial
from glob import glob, has_magic
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files import handed, spelling
from multipos.files.csv_columns import joined_cells
from multipos.files.pipes import Pipe, is_folder, is_pipe, is_there, rereadable
from multipos.files.spelling import StrPath
from multipos.files.tables import Source, Table, open_table, read_table
from multipos.files.whole import sha256_of
from multipos.files.written_units import split_unit
from multipos.finding import Findings, repeated_files
from multipos.fitting.calibrate_logs import rests_or_rows
from multipos.fleets.labels import Labels, joined_columns, joined_labels, labels_of
from multipos.numerics.arrays import Array
from multipos.positions.headers import is_environment
from multipos.results import frozen

_ENDINGS = (".csv", ".parquet")
_PACKED = (".gz", ".xz", ".zst")
_LOGS = (
    *(".csv", ".txt", ".tsv", ".log", ".dat", ".parquet", ".feather", ".h5", ".mat", ".xlsx"),
    *(".xls", ".ulg", ".bin", ".bag", ".db3", ".mcap"),
)
_UNIT = "unit"  # the column of units where none is named


class Owners(NamedTuple):
    """The unit and the station of every row; a single station '' where no column names them."""

    unit: Labels
    station: Labels


@frozen(eq=True)
class Rows:
    """All rows of a fleet, in one or several tables that have the same columns.

    Attributes
    ----------
    tables : tuple of Table
        Without the columns of unit and station.
    counted : bool
        Units are whole numbers in the tables, and not texts that look like some.
    unit_column : str or None
        None where files name the units.
    failed : tuple of (unit, reason)
        Files that are units and cannot be read.
    findings : tuple of Finding
    """

    tables: tuple[Table, ...]
    counted: bool = False
    unit_column: str | None = None
    failed: tuple[tuple[str, str], ...] = ()
    findings: Findings = ()

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """First row of each table, and the number of all."""
        return tuple(accumulate((table.rows for table in self.tables), initial=0))

    @property
    def count(self) -> int:
        """How many rows there are."""
        return self.starts[-1]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that are left."""
        return tuple(self.tables[0].columns)

    def select(self, rows: Sequence[int]) -> Table:
        """Return some rows as a table; messages still name file and line where it is one file."""
        if len(self.tables) == 1:
            return self.tables[0].select(rows)
        row = np.asarray(rows)
        places = np.searchsorted(self.starts[1:], row, side="right")
        parts = [
            self.tables[place].select((row[places == place] - self.starts[place]).tolist())
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

    def written(self, name: str) -> str:
        """Return a name as the header has it, with its unit in brackets or without."""
        bare = (each for each in self.columns if split_unit(each)[0] == name)
        return name if name in self.columns else next(bare, name)

    def numbers(self, name: str) -> Array:
        """Return a column as numbers, NaN where a cell is none."""
        tables = _joined(self.tables, name) or self.tables
        parts = [table.numbers(name) for table in tables]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def is_text(self, name: str) -> bool:
        """Tell whether a column is kept as text, in any of the tables."""
        return not all(_are_numbers(table, name) for table in self.tables)

    def conditions(self, name: str) -> Labels:
        """Return a column as labels; the fit checks them."""
        if joined := _joined(self.tables, name):
            return labels_of(joined[0], name, checked=False)
        return joined_labels([labels_of(table, name, checked=False) for table in self.tables])


def _are_numbers(table: Table, name: str) -> bool:
    """Tell whether a column is kept as numbers."""
    column = table.columns[name]
    return isinstance(column, np.ndarray) and column.dtype.kind in "fiub"


def _joined(tables: Sequence[Table], name: str) -> tuple[Table, ...]:
    """Return the same column of short tables as one table; none where they are other ones."""
    cells = joined_cells([table.columns[name] for table in tables]) if len(tables) > 1 else None
    return () if cells is None else (replace(tables[0], columns={name: cells}, rows=len(cells)),)


def read_rows(
    sources: Sequence[Source],
    unit_column: str | None,
    station_column: str | None = None,
    only: str | None = None,
    raw: "Averaging | None" = None,
) -> tuple[Rows, Owners]:
    """Return the rows of tables, and whose each is.

    Parameters
    ----------
    sources : paths, folders, patterns, mappings of columns, or data frames, or lists of them
    unit_column, station_column : str, optional
        Which columns name the unit and the station; without the first `unit`, or the files.
    only : str, optional
        A unit, of which at least all rows are returned; of raw logs no others.
    raw : Averaging, optional
        The tables are raw logs, of one unit each, which are averaged so.

    Raises
    ------
    MultiposError
        No such file or column, a table that cannot be read, or one whose columns differ from
        those of the first; a row without a unit.
    UsageError
        Nothing names the units.
    """
    files = _expanded(sources, _ENDINGS if raw is None else _LOGS)
    named = _file_units(files)
    if raw is not None:
        files, named = _of_unit_alone(files, named, only)
        read = average_logs(files, raw)
    else:
        read = [_tried(source, alone=len(files) == 1) for source in files]
    alone = len(files) == 1
    findings = _drop_repeated(read, named)
    if findings:
        kept_files = [place for place, table in enumerate(read) if table is not None]
        files, read = [files[i] for i in kept_files], [read[i] for i in kept_files]
        # a copy that is gone names no folder
        named = _file_units(files) if raw is None or only is None else [only] * len(files)
    foreign = _drop_foreign(read) if all(map(_is_path, files)) else {}
    if unit_column is None:
        read_tables = [table for table in read if isinstance(table, Table)]
        if read_tables and all(_UNIT in table for table in read_tables):
            unit_column = _UNIT
        elif raw is None and ((alone and only is None) or not all(map(_is_path, files))):
            raise UsageError(
                f"{read_tables[0].source} has no column '{_UNIT}'; name the column of units with "
                "--unit-column, or give several files, one per unit."
            )
    labelled = {name for name in (unit_column, station_column) if name is not None}
    read = [_labelled(table, labelled, alone=alone) for table in read]
    names = [name for name, table in zip(named, read, strict=True) if isinstance(table, Table)]
    tables = [table for table in read if isinstance(table, Table)]
    failed = tuple(
        (unit, str(error))
        for place, (name, error) in enumerate(zip(named, read, strict=True))
        if isinstance(error, Exception)
        for unit in _units_in(foreign.get(place), unit_column, name)
    )
    if not tables:
        raise MultiposError(failed[0][1])
    if unit_column is None:
        tables = [_of_unit(table, name) for table, name in zip(tables, names, strict=True)]
    key = unit_column or _UNIT
    for table in tables:
        _require_columns(table, tables[0], key, station_column)
    unit = joined_labels([labels_of(table, key) for table in tables])
    _require_units(tables, unit, key)
    station = Labels(np.zeros(len(unit), dtype=np.int32), ("",))
    if station_column is not None:
        station = joined_labels([labels_of(table, station_column) for table in tables])
    left = tuple(_without(table, {key, station_column}) for table in tables)
    rows = Rows(left, _are_counted(tables, key), unit_column, failed, findings)
    return rows, Owners(unit, station)


def _tried(source: Source, *, alone: bool) -> Table | MultiposError | None:
    """Return a table; of a file among others, why it cannot be read."""
    try:
        return _read(source)
    except MultiposError as error:
        if alone or not _is_path(source):
            raise
        return error


def _is_path(source: Source) -> TypeGuard[StrPath]:
    return isinstance(source, str | os.PathLike)


def _file_units(files: Sequence[Source]) -> list[str]:
    """Return the units that files name: without ending, with their folder where names repeat.

    A link has the name of its file.
    """
    stems = [_unpacked(_linked(Path(str(file)))).stem if _is_path(file) else "" for file in files]
    if len(set(stems)) == len(stems):
        return stems
    paths = [Path(str(file)) if _is_path(file) else Path() for file in files]
    folders = [f"{p.absolute().parent.name}/{n}" for p, n in zip(paths, stems, strict=True)]
    for longer in (folders, [*map(str, paths)]):
        often = Counter(stems)
        stems = [long if often[n] > 1 else n for n, long in zip(stems, longer, strict=True)]
    return stems


def _linked(path: Path) -> Path:
    """Return the file that a link is of."""
    return path.resolve() if path.is_file() else path


def _drop_repeated(read: list[Table | MultiposError | None], named: Sequence[str]) -> Findings:
    """Take files out that hold, packed or not, what one before them holds, and say which."""
    tables = (table if isinstance(table, Table) else None for table in read)
    contents = [None if table is None else table.content or table.sha256 for table in tables]
    again = handed.find_copies(contents, named)
    for place in again:
        read[place] = None
    return repeated_files(again.values())


def _drop_foreign(read: list[Table | MultiposError | None]) -> dict[int, Table]:
    """Put in place of every table with other columns than most have why it is none of them.

    Returns
    -------
    dict of int to Table
        The tables taken out, by their place.
    """
    kinds = [frozenset(table.columns) for table in read if isinstance(table, Table)]
    foreign: dict[int, Table] = {}
    if not kinds:
        return foreign
    usual, _ = Counter(kinds).most_common(1)[0]
    for place, table in enumerate(read):
        if isinstance(table, Table) and (odd := set(table.columns) ^ usual):
            foreign[place] = table
            read[place] = MultiposError(
                f"{table.source}: column {spelling.quoted(sorted(odd))} is not in both it and the "
                "other files; give tables with the same columns."
            )
    return foreign


def _labelled(
    table: Table | MultiposError | None, names: set[str], *, alone: bool
) -> Table | MultiposError | None:
    """Return a table whose texts in some columns are labels; of a file among others, why not."""
    if not isinstance(table, Table):
        return table
    texts = [name for name in names if name in table.columns and not _are_numbers(table, name)]
    try:
        labels = {name: labels_of(table, name) for name in texts}
    except MultiposError as error:
        if alone:
            raise
        return error
    return replace(table, columns={**table.columns, **labels}) if labels else table


def _units_in(table: Table | None, unit_column: str | None, name: str) -> tuple[str, ...]:
    """Return the units of a table that is not used: those of its column, else its file's name."""
    if table is None or unit_column is None or unit_column not in table:
        return (name,)
    return tuple(filter(None, labels_of(table, unit_column).names)) or (name,)


def _of_unit(table: Table, name: str) -> Table:
    """Return a table whose rows are all of one unit."""
    unit = Labels(np.zeros(table.rows, dtype=np.int32), (name,))
    return replace(table, columns={**table.columns, _UNIT: unit})


def _require_columns(table: Table, first: Table, unit: str, station: str | None) -> None:
    """Refuse a table without the columns that name units, or with others than the first."""
    for name in (unit, station):
        if name is not None and name not in table:
            raise MultiposError(
                f"{table.source}: no column '{name}'{spelling.near(name, list(table.columns))} The "
                f"columns are {spelling.quoted(table.columns)}."
            )
    if set(table.columns) != set(first.columns):
        odd = set(table.columns) ^ set(first.columns)
        raise MultiposError(
            f"{table.source}: column {spelling.quoted(sorted(odd))} is not in both it and "
            f"{first.source}; give tables with the same columns."
        )


def _are_counted(tables: Sequence[Table], name: str) -> bool:
    kinds = [getattr(table.columns[name], "dtype", np.dtype(object)) for table in tables]
    return all(kind.kind in "iu" and np.can_cast(kind, np.int64) for kind in kinds)


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
        raise MultiposError(f"{table.source}: there is no column but the unit's.")
    return replace(table, columns=columns)


@frozen(eq=True)
class Averaging:
    """How raw logs are averaged: options of `average`, and what runs them if not this thread."""

    options: Mapping[str, Any]
    executor: Executor | None


def average_logs(files: Sequence[Source], how: Averaging) -> list[Table | MultiposError | None]:
    """Return the means of raw logs as tables; where there are none, why not."""
    called = partial(_averaged, options=dict(how.options))
    return list((how.executor.map if how.executor else map)(called, files))


def _averaged(source: Source, options: Mapping[str, Any]) -> Table | MultiposError:
    """Return the means of a log, or rows of a waved one: outputs with their unit, and the rest."""
    try:
        found = rests_or_rows(source, **options)
    except MultiposError as error:
        return MultiposError(str(error))  # as it goes to another process and back
    unit = "" if found.unit is None else f" [{found.unit}]"
    beside = {f"{p}_{output}" for p in ("sd", "u", "dof") for output in found.outputs}
    columns = {
        f"{name}{unit}" if name in found.outputs else name: column
        for name, column in found.columns().items()
        if name in ("position", "n", *found.outputs, *beside) or is_environment(name)
    }
    table = read_table(columns, what="log")
    if not _is_path(source):
        return table
    sha256 = sha256_of(source, "log")
    return replace(table, source=str(source), sha256=sha256, content=handed.content_of(source))


def _of_unit_alone(
    files: Sequence[Source], named: list[str], only: str | None
) -> tuple[list[Source], list[str]]:
    """Return the logs with their units, of one unit where it is the only one wanted."""
    wanted = [place for place, name in enumerate(named) if only in (None, name)]
    if not wanted:  # the one of several copies that is left is called so
        wanted = [i for i, file in enumerate(files) if only == _unpacked(Path(str(file))).stem]
    if not wanted:
        raise MultiposError(f"no unit '{only}' among the logs; look at units.csv.")
    return [files[place] for place in wanted], [named[place] for place in wanted]


def _expanded(sources: Sequence[Source], endings: Sequence[str]) -> list[Source]:
    """Return sources with folders and patterns replaced by the files they stand for."""
    found: list[Source] = []
    for source in sources:
        if isinstance(source, list | tuple):
            found += _expanded(source, endings)
        else:
            given = handed.take_in(source, "table")
            found += _files(given, endings) if _is_path(given) else [given]
    if not found:
        raise MultiposError("no table; give at least one.")
    return found


def _files(source: StrPath, endings: Sequence[str]) -> Sequence[Source]:
    """Return the files that a path, a folder or a pattern stands for."""
    name = os.fspath(source)
    if is_folder(name):
        every = sorted(Path(name).iterdir())
        files = [path for path in every if _unpacked(path).suffix.casefold() in endings]
        if not files:
            raise MultiposError(f"{name}: the folder has no {' or '.join(endings)} files.")
        return files
    if has_magic(name) and not is_there(name):
        fitting = sorted(glob(name, recursive=True))  # noqa: PTH207 – any path, not one below
        if not fitting:
            raise MultiposError(f"{name}: no file fits the pattern; check the path.")
        return fitting
    return [rereadable(source)]


def _unpacked(path: Path) -> Path:
    """Return a path without the ending of what has packed it."""
    return path.with_suffix("") if path.suffix in _PACKED else path


def _read(source: Source) -> Table:
    if not _is_path(source):
        return read_table(source, what="table")
    if is_pipe(source) and not isinstance(source, Pipe):
        raise MultiposError(f"{source}: a pipe or a device; only files of a folder are read.")
    return open_table(source, "table")

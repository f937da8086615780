"""Parquet files of a fleet, read as far as they are needed.

- `is_parquet` says whether a source is such a file, `read_parquet` opens it, `spread_parquet`
  copies rows of it; `is_in_file` says whether a column is still there, a `FileColumn`.

They are read in this process, other than a log (`multipos.logs.extras`): texts stay what they
are in the file, a dictionary and numbers. A column stays in its file until rows of it are asked
for; what a file gives only together is a row group.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.csv_columns import FileBytes
from multipos.files.handed import require_extra
from multipos.files.spelling import StrPath
from multipos.files.tables import Column, Table
from multipos.fleets.labels import Labels, joined_labels
from multipos.numerics.arrays import places_of_kinds

_BATCH = 500_000  # rows that are copied at a time
_BUFFER = 1 << 20  # bytes of a column that are read ahead


class FileColumn(Sequence[Any]):
    """A column of a Parquet file, of which rows are read when they are asked for.

    Attributes
    ----------
    largest : int
        Rows of the largest row group.
    """

    def __init__(self, path: StrPath, name: str, groups: Mapping[int, int]) -> None:
        """Name a column in some groups of a file, each with its number of rows."""
        self.path: StrPath = path
        self._name = name
        self._groups, self._ends = list(groups), np.cumsum(list(groups.values()))
        self.largest: int = max(groups.values())

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, row: int | slice) -> Any:
        if isinstance(row, slice):
            start, stop, _ = row.indices(len(self))
            return self._rows(start, stop)
        return self._rows(row, row + 1)[0]

    def _rows(self, start: int, stop: int) -> Column:
        first, last = np.searchsorted(self._ends, [start, stop - 1], side="right").tolist()
        before = int(self._ends[first - 1]) if first else 0
        groups = self._groups[first : last + 1]
        return _read_column(self.path, self._name, groups, start - before, stop - start)


def is_in_file(column: Column) -> TypeGuard[FileColumn]:
    """Tell whether a column still is in its file."""
    return isinstance(column, FileColumn)


def is_parquet(head: bytes) -> bool:
    """Tell by its first bytes whether a file is Parquet."""
    return head.startswith(b"PAR1")


def read_parquet(path: StrPath, apart: set[str | None], kept: tuple[str, str] | None) -> Table:
    """Return a file as a table, of which columns beside those `apart` stay in it.

    Parameters
    ----------
    path : path
    apart : set of str
        Columns that are read at once.
    kept : (name, text), optional
        Only rows where this column says so, all columns of them.
    """
    require_extra(Path(path), "a Parquet file", "pyarrow", "parquet")
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            schema, about = file.schema_arrow, file.metadata
        groups = {i: about.row_group(i).num_rows for i in range(about.num_row_groups)}
        if kept is not None:
            columns = _rows_kept(path, schema, kept)
        elif count := sum(groups.values()):
            columns = {
                name: _read_column(path, name, list(groups), 0, count)
                if name in apart
                else FileColumn(path, name, groups)
                for name in schema.names
            }
        else:
            raise MultiposError(f"{path}: no rows; give one row per unit and position.")
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, error) from None
    rows = max(map(len, columns.values()), default=0)
    return Table(str(path), columns, rows, sha256=FileBytes(path, "table").sha256())


def spread_parquet(
    columns: Mapping[str, FileColumn], kinds: NDArray[np.int16], count: int, path: Path
) -> Callable[[int], dict[str, FileColumn]]:
    """Copy the rows of a file into a new one, those of a kind in row groups of their own.

    Parameters
    ----------
    columns : mapping of name to FileColumn
        Whole columns of one file.
    kinds : (n,) array of int
        Of every row, counted from 0; a row below 0 is left out.
    count : int
        How many kinds there are.
    path : path

    Returns
    -------
    callable
        The columns of a kind, with its rows in their order.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    from pyarrow import Table as ArrowTable
    from pyarrow import parquet

    groups: list[dict[int, int]] = [{} for _ in range(count)]
    source, start, written, writer = next(iter(columns.values())).path, 0, 0, None
    with ExitStack() as opened:
        for batch in _batches(source, list(columns)):
            if writer is None:
                writer = opened.enter_context(parquet.ParquetWriter(path, batch.schema))
            mine = kinds[start : start + len(batch)]
            table = ArrowTable.from_batches([batch])
            for kind, rows in places_of_kinds(mine, count):
                writer.write_table(table.take(rows), row_group_size=len(rows))
                groups[kind][written] = len(rows)
                written += 1
            start += len(batch)
    return lambda kind: {name: FileColumn(path, name, groups[kind]) for name in columns}


def _batches(path: StrPath, names: list[str]) -> Iterator[Any]:
    """Yield the rows of a file some at a time, however many a row group has."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path, buffer_size=_BUFFER) as file:
            yield from file.iter_batches(_BATCH, columns=names)
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, error) from None


def _rows_kept(path: StrPath, schema: Any, kept: tuple[str, str]) -> dict[str, Column]:
    """Return all columns of the rows of one unit, one by one so that only one is there twice."""
    import pyarrow as pa
    from pyarrow import compute, parquet

    texts, (column, unit) = _texts(schema), kept
    wanted = None  # a column that is not there is refused with the others named
    if column in schema.names:  # where the name of a unit may be a number
        wanted = compute.field(column).cast(pa.string()) == unit
    columns: dict[str, Column] = {}
    for name in schema.names:
        table = parquet.read_table(path, columns=[name], read_dictionary=texts, filters=wanted)
        columns[name] = _column(table.column(0), str(path), name)
    return columns


def _unreadable(path: StrPath, error: Exception) -> MultiposError:
    said = " ".join(str(error).split())[:200]
    return MultiposError(f"{path}: cannot be read as Parquet ({said}); write it again.")


def _texts(schema: Any) -> list[str]:
    """Return the columns of text, which are read as a dictionary and numbers."""
    import pyarrow as pa

    return [
        field.name
        for field in schema
        if pa.types.is_string(field.type) or pa.types.is_large_string(field.type)
    ]


def _read_column(
    path: StrPath, name: str, groups: Sequence[int], skipped: int, count: int
) -> Column:
    """Return some rows of a column, of the row groups that hold them."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as plain:
            texts = _texts(plain.schema_arrow)
        with parquet.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read_row_groups(list(groups), columns=[name])
        found = _column(table.column(0).slice(skipped, count), str(path), name)
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, error) from None
    del table
    pa.default_memory_pool().release_unused()
    return found


def _column(chunked: Any, source: str, name: str) -> Column:
    import pyarrow as pa

    kind = chunked.type
    if not len(chunked):
        return np.zeros(0)
    if pa.types.is_dictionary(kind) and not pa.types.is_floating(kind.value_type):
        return joined_labels([_labels(part) for part in chunked.chunks])
    try:
        return np.array(chunked.to_numpy())  # a copy, so that the rest of its groups can go
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

"""The rows of a fleet, cut into pieces of whole units, of which one is read at a time.

- `cut_rows` yields each `Cut`: some units and their rows.

Where the rows of a unit stand together, a piece is a stretch of the tables. Where they stand apart,
as in a table that is in the order of positions, all rows of a large fleet are copied once into a
temporary folder, those of a piece together; pieces and their units are the same ones in either way.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.csv_columns import Cells, arrange_cells, spread_cells
from multipos.files.tables import Column, Table
from multipos.fleets.grouping import Grouped
from multipos.fleets.labels import Labels
from multipos.fleets.parquet import is_in_file, spread_parquet
from multipos.fleets.sources import Rows
from multipos.numerics.arrays import Places, places_of_kinds

_PIECE = 1_500_000  # rows of a piece, if nothing that is read together has more

Part = Callable[[int], Mapping[str, Column]]  # columns of a piece


class Cut(NamedTuple):
    """A piece: its rows, their units, and which unit of all is the first of them."""

    rows: Rows
    grouped: Grouped
    first: int


@contextmanager
def cut_rows(rows: Rows, grouped: Grouped, folder: Path | None = None) -> Iterator[Iterator[Cut]]:
    """Give the pieces of the rows of tables, one after another.

    Parameters
    ----------
    rows : Rows
    grouped : Grouped
        Units of all rows, or of some of them.
    folder : path, optional
        Where copies of rows may stand; that of the system for temporary files if not given.

    Raises
    ------
    MultiposError
        A table cannot be read, or the copies cannot be written.
    """
    if grouped.order is None:
        yield _stretches(rows, grouped)
    elif rows.count <= _PIECE:
        yield _gathered(rows, grouped, grouped.order, [None] * len(rows.tables))
    else:
        with _room(folder) as room:
            copied = _copied(rows, grouped, grouped.order, room)
            yield _gathered(rows, grouped, grouped.order, copied)


def _bounds(starts: Places, size: int) -> list[int]:
    """Return the units with which pieces of so many rows begin, and the number of all."""
    bounds, count = [0], len(starts) - 1
    while bounds[-1] < count:
        end = starts[bounds[-1]] + size
        last = bisect_right(starts, end) - 1
        bounds.append(min(max(last, bounds[-1] + 1), count))
    return bounds


def _stretches(rows: Rows, grouped: Grouped) -> Iterator[Cut]:
    for first, last in pairwise(_bounds(grouped.starts, max(_PIECE, rows.largest))):
        start, stop = int(grouped.starts[first]), int(grouped.starts[last])
        yield Cut(rows.piece(start, stop), grouped.piece(first, last), first)


@contextmanager
def _room(folder: Path | None) -> Iterator[Path]:
    """Give a folder that is there as long as the block."""
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        made = TemporaryDirectory(prefix="multipos-", dir=folder)
    except OSError as error:
        raise _no_room(folder or "the folder for temporary files", error) from None
    with made as path:
        yield Path(path)


def _no_room(place: object, error: OSError) -> MultiposError:
    return MultiposError(
        f"{place}: rows of a unit are not contiguous, and a copy of them cannot be kept there: "
        f"{error.strerror or error}; make room, or sort the tables by unit."
    )


def _copied(rows: Rows, grouped: Grouped, order: Places, room: Path) -> list[Part | None]:
    """Copy the rows of every table that is a file, and return what gives those of a piece."""
    bounds = _bounds(grouped.starts, _PIECE)
    pieces = np.full(rows.count, -1, dtype=np.int16)
    for piece, (first, last) in enumerate(pairwise(bounds)):
        pieces[order[grouped.starts[first] : grouped.starts[last]]] = piece
    return [
        _copy(table.columns, pieces[start : start + table.rows], len(bounds) - 1, room / str(i))
        for i, (table, start) in enumerate(zip(rows.tables, rows.starts[:-1], strict=True))
    ]


def _copy(columns: Any, pieces: NDArray[np.int16], count: int, path: Path) -> Part | None:
    one = next(iter(columns.values()))
    try:
        if isinstance(one, Cells):
            return spread_cells(columns, pieces, count, path)
        return spread_parquet(columns, pieces, count, path) if is_in_file(one) else None
    except OSError as error:
        raise _no_room(path.parent, error) from None


def _gathered(
    rows: Rows, grouped: Grouped, order: Places, copied: Sequence[Part | None]
) -> Iterator[Cut]:
    """Yield pieces of rows that stand apart, in every table those of a unit together."""
    for piece, (first, last) in enumerate(pairwise(_bounds(grouped.starts, _PIECE))):
        mine = order[grouped.starts[first] : grouped.starts[last]]
        units = grouped.piece(first, last)
        yield Cut(*_gather(rows, mine, copied, piece, units), first)


def _gather(
    rows: Rows, mine: Places, copied: Sequence[Part | None], piece: int, units: Grouped
) -> tuple[Rows, Grouped]:
    """Return the rows of a piece, which stand at these places, and its units."""
    of_table = np.searchsorted(rows.starts, mine, side="right") - 1
    by_table = list(places_of_kinds(of_table, len(rows.tables)))
    tables = [
        _arranged(rows.tables[i], mine[places] - rows.starts[i], copied[i], piece)
        for i, places in by_table
    ]
    order = np.empty(len(mine), dtype=np.intp)
    order[np.concatenate([places for _, places in by_table])] = np.arange(len(mine))
    return Rows(tuple(tables)), replace(units, order=order)


def _arranged(table: Table, rows: Places, copied: Part | None, piece: int) -> Table:
    """Return the rows of a table that are in a piece, in the order of the units."""
    columns, places = table.columns, rows
    if copied is not None:  # which has these rows only, as they stand in the table
        columns, places = copied(piece), np.argsort(np.argsort(rows))
    lines = None if table.lines is None else np.asarray(_at(table.lines, rows))
    return replace(table, columns=_columns_at(columns, places), rows=len(rows), lines=lines)


def _columns_at(columns: Any, rows: Places) -> Mapping[str, Column]:
    if isinstance(next(iter(columns.values())), Cells):
        return arrange_cells(columns, rows)
    return {name: _at(column, rows) for name, column in columns.items()}


def _at(column: Column, rows: Places) -> Column:
    """Return a column at some rows, in memory."""
    if isinstance(column, range):
        return column.start + rows
    read = column[:] if is_in_file(column) else column
    if isinstance(read, Labels):
        return Labels(read.codes[rows], read.names)
    if isinstance(read, np.ndarray):
        return read[rows]
    return [read[row] for row in rows.tolist()]

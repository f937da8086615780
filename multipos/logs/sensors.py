"""Logs of several sensors whose rows take turns, distinguished by a column.

A column with few values that come in the same order again and again numbers sensors, or samples of
a packet. They are sensors where readings differ more from one row to the next than from one round
to the next.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.finding import Finding
from multipos.logs.table import Log, Piece
from multipos.numerics.arrays import Array, median

_SENSORS = 16  # at most
_ROUNDS = 32  # at least
_SAME = 0.98  # of the rows that go on by turns: some may be lost
_APART = 2.0  # times as far as from one round to the next
_HEAD = 4096  # rows that are looked at


def rows_of_sensor(log: Log, column: str, value: str) -> Log:
    """Return the rows of a log in which a column has a value.

    Raises
    ------
    MultiposError
        There is no such column, or no such row.
    """
    name = log.find(column)
    said = Finding("one-sensor", "note", f"only rows whose '{name}' is {value} are used")
    taken = replace(log, read=partial(_read, log, name, value), notes=(*log.notes, said))
    if not any(piece.table.rows for piece in taken.read((), (), ())):
        raise MultiposError(f"{log.source}: no row has '{name}' = {value}; correct --only.")
    return taken


def _read(
    log: Log,
    column: str,
    value: str,
    names: Sequence[str],
    optional: Sequence[str] = (),
    texts: Sequence[str] = (),
    *,
    lenient: bool = False,
) -> Iterator[Piece]:
    numeric = column in log.numeric
    more = ((*optional, column), texts) if numeric else (optional, (*texts, column))
    first = 0
    for piece in log.read(names, *more, lenient=lenient):
        table = piece.table
        if numeric:
            matches = np.asarray(table.columns[column], dtype=np.float64) == _number(value)
        else:
            matches = np.array([cell == value for cell in table.text(column)])
        rows = np.flatnonzero(matches).tolist()
        kept = {name: _some(cells, rows) for name, cells in table.columns.items()}
        lines = None if table.lines is None else [int(table.lines[row]) for row in rows]
        chosen = replace(table, columns=kept, rows=len(rows), lines=lines, first=first)
        first += len(rows)
        given = piece.lines
        yield Piece(chosen, None if given is None else partial(_lines, given, rows), piece.done)


def _number(value: str) -> float:
    try:
        return float(value)
    except ValueError:
        return np.nan


def _some(cells: Sequence[object] | Array, rows: list[int]) -> Sequence[object] | Array:
    return cells[rows] if isinstance(cells, np.ndarray) else [cells[row] for row in rows]


def _lines(given: Callable[[], list[str]], rows: list[int]) -> list[str]:
    every = given()
    return [every[row] for row in rows]


def refuse_interleaved(table: Table, outputs: Sequence[str], others: Sequence[str]) -> None:
    """Refuse a log in which several sensors take turns, by numbers or texts in its first rows.

    Raises
    ------
    MultiposError
    """
    data = np.array([table.columns[name] for name in outputs], dtype=np.float64)[:, :_HEAD]
    for name in others:
        column = table.columns[name][:_HEAD]
        if isinstance(column, np.ndarray):
            numbers = np.asarray(column, dtype=np.float64)
            names = [f"{cell:g}" for cell in numbers[:_SENSORS].tolist()]
        else:
            names = list(map(str, column))
            numbers = np.unique(names, return_inverse=True)[1].astype(np.float64)
        count = _turns(numbers)
        if count and _differ(data, count):
            raise MultiposError(
                f"{table.source}: {count} sensors take turns, which column '{name}' separates "
                f"({', '.join(names[:count])}); take the rows of one with --only {name}={names[0]}."
            )


def _turns(cells: Array) -> int:
    """Return after how many rows a column begins again, 0 where it does not."""
    again = np.flatnonzero(cells[1 : _SENSORS + 1] == cells[0])
    if not len(again) or not again[0]:
        return 0
    count = int(again[0]) + 1
    if len(cells) < count * _ROUNDS or len(set(cells[:count].tolist())) < count:
        return 0
    same = cells[count:] == cells[:-count]
    return count if float(np.mean(same)) >= _SAME else 0


def _differ(data: Array, count: int) -> bool:
    """Tell whether readings (M, n) differ more between rows than between rounds of them."""
    next_ = np.abs(data[:, 1:] - data[:, :-1])
    round_ = np.abs(data[:, count:] - data[:, :-count])
    with np.errstate(invalid="ignore"):
        usual = [median(each[:, np.isfinite(each).all(axis=0)], axis=1) for each in (next_, round_)]
    return bool((usual[0] > _APART * usual[1]).any())

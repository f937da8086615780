"""Observations: the columns a regression uses, in the rows that are complete.

Rates are formed from the time column where they are asked for (`multipos.regression.rates`). A row
with an empty cell is refused by name and number, or left out on request and counted. Columns that
could only say nothing, or the same as another one, are refused before anything is fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.numerics.arrays import LARGEST, Array
from multipos.regression.correlation import TimeOrder, time_order
from multipos.regression.rates import default_window, smoothed_rate

Rows = NDArray[np.intp]

_SAME = 1e-10  # relative difference below which two columns are one


@dataclass(frozen=True)
class Data:
    """Columns of the rows that are fitted, with their order in time and their clusters."""

    columns: Mapping[str, Array]
    response: Array
    order: TimeOrder | None = None
    cluster: Rows | None = None

    def take(self, rows: Rows) -> "Data":
        """Return some of the rows."""
        return Data(
            {name: column[rows] for name, column in self.columns.items()},
            self.response[rows],
            None if self.order is None else self.order.of(rows),
            None if self.cluster is None else self.cluster[rows],
        )

    def __len__(self) -> int:
        return len(self.response)


@dataclass(frozen=True)
class Observations:
    """What was read: the data, the time column, rates formed with their windows, rows dropped."""

    data: Data
    time: str | None
    rates: dict[str, float]
    dropped: int
    notes: tuple[str, ...]


def read_observations(
    table: Table,
    response: str,
    wanted: Sequence[str],
    *,
    time: str | None = None,
    rate_window: float | None = None,
    cluster: str | None = None,
    drop_missing: bool = False,
    largest: Mapping[str, float],
) -> Observations:
    """Return the columns that are used, in the rows that are complete.

    Parameters
    ----------
    table : Table
    response : str
    wanted : sequence of str
        Columns, or rates to be formed: X_rate of a column X.
    time : str, optional
        The time column; `time` where there is one.
    rate_window : float, optional
        Of rates, in the unit of time.
    cluster : str, optional
    drop_missing : bool
    largest : mapping of str to float
        How large a variable may be for its powers to be numbers.

    Raises
    ------
    MultiposError
        A column is missing, a cell is empty, no number or too large a one.
    """
    if time is None and "time" in table and not table.is_text("time"):
        time = "time"
    formed = [
        name
        for name in dict.fromkeys(wanted)
        if name not in table and name.endswith("_rate") and name.removesuffix("_rate") in table
    ]
    plain = [name for name in wanted if name not in formed]
    sources = [name.removesuffix("_rate") for name in formed]
    needed = list(dict.fromkeys([response, *plain, *sources, *([time] if time else [])]))
    missing = [name for name in [*needed, *([cluster] if cluster else [])] if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: no column '{missing[0]}'; the columns are {', '.join(table.columns)}."
        )
    if formed and time is None:
        raise MultiposError(
            f"{table.source}: no column '{formed[0]}', and no time column to form it from; "
            "name one with --time."
        )
    columns = {
        name: table.number(name, empty=True, largest=largest.get(name, LARGEST)) for name in needed
    }
    kept, notes = _complete(table, columns, drop_missing)
    if len(kept) < table.rows:
        columns = {name: column[kept] for name, column in columns.items()}
    rates = {}
    for name, source in zip(formed, sources, strict=True):
        assert time is not None
        window = default_window(columns[time]) if rate_window is None else rate_window
        columns[name] = smoothed_rate(columns[time], columns[source], window=window)
        rates[name] = window
        far = ~(np.abs(columns[name]) <= largest.get(name, LARGEST))
        if far.any():
            row = int(kept[np.argmax(far)])
            raise MultiposError(
                f"{table.where(row, source)}: the rate there is {columns[name][np.argmax(far)]:g}, "
                f"whose powers are no numbers; check the steps of column '{time}'."
            )
    groups = None
    if cluster is not None:
        labels = np.array(table.text(cluster))[kept]
        groups = np.unique(labels, return_inverse=True)[1]
        if groups.max() == 0:
            raise MultiposError(f"{table.source}: column '{cluster}' holds one cluster only.")
    order = None if time is None else time_order(columns[time])
    data = Data(columns, columns[response], order, groups)
    return Observations(data, time, rates, table.rows - len(kept), notes)


def _complete(
    table: Table, columns: Mapping[str, Array], drop: bool
) -> tuple[Rows, tuple[str, ...]]:
    """Return the rows without an empty cell; refuse the others unless they are to be dropped."""
    bad = {name: np.flatnonzero(~np.isfinite(column)) for name, column in columns.items()}
    rows = np.unique(np.concatenate(list(bad.values())))
    if not len(rows):
        return np.arange(table.rows), ()
    counted = ", ".join(f"{len(where)} in '{name}'" for name, where in bad.items() if len(where))
    named = ", ".join(str(row + 1) for row in rows[:10].tolist())
    named += ", …" if len(rows) > 10 else ""
    if not drop:
        first = next(name for name, where in bad.items() if rows[0] in where)
        raise MultiposError(
            f"{table.where(int(rows[0]), first)}: {len(rows)} of {table.rows} rows have an empty "
            f"cell ({counted}; rows {named}); fill them, or leave them out with --drop-missing."
        )
    if len(rows) == table.rows:
        raise MultiposError(f"{table.source}: every row has an empty cell ({counted}).")
    note = f"{len(rows)} of {table.rows} rows dropped for an empty cell ({counted}; rows {named})"
    return np.setdiff1d(np.arange(table.rows), rows), (note,)


def check_columns(
    source: str, data: Data, response: str, variables: Sequence[str], *, constant: bool
) -> None:
    """Refuse what is constant beside an intercept, and a variable that another one is already."""
    if _still(data.response, constant):
        raise MultiposError(
            f"{source}: the response '{response}' is constant ({data.response[0]:g}), so there is "
            "nothing to describe; give another column."
        )
    for i, name in enumerate(variables):
        column = data.columns[name]
        if _still(column, constant):
            raise MultiposError(
                f"{source}: column '{name}' is constant ({column[0]:g}), so nothing depends "
                "on it; leave it out."
            )
        for other in variables[:i]:
            if _same(data.columns[other], column, constant):
                raise MultiposError(
                    f"{source}: columns '{other}' and '{name}' say the same, one is the other "
                    "in another unit; leave one out."
                )


def _still(column: Array, constant: bool) -> bool:
    """Tell whether a column never changes; without an intercept it may, unless it is zero."""
    if not constant:
        return not column.any()
    return float(np.ptp(column)) <= 1e-14 * float(np.abs(column).max())


def _same(a: Array, b: Array, centred: bool) -> bool:
    x, y = (a - a.mean(), b - b.mean()) if centred else (a, b)
    x, y = x / (np.linalg.norm(x) or 1.0), y / (np.linalg.norm(y) or 1.0)
    return bool(np.linalg.norm(y - (x @ y) * x) <= _SAME)

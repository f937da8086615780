"""Observations: the columns a regression uses, in the rows that are complete.

`read_observations` returns them, with the rates (`multipos.regression.rates`) that are asked for,
and `join_runs` several tables as one, each a run. `check_columns` refuses columns that could only
say nothing, or the same as another one, before anything is fitted; `number_labels` counts runs.

A row with an empty cell is refused by name and number, or left out on request and counted.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.handed import find_copies
from multipos.files.tables import Source, Table, read_table
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import LARGEST, Array, Places, median
from multipos.regression.correlation import TimeOrder, time_order
from multipos.regression.rates import default_window, form_rate, rows_of_runs
from multipos.regression.whitening import Noise
from multipos.results import frozen

Rows = Places
_TIME = re.compile(
    r"time|timestamp|time[ _]stamp|(time|timestamp|t)[ _]?\(?(s|sec|ms|us|ns)\)?"
    r"|(seconds[ _])?elapsed|elapsed[ _]time|seconds|secs?|millis|micros|(utc|unix)[ _]?time"
)
_SAME = 1e-10  # relative difference below which two columns are one


@frozen
class Data:
    """Columns of the rows that are fitted, with order in time, runs and their noise.

    `variances` are those of the terms over the whole table (`multipos.regression.variation`).
    """

    columns: Mapping[str, Array]
    response: Array
    order: TimeOrder
    run: Rows | None = None
    noise: Noise | None = None
    variances: Array | None = None

    def take(self, rows: Rows) -> "Data":
        """Return some of the rows."""
        return Data(
            {name: column[rows] for name, column in self.columns.items()},
            self.response[rows],
            self.order.of(rows),
            None if self.run is None else self.run[rows],
            self.noise,
            self.variances,
        )

    def __len__(self) -> int:
        return len(self.response)


@frozen(eq=True)
class Observations:
    """What was read: the data, the time column, rates formed with their windows, rows dropped."""

    data: Data
    time: str | None
    rates: dict[str, float]
    dropped: int
    findings: Findings


RUN = "run"  # the column that tells joined files apart


def join_runs(sources: Sequence[Source], run: str | None = None) -> tuple[Table, str | None]:
    """Return several tables as one, each a switch-on of its own, and the column of the runs.

    Copies are left out; of one table alone no column tells runs apart but one that is named.

    Parameters
    ----------
    sources : sequence of path, mapping of columns, or data frame
        With the same columns.
    run : str, optional
        The column that tells them apart: the name of the file, with what stood there before.

    Raises
    ------
    MultiposError
        A table lacks a column that the first has, or is written otherwise.
    """
    tables = [read_table(source, what="data") for source in sources]
    contents = [table.content or table.sha256 for table in tables]
    again = find_copies(contents, [table.source for table in tables])
    copies = tuple(again.values())
    tables = [table for place, table in enumerate(tables) if place not in again]
    if len(tables) == 1:
        return replace(tables[0], copies=copies), run
    run = run or RUN
    first, columns = tables[0], dict[str, list[Any]]()
    for table in tables[1:]:
        missing = [name for name in first.columns if name not in table]
        if missing or table.delimiter != first.delimiter:
            what = f"no column '{missing[0]}'" if missing else "other marks between its columns"
            raise MultiposError(
                f"{table.source}: {what}, which {first.source} has; give tables of one form."
            )
    for name in first.columns:
        columns[name] = [cell for table in tables for cell in table.columns[name]]
    names = [Path(table.source).stem for table in tables]
    if len(set(names)) < len(names):
        names = [table.source for table in tables]
    if len(set(names)) < len(names):
        names = [str(number) for number in range(1, len(names) + 1)]
    columns[run] = [
        f"{name} {label}" if label else name
        for name, table in zip(names, tables, strict=True)
        for label in (table.text(run) if run in table else [""] * table.rows)
    ]
    known = [table.sha256 for table in tables if table.sha256 is not None]
    table = Table(
        ", ".join(table.source for table in tables),
        columns,
        rows=sum(table.rows for table in tables),
        sha256=sha256("".join(known).encode()).hexdigest() if len(known) == len(tables) else None,
        delimiter=first.delimiter,
        copies=copies,
    )
    return table, run


def read_observations(
    table: Table,
    response: str,
    wanted: Sequence[str],
    *,
    time: str | None = None,
    rate_window: float | None = None,
    causal: bool = False,
    run: str | None = None,
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
    causal : bool
        Rates from the rows up to each.
    run : str, optional
    drop_missing : bool
    largest : mapping of str to float
        How large a variable may be, and its inverse at least, for its powers to be numbers.

    Raises
    ------
    MultiposError
        A column is missing, a cell is empty, no number or too large or small a one.
    """
    time = time or _usual_time(table, (response, *wanted))
    formed = _rates_to_form(table, wanted)
    plain = [name for name in wanted if name not in formed]
    needed = list(dict.fromkeys(filter(None, [response, *plain, *formed.values(), time])))
    _require_columns(table, [*needed, *filter(None, [run])])
    if formed and time is None:
        raise MultiposError(
            f"{table.source}: no column '{next(iter(formed))}', and no time column of numbers "
            "to form it from; name one with --time."
        )
    columns = {
        name: table.number(name, empty=True, largest=largest.get(name, LARGEST)) for name in needed
    }
    kept, found = _complete(table, columns, drop_missing)
    if len(kept) < table.rows:
        columns = {name: column[kept] for name, column in columns.items()}
    runs = None if run is None else _labelled(table, run, kept)
    rates: dict[str, float] = {}
    if time is not None:
        rates = _form_rates(table, columns, kept, formed, time, rate_window, causal, runs, largest)
    _refuse_lost(table.source, {name: columns[name] for name in (response, *wanted)}, largest)
    clock = np.arange(float(len(kept))) if time is None else columns[time]
    order = time_order(clock, runs)
    data = Data(columns, columns[response], order, runs)
    return Observations(data, time, rates, table.rows - len(kept), found)


def _usual_time(table: Table, used: Sequence[str]) -> str | None:
    """Return the time column by its name; None where rows are consecutive.

    `time` is one where it holds numbers; another name must be no variable, and never fall.
    """
    for name in sorted(table.columns, key=lambda name: name != "time"):
        if name in used or not _TIME.fullmatch(name.casefold()) or table.is_text(name):
            continue
        values = table.number(name, empty=True)
        values = values[np.isfinite(values)]
        if name == "time" or not (values[1:] < values[:-1]).any():
            return name
    return None


def _rates_to_form(table: Table, wanted: Sequence[str]) -> dict[str, str]:
    """Return the wanted rates that are no columns, each with the column it is the rate of."""
    absent = [name for name in wanted if name not in table and name.endswith("_rate")]
    sources = {name: name.removesuffix("_rate") for name in absent}
    return {name: source for name, source in sources.items() if source in table}


def _require_columns(table: Table, names: Sequence[str]) -> None:
    missing = [name for name in names if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: no column '{missing[0]}'; the columns are {', '.join(table.columns)}."
        )


def _refuse_lost(source: str, columns: Mapping[str, Array], largest: Mapping[str, float]) -> None:
    """Refuse columns whose powers are lost, and with them what is divided by these."""
    for name, column in columns.items():
        size = float(np.abs(column).max())
        if 0.0 < size * largest.get(name, LARGEST) < 1.0:
            raise MultiposError(
                f"{source}: column '{name}' is {size:g} at most, too small a number to be squared; "
                "give it in a smaller unit."
            )


def _form_rates(
    table: Table,
    columns: dict[str, Array],
    kept: Rows,
    formed: Mapping[str, str],
    time: str,
    rate_window: float | None,
    causal: bool,
    runs: Rows | None,
    largest: Mapping[str, float],
) -> dict[str, float]:
    """Put the rates beside the columns they are formed from; return the window of each."""
    windows = {}
    for name, source in formed.items():
        window = _usual_window(columns[time], runs) if rate_window is None else rate_window
        rate = form_rate(columns[time], columns[source], window=window, causal=causal, run=runs)
        far = ~(np.abs(rate) <= largest.get(name, LARGEST))
        if far.any():
            first = int(np.argmax(far))
            raise MultiposError(
                f"{table.where(int(kept[first]), source)}: the rate there is {rate[first]:g}, "
                f"whose powers are no numbers; check the steps of column '{time}'."
            )
        columns[name], windows[name] = rate, window
    return windows


def _usual_window(time: Array, runs: Rows | None) -> float:
    """Return the default window of a log, in which time may start again with every run."""
    if runs is None:
        return default_window(time)
    windows = [default_window(time[rows]) for rows in rows_of_runs(runs) if len(rows) > 1]
    return float(median(windows)) if windows else np.nan


def _labelled(table: Table, column: str, kept: Rows) -> Rows:
    """Return the number of the run that each row belongs to."""
    groups = number_labels(np.array(table.text(column))[kept])
    if groups.max() == 0:
        raise MultiposError(f"{table.source}: column '{column}' holds one run only.")
    return groups


def number_labels(labels: NDArray[np.str_]) -> Rows:
    """Return labels as numbers from 0, in the order in which they first stand."""
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[numbers]


def _complete(table: Table, columns: Mapping[str, Array], drop: bool) -> tuple[Rows, Findings]:
    """Return the rows without an empty cell; refuse the others unless they are to be dropped."""
    bad = {name: np.flatnonzero(~np.isfinite(column)) for name, column in columns.items()}
    rows = np.unique(np.concatenate(list(bad.values())))
    if not len(rows):
        return np.arange(table.rows), ()
    counted = ", ".join(f"{len(where)} in '{name}'" for name, where in bad.items() if len(where))
    if not drop:
        first = next(name for name, where in bad.items() if rows[0] in where)
        raise MultiposError(
            f"{table.where(int(rows[0]), first)}: {len(rows)} of {table.rows} rows have an empty "
            f"cell ({counted}; rows {_listed(rows)}); fill them, or leave them out with "
            "--drop-missing."
        )
    if len(rows) == table.rows:
        raise MultiposError(f"{table.source}: every row has an empty cell ({counted}).")
    text = (
        f"{len(rows)} of {table.rows} rows were omitted for an empty cell ({counted}; rows "
        f"{_listed(rows)})"
    )
    return np.setdiff1d(np.arange(table.rows), rows), (Finding("dropped-rows", "note", text),)


def _listed(rows: Rows) -> str:
    """Return the first rows by the number a reader counts."""
    named = ", ".join(str(row + 1) for row in rows[:10].tolist())
    return named + (", …" if len(rows) > 10 else "")


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
                    f"{source}: columns '{other}' and '{name}' are the same in two units; leave "
                    "one out."
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

"""The front door `fit_many`: a table of many units, to one row of numbers a unit.

- `fit_many` returns the table; `fit_units` the numbers it is made of, also for a fleet.
- `averaging_options` and `with_rests` are what raw logs take of the options of `fit`.

Every number is that of `fit` of the unit's rows alone; what units share is worked out once
(`multipos.fleets.tasks`).
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from multipos.errors import CalibrationWarning, UsageError
from multipos.files.tables import Source
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import FitOptions, takes_options
from multipos.fleets.grouping import Grouped, group_rows, put_together
from multipos.fleets.labels import Labels, joined_labels
from multipos.fleets.sources import Averaging, Rows, read_rows
from multipos.fleets.tasks import FEWEST, Tasks
from multipos.fleets.unit_results import Units, UnitsFound
from multipos.fleets.workers import open_engine
from multipos.positions.scheme import read_scheme
from multipos.results import Columns
from multipos.uncertainty.budgets import read_budget


@takes_options(FitOptions, fit)
def fit_many(
    *tables: Source,
    unit_column: str | None = None,
    station_column: str | None = None,
    executor: Executor | None = None,
    progress: Callable[[int], object] | None = None,
    **options: Unpack[FitOptions],
) -> Columns:
    """Calibrate every unit of a table, each as `fit` would by itself.

    Parameters
    ----------
    tables : paths, folders, patterns, mappings of columns, or data frames
        One row per unit and position; rows of a unit may stand anywhere. Lists of them, too.
    unit_column, station_column : str, optional
        The columns that name the unit and the station. Without the first, the column `unit`, or
        several files are one unit each, by their names.
    executor : concurrent.futures.Executor, optional
        What runs the tasks; threads of this process if not given.
    progress : callable, optional
        Called with how many units are done.
    options
        Of `fit`; `stepwise` is refused, as all units have one model.

    Returns
    -------
    Columns
        `unit`, `station`, every parameter by name, `u_<name>`, `dof_<name>`, `rms` [g], `findings`
        and, of a unit that failed, `reason`; (B,) each.

    Raises
    ------
    MultiposError
        A table or a column is missing or cannot be read.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> up = mp.read_scheme("faces-6").up
    >>> bias = 0.01 * rng.standard_normal((3, 1, 3))
    >>> values = bias + up + 1e-4 * rng.standard_normal((3, 6, 3))
    >>> table = {"unit": np.repeat(["A", "B", "C"], 6), "position": np.tile(np.arange(1, 7), 3)}
    >>> table |= dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T))
    >>> found = mp.fit_many(table, unit_column="unit", scheme="faces-6")
    >>> list(found)[:4]
    ['unit', 'station', 'bias_ax', 'scale_ax']
    >>> bool(np.abs(found["bias_ax"] - bias[:, 0, 0]).max() < 5e-4)
    True
    """
    report = progress or (lambda done: None)
    found = fit_units(tables, unit_column, station_column, options, executor, report=report)
    return found.columns()


def fit_units(
    tables: Sequence[Source],
    unit_column: str | None,
    station_column: str | None,
    options: Mapping[str, Any],
    executor: Executor | None,
    *,
    folder: Path | None = None,
    report: Callable[[int], object] = lambda done: None,
    fixtures: bool = False,
    raw: bool = False,
) -> Units:
    """Return every unit's numbers; parameters are those of `fit_many`.

    Parameters
    ----------
    raw : bool
        The tables are raw logs, one a unit, which the executor averages first.
    folder : path, optional
        Where finished tasks are kept, and found again.
    fixtures : bool
        Whether sums over the units of one fixture are kept.
    """
    given = _read_options(with_rests(options) if raw else options)
    how = Averaging(averaging_options(options), executor) if raw else None
    rows, owners = read_rows(tables, unit_column, station_column, raw=how)
    grouped = group_rows(owners)
    del owners  # which take memory, and are known by units
    threads = executor is None and len(grouped) >= FEWEST
    opened = open_engine("threads") if threads else nullcontext(executor)
    # what single fits warn of is a column of the result
    with opened as running, warnings.catch_warnings(action="ignore", category=CalibrationWarning):
        return _solve(rows, grouped, given, running, folder, report, fixtures=fixtures)


def averaging_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return what averaging takes of the options of `fit`."""
    names = ("scheme", "order", "convention", "outputs", "field", "unit")
    return {name: options[name] for name in names if options.get(name) is not None}


def with_rests(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `fit` for means of rests: of unknown orientation, as in `calibrate`."""
    stated = ("scheme", "closed_form", "orientation_sd", "level_sd")
    assumed = not any(options.get(name) for name in stated)
    return {**options, **({"unknown_orientation": True} if assumed else {})}


def _solve(
    rows: Rows,
    grouped: Grouped,
    options: dict[str, Any],
    executor: Executor | None,
    folder: Path | None,
    report: Callable[[int], object],
    *,
    fixtures: bool = False,
) -> Units:
    """Return the numbers of units, and behind them files that cannot be read."""
    more, count = len(rows.failed), len(grouped)
    unit, first = grouped.unit, grouped.firsts
    rows, grouped = put_together(rows, grouped)
    tasks = Tasks(rows, grouped, options, fixtures=fixtures)
    found, times = UnitsFound(count + more), np.full(count + more, np.nan)
    for solved in tasks.solve(executor, folder, report):
        found.take(solved)
    if "time" in rows.columns:
        times[:count] = tasks.times()
    if more:
        first = np.append(first, rows.count + np.arange(more))
        names, found.reasons[count:] = zip(*rows.failed, strict=True)
        unit = joined_labels([unit, Labels(np.arange(more, dtype=np.int32), names)])
    return Units(
        unit=unit,
        station=(*grouped.station, *[""] * more),
        model=tasks.model,
        **vars(found),
        first=first,
        time=times,
        confidence=float(options.get("confidence", 0.95)),
        gravity_u=tasks.gravity_u,
        sources=tuple((table.source, table.sha256) for table in rows.tables),
        counted=rows.counted and not more,
        key=rows.unit_column,
        notes=(*rows.findings, *tasks.notes),
    )


def _read_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with the files that they name read once."""
    given = dict(options)
    if given.pop("stepwise", False):
        raise UsageError("--stepwise gives every unit another model; choose one for all of them.")
    if given.get("scheme") is not None:
        given["scheme"] = read_scheme(given["scheme"], order=given.pop("order", "paper"))
    if given.get("budget") is not None:
        given["budget"] = read_budget(given["budget"])
    return given

"""The front door `fit_many`: a table of many units, to one row of numbers a unit.

Every number is that of `fit` of the unit's rows alone; what units share is worked out once. Rows of
files are read and solved piece by piece, so that only what is found of every unit stays in memory.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import CalibrationWarning, UsageError
from multipos.estimation.losses import Loss
from multipos.files.lists import Names
from multipos.files.tables import Source
from multipos.fleets.cutting import cut_rows
from multipos.fleets.grouping import Grouped, group_rows
from multipos.fleets.labels import Codes
from multipos.fleets.piecewise import Known, Piece
from multipos.fleets.repeats import find_trials, gather_study
from multipos.fleets.running import open_engine
from multipos.fleets.sources import Rows, read_rows
from multipos.fleets.units import Units, UnitsFound
from multipos.numerics.arrays import Places
from multipos.positions.attitudes import Convention
from multipos.positions.scheme import Scheme, read_scheme
from multipos.results import Columns
from multipos.sensor.expressions import Expression
from multipos.sensor.model import Gauge
from multipos.uncertainty.budgets import Budget, BudgetSource, read_budget


class FitOptions(TypedDict, total=False):
    """Options of `multipos.fit`, which `fit_many` and `fleet` hand on for every unit."""

    scheme: "Source | Scheme | None"
    model: str | Expression
    convention: Convention
    outputs: Names | None
    axes: Names | None
    inputs: Names
    closed_form: bool
    unknown_orientation: bool
    orientation_sd: float | Literal["auto"] | None
    gauge: Gauge
    robust: Loss | None
    pool: bool
    stepwise: bool
    reading_sd: ArrayLike | None
    gravity: float | None
    gravity_u: float | None
    latitude: float | None
    height: float | None
    level_sd: float
    budget: "BudgetSource | Budget | None"
    unit: str | None
    range: Sequence[float] | None
    confidence: float


def fit_many(
    *tables: Source,
    unit_column: str,
    station_column: str | None = None,
    executor: Executor | None = None,
    progress: Callable[[int], object] | None = None,
    **options: Unpack[FitOptions],
) -> Columns:
    """Calibrate every unit of a table, each as `fit` would by itself.

    Parameters
    ----------
    tables : paths, folders, patterns, mappings of columns, or data frames
        One row per unit and position; rows of a unit may stand anywhere.
    unit_column, station_column : str
        The columns that name the unit and, optional, the station.
    executor : concurrent.futures.Executor, optional
        What runs the tasks; threads of this process if not given.
    progress : callable, optional
        Is told how many units are done.
    options
        Of `fit`; `stepwise` is refused, as all units have one model.

    Returns
    -------
    Columns
        `unit`, `station`, every parameter by name, `u_<name>`, `dof_<name>`, `rms` [g], `doubts`
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
    opened = open_engine("threads") if executor is None else nullcontext(executor)
    with opened as running:
        found = fit_units(
            tables,
            unit_column,
            station_column,
            options,
            running,
            told=progress or (lambda done: None),
        )
    return found.columns()


def fit_units(
    tables: Sequence[Source],
    unit_column: str,
    station_column: str | None,
    options: Mapping[str, Any],
    executor: Executor,
    *,
    folder: Path | None = None,
    told: Callable[[int], object] = lambda done: None,
    study: bool = False,
) -> Units:
    """Return every unit's numbers; parameters are those of `fit_many`.

    Parameters
    ----------
    folder : path, optional
        Where finished tasks are kept, and found again.
    study : bool
        Whether repeats of units at several stations are fitted one by one as well.
    """
    given = _read_options(options)
    rows = read_rows(tables, unit_column, station_column)
    grouped = group_rows(rows)
    rows = rows.without_labels()
    with _quiet():
        units = _solve(rows, grouped, given, executor, folder, told)
        trials = find_trials(rows, grouped) if study else None
        if trials is None:
            return units
        each = _solve(rows, trials.grouped, given, executor, folder, lambda done: None)
    usable = ~each.failed & ~each.implausible & (each.names == units.names)
    return replace(units, study=gather_study(trials, each.parameters, usable))


def _solve(
    rows: Rows,
    grouped: Grouped,
    options: dict[str, Any],
    executor: Executor,
    folder: Path | None,
    told: Callable[[int], object],
) -> Units:
    """Return the numbers of units, piece by piece."""
    known = Known(options)
    found, times = UnitsFound(len(grouped)), np.full(len(grouped), np.nan)
    stations = _in_order_of_coming(grouped.station.codes)
    with cut_rows(rows, grouped, folder) as cuts:
        for cut in cuts:
            mine = slice(cut.first, cut.first + len(cut.grouped))
            piece = Piece(cut.rows, cut.grouped, stations[mine], cut.first, known)
            for solved in piece.solve(executor, folder, told):
                found.take(solved)
            times[mine] = piece.times()
            del cut, piece  # before the next one is read
    return Units(
        unit=grouped.unit,
        station=tuple(grouped.station),
        model=known.model,
        names=found.names,
        parameters=found.parameters,
        u=found.u,
        dof=found.dof,
        rms=found.rms,
        doubts=found.doubts,
        implausible=found.implausible,
        reasons=found.reasons,
        first=grouped.firsts,
        time=times,
        nests=tuple(found.nests),
        confidence=float(options.get("confidence", 0.95)),
        gravity_u=known.gravity_u,
        sources=tuple((table.source, table.sha256) for table in rows.tables),
        counted=rows.counted,
    )


def _read_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with the files that they name read once."""
    given = dict(options)
    if given.pop("stepwise", False):
        raise UsageError("--stepwise gives every unit another model; choose one for all of them.")
    if given.get("scheme") is not None:
        given["scheme"] = read_scheme(given["scheme"])
    if given.get("budget") is not None:
        given["budget"] = read_budget(given["budget"])
    return given


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out the warnings of single fits: what they say is a column of the result."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        yield


def _in_order_of_coming(codes: Codes) -> Places:
    """Return codes (B,) as 0, 1, … in the order in which they first come."""
    _, first, inverse = np.unique(codes, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[inverse])

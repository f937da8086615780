"""The front door `fit_many`: a table of many units, to one row of numbers a unit.

Every number is that of `fit` of the unit's rows alone; what units share is worked out once. The
first unit whose columns can be read says which columns are outputs, for all of them.
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

from multipos.errors import CalibrationWarning, MultiposError, UsageError
from multipos.estimation.losses import Loss
from multipos.files.lists import Names
from multipos.files.tables import Source
from multipos.fleets.grouping import Conditions, Grouped, Places, group_rows
from multipos.fleets.labels import Codes
from multipos.fleets.repeats import find_trials, gather_study
from multipos.fleets.running import open_engine, solve_all
from multipos.fleets.solving import LEFT, Pattern, Task, find_pattern, fit_one
from multipos.fleets.sources import Rows, read_rows
from multipos.fleets.units import Units, UnitsFound
from multipos.numerics.arrays import Array
from multipos.numerics.terms import formula_columns
from multipos.positions.attitudes import Convention
from multipos.positions.reading_tables import read_readings
from multipos.positions.scheme import Scheme, read_scheme
from multipos.positions.stated_noise import spread_reading_sd
from multipos.results import Columns
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import Expression
from multipos.sensor.model import Gauge, Model
from multipos.uncertainty.budgets import Budget, BudgetSource, read_budget

_READINGS = 200_000  # of an output in a task
_ALONE = 64  # units of a task that are fitted one by one
_TRIED = 3  # units of a group that may be at fault before it is taken one by one
_FEWEST = 2  # units that share anything


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
    with _quiet():
        units = _Fleet(rows, grouped, given).solve(executor, folder, told)
        trials = find_trials(rows, grouped) if study else None
        if trials is None:
            return units
        each = _Fleet(rows, trials.grouped, given).solve(executor, folder, lambda done: None)
    usable = ~each.failed & ~each.implausible & (each.names == units.names)
    return replace(units, study=gather_study(trials, each.parameters, usable))


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


class _Fleet:
    """The units while they are solved."""

    def __init__(self, rows: Rows, grouped: Grouped, options: dict[str, Any]) -> None:
        self._rows, self._grouped, self._options = rows, grouped, options
        self._stations = _in_order_of_coming(grouped.station.codes)
        self._model: Model | None = None
        self._gravity_u = 0.0
        outputs = self._outputs()
        self._options = {**options, "outputs": outputs}
        model = options.get("model", "linear")
        used = formula_columns(model) if isinstance(model, str) else ()
        self._conditions = Conditions(rows, grouped, outputs, used)

    def solve(
        self, executor: Executor, folder: Path | None, told: Callable[[int], object]
    ) -> Units:
        """Solve all units, those that batches leave over last."""
        count = len(self._grouped)
        found = UnitsFound(count)
        left: list[Places] = []
        for solved in solve_all(self._tasks(), executor, folder=folder, told=told):
            found.take(solved)
            left.append(solved.units[[reason == LEFT for reason in solved.reasons]])
        rest = np.concatenate(left) if left else np.zeros(0, dtype=np.intp)
        for solved in solve_all(self._alone(rest), executor, folder=folder):
            found.take(solved)
        return Units(
            unit=tuple(self._grouped.unit),
            station=tuple(self._grouped.station),
            model=self._model,
            names=found.names,
            parameters=found.parameters,
            u=found.u,
            dof=found.dof,
            rms=found.rms,
            doubts=tuple(found.doubts),
            implausible=found.implausible,
            reasons=tuple(found.reasons),
            first=self._grouped.firsts,
            time=self._times(),
            nests=tuple(found.nests),
            confidence=float(self._options.get("confidence", 0.95)),
            gravity_u=self._gravity_u,
            sources=tuple((table.source, table.sha256) for table in self._rows.tables),
            counted=self._rows.counted,
        )

    def _outputs(self) -> tuple[str, ...]:
        """Return the outputs, as the first units say them that can be fitted."""
        said = ""
        for unit in range(min(len(self._grouped), _TRIED * 10)):
            fitted = self._fit(unit)
            if isinstance(fitted, Calibration):
                return fitted.outputs
            said = said or fitted
        return self._outputs_by_columns(said)

    def _outputs_by_columns(self, said: str) -> tuple[str, ...]:
        """Return the outputs where none of the first units can be fitted, or say why."""
        model = self._options.get("model", "linear")
        used = formula_columns(model) if isinstance(model, str) else ()
        for unit in range(min(len(self._grouped), _TRIED * 10)):
            try:
                table = self._rows.select(self._grouped.rows(unit).tolist())
                wanted = self._options.get("outputs")
                return read_readings(table, outputs=wanted, environment=used).outputs
            except MultiposError:
                continue
        raise MultiposError(f"none of the first units can be read: {said}")

    def _fit(self, unit: int) -> Calibration | str:
        fitted = fit_one(self._rows.select(self._grouped.rows(unit).tolist()), self._options)
        if isinstance(fitted, Calibration):
            self._know(fitted)
        return fitted

    def _know(self, fitted: Calibration) -> None:
        if self._model is None:
            self._model = fitted.model
            gravity = fitted.gravity
            self._gravity_u = 0.0 if gravity is None else gravity.u / gravity.value

    def _tasks(self) -> Iterator[Task]:
        alone: list[Places] = []
        for units in self._conditions.groups():
            pattern = self._pattern(units) if len(units) >= _FEWEST else None
            if pattern is None:
                alone.append(units)
            else:
                yield from self._batches(units, pattern)
        if alone:
            yield from self._alone(np.sort(np.concatenate(alone)))

    def _pattern(self, units: Places) -> Pattern | None:
        """Return what the units of a group share, from the first of them that can tell it."""
        for unit in units[:_TRIED].tolist():
            fitted = self._fit(unit)
            if isinstance(fitted, Calibration):
                pattern = find_pattern(fitted, self._options)
                if pattern is not None:
                    return pattern
        return None

    def _batches(self, units: Places, pattern: Pattern) -> Iterator[Task]:
        n = int(self._grouped.counts[units[0]])
        size = max(1, _READINGS // n)
        for start in range(0, len(units), size):
            mine = units[start : start + size]
            read = self._conditions
            values = read.of(read.values, mine, n)
            yield Task(
                mine,
                self._stations[mine],
                pattern,
                values,
                {},
                self._options,
                *self._stated(mine, values),
            )

    def _stated(
        self, units: Places, values: tuple[Array, ...]
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return what is stated of the noise of readings, u and its degrees of freedom."""
        read, (count, n) = self._conditions, values[0].shape
        sd = self._options.get("reading_sd")
        if sd is not None:
            u = spread_reading_sd(sd, (n, len(values)))
            return tuple(np.broadcast_to(each, (count, n)) for each in u.T), ()
        return read.of(read.stated, units, n), read.of(read.claimed, units, n)

    def _alone(self, units: Places) -> Iterator[Task]:
        for start in range(0, len(units), _ALONE):
            mine = units[start : start + _ALONE]
            tables = {
                unit: self._rows.select(self._grouped.rows(unit).tolist()) for unit in mine.tolist()
            }
            yield Task(mine, self._stations[mine], None, (), tables, self._options)

    def _times(self) -> Array:
        """Return the mean of the column `time` of every unit, NaN where there is none."""
        count = len(self._grouped)
        if "time" not in self._rows.columns:
            return np.full(count, np.nan)
        try:
            time = self._grouped.arranged(self._rows.numbers("time"))
        except MultiposError:
            return np.full(count, np.nan)
        return np.asarray(np.add.reduceat(time, self._grouped.starts[:-1]) / self._grouped.counts)

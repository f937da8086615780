"""The front door `fit_many`: a table of many units, to one row of numbers a unit.

Every number is that of `fit` of the unit's rows alone; what units share is worked out once. Rows of
files are read and solved piece by piece, so that only what is found of every unit stays in memory.

The rows of a fleet, cut into pieces of whole units, of which one is read at a time.

Where the rows of a unit stand together, a piece is a stretch of the tables. Where they stand apart,
as in a table that is in the order of positions, all rows of a large fleet are copied once into a
temporary folder, those of a piece together; pieces and their units are the same ones in either way.

Units of one piece of a fleet's rows: what they share, and the tasks that solve them.

The first unit whose columns can be read says which columns are outputs, for all of them.
"""

import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import NDArray

from multipos.errors import CalibrationWarning, MultiposError, UsageError
from multipos.files.csv_columns import Cells, arrange_cells, spread_cells
from multipos.files.records import LARGEST
from multipos.files.tables import Column, Source, Table
from multipos.finding import Findings
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import FitOptions, takes_options
from multipos.fleets.grouping import Conditions, Grouped, group_rows
from multipos.fleets.labels import Codes, Labels, joined_labels
from multipos.fleets.parquet import is_in_file, spread_parquet
from multipos.fleets.solving import LEFT, Pattern, Solved, Task, find_pattern, fit_one, gather
from multipos.fleets.sources import Averaging, Rows, read_rows
from multipos.fleets.unit_results import Units, UnitsFound
from multipos.fleets.workers import open_engine, solve_all
from multipos.numerics.arrays import Array, Places, places_of_kinds
from multipos.numerics.terms import formula_columns
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import spread_reading_sd
from multipos.positions.scheme import read_scheme
from multipos.results import Columns
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model
from multipos.uncertainty.budgets import read_budget

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


_READINGS = 96_000  # of an output in a task: what a task costs by itself is then some percent
_SLOW = 2  # so many times fewer where a unit takes long, so that workers share them
_ALONE = 64  # units of a task that are fitted one by one
_TRIED = 3  # units that may be at fault before a group is taken one by one, and outputs are read
_FEWEST = 2  # units that share anything
_FIRST = 30  # units of which outputs are read


class Known:
    """What the first units tell of all.

    Attributes
    ----------
    options : dict
        Of `fit`, with the outputs from when they are known.
    outputs : tuple of str or None
    model : Model or None
    gravity_u : float
        Relative.
    notes : tuple of Finding
        Which columns are no outputs.
    fixtures : bool
        Whether sums over units of one fixture are asked.
    """

    def __init__(self, options: dict[str, Any], *, fixtures: bool) -> None:
        """Begin with the options as they were given."""
        self.options, self.fixtures = options, fixtures
        self.outputs: tuple[str, ...] | None = None
        self.model: Model | None = None
        self.gravity_u = 0.0
        self.notes: Findings = ()

    def learn(self, fitted: Calibration) -> None:
        """Take the model from the first unit that is fitted."""
        if self.model is None:
            self.model = fitted.model
            gravity = fitted.gravity
            self.gravity_u = 0.0 if gravity is None else gravity.u / gravity.value
            self.notes = tuple(f for f in fitted.findings if f.code == "outputs-by-name")

    @property
    def used(self) -> tuple[str, ...]:
        """Columns of the model's formula."""
        model = self.options.get("model", "linear")
        return formula_columns(model) if isinstance(model, str) else ()


class Piece:
    """Units whose rows are there, while they are solved."""

    def __init__(
        self, rows: Rows, grouped: Grouped, stations: Places, first: int, known: Known
    ) -> None:
        """Take units from `first` on, with their stations as numbers."""
        self._rows, self._grouped, self._known = rows, grouped, known
        self._stations, self._first = stations, first
        self._fitted: dict[int, Calibration | str] = {}
        self._taken: set[int] = set()  # of these, those whose numbers are their own fit's
        if known.outputs is None:
            known.outputs = self._outputs()
            known.options = {**known.options, "outputs": known.outputs}

    @cached_property
    def _conditions(self) -> Conditions:
        assert self._known.outputs is not None
        return Conditions(self._rows, self._grouped, self._known.outputs, self._known.used)

    def solve(
        self, executor: Executor | None, folder: Path | None, report: Callable[[int], object]
    ) -> Iterator[Solved]:
        """Yield what is found of the units, of those that batches leave over last."""
        left: list[Places] = []

        def report_all(done: int) -> None:
            report(self._first + done)

        for solved in solve_all(self._tasks(), executor, folder=folder, report=report_all):
            yield solved
            left.append(solved.units[[reason == LEFT for reason in solved.reasons]])
        if left:
            rest = np.concatenate(left) - self._first
            yield from solve_all(self._alone(rest), executor, folder=folder)
        alone = np.array(sorted(self._taken), dtype=np.intp)
        if len(alone):
            yield gather(alone + self._first, [self._fitted[unit] for unit in alone.tolist()])

    def _outputs(self) -> tuple[str, ...]:
        """Return the outputs, as the first units say them that can be fitted, or read."""
        said, first = "", range(min(len(self._grouped), _FIRST))
        for unit in first[:_TRIED]:
            fitted = self._fit(unit)
            if isinstance(fitted, Calibration):
                return fitted.outputs
            said = said or fitted
        for unit in first:  # none can be fitted, but its columns may be read
            try:
                table = self._table(unit)
                wanted = self._known.options.get("outputs")
                return read_readings(table, outputs=wanted, environment=self._known.used).outputs
            except MultiposError:
                continue
        raise MultiposError(f"none of the first units can be read: {said}")

    def _fit(self, unit: int) -> Calibration | str:
        if unit in self._fitted:
            return self._fitted[unit]
        fitted = fit_one(self._table(unit), self._known.options)
        if isinstance(fitted, Calibration):
            self._known.learn(fitted)
        if isinstance(fitted, Calibration) or self._known.outputs is not None:
            self._fitted[unit] = fitted
        return fitted

    def _table(self, unit: int) -> Table:
        """Return the rows of a unit."""
        return self._rows.select(self._grouped.rows(unit).tolist())

    def _tasks(self) -> Iterator[Task]:
        if len(self._grouped) < _FEWEST:
            yield from self._alone(np.arange(len(self._grouped)))
            return
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
                known = self._known
                pattern = find_pattern(
                    fitted, self._table(unit), known.options, fixtures=known.fixtures
                )
                if pattern is not None:
                    return pattern
        return None

    def _batches(self, units: Places, pattern: Pattern) -> Iterator[Task]:
        n = int(self._grouped.counts[units[0]])
        size = max(1, _READINGS // (n if pattern.quick else _SLOW * n))
        for start in range(0, len(units), size):
            mine = units[start : start + size]
            read = self._conditions
            values = read.of(read.values, mine, n)
            time = read.of([self._time], mine, n)[0] if pattern.timed else None
            yield Task(
                mine + self._first,
                self._stations[mine],
                pattern,
                values,
                {},
                self._known.options,
                *self._stated(mine, values),
                time=time,
                temperature=read.of(read.temperature, mine, n),
            )

    def _stated(
        self, units: Places, values: tuple[Array, ...]
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return what is stated of the noise of readings, u and its degrees of freedom."""
        read, (count, n) = self._conditions, values[0].shape
        sd = self._known.options.get("reading_sd")
        if sd is not None:
            u = spread_reading_sd(sd, (n, len(values)))
            return tuple(np.broadcast_to(each, (count, n)) for each in u.T), ()
        return read.of(read.stated, units, n), read.of(read.stated_dof, units, n)

    def _alone(self, units: Places) -> Iterator[Task]:
        """Yield tasks of units that are fitted one by one, without those that are already."""
        self._taken.update(self._fitted.keys() & units.tolist())
        left = [unit for unit in units.tolist() if unit not in self._fitted]
        for start in range(0, len(left), _ALONE):
            mine = np.array(left[start : start + _ALONE], dtype=np.intp)
            tables = {unit + self._first: self._table(unit) for unit in mine.tolist()}
            yield Task(
                mine + self._first, self._stations[mine], None, (), tables, self._known.options
            )

    def times(self) -> Array:
        """Return the mean of the column `time` of every unit, NaN where it holds no numbers."""
        starts, counts = self._grouped.starts[:-1], self._grouped.counts
        return np.asarray(np.add.reduceat(self._time, starts) / counts)

    @cached_property
    def _time(self) -> Array:
        """The column `time` of every row, NaN where it holds no numbers."""
        try:
            time = self._grouped.arranged(self._rows.numbers("time"))
            return np.where(np.abs(time) <= LARGEST, time, np.nan)
        except MultiposError:
            return np.full(self._grouped.starts[-1], np.nan)


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
    threads = executor is None and len(grouped) >= _FEWEST
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
    """Return the numbers of units, piece by piece, and behind them files that cannot be read."""
    known, more = Known(options, fixtures=fixtures), len(rows.failed)
    found, times = UnitsFound(len(grouped) + more), np.full(len(grouped) + more, np.nan)
    unit, first = grouped.unit, grouped.firsts
    if more:
        first = np.append(first, rows.count + np.arange(more))
        names, found.reasons[len(grouped) :] = zip(*rows.failed, strict=True)
        unit = joined_labels([unit, Labels(np.arange(more, dtype=np.int32), names)])
    stations = _in_order_of_coming(grouped.station.codes)
    with cut_rows(rows, grouped, folder) as cuts:
        for cut in cuts:
            mine = slice(cut.first, cut.first + len(cut.grouped))
            piece = Piece(cut.rows, cut.grouped, stations[mine], cut.first, known)
            for solved in piece.solve(executor, folder, report):
                found.take(solved)
            if "time" in cut.rows.columns:
                times[mine] = piece.times()
            del cut, piece  # before the next one is read
    return Units(
        unit=unit,
        station=(*grouped.station, *[""] * more),
        model=known.model,
        **vars(found),
        first=first,
        time=times,
        confidence=float(options.get("confidence", 0.95)),
        gravity_u=known.gravity_u,
        sources=tuple((table.source, table.sha256) for table in rows.tables),
        counted=rows.counted and not more,
        key=rows.unit_column,
        notes=(*rows.findings, *known.notes),
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


def _in_order_of_coming(codes: Codes) -> Places:
    """Return codes (B,) as 0, 1, … in the order in which they first come."""
    coming = codes.tolist()
    rank = {code: place for place, code in enumerate(dict.fromkeys(coming))}
    return np.array([rank[code] for code in coming], dtype=np.intp)

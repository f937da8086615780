"""The tasks of a fleet: what its units share, and in which batches they are solved.

- `Tasks` makes them and yields what they find.

The first unit whose columns can be read says which columns are outputs, for all of them.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import LARGEST
from multipos.files.tables import Table
from multipos.finding import Findings
from multipos.fleets.grouping import Conditions, Grouped
from multipos.fleets.labels import Codes
from multipos.fleets.solving import LEFT, Pattern, Solved, Task, find_pattern, fit_one, gather
from multipos.fleets.sources import Rows
from multipos.fleets.workers import solve_all
from multipos.numerics.arrays import Array, Places
from multipos.numerics.terms import formula_columns
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import spread_reading_sd
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model

_READINGS = 96_000  # of an output in a task: what a task costs by itself is then some percent
_SLOW = 2  # so many times fewer where a unit takes long, so that workers share them
_ALONE = 64  # units of a task that are fitted one by one
_TRIED = 3  # units that may be at fault before a group is taken one by one, and outputs are read
FEWEST = 2  # units that share anything
_FIRST = 30  # units of which outputs are read


class Tasks:
    """The units of a fleet while they are solved, and what the first of them say of all.

    Attributes
    ----------
    options : dict
        Of `fit`, with the outputs.
    model : Model or None
        Of the first unit that was fitted.
    gravity_u : float
        Relative.
    notes : tuple of Finding
        Which columns are no outputs.
    """

    def __init__(
        self, rows: Rows, grouped: Grouped, options: dict[str, Any], *, fixtures: bool
    ) -> None:
        """Take all units; `fixtures` says whether sums over units of one fixture are asked."""
        self._rows, self._grouped, self._fixtures = rows, grouped, fixtures
        self._stations = _in_order_of_coming(grouped.station.codes)
        self._fitted: dict[int, Calibration | str] = {}
        self._taken: set[int] = set()  # of these, those whose numbers are their own fit's
        self.model: Model | None = None
        self.gravity_u = 0.0
        self.notes: Findings = ()
        self.options = options
        formula = options.get("model", "linear")
        self._used = formula_columns(formula) if isinstance(formula, str) else ()
        self._outputs: tuple[str, ...] | None = None
        self._outputs = self._find_outputs()
        self.options = {**options, "outputs": self._outputs}

    @cached_property
    def _conditions(self) -> Conditions:
        assert self._outputs is not None
        return Conditions(self._rows, self._grouped, self._outputs, self._used)

    def solve(
        self, executor: Executor | None, folder: Path | None, report: Callable[[int], object]
    ) -> Iterator[Solved]:
        """Yield what is found of the units, of those that batches leave over last."""
        left: list[Places] = []
        for solved in solve_all(self._tasks(), executor, folder=folder, report=report):
            yield solved
            left.append(solved.units[[reason == LEFT for reason in solved.reasons]])
        if left:
            rest = self._alone(np.concatenate(left))
            yield from solve_all(rest, executor, folder=folder)
        alone = np.array(sorted(self._taken), dtype=np.intp)
        if len(alone):
            yield gather(alone, [self._fitted[unit] for unit in alone.tolist()])

    def _find_outputs(self) -> tuple[str, ...]:
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
                wanted = self.options.get("outputs")
                return read_readings(table, outputs=wanted, environment=self._used).outputs
            except MultiposError:
                continue
        raise MultiposError(f"none of the first units can be read: {said}")

    def _fit(self, unit: int) -> Calibration | str:
        if unit in self._fitted:
            return self._fitted[unit]
        fitted = fit_one(self._table(unit), self.options)
        if isinstance(fitted, Calibration) and self.model is None:
            self.model = fitted.model
            gravity = fitted.gravity
            self.gravity_u = 0.0 if gravity is None else gravity.u / gravity.value
            self.notes = tuple(f for f in fitted.findings if f.code == "outputs-by-name")
        if isinstance(fitted, Calibration) or self._outputs is not None:
            self._fitted[unit] = fitted
        return fitted

    def _table(self, unit: int) -> Table:
        """Return the rows of a unit."""
        return self._rows.select(self._grouped.rows(unit).tolist())

    def _tasks(self) -> Iterator[Task]:
        if len(self._grouped) < FEWEST:
            yield from self._alone(np.arange(len(self._grouped)))
            return
        alone: list[Places] = []
        for units in self._conditions.groups():
            pattern = self._pattern(units) if len(units) >= FEWEST else None
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
                table, fixtures = self._table(unit), self._fixtures
                pattern = find_pattern(fitted, table, self.options, fixtures=fixtures)
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
                mine,
                self._stations[mine],
                pattern,
                values,
                {},
                self.options,
                *self._stated(mine, values),
                time=time,
                temperature=read.of(read.temperature, mine, n),
            )

    def _stated(
        self, units: Places, values: tuple[Array, ...]
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return what is stated of the noise of readings, u and its degrees of freedom."""
        read, (count, n) = self._conditions, values[0].shape
        sd = self.options.get("reading_sd")
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
            tables = {unit: self._table(unit) for unit in mine.tolist()}
            yield Task(mine, self._stations[mine], None, (), tables, self.options)

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


def _in_order_of_coming(codes: Codes) -> Places:
    """Return codes (B,) as 0, 1, … in the order in which they first come."""
    coming = codes.tolist()
    rank = {code: place for place, code in enumerate(dict.fromkeys(coming))}
    return np.array([rank[code] for code in coming], dtype=np.intp)

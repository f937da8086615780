"""Units of one piece of a fleet's rows: what they share, and the tasks that solve them.

The first unit whose columns can be read says which columns are outputs, for all of them.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.fleets.grouping import Conditions, Grouped
from multipos.fleets.running import solve_all
from multipos.fleets.solving import LEFT, Pattern, Solved, Task, find_pattern, fit_one
from multipos.fleets.sources import Rows
from multipos.numerics.arrays import Array, Places
from multipos.numerics.terms import formula_columns
from multipos.positions.reading_tables import read_readings
from multipos.positions.stated_noise import spread_reading_sd
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model

_READINGS = 200_000  # of an output in a task
_ALONE = 64  # units of a task that are fitted one by one
_TRIED = 3  # units of a group that may be at fault before it is taken one by one
_FEWEST = 2  # units that share anything


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
    """

    def __init__(self, options: dict[str, Any]) -> None:
        """Begin with the options as they were given."""
        self.options = options
        self.outputs: tuple[str, ...] | None = None
        self.model: Model | None = None
        self.gravity_u = 0.0

    def learn(self, fitted: Calibration) -> None:
        """Take the model from the first unit that is fitted."""
        if self.model is None:
            self.model = fitted.model
            gravity = fitted.gravity
            self.gravity_u = 0.0 if gravity is None else gravity.u / gravity.value

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
        if known.outputs is None:
            known.outputs = self._outputs()
            known.options = {**known.options, "outputs": known.outputs}
        self._conditions = Conditions(rows, grouped, known.outputs, known.used)

    def solve(
        self, executor: Executor, folder: Path | None, told: Callable[[int], object]
    ) -> Iterator[Solved]:
        """Yield what is found of the units, of those that batches leave over last."""
        left: list[Places] = []

        def told_of_all(done: int) -> None:
            told(self._first + done)

        for solved in solve_all(self._tasks(), executor, folder=folder, told=told_of_all):
            yield solved
            left.append(solved.units[[reason == LEFT for reason in solved.reasons]])
        rest = np.concatenate(left) - self._first if left else np.zeros(0, dtype=np.intp)
        yield from solve_all(self._alone(rest), executor, folder=folder)

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
        for unit in range(min(len(self._grouped), _TRIED * 10)):
            try:
                table = self._table(unit)
                wanted = self._known.options.get("outputs")
                return read_readings(table, outputs=wanted, environment=self._known.used).outputs
            except MultiposError:
                continue
        raise MultiposError(f"none of the first units can be read: {said}")

    def _fit(self, unit: int) -> Calibration | str:
        fitted = fit_one(self._table(unit), self._known.options)
        if isinstance(fitted, Calibration):
            self._known.learn(fitted)
        return fitted

    def _table(self, unit: int) -> Table:
        """Return the rows of a unit."""
        return self._rows.select(self._grouped.rows(unit).tolist())

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
                pattern = find_pattern(fitted, self._table(unit), self._known.options)
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
                mine + self._first,
                self._stations[mine],
                pattern,
                values,
                {},
                self._known.options,
                *self._stated(mine, values),
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
        return read.of(read.stated, units, n), read.of(read.claimed, units, n)

    def _alone(self, units: Places) -> Iterator[Task]:
        for start in range(0, len(units), _ALONE):
            mine = units[start : start + _ALONE]
            tables = {unit + self._first: self._table(unit) for unit in mine.tolist()}
            yield Task(
                mine + self._first, self._stations[mine], None, (), tables, self._known.options
            )

    def times(self) -> Array:
        """Return the mean of the column `time` of every unit, NaN where there is none."""
        count = len(self._grouped)
        if "time" not in self._rows.columns:
            return np.full(count, np.nan)
        try:
            time = self._grouped.arranged(self._rows.numbers("time"))
        except MultiposError:
            return np.full(count, np.nan)
        return np.asarray(np.add.reduceat(time, self._grouped.starts[:-1]) / self._grouped.counts)

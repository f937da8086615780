"""Rows as they come: outputs, other columns and time, kept only as long as a rest may need them.

What a log gives to `average` as a whole (`multipos.logs.samples`) comes to `LiveRows` piece by
piece: which columns are outputs, which one tells the time and at which rate is decided by the first
rows and by `RowOptions`, and a row without numbers is counted and left out. Rows are in memory
while few, in a temporary file when many, and let go of when no rest can begin before them any more.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import field

import numpy as np

from multipos.errors import MultiposError
from multipos.finding import Finding
from multipos.logs import rests
from multipos.logs.clock import Clock, read_clock, sample_rate, time_columns
from multipos.logs.log_columns import choose_outputs
from multipos.logs.samples import Kept, Store, Timing, good_rows, rises_or_wraps, usual_size
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.results import frozen

_GAP = 3.0  # usual steps of the time: a longer one is a gap


@frozen(eq=True)
class RowOptions:
    """How the rows are read, as `average` has it."""

    outputs: tuple[str, ...] | None = None
    timing: Timing = field(default_factory=Timing)
    min_duration: float | None = None
    threshold: float | None = None


class LiveRows(Kept):
    """Outputs, other columns and time of rows that come piece by piece.

    Attributes
    ----------
    log : Log
    outputs, others : tuples of str
        As in `multipos.logs.samples.Samples`.
    clock : Clock or None
    rate : float or None [Hz]
    step : float [s]
    rows : int
        Good rows so far.
    whole : int
        Of them those in which spikes have been looked for, which are what `pieces` gives.
    gaps, bad : int
        Gaps in the time, and rows left out, so far.
    findings : tuple of Finding
    """

    def __init__(
        self, log: Log, head: Array, outputs: tuple[str, ...] | None, timing: Timing
    ) -> None:
        self.log = log
        self.rows: int = 0
        self.whole: int = 0
        self.gaps: int = 0
        self.bad: int = 0
        self._left_out: list[int] = []  # how many good rows came before each that was left out
        named = None if timing.column is None else log.find(timing.column)
        likely = time_columns(log) if timing.rate is None else []
        chosen = choose_outputs(log, outputs, [*time_columns(log), *([named] if named else [])])
        self.outputs: tuple[str, ...] = chosen.names
        self.findings: tuple[Finding, ...] = (*log.notes, *chosen.findings)
        column = named or next(
            (name for name in likely if rises_or_wraps(log, name, self._of(head, name))), None
        )
        self.clock: Clock | None = None
        self.rate = timing.rate or log.rate
        self.step: float = np.nan
        if column is not None:
            self._read_clock(column, self._of(head, column), timing)
        apart = {*self.outputs, column, *log.nameless}
        self.others: tuple[str, ...] = tuple(name for name in log.numeric if name not in apart)
        names = [*self.outputs, *self.others, *([column] if column else [])]
        self._order = [self._place(name) for name in names]
        self._usual = usual_size(self._arranged(head))
        self._last = -np.inf
        self._store = Store()
        self._spikes = rests.Spikes(len(self.outputs))

    def _read_clock(self, column: str, time: Array, timing: Timing) -> None:
        """Learn from the first times what their unit is, and how often rows come."""
        time = time[np.isfinite(time)]
        self.clock = read_clock(self.log, column, time, timing.unit)
        self.rate = sample_rate(self.log.source, column, time * self.clock.seconds)
        self.step = 1.0 / self.rate

    def _of(self, head: Array, name: str) -> Array:
        return np.asarray(head[self._place(name)])

    def _place(self, name: str) -> int:
        if name not in self.log.numeric:
            raise MultiposError(f"{self.log.source}: column '{name}' holds no numbers.")
        return self.log.numeric.index(name)

    def _arranged(self, columns: Array) -> Array:
        data = columns[self._order]
        if self.clock is not None:
            data[-1] *= self.clock.seconds
        return data

    def take(self, columns: Array) -> tuple[Array, list[bool]]:
        """Take up the numeric columns (k, n) of rows; return outputs, and which rows are good.

        The outputs are those of whole chunks in which spikes can be identified, of earlier rows
        too.

        A time that runs backwards is that of a source that began anew: the row counts as a gap.
        """
        data = self._arranged(columns)
        timed = self.clock is not None
        good = good_rows(data, len(self.outputs), timed=timed, usual=self._usual)
        if not good.all():
            self._left_out += (self.rows + np.cumsum(good)[~good]).tolist()
            self.bad += int((~good).sum())
            data = data[:, good]
        self.rows += data.shape[1]
        if timed and data.shape[1]:
            steps = np.diff(
                data[-1], prepend=self._last if np.isfinite(self._last) else data[-1, 0]
            )
            self.gaps += int(((steps > _GAP * self.step) | (steps < 0.0)).sum())
            self._last = float(data[-1, -1])
        return self._kept(self._spikes.feed(data)), good.tolist()

    def finish(self) -> Array:
        """Take up the rows that are left of a chunk; return their outputs (M, n)."""
        return self._kept(self._spikes.finish()) if self.rows else np.empty((len(self.outputs), 0))

    def _kept(self, data: Array) -> Array:
        self._store.add(np.ascontiguousarray(data))
        self.whole += data.shape[1]
        return data[: len(self.outputs)]

    def pieces(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the numbers (columns, rows) of each piece that is kept."""
        return self._store.pieces()

    def forget(self, row: int) -> None:
        """Let go of the rows before one, as far as that is easy."""
        self._store.forget(row)
        del self._left_out[: bisect_left(self._left_out, row)]

    def in_log(self, rest: rests.Rest) -> rests.Rest:
        """Return the rows of the log that a rest is, those without numbers counted too."""
        forgotten = self.bad - len(self._left_out)
        before, within = (
            forgotten + bisect_right(self._left_out, row) for row in (rest.start, rest.end - 1)
        )
        return rests.Rest(rest.start + before, rest.end + within)

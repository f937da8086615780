"""Rests as they happen: those that `average` finds in the log, one after the other.

The windows, the threshold and the rule that makes a rest of them are those of
`multipos.logs.rests`, fed as the rows come. A rest is settled when eight windows after its end
nothing can join it any more; what is settled never changes. Until the threshold is fixed, from the
first rests themselves, rests are provisional: the standard deviations of all windows so far are
kept and gone through again. With the threshold V and the rate R fixed so, the rests are exactly
those of ``average LOG --threshold V --rate R``.

Rows as they come: outputs, other columns and time, kept only as long as a rest may need them.

What a log gives to `average` as a whole (`multipos.logs.samples`) comes here piece by piece: which
columns are outputs, which one tells the time and at which rate is settled by the first rows, and a
row without numbers is counted and left out. Rows are in memory while few, in a temporary file when
many, and let go of when no rest can begin before them any more.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import field
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.finding import Finding
from multipos.logs import rests
from multipos.logs.clock import Clock, read_clock, sample_rate, time_columns
from multipos.logs.log_columns import choose_outputs
from multipos.logs.samples import (
    Kept,
    Store,
    Timing,
    good_rows,
    rises_or_wraps,
    small_pieces,
    usual_size,
)
from multipos.logs.still import Still, average_rests
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


_ENOUGH = 3  # rests that show what stillness is
_FIRST_PIECE, _PIECE = 512, 64  # samples that the survey is handed at once
_MANY = 1024  # pieces, each of which costs more than what it holds
_OFTEN = 4  # windows from one look for provisional rests to the next


class Motion(NamedTuple):
    """What the newest window shows."""

    size: float | None  # standard deviation, in the unit of the outputs
    still: bool
    samples_left: int  # to hold still until the stretch is a rest


class LiveRests:
    """Find rests in rows that come piece by piece.

    Attributes
    ----------
    grid : Grid
    survey : Survey
    threshold : float or None
        Once it is fixed.
    settled : list of Still
        Rests that have ended; provisional ones while there is no threshold.
    """

    def __init__(self, rows: LiveRows, min_duration: float | None, threshold: float | None) -> None:
        self._rows = rows
        self.grid: rests.Grid = rests.choose_grid(rows.rate, min_duration)
        self.survey: rests.Survey = rests.Survey(len(rows.outputs), self.grid)
        self.threshold = threshold
        self.settled: list[Still] = []
        self._windows = rests.Windows(self.grid.block)
        self._finder = (
            None if threshold is None else rests.Finder(self.grid, rests.Limits(threshold))
        )
        self._sizes: list[Array] = []  # of all windows, until the threshold is fixed
        self._runs = self._last = 0  # that are settled, and the end of the last
        self._seen = self._looked = 0  # windows, and those at the last look
        self._pending: list[tuple[Array, Array, Array]] = []  # not in the survey yet
        self._provisional: rests.Finder | None = None
        self._newest: float | None = None

    def feed(self, outputs: Array) -> bool:
        """Take up outputs (M, n) that the rows have taken; tell whether what is settled changed."""
        self._take(outputs)
        changed = self._settle() if self._finder is not None else self._look()
        if self._finder is not None:
            self._rows.forget(self._finder.open_since)
        return changed

    def _take(self, outputs: Array) -> None:
        for small in small_pieces(outputs):
            mean, spread = self._windows.feed(small)
            self._survey(small, mean, spread)
            if not mean.shape[1]:
                continue
            self._newest = float(spread[0, -1])
            self._seen += mean.shape[1]
            if self._finder is None:
                self._sizes.append(spread)
                if len(self._sizes) > _MANY:
                    self._sizes = [np.concatenate(self._sizes, axis=1)]
            else:
                self._finder.add(spread)

    def finish(self) -> bool:
        """Settle what is there when no more rows come; tell whether that changed anything.

        Raises
        ------
        MultiposError
            There is no rest, or nothing that shows what one is.
        """
        before = len(self.settled)
        self._take(self._rows.finish())
        self._survey_pending()
        if self._finder is None:
            self._fix(self.survey.limits())
        assert self._finder is not None
        self._append(self._finder.runs())
        if not self.settled:
            raise MultiposError(
                f"{self._rows.log.source}: no rest of {self.grid.shortest} samples in "
                f"{self._rows.rows} rows at threshold {self._finder.limits.size:.3g}; hold the "
                "sensor still for longer, or lower --min-duration."
            )
        return len(self.settled) > before

    @property
    def limit(self) -> float | None:
        """The threshold, or what it would be by now."""
        if self._provisional is not None:
            return self._provisional.limits.size
        return self.threshold

    def motion(self) -> Motion:
        """Return what the newest window shows, by the threshold as far as it is known."""
        finder = self._finder or self._provisional
        since = None if finder is None else finder.still_since
        whole = self.grid.shortest
        if since is None:
            return Motion(self._newest, False, whole)
        seen = self._seen - since // self.grid.block + rests.BLOCKS - 1
        return Motion(self._newest, True, max(0, whole - seen * self.grid.block))

    def running(self) -> Still | None:
        """Return the stretch that is still so far, once it is long enough for a rest."""
        finder = self._finder or self._provisional
        since = None if finder is None else finder.still_since
        if since is None or self.motion().samples_left:
            return None
        return self._average([rests.Rest(since, self._rows.whole)])[0]

    def _survey(self, samples: Array, mean: Array, spread: Array) -> None:
        """Add to the survey, in pieces that show the steps between samples."""
        self._pending.append((samples, mean, spread))
        waiting = sum(piece[0].shape[1] for piece in self._pending)
        if waiting >= (_PIECE if self.survey.rows else _FIRST_PIECE):
            self._survey_pending()

    def _survey_pending(self) -> None:
        if self._pending:
            pieces = [np.concatenate(each, axis=1) for each in zip(*self._pending, strict=True)]
            self._pending = []
            self.survey.add(*pieces)

    def _settle(self) -> bool:
        assert self._finder is not None
        before = len(self.settled)
        self._append(self._finder.settled())
        return len(self.settled) > before

    def _append(self, runs: list[rests.Run]) -> None:
        """Add the rests of runs, of which the first are settled already."""
        assert self._finder is not None
        new = runs[self._runs :]
        if not new:
            return
        self._survey_pending()
        edges = self._edges(new, self._finder.limits)
        self._runs, self._last = len(runs), edges[-1].end
        self.settled += self._average([each for each in edges if self._is_long(each)])

    def _edges(self, runs: list[rests.Run], limits: rests.Limits) -> list[rests.Rest]:
        rows = self._rows
        return rests.find_edges(runs, rows.whole, self.grid, limits, rows.read, self._last)

    def _is_long(self, rest: rests.Rest) -> bool:
        return rests.is_long(rest, self.grid.shortest, self.grid)

    def _average(self, found: list[rests.Rest]) -> list[Still]:
        pairs = [("", rest) for rest in found]
        return average_rests(self._rows, pairs, self.grid, self.survey, None)

    def _look(self) -> bool:
        """Find provisional rests; fix the threshold when there are enough of them."""
        if self._seen - self._looked < _OFTEN:
            return False
        self._looked = self._seen
        try:
            limits = self.survey.limits()
        except MultiposError:  # nothing like a rest yet
            return False
        finder = rests.Finder(self.grid, limits)
        finder.add(np.concatenate(self._sizes, axis=1))
        self._provisional = finder
        found = list(filter(self._is_long, self._edges(finder.settled(), limits)))
        if len(found) >= _ENOUGH:
            self._fix(limits)
            return True
        if [self._rows.in_log(rest) for rest in found] == [each.rows for each in self.settled]:
            return False
        self.settled = self._average(found)
        return True

    def _fix(self, limits: rests.Limits) -> None:
        self.threshold = limits.size
        self._finder = rests.Finder(self.grid, limits)
        if self._sizes:
            self._finder.add(np.concatenate(self._sizes, axis=1))
        self._sizes = []
        self._provisional = None
        self.settled = []
        self._settle()

"""Rests as they happen: those that `average` finds in the log, one after the other.

`LiveRests` finds them, `Motion` is whether the sensor rests now. The windows, the threshold and the
rule that makes a rest of them are those of `multipos.logs.rests`, fed as the rows come. A rest is
final when eight windows after its end nothing can join it any more, and never changes then. Until
the threshold is fixed, from the first rests themselves, rests are provisional: the standard
deviations of all windows so far are kept and gone through again. With the threshold V and the rate
R fixed so, the rests are exactly those of ``average LOG --threshold V --rate R``.
"""

from typing import NamedTuple

import numpy as np

from multipos.capturing.live_rows import LiveRows
from multipos.errors import MultiposError
from multipos.logs import rests
from multipos.logs.samples import small_pieces
from multipos.logs.still import Still, average_rests
from multipos.numerics.arrays import Array

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

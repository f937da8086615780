"""The numbers of a log, read once and kept: in memory while few, in a temporary file when many."""

import tempfile
from collections.abc import Callable, Iterator
from typing import IO, Self

import numpy as np

from multipos.errors import MultiposError
from multipos.logs.rests import (
    FASTEST,
    LARGEST_SAMPLE,
    PIECE,
    SLOWEST,
    Grid,
    Rest,
    Survey,
    Windows,
    choose_grid,
)
from multipos.logs.table import Log
from multipos.numerics.arrays import Array

Progress = Callable[[float], object]  # is told how much of the log has been read, 0 to 1

_IN_MEMORY = 1 << 22  # bytes
_LATEST = 1e25  # of the other columns: no clock counts so far, in picoseconds neither


class Samples:
    """Outputs, other columns and time of a log, in pieces that can be gone through again.

    Attributes
    ----------
    log : Log
    outputs : int
        Number of outputs; they come first in each piece.
    others : tuple of str
        Numeric columns that are no outputs; empty cells are NaN.
    time_column : str or None
        Comes last in each piece.
    rows : int
    step : float [s]
        Usual step of the time.
    notes : list of str
        What was left out, in words.
    """

    def __init__(self, log: Log, outputs: tuple[str, ...], time_column: str | None) -> None:
        self.log = log
        self.outputs = len(outputs)
        self.time_column = time_column
        taken = {*outputs, time_column}
        self.others = tuple(name for name in log.numeric if name not in taken)
        self.notes = [
            f"column '{name}' holds text and is not used"
            for name in log.columns
            if name not in log.numeric and name not in taken
        ]
        self.rows = 0
        self.step = np.nan
        self._names = outputs
        self._rate: float | None = None
        self._sizes: list[int] = []
        self._kept: IO[bytes] = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY)  # noqa: SIM115

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.close()

    def survey(
        self, rate: float | None, min_duration: float | None, progress: Progress | None
    ) -> tuple[Survey, Grid, float | None]:
        """Read the log; return what it is like, the sizes to use, and its sample rate [Hz]."""
        grid = scan = found = None
        last = -np.inf
        time_column = [] if self.time_column is None else [self.time_column]
        for piece in self.log.read((*self._names, *time_column), self.others):
            table = piece.table
            if time_column:
                time = table.number(time_column[0])
                back = np.flatnonzero(np.diff(time, prepend=last) < 0.0)
                if len(back):
                    row = int(back[0])
                    raise MultiposError(
                        f"{table.where(row, time_column[0])}: the time runs backwards, to "
                        f"{time[row]:.10g} s; sort the rows, or give --rate instead."
                    )
                last = time[-1]
            if grid is None:
                if time_column:
                    rate, self.step = self._rate_of(time)
                self._rate = rate
                grid = choose_grid(rate, min_duration)
                scan, found = Windows(grid.block), Survey(self.outputs, grid)
            assert scan is not None
            assert found is not None
            data = np.array(
                [table.number(name, largest=LARGEST_SAMPLE) for name in self._names]
                + [table.number(name, empty=True, largest=_LATEST) for name in self.others]
                + [table.number(name, largest=_LATEST) for name in time_column]
            )
            self._kept.write(data.tobytes())
            self._sizes.append(table.rows)
            self.rows += table.rows
            for small in small_pieces(data[: self.outputs]):
                found.add(small, *scan.feed(small))
            if progress is not None:
                progress(piece.done)
        if grid is None or found is None:
            raise MultiposError(f"{self.log.source}: no rows; a log needs samples.")
        return found, grid, rate

    def pieces(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the numbers (columns, rows) of each piece, in order."""
        self._kept.seek(0)
        width = self.outputs + len(self.others) + (self.time_column is not None)
        first = 0
        for rows in self._sizes:
            numbers = np.frombuffer(self._kept.read(8 * width * rows))
            yield first, numbers.reshape(width, rows)
            first += rows

    def time(self, rest: Rest) -> tuple[float, float] | None:
        """Return when a rest begins and ends by the sample rate; None where there is none."""
        if self._rate is None:
            return None
        return rest.start / self._rate, (rest.end - 1) / self._rate

    def _rate_of(self, time: Array) -> tuple[float, float]:
        """Return the sample rate and the usual step of the time; stamps may come in bursts."""
        steps = np.diff(time)
        usual = float(np.median(steps)) if len(steps) else 0.0
        if usual <= 0.0:
            usual = float(np.mean(steps)) if len(steps) else 0.0
        if usual <= 0.0:
            raise MultiposError(
                f"{self.log.source}: column '{self.time_column}' does not move on; "
                "it must hold the time in seconds, or give --rate."
            )
        if not SLOWEST <= 1.0 / usual <= FASTEST:
            raise MultiposError(
                f"{self.log.source}: column '{self.time_column}' steps by {usual:g}, no time "
                f"between samples in seconds ({1.0 / FASTEST:g} to {1.0 / SLOWEST:g}); correct it, "
                "or give --rate."
            )
        if usual >= 10.0:
            self.notes.append(
                f"column '{self.time_column}' steps by {usual:g}; it must be in seconds"
            )
        return 1.0 / usual, usual


def small_pieces(samples: Array) -> Iterator[Array]:
    """Yield samples (M, n) in pieces that stay in the processor's cache."""
    for start in range(0, samples.shape[1], PIECE):
        yield samples[:, start : start + PIECE]

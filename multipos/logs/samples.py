"""The numbers of a log, read once and kept: in memory while few, in a temporary file when many.

`read_timing` checks what the user says of the time, `share_of` tells how much of several logs is
read. `good_rows` are the rows to use, by the `usual_size` of each column, and `rows_in_log` where
they stand in the log; `rises` and `rises_or_wraps` tell a time, `small_pieces` cuts samples into
pieces. `rows_of_sensor` takes the rows of one sensor, `refuse_interleaved` refuses those of
several. A column of labels names positions: the rows of one label are a rest.

Rows of several sensors may take turns: a column with few values that come in the same order again
and again numbers sensors, or samples of a packet. They are sensors where readings differ more from
one row to the next than from one round to the next.
"""

import os
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple, Protocol, Self

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.csv_columns import Column
from multipos.files.tables import Table
from multipos.finding import Finding
from multipos.logs.clock import (
    Clock,
    TimeUnit,
    check_time_unit,
    counts_rows,
    read_clock,
    sample_rate,
    time_columns,
    unwrap,
    usual_step,
    wraps_of,
)
from multipos.logs.rests import PIECE, Rest, Spikes, Survey, Windows, choose_grid
from multipos.logs.table import Log, Piece, Wanted
from multipos.numerics.arrays import LARGEST_SAMPLE, Array, Mask, Places, median, require_rate


class Runs:
    """Where a column has which label; rows without one belong to no position.

    Attributes
    ----------
    column : str
    """

    def __init__(self, source: str, column: str) -> None:
        self.column = column
        self._source = source
        self._runs: list[tuple[str, int]] = []  # a label, and rows in a row that have it

    def feed(self, labels: Sequence[str]) -> None:
        """Add the labels of the rows that follow."""
        self._runs += [(label, sum(1 for _ in rows)) for label, rows in groupby(labels)]

    def rests(self) -> list[tuple[str, Rest]]:
        """Return the rests with their labels, in the order of the log; a label may come again.

        Raises
        ------
        MultiposError
            No row has a label, or a label stands on a single row.
        """
        found, row = [], 0
        for label, runs in groupby(self._runs, key=itemgetter(0)):
            start, row = row, row + sum(rows for _, rows in runs)
            found += [(label, Rest(start, row))] if label else []
        if not found:
            raise MultiposError(
                f"{self._source}: column '{self.column}' has no label; a row without one belongs "
                "to no position."
            )
        for label, rest in found:
            if rest.end - rest.start < 2:
                raise MultiposError(
                    f"{self._source}: label '{label}' of column '{self.column}' is on row "
                    f"{rest.start} alone, counted from 0; a position needs at least two rows."
                )
        return found


Progress = Callable[[float], object]  # is called with how much of the log has been read, 0 to 1


def share_of(progress: Progress | None, done: int, count: int) -> Progress | None:
    """Return what is called with how much of one log of several has been read."""
    return None if progress is None else lambda part: progress((done + part) / count)


_IN_MEMORY = 1 << 22  # bytes
_LATEST = 1e25  # of the other columns: no clock counts so far, in picoseconds neither
_FAR = 1e6  # times the median of a column: no sensor reads so much, a damaged number does


class Timing(NamedTuple):
    """What the user says of the time: a column, its unit, or the sample rate [Hz]."""

    column: str | None = None
    unit: TimeUnit | None = None
    rate: float | None = None

    def in_log(self, log: Log) -> "Timing":
        """Return it with the column as the log calls it."""
        return self if self.column is None else self._replace(column=log.find(self.column))


def read_timing(column: str | None, unit: TimeUnit | None, rate: float | None) -> Timing:
    """Return what the user says of the time, checked."""
    check_time_unit(unit)
    if column is not None and rate is not None:
        raise UsageError("--time-column and --rate both state the time; give one.")
    if rate is not None:
        require_rate(rate)
    return Timing(column, unit, rate)


class Kept(Protocol):
    """Rows that can be gone through again: what averaging a rest asks of them."""

    log: Log
    outputs: tuple[str, ...]
    others: tuple[str, ...]
    clock: Clock | None
    rate: float | None
    step: float

    def pieces(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the numbers (columns, rows) of each piece, in order."""

    def in_log(self, rest: Rest) -> Rest:
        """Return the rows of the log that a rest is."""

    def time(self, rest: Rest) -> tuple[float, float] | None:
        """Return when a rest begins and ends by the sample rate; None where there is none."""
        if self.rate is None:
            return None
        return rest.start / self.rate, (rest.end - 1) / self.rate

    def read(self, stretches: list[Rest]) -> list[Array]:
        """Return the outputs (M, n) of stretches of rows."""
        parts: list[list[Array]] = [[] for _ in stretches]
        for first, piece in self.pieces():
            for part, (start, end) in zip(parts, stretches, strict=True):
                if start < first + piece.shape[1] and end > first:
                    part.append(piece[: len(self.outputs), max(start - first, 0) : end - first])
        return [np.concatenate(part, axis=1) for part in parts]


class Store:
    """Columns (k, n) in pieces, in a temporary file when they are many."""

    def __init__(self) -> None:
        import tempfile  # slow to import, and not needed to fit

        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115  # closed below
        self._closing = weakref.finalize(self, self._file.close)
        self._shapes: list[tuple[int, ...]] = []  # of the pieces
        self._first = 0  # row of the first piece
        self._begin = 0  # where in the file it begins

    def add(self, piece: Array) -> None:
        """Keep the rows that follow."""
        if not piece.shape[1]:
            return
        self._file.seek(0, os.SEEK_END)
        self._file.write(np.ascontiguousarray(piece).tobytes())
        self._shapes.append(piece.shape)

    def pieces(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the numbers of each piece, in order."""
        first, place = self._first, self._begin
        for width, rows in [*self._shapes]:
            self._file.seek(place)
            numbers = np.frombuffer(self._file.read(8 * width * rows))
            yield first, numbers.reshape(width, rows)
            first, place = first + rows, place + numbers.nbytes

    def forget(self, row: int) -> None:
        """Let go of the pieces before a row."""
        while self._shapes and self._first + self._shapes[0][1] <= row:
            width, rows = self._shapes.pop(0)
            self._first += rows
            self._begin += 8 * width * rows
        if not self._shapes:
            self._file.truncate(0)
            self._begin = 0

    def close(self) -> None:
        """Let go of everything that is kept."""
        self._closing()


class Samples(Kept):
    """Outputs, other columns and time of a log, in pieces that can be gone through again.

    Rows are counted without those that were left out; `in_log` says where they stand in the log.
    Spikes are taken out, unless samples are wanted as they are.

    Attributes
    ----------
    log : Log
    outputs : tuple of str
        They come first in each piece.
    others : tuple of str
        Numeric columns that are no outputs; empty cells are NaN.
    clock : Clock or None
        Its column comes last in each piece, in seconds.
    rate : float or None [Hz]
    rows : int
    step : float [s]
        Usual step of the time.
    wraps : (float, int)
        After how many seconds the time wraps around, and how often it does; zeros where not.
    signed : int or None
        Bits of two's complement that the outputs are read as.
    counter : str or None
        Column named as a time that counts rows.
    labels : Runs or None
        Where a label column has which label.
    spikes : Spikes
        Single samples that their neighbours' median stands for.
    """

    def __init__(
        self,
        log: Log,
        outputs: tuple[str, ...],
        timing: Timing,
        *,
        label_column: str | None = None,
        signed: int | None = None,
        drop_bad: bool = False,
        as_they_are: bool = False,
    ) -> None:
        self.log = log
        self.outputs: tuple[str, ...] = outputs
        self.clock: Clock | None = None
        self.rate = timing.rate
        self.rows: int = 0
        self.step: float = np.nan
        self.wraps: tuple[float, int] = 0.0, 0
        self.counter: str | None = None
        self.labels: Runs | None = None if label_column is None else Runs(log.source, label_column)
        self.signed = signed
        self._timing, self._drop_bad, self._as_they_are = timing, drop_bad, as_they_are
        taken = {*outputs, label_column, *log.nameless}
        self.others: tuple[str, ...] = tuple(name for name in log.numeric if name not in taken)
        self._texts = () if label_column is None else (label_column,)
        self._seen = 0  # rows of the log
        self._dropped: list[int] = []
        self._last = -np.inf
        self.spikes: Spikes = Spikes(len(outputs))
        self._store = Store()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    def survey(self, min_duration: float | None, progress: Progress | None = None) -> Survey:
        """Read the log; return what it is like."""
        survey: Survey | None = None
        for piece in self._read():
            if survey is None:
                self._read_clock(piece.table)
                survey = Survey(len(self.outputs), choose_grid(self.rate, min_duration))
                windows = Windows(survey.grid.block)
                refuse_interleaved(piece.table, self.outputs, self.others)
                self._refuse_named_sensors()
            taken = self._take(piece.table)
            whole = taken if self._as_they_are else self.spikes.feed(taken)
            self._look_at(whole, survey, windows)
            if progress is not None:
                progress(piece.done)
        if survey is None or not self.rows:
            raise MultiposError(f"{self.log.source}: no rows; a log needs samples.")
        if not self._as_they_are:
            self._look_at(self.spikes.finish(), survey, windows)
        return survey

    def _refuse_named_sensors(self) -> None:
        """Refuse a log in which several sensors take turns that a column of texts names."""
        numbers = {*self.log.numeric, *self.log.nameless}
        texts = [name for name in self.log.columns if name not in numbers]
        if texts and self.labels is None:
            head = next(self.log.read((), self.outputs, texts, lenient=True), None)
            if head is not None:
                refuse_interleaved(head.table, self.outputs, texts)

    def _look_at(self, data: Array, survey: Survey, windows: Windows) -> None:
        """Keep numbers (columns, rows), and add the outputs to the survey."""
        self._store.add(data)
        for small in small_pieces(data[: len(self.outputs)]):
            survey.add(small, *windows.feed(small))

    def _read(self) -> Iterator[Piece]:
        """Read the log: outputs and a clock that is sure must be numbers, unless rows may go."""
        sure = (*self.outputs, *self._named_clock())
        required, optional = ((), (*sure, *self.others)) if self._drop_bad else (sure, self.others)
        return self.log.read(required, optional, self._texts, lenient=self._drop_bad)

    def pieces(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the numbers (columns, rows) of each piece, in order."""
        return self._store.pieces()

    def raw_outputs(self) -> Iterator[tuple[int, Array]]:
        """Yield the first row and the outputs (M, rows) of each piece as the log has them."""
        for first, piece in self.pieces():
            outputs = piece[: len(self.outputs)].copy()
            for row, j, value in self.spikes.found:
                if first <= row < first + outputs.shape[1]:
                    outputs[j, row - first] = value
            yield first, outputs

    @property
    def dropped(self) -> int:
        """How many rows were left out."""
        return len(self._dropped)

    def in_log(self, rest: Rest) -> Rest:
        """Return the rows of the log that a rest is."""
        return rows_in_log(rest, self._dropped)

    def among_kept(self, rest: Rest) -> Rest:
        """Return where rows of the log are among those that were not left out."""
        start, end = np.searchsorted(self._dropped, [*rest]).tolist()
        return Rest(rest.start - start, rest.end - end)

    @property
    def log_rows(self) -> int:
        """Rows of the log, with those that were left out."""
        return self._seen

    def _named_clock(self) -> tuple[str, ...]:
        """Return the column that surely tells the time: the one named, or ``time``."""
        if self._timing.column is not None:
            return (self._timing.column,)
        sure = self._timing.rate is None and time_columns(self.log)[:1] == ["time"]
        return ("time",) if sure else ()

    def _read_clock(self, table: Table) -> None:
        """Find the time: in the column that was named, or in one whose name says so."""
        likely = time_columns(self.log) if self._timing.rate is None else []
        rising = (
            name
            for name in likely
            if name in self.others and rises_or_wraps(self.log, name, table.columns[name])
        )
        column = next(iter(self._named_clock()), None) or next(rising, None)
        time = None if column is None else self._column(table, column, _LATEST)
        if time is not None and self._timing.column is None and self._timing.unit is None:
            data = np.array([self._column(table, name, LARGEST_SAMPLE) for name in self.outputs])
            self.counter = column if counts_rows(self.log, str(column), time, data) else None
        if column is None or time is None or self.counter is not None:
            self.rate = self._timing.rate or self.log.rate
            return
        time = time[np.isfinite(time)]
        self.clock = read_clock(self.log, column, time, self._timing.unit)
        self.others = tuple(name for name in self.others if name != column)
        seconds = time * self.clock.seconds
        step = usual_step(seconds)
        seconds = unwrap(seconds, np.nan, 0.0, step, wraps_of(self.clock)).time
        self.rate = sample_rate(self.log.source, column, seconds)
        self.step = 1.0 / self.rate

    def _column(self, table: Table, name: str, largest: float, *, empty: bool = False) -> Array:
        """Return a column; where bad rows are left out, whatever it holds."""
        if self._drop_bad:
            return np.asarray(table.columns[name], dtype=np.float64)
        if self._as_they_are and empty:
            values = table.numbers(name)
            return np.where(np.abs(values) <= largest, values, np.nan)
        return table.number(name, empty=empty, largest=largest)

    def _output(self, table: Table, name: str) -> Array:
        values = self._column(table, name, LARGEST_SAMPLE)
        if self.signed is None:
            return values
        whole = 2.0**self.signed
        if name in self.log.registers:  # as they stood in the log
            values = np.where(values < 0.0, values + 2.0 ** self.log.registers[name], values)
        bad = np.flatnonzero(~((values >= 0.0) & (values < whole) & (values % 1.0 == 0.0)))
        if len(bad):
            raise MultiposError(
                f"{table.where(int(bad[0]), name)}: {values[bad[0]]:.10g} is no number of "
                f"{self.signed} bits without a sign; leave --signed away."
            )
        return np.where(values >= whole / 2.0, values - whole, values)

    def _take(self, table: Table) -> Array:
        """Take up a piece of the log, without the rows to be left out; return its numbers."""
        rows = [self._output(table, name) for name in self.outputs]
        rows += [self._column(table, name, _LATEST, empty=True) for name in self.others]
        if self.clock is not None:
            seconds = self._column(table, self.clock.column, _LATEST)
            rows.append(seconds * self.clock.seconds)
        data = np.array(rows)
        good = np.ones(table.rows, dtype=np.bool_)
        if self._drop_bad:
            good = good_rows(data, len(self.outputs), timed=self.clock is not None)
        kept = np.flatnonzero(good)
        if len(kept) < table.rows:
            self._dropped += (self._seen + np.flatnonzero(~good)).tolist()
            data = np.ascontiguousarray(data[:, kept])
        if self.clock is not None:
            data[-1] = self._unwrapped(data[-1])
            self._check_time(table, data[-1], kept)
        if self.labels is not None:
            labels = table.text(self.labels.column)
            self.labels.feed([labels[i] for i in kept.tolist()])
        self._seen += table.rows
        self.rows += data.shape[1]
        return data

    def _unwrapped(self, time: Array) -> Array:
        """Return the times (n,) of a piece, those of a counter that wraps around made to go on."""
        assert self.clock is not None
        size, count = self.wraps
        time = time + size * count
        found = unwrap(time, self._last, size, self.step, wraps_of(self.clock))
        self.wraps = found.size or size, count + found.wraps
        return found.time

    def _check_time(self, table: Table, time: Array, rows: Places) -> None:
        assert self.clock is not None
        back = np.flatnonzero(np.diff(time, prepend=self._last) < 0.0)
        if len(back):
            row = int(back[0])
            raise MultiposError(
                f"{table.where(int(rows[row]), self.clock.column)}: the time runs backwards, to "
                f"{time[row]:.10g} s; rows are interchanged or missing: sort them, or give --rate "
                "instead."
            )
        self._last = time[-1] if len(time) else self._last


def rows_in_log(rest: Rest, dropped: Sequence[int]) -> Rest:
    """Return the rows of a log that a rest is, counted with those that were dropped."""
    before = np.array(dropped) - np.arange(len(dropped))
    start, last = np.searchsorted(before, [rest.start, rest.end - 1], side="right").tolist()
    return Rest(rest.start + start, rest.end + last)


def good_rows(data: Array, outputs: int, *, timed: bool, usual: Array | None = None) -> Mask:
    """Return which rows (n,) have a time and outputs, and nothing beyond what sensors read.

    Parameters
    ----------
    data : (k, n) array
        The outputs come first, the time last where there is one.
    outputs : int
    timed : bool
    usual : (k,) array, optional
        Of each column, as `usual_size` gives it; that of `data` otherwise.
    """
    required = [*range(outputs), *([len(data) - 1] if timed else [])]
    size = np.abs(data)
    good: Mask = np.logical_and.reduce(np.isfinite(data[required]))
    good &= ~(size > _LATEST).any(axis=0)
    good &= (size[:outputs] <= LARGEST_SAMPLE).all(axis=0)
    limit = _FAR * (usual_size(data) if usual is None else usual)[:, np.newaxis]
    good &= ~((size > limit) & (limit > 0.0)).any(axis=0)
    return good


def usual_size(data: Array) -> Array:
    """Return the median size of what may be a time in each column (k,), 0 where nothing is."""
    there = [size[size <= _LATEST] for size in np.abs(data)]  # no NaN, and no product overflows
    return np.array([median(size) if len(size) else 0.0 for size in there])


def _clock_values(column: Column) -> Array:
    """Return what a clock may have counted to in a column."""
    time = np.asarray(column, dtype=np.float64)
    return time[np.abs(time) <= _LATEST]


def rises(column: Column) -> bool:
    """Tell whether a column goes up, as a time does."""
    time = _clock_values(column)
    return len(time) > 1 and bool((np.diff(time) >= 0.0).all()) and bool(time[-1] > time[0])


def rises_or_wraps(log: Log, name: str, column: Column) -> bool:
    """Tell whether a column goes up but where a counter wraps around."""
    if rises(column):
        return True
    time = _clock_values(column)
    clock = read_clock(log, name, time, None)
    seconds = time * clock.seconds
    return rises(unwrap(seconds, np.nan, 0.0, usual_step(seconds), wraps_of(clock)).time)


def small_pieces(samples: Array) -> Iterator[Array]:
    """Yield samples (M, n) in pieces that stay in the processor's cache."""
    for start in range(0, samples.shape[1], PIECE):
        yield samples[:, start : start + PIECE]


_SENSORS = 16  # at most
_ROUNDS = 32  # at least
_SAME = 0.98  # of the rows that go on by turns: some may be lost
_APART = 2.0  # times as far as from one round to the next
_HEAD = 4096  # rows that are looked at


def rows_of_sensor(log: Log, column: str, value: str) -> Log:
    """Return the rows of a log in which a column has a value.

    Raises
    ------
    MultiposError
        There is no such column, or no such row.
    """
    name = log.find(column)
    said = Finding("one-sensor", "note", f"only rows whose '{name}' is {value} are used")
    taken = replace(log, pieces=partial(_read, log, name, value), notes=(*log.notes, said))
    if not any(piece.table.rows for piece in taken.read((), (), (), lenient=True)):
        raise MultiposError(f"{log.source}: no row has '{name}' = {value}; correct --only.")
    return taken


def _read(log: Log, column: str, value: str, wanted: Wanted) -> Iterator[Piece]:
    numeric, first = column in log.numeric, 0
    if numeric:
        wanted = wanted._replace(optional=(*wanted.optional, column))
    else:
        wanted = wanted._replace(texts=(*wanted.texts, column))
    for piece in log.pieces(wanted):
        table = piece.table
        if numeric:
            matches = np.asarray(table.columns[column], dtype=np.float64) == _number(value)
        else:
            matches = np.array([cell == value for cell in table.text(column)])
        rows = np.flatnonzero(matches).tolist()
        chosen = replace(table.select(rows), first=first)
        first += len(rows)
        given = piece.lines
        yield Piece(chosen, None if given is None else partial(_lines, given, rows), piece.done)


def _number(value: str) -> float:
    try:
        return float(value)
    except ValueError:
        return np.nan


def _lines(given: Callable[[], list[str]], rows: list[int]) -> list[str]:
    every = given()
    return [every[row] for row in rows]


def refuse_interleaved(table: Table, outputs: Sequence[str], others: Sequence[str]) -> None:
    """Refuse a log in which several sensors take turns, by numbers or texts in its first rows.

    Raises
    ------
    MultiposError
    """
    data = np.array([table.columns[name] for name in outputs], dtype=np.float64)[:, :_HEAD]
    for name in others:
        column = table.columns[name][:_HEAD]
        if isinstance(column, np.ndarray):
            numbers = np.asarray(column, dtype=np.float64)
            names = [f"{cell:g}" for cell in numbers[:_SENSORS].tolist()]
        else:
            names = list(map(str, column))
            numbers = np.unique(names, return_inverse=True)[1].astype(np.float64)
        count = _turns(numbers)
        if count and _differ(data, count):
            raise MultiposError(
                f"{table.source}: {count} sensors take turns, which column '{name}' separates "
                f"({', '.join(names[:count])}); take the rows of one with --only {name}={names[0]}."
            )


def _turns(cells: Array) -> int:
    """Return after how many rows a column begins again, 0 where it does not."""
    again = np.flatnonzero(cells[1 : _SENSORS + 1] == cells[0])
    if not len(again) or not again[0]:
        return 0
    count = int(again[0]) + 1
    if len(cells) < count * _ROUNDS or len(set(cells[:count].tolist())) < count:
        return 0
    same = cells[count:] == cells[:-count]
    return count if float(np.mean(same)) >= _SAME else 0


def _differ(data: Array, count: int) -> bool:
    """Tell whether readings (M, n) differ more between rows than between rounds of them."""
    next_ = np.abs(data[:, 1:] - data[:, :-1])
    round_ = np.abs(data[:, count:] - data[:, :-count])
    with np.errstate(invalid="ignore"):
        usual = [median(each[:, np.isfinite(each).all(axis=0)], axis=1) for each in (next_, round_)]
    return bool((usual[0] > _APART * usual[1]).any())

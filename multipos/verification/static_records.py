"""A static record, read once: its phases to the disk, its blocks to memory."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.lists import near
from multipos.logs.samples import Progress, Samples
from multipos.logs.table import Log
from multipos.numerics.allan import Phases, octaves
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.positions.reading_tables import is_environment
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensed_axes

_BLOCKS = 256  # at least so many of a long record, less than twice as many
_FEWEST = 64  # samples of which anything can be said
_GAP = 3.0  # usual steps of the time: a longer one is a gap


@dataclass(frozen=True)
class Source:
    """What of a log is wanted.

    Attributes
    ----------
    outputs : tuple of str or None
        Named columns; None for every numeric column without another meaning.
    calibration : Calibration or None
        Compensates the outputs.
    temperature : str or None
        Named column; None for `temperature` where there is one.
    time_column : str or None
    rate : float or None [Hz]
    """

    outputs: tuple[str, ...] | None
    calibration: Calibration | None
    temperature: str | None
    time_column: str | None
    rate: float | None


@dataclass(frozen=True)
class RawRecord:
    """One record in samples: blocks (K, b) and sums (K, T) of `octaves(samples)`."""

    source: str
    names: tuple[str, ...]
    samples: int
    rate: float
    length: int
    blocks: Array
    temperature: Array | None
    sums: Array
    notes: tuple[str, ...]


def read_record(log: Log, wanted: Source, progress: Progress | None) -> RawRecord:
    """Read one record.

    Raises
    ------
    MultiposError
        A column is missing; nothing tells the time; there are too few samples, or the force or the
        temperature of a row is unknown.
    UsageError
        More than three columns could be outputs.
    """
    time_column = _time_column(log, wanted)
    raw = _outputs(log, wanted, time_column)
    _require(log, [c for c in (time_column, wanted.temperature) if c is not None])
    with Samples(log, raw, time_column) as samples, ExitStack() as stack:
        rate = samples.survey(wanted.rate, None, progress)[2]
        assert rate is not None
        if samples.rows < _FEWEST:
            raise MultiposError(
                f"{log.source}: {samples.rows} samples say nothing about stability; a record needs "
                f"at least {_FEWEST}, and hours for its slow part."
            )
        names = _names(raw, wanted.calibration)
        length = 1 << max(samples.rows // _BLOCKS, 1).bit_length() - 1
        blocks, gaps = _Blocks(length), _Gaps(samples)
        warmth = _temperature(log, wanted, samples)
        phases = [stack.enter_context(Phases()) for _ in names]
        for first, piece in samples.pieces():
            values = _compensated(wanted.calibration, samples, piece, first)
            for each, one in zip(phases, values, strict=True):
                each.feed(one)
            blocks.feed(np.vstack([values, piece[warmth]]))
            gaps.feed(piece)
        lengths, means = octaves(samples.rows), blocks.means()
        return RawRecord(
            source=log.source,
            names=names,
            samples=samples.rows,
            rate=rate,
            length=length,
            blocks=means[: len(names)],
            temperature=_measured(log.source, means[len(names) :]),
            sums=np.array([each.sums(lengths) for each in phases]),
            notes=tuple(f"{log.source}: {note}" for note in (*samples.notes, *gaps.notes())),
        )


def _time_column(log: Log, wanted: Source) -> str | None:
    """Return the column of the time, or None where the rate is given."""
    if wanted.time_column is not None or wanted.rate is not None:
        return wanted.time_column
    if "time" not in log.numeric:
        raise MultiposError(
            f"{log.source}: no column 'time', so nothing tells how long a sample takes; name it "
            "with --time-column, or give --rate."
        )
    return "time"


def _require(log: Log, columns: Sequence[str]) -> None:
    for name in columns:
        if name not in log.columns:
            raise MultiposError(
                f"{log.source}: no column '{name}'; the columns are {', '.join(log.columns)}"
                f"{near(name, log.columns)}"
            )


def _outputs(log: Log, wanted: Source, time_column: str | None) -> tuple[str, ...]:
    if wanted.calibration is not None:
        _require(log, [*wanted.calibration.outputs, *wanted.calibration.model.environment])
        return wanted.calibration.outputs
    if wanted.outputs is not None:
        _require(log, wanted.outputs)
        return wanted.outputs
    others = (time_column, wanted.temperature)
    names = tuple(n for n in log.numeric if n not in others and not is_environment(n))
    if not names:
        raise MultiposError(f"{log.source}: no numeric column can be an output; see --outputs.")
    if len(names) > len(COMPONENTS):
        raise UsageError(
            f"{len(names)} columns could be outputs: {', '.join(names)}; name them with --outputs."
        )
    return names


def _names(raw: tuple[str, ...], calibration: Calibration | None) -> tuple[str, ...]:
    if calibration is None:
        return raw
    return tuple(f"f_{COMPONENTS[axis]}" for axis in sensed_axes(calibration.model))


def _temperature(log: Log, wanted: Source, samples: Samples) -> slice:
    """Return the row of the temperature in the pieces, none where it was not measured."""
    name = "temperature" if wanted.temperature is None else wanted.temperature
    if name not in samples.others:
        if wanted.temperature is not None:
            raise MultiposError(
                f"{log.source}: column '{name}' is an output or no number, so no temperature; "
                "name another with --temperature."
            )
        return slice(0)
    row = samples.outputs + samples.others.index(name)
    return slice(row, row + 1)


def _compensated(
    calibration: Calibration | None, samples: Samples, piece: Array, first: int
) -> Array:
    """Return the outputs (K, k) of a piece, compensated where a calibration was given."""
    raw = piece[: samples.outputs]
    if calibration is None:
        return raw
    columns = dict(zip(samples.others, piece[samples.outputs :], strict=False))
    environment = {name: columns[name] for name in calibration.model.environment}
    force = calibration.compensate(raw.T, environment).T
    unknown = ~np.isfinite(force).all(axis=0)
    if unknown.any():
        raise MultiposError(
            f"{samples.log.source}: row {first + int(np.argmax(unknown)) + 1}: no force explains "
            "the reading, or a column of the model is empty there; leave the row out."
        )
    return np.ascontiguousarray(force)


def _measured(source: str, means: Array) -> Array | None:
    if not len(means):
        return None
    if not np.isfinite(means).all():
        raise MultiposError(
            f"{source}: the temperature is unknown in part of the record; fill it in, or name "
            "another column with --temperature."
        )
    return np.asarray(means[0])


class _Blocks:
    """Means of blocks of so many samples; a cell that is empty takes no part."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._left: Array | None = None
        self._means: list[Array] = []

    def feed(self, samples: Array) -> None:
        """Add samples (K, k)."""
        together = samples
        if self._left is not None:
            together = np.concatenate([self._left, samples], axis=1)
        count = together.shape[1] // self._length
        whole = together[:, : count * self._length].reshape(len(samples), count, self._length)
        origin = np.nan_to_num(whole[:, :, :1])
        known = np.isfinite(whole)
        with np.errstate(invalid="ignore"):
            means = np.where(known, whole - origin, 0.0).sum(axis=2) / known.sum(axis=2)
        self._means.append(means + origin[:, :, 0])
        self._left = together[:, count * self._length :]

    def means(self) -> Array:
        """Return the means (K, b) of whole blocks."""
        return np.concatenate(self._means, axis=1)


class _Gaps:
    """Count the steps of the time that are far longer than usual."""

    def __init__(self, samples: Samples) -> None:
        self._timed = samples.time_column is not None
        self._longest = _GAP * samples.step
        self._last = np.empty(0)
        self._count = 0

    def feed(self, piece: Array) -> None:
        if not self._timed:
            return
        time = piece[-1]
        self._count += int((np.diff(time, prepend=self._last) > self._longest).sum())
        self._last = time[-1:]

    def notes(self) -> list[str]:
        if not self._count:
            return []
        return [f"the time has {self._count} gaps; samples are taken as if evenly spaced"]

"""A static record, read once: its phases to the disk, its blocks to memory.

- `read_record` returns a `RawRecord` of a log, `Blocks` of every output, by `RecordOptions`.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack

import numpy as np

from multipos.bias_stability.allan import Phases, octaves
from multipos.errors import MultiposError
from multipos.finding import Finding, Findings, about
from multipos.logs.clock import time_columns
from multipos.logs.log_columns import Outputs, choose_outputs
from multipos.logs.samples import Progress, Samples, Timing
from multipos.logs.table import Log
from multipos.numerics.arrays import COMPONENTS, SMALLEST, Array, median
from multipos.positions.headers import require_units
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

_BLOCKS = 256  # at least so many of a long record, less than twice as many
_OTHER = (STANDARD_GRAVITY, 1.0 / STANDARD_GRAVITY, 1e3)  # [g] of 1 g in a wrong unit,
_NEAR = 2.0  # within such a factor, as the bias is in another unit too
_FEWEST = 64  # samples of which anything can be said
_GAP = 3.0  # usual steps of the time: a longer one is a gap


@frozen(eq=True)
class RecordOptions:
    """What of a log is wanted.

    Attributes
    ----------
    outputs : tuple of str or None
        Named columns; None for every numeric column without another meaning.
    calibration : Calibration or None
        Compensates the outputs.
    temperature : str or None
        Named column; None for `temperature` where there is one.
    timing : Timing
    drop_bad : bool
    """

    outputs: tuple[str, ...] | None
    calibration: Calibration | None
    temperature: str | None
    timing: Timing
    drop_bad: bool


@frozen
class Blocks:
    """One output of one record as means of blocks.

    Attributes
    ----------
    samples : int
        Of the record.
    length : int
        Samples of a block, a power of two.
    values : (b,) array
    temperature : (b,) array or None
    sums : (T,) array
        Of the squared second differences of its phases, over `octaves(samples)`.
    """

    samples: int
    length: int
    values: Array
    temperature: Array | None
    sums: Array

    @property
    def time(self) -> Array:
        """The middles (b,) of the blocks, in samples from the begin of the record."""
        return np.asarray((np.arange(len(self.values)) + 0.5) * self.length)


@frozen
class RawRecord:
    """One record: the blocks of every output, its sample rate and the unit of all outputs."""

    source: str
    rate: float
    unit: str | None  # that the header gives all outputs
    outputs: Mapping[str, Blocks]
    findings: Findings

    @property
    def any(self) -> Blocks:
        """The blocks of some output, whose samples and temperature are those of all."""
        return next(iter(self.outputs.values()))


def read_record(log: Log, wanted: RecordOptions, progress: Progress | None) -> RawRecord:
    """Read one record.

    Raises
    ------
    MultiposError
        A column is missing; nothing tells the time; there are too few samples, or the force or the
        temperature of a row is unknown.
    UsageError
        More than three columns could be outputs.
    """
    timing = wanted.timing.in_log(log)
    raw = _outputs(log, wanted, timing.column)
    with (
        Samples(log, raw.names, timing, drop_bad=wanted.drop_bad, as_they_are=True) as samples,
        ExitStack() as stack,
    ):
        samples.survey(None, progress)
        rate = _rate(samples)
        names = _names(raw.names, wanted.calibration)
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
        _require_sizes(log.source, names, means)
        if wanted.calibration is not None:
            _require_one_g(log.source, wanted.calibration, means[: len(names)])
        temperature = _measured(log.source, means[len(names) :])
        parts = zip(names, means, phases, strict=False)
        return RawRecord(
            source=log.source,
            rate=rate,
            unit=_unit(log, raw.names),
            outputs={
                name: Blocks(samples.rows, length, values, temperature, each.sums(lengths))
                for name, values, each in parts
            },
            findings=about(
                log.source,
                (*log.left_out, *raw.findings, *_dropped(samples), *gaps.findings()),
            ),
        )


def _unit(log: Log, names: tuple[str, ...]) -> str | None:
    """Return the unit that the header gives outputs, None where it gives none or several."""
    units = {log.units.get(name) for name in names}
    return units.pop() if len(units) == 1 else None


def _rate(samples: Samples) -> float:
    if samples.rate is None:
        raise MultiposError(
            f"{samples.log.source}: no column is a time, so the duration of a sample is unknown; "
            "name one with --time-column, or give --rate."
        )
    if samples.rows < _FEWEST:
        raise MultiposError(
            f"{samples.log.source}: {samples.rows} samples are too few for stability; a record "
            f"needs at least {_FEWEST}, and hours for its slow part."
        )
    return samples.rate


def _require_sizes(source: str, names: Sequence[str], means: Array) -> None:
    """Refuse outputs, of block means (M …, n), whose variances would be no numbers."""
    for name, size in zip(names, np.abs(means).max(axis=1).tolist(), strict=False):
        if 0.0 < size < SMALLEST:
            raise MultiposError(
                f"{source}: column '{name}' is {size:g} at most, too small a number to be squared; "
                "give the readings in a smaller unit."
            )


def _dropped(samples: Samples) -> list[Finding]:
    if not samples.dropped:
        return []
    text = f"{samples.dropped} of {samples.log_rows} rows are bad and were omitted"
    return [Finding("dropped-rows", "note", text)]


def _outputs(log: Log, wanted: RecordOptions, time_column: str | None) -> Outputs:
    if wanted.calibration is not None:
        model = wanted.calibration.model
        found = {name: log.find(name) for name in (*model.outputs, *model.environment)}
        units = {name: log.units[its] for name, its in found.items() if its in log.units}
        require_units(log.source, units, model.outputs, model.environment, model.unit)
        return Outputs(tuple(found[name] for name in model.outputs), ())
    temperature = None if wanted.temperature is None else log.find(wanted.temperature)
    taken = [*time_columns(log), *filter(None, (time_column, temperature))]
    return choose_outputs(log, wanted.outputs, taken)


def _names(raw: tuple[str, ...], calibration: Calibration | None) -> tuple[str, ...]:
    if calibration is None:
        return raw
    symbol = calibration.field.symbol
    return tuple(f"{symbol}_{COMPONENTS[axis]}" for axis in calibration.model.sensed_axes)


def _temperature(log: Log, wanted: RecordOptions, samples: Samples) -> slice:
    """Return the row of the temperature in the pieces, none where it was not measured."""
    name = "temperature" if wanted.temperature is None else log.find(wanted.temperature)
    if name not in samples.others:
        if wanted.temperature is not None:
            raise MultiposError(
                f"{log.source}: column '{name}' is an output or no number, so no temperature; "
                "name another with --temperature."
            )
        return slice(0)
    row = len(samples.outputs) + samples.others.index(name)
    return slice(row, row + 1)


def _compensated(
    calibration: Calibration | None, samples: Samples, piece: Array, first: int
) -> Array:
    """Return the outputs (K, k) of a piece, compensated where a calibration was given."""
    raw = piece[: len(samples.outputs)]
    if calibration is None:
        return raw
    columns = dict(zip(samples.others, piece[len(samples.outputs) :], strict=False))
    environment = {name: columns[samples.log.find(name)] for name in calibration.model.environment}
    force = calibration.compensate(raw.T, environment).T
    unknown = ~np.isfinite(force).all(axis=0)
    if unknown.any():
        raise MultiposError(
            f"{samples.log.source}: row {first + int(np.argmax(unknown)) + 1}: no force explains "
            "the reading, or a column of the model is empty there; leave the row out."
        )
    return np.ascontiguousarray(force)


def _require_one_g(source: str, calibration: Calibration, force: Array) -> None:
    """Refuse a record at rest whose force (3, b) [g] is one g in another unit."""
    if not calibration.field.same_everywhere:
        return
    size = float(median(np.linalg.norm(force, axis=0)))
    other = any(each / _NEAR < size < each * _NEAR for each in _OTHER)
    if len(force) == len(COMPONENTS) and other:
        raise MultiposError(
            f"{source}: the force of the record is {size:.3g} g at rest, where 1 g is meant; the "
            f"calibration is in {calibration.model.unit}: convert the record, or take a "
            "calibration in its unit."
        )


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
        self._timed = samples.clock is not None
        self._longest = _GAP * samples.step
        self._last = np.empty(0)
        self._count = 0

    def feed(self, piece: Array) -> None:
        if not self._timed:
            return
        time = piece[-1]
        self._count += int((np.diff(time, prepend=self._last) > self._longest).sum())
        self._last = time[-1:]

    def findings(self) -> list[Finding]:
        if not self._count:
            return []
        text = f"the time has {self._count} gaps; samples are taken as evenly spaced"
        return [Finding("time-gap", "warning", text, "Check the logger.")]

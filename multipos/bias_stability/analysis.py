"""How stable a sensor at rest is: noise laws, warm-up, drift, temperature, and how it repeats.

Records are read one by one, whatever their length (`multipos.bias_stability.static_records`). Of
several the sums of the Allan variance are pooled; noise laws and trends are found together
(`multipos.bias_stability.trends`). The zero of a record is its mean without the warm-up; the
standard deviation of the zeros is the bias stability of the six-position paper, measured as it
says: at least four switch-ons, the calibration in place.

Movement in a static record: steps and knocks that neither noise nor a warm-up makes.

Of the means b_k of its blocks a record that lies still has differences

    J_k = b_{k+1} − b_{k−1},                                                               (1)

over the block in between, where a movement may have happened, of one law: that of its noise, with a
drift or warm-up which changes slowly from one to the next. A movement is where J is beyond 8 of
their standard deviation, 1.4826 times the median modulus about the median, and beyond four times
those three blocks before and after, so that the steep begin of a warm-up is none.

From what was found in samples to numbers in seconds, with their units and U.

References
----------
Song and Qin 2009, section 3 and figure 1. IEEE Std 952 and 1293 (the laws). C. A. Greenhall,
W. J. Riley, 35th PTTI Meeting, 2003 (degrees of freedom of the Allan variance).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from multipos.bias_stability import allan, trends
from multipos.bias_stability.stability_result import (
    Estimate,
    OutputStability,
    Spread,
    Stability,
    StaticRecord,
    TemperatureCoefficient,
    WarmUp,
)
from multipos.bias_stability.static_records import RawRecord, RecordOptions, read_record
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, StrPath, split_names, spread
from multipos.files.tables import Source
from multipos.finding import Finding, Findings, in_order
from multipos.logs.clock import TimeUnit
from multipos.logs.opening import less_copies, open_log
from multipos.logs.samples import Progress, read_timing, share_of
from multipos.logs.table import Log, called_as
from multipos.numerics.arrays import Array, Places, median
from multipos.numerics.quantiles import check_confidence, coverage_factor
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.units import MICRO_G

_FAR = 8.0  # standard deviations: of normal noise once in 1e15
_ALONE = 4.0  # times what is before and after
_BESIDE = 3  # blocks, so that neither is of the same movement
_FEWEST = 32  # blocks
_NORMAL = 1.4826  # standard deviation over median modulus


@frozen(eq=True)
class Movement:
    """The largest movement of an output: its block, its jump, and how many there are."""

    block: int
    jump: float
    count: int


def find_movement(means: Array) -> Movement | None:
    """Return the largest movement in the means (B,) of blocks; None where it lay still."""
    if len(means) < _FEWEST:
        return None
    jump = means[2:] - means[:-2]
    size = np.abs(jump - median(jump))
    sd = _NORMAL * float(median(size))
    beside = np.maximum(size[: -2 * _BESIDE], size[2 * _BESIDE :])
    if not sd:  # of a few codes only: nothing tells what is usual
        return None
    judged = size[_BESIDE:-_BESIDE]
    moved = np.flatnonzero((judged > _FAR * sd) & (judged > _ALONE * beside)) + _BESIDE
    if not len(moved):
        return None
    largest = int(moved[np.argmax(size[moved])])
    return Movement(largest + 1, float(jump[largest]), _separate(moved))


def _separate(moved: Places) -> int:
    """Return of how many movements blocks are: those nearer than three are of one."""
    return 1 + int((np.diff(moved) > _BESIDE).sum())


_NOTHING = 0.1  # of the largest mean reading: an output that reads less has no ppm


class Values:
    """Numbers of several records in the units of time and of the outputs."""

    def __init__(
        self, raw: Sequence[RawRecord], lengths: Sequence[int], unit: str, confidence: float
    ) -> None:
        self._unit = unit
        self._rate, self._confidence = raw[0].rate, confidence
        self._raw, self._lengths = raw, lengths
        self._samples = [each.samples for each in raw]
        self._means = np.mean([each.blocks.mean(axis=1) for each in raw], axis=0)

    def output(self, index: int, found: trends.Description) -> OutputStability:
        """Return the stability of one output."""
        adev = self._deviation(index)
        dof = allan.degrees_of_freedom(found.laws, self._lengths, self._samples)
        root = np.sqrt(self._rate)
        return OutputStability(
            tau=np.array(self._lengths) / self._rate,
            adev=adev,
            u=adev / np.sqrt(2.0 * dof),
            dof=dof,
            white_noise=self._law(found, 0, 1.0 / root, f"{self._unit}/sqrt(Hz)"),
            bias_instability=self._law(found, 1, 1.0, self._unit),
            random_walk=self._law(found, 2, root, f"{self._unit}/sqrt(s)"),
            drift=self._estimate(found.found[trends.DRIFT], self._rate, f"{self._unit}/s"),
            warm_up=self._warm_up(found),
            temperature_coefficient=self._temperature(found, index),
        )

    def _deviation(self, index: int) -> Array:
        sums = np.zeros(len(self._lengths))
        for each in self._raw:
            sums[: each.sums.shape[1]] += each.sums[index]
        scale = [2.0 * m**2 * sum(allan.starts(n, m) for n in self._samples) for m in self._lengths]
        return np.asarray(np.sqrt(sums / scale))

    def _law(self, found: trends.Description, law: int, factor: float, unit: str) -> Estimate:
        value, u = found.laws.root(law, 1.0)
        U = found.laws.root(law, coverage_factor(self._confidence, np.inf))[1]
        return Estimate(value, u, U, np.inf, unit).scaled(factor, unit)

    def _estimate(self, found: trends.TrendEstimate, factor: float, unit: str) -> Estimate:
        U = coverage_factor(self._confidence, found.dof) * found.u
        return Estimate(found.value, found.u, U, found.dof, unit).scaled(factor, unit)

    def _warm_up(self, found: trends.Description) -> WarmUp | None:
        if found.time_constant is None:
            return None
        amplitude = self._estimate(found.found[trends.WARM_UP], 1.0, self._unit)
        constant = self._estimate(found.time_constant, 1.0 / self._rate, "s")
        lowest = float(found.laws.deviation(np.array(self._lengths, dtype=np.float64)).min())
        times = np.log(max(abs(amplitude.value) / lowest, 1.0))
        return WarmUp(amplitude, constant, float(constant.value * times))

    def _temperature(self, found: trends.Description, index: int) -> TemperatureCoefficient | None:
        if trends.TEMPERATURE not in found.found:
            return None
        change = self._estimate(found.found[trends.TEMPERATURE], 1.0, f"{self._unit}/degC")
        micro_g = ppm = None
        if self._unit in MICRO_G:
            micro_g = change.scaled(MICRO_G[self._unit], "ug/degC")
        mean = float(self._means[index])
        if abs(mean) >= _NOTHING * np.abs(self._means).max() and mean != 0.0:
            ppm = change.scaled(1e6 / mean, "ppm/degC")
        return TemperatureCoefficient(change, micro_g, ppm)


_ALIKE = 0.01  # relative difference of sample rates that are one
_FIRST = 0.01  # of a record: its zero just after switching on
_LEAST = 4  # switch-ons that the six-position paper asks for


def stability(
    *logs: "Source | Log | Sequence[Source | Log]",
    calibration: "Calibration | StrPath | None" = None,
    outputs: Names | None = None,
    temperature: str | None = None,
    columns: Names | None = None,
    time_column: str | None = None,
    time_unit: TimeUnit | None = None,
    rate: float | None = None,
    drop_bad: bool = False,
    unit: str | None = None,
    confidence: float = 0.95,
    progress: Progress | None = None,
) -> Stability:
    """Describe how stable a sensor at rest is.

    Parameters
    ----------
    *logs : path, mapping of columns, data frame, or Log
        Static records, each a switch-on of its own; one by one, or one list or tuple of them.
    calibration : Calibration or path, optional
        Compensates the outputs; without it they are taken raw.
    outputs : names, optional
        The columns that are outputs; otherwise every numeric column without another meaning.
    temperature : str, optional
        Column with the temperature [degC]; ``temperature`` where there is one.
    columns : names, optional
        Names of all columns of the logs, where they have no header or others are wanted.
    time_column : str, optional
        Column with the time; otherwise the one that is named so.
    time_unit : str, optional
        's', 'ms', 'us' or 'ns'; otherwise by the column's name, or its steps.
    rate : float, optional [Hz]
        Sample rate, where no column tells the time.
    drop_bad : bool
        Leave out rows with a bad cell; how many is said.
    unit : str, optional
        Of raw outputs, such as 'g' or 'V'.
    confidence : float
        Coverage probability of U.
    progress : callable, optional
        Called with how much has been read.

    Returns
    -------
    Stability

    Raises
    ------
    MultiposError
        A record is short, has no time, or an output that never changes; the records differ in
        their outputs or sample rates.
    UsageError
        No log, or an option is at fault.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> record = {"time": np.arange(4000) / 10.0, "ax": 0.01 + 2e-4 * rng.standard_normal(4000)}
    >>> noise = mp.stability(record, unit="g").outputs["ax"].white_noise
    >>> print(f"{1e6 * noise.value:.0f}e-6 {noise.unit}")
    63e-6 g/sqrt(Hz)
    """
    given, copies = less_copies(spread(logs))
    if not given:
        raise UsageError("stability needs one static record or more.")
    timing = read_timing(time_column, time_unit, rate)
    _check_options(calibration, outputs, unit, confidence)
    model = calibration
    if model is not None and not isinstance(model, Calibration):
        model = load(model)
    wanted = RecordOptions(
        outputs=None if outputs is None else split_names(outputs, "--outputs"),
        calibration=model,
        temperature=temperature,
        timing=timing,
        drop_bad=drop_bad,
    )
    raw = []
    for i, each in enumerate(given):
        report = share_of(progress, i, len(given))
        log = called_as(open_log(each, columns=columns, outputs=outputs), (trends.TEMPERATURE,))
        raw.append(read_record(log, wanted, report))
    _check_alike(raw)
    own = raw[0].unit or "reading" if model is None else model.field.printed
    found = _complete(raw, model, unit or own, confidence)
    return replace(found, findings=in_order((*copies, *found.findings)))


def _check_options(
    calibration: object, outputs: object, unit: str | None, confidence: float
) -> None:
    if calibration is not None and outputs is not None:
        raise UsageError("--outputs names raw columns, but --calibration has its own; drop one.")
    if calibration is not None and unit is not None:
        raise UsageError(
            "--unit is of raw outputs, but with --calibration they are compensated; drop it."
        )
    check_confidence(confidence)


def _check_alike(raw: Sequence[RawRecord]) -> None:
    first = raw[0]
    for each in raw[1:]:
        if each.names != first.names:
            raise MultiposError(
                f"{each.source}: its outputs are {', '.join(each.names)}, those of {first.source} "
                f"{', '.join(first.names)}; name common ones with --outputs."
            )
        if each.unit != first.unit:
            raise MultiposError(
                f"{each.source}: its outputs are in {each.unit or 'no stated unit'}, those of "
                f"{first.source} in {first.unit or 'none'}; convert one of them."
            )
        if not abs(each.rate / first.rate - 1.0) < _ALIKE:
            raise MultiposError(
                f"{each.source}: {each.rate:.6g} Hz, but {first.source} has {first.rate:.6g} Hz; "
                "records that are pooled need one sample rate."
            )
        if (each.temperature is None) != (first.temperature is None):
            known, missing = (first, each) if each.temperature is None else (each, first)
            raise MultiposError(
                f"{missing.source}: no temperature, which {known.source} has; leave it out of "
                "both, or record it in both."
            )
    for each in raw:
        stuck = np.flatnonzero(each.sums[:, 0] == 0.0)
        if len(stuck):
            raise MultiposError(
                f"{each.source}: '{each.names[stuck[0]]}' never changes; a stuck output has no "
                "stability, leave it out with --outputs."
            )


def _complete(
    raw: Sequence[RawRecord], calibration: Calibration | None, unit: str, confidence: float
) -> Stability:
    names, lengths = raw[0].names, allan.octaves(max(each.samples for each in raw))
    steady = [each.source for each in raw if _is_steady(each)]
    found = [_trends(raw, i, lengths, not steady) for i in range(len(names))]
    records = tuple(_kept(each, [d.transients[r] for d in found]) for r, each in enumerate(raw))
    values = Values(raw, lengths, unit, confidence)
    outputs = {name: values.output(i, found[i]) for i, name in enumerate(names)}
    run_to_run, turn_on = _repeats(records, names)
    return Stability(
        outputs=outputs,
        run_to_run=run_to_run,
        turn_on=turn_on,
        records=records,
        sample_rate=raw[0].rate,
        unit=unit,
        confidence=confidence,
        calibration=None if calibration is None else calibration.created,
        findings=_find(raw, steady, outputs),
    )


def _kept(record: RawRecord, transients: Sequence[Array]) -> StaticRecord:
    zero = dict(zip(record.names, record.blocks, strict=True))
    return StaticRecord(
        source=record.source,
        samples=record.samples,
        time=np.asarray((np.arange(record.blocks.shape[1]) + 0.5) * record.length / record.rate),
        zero=zero,
        settled={
            name: float(np.mean(zero[name] - transient))
            for name, transient in zip(record.names, transients, strict=True)
        },
        temperature=record.temperature,
    )


def _repeats(
    records: Sequence[StaticRecord], names: Sequence[str]
) -> tuple[dict[str, Spread], dict[str, Spread]]:
    """Return how the settled zero and the zero just after switching on repeat."""
    if len(records) == 1:
        return {}, {}
    settled = {name: _spread([each.settled[name] for each in records]) for name in names}
    begun = {name: _spread([_begin(each.zero[name]) for each in records]) for name in names}
    return settled, begun


def _is_steady(record: RawRecord) -> bool:
    return record.temperature is not None and not np.ptp(record.temperature)


def _blocks(record: RawRecord, output: int, count: int, with_temperature: bool) -> trends.Blocks:
    sums = np.zeros(count)
    sums[: record.sums.shape[1]] = record.sums[output]
    return trends.Blocks(
        samples=record.samples,
        length=record.length,
        values=record.blocks[output],
        temperature=record.temperature if with_temperature else None,
        sums=sums,
    )


def _trends(
    raw: Sequence[RawRecord], output: int, lengths: Sequence[int], with_temperature: bool
) -> trends.Description:
    """Return trends and noise; a warm-up that follows the temperature is one all the same."""
    blocks = [_blocks(each, output, len(lengths), with_temperature) for each in raw]
    found = trends.describe(blocks, lengths)
    if blocks[0].temperature is None or found.time_constant is not None:
        return found
    recorded = trends.describe([replace(each, temperature=None) for each in blocks], lengths)
    if recorded.time_constant is None:
        return found
    return replace(
        found,
        found={**found.found, trends.WARM_UP: recorded.found[trends.WARM_UP]},
        time_constant=recorded.time_constant,
        transients=recorded.transients,
    )


def _begin(zero: Array) -> float:
    return float(zero[: max(round(_FIRST * len(zero)), 1)].mean())


def _spread(values: list[float]) -> Spread:
    return Spread(float(np.std(values, ddof=1)), float(np.ptp(values)), len(values) - 1)


def _find(
    raw: Sequence[RawRecord], steady: Sequence[str], outputs: Mapping[str, OutputStability]
) -> Findings:
    said = [found for each in raw for found in each.findings]
    if steady:
        text = f"{steady[0]}: the temperature is constant and not used"
        said.append(Finding("constant-temperature", "note", text))
    said += [found for each in raw for found in _movements(each)]
    shortest = min(each.samples / each.rate for each in raw)
    for name, found in outputs.items():
        said += _unsettled(name, found, shortest)
    if 1 < len(raw) < _LEAST:
        text = f"{len(raw)} records determine turn-on repeatability poorly"
        action = f"Record at least {_LEAST} switch-ons."
        said.append(Finding("few-repeats", "note", text, action))
    return in_order(said)


def _unsettled(name: str, found: OutputStability, shortest: float) -> list[Finding]:
    """Say that a warm-up settles only after the shortest record [s] has ended."""
    if found.warm_up is None or not found.warm_up.settled_after > shortest:
        return []
    text = (
        f"{name}: warm-up takes {found.warm_up.settled_after:.0f} s, but a record ends at "
        f"{shortest:.0f} s"
    )
    return [Finding("warm-up-unsettled", "warning", text, "Record longer.", outputs=(name,))]


def _movements(record: RawRecord) -> list[Finding]:
    """Say what moved in a record that should have lain still."""
    said = []
    for name, means in zip(record.names, record.blocks, strict=True):
        found = find_movement(means)
        if found is None:
            continue
        when = (found.block + 0.5) * record.length / record.rate
        more = f", the largest of {found.count} movements" if found.count > 1 else ""
        text = (
            f"{record.source}: {name} jumps by {found.jump:.2g} near {when:.0f} s{more}, as if "
            "moved or knocked; noise, drift and bias include it"
        )
        action = "Remove this part of the record."
        said.append(Finding("jump", "warning", text, action, outputs=(name,)))
    return said

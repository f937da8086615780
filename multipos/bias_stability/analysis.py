"""How stable a sensor at rest is: noise laws, warm-up, drift, temperature, and how it repeats.

- `stability` returns the `Stability` of records.

Records are read one by one, whatever their length (`multipos.bias_stability.static_records`). Of
several the sums of the Allan variance are pooled; noise laws and trends are found together
(`multipos.bias_stability.trends`). The zero of a record is its mean without the warm-up; the
standard deviation of the zeros is the bias stability of the six-position paper, measured as it
says: at least four switch-ons, the calibration in place.

References
----------
Song and Qin 2009, section 3 and figure 1. IEEE Std 952 and 1293 (the laws). C. A. Greenhall,
W. J. Riley, 35th PTTI Meeting, 2003 (degrees of freedom of the Allan variance).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from multipos.bias_stability import allan, trends
from multipos.bias_stability.movement import find_movement
from multipos.bias_stability.noise_laws import degrees_of_freedom
from multipos.bias_stability.stability_result import (
    Estimate,
    OutputStability,
    Spread,
    Stability,
    StaticRecord,
    TemperatureCoefficient,
    WarmUp,
)
from multipos.bias_stability.static_records import (
    Blocks,
    RawRecord,
    RecordOptions,
    read_record,
)
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, StrPath, split_names, spread
from multipos.files.tables import Source
from multipos.finding import Finding, Findings, in_order
from multipos.logs.clock import TimeUnit
from multipos.logs.opening import less_copies, open_log
from multipos.logs.samples import Progress, read_timing, share_of
from multipos.logs.table import Log, called_as
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import check_confidence, coverage_factor
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.units import MICRO_G

_ALIKE = 0.01  # relative difference of sample rates that are one
_FIRST = 0.01  # of a record: its zero just after switching on
_NOTHING = 0.1  # of the largest mean reading: an output that reads less has no ppm


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
        if [*each.outputs] != [*first.outputs]:
            raise MultiposError(
                f"{each.source}: its outputs are {', '.join(each.outputs)}, those of "
                f"{first.source} {', '.join(first.outputs)}; name common ones with --outputs."
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
        recorded = each.any.temperature is not None
        if recorded != (first.any.temperature is not None):
            known, missing = (each, first) if recorded else (first, each)
            raise MultiposError(
                f"{missing.source}: no temperature, which {known.source} has; leave it out of "
                "both, or record it in both."
            )
    for each in raw:
        stuck = [name for name, one in each.outputs.items() if one.sums[0] == 0.0]
        if stuck:
            raise MultiposError(
                f"{each.source}: '{stuck[0]}' never changes; a stuck output has no "
                "stability, leave it out with --outputs."
            )


def _complete(
    raw: Sequence[RawRecord], calibration: Calibration | None, unit: str, confidence: float
) -> Stability:
    names, lengths = tuple(raw[0].outputs), allan.octaves(max(each.any.samples for each in raw))
    varies = all(map(_varies, raw))
    found = {name: _trends([each.outputs[name] for each in raw], lengths, varies) for name in names}
    records = tuple(
        _kept(each, {name: one.transients[r] for name, one in found.items()})
        for r, each in enumerate(raw)
    )
    values = _Values(raw, lengths, unit, confidence)
    outputs = {name: values.output(name, found[name]) for name in names}
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
        findings=_find(raw, outputs),
    )


def _kept(record: RawRecord, transients: Mapping[str, Array]) -> StaticRecord:
    blocks = record.any
    zero = {name: each.values for name, each in record.outputs.items()}
    return StaticRecord(
        source=record.source,
        samples=blocks.samples,
        time=blocks.time / record.rate,
        zero=zero,
        settled={name: float(np.mean(zero[name] - transients[name])) for name in zero},
        temperature=blocks.temperature,
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


def _varies(record: RawRecord) -> bool:
    """Whether the temperature is known, and not constant."""
    temperature = record.any.temperature
    return temperature is not None and bool(np.ptp(temperature))


def _trends(
    blocks: Sequence[Blocks], lengths: Sequence[int], with_temperature: bool
) -> trends.Description:
    """Return trends and noise; a warm-up that follows the temperature is one all the same."""
    recorded = [replace(each, temperature=None) for each in blocks]
    if not with_temperature:
        return trends.describe(recorded, lengths)
    found = trends.describe(blocks, lengths)
    if found.time_constant is not None:
        return found
    without = trends.describe(recorded, lengths)
    if without.time_constant is None:
        return found
    return found._replace(
        coefficients={**found.coefficients, trends.WARM_UP: without.coefficients[trends.WARM_UP]},
        time_constant=without.time_constant,
        transients=without.transients,
    )


class _Values:
    """Makes of the description of an output its numbers in seconds, with their units and U."""

    def __init__(
        self, raw: Sequence[RawRecord], lengths: Sequence[int], unit: str, confidence: float
    ) -> None:
        self._raw, self._lengths, self._unit = raw, lengths, unit
        self._rate, self._confidence = raw[0].rate, confidence

    def output(self, name: str, found: trends.Description) -> OutputStability:
        """Return the stability of one output."""
        blocks = [each.outputs[name] for each in self._raw]
        samples = [each.samples for each in blocks]
        sums = [each.sums for each in blocks]
        adev = np.sqrt(allan.pooled_variances(sums, self._lengths, samples))
        dof = degrees_of_freedom(found.laws, self._lengths, samples)
        root = np.sqrt(self._rate)
        return OutputStability(
            tau=np.array(self._lengths) / self._rate,
            adev=adev,
            u=adev / np.sqrt(2.0 * dof),
            dof=dof,
            white_noise=self._law(found, 0, 1.0 / root, f"{self._unit}/sqrt(Hz)"),
            bias_instability=self._law(found, 1, 1.0, self._unit),
            random_walk=self._law(found, 2, root, f"{self._unit}/sqrt(s)"),
            drift=self._estimate(found.coefficients[trends.DRIFT], self._rate, f"{self._unit}/s"),
            warm_up=self._warm_up(found),
            temperature_coefficient=self._temperature(found, name),
        )

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
        amplitude = self._estimate(found.coefficients[trends.WARM_UP], 1.0, self._unit)
        constant = self._estimate(found.time_constant, 1.0 / self._rate, "s")
        lowest = float(found.laws.deviation(np.array(self._lengths, dtype=np.float64)).min())
        times = np.log(max(abs(amplitude.value) / lowest, 1.0))
        return WarmUp(amplitude, constant, float(constant.value * times))

    def _temperature(self, found: trends.Description, name: str) -> TemperatureCoefficient | None:
        if trends.TEMPERATURE not in found.coefficients:
            return None
        change = self._estimate(found.coefficients[trends.TEMPERATURE], 1.0, f"{self._unit}/degC")
        micro_g = ppm = None
        if self._unit in MICRO_G:
            micro_g = change.scaled(MICRO_G[self._unit], "ug/degC")
        means = {
            each: float(np.mean([one.outputs[each].values.mean() for one in self._raw]))
            for each in self._raw[0].outputs
        }
        mean, largest = means[name], max(map(abs, means.values()))
        if abs(mean) >= _NOTHING * largest and mean != 0.0:
            ppm = change.scaled(1e6 / mean, "ppm/degC")
        return TemperatureCoefficient(change, micro_g, ppm)


def _begin(zero: Array) -> float:
    return float(zero[: max(round(_FIRST * len(zero)), 1)].mean())


def _spread(values: list[float]) -> Spread:
    return Spread(float(np.std(values, ddof=1)), float(np.ptp(values)), len(values) - 1)


def _find(raw: Sequence[RawRecord], outputs: Mapping[str, OutputStability]) -> Findings:
    said = [found for each in raw for found in each.findings]
    said += [found for each in raw for found in _movements(each)]
    shortest = min(each.any.samples / each.rate for each in raw)
    for name, found in outputs.items():
        said += _unsettled(name, found, shortest)
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
    for name, blocks in record.outputs.items():
        found = find_movement(blocks.values)
        if found is None:
            continue
        when = float(blocks.time[found.block]) / record.rate
        more = f", the largest of {found.count} movements" if found.count > 1 else ""
        text = (
            f"{record.source}: {name} jumps by {found.jump:.2g} near {when:.0f} s{more}, as if "
            "moved or knocked; noise, drift and bias include it"
        )
        action = "Remove this part of the record."
        said.append(Finding("jump", "warning", text, action, outputs=(name,)))
    return said

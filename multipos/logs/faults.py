"""What is wrong with a log: wrapped numbers, mixed units, saturated or stuck outputs, motion, gaps.

`find_wrapped`, `find_second_unit` and `differ_in_unit` look at whole logs, `find_faults`,
`find_stuck`, `find_saturated`, `compare_scales` and `common_noise` at rests, of which `suspects`,
`is_saturated` and `saturated_few` tell the saturated ones; `is_factor` knows the ratio of two
units, `at_one_value` and `fault_and_way` word what is found.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.errors import MultiposError
from multipos.finding import Finding, Level
from multipos.logs.rest_means import RestMean, is_one_code
from multipos.logs.rests import Rest, Survey
from multipos.logs.samples import Kept, Samples
from multipos.numerics.arrays import SMALLEST, Array, median

# A share of the samples at one value, the extreme of the log, that noise does not explain.
_SATURATED = 0.01
_SATURATED_SAMPLES = 5
_BESIDE = 3  # values beside an extreme whose counts are compared with its own
_HEAP = 1.5  # times as many samples as at the values beside it
_NOISY = 1.5  # steps of resolution: with less noise many samples share one value anyway
_STUCK = 20  # equal samples in a row
_MOSTLY = 0.5  # of a rest: so many equal samples in a row are no chance
_UNITS = 3.0  # times the scale factor of another output: no pair of one unit differs so much
_SPREAD = 50.0  # condition of the ellipsoid: worse where the positions do not span the sphere
_FEW = 30.0  # independent samples, below which u is itself uncertain
_SIGNIFICANT = 5.0  # times its standard uncertainty
_UNSTEADY = 3.0  # times the usual standard deviation of a rest
_TWIN_DEG = 2.0
_EDGE = 0.1  # of the windows of a section may be its edges
_FEW_RESTS = 0.25  # of the rests, that a calibration may do without


class SaturatedRestsError(MultiposError):
    """A few rests are saturated and nothing else is wrong: the others may do without them."""


def saturated_few(findings: Sequence[Finding], count: int) -> frozenset[str]:
    """Return the labels of saturated rests, of `count` in all; none where they are too many."""
    labels = frozenset(row for each in findings if each.code == "saturated" for row in each.rows)
    return labels if len(labels) <= _FEW_RESTS * count else frozenset()


def fault_and_way(wrong: Finding) -> str:
    """Return what is wrong with means and the ways out, as an error says it."""
    action = wrong.action or "Correct the log."
    way = f"{action[0].lower()}{action[1:].removesuffix('.')}"
    return f"{wrong.text}; {way}, or continue with --accept-faults of average or calibrate."


def compare_scales(outputs: Sequence[str], means: Array) -> Finding | None:
    """Find outputs of different units, by the ellipsoid of their means (n, 3)."""
    scale = _semi_axes(means)
    if scale is None or scale.max() <= _UNITS * scale.min():
        return None
    large, small = outputs[int(np.argmax(scale))], outputs[int(np.argmin(scale))]
    text = (
        f"'{large}' is {scale.max() / scale.min():.3g} times as sensitive as '{small}'; their "
        "units probably differ"
    )
    action = "Convert the outputs to one unit, or average them one at a time with --outputs."
    return Finding("output-unit", "warning", text, action, outputs=(large, small))


def _semi_axes(means: Array) -> Array | None:
    """Return the semi-axes of the ellipsoid along the axes that the means (n, 3) lie on."""
    if means.shape[1] != 3 or len(means) < 6:
        return None
    half = np.ptp(means, axis=0) / 2.0
    if not (half >= SMALLEST).all():  # what stands still or is lost has no scale
        return None
    y = (means - means.min(axis=0)) / half - 1.0
    rows = np.column_stack([y**2, y])
    if np.linalg.cond(rows) > _SPREAD:
        return None
    a, b = np.split(np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0], 2)
    if not (a > 0.0).all():
        return None
    return np.asarray(half / np.sqrt(a / (1.0 + float((b**2 / (4.0 * a)).sum()))))


def find_stuck(
    outputs: Sequence[str], found: Sequence[RestMean], surveys: Sequence[Survey]
) -> list[list[str]]:
    """Return what is said of each rest in which an output never changes.

    At an extreme of its log it is saturated, elsewhere stuck.
    """
    usual = median([each.sd for each in found], axis=0)
    said: list[list[str]] = []
    for each, survey in zip(found, surveys, strict=True):
        noisy = usual > 0.5 * np.nan_to_num(survey.resolution)
        constant = (each.longest >= _MOSTLY * each.n) & noisy
        value = np.where(each.at_low >= each.at_high, each.low, each.high)
        extreme = (value == survey.lowest) | (value == survey.highest)
        said.append([])
        for j in np.flatnonzero(constant).tolist():
            fault, count = "saturated" if extreme[j] else "stuck", int(each.longest[j])
            said[-1].append(at_one_value(outputs[j], fault, float(value[j]), count, each.n))
    return said


def at_one_value(output: str, fault: str, value: float, count: int, n: int) -> str:
    """Return how an output is said to be at one value too often."""
    return f"output '{output}' is {fault} at {value:.10g} ({count} of {n} samples)"


def suspects(each: RestMean, survey: Survey) -> list[tuple[int, bool]]:
    """Return the outputs that are often at an extreme of the whole log, and whether the upper."""
    noisy = (each.sd >= _NOISY * survey.resolution) & (survey.resolution > 0.0)
    enough = max(_SATURATED_SAMPLES, _SATURATED * each.n)
    high = noisy & (each.high == survey.highest) & (each.at_high >= enough)
    low = noisy & (each.low == survey.lowest) & (each.at_low >= enough)
    found = [(j, True) for j in np.flatnonzero(high).tolist()]
    return found + [(j, False) for j in np.flatnonzero(low & ~high).tolist()]


def is_saturated(counts: Sequence[int]) -> bool:
    """Tell from how many samples have each value, from the extreme inward.

    Noise has fewer samples at its extreme than beside it, or as many where codes differ in
    width; what was cut off has all of its tail there.
    """
    beside = max(counts[1 : 1 + _BESIDE], default=0)
    more = counts[0] - beside
    return more > _SIGNIFICANT * (counts[0] + beside) ** 0.5 and counts[0] > _HEAP * beside


def find_faults(
    outputs: Sequence[str],
    found: Sequence[RestMean],
    resolution: Array,
    gaps: Sequence[int],
    moving: Sequence[float | None],
    labels: Sequence[str],
) -> tuple[list[list[Finding]], list[Finding]]:
    """Return the findings about each rest, and about all of them together."""
    usual = median([each.sd for each in found], axis=0)
    faults = []
    for each, gap, moved in zip(found, gaps, moving, strict=True):
        own = [*_moved(moved), *_gaps(gap)]
        for j, output in enumerate(() if moved else outputs):
            own += _output_faults(output, j, each, float(usual[j]), float(resolution[j]))
        faults.append(own)
    still = [i for i, moved in enumerate(moving) if not moved]
    return faults, _twins([found[i] for i in still], [labels[i] for i in still])


def _moved(share: float | None) -> list[Finding]:
    if not share:
        return []
    if share > _EDGE:
        text = f"the sensor moved during {100 * share:.0f} % of the time"
        action = "Correct its rows in --sections, or record it again."
        return [Finding("in-motion", "warning", text, action)]
    text = "the sensor moved at the beginning or end"
    return [Finding("motion-at-edge", "warning", text, "Give fewer rows of it with --sections.")]


def _gaps(count: int) -> list[Finding]:
    if not count:
        return []
    text = "the time has 1 gap" if count == 1 else f"the time has {count} gaps"
    return [Finding("time-gap", "warning", text, "Check the logger.")]


def _output_faults(
    output: str, j: int, each: RestMean, usual: float, resolution: float
) -> list[Finding]:
    notes: list[Finding] = []

    def add(code: str, level: Level, text: str) -> None:
        notes.append(Finding(code, level, text, outputs=(output,)))

    noisy = each.sd[j] >= _NOISY * resolution
    if noisy and each.longest[j] >= max(_STUCK, each.n / 10):
        add("stuck", "warning", f"'{output}' repeats one value {each.longest[j]} times")
    if is_one_code(each)[j] and resolution > 0.0:
        text = f"all samples of '{output}' are one code; u is resolution/sqrt(12)"
        add("quantized", "note", text)
    if usual > 0.0 and each.sd[j] > _UNSTEADY * usual:
        text = f"'{output}' has {each.sd[j] / usual:.1f} times the usual noise; its u includes it"
        add("unsteady", "note", text)
    if each.drift_u[j] > 0.0 and abs(each.drift[j]) > _SIGNIFICANT * each.drift_u[j]:
        add("slow-drift", "note", f"'{output}' drifted by {each.drift[j]:+.3g}")
    elif each.edge[j] > _SIGNIFICANT:
        text = f"'{output}' differs at the beginning or end, as if the sensor moved there"
        add("motion-at-edge", "warning", text)
    return notes + _settled(output, j, each)


def common_noise(outputs: Sequence[str], found: Sequence[RestMean]) -> list[Finding]:
    """Name the outputs whose flicker noise all rests together show."""
    ratio = np.array([each.common for each in found])
    names = [f"'{outputs[j]}'" for j in np.flatnonzero((ratio > 1.0).any(axis=0)).tolist()]
    if not names:
        return []
    raised = ratio[ratio > 1.0]
    low, high = f"{raised.min():.2g}", f"{raised.max():.2g}"
    times = low if low == high else f"{low} to {high}"
    text = (
        f"flicker noise on {', '.join(names)}: longer averaging will not help; u includes it "
        f"(factor {times})"
    )
    return [Finding("flicker", "note", text)]


def _settled(output: str, j: int, each: RestMean) -> list[Finding]:
    """Find a mean that drifts, or that rests on few independent samples."""
    if each.common[j] > 1.0:  # which is said once, of all rests
        return []
    if each.drift_factor[j] > 1.0:
        text = (
            f"'{output}' drifted slowly (by its Allan deviation); u was increased "
            f"{each.drift_factor[j]:.2g} times"
        )
        return [Finding("slow-drift", "note", text, outputs=(output,))]
    if each.sd[j] > 0.0 and each.effective[j] < _FEW:
        text = (
            f"noise of '{output}' is correlated: {each.n} samples equal about "
            f"{each.effective[j]:.2g} independent ones; its u has {each.dof[j]:.2g} dof"
        )
        return [Finding("correlated-samples", "note", text, outputs=(output,))]
    return []


def _twins(found: Sequence[RestMean], labels: Sequence[str]) -> list[Finding]:
    if len(found) < 3 or len(found[0].mean) == 2:  # two axes read the same of two directions
        return []
    means = np.array([each.mean for each in found])
    half_range = float(np.ptp(means, axis=0).max()) / 2.0
    near = np.radians(_TWIN_DEG) * half_range
    pairs = []
    for i, mean in enumerate(means):
        apart = np.linalg.norm(means[i + 1 :] - mean, axis=1)
        others = (i + 1 + np.flatnonzero(apart < near)).tolist()
        pairs += [f"{labels[i]} and {labels[k]}" for k in others if labels[i] != labels[k]]
    if not pairs:
        return []
    listed = ", ".join(pairs[:3]) + (f" and {len(pairs) - 3} more pairs" if len(pairs) > 3 else "")
    text = (
        f"positions within about {_TWIN_DEG:g} degrees of each other: {listed}; such pairs are "
        "repeats and separate no further parameters"
    )
    return [Finding("near-twins", "note", text)]


_BITS = (8, 10, 12, 14, 16, 18, 20, 24, 32)
_FULL = 0.98  # of what so many bits hold: a sensor that wraps has been near both ends
_ACROSS = 0.9  # of it from one sample to the next: no motion
_FACTORS = (9.80665, 1000.0, 1000.0 / 9.80665, 9806.65, 980.665)  # between g, mg, m/s², mm/s², Gal
_NEAR = 0.1  # relative: how far a bias moves the factor
_ALIKE = 0.4  # relative: how far the size of gravity is from its median, with a bias
_MOST = 0.8  # of the windows of a part: the others are in motion
_PARTS = 64  # places where a log may be cut in two
_FEWEST = 8  # windows of a part


def find_wrapped(samples: Samples, survey: Survey) -> list[Finding]:
    """Find outputs that wrap around: whole numbers of so many bits.

    A sample beyond the largest number comes out as the smallest.
    """
    ends = np.array([survey.lowest, survey.highest])
    for _, j, value in samples.spikes.found:  # which jumps may have been taken for
        ends[:, j] = min(ends[0, j], value), max(ends[1, j], value)
    bits = [_bits(*each) for each in np.vstack([ends, survey.resolution]).T.tolist()]
    if not any(bits):
        return []
    across = [_ACROSS * 2.0**each if each else np.inf for each in bits]
    jumps = np.zeros(len(bits), dtype=np.int64)
    first = np.full(len(bits), -1)
    for begin, outputs in samples.raw_outputs():
        steps = np.abs(np.diff(outputs, axis=1)) > np.array(across)[:, None]
        for j in np.flatnonzero(steps.any(axis=1) & (first < 0)).tolist():
            first[j] = begin + int(np.argmax(steps[j])) + 1
        jumps += steps.sum(axis=1)
    return [
        Finding(
            "wrapped",
            "warning",
            f"output '{output}' wraps around {jumps[j]} times in {bits[j]} bits "
            f"({ends[0, j]:.10g} to {ends[1, j]:.10g}), first at row {first[j]}",
            f"Read it with --signed {bits[j]}."
            if ends[0, j] >= 0.0
            else "Record it again in a wider range.",
            outputs=(output,),
        )
        for j, output in enumerate(samples.outputs)
        if jumps[j]
    ]


def _bits(low: float, high: float, step: float) -> int:
    """Return how many bits an output between two ends fills, 0 where it does not."""
    if not float(low).is_integer() or not float(high).is_integer() or not step >= 1.0:
        return 0
    for bits in _BITS:
        signed = low >= -(2.0 ** (bits - 1)) and high < 2.0 ** (bits - 1)
        unsigned = low >= 0.0 and high < 2.0**bits
        if (signed or unsigned) and high - low >= _FULL * (2.0**bits - 1.0):
            return bits
    return 0


def find_saturated(samples: Kept, rest: Rest, found: RestMean, survey: Survey) -> list[str]:
    """Return what is said of outputs that are cut off at an extreme of the log in one rest."""
    said = []
    for j, upper in suspects(found, survey):
        (outputs,) = samples.read([rest])
        values, counts = np.unique(outputs[j], return_counts=True)
        inward = counts[::-1] if upper else counts
        if is_saturated(inward.tolist()):
            value = float(values[-1] if upper else values[0])
            name = samples.outputs[j]
            said.append(at_one_value(name, "saturated", value, int(inward[0]), found.n))
    return said


def find_second_unit(survey: Survey) -> list[Finding]:
    """Find a log that goes on in another unit: gravity has two sizes."""
    sizes = survey.sizes()
    places = np.linspace(_FEWEST, len(sizes) - _FEWEST, _PARTS).astype(int)
    places = places[(places >= _FEWEST) & (places <= len(sizes) - _FEWEST)]
    if not len(places):
        return []
    logs = np.log(np.maximum(sizes, np.finfo(float).tiny))
    if np.ptp(logs) < np.log((1.0 - _NEAR) * min(_FACTORS)):
        return []  # no two medians of them can differ by a factor
    steps = [float(median(logs[at:]) - median(logs[:at])) for at in places]
    at = int(places[int(np.argmax(np.abs(steps)))])
    before, after = float(median(logs[:at])), float(median(logs[at:]))
    # Where the fewest windows lie nearer to the size of the other part.
    nearer = np.where(np.abs(logs - before) < np.abs(logs - after), 1, -1)
    at = int(np.argmax(np.cumsum(nearer))) + 1
    ratio = float(np.exp(after - before))
    if not is_factor(ratio) or not (_alike(sizes[:at]) and _alike(sizes[at:])):
        return []
    row = at * survey.grid.window
    more, times = ("larger", ratio) if ratio > 1.0 else ("smaller", 1.0 / ratio)
    text = f"from about row {row} on readings are {times:.3g} times {more}: two units in one log"
    return [Finding("two-units", "warning", text, "Convert one of the two parts.")]


def is_factor(ratio: float) -> bool:
    """Tell whether a ratio is that of two units of acceleration."""
    size = max(ratio, 1.0 / ratio)
    return any(abs(size / factor - 1.0) < _NEAR for factor in _FACTORS)


def _alike(sizes: Array) -> bool:
    if not len(sizes):
        return False
    usual = median(sizes)
    return bool((np.abs(sizes - usual) <= _ALIKE * usual).mean() >= _MOST)


def differ_in_unit(surveys: Mapping[str, Survey]) -> list[Finding]:
    """Name the first log, by its source, that reads a factor of units of what the first does."""
    sizes = [survey.sizes() for survey in surveys.values()]
    usual = [float(median(each)) if len(each) else 0.0 for each in sizes]
    first = next(iter(surveys))
    for name, each in zip(surveys, usual, strict=True):
        if usual[0] > 0.0 and each > 0.0 and is_factor(each / usual[0]):
            text = f"readings of {name} are {each / usual[0]:.3g} times those of {first}: two units"
            return [Finding("two-units", "warning", text, "Convert one of the files.")]
    return []

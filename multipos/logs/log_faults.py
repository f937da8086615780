"""What is wrong with a whole log: numbers that wrap around, and a part of it in another unit."""

from collections.abc import Sequence

import numpy as np

from multipos.logs.rest_faults import at_one_value, is_saturated, suspects
from multipos.logs.rest_means import RestMean
from multipos.logs.rest_sums import Counts
from multipos.logs.rests import Rest, Survey
from multipos.logs.samples import Kept, Samples
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median

_BITS = (8, 10, 12, 14, 16, 18, 20, 24, 32)
_FULL = 0.98  # of what so many bits hold: a sensor that wraps has been near both ends
_ACROSS = 0.9  # of it from one sample to the next: no motion
_FACTORS = (9.80665, 1000.0, 1000.0 / 9.80665, 9806.65, 980.665)  # between g, mg, m/s², mm/s², Gal
_NEAR = 0.1  # relative: how far a bias moves the factor
_ALIKE = 0.4  # relative: how far the size of gravity is from its median, with a bias
_MOST = 0.8  # of the windows of a part: the others are in motion
_PARTS = 64  # places where a log may be cut in two
_FEWEST = 8  # windows of a part


def find_wrapped(samples: Samples, survey: Survey) -> list[str]:
    """Return what is said of outputs that wrap around: whole numbers of so many bits.

    A sample beyond the largest number comes out as the smallest.
    """
    bits = [_bits(survey, j) for j in range(len(samples.outputs))]
    if not any(bits):
        return []
    across = [_ACROSS * 2.0**each if each else np.inf for each in bits]
    jumps = np.zeros(len(bits), dtype=np.int64)
    first = np.full(len(bits), -1)
    for begin, piece in samples.pieces():
        steps = np.abs(np.diff(piece[: len(bits)], axis=1)) > np.array(across)[:, None]
        for j in np.flatnonzero(steps.any(axis=1) & (first < 0)).tolist():
            first[j] = begin + int(np.argmax(steps[j])) + 1
        jumps += steps.sum(axis=1)
    return [
        f"output '{output}' wraps around: {jumps[j]} times it jumps across all of {bits[j]} bits, "
        f"from {survey.lowest[j]:.10g} to {survey.highest[j]:.10g}, first at row {first[j]}"
        for j, output in enumerate(samples.outputs)
        if jumps[j]
    ]


def _bits(survey: Survey, j: int) -> int:
    """Return how many bits an output fills, 0 where it does not."""
    low, high, step = survey.lowest[j], survey.highest[j], survey.resolution[j]
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
        values, counts = _values(samples, rest, j)
        inward = counts[::-1] if upper else counts
        if is_saturated(inward.tolist()):
            value = float(values[-1] if upper else values[0])
            name = samples.outputs[j]
            said.append(at_one_value(name, "saturated", value, int(inward[0]), found.n))
    return said


def _values(samples: Kept, rest: Rest, j: int) -> tuple[Array, Counts]:
    """Return the values of an output in a rest, in order, and how many samples have each."""
    parts = [
        piece[j, max(rest.start - first, 0) : max(rest.end - first, 0)]
        for first, piece in samples.pieces()
    ]
    values, counts = np.unique(np.concatenate(parts), return_counts=True)
    return values, counts


def find_second_unit(survey: Survey) -> list[str]:
    """Return what is said of a log that goes on in another unit: gravity has two sizes."""
    sizes = survey.sizes()
    places = np.unique(np.linspace(_FEWEST, len(sizes) - _FEWEST, _PARTS).astype(int))
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
    said = f"from about row {row} on the readings are {times:.3g} times {more} than before"
    return [f"{said}: two units in one log"]


def is_factor(ratio: float) -> bool:
    """Tell whether a ratio is that of two units of acceleration."""
    size = max(ratio, 1.0 / ratio)
    return any(abs(size / factor - 1.0) < _NEAR for factor in _FACTORS)


def _alike(sizes: Array) -> bool:
    if not len(sizes):
        return False
    usual = median(sizes)
    return bool((np.abs(sizes - usual) <= _ALIKE * usual).mean() >= _MOST)


def differ_in_unit(surveys: Sequence[Survey]) -> tuple[int, float] | None:
    """Return which log reads how many times what the first does, by a factor of units."""
    sizes = [survey.sizes() for survey in surveys]
    usual = [float(median(each)) if len(each) else 0.0 for each in sizes]
    for i, each in enumerate(usual):
        if usual[0] > 0.0 and each > 0.0 and is_factor(each / usual[0]):
            return i, each / usual[0]
    return None

"""Findings about repeats: two sensors taken for one, and one run taken twice.

- `find_repeats` returns what is found of repeated calibrations.
- `find_repeated_regressions` returns it of regressions.

A sensor drifts. Its zero moves by some hundredths of a g over years and its scale factors by a
percent, but its axes, etched or glued, keep their angles to each other, and how it is mounted
changes none of them. Two runs r and s with responses K_i (M, 3), zeros b_i and standard
uncertainties u are those of two sensors where, beyond U of both, one of

    |log |K_i,r| − log |K_i,s||,   |angle_ij,r − angle_ij,s|,   |b_i,r − b_i,s| / |K_i|      (1)

passes its limit below. Two of one production, whose scale factors scatter by 2 %, axes by half a
degree and zeros by 40 mg, pass one of them nearly always; no sensor does that drifts as data
sheets say.

Readings equal to the last digit are those of one run, and so are all coefficients of a regression.
"""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from multipos.finding import Finding, Findings, about, errors_of, serious
from multipos.numerics.arrays import Array
from multipos.numerics.terms import CONSTANT
from multipos.regression.regression import Regression
from multipos.sensor.calibration import Calibration

_SCALE = 0.02  # of a scale factor
_ANGLE = math.radians(1.0)  # between outputs
_ZERO = 0.1  # [g]


def find_repeats(found: Sequence[Calibration]) -> Findings:
    """Return the findings about repeats, those about the calibrations themselves first.

    Parameters
    ----------
    found : sequence of R Calibration
        Of one model, outputs and unit; recognised by their numbers, for files may be renamed.
    """
    carried = _carried([errors_of(c.diagnostics.findings) for c in found])
    own = (
        _repeated_run("readings", [c.readings.values for c in found]),
        _different_sensors(found),
    )
    return (*carried, *(finding for finding in own if finding is not None))


def find_repeated_regressions(runs: Sequence[Sequence[Regression]]) -> Findings:
    """Return the findings about repeated regressions, those about each of them first.

    Warnings are among these: correlated rows make u too small, by which repeats are compared.

    Parameters
    ----------
    runs : sequence of R sequences of Regression
        The responses of each repeat.
    """
    # Repeats are several switch-ons themselves.
    each = (serious(one for r in run for one in r.findings) for run in runs)
    carried = _carried([tuple(one for one in found if one.code != "turn-on") for found in each])
    repeated = _repeated_run("coefficients", [_coefficients(run) for run in runs])
    return carried if repeated is None else (*carried, repeated)


def _carried(findings: Sequence[Sequence[Finding]]) -> Findings:
    """Return the findings about each run, which is named before their text."""
    return tuple(
        finding for i, each in enumerate(findings, start=1) for finding in about(f"run {i}", each)
    )


def _coefficients(run: Sequence[Regression]) -> Array:
    segments = [segment for r in run for segment in r.segments]
    return np.array([(c.value, c.u) for segment in segments for c in segment.coefficients])


def _repeated_run(what: str, found: Sequence[Array]) -> Finding | None:
    """Find runs whose readings or coefficients are those of another."""
    pairs = [
        (i, j)
        for (i, a), (j, b) in combinations(enumerate(found, start=1), 2)
        if np.array_equal(a, b)
    ]
    if not pairs:
        return None
    first, second = pairs[0]
    return Finding(
        "repeated-runs",
        "warning",
        (
            f"the {what} of runs {first} and {second} are identical: one run is not a repeat of "
            "itself"
        ),
        "Remove one of them.",
    )


def _different_sensors(found: Sequence[Calibration]) -> Finding | None:
    """Find the two runs that are least those of one sensor, by eq. (1)."""
    worst, said, pair = 1.0, "", (0, 0)
    for i, j in combinations(range(len(found)), 2):
        by, what = _apart(found[i], found[j])
        if by > worst:
            worst, said, pair = by, what, (i, j)
    if not said:
        return None
    return Finding(
        "different-sensors",
        "warning",
        (
            f"runs {pair[0] + 1} and {pair[1] + 1} are probably of two sensors: {said}, more than "
            "a sensor drifts"
        ),
        "Check the sensor of each file, and the order and unit of its columns.",
    )


def _apart(a: Calibration, b: Calibration) -> tuple[float, str]:
    """Return by how much eq. (1) passes its limits, 0 where nowhere, and where most, in words."""
    size_a, size_b = (np.linalg.norm(c.sensitivity, axis=1) for c in (a, b))
    if not (size_a.all() and size_b.all()):
        return 0.0, ""
    unsure = _unsure(a) + _unsure(b)
    zeros = dict(_zeros(b))
    found = []
    for i, output in enumerate(a.outputs):
        ratio = float(size_b[i] / size_a[i])
        change = abs(math.log(ratio))
        words = f"{output} is {ratio:.4g} times as sensitive"
        found.append((change, unsure[i, 0], _SCALE, words))
        for j, other in enumerate(a.outputs[:i]):
            turned = _angle(b, i, j) - _angle(a, i, j)
            words = f"the angle of {other} and {output} changed {math.degrees(turned):+.2g} degrees"
            found.append((abs(turned), unsure[i, 1] + unsure[j, 1], _ANGLE, words))
    for output, zero in _zeros(a):
        i = a.outputs.index(output)
        moved = (zeros[output] - zero) / float(size_a[i])
        words = f"the bias of {output} changed by {moved:+.2g} g"
        found.append((abs(moved), unsure[i, 2], _ZERO, words))
    beyond = [(size / limit, words) for size, U, limit, words in found if size > U]
    return max(beyond, default=(0.0, ""))


def _zeros(c: Calibration) -> list[tuple[str, float]]:
    pairs = zip(c.model.keys, c.parameters.tolist(), strict=True)
    return [(output, value) for (output, term), value in pairs if term == CONSTANT]


def _unsure(c: Calibration) -> Array:
    """Return U of size, direction [rad] and zero [g] of each output (M, 3); 0 where not known."""
    result = np.zeros((len(c.outputs), 3))
    size = np.linalg.norm(c.sensitivity, axis=1)
    for (output, term), U in zip(c.model.keys, np.nan_to_num(c.U).tolist(), strict=True):
        if term != CONSTANT and (term.along is None or term.force_degree != 1):
            continue
        i = c.outputs.index(output)
        place = 2 if term == CONSTANT else 0 if term.along == c.model.axes[i] else 1
        result[i, place] = max(result[i, place], U / float(size[i]))
    return result


def _angle(c: Calibration, i: int, j: int) -> float:
    first, second = c.sensitivity[i], c.sensitivity[j]
    size = np.linalg.norm(first) * np.linalg.norm(second)
    return math.acos(float(np.clip(first @ second / size, -1.0, 1.0)))

"""Findings about repeats: what makes one of them unfit for use, and one run taken twice.

- `find_repeats` returns what is found of repeated calibrations.
- `find_repeated_regressions` returns it of regressions.

Readings equal to the last digit are those of one run, and so are all coefficients of a regression.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from multipos.finding import Finding, Findings, about, errors_of, serious
from multipos.numerics.arrays import Array
from multipos.regression.regression import Regression
from multipos.sensor.calibration import Calibration


def find_repeats(found: Sequence[Calibration]) -> Findings:
    """Return the findings about repeats, those about the calibrations themselves first.

    Parameters
    ----------
    found : sequence of R Calibration
        Of one model, outputs and unit; recognised by their numbers, for files may be renamed.
    """
    carried = _carried([errors_of(c.diagnostics.findings) for c in found])
    return (*carried, *_repeated_run("readings", [c.readings.values for c in found]))


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
    return (*carried, *_repeated_run("coefficients", [_coefficients(run) for run in runs]))


def _carried(findings: Sequence[Sequence[Finding]]) -> Findings:
    """Return the findings about each run, which is named before their text."""
    return tuple(
        finding for i, each in enumerate(findings, start=1) for finding in about(f"run {i}", each)
    )


def _coefficients(run: Sequence[Regression]) -> Array:
    segments = [segment for r in run for segment in r.segments]
    return np.array([(c.value, c.u) for segment in segments for c in segment.coefficients])


def _repeated_run(what: str, found: Sequence[Array]) -> Findings:
    """Find runs whose readings or coefficients are those of another."""
    numbered = combinations(enumerate(found, start=1), 2)
    pairs = [(i, j) for (i, a), (j, b) in numbered if np.array_equal(a, b)]
    if not pairs:
        return ()
    first, second = pairs[0]
    text = (
        f"the {what} of runs {first} and {second} are identical: one run is not a repeat of itself"
    )
    return (Finding("repeated-runs", "warning", text, "Remove one of them."),)

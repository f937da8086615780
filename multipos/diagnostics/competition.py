"""Which cause is named: those that explain the same residuals compete in one likelihood.

Terms that the model lacks, orientation error, outliers and repeats that agree too well are found by
tests of their own, causes of time and table by `multipos.diagnostics.row_order`. Where one of these
is beyond chance, all are held against each other by S of eq. (3) there, and the best is named.
"""

import math
from typing import Any

import numpy as np

from multipos.diagnostics.noise_causes import explain_orientations, explain_unequal
from multipos.diagnostics.residuals import residuals_of
from multipos.diagnostics.row_order import (
    SLOW,
    asked,
    describe,
    estimate,
    search,
    slow_gain,
    time_order,
)
from multipos.diagnostics.score_tests import significant
from multipos.finding import Finding
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

RIVALS = frozenset({"missing-term", "placement", "outlier", "lack-of-fit", SLOW})


def compete(c: Calibration, found: list[Finding]) -> list[Finding]:
    """Return what was found, with the best of the causes that explain the same residuals.

    Causes of time and table (`multipos.diagnostics.row_order`) are held against the terms that the
    model lacks, orientation error and outliers among what was found; one of them is named.
    """
    wrong = any(finding.level == "error" for finding in found)
    if wrong or not asked(c) or any(finding.code == "zero-per-soak" for finding in found):
        return found
    causes = search(c)
    if not causes:
        return found
    freedom = float(c.residuals.size - len(c.parameters))
    if c.estimator is Estimator.UNKNOWN:
        freedom = float(len(c.residuals) - len(c.parameters))
    sized = [estimate(c, cause) if cause.code != SLOW else (cause, None) for cause in causes]
    best, sizes = max(sized, key=lambda pair: pair[0].score(freedom))
    rivals = [finding for finding in found if finding.code in RIVALS]
    kept = [finding for finding in found if finding.code not in RIVALS]
    strongest = max(rivals, key=lambda finding: _score(c, finding, freedom), default=None)
    if strongest is not None:
        said = {finding.code for finding in rivals}
        if best.code in said or _score(c, strongest, freedom) >= best.score(freedom):
            return [*kept, *(d for d in rivals if d.code == strongest.code)]
    return [*kept, describe(c, best, sizes)]


def _score(c: Calibration, finding: Finding, freedom: float) -> float:
    """Return S of a finding of residuals, as `row_order` has it."""
    n, m = c.residuals.shape
    if finding.code == "missing-term":
        best = significant(c.diagnostics.model_tests)[0]
        columns = sum(each for each, _ in best.dofs)
        tried = len(c.diagnostics.model_tests)
        return best.gain + columns * (2.0 - math.log(freedom)) - 2.0 * math.log(tried)
    if finding.code == "placement":
        of = residuals_of(c)
        gain = float((explain_unequal(of).deviance - explain_orientations(of).deviance)[0])
        return float(gain - (2.0 - m) * math.log(freedom))
    if finding.code == SLOW:
        return slow_gain(c, time_order(c)) - math.log(freedom)
    if finding.code == "lack-of-fit":
        found: Any = list(c.diagnostics.lack_of_fit.values())
        tests: list[tuple[float, float, float]] = [(each["F"], *each["dof"]) for each in found]
        gain = sum((q + nu) * math.log1p(q * f / nu) for f, q, nu in tests)
        return float(gain - sum(q for _, q, _ in tests) * math.log(freedom))
    if finding.code == "outlier" and c.estimator.exact:
        rows = [i for i, label in enumerate(c.readings.labels) if label in finding.rows]
        gain = _gain_without(c, rows)
        tried = math.comb(n, len(rows))
        return float(gain - m * len(rows) * math.log(freedom) - 2.0 * math.log(tried))
    return 0.0


def _gain_without(c: Calibration, rows: list[int]) -> float:
    """Return Λ of rows that are left out of every output."""
    phi = c.model.basis(c.reference, c.readings.environment)
    total = 0.0
    for i, columns in enumerate(c.model.columns):
        X, e = (
            phi[:, columns] / c.sd_of_readings[:, [i]],
            c.residuals[:, i] / c.sd_of_readings[:, i],
        )
        Q = np.linalg.qr(X)[0][rows]
        lost = e[rows] @ np.linalg.lstsq(np.eye(len(rows)) - Q @ Q.T, e[rows], rcond=None)[0]
        total -= (len(e) - X.shape[1]) * math.log(max(1.0 - float(lost / (e @ e)), 1e-15))
    return total

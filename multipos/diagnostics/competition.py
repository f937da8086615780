"""Which cause is named: those that explain the same residuals compete in one likelihood.

Terms that the model lacks, orientation error, outliers and repeats that agree too well are found by
tests of their own, causes of time and table by `multipos.diagnostics.row_order`. Where one of these
is beyond chance, all are held against each other by S of eq. (3) there, and the best is named, with
its size and what to do.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from multipos.diagnostics.noise_causes import explain_orientations, explain_unequal
from multipos.diagnostics.residuals import residuals_of
from multipos.diagnostics.row_order import (
    SLOW,
    TIME,
    UNEQUAL,
    Cause,
    asked,
    estimate,
    search,
    slow_score,
)
from multipos.diagnostics.score_tests import significant
from multipos.finding import Finding
from multipos.numerics.arrays import Array
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
    best = max(causes, key=lambda cause: cause.score)
    rivals = [finding for finding in found if finding.code in RIVALS]
    kept = [finding for finding in found if finding.code not in RIVALS]
    if rivals:
        scores = [_score(c, finding, freedom) for finding in rivals]
        strongest = rivals[int(np.argmax(scores))].code
        if best.code in {finding.code for finding in rivals} or max(scores) >= best.score:
            return [*kept, *(d for d in rivals if d.code == strongest)]
    return [*kept, _describe(c, best)]


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
        return slow_score(c)
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


def _describe(c: Calibration, cause: Cause) -> Finding:
    """Return what is said of a cause, with its size and what to do."""
    sizes = np.zeros(0) if cause.code == SLOW else estimate(c, cause)
    text, action, rows = _SAID[cause.code](c, cause, sizes)
    return Finding(cause.code, "warning", text, action, rows, p=cause.p)


_Said = tuple[str, str, tuple[str, ...]]


def _drift(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    time = c.readings.environment.get(TIME)
    timed = time is not None and np.isfinite(time).all() and np.ptp(time) > 0.0
    span = float(np.ptp(time)) if time is not None and timed else len(c.readings) - 1.0
    whole = float(np.abs(sizes).max()) * span
    text = f"readings drift by {whole:.2g} {c.model.unit} from the first row to the last"
    return f"{text} (p = {cause.chance})", "Fit the drift with --drift.", ()


def _slipped(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    row, degrees = _first_row(c, cause), math.degrees(float(np.linalg.norm(sizes)))
    text = f"from row {row} on the case is rotated by {degrees:.2g} degrees, as if it slipped"
    action = f"Name the rows from {row} on in a column `group`, and no others."
    return f"{text} (p = {cause.chance}); U excludes it", action, (row,)


def _replaced(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    row, what = _first_row(c, cause), "parameters"
    if not cause.wholly:
        what = f"biases, by up to {float(np.abs(sizes).max()):.2g} {c.model.unit}"
    text = f"from row {row} on readings have other {what} (p = {cause.chance})"
    action = f"Fit the rows before {row} and those from it on separately."
    return f"{text}, as after an exchange or a switch-on", action, (row,)


def _settling(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    share = 100.0 * float(sizes.item())
    text = f"readings contain {share:.2g} % of the previous row (p = {cause.chance})"
    action = "Wait longer at each position before reading."
    return f"{text}, as from a filter with a long time constant", action, ()


def _hysteresis(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    both = 2.0 * float(np.abs(sizes).max())
    text = f"readings differ by {both:.2g} {c.model.unit} with the side of approach to a position"
    action = "Approach all positions from one side, or each from both."
    return f"{text} (p = {cause.chance})", action, ()


def _vibration(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    sd = c.readings.sd
    assert sd is not None
    own = np.sqrt(np.einsum("nm,nm->n", sd, sd))
    loud = np.flatnonzero(own > UNEQUAL * np.median(own))
    moved = float(np.abs(sizes).max() * own.max() ** 2)
    text = f"readings change by up to {moved:.2g} {c.model.unit} with the variance of their rests"
    action = "Measure these rests again with less vibration, or set them aside with --exclude."
    rows = tuple(c.readings.labels[i] for i in loud.tolist())
    return f"{text} (p = {cause.chance}), as from rectified vibration", action, rows


def _level(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    degrees = math.degrees(float(np.linalg.norm(sizes)))
    text = f"the attitudes indicate a table tilt of {degrees:.2g} degrees (p = {cause.chance})"
    return f"{text}; U excludes it", f"Level it, or fit with --level-sd {degrees:.1g}.", ()


def _table(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    off = f"{math.degrees(float(np.abs(sizes).max())):.1g}"
    text = f"residuals follow the roll angles, as from table errors of {off} degrees"
    action = f"Correct the angles with `multipos tumble`, or fit with --orientation-sd {off}."
    return f"{text} (p = {cause.chance})", action, ()


def _slow(c: Calibration, cause: Cause, sizes: Array) -> _Said:
    text = "residuals of neighbouring rows are correlated although their positions differ; U is"
    action = "Add a column `time`, or measure the positions in random order."
    return f"{text} too small", action, ()


def _first_row(c: Calibration, cause: Cause) -> str:
    assert cause.row is not None
    return c.readings.labels[cause.row]


_SAID: dict[str, Callable[[Calibration, Cause, Array], _Said]] = {
    "drift": _drift,
    "slipped": _slipped,
    "replaced": _replaced,
    "settling": _settling,
    "hysteresis": _hysteresis,
    "vibration": _vibration,
    "level": _level,
    "table": _table,
    "time-correlated": _slow,
}

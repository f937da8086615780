"""Cautions about what the residuals show, of readings that are no absurdity.

- Repeats scatter less than the model misses their means (lack of fit, an F test of the fit).
- Residuals are alike from row to row though the positions are not: something drifted. With the
  pooled lag-one product c = sum e_k e_k+1 / sum e², its mean under white noise
  tr(S(I − H))/(n − r),
  S the lag by one and H the hat matrix, and its variance nearly 1/(M (n − r)).
"""

import math
from collections.abc import Mapping

import numpy as np

from multipos.doubt import Doubt
from multipos.doubts.columns import repeated_rows, resolution
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.sensor.calibration import Calibration

_LEVEL = 0.01  # at which repeats deny the model, all outputs together
_DRIFTS = 3.7  # standard deviations, one in ten thousand
_FEWEST = 12  # positions that show a drift
_APART = 60.0  # [deg] from one position to the next, so that order and direction are two things
_ROUNDING = 1e-12  # of a response: residuals that are nothing
_SHOWN = 4


def outlier(c: Calibration) -> Doubt | None:
    """Find positions that stick out."""
    found = c.diagnostics.outliers
    noise = c.residual_sd > _ROUNDING * np.linalg.norm(c.sensitivity, axis=1) if found else ()
    if not found or not np.any(noise):
        return None
    more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    heads = [(f"position {label}:", f"position {label} ", label) for label in c.readings.labels]
    rows = [label for *starts, label in heads if any(s.startswith(tuple(starts)) for s in found)]
    return Doubt(
        "outlier",
        "caution",
        f"{'; '.join(found[:_SHOWN])}{more}: measure again, leave it out, or fit with --robust "
        "huber",
        tuple(dict.fromkeys(rows)),
    )


def lack_of_fit(c: Calibration) -> Doubt | None:
    """Find outputs whose repeats scatter less than the model misses them."""
    if c.effective_rows:  # neighbours are no repeats
        return None
    level = _LEVEL / len(c.outputs)
    small = {}
    for output, test in c.diagnostics.lack_of_fit.items():
        p, i = test["p"], c.outputs.index(output)
        if not isinstance(p, float) or p >= level:
            continue
        # repeats that agree because they are rounded say nothing of the noise
        if c.residual_sd[i] > resolution(c.readings.values[:, i]):
            small[output] = p
    if not small or repeated_rows(c) is not None:  # copies are no repeats
        return None
    said = ", ".join(f"{output} (p = {p:.2g})" for output, p in small.items())
    return Doubt(
        "lack-of-fit",
        "caution",
        f"repeats of a position agree better than the model meets them: {said}; the model lacks a "
        "term, or the positions are not where they are listed (--orientation-sd)",
        outputs=tuple(small),
    )


def time_correlated(c: Calibration) -> Doubt | None:
    """Find rows that are worth fewer, and residuals alike where the positions are not."""
    if c.effective_rows:
        return _worth_fewer(c, c.effective_rows)
    n, outputs = c.residuals.shape
    terms = min(map(len, c.model.terms))
    left = n - terms
    if n < _FEWEST or not left or not c.estimator.exact:
        return None
    square = np.sum(c.residuals**2, axis=0)
    if not (square > 0.0).all():
        return None
    e = c.residuals / np.sqrt(square)
    product = float(np.sum(e[1:] * e[:-1])) / outputs
    enough = _DRIFTS / math.sqrt(outputs * left)
    if product + terms / left < enough:  # -tr(SH) is no more than tr H
        return None
    phi = c.model.basis(c.reference, c.readings.environment)
    basis = np.linalg.svd(phi, full_matrices=False)[0][:, :terms]
    expected = -float(np.sum(basis[1:] * basis[:-1])) / left
    if product - expected < enough or float(median(_angles_between(c.reference))) < _APART:
        return None
    return Doubt(
        "time-correlated",
        "caution",
        "residuals are alike from one row to the next though the positions are not: something "
        "drifted while it was measured, and U is too small; take the positions in random order, "
        "or fit a term of time or temperature",
    )


def _worth_fewer(c: Calibration, effective: Mapping[str, float]) -> Doubt:
    """Return the doubt about rows whose correlation U follows from."""
    n = len(c.residuals)
    fewer = {output: rows for output, rows in effective.items() if rows < n}
    said = ", ".join(f"{output} {max(rows, 1.0):.2g}" for output, rows in fewer.items())
    return Doubt(
        "time-correlated",
        "caution",
        f"neighbouring rows have nearly the same error: the mean of {n} is worth that of fewer "
        f"independent ones, {said}, and U is larger for it; take the positions several times, in "
        "random order",
        outputs=tuple(fewer),
    )


def _angles_between(reference: Array) -> Array:
    """Return the angles [degrees] from each position (n, 3) to the next (n − 1,)."""
    size = np.linalg.norm(reference, axis=1, keepdims=True)
    unit = reference / np.where(size > 0.0, size, 1.0)
    cosines = np.sum(unit[1:] * unit[:-1], axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))

"""Does the zero differ from one soak to the next? Rows of one soak are then no readings apart.

A soak is a stay at one temperature, in which several positions are read. Its rows share whatever
the zero did there beside what the model follows (hysteresis, a switch-on, a chamber that tilts):

    y_k = x_k' p + a_s(k) + e_k,    a_s ~ N(0, σ_a²).                                       (1)

The fit takes all rows as independent, and its U and the band over temperature are too small by as
much as the soaks have rows. With Δ what columns of the soaks explain beyond the model and the next
power of temperature, on q degrees of freedom, and ν left,

    F = (Δ/q) / (rest/ν),      σ_a² = (F − 1) s² q / Σ left of the columns,                 (2)

one F an output, their p values combined as in `multipos.sensor.term_tests`. A curve that was fitted
straight shows as the next power of temperature (`multipos.doubts.score_tests`); of the two causes a
zero of its own for each soak explains the other, so it is asked first.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.doubt import Doubt
from multipos.doubts.candidates import Kind, lacking
from multipos.doubts.projections import left_of, seen_rows
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.term_tests import ModelTest

COLUMN = "temperature"
_LEVEL = 0.01
_GAP = 0.04  # of the span of temperature, by which levels are apart
_FEWEST = 4  # soaks


def zero_per_soak(c: Calibration) -> Doubt | None:
    """Find a zero that differs from soak to soak, by eq. (2)."""
    found = judge_soaks(c)
    if found is None or not found[0].is_below(_LEVEL):
        return None
    test, sizes = found
    told = ", ".join(
        f"{output} {size:.2g}" for output, size in zip(c.outputs, sizes.tolist(), strict=True)
    )
    return Doubt(
        "zero-per-soak",
        "caution",
        f"the zero differs from soak to soak, beyond what the model follows (p = {test.p:.1g}; "
        f"{told} {c.model.unit}): rows of one soak are not independent, and U and the band over "
        "temperature are too small; take more soaks, or state it in a budget, [stability] u_… = …",
    )


def judge_soaks(c: Calibration) -> tuple[ModelTest, Array] | None:
    """Test eq. (1) in every output; None where there are no soaks, or nothing is left.

    Returns
    -------
    ModelTest
    sizes : (M,) array
        σ_a, in reading units.
    """
    plain = c.estimator.exact and c.noise is None and c.robust_weight is None
    if not plain or isinstance(c.model, ExpressionModel) or COLUMN not in c.readings.environment:
        return None
    soak = find_soaks(c.readings.environment[COLUMN])
    if soak is None:
        return None
    columns = (soak[:, None] == np.unique(soak)).astype(np.float64)
    phi = c.model.basis(c.reference, c.readings.environment)
    curved = [kind for kind in lacking(c) if kind.name.partition("^")[0] == COLUMN]
    ratios, dofs, sizes = [], [], []
    for i, mine in enumerate(c.model.columns):
        design = np.column_stack([phi[:, mine], _columns(curved, i, c)])
        Q = np.linalg.qr(design)[0]
        V = left_of(Q, columns)
        rows = seen_rows(V, columns)
        q, nu = float(len(rows)), float(len(Q) - Q.shape[1] - len(rows))
        e = c.residuals[:, i] - Q @ (Q.T @ c.residuals[:, i])
        explained = float(np.sum((rows @ e) ** 2))
        rest = float(e @ e) - explained
        if q < 1.0 or nu < 1.0 or not rest > 0.0:
            return None
        ratios.append(explained / q / (rest / nu))
        dofs.append((q, nu))
        sizes.append(np.sqrt(max(ratios[-1] - 1.0, 0.0) * rest / nu * q / np.sum(V**2)))
    return ModelTest("soak", c.outputs, tuple(ratios), tuple(dofs)), np.array(sizes)


def find_soaks(temperature: Array) -> NDArray[np.intp] | None:
    """Return the number of the soak of each row, None where temperatures do not stand in levels.

    Levels are apart by a gap; a level that is left and come back to is another soak, where rows
    stand in order.
    """
    if not np.isfinite(temperature).all() or not np.ptp(temperature) > 0.0:
        return None
    order = np.argsort(temperature, kind="stable")
    steps = np.diff(temperature[order]) > _GAP * np.ptp(temperature)
    level = np.empty(len(order), dtype=np.intp)
    level[order] = np.concatenate([[0], np.cumsum(steps)])
    runs = np.concatenate([[0], np.cumsum(np.diff(level) != 0)])
    soak = runs if runs[-1] + 1 <= len(runs) / 3.0 else level
    counts = np.bincount(soak)
    return soak if len(counts) >= _FEWEST and counts.min() >= 2 else None


def _columns(kinds: list[Kind], output: int, c: Calibration) -> Array:
    """Return the columns (n, q) of kinds of terms of one output."""
    variables = {axis: c.reference[:, i] for i, axis in enumerate(COMPONENTS)}
    variables |= dict(c.readings.environment)
    terms = [term for kind in kinds for term in kind.terms[output]]
    columns = [np.broadcast_to(term.evaluate(variables), len(c.reference)) for term in terms]
    return np.column_stack(columns) if columns else np.zeros((len(c.reference), 0))

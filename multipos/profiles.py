"""Profile-likelihood intervals: how far a parameter may move before the fit gets worse.

With whitened residuals r(p) and S(p) = r'r, a parameter at the value t leaves, once all others
are fitted anew, the profile S_j(t) = min over p with p_j = t of S(p). Its interval is where

    S_j(t) ≤ S_min (1 + k²/ν),    k from Student's t at ν degrees of freedom,              (1)
    S_j(t) ≤ S_min + k²,          k normal, where the noise is known (ν infinite).         (2)

For a linear fit that is p_j ± k u_j exactly; for a nonlinear one it bends with the model, is not
symmetric, and does not depend on how the parameters are written.

References
----------
D. M. Bates, D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, section 6.1.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.calibration import Calibration
from multipos.errors import ConvergenceError
from multipos.inverse import parameter_jacobian
from multipos.known import stated_noise
from multipos.quantiles import coverage_factor

Array = NDArray[np.float64]

_FARTHEST = 50.0  # expanded uncertainties from the estimate; farther out the interval is open


class Interval(NamedTuple):
    """An interval; an end is infinite where the fit never gets bad enough."""

    low: float
    high: float


def profile_interval(
    residuals: Callable[[Array], Array],
    estimate: ArrayLike,
    index: int,
    *,
    u: float,
    dof: float = math.inf,
    confidence: float = 0.95,
) -> Interval:
    """Return the profile-likelihood interval of one parameter, eqs. (1) and (2).

    Parameters
    ----------
    residuals : callable
        Takes parameters (p,), returns whitened residuals (n,).
    estimate : (p,) array
        Where r'r is least.
    index : int
        The parameter.
    u : float
        Its standard uncertainty, to know how far to look.
    dof : float
        Degrees of freedom of the residual variance; inf where the noise is known.
    confidence : float
        Coverage probability.

    Raises
    ------
    ConvergenceError
        `estimate` is not where the sum of squares is least.
    """
    from scipy.optimize import brentq

    best = np.asarray(estimate, dtype=np.float64)
    smallest = float(np.sum(residuals(best) ** 2))
    k = coverage_factor(confidence, dof)
    allowed = k * k if math.isinf(dof) else smallest * k * k / dof
    ends = []
    for side in (-1.0, 1.0):
        start = np.delete(best, index)  # each point starts from its neighbour's answer

        def excess(step: float, side: float = side) -> float:
            nonlocal start
            found, start = _profiled(residuals, start, index, best[index] + side * step)
            if found < smallest - 1e-6 * max(allowed, smallest):
                raise ConvergenceError(
                    "the estimate is not where the sum of squares is least; fit again from "
                    f"{np.insert(start, index, best[index] + side * step).tolist()}."
                )
            return found - smallest - allowed

        reach = k * u
        while excess(reach) < 0.0 and reach < _FARTHEST * k * u:
            reach *= 1.5
        ends.append(
            side * math.inf
            if reach >= _FARTHEST * k * u
            else float(best[index]) + side * float(brentq(excess, 0.0, reach, xtol=1e-10 * k * u))
        )
    return Interval(*ends)


def calibration_interval(calibration: Calibration, output: str, term: str) -> Interval:
    """Return the profile-likelihood interval of a parameter of a fit at known orientations.

    Of the scatter of the readings alone, without what the budget adds.
    """
    c = calibration
    index = c.model.index(output, term)
    column = c.outputs.index(output)
    part = c.model.slices[column]
    n, m = c.readings.values.shape
    design = parameter_jacobian(c.model, c.reference, c.readings.environment)
    noise = stated_noise(c.readings)
    if noise is not None and noise.ndim == 2:
        whiten, rows = np.linalg.inv(np.linalg.cholesky(noise)), design.reshape(n * m, -1)
        y, estimate, place = whiten @ c.readings.values.ravel(), c.parameters, index
        X = whiten @ rows
    else:
        sd = np.ones(n) if noise is None else np.sqrt(noise[column::m])
        X = design[:, column, part] / sd[:, None]
        y, estimate, place = (
            c.readings.values[:, column] / sd,
            c.parameters[part],
            (index - part.start),
        )
    dof = float(c.dof[column])
    start = np.linalg.lstsq(X, y, rcond=None)[0] if c.estimator == "closed-form" else estimate
    return profile_interval(
        lambda p: y - X @ p, start, place, u=float(c.u[index]), dof=dof, confidence=c.confidence
    )


def _profiled(
    residuals: Callable[[Array], Array], start: Array, index: int, value: float
) -> tuple[float, Array]:
    """Return the least sum of squares with one parameter held, and where the others are then."""
    from scipy.optimize import least_squares

    if not len(start):
        return float(np.sum(residuals(np.array([value])) ** 2)), start
    found = least_squares(
        lambda others: residuals(np.insert(others, index, value)), start, method="trf",
        x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12,
    )  # fmt: skip
    return 2.0 * float(found.cost), np.asarray(found.x)


def fit_residuals(residuals: Callable[[Array], Array], start: Sequence[float]) -> Array:
    """Return the parameters (p,) at which a sum of squares is least, from a start."""
    from scipy.optimize import least_squares

    found = least_squares(residuals, np.asarray(start, dtype=np.float64), x_scale="jac",
                          xtol=1e-15, ftol=1e-15, gtol=1e-15)  # fmt: skip
    if not found.success:
        raise ConvergenceError(f"no least sum of squares was found: {found.message}")
    return np.asarray(found.x)

"""Profile-likelihood intervals: how far a parameter may move before the fit gets worse.

With whitened residuals r(p), of unit variance or divided by their estimated standard deviation,
and S(p) = r'r, a parameter at the value t leaves, once all others are fitted anew, the profile
S_j(t) = min over p with p_j = t of S(p). Its interval is where

    S_j(t) ≤ S_min + k²,    k from Student's t at ν degrees of freedom, normal at ν = ∞.    (1)

For a linear fit that is p_j ± k u_j exactly; for a nonlinear one it bends with the model, is not
symmetric, and does not depend on how the parameters are written.

With unknown orientations the best the unknown can do for a reading leaves its distance from the
model's surface |f| = g; with f = h⁻¹(y; p), J = dh/df and the noise σ of the outputs,

    r_k = (|f_k| - g) / |σ ∘ J⁻ᵀ f_k/|f_k||,                                                (2)

to first order in r_k σ over the size of the surface, which is thousands of times larger.

References
----------
D. M. Bates, D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, section 6.1.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.calibration import Calibration
from multipos.errors import ConvergenceError, MultiposError
from multipos.inverse import invert
from multipos.known import reading_noise
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
    """Return the profile-likelihood interval of one parameter, eq. (1).

    Parameters
    ----------
    residuals : callable
        Takes parameters (p,), returns residuals (n,) of unit variance, or divided by the
        standard deviation that was estimated for them.
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
    ends = []
    for side in (-1.0, 1.0):
        start = np.delete(best, index)  # each point starts from its neighbour's answer

        def excess(step: float, side: float = side) -> float:
            nonlocal start
            found, start = _profiled(residuals, start, index, best[index] + side * step)
            if found < smallest - 1e-6 * k * k:
                raise ConvergenceError(
                    "the estimate is not where the sum of squares is least; fit again from "
                    f"{np.insert(start, index, best[index] + side * step).tolist()}."
                )
            return found - smallest - k * k

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
    """Return the profile-likelihood interval of a parameter, without what the budget adds.

    Raises
    ------
    MultiposError
        The orientations were uncertain: neither known nor unknown.
    """
    c = calibration
    if c.estimator not in ("linear", "closed-form", "unknown-orientation"):
        raise MultiposError(
            f"no profile is written for the estimator '{c.estimator}'; give `profile_interval` "
            "the residuals."
        )
    index = c.model.index(output, term)
    dof = float(c.dof[c.outputs.index(output)])
    residuals = calibration_residuals(c)
    start = c.parameters
    if c.estimator == "closed-form":
        start = fit_residuals(residuals, start)
    return profile_interval(
        residuals, start, index, u=float(c.u[index]), dof=dof, confidence=c.confidence
    )


def calibration_residuals(calibration: Calibration) -> Callable[[Array], Array]:
    """Return the whitened residuals (n M,) or (n,) of a calibration as a function of (p,)."""
    c = calibration
    noise = reading_noise(c.readings)
    n, m = c.readings.values.shape
    believed = noise is not None and noise.ndim == 1 and bool(np.isinf(c.dof).all())
    sd = np.broadcast_to(c.residual_sd, (n, m))
    if believed and noise is not None:
        sd = np.sqrt(noise).reshape(n, m)

    def of_known(p: Array) -> Array:
        y = c.model.predict(p, c.reference, c.readings.environment)
        return np.asarray(((c.readings.values - y) / sd).ravel())

    def of_unknown(p: Array) -> Array:
        force = invert(c.model, p, c.readings.values, c.readings.environment)
        size = np.linalg.norm(force, axis=1)
        jacobian = c.model.force_jacobian(p, force, c.readings.environment)
        normal = np.linalg.solve(jacobian.transpose(0, 2, 1), (force / size[:, None])[:, :, None])
        spread = np.linalg.norm(sd * normal[:, :, 0], axis=1)
        return np.asarray((size - np.linalg.norm(c.reference, axis=1)) / spread)

    return of_unknown if c.estimator == "unknown-orientation" else of_known


def _profiled(
    residuals: Callable[[Array], Array], start: Array, index: int, value: float
) -> tuple[float, Array]:
    """Return the least sum of squares with one parameter held, and where the others are then."""
    from scipy.optimize import least_squares

    if not len(start):
        return float(np.sum(residuals(np.array([value])) ** 2)), start

    def held(others: Array) -> Array:
        return residuals(np.insert(others, index, value))

    found = least_squares(held, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return 2.0 * float(found.cost), np.asarray(found.x)


def fit_residuals(residuals: Callable[[Array], Array], start: ArrayLike) -> Array:
    """Return the parameters (p,) at which a sum of squares is least, from a start."""
    from scipy.optimize import least_squares

    found = least_squares(residuals, np.asarray(start, dtype=np.float64), x_scale="jac",
                          xtol=1e-15, ftol=1e-15, gtol=1e-15)  # fmt: skip
    if not found.success:
        raise ConvergenceError(f"no least sum of squares was found: {found.message}")
    return np.asarray(found.x)

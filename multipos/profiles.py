"""Profile-likelihood intervals: how far a parameter may move before the fit gets worse.

With whitened residuals r(p), of unit variance or divided by their estimated standard deviation,
and S(p) = r'r, a parameter at the value t leaves, once all others are fitted anew, the profile
S_j(t) = min over p with p_j = t of S(p). Its interval is where

    S_j(t) ≤ S_min + k²,    k from Student's t at ν degrees of freedom, normal at ν = ∞.    (1)

For a linear fit that is p_j ± k u_j exactly; for a nonlinear one it bends with the model, is not
symmetric, and does not depend on how the parameters are written.

For uncertain and unknown orientations S is the minimum F of `multipos.likelihood`, orientations
fitted anew with the others, at the noise of the fit; where a stated noise was denied, k² is
multiplied by F_min/ν. Where variances were estimated ν is the parameter's own, by Satterthwaite.

References
----------
D. M. Bates, D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, section 6.1.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.calibration import Calibration
from multipos.descent import maximise
from multipos.errors import ConvergenceError, MultiposError
from multipos.known import reading_noise
from multipos.quantiles import coverage_factor
from multipos.restatement import estimated_variances, noise_factor, restate, return_to_optimum
from multipos.variances import components, linearised

Array = NDArray[np.float64]
Profile = Callable[[float], float]  # how much a parameter's value costs, S_j(t) - S_min

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
    best = np.asarray(estimate, dtype=np.float64)
    smallest = float(np.sum(residuals(best) ** 2))

    def walk() -> Profile:
        start = np.delete(best, index)  # each point starts from its neighbour's answer

        def rise(value: float) -> float:
            nonlocal start
            found, start = _profiled(residuals, start, index, value)
            return found - smallest

        return rise

    return _search_ends(walk, float(best[index]), coverage_factor(confidence, dof), u)


def _search_ends(walk: Callable[[], Profile], centre: float, k: float, u: float) -> Interval:
    """Return where a profile has risen by k², each side on a walk of its own."""
    from scipy.optimize import brentq

    ends = []
    for side in (-1.0, 1.0):
        rise = walk()

        def excess(step: float, side: float = side, rise: Profile = rise) -> float:
            found = rise(centre + side * step)
            if found < -1e-6 * k * k:
                raise ConvergenceError(
                    "the estimate is not where the sum of squares is least; fit again from where "
                    f"the parameter is {centre + side * step:.6g}."
                )
            return found - k * k

        reach = k * u
        while excess(reach) < 0.0 and reach < _FARTHEST * k * u:
            reach *= 1.5
        ends.append(
            side * math.inf
            if reach >= _FARTHEST * k * u
            else centre + side * float(brentq(excess, 0.0, reach, xtol=1e-10 * k * u))
        )
    return Interval(*ends)


def calibration_interval(calibration: Calibration, output: str, term: str) -> Interval:
    """Return the profile-likelihood interval of a parameter, without what the budget adds.

    Raises
    ------
    MultiposError
        The fit was robust: its loss is no likelihood.
    ConvergenceError
        As in `profile_interval`.
    """
    c = calibration
    if "robust_weight" in c.extra:
        raise MultiposError(
            "a robust loss is no likelihood and has no profile; fit again without --robust."
        )
    index = c.model.index(output, term)
    if c.estimator.endswith("orientation"):
        return _likelihood_interval(c, index)
    dof = float(c.dof[c.outputs.index(output)])
    residuals = calibration_residuals(c)
    start = c.parameters
    if c.estimator == "closed-form":
        start = fit_residuals(residuals, start)
    return profile_interval(
        residuals, start, index, u=float(c.u[index]), dof=dof, confidence=c.confidence
    )


def _likelihood_interval(c: Calibration, index: int) -> Interval:
    """Return the interval of an uncertain or unknown orientation."""
    problem = restate(c)
    best = return_to_optimum(c, problem)
    factor = noise_factor(c, problem, best)
    held = replace(problem, held=(index,))
    dof, free = float(c.dof[0]), estimated_variances(c)
    if free.any():
        dof = float(components(linearised(problem, best), np.zeros(2), free).dof[index])

    def walk() -> Profile:
        state = best.state  # each point starts from its neighbour's answer

        def rise(value: float) -> float:
            nonlocal state
            theta = state.theta.copy()
            theta[index] = value
            found = maximise(held, replace(state, theta=theta))
            if not found.converged:
                raise ConvergenceError(
                    f"no fit was found with `{c.names[index]}` held at {value:.6g}; choose a model "
                    "with fewer terms."
                )
            state = found.state
            return (found.point.objective - best.point.objective) / factor

        return rise

    k = coverage_factor(c.confidence, dof)
    return _search_ends(walk, float(best.state.theta[index]), k, float(c.u[index]))


def calibration_residuals(calibration: Calibration) -> Callable[[Array], Array]:
    """Return the whitened residuals (n M,) at known orientations as a function of (p,)."""
    c = calibration
    noise = reading_noise(c.readings)
    n, m = c.readings.values.shape
    believed = noise is not None and noise.ndim == 1 and bool(np.isinf(c.dof).all())
    sd = np.broadcast_to(c.residual_sd, (n, m))
    if believed and noise is not None:
        sd = np.sqrt(noise).reshape(n, m)

    def residuals(p: Array) -> Array:
        y = c.model.predict(p, c.reference, c.readings.environment)
        return np.asarray(((c.readings.values - y) / sd).ravel())

    return residuals


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

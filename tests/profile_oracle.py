"""Profile-likelihood intervals: how far a parameter may move before the fit gets worse.

With whitened residuals r(p), of unit variance or divided by their estimated standard deviation,
and S(p) = r'r, a parameter at the value t leaves, once all others are fitted anew, the profile
S_j(t) = min over p with p_j = t of S(p). Its interval is where

    S_j(t) ≤ S_min + k²,    k from Student's t at ν degrees of freedom, normal at ν = ∞.    (1)

For a linear fit that is p_j ± k u_j exactly; for a nonlinear one it bends with the model, is not
symmetric, and does not depend on how the parameters are written.

For uncertain and unknown orientations S is the minimum F of `multipos.estimation.likelihood`,
orientations fitted anew with the others, at the noise of the fit; where a stated noise was denied,
k² is multiplied by F_min/ν. Where variances were estimated ν is the parameter's own, by
Satterthwaite.

Profiles of a user-defined model at known orientations, with exact second derivatives.

With residuals r_k = y_k − h_k(p), weights w_k of the fit and priors b about m, a parameter is held
at t and

    S(p) = Σ w_k r_k² + Σ b_j (p_j − m_j)²,                                                  (2)

is made least over the others by Newton's iteration, with half the gradient and half the curvature

    g = −Σ w_k r_k a_k + b (p − m),      H = Σ w_k (a_k a_k' − r_k ∂²h_k/∂p²) + diag(b),      (3)

a = ∂h/∂p. The term of second derivatives is what Gauss and Newton leave out; far from the estimate,
where an interval ends, residuals are no longer small. Where H is not positive definite that
term is left out for the step.

References
----------
D. M. Bates, D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, section 6.1.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import ConvergenceError, MultiposError
from multipos.estimation.descent import maximise
from multipos.estimation.gains import estimator_gain, restate, return_to_optimum
from multipos.estimation.likelihood import linearise, moved, recentred
from multipos.estimation.starts import reduced_information
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor
from multipos.results import require
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian
from multipos.uncertainty.propagation import evaluate_budget

_STEPS = 50
_FLAT = 1e-12  # of S, from which on a step takes nothing off


class OwnProfile:
    """S of eq. (2) with one parameter held: called with its value, the rise over the least S."""

    def __init__(self, c: Calibration, index: int, sd: Array) -> None:
        self.c, self.model, self.index = c, c.model, index
        self.weight = 1.0 / np.broadcast_to(sd, c.residuals.shape) ** 2
        self.others = np.arange(len(c.parameters)) != index
        self.best = c.parameters
        g, H, self.least = self._at(self.best)
        self.slope = np.zeros(len(g))  # how the others follow the parameter
        self.slope[index] = 1.0
        self.slope[self.others] = -np.linalg.solve(
            H[np.ix_(self.others, self.others)], H[self.others, index]
        )

    def __call__(self, value: float) -> float:
        """Return the rise of S where the parameter has a value."""
        p = self.best + (value - self.best[self.index]) * self.slope
        g, H, S = self._at(p)
        for _ in range(_STEPS):
            step = np.zeros(len(p))
            if self.others.any():
                step[self.others] = -np.linalg.solve(
                    H[np.ix_(self.others, self.others)], g[self.others]
                )
            fall = -2.0 * float(g @ step)
            trial = self._at(p + step)
            while trial[2] > S and fall > _FLAT * S:  # too long: shorter, until it is lower
                step, fall = step / 2.0, fall / 2.0
                trial = self._at(p + step)
            if fall <= _FLAT * S:
                break
            p = p + step
            g, H, S = trial
        return S - self.least

    def _at(self, p: Array) -> tuple[Array, Array, float]:
        """Return g and H of eq. (3), and S."""
        c = self.c
        environment = c.readings.environment
        r = c.readings.values - self.model.predict(p, c.reference, environment)
        A = parameter_jacobian(self.model, p, c.reference, environment)
        bend = self.model.second_derivatives(p, c.reference, environment)
        excess, slope = self.model.belief(p)
        wr = self.weight * r
        g = -np.einsum("nm,nmp->p", wr, A) + slope * excess
        plain = np.einsum("nmp,nm,nmq->pq", A, self.weight, A) + np.diag(slope**2)
        H = plain - np.einsum("nm,nmpq->pq", wr, bend)
        inner = H[np.ix_(self.others, self.others)]
        if inner.size and np.linalg.eigvalsh(inner)[0] <= 0.0:
            H = plain
        return g, H, float(np.sum(wr * r)) + float(excess @ excess)


Profile = Callable[[float], float]  # how much a parameter's value costs, S_j(t) - S_min

_FARTHEST = 50.0  # expanded uncertainties from the estimate; farther out the interval is open


class Interval(NamedTuple):
    """An interval; an end is infinite where the fit never gets bad enough."""

    low: float
    high: float


def search_interval(
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
    slope = _follow(residuals, best, index)

    def rise(value: float) -> float:
        start = np.delete(best + (value - best[index]) * slope, index)
        return _profiled(residuals, start, index, value) - smallest

    return _search_ends(rise, float(best[index]), coverage_factor(confidence, dof), u)


def _follow(residuals: Callable[[Array], Array], best: Array, index: int) -> Array:
    """Return how all parameters (p,) move with one where the sum of squares stays least."""
    from scipy.optimize import least_squares

    slopes = np.asarray(least_squares(residuals, best, x_scale="jac", max_nfev=1).jac)
    others = np.linalg.lstsq(np.delete(slopes, index, axis=1), -slopes[:, index], rcond=None)[0]
    return np.insert(others, index, 1.0)


def _search_ends(rise: Profile, centre: float, k: float, u: float) -> Interval:
    """Return where a profile has risen by k², to either side.

    A profile is nearly a parabola, so its root, which is nearly a straight line, is what is
    searched. The first step goes beyond k u, where the profile of a linear fit ends.
    """
    from scipy.optimize import brentq

    @cache  # the search compares signs at points it has seen: they must not change by rounding
    def excess(step: float) -> float:
        found = rise(centre + step)
        if found < -1e-6 * k * k:
            raise ConvergenceError(
                "the estimate is not where the sum of squares is least; fit again from where "
                f"the parameter is {centre + step:.6g}."
            )
        return math.sqrt(max(found, 0.0)) - k

    ends = []
    for side in (-1.0, 1.0):
        near, reach = 0.0, 1.25 * side * k * u
        while excess(reach) < 0.0 and abs(reach) < _FARTHEST * k * u:
            near, reach = reach, 1.5 * reach
        if excess(reach) < 0.0:
            ends.append(side * math.inf)
        else:
            ends.append(centre + float(brentq(excess, near, reach, xtol=1e-10 * k * u)))
    return Interval(*ends)


def profile_interval(calibration: Calibration, output: str, term: str) -> Interval:
    """Return the profile-likelihood interval of a parameter, without what the budget adds.

    Parameters
    ----------
    calibration : Calibration
    output, term : str
        The parameter, as in ``calibration[output, term]``.

    Returns
    -------
    Interval
        (low, high), in the parameter's unit, at the confidence of the calibration.

    Raises
    ------
    MultiposError
        The fit was robust, and its loss is no likelihood; or nothing tells the noise.
    ConvergenceError
        As in `search_interval`.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> found = mp.profile_interval(cal, "ax", "1")
    >>> print(f"{1e3 * found.low:.2f} to {1e3 * found.high:.2f} mg")
    -7.44 to 5.87 mg
    """
    require(calibration, Calibration)
    c = calibration
    if c.robust_weight is not None:
        raise MultiposError(
            "a robust loss is no likelihood and has no profile; fit again without --robust."
        )
    index = c.model.index(output, term)
    if not c.estimator.exact:
        return _likelihood_interval(c, index)
    dof = float(c.dof_of_outputs[index])
    if not dof > 0.0:
        raise MultiposError(
            f"as many terms of {output} as readings: nothing is left to tell how far they may "
            "move; give --reading-sd or more positions."
        )
    if not c.model.has_terms and (c.noise is None or c.noise.ndim == 1):
        rise, k = OwnProfile(c, index, _own_sd(c, index)), coverage_factor(c.confidence, dof)
        return _search_ends(rise, float(c.parameters[index]), k, float(c.u[index]))
    residuals, best = _known_problem(c, index)
    return search_interval(
        residuals, best, index, u=float(c.u[index]), dof=dof, confidence=c.confidence
    )


def _own_sd(c: Calibration, index: int) -> Array:
    """Return the sd of every reading (n, M) by which a user-defined model was weighed."""
    if c.noise is None:
        return np.broadcast_to(c.residual_sd, c.residuals.shape)
    root = np.sqrt(c.noise)
    gain = estimator_gain(c)[index]
    factor = _scatter_of(c, index) / math.sqrt(float(gain @ (c.noise * gain)))
    return np.asarray(factor * root.reshape(c.residuals.shape))


def _likelihood_interval(c: Calibration, index: int) -> Interval:
    """Return the interval of an uncertain or unknown orientation."""
    problem = restate(c)
    best = return_to_optimum(c, problem)
    held = replace(problem, held=(index,))
    normal = linearise(problem, best.state, best.point)
    # what the noise that was found makes of the variance under the noise as restated
    variance = float(
        np.linalg.inv(reduced_information(normal.information, len(c.names)))[index, index]
    )
    factor = _scatter_of(c, index) ** 2 / variance
    slope = np.zeros(len(normal.information))  # how all unknowns follow the parameter
    others = np.arange(len(slope)) != index
    slope[index] = 1.0
    slope[others] = -np.linalg.lstsq(
        normal.information[np.ix_(others, others)], normal.information[others, index], rcond=None
    )[0]

    def rise(value: float) -> float:
        step = (value - best.state.theta[index]) * slope
        start = recentred(problem, moved(problem, best.state, best.point, normal, step, 0.0))
        found = maximise(held, start)
        if not found.converged:
            raise ConvergenceError(
                f"no fit was found with `{c.names[index]}` held at {value:.6g}; choose a model "
                "with fewer terms."
            )
        return (found.point.objective - best.point.objective) / factor

    k = coverage_factor(c.confidence, float(c.dof[0]))
    return _search_ends(rise, float(best.state.theta[index]), k, float(c.u[index]))


def _scatter_of(c: Calibration, index: int) -> float:
    """Return u of a parameter without what a budget added to it."""
    rows = (row for row in evaluate_budget(c, {}).rows if row.evaluation == "A")
    return math.sqrt(sum(float(row.covariance[index, index]) for row in rows))


def _known_problem(c: Calibration, index: int) -> tuple[Callable[[Array], Array], Array]:
    """Return the whitened residuals (n M,) of parameters (p,) at known orientations, and the best.

    The noise is that by which the fit weighed readings, or of variance one, times what the fit
    multiplied it by; so that where a scatter was found, u of one parameter is what it was.
    """
    noise = c.noise
    full = noise is not None and noise.ndim == 2
    root = np.ones(c.readings.values.size) if noise is None else noise
    root = np.asarray(np.linalg.cholesky(root) if full else np.sqrt(root))

    def left(p: Array) -> Array:
        found = c.model.predict(p, c.reference, c.readings.environment)
        return np.asarray(c.readings.values - found)

    def whitened(residuals: Array) -> Array:
        flat = residuals.ravel()
        return np.asarray(np.linalg.solve(root, flat) if full else flat / root)

    best = c.parameters
    if c.estimator is Estimator.CLOSED_FORM:
        best = fit_residuals(lambda p: whitened(left(p)), best)
    if c.weighed and noise is not None:
        gain = estimator_gain(c)[index]
        variance = gain @ (noise @ gain if full else noise * gain)
        sd = np.full(len(c.outputs), _scatter_of(c, index) / math.sqrt(variance))
    else:
        sd = np.sqrt(_variance_factor(c, chi_squares(left(best), noise)))

    def residuals(p: Array) -> Array:
        return whitened(left(p) / sd)

    # a factor for each output moves the best parameters where outputs are correlated
    return residuals, fit_residuals(residuals, best) if full else best


def chi_squares(residuals: Array, noise: Array | None) -> Array:
    """Return r'V⁻¹r of each output by itself (M,), V as `Readings.noise` has it; 1 where None.

    Parameters
    ----------
    residuals : (n, M) array
    noise : (n M,) or (n M, n M) array, optional
    """
    n, m = residuals.shape
    if noise is None or noise.ndim == 1:
        variances = np.ones((n, m)) if noise is None else noise.reshape(n, m)
        return np.asarray(np.sum(residuals**2 / variances, axis=0))
    blocks = noise.reshape(n, m, n, m)
    return np.array(
        [residuals[:, i] @ np.linalg.solve(blocks[:, i, :, i], residuals[:, i]) for i in range(m)]
    )


def _variance_factor(c: Calibration, chi2: Array) -> Array:
    """Return what the fit multiplied each output's variance by (M,)."""
    nu = len(c.readings) - np.array([len(terms) for terms in c.model.terms])
    if c.dof[0] == nu.sum():  # pooled, or one output
        return np.full(len(nu), chi2.sum() / nu.sum())
    return np.where(np.isinf(c.dof), 1.0, chi2 / np.maximum(nu, 1))


def _profiled(residuals: Callable[[Array], Array], start: Array, index: int, value: float) -> float:
    """Return the least sum of squares with one parameter held."""
    from scipy.optimize import least_squares

    if not len(start):
        return float(np.sum(residuals(np.array([value])) ** 2))

    def held(others: Array) -> Array:
        return residuals(np.insert(others, index, value))

    found = least_squares(held, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return 2.0 * float(found.cost)


def fit_residuals(residuals: Callable[[Array], Array], start: ArrayLike) -> Array:
    """Return the parameters (p,) at which a sum of squares is least, from a start."""
    from scipy.optimize import least_squares

    found = least_squares(
        residuals,
        np.asarray(start, dtype=np.float64),
        x_scale="jac",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    if not found.success:
        raise ConvergenceError(f"no least sum of squares was found: {found.message}")
    return np.asarray(found.x)

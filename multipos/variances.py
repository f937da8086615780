"""Reading noise and orientation error estimated together: restricted maximum likelihood.

Linearised about a solution, the readings at the listed positions have residuals e_k (n, M) with

    cov e_k = sigma² I + s_k² J_k J_k',     e = A theta + error,                            (1)

(J_k, A as in `multipos.likelihood`). What the parameters do not use up is judged by

    -2 l = sum ln det V_k + ln det(A'V⁻¹A) + e'Pe,   P = V⁻¹ − V⁻¹A (A'V⁻¹A)⁻¹ A'V⁻¹,       (2)

maximised over ln sigma² and, where it is asked for, ln s² of all uncertain positions. The
inverse of its curvature is the covariance of those logarithms, and carries over to degrees of
freedom of each parameter by Satterthwaite's rule,

    nu_j = 2 C_jj² / (g_j' cov g_j),     g_j = dC_jj / d(ln sigma², ln s²).                 (3)

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72, eq. (2); F. G. Giesbrecht and J. C. Burns 1985,
Biometrics 41, eq. (3).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from multipos.likelihood import Optimum, Problem, assemble
from multipos.model import Block

Array = NDArray[np.float64]

_H = 0.05  # step of the curvature in ln variance: the likelihood is smooth over factors of e
_RANGE = 30.0  # ln variance may move this far from its start, ten powers of ten


@dataclass(frozen=True)
class Linearised:
    """A solution as a linear model of its readings, eq. (1)."""

    error: Array  # (n, M), residuals at the listed positions
    blocks: Sequence[Block]
    shared: Array  # (n, M, q)
    jacobian: Array  # (n, M, 2)
    spread: Array  # (n,) [rad], relative where the orientation sd is estimated
    prior: Array  # (q,) information of the shared unknowns themselves
    p: int


@dataclass(frozen=True)
class Components:
    """Estimated variances.

    Attributes
    ----------
    sigma2 : float
        Variance of a reading.
    factor : float
        Factor on the listed orientation variances; 1 where they are given.
    log_covariance : (v, v) array
        Covariance of the logarithms of what was estimated.
    dof : (p,) array
        Degrees of freedom of each parameter, eq. (3).
    """

    sigma2: float
    factor: float
    log_covariance: Array
    dof: Array


def linearised(problem: Problem, optimum: Optimum) -> Linearised:
    """Return the linear model about an optimum."""
    normal, state = optimum.normal, optimum.state
    moved = np.einsum("nmi,ni->nm", normal.jacobian, state.step)
    prior = np.zeros(problem.shared)
    if problem.level_spread > 0.0:
        prior[-2:] = 1.0 / problem.level_spread**2
    return Linearised(
        error=optimum.point.residuals + moved,
        blocks=optimum.point.blocks,
        shared=normal.shared,
        jacobian=normal.jacobian,
        spread=problem.spread,
        prior=prior,
        p=len(state.theta),
    )


def estimate_components(linear: Linearised, sigma2: float, *, orientation: bool) -> Components:
    """Maximise the restricted likelihood, eq. (2).

    Parameters
    ----------
    linear : Linearised
    sigma2 : float
        Where to start.
    orientation : bool
        Estimate a common factor on the orientation variances as well.
    """
    from scipy.optimize import minimize

    start = np.array([np.log(sigma2), 0.0] if orientation else [np.log(sigma2)])

    def objective(v: Array) -> float:
        if np.abs(v - start).max() > _RANGE:
            return 1e300
        return _restricted(linear, v)[0]

    found = minimize(
        objective, start, method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-9, "maxiter": 500,
                 "initial_simplex": _simplex(start)},
    )  # fmt: skip
    v = np.asarray(found.x)
    covariance = _log_covariance(objective, v)

    def variances(at: Array) -> Array:
        return np.diag(_restricted(linear, at)[1])

    centre = variances(v)
    steps = _H * np.eye(len(v))
    slopes = np.array([(variances(v + h) - variances(v - h)) / (2.0 * _H) for h in steps]).T
    spread = np.einsum("pv,vw,pw->p", slopes, covariance, slopes)
    return Components(
        sigma2=float(np.exp(v[0])),
        factor=float(np.exp(v[1])) if orientation else 1.0,
        log_covariance=covariance,
        dof=2.0 * centre**2 / np.maximum(spread, 1e-300),
    )


def _simplex(start: Array) -> Array:
    return np.vstack([start, start + 2.0 * np.eye(len(start))])


def _log_covariance(objective: Callable[[Array], float], v: Array) -> Array:
    """Return twice the inverse curvature of -2 l; infinite along a direction that is flat."""
    size = len(v)
    curvature = np.empty((size, size))
    steps = _H * np.eye(size)
    for i in range(size):
        for j in range(size):
            curvature[i, j] = (
                objective(v + steps[i] + steps[j])
                - objective(v + steps[i] - steps[j])
                - objective(v - steps[i] + steps[j])
                + objective(v - steps[i] - steps[j])
            ) / (4.0 * _H * _H)
    eigenvalues, vectors = np.linalg.eigh((curvature + curvature.T) / 2.0)
    # A variance at its boundary (nothing left for it) has no curvature: known to a factor e^5.
    return np.asarray((vectors / np.maximum(eigenvalues, 2.0 / 25.0) * 2.0) @ vectors.T)


def _restricted(linear: Linearised, v: Array) -> tuple[float, Array]:
    """Return -2 l of eq. (2) and the covariance C of the parameters."""
    n, m = linear.error.shape
    precision = float(np.exp(-v[0]))
    spread2 = linear.spread**2 * (np.exp(v[1]) if len(v) > 1 else 1.0)
    unknown = np.isinf(linear.spread)
    exact = linear.spread == 0.0
    gram = linear.jacobian.transpose(0, 2, 1) @ linear.jacobian * precision
    with np.errstate(divide="ignore"):
        prior = np.where(exact | unknown, 0.0, 1.0 / np.where(exact, 1.0, spread2))
    inner = gram + prior[:, None, None] * np.eye(2)
    inner[exact] = np.eye(2)
    inverse = np.linalg.inv(inner)
    inverse[exact] = 0.0
    weighted = precision * linear.jacobian
    marginal = precision * np.eye(m) - weighted @ inverse @ weighted.transpose(0, 2, 1)
    push = np.einsum("nij,nj->ni", marginal, linear.error)
    information, right = assemble(linear.p, linear.blocks, marginal, push, linear.shared)
    q = len(linear.prior)
    if q:
        information[-q:, -q:] += np.diag(linear.prior)
    # ln det V = -M ln precision + ln det H - ln det(prior); where s is infinite, less a constant.
    log_inner = np.log(np.linalg.det(inner))
    log_prior = np.where(prior > 0.0, 2.0 * np.log(np.where(prior > 0.0, prior, 1.0)), 0.0)
    log_det = n * m * v[0] + float(np.sum(np.where(exact, 0.0, log_inner - log_prior)))
    solved = np.linalg.solve(information, right)
    value = (
        log_det
        + float(np.linalg.slogdet(information)[1])
        + float(np.einsum("nm,nm->", linear.error, push))
        - float(right @ solved)
    )
    return float(value), np.asarray(np.linalg.inv(information)[: linear.p, : linear.p])

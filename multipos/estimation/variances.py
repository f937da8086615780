"""Reading noise and orientation error estimated together: restricted maximum likelihood.

Linearised about a solution, the readings at the listed positions have residuals e_k (n, M) with

    cov e_k = a Sigma_k + b s_k² J_k J_k',     e = A theta + error,                         (1)

(Sigma_k, s_k, J_k, A as in `multipos.estimation.likelihood`), a and b factors on what is stated.
What the parameters do not use up is judged by

    -2 l = sum ln det V_k + ln det(A'V⁻¹A) + e'Pe,   P = V⁻¹ − V⁻¹A (A'V⁻¹A)⁻¹ A'V⁻¹,       (2)

maximised over ln a, ln b or both, with the gradient

    d(-2 l)/dv = tr(P dV) − e'P dV P e,       dV = a Sigma or b s² J J'.                    (3)

Twice the inverse of its curvature is the covariance of those logarithms. It carries over to
degrees of freedom of each parameter by Satterthwaite's rule,

    nu_j = 2 C_jj² / (g_j' cov g_j),     g_j = dC_jj/dv,     dC/dv = C A'V⁻¹ dV V⁻¹A C.     (4)

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72, eqs. (2), (3); F. G. Giesbrecht and J. C. Burns
1985, Biometrics 41, eq. (4).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.likelihood import eliminate, linearise
from multipos.estimation.problem import Optimum, Problem
from multipos.numerics.arrays import Array
from multipos.sensor.inverse import parameter_jacobian

_H = 0.05  # step of the curvature in ln variance: the likelihood is smooth over factors of e
_LEAST, _MOST = 1e-8, 1e2  # of what either variance would be if all the error were its own
_FINEST = 1e-9  # [g, rad]: no reading is as quiet, no position as well known
# Noise that is less of what the placement does would leave no digits of what tells them apart.
FINEST_OF_PLACEMENT = 1e-6
_FLAT = 2.0 / 25.0  # curvature of a variance at its boundary: known to a factor e^5


@dataclass(frozen=True)
class Linearised:
    """A solution as a linear model of its readings, eq. (1)."""

    error: Array  # (n, M), residuals at the listed positions
    design: Array  # (n, M, p + q), A: parameters and shared unknowns
    jacobian: Array  # (n, M, 2)
    precision: Array  # (n, M, M), Sigma^-1
    orientation_sd: Array  # (n,) [rad]
    prior: Array  # (p + q,) information of the unknowns themselves
    p: int


@dataclass(frozen=True)
class Components:
    """How well the estimated variances are known.

    Attributes
    ----------
    log_covariance : (v, v) array
        Covariance of the logarithms of what was estimated.
    dof : (p,) array
        Degrees of freedom of each parameter, eq. (4).
    """

    log_covariance: Array
    dof: Array


def linearised(problem: Problem, optimum: Optimum) -> Linearised:
    """Return the linear model about an optimum, with the variances that `problem` states."""
    state = optimum.state
    normal = linearise(problem, state, optimum.point)
    p, m = len(state.theta), problem.values.shape[1]
    slopes = parameter_jacobian(
        problem.model, state.theta, optimum.point.force, problem.environment
    )
    prior = np.zeros(p + problem.shared)
    if problem.level_sd > 0.0:
        prior[-2:] = 1.0 / problem.level_sd**2
    precision = problem.precision
    return Linearised(
        error=optimum.point.residuals + np.einsum("nmi,ni->nm", normal.jacobian, state.step),
        design=np.concatenate([slopes, normal.shared], axis=2),
        jacobian=normal.jacobian,
        precision=precision if precision.ndim == 3 else precision[:, :, None] * np.eye(m),
        orientation_sd=problem.orientation_sd,
        prior=prior,
        p=p,
    )


def maximise_restricted(linear: Linearised, start: Array, free: NDArray[np.bool_]) -> Array:
    """Return (ln a, ln b) that maximise the restricted likelihood, eq. (2).

    Parameters
    ----------
    linear : Linearised
    start : (2,) array
    free : (2,) array of bool
        Which of the two to estimate; the other stays where it starts.
    """
    from scipy.optimize import minimize

    def objective(inner: Array) -> tuple[float, Array]:
        value, slope, _ = _restricted(linear, _at(start, free, inner))
        return value, slope[free]

    low, high = _bounds(linear)[free].T
    found = minimize(
        objective,
        np.clip(start[free], low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low.tolist(), high.tolist(), strict=True)),
        options={"ftol": 1e-13, "gtol": 1e-6},
    )
    return _at(start, free, np.asarray(found.x))


def components(linear: Linearised, v: Array, free: NDArray[np.bool_]) -> Components:
    """Return how well ln a and ln b are known, and with them the parameters."""
    steps = _H * np.eye(2)[free]
    curvature = np.array(
        [
            (_restricted(linear, v + h)[1] - _restricted(linear, v - h)[1])[free] / (2.0 * _H)
            for h in steps
        ]
    )
    eigenvalues, vectors = np.linalg.eigh((curvature + curvature.T) / 2.0)
    covariance = (vectors * 2.0 / np.maximum(eigenvalues, _FLAT)) @ vectors.T
    _, _, (C, by_variance) = _restricted(linear, v)
    slopes = np.array([np.diag(C @ change @ C)[: linear.p] for change in by_variance[free]])
    spread = np.einsum("vp,vw,wp->p", slopes, covariance, slopes)
    dof = 2.0 * np.diag(C)[: linear.p] ** 2 / np.maximum(spread, 1e-300)
    # A variance that rests on less than one contrast is not known at all, and the rule's answer,
    # a fraction whose k is astronomical, says no more than the k of one degree of freedom.
    return Components(covariance, np.clip(dof, 1.0, 1e9))


def _bounds(linear: Linearised) -> Array:
    """Return the range (2, 2) of ln a and ln b beyond which nothing changes any more."""
    error, J, P = linear.error, linear.jacobian, linear.precision
    tied = np.isfinite(linear.orientation_sd) & (linear.orientation_sd > 0.0)
    whole = float(np.einsum("ni,nij,nj->", error, P, error))
    gram = np.einsum("nia,nij,nja->n", J, P, J)[tied]
    turned = float(np.sum(linear.orientation_sd[tied] ** 2 * gram))
    largest = whole / np.array([error.size, turned if turned > 0.0 else 1.0])
    # Where nothing is left over, as when a tilt explains it all, a variance would go to nothing,
    # and with it the digits of the information.
    signal = float(np.einsum("nia,nij,nja->", J, P, J)) / error.size or 1.0
    widest = float(linear.orientation_sd[tied].max()) if tied.any() else 1.0
    quietest = max(_FINEST, FINEST_OF_PLACEMENT * widest) if tied.any() else _FINEST
    finest = np.array([quietest**2 * signal, (_FINEST / widest) ** 2])
    lowest = np.maximum(_LEAST * largest, finest)
    bounds = np.column_stack([lowest, np.maximum(_MOST * largest, lowest)])
    return np.asarray(np.log(bounds))


def _at(start: Array, free: NDArray[np.bool_], inner: Array) -> Array:
    v = start.copy()
    v[free] = inner
    return v


def _restricted(linear: Linearised, v: Array) -> tuple[float, Array, tuple[Array, Array]]:
    """Return -2 l, its gradient, C = (A'V⁻¹A)⁻¹, and A'V⁻¹ dV V⁻¹A of both variances."""
    n, m = linear.error.shape
    a, b = np.exp(v)
    P, J = linear.precision / a, linear.jacobian
    exact, unknown = linear.orientation_sd == 0.0, np.isinf(linear.orientation_sd)
    tied = ~(exact | unknown)
    spread2 = np.where(tied, b * np.where(tied, linear.orientation_sd, 1.0) ** 2, 0.0)
    weighted = P @ J
    prior = np.where(tied, 1.0 / np.where(tied, spread2, 1.0), 0.0)
    own = eliminate(P, J, weighted, prior, exact)
    W, H = own.marginal, own.determinant
    # ln det V = M ln a + ln det H + 2 ln s², less what does not depend on v: ln det Sigma, and
    # 2 ln s² where s is infinite.
    log_det = n * m * v[0] + float(np.sum(np.log(np.where(H > 0.0, H, 1.0))))
    log_det += float(np.sum(2.0 * np.log(np.where(tied, spread2, 1.0))))

    X = (W @ linear.design).reshape(n * m, -1)  # V⁻¹A
    A = linear.design.reshape(n * m, -1)
    information = A.T @ X + np.diag(linear.prior)
    C = np.asarray(np.linalg.inv(information), dtype=np.float64)
    plain = np.einsum("nij,nj->ni", W, linear.error)
    right = A.T @ plain.ravel()
    left = plain - (X @ (C @ right)).reshape(n, m)  # P e
    value = (
        log_det
        + float(np.linalg.slogdet(information)[1])
        + float(np.einsum("nm,nm->", linear.error, plain))
        - float(right @ C @ right)
    )

    noise = np.linalg.inv(P)  # a Sigma
    by_noise = X.T @ (noise @ X.reshape(n, m, -1)).reshape(n * m, -1)
    seen = J.transpose(0, 2, 1) * np.sqrt(spread2)[:, None, None]  # (n, 2, M)
    Y = (seen @ X.reshape(n, m, -1)).reshape(2 * n, -1)
    by_spread = Y.T @ Y
    gradient = np.array(
        [
            np.einsum("nij,nji->", W, noise)
            - np.sum(C * by_noise)
            - np.einsum("ni,nij,nj->", left, noise, left),
            np.einsum("nai,nij,naj->", seen, W, seen)
            - np.sum(C * by_spread)
            - np.sum(np.einsum("nai,ni->na", seen, left) ** 2),
        ],
        dtype=np.float64,
    )
    return float(value), gradient, (C, np.array([by_noise, by_spread]))

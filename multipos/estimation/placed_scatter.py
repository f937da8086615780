"""Scatter beside a stated noise where orientations are uncertain or unknown.

About a solution the readings of a position have the marginal covariance

    V_k = Σ_k + τ² I + s_k² J_k J_k',                                                       (1)

Σ, J and s of `multipos.estimation.likelihood`; unknown orientations have s infinite, and of their
readings only what lies along the normal of the sphere counts. The posterior of τ² and of the
parameters is that of `multipos.estimation.scatter`, with Jeffreys' prior of (1),
dτ² (Σ tr V_k⁻²)^½.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from multipos.estimation.descent import resume
from multipos.estimation.likelihood import eliminate
from multipos.estimation.problem import Optimum, Problem
from multipos.estimation.scatter import Found, Posterior, integrate
from multipos.estimation.variances import Linearised, linearised
from multipos.numerics.arrays import Array

_ROUNDS = 8  # of scatter and solution in turn
_SETTLED = 1e-4  # relative change of the noise far below what is known of it
_ROWS = 50_000  # positions worked on at once


def integrate_placed(
    first: Problem, optimum: Optimum, nu: float
) -> tuple[Problem, Optimum, Posterior]:
    """Return problem and optimum with the scatter that was found, and its posterior.

    Parameters
    ----------
    first, optimum
        With the stated noise.
    nu : float
        Degrees of freedom, above 0.
    """
    floor = _covariances(first)
    size = float(np.exp(np.mean(np.log(np.diagonal(floor, axis1=1, axis2=2)))))
    problem, before = first, 0.0
    for _ in range(_ROUNDS):
        linear = linearised(first, optimum)
        residuals = optimum.point.residuals
        squares = optimum.point.objective * size, float(np.sum(residuals**2))
        if before > 0.0:  # the objective is under the noise that was found
            squares = squares[0] * (size + before) / size, squares[1]
        posterior = integrate(partial(_evaluate, linear, floor, size), nu, size, squares)
        tau2 = posterior.summary[0]
        problem = replace(first, precision=_precision(first, floor, tau2))
        optimum = resume(problem, optimum)
        if abs(tau2 - before) <= _SETTLED * (size + before):
            break
        before = tau2
    return problem, optimum, posterior


def _covariances(problem: Problem) -> Array:
    """Return the stated covariance of each position (n, M, M)."""
    if problem.precision.ndim == 3:
        return np.asarray(np.linalg.inv(problem.precision))
    return np.asarray((1.0 / problem.precision)[:, :, None] * np.eye(problem.values.shape[1]))


def _precision(problem: Problem, floor: Array, tau2: float) -> Array:
    m = floor.shape[1]
    if problem.precision.ndim == 2:
        return np.asarray(1.0 / (np.diagonal(floor, axis1=1, axis2=2) + tau2))
    return np.asarray(np.linalg.inv(floor + tau2 * np.eye(m)))


def _evaluate(linear: Linearised, floor: Array, size: float, nodes: Array) -> Found:
    """Return the posterior density of ln(τ² + size), moves and variances at nodes (G,)."""
    step = max(1, _ROWS // len(floor))
    parts = [
        _evaluate_few(linear, floor, nodes[first : first + step], size)
        for first in range(0, len(nodes), step)
    ]
    return Found(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _evaluate_few(linear: Linearised, floor: Array, nodes: Array, size: float) -> Found:
    n, m = linear.error.shape
    G = len(nodes)
    covariance = floor + nodes[:, None, None, None] * np.eye(m)
    P = np.asarray(np.linalg.inv(covariance), dtype=np.float64).reshape(G * n, m, m)
    J = np.tile(linear.jacobian, (G, 1, 1))
    sd = np.tile(linear.orientation_sd, G)
    tied = np.isfinite(sd) & (sd > 0.0)
    prior = np.where(tied, 1.0 / np.where(tied, sd, 1.0) ** 2, 0.0)
    own = eliminate(P, J, P @ J, prior, sd == 0.0)
    W = own.marginal.reshape(G, n, m, m)
    H = own.determinant.reshape(G, n)
    # ln det V = ln det (Σ + τ²) + ln det H + 2 ln s², less what does not depend on τ²
    log_det = np.linalg.slogdet(covariance)[1].sum(axis=1)
    log_det += np.log(np.where(H > 0.0, H, 1.0)).sum(axis=1)
    A = linear.design.reshape(n * m, -1)
    X = (W @ linear.design).reshape(G, n * m, -1)  # V⁻¹A
    plain = np.einsum("gnij,nj->gni", W, linear.error).reshape(G, -1)
    information = A.T @ X + np.diag(linear.prior)
    C = np.linalg.inv(information)
    right = plain @ A
    moves = np.einsum("gpq,gq->gp", C, right)
    log = -0.5 * (
        log_det
        + np.linalg.slogdet(information)[1]
        + plain @ linear.error.ravel()
        - np.einsum("gp,gp->g", right, moves)
    )
    log += 0.5 * np.log(np.einsum("gnij,gnji->g", W, W)) + np.log(nodes + size)
    variances = np.einsum("gpp->gp", C)[:, : linear.p]
    return Found(log, moves[:, : linear.p], variances)

"""Scatter beside a stated noise where orientations are uncertain or unknown.

About a solution the readings of a position have the marginal covariance

    V_k = Σ_k + τ² I + s_k² J_k J_k',                                                       (1)

Σ, J and s of `multipos.estimation.likelihood`; unknown orientations have s infinite, and of their
readings only what lies along the normal of the sphere counts. The posterior of τ² and of the
parameters is that of `multipos.estimation.posteriors`, with Jeffreys' prior of (1),
dτ² (Σ tr V_k⁻²)^½.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from multipos.estimation.descent import maximise, resume
from multipos.estimation.grids import Both, integrate_grid
from multipos.estimation.likelihood import eliminate
from multipos.estimation.linearisation import Linearised, linearised
from multipos.estimation.posteriors import Found, Posterior, integrate
from multipos.estimation.problem import Optimum, Problem, start_state
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import step_on_sphere

ROUNDS = 8  # of scatter and solution in turn
SETTLED = 1e-4  # relative change of the noise far below what is known of it
SETTLED_BOTH = 0.02  # change of a logarithm, where both are known to a tenth of one at best
_ROWS = 50_000  # positions worked on at once
_NOTHING = 1e-4  # of the noise that is stated, as a variance
LEAST = 0.03  # of what placement does to a reading: noise of that size changes nothing
LEAST_TOLD = 1e-3  # the same where readings tell the noise
TELLING = 6  # contrasts from which on they do
_RANK = 1e-14  # of the largest eigenvalue, scaled, below which nothing is told
_TOUCHED = 1e-6  # of the largest slope, below which a turn moves nothing


def integrate_placed(
    first: Problem, optimum: Optimum, nu: float, *, believed: bool = True
) -> tuple[Problem, Optimum, Posterior]:
    """Return problem and optimum with the scatter that was found, and its posterior.

    Parameters
    ----------
    first, optimum
        With the stated noise.
    nu : float
        Degrees of freedom, above 0.
    believed : bool
        The stated noise may be all there is.
    """
    floor = _covariances(first)
    size = _harmonic_mean(floor)
    problem, before = first, 0.0
    for _ in range(ROUNDS):
        linear = linearised(first, optimum)
        residuals = optimum.point.residuals
        squares = optimum.point.objective * size, float(np.sum(residuals**2))
        if before > 0.0:  # the objective is under the noise that was found
            squares = squares[0] * (size + before) / size, squares[1]
        brackets = np.array(squares[:1]), np.array(squares[1:])
        alone = partial(_of_one, linear, floor, size)
        posterior = integrate(alone, nu, np.array([size]), brackets, believed=believed)
        tau2 = float(posterior.summary[0][0])
        problem = replace(first, precision=_precision(first, floor, tau2))
        optimum = resume(problem, optimum)
        if abs(tau2 - before) <= SETTLED * (size + before):
            break
        before = tau2
    return problem, optimum, posterior


def least_floor(problem: Problem, optimum: Optimum) -> Problem:
    """Return the problem with a noise so small that it changes nothing.

    Where no contrast tells the noise, the least noise that could matter is what placement does to
    a reading, by a small share; elsewhere what is left over is.
    """
    linear = linearised(problem, optimum)
    share = LEAST_TOLD if tells_apart(problem, optimum) else LEAST
    size = share**2 * float(np.sum(linear.spread**2)) / problem.values.size
    if not linear.tied.any():
        size = LEAST_TOLD**2 * float(np.mean(optimum.point.residuals**2))
    rounding = np.finfo(float).eps * float(np.abs(problem.values).max())
    floor = max(size, rounding**2)
    return replace(problem, precision=np.full(problem.values.shape, 1.0 / floor))


def integrate_both(
    first: Problem, optimum: Optimum, nu: float, *, floor: bool = False, believed: bool = True
) -> tuple[Problem, Optimum, Both]:
    """Return problem and optimum with the scatter and the placement that were found.

    Parameters
    ----------
    first, optimum
        With the stated noise, and orientation sds that are right but for a common factor.
    nu : float
        Degrees of freedom, above 0.
    floor : bool
        The orientation sds are a floor, as the noise is.
    believed : bool
        The stated noise may be all there is.
    """
    least = _covariances(first)
    size = _harmonic_mean(least)
    grid = partial(_over_both, floor=least, size=size, nu=nu, placed=floor, believed=believed)
    problem, before = first, np.zeros(2)
    for _ in range(ROUNDS):
        both = grid(linearised(first, optimum))
        tau2, factor = float(both.posterior.summary[0][0]), float(both.factor[0])
        problem = replace(
            first,
            precision=_precision(first, least, tau2),
            orientation_sd=first.orientation_sd * np.sqrt(factor),
        )
        optimum = resume(problem, optimum)
        now = np.log([size + tau2, factor])
        if np.abs(now - before).max() <= SETTLED_BOTH:
            break
        before = now
    return problem, optimum, both


def tells_apart(problem: Problem, optimum: Optimum) -> bool:
    """Tell whether readings tell scatter from placement; where few do, U would not cover."""
    return _contrasts(problem, optimum) >= TELLING


def _contrasts(problem: Problem, optimum: Optimum) -> int:
    """Return how many contrasts of the readings no placement touches: they alone tell the scatter.

    Only what lies along the normals of the sphere, less what the parameters take of it.
    """
    linear = linearised(problem, optimum)
    n, m, _ = linear.design.shape
    axes, sizes, _ = np.linalg.svd(linear.jacobian, full_matrices=True)
    seen = np.zeros((n, m), bool)  # outputs' combinations that a turn does not move
    seen[:, : sizes.shape[1]] = sizes <= _TOUCHED * sizes.max()
    seen[:, sizes.shape[1] :] = True
    seen[problem.exact] = True
    across = axes.transpose(0, 2, 1) @ linear.design
    left = across[seen]
    size = np.linalg.norm(linear.design, axis=(0, 1))
    return int(len(left) - np.linalg.matrix_rank(left / np.where(size > 0.0, size, 1.0)))


def as_scatter(problem: Problem, optimum: Optimum) -> tuple[Problem, Optimum]:
    """Return the problem of positions that are where they are listed, and its optimum."""
    tied = np.isfinite(problem.orientation_sd)
    exact = replace(problem, orientation_sd=np.where(tied, 0.0, problem.orientation_sd))
    direction = step_on_sphere(optimum.state.centre, optimum.state.basis, optimum.state.step)
    state = start_state(exact, optimum.state.theta, direction, optimum.state.turns)
    return exact, maximise(exact, state)


def _over_both(
    linear: Linearised, *, floor: Array, size: float, nu: float, placed: bool, believed: bool
) -> Both:
    """Return the posterior over a grid of ln(τ² + size) and the logarithm of the factor on s²."""
    slopes = float(np.sum(linear.spread**2))

    def evaluate(factors: Array, nodes: Array, *, whole: bool) -> Found:
        found = _evaluate(linear, floor, size, factors[0], nodes[0])
        return Found(*(each[None] for each in found))

    return integrate_grid(
        evaluate,
        nu,
        np.array([size]),
        np.array([np.sum(linear.error**2)]),
        np.array([slopes]),
        least=None if placed else np.array([least_factor(size, linear.error.size, slopes)]),
        believed=believed,
    )


def least_factor(size: Any, readings: int, slopes: Any) -> Any:
    """Return the factor on s² below which what placement does is nothing beside the noise."""
    return _NOTHING * size * readings / slopes


def _harmonic_mean(covariances: Array) -> float:
    """Return the harmonic mean of the variances of readings, (n, M, M) their covariances."""
    return 1.0 / float(np.mean(1.0 / np.diagonal(covariances, axis1=1, axis2=2)))


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


def _of_one(linear: Linearised, floor: Array, size: float, nodes: Array) -> Found:
    """Return what `_evaluate` finds at nodes (1, G), as of a batch of one."""
    found = _evaluate(linear, floor, size, None, nodes[0])
    return Found(*(each[None] for each in found))


def _evaluate(
    linear: Linearised, floor: Array, size: float, factors: Array | None, nodes: Array
) -> Found:
    """Return the posterior density of ln(τ² + size), moves and variances at nodes (G,).

    With `factors` (G,), by which s² is multiplied, it is that of ln s² as well.
    """
    step = max(1, _ROWS // len(floor))
    parts = [
        _evaluate_few(linear, floor, size, None if factors is None else factors[rows], nodes[rows])
        for rows in (slice(first, first + step) for first in range(0, len(nodes), step))
    ]
    return Found(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _evaluate_few(
    linear: Linearised, floor: Array, size: float, factors: Array | None, nodes: Array
) -> Found:
    n, m = linear.error.shape
    G = len(nodes)
    covariance = floor + nodes[:, None, None, None] * np.eye(m)
    P, log_det = _inverses(covariance.reshape(G * n, m, m))
    J = np.tile(linear.jacobian, (G, 1, 1))
    sd = np.tile(linear.orientation_sd, G)
    tied, rolled = np.tile(linear.tied, G), np.tile(linear.rolled, G)
    times = np.ones(G) if factors is None else factors
    variance = np.where(tied, np.where(tied, sd, 1.0) ** 2 * np.repeat(times, n), 1.0)
    exact = (sd == 0.0) & ~rolled
    own = eliminate(P, J, P @ J, np.where(tied, 1.0 / variance, 0.0), exact, rolled)
    W = own.marginal.reshape(G, n, m, m)
    H = own.determinant
    # ln det V = ln det (Σ + τ²) + ln det H + 2 ln s² (of a roll ln s²), less what is constant
    angles = np.where(rolled, 1.0, 2.0)  # that have a prior
    log_det += np.log(np.where(H > 0.0, H, 1.0)) + angles * np.log(variance)
    A = linear.design.reshape(n * m, -1)
    X = (W @ linear.design).reshape(G, n * m, -1)  # V⁻¹A
    plain = np.einsum("gnij,nj->gni", W, linear.error).reshape(G, -1)
    C, log_information = _invert(A.T @ X + np.diag(linear.prior))
    right = plain @ A + linear.pull
    moves = np.einsum("gpq,gq->gp", C, right)
    log = -0.5 * (
        log_det.reshape(G, n).sum(axis=1)
        + log_information
        + plain @ linear.error.ravel()
        - np.einsum("gp,gp->g", right, moves)
    )
    log += _log_prior(linear, W, factors) + np.log(nodes + size)
    return Found(log, moves[:, : linear.p], np.einsum("gpp->gp", C)[:, : linear.p])


def _inverses(covariances: Array) -> tuple[Array, Array]:
    """Return inverses and ln det of covariances (k, M, M), at once where all are diagonal."""
    variances = np.einsum("kii->ki", covariances)
    if np.count_nonzero(covariances) > np.count_nonzero(variances):
        return np.asarray(np.linalg.inv(covariances)), np.linalg.slogdet(covariances)[1]
    inverses = np.zeros_like(covariances)
    np.einsum("kii->ki", inverses)[:] = 1.0 / variances
    return inverses, np.log(variances).sum(axis=1)


def _invert(information: Array) -> tuple[Array, Array]:
    """Return inverses (G, p, p) and ln det (G,), without what nothing tells, such as a rotation."""
    size = np.sqrt(np.einsum("gpp->gp", information))
    scale = 1.0 / np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(information * scale[:, :, None] * scale[:, None, :])
    told = values > _RANK * values[:, -1:]
    kept = np.where(told, values, 1.0)
    inverse = (vectors * (told / kept)[:, None, :]) @ vectors.transpose(0, 2, 1)
    inverse = inverse * scale[:, :, None] * scale[:, None, :]
    return inverse, np.log(kept).sum(axis=1) - 2.0 * np.log(scale).sum(axis=1)


def _log_prior(linear: Linearised, W: Array, factors: Array | None) -> Array:
    """Return ln of Jeffreys' prior of τ², or of τ² and ln s² together, at nodes (G,)."""
    by_scatter = np.einsum("gnij,gnji->g", W, W)
    if factors is None:
        return np.asarray(0.5 * np.log(by_scatter))
    S = linear.spread  # s J
    WS = W @ S
    inner = S.transpose(0, 2, 1) @ WS
    by_both = np.einsum("gnia,gnia->g", WS, WS)
    by_placement = np.einsum("gnab,gnba->g", inner, inner)
    determinant = np.maximum(by_scatter * by_placement - by_both**2, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(0.5 * np.log(determinant) + np.log(factors))

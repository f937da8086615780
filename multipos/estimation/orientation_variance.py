"""Scatter beside a stated noise where orientations are uncertain or unknown.

About a solution the readings of a position have the marginal covariance

    V_k = Σ_k + τ² I + s_k² J_k J_k',                                                       (1)

Σ, J and s of `multipos.estimation.likelihood`; unknown orientations have s infinite, and of their
readings only what lies along the normal of the sphere counts. The posterior of τ² and of the
parameters is that of `multipos.estimation.posteriors`, with Jeffreys' prior of (1),
dτ² (Σ tr V_k⁻²)^½.

Scatter and placement of many units at uncertain orientations: their posteriors, all at once.

About its solution the readings of a unit at position k have, as in
`multipos.estimation.orientation_variance`, the marginal covariance

    V_k = Σ_k + τ² I + F s_k² J_k J_k' = U_k diag(a_k + F c_k + τ²) U_k',                   (2)

a matrix in axes U_k that do not move with τ². Where all readings of a position have one variance,
a is that, c_k are s_k² times the eigenvalues of J_k J_k', one of which is zero, and U_k does not
move with F either; elsewhere a_k are the squares of the singular values of (Σ_k^½, s_k J_k), and
F = 1. In these axes the residuals e_k at the listed positions and the design A_k are single numbers
d and rows D of the weights w = 1/(a + F c + τ²), so that at all nodes (τ², F) of a unit

    S = D'wD,   b = D'wd,   q = d'wd,   ln det V = −Σ ln w                                  (3)

are one product of w with the products of D and d, and with the Cholesky factor of
((S, b), (b', q)) the restricted likelihood and the parameters follow as they do there,

    −2 ln L = ln det V + ln det S + q − b'S⁻¹b,    moves S⁻¹b,    variances diag S⁻¹,       (4)

times Jeffreys' prior, (Σ w²)^½ of τ² and (Σ w² Σ w²c² − (Σ w²c)²)^½ F of both.

Where nothing is known of an orientation, only what lies along the normal n of the sphere is left of
a reading: one number a position, with a = n'Σn.

A solution of the likelihood as a linear model of its readings.

About an optimum the readings at the listed positions have residuals e_k (n, M) with

    e = A theta + error,      cov error_k = Sigma_k + s_k² J_k J_k',                        (5)

Sigma_k, s_k, J_k, A as in `multipos.estimation.likelihood`.

Noise and solutions of many units in turn, each unit until its noise settles.

What residuals say of the noise moves the solution, and that the residuals. A unit that has settled
is left out of the turns that follow, so that a few which take long do not hold up the others.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.descent import maximise, resume
from multipos.estimation.likelihood import eliminate, linearise
from multipos.estimation.posteriors import Both, Found, Posterior, integrate, integrate_grid
from multipos.estimation.problem import Optimum, Problem, start_state
from multipos.numerics.arrays import Array, Places
from multipos.numerics.rotations import step_on_sphere
from multipos.sensor.inverse import parameter_jacobian


@dataclass(frozen=True, eq=False)
class Linearised:
    """A solution as a linear model of its readings, eq. (5)."""

    error: Array  # (n, M), residuals at the listed positions
    design: Array  # (n, M, p + q), A: parameters and shared unknowns
    jacobian: Array  # (n, M, 2)
    precision: Array  # (n, M, M), Sigma^-1
    orientation_sd: Array  # (n,) [rad]
    prior: Array  # (p + q,) information of the unknowns themselves
    p: int
    rolled: NDArray[np.bool_]  # (n,), rolls whose first angle is free
    pull: Array | float = 0.0  # (p + q,) of the priors of parameters towards their centres

    @property
    def tied(self) -> NDArray[np.bool_]:
        """Positions (n,) that are off by their sd."""
        return np.isfinite(self.orientation_sd) & (self.orientation_sd > 0.0)

    @property
    def spread(self) -> Array:
        """What a turn by its sd does to each position, s_k J_k (n, M, 2); 0 for a free turn."""
        size = np.where(self.tied, self.orientation_sd, 0.0)[:, None, None]
        return np.asarray(self.jacobian * size * np.where(self.rolled[:, None, None], [0, 1], 1))


def linearised(problem: Problem, optimum: Optimum) -> Linearised:
    """Return the linear model about an optimum, with the variances that `problem` states."""
    state = optimum.state
    normal = linearise(problem, state, optimum.point)
    p, m = len(state.theta), problem.values.shape[1]
    slopes = parameter_jacobian(
        problem.model, state.theta, optimum.point.force, problem.environment
    )
    prior = np.zeros(p + problem.shared)
    pull = np.zeros(p + problem.shared)
    if problem.believed:
        excess, slope = problem.model.belief(state.theta)
        prior[:p], pull[:p] = slope**2, -slope * excess
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
        pull=pull,
        p=p,
        rolled=problem.rolled,
    )


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


_AT_ONCE = 2000  # nodes of all units, so that what they need stays in the cache
_OUTPUTS = 3


class About(NamedTuple):
    """Solutions of B units as linear models of their readings at the listed positions."""

    error: Array  # e, (B, n, 3)
    design: Array  # A, (B, n, 3, p)
    spread: Array  # s J, (B, n, 3, 2)


class Normals(NamedTuple):
    """Solutions of B units of unknown orientation as linear models of what is left of readings."""

    error: Array  # along the normals, (B, n)
    design: Array  # (B, n, p)
    normal: Array  # of length one, (B, n, 3)


class Rotated(NamedTuple):
    """The linear models in the axes of eq. (2), N single numbers a unit, 3 or one a position."""

    products: Array  # of D and d with each other, (B, N, (p + 1)(p + 2)/2)
    fixed: Array  # a, (B, N)
    moving: Array  # c, (B, N)
    parameters: int


def integrate_scatter(
    about: About,
    floor: Array,
    dof: float,
    squares: tuple[Array, Array],
    *,
    believed: bool,
) -> Posterior:
    """Return the posterior of τ² and of parameters, of units whose placement is known.

    Parameters
    ----------
    about : About
    floor : (B, n, 3) array
        Stated variances.
    dof : float
    squares : tuple of two (B,) arrays
        As in `multipos.estimation.posteriors.integrate`.
    believed : bool
    """
    size = typical(floor)
    evaluator = _Evaluator(_rotated(about, floor), size)
    return integrate(evaluator.at_scatter, dof, size, squares, believed=believed)


def integrate_along(
    normals: Normals, floor: Array, dof: float, squares: tuple[Array, Array]
) -> Posterior:
    """Return the posterior of τ² and of parameters, of units of unknown orientation.

    Parameters
    ----------
    normals : Normals
    floor : (B, n, 3) array
        Stated variances.
    dof : float
    squares : tuple of two (B,) arrays
        As in `multipos.estimation.posteriors.integrate`.
    """
    size = typical(floor)
    rows = np.concatenate([normals.design, normals.error[..., None]], axis=2)
    fixed = np.einsum("bni,bni->bn", normals.normal**2, floor)
    rotated = Rotated(_products(rows), fixed, np.zeros_like(fixed), normals.design.shape[2])
    return integrate(_Evaluator(rotated, size).at_scatter, dof, size, squares)


def integrate_scatter_and_placement(
    about: About, floor: Array, dof: float, *, believed: bool
) -> Both:
    """Return the posterior of τ², F and parameters.

    Parameters
    ----------
    about : About
    floor : (B, n, 3) array
        Stated variances, all of a unit alike.
    dof : float
    believed : bool
    """
    size = typical(floor)
    slopes = np.einsum("bnij,bnij->b", about.spread, about.spread)
    count = len(size)
    return integrate_grid(
        _Evaluator(_rotated(about, floor), size).at_both,
        dof,
        size,
        np.einsum("bni,bni->b", about.error, about.error),
        slopes,
        least=least_factor(size, about.error.size // count, slopes),
        believed=believed,
    )


def typical(floor: Array) -> Array:
    """Return the harmonic mean (B,) of variances (B, n, 3)."""
    return np.asarray(1.0 / np.mean(1.0 / floor, axis=(1, 2)))


def are_alike(floor: Array) -> NDArray[np.bool_]:
    """Tell of which units (B,) the variances (B, n, 3) are one number."""
    return np.asarray(np.ptp(floor.reshape(len(floor), -1), axis=1) == 0.0)


def _rotated(about: About, floor: Array) -> Rotated:
    """Return the linear models in the axes in which eq. (2) is diagonal."""
    count, n = floor.shape[:2]
    p = about.design.shape[3]
    if are_alike(floor).all():
        axes, moving = _axes_of_turns(about.spread.reshape(-1, _OUTPUTS, 2))
        fixed = floor.reshape(-1, _OUTPUTS)
    else:
        root = np.sqrt(floor)[..., None] * np.eye(_OUTPUTS)
        both = np.concatenate([root, about.spread], axis=3).reshape(-1, _OUTPUTS, _OUTPUTS + 2)
        U, singular, _ = np.linalg.svd(both, full_matrices=False)
        axes, fixed, moving = U.transpose(0, 2, 1), singular**2, np.zeros_like(singular)
    rows = np.concatenate([about.design, about.error[..., None]], axis=3)
    rows = (axes @ rows.reshape(-1, _OUTPUTS, p + 1)).reshape(count, n * _OUTPUTS, p + 1)
    return Rotated(_products(rows), fixed.reshape(count, -1), moving.reshape(count, -1), p)


def _products(rows: Array) -> Array:
    """Return the products of single numbers (B, N, p + 1) with each other."""
    first, second = np.triu_indices(rows.shape[2])
    return np.asarray(rows[:, :, first] * rows[:, :, second])


def _axes_of_turns(spread: Array) -> tuple[Array, Array]:
    """Return the axes (N, 3, 3), as rows, and eigenvalues (N, 3) of sJ (sJ)' (N, 3, 2).

    By the angle that makes the two columns orthogonal, so that small eigenvalues are exact.
    """
    first, second = spread[:, :, 0], spread[:, :, 1]
    a, d = (np.einsum("ni,ni->n", each, each) for each in (first, second))
    angle = np.arctan2(2.0 * np.einsum("ni,ni->n", first, second), a - d) / 2.0
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    one, two = c * first + s * second, c * second - s * first
    large, small = (np.einsum("ni,ni->n", each, each) for each in (one, two))
    exact = (large == 0.0)[:, None]  # of a position known exactly any axes serve
    one = np.where(exact, [1.0, 0.0, 0.0], one) / np.sqrt(np.where(exact, 1.0, large[:, None]))
    two = np.where(exact, [0.0, 1.0, 0.0], two) / np.sqrt(np.where(exact, 1.0, small[:, None]))
    values = np.stack([large, small, np.zeros_like(large)], axis=1)
    return np.stack([one, two, np.cross(one, two)], axis=1), values


class _Evaluator:
    """What evaluates eq. (4) at nodes of B units, some of them at a time."""

    def __init__(self, rotated: Rotated, size: Array) -> None:
        self._rotated, self._size = rotated, size

    def at_scatter(self, nodes: Array) -> Found:
        """Return what is found at values of τ² (B, G)."""
        return self.at_both(None, nodes)

    def at_both(self, factors: Array | None, nodes: Array, *, whole: bool = True) -> Found:
        """Return what is found at factors and values of τ² (B, G); of parameters if `whole`."""
        (count, G), p = nodes.shape, self._rotated.parameters if whole else 0
        log = np.empty((count, G))
        moves, variances = np.empty((count, G, p)), np.empty((count, G, p))
        for units, places in _pieces(count, G):
            some = None if factors is None else factors[units, places]
            mine = nodes[units, places]
            log[units, places], L = _likelihood(self._rotated, self._size, units, some, mine)
            if whole:
                moves[units, places], variances[units, places] = _parameters(L)
        return Found(log, moves, variances)


def _pieces(count: int, nodes: int) -> Iterator[tuple[slice, slice]]:
    """Yield units and nodes, few enough at a time."""
    step = max(1, _AT_ONCE // nodes)
    for first in range(0, count, step):
        for place in range(0, nodes, _AT_ONCE):
            yield slice(first, first + step), slice(place, place + _AT_ONCE)


def _likelihood(
    rotated: Rotated, size: Array, units: slice, factors: Array | None, nodes: Array
) -> tuple[Array, Array]:
    """Return ln of the posterior density (B, G), and the Cholesky factors of eq. (4)."""
    (count, G), p = nodes.shape, rotated.parameters
    fixed, moving = rotated.fixed[units, None], rotated.moving[units, None]
    times = 1.0 if factors is None else factors[:, :, None]
    weight = 1.0 / (fixed + times * moving + nodes[:, :, None])  # (B, G, N)
    sums = weight @ rotated.products[units]
    both = np.zeros((count, G, p + 1, p + 1))
    first, second = np.triu_indices(p + 1)
    both[:, :, second, first] = sums
    L = np.asarray(np.linalg.cholesky(both), dtype=np.float64)  # of the lower triangle
    logs = np.log(np.einsum("bgpp->bgp", L)[:, :, :p]).sum(axis=2)
    log = 0.5 * (np.log(weight).sum(axis=2) - L[:, :, p, p] ** 2) - logs
    square = weight * weight
    if factors is None:
        log += 0.5 * np.log(square.sum(axis=2))
    else:
        powers = np.stack([np.ones_like(moving), moving, moving**2], axis=-1)[:, 0]
        by_scatter, by_both, by_placement = np.moveaxis(square @ powers, 2, 0)
        determinant = np.maximum(by_scatter * by_placement - by_both**2, 0.0)
        log += 0.5 * np.log(determinant) + np.log(factors)
    return np.asarray(log + np.log(nodes + size[units, None])), L


def _parameters(L: Array) -> tuple[Array, Array]:
    """Return moves and variances (B, G, p) of the parameters, eq. (4)."""
    inverse = _inverted(L[:, :, :-1, :-1])
    moves = np.einsum("qpbg,bgq->bgp", inverse, L[:, :, -1, :-1])
    return moves, np.moveaxis(np.einsum("qpbg,qpbg->pbg", inverse, inverse), 0, 2)


def _inverted(L: Array) -> Array:
    """Return inverses (p, p, B, G) of lower triangles (B, G, p, p), all in step."""
    A = np.ascontiguousarray(np.moveaxis(L, (2, 3), (0, 1)))
    inverse = np.zeros_like(A)
    for i in range(len(A)):
        inverse[i, i] = 1.0 / A[i, i]
        if i:
            inverse[i, :i] = -inverse[i, i] * np.einsum("kbg,kjbg->jbg", A[i, :i], inverse[:i, :i])
    return inverse


class _Units(Protocol):
    """Something of many units (B)."""

    def of(self, units: NDArray[Any], /) -> Self:
        """Return some of the units."""

    def put(self, units: Places, other: Self, /) -> None:
        """Put other units in places of these."""


Place = TypeVar("Place", bound=_Units)
Noise = TypeVar("Noise", bound=_Units)


class Judged(NamedTuple, Generic[Noise]):
    """What a turn finds of the noise of some units, and of which it has settled."""

    posterior: Posterior
    noise: Noise
    settled: NDArray[np.bool_]


class Alternated(NamedTuple, Generic[Place, Noise]):
    """What was found of B units."""

    place: Place
    noise: Noise
    U: Array  # at 95 %, (B, p)
    dof: Array  # (B,)
    sound: NDArray[np.bool_]


def judge_in_turn(
    place: Place,
    noise: Noise,
    sound: NDArray[np.bool_],
    parameters: int,
    judge: Callable[[Places, Place, Noise], Judged[Noise]],
    search: Callable[[Places, Place, Noise], tuple[Place, NDArray[np.bool_]]],
) -> Alternated[Place, Noise]:
    """Judge the noise and search on from there, in turn; `place` and `noise` follow.

    Parameters
    ----------
    place : Place
        Where the searches ended under `noise`.
    noise : Noise
    sound : (B,) array of bool
        The units that are asked.
    parameters : int
        p
    judge, search : callables
        Take units, their places and their noise; the one returns what it finds of the noise, the
        other where searches end under it, and of which units they do.
    """
    U, tail = np.full((len(sound), parameters), np.nan), np.full(len(sound), np.nan)
    sound = sound.copy()
    units = np.flatnonzero(sound)
    for turn in range(ROUNDS):
        if not len(units):
            break
        here = place.of(units)
        posterior, known, settled = judge(units, here, noise.of(units))
        noise.put(units, known)
        following, ended = search(units, here, known)
        place.put(units, following)
        sound[units] &= ended
        going = ~settled & ended & (turn < ROUNDS - 1)
        if not going.all():
            U[units], tail[units] = posterior.centred, posterior.shape
        units = units[going]
    return Alternated(place, noise, U, tail, sound)

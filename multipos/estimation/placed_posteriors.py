"""Scatter and placement of many units at uncertain orientations: their posteriors, all at once.

About its solution the readings of a unit at position k have, as in
`multipos.estimation.placed_scatter`, the marginal covariance

    V_k = Σ_k + τ² I + F s_k² J_k J_k' = U_k diag(a_k + F c_k + τ²) U_k',                   (1)

a matrix in axes U_k that do not move with τ². Where all readings of a position have one variance,
a is that, c_k are s_k² times the eigenvalues of J_k J_k', one of which is zero, and U_k does not
move with F either; elsewhere a_k are the squares of the singular values of (Σ_k^½, s_k J_k), and
F = 1. In these axes the residuals e_k at the listed positions and the design A_k are single numbers
d and rows D of the weights w = 1/(a + F c + τ²), so that at all nodes (τ², F) of a unit

    S = D'wD,   b = D'wd,   q = d'wd,   ln det V = −Σ ln w                                  (2)

are one product of w with the products of D and d, and with the Cholesky factor of
((S, b), (b', q)) the restricted likelihood and the parameters follow as they do there,

    −2 ln L = ln det V + ln det S + q − b'S⁻¹b,    moves S⁻¹b,    variances diag S⁻¹,       (3)

times Jeffreys' prior, (Σ w²)^½ of τ² and (Σ w² Σ w²c² − (Σ w²c)²)^½ F of both.

Where nothing is known of an orientation, only what lies along the normal n of the sphere is left of
a reading: one number a position, with a = n'Σn.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.grids import Both, integrate_grid
from multipos.estimation.placed_scatter import least_factor
from multipos.estimation.posteriors import Found, Posterior, integrate
from multipos.numerics.arrays import Array

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
    """The linear models in the axes of eq. (1), N single numbers a unit, 3 or one a position."""

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
    """Return the linear models in the axes in which eq. (1) is diagonal."""
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
    """What evaluates eq. (3) at nodes of B units, some of them at a time."""

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
    """Return ln of the posterior density (B, G), and the Cholesky factors of eq. (3)."""
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
    """Return moves and variances (B, G, p) of the parameters, eq. (3)."""
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

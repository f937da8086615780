"""The best that positions can do: weights of a continuous design, with their certificate.

`optimise_sphere` returns the best weights over all directions, `optimise_candidates` those on
candidates and `weigh` those on a few hundred, each with its gap. `largest_sensitivity` is max s of
criterion D, `maxima` finds where a function of directions is largest, and `solve_definite` solves
for a positive definite matrix. `gap_of_least` is the certificate of the least eigenvalue.

Weights w on candidate positions, Σ w_k = 1, make a criterion F of `multipos.designs.criteria` as
large as it can be. F is concave, so a solution is known when it is seen: with s its gradient,

    F* − F(w) ≤ max s − 1,                                                                 (1)

Kiefer and Wolfowitz's equivalence theorem as a certificate; the right-hand side is the gap. For D
the efficiency that can be missing is 1 − exp(−gap). E is made smooth, but its certificate is that
of the least eigenvalue itself: no M' has a larger one than tr(G M')/tr G, so that

    λ*_min/λ_min − 1 ≤ max s/(λ_min tr G) − 1.                                              (3)

Weights on a few hundred candidates come from a primal–dual interior-point iteration,

    (−∇²F + diag(z/w)) Δw + ν 1 = s + μ/w,      Σ Δw = 0,      z_k w_k → μ → 0,             (2)

which takes some twenty steps whatever the candidates and, where many designs are best, ends in
their middle, so that symmetry is kept. Among very many candidates, or all directions of the
sphere, only those matter where s is near 1: a small set is solved, the others are priced by s, the
highest join it, and so on until none exceeds 1. The cost of a round is linear in their number.
On the sphere the maxima of s are refined from a grid by Newton's iteration, vectorised.

Rejected: vertex directions and multiplicative weights alone, whose last digits take thousands of
steps; a semidefinite programme, which solves the same problem a hundred times slower.

Sources: J. Kiefer, J. Wolfowitz, Canad. J. Math. 12, 1960; R. Harman, L. Pronzato, Statist. Probab.
Lett. 77, 2007 (which candidates can be left out).
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np

from multipos.designs.criteria import Criterion, kernels, least_eigenvalue, objective, sensitivity
from multipos.designs.information import (
    Blocks,
    Setting,
    inform,
    log_det,
    multiply,
    require_values,
    tangents,
    unit,
)
from multipos.errors import ConvergenceError
from multipos.numerics.arrays import Array, Mask, Places
from multipos.positions.scheme import read_scheme
from multipos.results import frozen

GAP = 1e-7  # certificate asked for: ten times sharper than the one promised
_WORKING = 80  # candidates solved together at the start
_MOST = 200  # candidates solved together at most
_SMALL = 80  # equations up to which BLAS starts no threads
_JOINED = 30  # candidates that join them in a round at most
_NEGLIGIBLE = 1e-9  # weight that is none
_ROUNDS = 20  # one is usual, eleven the most seen
_STEPS = 60  # of the interior point; twenty are usual
_GRID = 2000  # directions that a maximum over the sphere is looked for from
_FINE = 20_000  # directions from which a certificate is confirmed
_MAXIMA = 100  # local maxima of the grid that are climbed
_CLIMBS = 8  # Newton steps
_SAME = 1.0 - 1e-9  # cosine from which two directions are one
_SPECIAL = "all-26+icosahedron-12+dodecahedron-20"


Working = TypeVar("Working", Array, Places)  # directions, or candidates by number


@frozen
class ContinuousOptimum:
    """A continuous design and its certificate.

    Attributes
    ----------
    up : (k, 3) array
        Empty where the candidates are not directions.
    chosen : (k,) array of int
        The candidates that carry weight; empty on the sphere.
    weights : (k,) array
    value, log_det : float
        The criterion, and ln det of the information per position.
    gap : float
        max s − 1, over the candidates or refined over the sphere; of E eq. (3).
    """

    up: Array
    chosen: Places
    weights: Array
    value: float
    log_det: float
    gap: float


def optimise_candidates(rows: Blocks, criterion: Criterion) -> ContinuousOptimum:
    """Return the best weights on candidates whose rows are (n, K, p_b).

    Raises
    ------
    ConvergenceError
        The certificate stays above `GAP`.
    """
    n = len(rows[0])
    start = np.unique(np.linspace(0, n - 1, min(n, _WORKING)).astype(np.intp))
    if log_det(inform(_taken(rows, start))) == -np.inf:
        start = _spread(rows)

    def price(kernel: Blocks) -> tuple[Places, Array]:
        s = sensitivity(rows, kernel)
        highest = np.argpartition(-s, min(_JOINED, n - 1))[:_JOINED]
        return highest, s[highest]

    chosen, weights, reached = _optimise(start, partial(_taken, rows), price, criterion)
    return ContinuousOptimum(np.empty((0, 3)), chosen, weights, *reached)


def optimise_sphere(setting: Setting, criterion: Criterion) -> ContinuousOptimum:
    """Return the best weights over all directions of the sphere.

    Raises
    ------
    ConvergenceError
        The certificate stays above `GAP`.
    MultiposError
        A formula has no value somewhere.
    """

    def price(kernel: Blocks) -> tuple[Array, Array]:
        sensed = partial(_sensed, setting, kernel)
        peaks, heights = maxima(sensed)
        if heights.max() - 1.0 <= GAP:  # before it is said, look closer
            return maxima(sensed, _FINE)
        return peaks, heights

    start = np.concatenate([read_scheme("all-26").up, read_scheme("fibonacci-80").up])
    require_values(setting, setting.rows(start))
    up, weights, reached = _optimise(start, setting.rows, price, criterion)
    return ContinuousOptimum(up, np.empty(0, dtype=np.intp), weights, *reached)


def _optimise(
    working: Working,
    rows_of: Callable[[Working], Blocks],
    price: Callable[[Blocks], tuple[Working, Array]],
    criterion: Criterion,
) -> tuple[Working, Array, tuple[float, float, float]]:
    """Return the candidates that carry weight, it, and value, log_det and gap.

    `price` returns those of highest s of all that there are, and s.
    """
    for _ in range(_ROUNDS):
        rows = rows_of(working)
        weights = weigh(rows, criterion, gap=0.01 * GAP)
        kept = np.flatnonzero(weights > _NEGLIGIBLE)
        working, weights = working[kept], weights[kept] / weights[kept].sum()
        information = inform(_taken(rows, kept), weights)
        kernel = kernels(information, criterion)
        highest, s = price(kernel)
        gap = float(s.max()) - 1.0
        if gap <= GAP:
            if criterion.power:
                gap = gap_of_least(information, kernel, gap)
            return working, weights, (objective(information, criterion), log_det(information), gap)
        joining = highest[s > 1.0][: _MOST // 3]
        heaviest = np.argsort(-weights, kind="stable")[: _MOST - len(joining)]
        working = np.concatenate([working[np.sort(heaviest)], joining])
    raise ConvergenceError(
        f"the best weights are known to a gap of {gap:.1e} only, {GAP:g} was asked; "
        "the model is nearly inseparable on these positions, drop a term."
    )


def gap_of_least(information: Blocks, kernel: Blocks, gap: float) -> float:
    """Return by which part the least eigenvalue may fall short of the best one, eq. (3)."""
    traces = sum(float(np.trace(G)) for G in kernel)
    return (1.0 + gap) / (traces * least_eigenvalue(information)) - 1.0


def largest_sensitivity(setting: Setting, information: Blocks) -> float:
    """Return the largest s(u) of criterion D over the sphere."""
    sensed = partial(_sensed, setting, kernels(information, Criterion("D")))
    return float(maxima(sensed)[1].max())


def _sensed(setting: Setting, kernel: Blocks, up: Array) -> Array:
    return sensitivity(setting.rows(up), kernel)


def weigh(rows: Blocks, criterion: Criterion, *, gap: float) -> Array:
    """Return the best weights (n,) of a few hundred candidates to a gap, by eq. (2)."""
    n = len(rows[0])
    w = np.full(n, 1.0 / n)
    s, curvature = _derivatives(rows, w, criterion)
    z = np.full(n, float(s.max()))
    for _ in range(_STEPS):
        mu = 0.1 * float(z @ w) / n
        curvature[np.arange(n), np.arange(n)] += z / w
        free, level = solve_definite(curvature, np.stack([s + mu / w, np.ones(n)], axis=1)).T
        step = free - level * (free.sum() / level.sum())
        turn = mu / w - z / w * step - z
        w = w + _length(w, step) * step
        z = z + _length(z, turn) * turn
        w /= w.sum()
        s, curvature = _derivatives(rows, w, criterion)
        if s.max() - 1.0 <= gap:
            break
    return w


def solve_definite(A: Array, B: Array) -> Array:
    """Return A⁻¹ B for a positive definite A, by halves: see `_PIECE` in `information`."""
    n = len(A)
    if n <= _SMALL:
        return np.asarray(np.linalg.solve(A, B))
    h = n // 2
    left = solve_definite(A[:h, :h], np.hstack([A[:h, h:], B[:h]]))
    across, first = left[:, : n - h], left[:, n - h :]
    rest = solve_definite(
        A[h:, h:] - multiply(A[h:, :h], across), B[h:] - multiply(A[h:, :h], first)
    )
    return np.concatenate([first - multiply(across, rest), rest])


def _length(x: Array, step: Array) -> float:
    """Return how far a step may go before an entry vanishes."""
    shrinking = step < 0.0
    return min(1.0, 0.95 * float((-x[shrinking] / step[shrinking]).min(initial=np.inf)))


def _derivatives(rows: Blocks, w: Array, criterion: Criterion) -> tuple[Array, Array]:
    """Return the gradient s (n,) and the curvature −∇²F (n, n) along Σ Δw = 0."""
    information = inform(rows, w)
    kernel = kernels(information, criterion)
    s = sensitivity(rows, kernel)
    n = len(w)
    curvature = np.zeros((n, n))
    p = sum(len(M) for M in information)
    for Z, M, G in zip(rows, information, kernel, strict=True):
        k = Z.shape[1]
        flat = Z.reshape(n * k, -1)
        if criterion.power:
            value = objective(information, criterion)
            curvature += _bend_of_least(Z, M, value, criterion.power)
            continue
        plain = multiply(flat, np.asarray(np.linalg.solve(M, flat.T)))
        if criterion.weight is None:
            products = plain**2 / p
        else:
            products = 2.0 * plain * multiply(flat, G @ flat.T)
        curvature += products.reshape(n, k, n, k).sum(axis=(1, 3))
    if criterion.weight is not None or criterion.power:
        curvature -= (criterion.power or 1.0) * np.outer(s, s)
    return s, curvature


def _bend_of_least(Z: Array, M: Array, value: float, power: float) -> Array:
    """Return −Σ_ab g[λ_a, λ_b] (Q'I_kQ)_ab (Q'I_lQ)_ab of one block, for eq. (3) of `criteria`.

    g[,] are the divided differences of g(λ) = λ^(−q−1)/tr M^−q, by logarithms: between equal ones
    they are its slope.
    """
    eigen, Q = np.linalg.eigh(M)
    lower, upper = np.minimum.outer(eigen, eigen), np.maximum.outer(eigen, eigen)
    apart = np.maximum(np.log(upper / lower), 1e-12)
    slopes = np.expm1(-(power + 1.0) * apart) / np.expm1(-apart) / (lower * upper)
    slopes *= np.exp(-power * (np.log(lower) - value))
    turned = Z @ Q
    each = np.einsum("nka,nkb->nab", turned, turned).reshape(len(Z), -1)
    return multiply(each * slopes.ravel(), each.T)


def maxima(function: Callable[[Array], Array], grid_size: int = _GRID) -> tuple[Array, Array]:
    """Return directions (k, 3) where a function of directions has its highest maxima, and them.

    From the highest of a grid's local maxima, and from faces, edges and corners, by Newton's
    iteration with differences; a step that does not rise is not taken, and the next is shorter.
    """
    grid, neighbours = _grid(grid_size)
    values = function(grid)
    summit = np.ones(len(grid), dtype=bool)
    for offset, near in neighbours:
        summit[offset:] &= ~near | (values[offset:] >= values[:-offset])
        summit[:-offset] &= ~near | (values[:-offset] >= values[offset:])
    peaks = np.flatnonzero(summit)
    special = read_scheme(_SPECIAL).up
    up = np.concatenate([special, grid[peaks[np.argsort(-values[peaks])[:_MAXIMA]]]])
    height = function(up)
    reach = np.full(len(up), 0.1)
    h = 1e-3
    for _ in range(_CLIMBS):
        first, second = np.moveaxis(tangents(up), 2, 0)
        around = [
            function(unit(up + h * (a * first + b * second))) - height
            for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1))
        ]
        gradient = np.stack([around[0] - around[1], around[2] - around[3]], axis=1) / (2 * h)
        xx, yy = (around[0] + around[1]) / h**2, (around[2] + around[3]) / h**2
        xy = (around[4] - h * gradient.sum(axis=1)) / h**2 - (xx + yy) / 2.0
        hessian = np.stack([np.stack([xx, xy], 1), np.stack([xy, yy], 1)], 1)
        bend, axes = np.linalg.eigh(hessian)
        along = np.einsum("nij,ni->nj", axes, gradient) / np.maximum(np.abs(bend), 1e-3)
        size = np.maximum(np.linalg.norm(along, axis=1), 1e-300)
        along *= np.minimum(1.0, reach / size)[:, np.newaxis]
        step = np.einsum("nij,nj->ni", axes, along)
        moved = unit(up + step[:, :1] * first + step[:, 1:] * second)
        raised = function(moved)
        better = raised > height
        up, height = np.where(better[:, np.newaxis], moved, up), np.where(better, raised, height)
        reach = np.where(better, reach, 0.2 * np.minimum(reach, size))
    return _apart(up, height)


def _apart(up: Array, height: Array) -> tuple[Array, Array]:
    """Return each maximum once, highest first: several climbs may end on one summit."""
    kept: list[int] = []
    for index in np.argsort(-height, kind="stable").tolist():
        if not kept or (up[kept] @ up[index]).max() < _SAME:
            kept.append(index)
    return up[kept], height[kept]


@lru_cache(maxsize=2)
def _grid(count: int) -> tuple[Array, list[tuple[int, Mask]]]:
    """Return directions on a golden spiral, and its neighbours: by index offsets, where near.

    Neighbours on the spiral are a Fibonacci number of places apart, which one depends on the
    latitude.
    """
    up = read_scheme(f"fibonacci-{count}").up
    spacing = np.cos(3.0 * np.sqrt(np.pi / count))
    offsets = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377)
    near = [np.einsum("ni,ni->n", up[k:], up[:-k]) > spacing for k in offsets]
    return up, list(zip(offsets, near, strict=True))


def _taken(rows: Blocks, chosen: Places) -> Blocks:
    return tuple(Z[chosen] for Z in rows)


def _spread(rows: Blocks) -> Places:
    """Return candidates that determine every parameter: pivots of each block, as QR picks them."""
    chosen = [pivot // Z.shape[1] for Z in rows for pivot in _pivots(Z.reshape(-1, Z.shape[2]))]
    return np.unique(np.array(chosen, dtype=np.intp))


def _pivots(rows: Array) -> list[int]:
    """Return p rows of (n, p), of which each is the longest across those before it."""
    rest, pivots = rows.copy(), []
    for _ in range(rows.shape[1]):
        length = np.linalg.norm(rest, axis=1)
        pivots.append(int(np.argmax(np.round(length, 12))))
        direction = rest[pivots[-1]] / max(float(length[pivots[-1]]), 1e-300)
        rest -= np.outer(rest @ direction, direction)
    return pivots

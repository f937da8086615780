"""The excess variance τ² of readings, and the common factor F on the variances of orientations.

`find_excess` returns τ² of units and `find_both` τ² and F, with the solutions under them.
`contrasts` counts what no orientation error touches, `least_variance` is a variance that changes
nothing, and `sum_of_squares` and `harmonic_mean` are of arrays of units.

Near a solution the readings of a unit are linear in its unknowns θ. With e_k the residuals of
position k at its listed orientation, A_k their slopes by θ, and J_k those by the two angles by
which the orientation may be wrong, each of standard deviation s_k [rad],

    e_k = A_k dθ + error,      V_k = cov error = Σ_k + τ² I + F s_k² J_k J_k'.              (1)

Σ_k is the stated covariance; τ² ≥ 0 is what readings vary by in excess of it, and F scales the
stated variances of the angles. An angle of which nothing is known is eliminated beforehand: only
combinations of the readings count that it does not move, one a position where both are unknown.
V_k is diagonal in axes U_k that do not depend on τ²,

    V_k = U_k diag(a_k + F c_k + τ²) U_k',                                                  (2)

nor on F where all readings of a position have one variance a_k; c_k are then the eigenvalues of
s_k² J_k J_k'. Elsewhere a_k are the squared singular values of (Σ_k^½, F^½ s_k J_k), with c_k = 0.
In these axes e and A become single numbers d and rows D of weight w = 1/(a + F c + τ²), and with P
the prior information of θ and g the prior gradient, at all nodes (τ², F),

    S = D'wD + P,   b = D'wd + g,   q = d'wd,   ln det V = −Σ ln w,                         (3)
    −2 ln L = ln det V + ln det S + q − b'S⁻¹b,                                             (4)

is the restricted likelihood, S⁻¹b the shift of θ and diag S⁻¹ its variances: products of w with
those of D and d, and one Cholesky factor of ((S, b), (b', q)) a node. Jeffreys' prior multiplies
it: the root of tr V⁻² for τ², and for both the root of tr V⁻² tr (V⁻¹C)² − (tr V⁻²C)², C = s²JJ'.
Where all a are equal and parameters have no prior, w is but for its size one of a curve,

    w = w°(z)/v,   w° = 1/(z + (1 − z) c/κ),   v = a + τ² + κF,   z = (a + τ²)/v,           (5)

with κ the largest c, and so are S, b and q. All that is found along it is analytic in ln z but for
Im ln z = ±π, as w° has its poles, and S and q their zeros, at z < 0: a polynomial through few nodes
of Chebyshev then has all the digits there are.

`multipos.estimation.posteriors` integrates. Estimates and noise alternate until the noise has
converged, each unit for itself; a single fit is a batch of one unit.

Source: D. A. Harville, J. Amer. Statist. Assoc. 72, 1977 (restricted likelihood).
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from multipos.estimation.posteriors import Found, Posterior, integrate, integrate_grid
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.levenberg_marquardt import STRICT

ROUNDS = 8  # of noise and estimates
CONVERGED = 1e-4  # relative change of the noise far below its uncertainty
CONVERGED_BOTH = 0.02  # change of a logarithm, where both are known to a tenth of one at best
_NEAR = 1e-8  # of F, from which noise is found again: a step of 1e-4 standard uncertainties
_NOTHING = 1e-4  # of the stated noise, as a variance
_AT_ONCE = 60_000  # weights of all units, so that what they need stays in the cache
_FACTORS = 30_000  # of products that are made at once, so that they stay in cache
_FEWEST = 64  # nodes of a product of matrices
_TOUCHED = 1e-6  # of the largest slope, below which an angle moves nothing
_LEAST = 0.03  # of what orientation errors do to a reading: noise of that size changes nothing
_LEAST_SEPARATED = 1e-3  # the same where readings determine the noise
SEPARATING = 6  # contrasts from which on they do


class Block(NamedTuple):
    """Positions of B units with r numbers each, eq. (1)."""

    error: Array  # e, (B, k, r)
    design: Array  # A, (B, k, r, P)
    spread: Array  # s J, (B, k, r, 2)
    variance: Array  # of Σ, (B, k, r), or Σ itself (B, k, r, r)

    def of(self, units: Any) -> "Block":
        """Return some of the units."""
        return Block(*(each[units] for each in self))

    @property
    def keeps_axes(self) -> bool:
        """Whether the axes of eq. (2) do not depend on F."""
        if self.variance.ndim == 4:
            return False
        return not self.spread.any() or not np.ptp(self.variance, axis=2).any()


class Linear(NamedTuple):
    """Solutions of B units as linear models of their readings."""

    blocks: tuple[Block, ...]
    information: Array | float = 0.0  # P, (P, P)
    gradient: Array | float = 0.0  # g, (P,)
    penalty: float = 0.0  # of the prior where the model is linear
    outer: Array | None = None  # (p, P) parameters as combinations of θ; None: they are θ

    def of(self, units: Any) -> "Linear":
        """Return some of the units."""
        return self._replace(blocks=tuple(block.of(units) for block in self.blocks))

    @property
    def flat(self) -> bool:
        """Whether no parameter has a prior, and θ are the parameters."""
        return self.outer is None and np.ndim(self.information) == 0

    @property
    def spreads(self) -> Array:
        """Sum (B,) of what orientation errors of one sd do to readings, squared."""
        return sum_of_squares(*(block.spread for block in self.blocks))


class _Unmoved(NamedTuple):
    """Combinations of parameters that no orientation error moves: the same at any τ² and F."""

    outer: Array  # parameters as combinations of those that are left, (B, p, P)
    moves: Array  # what these combinations shift parameters by, (B, p)
    variances: Array  # and add to their variances in units of a + τ², (B, p)

    def of(self, units: slice) -> "_Unmoved":
        """Return some of the units."""
        return _Unmoved(*(each[units] for each in self))


class _Rotated(NamedTuple):
    """The linear models in the axes of eq. (2), N single numbers a unit, or so many of a kind."""

    products: Array  # of D and d with each other, (B, N, (P + 1)(P + 2)/2)
    fixed: Array  # a, (B, N)
    moving: Array  # c, (B, N)
    number: Array  # how many each stands for, (N,)
    axes: tuple[Array, ...]  # of each block, (B, k, r, r)
    unmoved: _Unmoved | None = None

    def of(self, units: slice) -> "_Rotated":
        """Return some of the units, for which the axes are no longer asked."""
        return self._replace(
            products=self.products[units],
            fixed=self.fixed[units],
            moving=self.moving[units],
            unmoved=None if self.unmoved is None else self.unmoved.of(units),
        )


def sum_of_squares(*arrays: Array) -> Array:
    """Return the sums of squares (B,) of arrays (B, …) together."""
    flat = (each.reshape(len(each), -1) for each in arrays)
    return np.asarray(sum(np.einsum("bi,bi->b", each, each) for each in flat))


def harmonic_mean(variance: Array) -> Array:
    """Return the harmonic mean (B,) of variances (B, n, M)."""
    return np.asarray(1.0 / np.mean(1.0 / variance, axis=(1, 2)))


class Units(Protocol):
    """B units whose searches have ended, and whose noise is estimated."""

    @property
    def size(self) -> Array:
        """Harmonic mean (B,) of the stated variances."""

    def of(self, units: Places, /) -> Self:
        """Return some of the units."""

    def put(self, units: Places, other: Self, /) -> None:
        """Put other units in places of these."""

    def linear(self) -> Linear:
        """Return the linear models about the solutions, with the stated noise."""

    def squares(self) -> tuple[Array, Array]:
        """Return F under the present noise, and the sum of squared residuals, (B,) each."""

    def searched(self, excess: Array, factor: Array | None, end: float, /) -> tuple[Self, Mask]:
        """Return the units under τ² and F (B,), searched on from here, and which have ended.

        A search ends when its next step takes no more than the part `end` off its objective.
        """


class Estimated(NamedTuple):
    """What is found of the noise of some units."""

    posterior: Posterior
    excess: Array  # τ², (B,)
    converged: Mask
    factor: Array | None = None  # F and the ends of its central 68 %, (3, B)
    end: float = STRICT  # of the search under it


UnitsT = TypeVar("UnitsT", bound=Units)


class Components:
    """Variance components of B units, NaN where none were found.

    Attributes
    ----------
    U : (B, p) array
        Of the parameters at 95 %.
    tails : (B, p) array
        How much wider U is than an inner interval, and `dof` by their median.
    dof : (B,) array
    excess, u : (B,) arrays
        τ², and the standard uncertainty of τ.
    factor, low, high : (B,) arrays
        F, and the ends of its central 68 %; 1 where it was not estimated.
    valid : (B,) array of bool
        Whose searches have ended.
    """

    def __init__(self, valid: Mask, parameters: int) -> None:
        self.valid = valid.copy()
        self.U, self.tails = np.full((2, len(valid), parameters), np.nan)
        self.dof, self.excess, self.u = np.full((3, len(valid)), np.nan)
        self.factor, self.low, self.high = np.ones((3, len(valid)))

    def put(self, units: Places, estimated: Estimated, which: Mask) -> None:
        """Put what is found of `which` of some units in places of `units`."""
        posterior = estimated.posterior.of(which)
        self.U[units], self.tails[units] = posterior.centred, posterior.tails
        self.dof[units] = posterior.shape
        self.excess[units] = estimated.excess[which]
        self.u[units] = estimated.posterior.summary[1][which]
        if estimated.factor is not None:
            self.factor[units], self.low[units], self.high[units] = estimated.factor[:, which]


def find_excess(
    units: UnitsT, valid: Mask, parameters: int, dof: float, *, stated: bool = True
) -> Components:
    """Return the excess variance of units, which follow to the solutions under it.

    Parameters
    ----------
    units : Units
    valid : (B,) array of bool
        The units that are asked.
    parameters : int
        p
    dof : float
        Degrees of freedom, above 0.
    stated : bool
        Σ is stated by the user and may be all there is: τ² = 0 has a probability of its own.
    """
    before = np.zeros(len(valid))

    def estimate(here: Units, places: Places, turn: int) -> Estimated:
        size, last = here.size, before[places]
        objective, squares = here.squares()
        evaluator = _Evaluator(here.linear(), size)
        posterior = integrate(
            evaluator.at_excess, dof, size, (objective * (size + last), squares), stated=stated
        )
        excess = posterior.summary[0]
        before[places] = excess
        converged = np.abs(excess - last) <= CONVERGED * (size + last)
        return Estimated(posterior, excess, converged)

    return _alternate(units, Components(valid, parameters), estimate)


def find_both(
    units: UnitsT,
    valid: Mask,
    parameters: int,
    dof: float,
    *,
    stated: bool = True,
    least: bool = False,
) -> Components:
    """Return excess variance and factor F of units, which follow to the solutions under them.

    Parameters
    ----------
    units, valid, parameters, dof, stated
        As in `find_excess`.
    least : bool
        The stated sds of orientations are the least that they can be: F ≥ 1, and F = 1 has a
        probability of its own.
    """
    before = np.full((2, len(valid)), np.nan)  # no noise before the first round
    ends = np.empty((2, 2, len(valid)))

    def estimate(here: Units, places: Places, turn: int) -> Estimated:
        size, linear = here.size, here.linear()
        spreads = linear.spreads
        errors = [block.error for block in linear.blocks]
        count = sum(each[0].size for each in errors)
        both = integrate_grid(
            _Evaluator(linear, size).at_both,
            dof,
            size,
            sum_of_squares(*errors),
            spreads,
            least=None if least else _NOTHING * size * count / spreads,
            stated=stated,
            near=ends[:, :, places] if turn else None,
        )
        ends[:, :, places] = both.ends
        excess = both.posterior.summary[0]
        now = np.log([size + excess, both.quantiles[0]])
        converged = np.abs(now - before[:, places]).max(axis=0) <= CONVERGED_BOTH
        before[:, places] = now
        # the first round is never the last
        end = STRICT if turn else _NEAR
        return Estimated(both.posterior, excess, converged, both.quantiles, end)

    return _alternate(units, Components(valid, parameters), estimate)


def _alternate(
    units: UnitsT, found: Components, estimate: Callable[[UnitsT, Places, int], Estimated]
) -> Components:
    """Alternate noise and estimates; a unit that has converged is left out of what follows."""
    going = np.flatnonzero(found.valid)
    for turn in range(ROUNDS):
        if not len(going):
            break
        here = units.of(going)
        estimated = estimate(here, going, turn)
        factor = None if estimated.factor is None else estimated.factor[0]
        following, ended = here.searched(estimated.excess, factor, estimated.end)
        units.put(going, following)
        found.valid[going] &= ended
        on = ~estimated.converged & ended & (turn < ROUNDS - 1)
        if (done := ended & ~on).any():
            found.put(going[done], estimated, done)
        going = going[on]
    return found


def least_variance(spreads: Array, values: Array, separated: Mask) -> Array:
    """Return variances (B,) of readings so small that they change nothing.

    Parameters
    ----------
    spreads : (B,) array
        As `Linear.spreads`.
    values : (B, n, M) array
        Readings.
    separated : (B,) array of bool
        Contrasts that no orientation error touches determine the noise.
    """
    part = np.where(separated, _LEAST_SEPARATED, _LEAST)
    rounding = np.finfo(float).eps * np.abs(values).max(axis=(1, 2))
    return np.asarray(np.maximum(part**2 * spreads / values[0].size, rounding**2))


def contrasts(linear: Linear) -> Places:
    """Return how many contrasts (B,) of readings no orientation error touches.

    They alone determine τ²: combinations along the normals of the sphere, less what the
    parameters take of them.
    """
    turned = [_axes_of_errors(block.spread) for block in linear.blocks]
    largest = np.max([moving.max(axis=(1, 2)) for _, moving in turned], axis=0)[:, None, None]
    rows, count = [], np.zeros(len(largest), dtype=np.intp)
    for block, (axes, moving) in zip(linear.blocks, turned, strict=True):
        free = moving <= _TOUCHED**2 * largest
        count += free.sum(axis=(1, 2))
        rows.append(_flat((axes @ block.design) * free[..., None]))
    size = np.sqrt(sum((block.design**2).sum(axis=(1, 2)) for block in linear.blocks))
    left = np.concatenate(rows, axis=1) / np.where(size > 0.0, size, 1.0)[:, None]
    whole = np.isfinite(left).all(axis=(1, 2))
    left[~whole] = 0.0
    return np.asarray(np.where(whole, count - np.linalg.matrix_rank(left), 0))


def _flat(rows: Array) -> Array:
    """Return rows (B, k, r, P) as (B, k r, P)."""
    return rows.reshape(len(rows), -1, rows.shape[3])


def _axes_of_errors(spread: Array) -> tuple[Array, Array]:
    """Return the axes (B, k, r, r), as rows, and eigenvalues (B, k, r) of sJ (sJ)' (B, k, r, 2).

    Of three readings by the angle that makes the two columns orthogonal, so that small
    eigenvalues keep their digits.
    """
    r = spread.shape[2]
    if not spread.any():
        shape = spread.shape[:3]
        return np.broadcast_to(np.eye(r), (*shape, r)), np.zeros(shape)
    if r != 3:
        U, singular, _ = np.linalg.svd(spread)
        values = np.zeros(spread.shape[:3])
        values[..., : singular.shape[2]] = singular**2
        return np.swapaxes(U, 2, 3), values
    first, second = spread[..., 0], spread[..., 1]
    a, d = (np.einsum("bki,bki->bk", each, each) for each in (first, second))
    angle = np.arctan2(2.0 * np.einsum("bki,bki->bk", first, second), a - d) / 2.0
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    one, two = c * first + s * second, c * second - s * first
    large, small = (np.einsum("bki,bki->bk", each, each) for each in (one, two))
    exact = (large == 0.0)[..., None]  # of a position known exactly any axes serve
    one = np.where(exact, [1.0, 0.0, 0.0], one) / np.sqrt(np.where(exact, 1.0, large[..., None]))
    # Of errors along one line, by all the digits there are, any axis across it serves.
    line = (small <= _ROUNDING**2 * large)[..., None]
    away = np.eye(3)[np.abs(one).argmin(axis=2)]
    away = away - np.einsum("bki,bki->bk", one, away)[..., None] * one
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    two = np.where(line, away, two) / np.sqrt(np.where(line, 1.0, small[..., None]))
    values = np.stack([large, small, np.zeros_like(large)], axis=2)
    return np.stack([one, two, np.cross(one, two)], axis=2), values


def _axes(block: Block) -> tuple[Array, Array, Array]:
    """Return the axes of eq. (2) of a block at F = 1, with a and c, (B, k, r) each."""
    if block.keeps_axes:
        axes, moving = _axes_of_errors(block.spread)
        return axes, block.variance, moving
    if block.variance.ndim == 3:
        root = np.sqrt(block.variance)[..., None] * np.eye(block.variance.shape[2])
    else:
        root = np.asarray(np.linalg.cholesky(block.variance), dtype=np.float64)
    both = np.concatenate([root, block.spread], axis=3)
    U, singular, _ = np.linalg.svd(both, full_matrices=False)
    return np.swapaxes(U, 2, 3), singular**2, np.zeros_like(singular)


def _rotated(linear: Linear, *, joined: bool) -> _Rotated:
    """Return the linear models in the axes of eq. (2), at F = 1 where these depend on it.

    Numbers of equal a that no orientation error moves have one weight, and are `joined`. Of
    parameters without a prior, no more are then left than numbers that are moved.
    """
    axes, fixed, moving = zip(*(_axes(block) for block in linear.blocks), strict=True)
    both = (
        np.concatenate([block.design, block.error[..., None]], axis=3) for block in linear.blocks
    )
    rows = [_flat(each @ row) for each, row in zip(axes, both, strict=True)]
    whole = rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1)
    a, c = (
        np.concatenate([each.reshape(len(each), -1) for each in parts], axis=1)
        for parts in (fixed, moving)
    )
    still = (c == 0.0).all(axis=0)
    if not (joined and still.sum() > 1) or np.ptp(a[:, still], axis=1).any():
        return _Rotated(_products(whole), a, c, np.ones(a.shape[1]), axes)
    place, equal, others = np.flatnonzero(still)[:1], whole[:, still], whole[:, ~still]
    count, unmoved = np.append(np.ones(others.shape[1]), float(still.sum())), None
    if linear.flat and others.shape[1] < others.shape[2] - 1:
        equal, others, unmoved = _without_unmoved(equal, others)
    gram = (equal.transpose(0, 2, 1) @ equal)[:, None, *np.triu_indices(others.shape[2])]
    products = np.concatenate([_products(others), gram], axis=1)
    a, c = (np.concatenate([each[:, ~still], each[:, place]], axis=1) for each in (a, c))
    return _Rotated(products, a, c, count, axes, unmoved)


def _products(rows: Array) -> Array:
    """Return the products of the numbers of rows (B, N, P) with each other (B, N, P(P + 1)/2)."""
    first, second = np.triu_indices(rows.shape[2])
    each = rows.reshape(-1, rows.shape[2])
    products, step = np.empty((len(each), len(first))), max(1, _FACTORS // len(first))
    for start in range(0, len(each), step):
        some = each[start : start + step]
        out = products[start : start + step]
        np.multiply(some.take(first, axis=1), some.take(second, axis=1), out=out)
    return products.reshape(*rows.shape[:2], len(first))


def _without_unmoved(still: Array, moving: Array) -> tuple[Array, Array, _Unmoved]:
    """Return rows (D, d) of both kinds without combinations of θ that no error moves, and those.

    In axes Q of θ of which the first q have no part in rows that are `moving` (B, P − q, P + 1),
    those that are `still`, of weight w = 1/(a + τ²), have the triangle ((T, K), (0, L)) for θ, d.
    At any noise the first q follow the others, x, as T⁻¹(K_d − K_D x), with covariance (T'T)⁻¹/w
    about that, and their part of det S is w^q but for a constant. L stands for still rows.
    """
    P = moving.shape[2] - 1
    q = P - moving.shape[1]
    scale = np.linalg.norm(np.concatenate([still, moving], axis=1)[:, :, :P], axis=1)[:, :, None]
    basis = np.linalg.qr(np.swapaxes(moving[:, :, :P], 1, 2) / scale, mode="complete")[0]
    basis = np.roll(basis, q, axis=2) / scale
    rows = np.concatenate([still[:, :, :P] @ basis, still[:, :, P:]], axis=2)
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    own = basis[:, :, :q] @ np.linalg.inv(triangle[:, :q, :q])
    follows = own @ triangle[:, :q, q:]
    unmoved = _Unmoved(
        basis[:, :, q:] - follows[:, :, :-1], follows[:, :, -1], (own**2).sum(axis=2)
    )
    moving = np.concatenate([moving[:, :, :P] @ basis[:, :, q:], moving[:, :, P:]], axis=2)
    return triangle[:, q:, q:], moving, unmoved


class _Terms(NamedTuple):
    """The terms of eq. (4), and the parameters, at nodes (B, G)."""

    log: Array  # −(ln det V + ln det S)/2, with ln of Jeffreys' prior
    square: Array  # q − b'S⁻¹b
    moves: Array  # (B, G, p)
    variances: Array  # (B, G, p)


class _Curve(NamedTuple):
    """The terms along the curve of eq. (5), at K nodes of Chebyshev between two values of ln z."""

    widest: Array  # κ, (B, 1)
    low: Array  # (B, 1)
    high: Array  # (B, 1)
    values: Array  # log, ln of square, moves, ln of variances, and ones, (B, K, 2 p + 3)


class _Evaluator:
    """What evaluates eq. (4) at nodes of B units."""

    def __init__(self, linear: Linear, size: Array) -> None:
        self._linear, self._size = linear, size
        self._keeps_axes = all(block.keeps_axes for block in linear.blocks)
        self._rotated = _rotated(linear, joined=self._keeps_axes)
        self._prior = _prior_products(linear)
        equal = self._keeps_axes and not np.ptp(self._rotated.fixed, axis=1).any()
        self._has_curve = equal and not np.any(self._prior)
        self._curve: _Curve | None = None

    def at_excess(self, nodes: Array, *, whole: bool) -> Found:
        """Return what is found at values of τ² (B, G), of the parameters only if `whole`."""
        rotated, parts = self._rotated, []
        for units, places in _pieces(nodes.shape, len(rotated.number)):
            mine = rotated.of(units)
            tau2 = nodes[units, places]
            weight = 1.0 / ((mine.fixed + mine.moving)[:, None] + tau2[..., None])
            log, square, *parameters = self._likelihood(mine, weight, whole=whole)
            log += 0.5 * (np.log((weight * weight) @ mine.number) - square)
            log += np.log(tau2 + self._size[units, None])
            parts.append((units, places, (log, *parameters)))
        return Found(*_joined(nodes.shape, parts))

    def at_both(self, factors: Array, nodes: Array, *, whole: bool) -> Found:
        """Return what is found at all pairs of τ² (B, G) and F (B, C), F running fastest.

        Of the parameters only if `whole`.
        """
        if not self._keeps_axes:
            return self._with_moving_axes(factors, nodes, whole=whole)
        tau2, F = _pairs(factors, nodes)
        evaluate = self._along_curve if self._has_curve else self._at_pairs
        log, square, *parameters = evaluate(self._rotated, tau2, F, whole=whole)
        log += np.log(F * (tau2 + self._size[:, None])) - 0.5 * square
        return Found(log, *parameters)

    def _at_pairs(self, rotated: _Rotated, tau2: Array, F: Array, *, whole: bool) -> _Terms:
        """Return the terms at τ² and F (B, G)."""
        parts = []
        powers = np.stack([np.ones_like(rotated.moving), rotated.moving, rotated.moving**2], axis=2)
        powers *= rotated.number[:, None]
        for units, places in _pieces(tau2.shape, len(rotated.number)):
            mine = rotated.of(units)
            weight = F[units, places, None] * mine.moving[:, None]
            weight += mine.fixed[:, None]
            weight += tau2[units, places, None]
            np.reciprocal(weight, out=weight)
            terms = self._likelihood(mine, weight, whole=whole)
            terms.log[:] += _prior_of_both(*np.moveaxis((weight * weight) @ powers[units], 2, 0))
            parts.append((units, places, terms))
        return _Terms(*_joined(tau2.shape, parts))

    def _along_curve(self, rotated: _Rotated, tau2: Array, F: Array, *, whole: bool) -> _Terms:
        """Return the terms at τ² and F (B, G) by eq. (5); the first call has the widest range.

        All calls are `whole`, or none is.
        """
        variance = rotated.fixed[:, :1] + tau2
        curve = self._curve = self._curve or self._curve_through(variance, F, whole=whole)
        nodes, signs = _chebyshev(curve.values.shape[1])
        size = variance + curve.widest * F
        x = (2.0 * np.log(variance / size) - curve.low - curve.high) / (curve.high - curve.low)
        found = np.empty((*x.shape, curve.values.shape[2] - 1))
        for units, places in _pieces(x.shape, len(nodes)):
            gaps = x[units, places, None] - nodes
            gaps += _TINY_GAP  # of a node itself
            sums = np.divide(signs, gaps, out=gaps) @ curve.values[units]
            np.divide(sums[..., :-1], sums[..., -1:], out=found[units, places])
        left = rotated.number.sum() - self._linear.blocks[0].design.shape[3]
        log = found[..., 0] - (0.5 * left + 2.0) * np.log(size)  # 2: of the prior
        moves, variances = np.split(found[..., 2:], 2, axis=2)
        variances = size[..., None] * np.exp(variances)
        return _Terms(log, np.exp(found[..., 1]) / size, moves, variances)

    def _curve_through(self, variance: Array, F: Array, *, whole: bool) -> _Curve:
        """Return the curve between the least and the largest z of a + τ² and F (B, G)."""
        rotated = self._rotated
        widest = rotated.moving.max(axis=1, keepdims=True)
        x = np.log(variance / (variance + widest * F))
        low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
        span = high - low
        if not np.isfinite(span).all():
            raise np.linalg.LinAlgError("not positive definite")
        count = 2 + 2 * int(_NEPERS / np.arcsinh(2.0 * np.pi / span.max()) / 2.0)
        x = (low + high + span * _chebyshev(count)[0]) / 2.0
        rotated = rotated._replace(fixed=np.zeros_like(rotated.fixed))
        terms = self._at_pairs(rotated, np.exp(x), -np.expm1(x) / widest, whole=whole)
        log, square, moves, variances = terms
        of_both = np.stack([log, np.log(square)], axis=2)
        ones = np.ones((*x.shape, 1))
        # logarithms, as variances at the two ends may have no digit in common
        variances = np.log(np.maximum(variances, np.finfo(float).tiny))
        values = np.concatenate([of_both, moves, variances, ones], axis=2)
        return _Curve(widest, low, high, values)

    def _with_moving_axes(self, factors: Array, nodes: Array, *, whole: bool) -> Found:
        """Return the same where axes depend on F: unit by unit, the values of F side by side."""
        found = [
            self._of_unit(unit, factors[unit], nodes[unit], whole=whole)
            for unit in range(len(nodes))
        ]
        return Found(*(np.stack(each) for each in zip(*found, strict=True)))

    def _of_unit(self, unit: int, factors: Array, nodes: Array, *, whole: bool) -> Found:
        C, G = len(factors), len(nodes)
        blocks = self._linear.of([unit] * C).blocks
        root = np.sqrt(factors)[:, None, None, None]
        rotated = _rotated(
            Linear(tuple(block._replace(spread=root * block.spread) for block in blocks)),
            joined=False,
        )
        weight = 1.0 / ((rotated.fixed + rotated.moving)[:, None] + nodes[:, None])
        log, left, moves, variances = self._likelihood(rotated, weight, whole=whole)
        sums = np.zeros((3, C, G))
        first = 0
        for block, axes in zip(blocks, rotated.axes, strict=True):
            k, r = block.spread.shape[1:3]
            w = weight[:, :, first : first + k * r].reshape(C, G, k, r)
            turned = axes @ block.spread
            square = (turned @ np.swapaxes(turned, 2, 3)) ** 2  # of each element of C
            sums[0] += np.einsum("bgkr,bgkr->bg", w, w)
            sums[1] += np.einsum("bgkr,bgkr,bkr->bg", w, w, np.sum(turned**2, axis=3))
            sums[2] += np.einsum(
                "bgkr,bgkr->bg", w, np.swapaxes(np.swapaxes(w, 1, 2) @ square, 1, 2)
            )
            first += k * r
        log += np.log(factors[:, None] * (nodes + self._size[unit])) - 0.5 * left
        log += _prior_of_both(*sums)
        shape = (G * C,)
        both = (np.swapaxes(each, 0, 1).reshape(*shape, -1) for each in (moves, variances))
        return Found(log.T.reshape(shape), *both)

    def _likelihood(self, rotated: _Rotated, weight: Array, *, whole: bool) -> _Terms:
        """Return the terms but for the prior, of the parameters only if `whole`."""
        sums = np.swapaxes(rotated.products, 1, 2) @ np.swapaxes(weight, 1, 2)
        sums = np.moveaxis(sums, 1, 0)
        sums += np.reshape(self._prior, (-1, 1, 1))
        sums[-1] *= 1.0 + _ROUNDING  # of residuals that are nothing but rounding
        sums[-1] += _TINY
        R = _triangles(sums)
        logs = np.log(np.einsum("ppbg->pbg", R[:-1, :-1])).sum(axis=0)
        log = 0.5 * (np.log(weight) @ rotated.number) - logs
        unmoved, common = rotated.unmoved, weight[:, :, -1]
        if unmoved is not None:  # its part of ln det S
            p, P = unmoved.outer.shape[1:]
            log -= 0.5 * (p - P) * np.log(common)
        parameters = self._parameters(R, unmoved, common) if whole else np.empty((2, *log.shape, 0))
        return _Terms(log, R[-1, -1] ** 2, *parameters)

    def _parameters(self, R: Array, unmoved: _Unmoved | None, weight: Array) -> tuple[Array, Array]:
        """Return shifts and variances (B, G, p) of the parameters, eq. (4).

        From Cholesky factors R (P + 1, P + 1, B, G), and the weight (B, G) of numbers not moved.
        """
        # (B, P, q, G), S⁻¹ = sum over q of its squares
        inverse = np.transpose(_inverted(R[:-1, :-1]), (2, 1, 0, 3))
        outer = self._linear.outer if unmoved is None else unmoved.outer
        if outer is not None:
            B, P, q, G = inverse.shape
            inverse = (outer @ inverse.reshape(B, P, q * G)).reshape(B, outer.shape[-2], q, G)
        moves = np.einsum("bpqg,qbg->bgp", inverse, R[:-1, -1])
        variances = np.einsum("bpqg,bpqg->bgp", inverse, inverse)
        if unmoved is not None:
            moves += unmoved.moves[:, None]
            variances += unmoved.variances[:, None] / weight[:, :, None]
        return moves, variances


def _joined(
    shape: tuple[int, ...], parts: Sequence[tuple[slice, slice, Sequence[Array]]]
) -> list[Array]:
    """Return arrays (B, G, …) of all units and nodes from those of some of them each."""
    whole = [np.empty((*shape, *each.shape[2:])) for each in parts[0][2]]
    for units, places, found in parts:
        for each, part in zip(whole, found, strict=True):
            each[units, places] = part
    return whole


_NEPERS = 30.0  # to which the polynomial of eq. (5) is exact
_TINY_GAP = 1e-30


@cache
def _chebyshev(count: int) -> tuple[Array, Array]:
    """Return the nodes of a polynomial between −1 and 1, and their barycentric weights."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    return np.cos(angle), np.sin(angle) * (-1.0) ** np.arange(count)


_ROUNDING = 1e-12  # of q, which it is computed to
_TINY = np.finfo(float).tiny


def _prior_products(linear: Linear) -> Array | float:
    """Return what the prior adds to the sums of eq. (3), in the order of `_Rotated.products`."""
    if linear.flat:
        return 0.0
    P = linear.blocks[0].design.shape[3]
    whole = np.zeros((P + 1, P + 1))
    whole[:P, :P], whole[:P, P] = linear.information, linear.gradient
    whole[P, P] = linear.penalty  # constant, but keeps q − b'S⁻¹b positive
    return np.asarray(whole[np.triu_indices(P + 1)])


def _prior_of_both(by_excess: Array, by_both: Array, by_orientation: Array) -> Array:
    """Return ln of Jeffreys' prior of τ² and ln F but for F, from its traces."""
    determinant = np.maximum(by_excess * by_orientation - by_both**2, _TINY)
    return np.asarray(0.5 * np.log(determinant))


def _pairs(factors: Array, nodes: Array) -> tuple[Array, Array]:
    """Return τ² and F at all pairs of nodes (B, G) and factors (B, C), F running fastest."""
    return (
        np.repeat(nodes, factors.shape[1], axis=1),
        np.tile(factors, (1, nodes.shape[1])),
    )


def _pieces(shape: tuple[int, ...], numbers: int) -> Iterator[tuple[slice, slice]]:
    """Yield units and nodes, few enough at a time."""
    (count, nodes), most = shape, max(_FEWEST, _AT_ONCE // numbers)
    step = max(1, most // nodes)
    for first in range(0, count, step):
        for place in range(0, nodes, most):
            yield slice(first, first + step), slice(place, place + most)


def _triangles(sums: Array) -> Array:
    """Return triangles R (P, P, B, G), R'R given by its upper triangle (P(P + 1)/2, B, G).

    All at once, which for so small ones takes a third of the time of one after the other.
    """
    P = int(np.sqrt(2 * len(sums)))
    R = np.zeros((P, P, *sums.shape[1:]))
    for i, rows in enumerate(np.split(sums, np.cumsum(np.arange(P, 1, -1)))):
        left = rows - np.einsum("kjbg,kbg->jbg", R[:i, i:], R[:i, i]) if i else rows
        if not (left[0] > 0.0).all():
            raise np.linalg.LinAlgError("not positive definite")
        R[i, i:] = left / np.sqrt(left[0])
    return R


def _inverted(R: Array) -> Array:
    """Return inverses (P, P, B, G) of the transposes of triangles R (P, P, B, G), all at once."""
    inverse = np.zeros_like(R)
    for i in range(len(R)):
        inverse[i, i] = 1.0 / R[i, i]
        if i:
            inverse[i, :i] = -inverse[i, i] * np.einsum("kbg,kjbg->jbg", R[:i, i], inverse[:i, :i])
    return inverse

"""Integrals over the posterior of an excess variance, alone or with that of orientation errors.

`integrate` returns the posterior of an excess variance and `integrate_grid` that of both variances;
`stated_weight` is the weight of τ² = 0. `standard_uncertainty` is u of U, and `dof_of_tails` the
degrees of freedom of its tails.

With τ² a variance in excess of stated ones of a typical size, the posterior density of
ln(τ² + size) is known at any nodes. It is integrated by the trapezoidal rule, after the range was
narrowed to where the density is not negligible; the stated noise may be all there is, so that
τ² = 0 has a probability of its own, at the first node. Parameters then are a mixture of normal laws
with shifts m_g and variances c_g at the nodes, and

    sum_g w_g [Φ((U − m_g)/√c_g) + Φ((U + m_g)/√c_g) − 1] = 95 %                            (1)

gives U about an estimate.

With orientation errors the variances are Σ + τ² + F s² J J' with stated Σ, s and J, and two unknown
numbers: τ² and the factor F on the squares of the orientation sds
(`multipos.estimation.orientation_variance`). The posterior density of ln(τ² + size) and ln F is
integrated over a grid of both in the same way. The probability of τ² = 0, where noise is stated,
stands in its first row, and that of F = 1, where the stated sds are a lower bound, in its first
column. A first round, about solutions under no noise yet, asks for τ² and F alone; the next take
the range that it found. All of it is done for B units at once, which share nothing but the number
of nodes; a single fit is a batch of one.
"""

import math
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.numerics.quantiles import coverage_factor, coverage_factors, erf
from multipos.results import frozen

_STATED_WEIGHT = 1.4  # weight of τ² = 0, in units of ln V, from six degrees of freedom on
_FEW = 6.0  # degrees of freedom below which that weight must be larger, or U is too long
_RISE = 2.0  # power of 1/ν by which it does
_COVERAGE = 0.95  # at which U and Student's t are made to agree
_INNER = 0.68  # beside it, what tells how heavy the tails are
# Below so many degrees of freedom, so many nodes: a posterior of many is nearly normal, of which
# the trapezoidal rule asks for one node a standard deviation.
_NODES = ((100.0, 48), (1000.0, 32), (math.inf, 24))
_NARROWED = 3  # times that the range is cut to where something is probable
NEGLIGIBLE = 30.0  # of -2 ln: one part in three million of the posterior
_MOST_DOF = 1000.0  # beyond which Student's t is normal to a thousandth
_SHAPES = 64  # steps of degrees of freedom, between which tails are nearly straight
_UNFELT = 1e-60  # of the squares, at which any orientation error is one
_SAME = 1e-9  # relative difference of mixtures that are one
_NEAR = 1e-4  # a step of Halley's method that leaves its cube
_ROOT, _AREA = math.sqrt(2.0), math.sqrt(2.0 * math.pi)
_FAINT = np.finfo(float).tiny  # a density next to none
_LEVEL = 1e-6  # change of a logarithm that is none
_POINT = 1e-12  # of the spread, or of a probability, below which there is none
_AT_ONCE = 10_000  # normal laws of all units, so that what a step needs stays in the cache


class Found(NamedTuple):
    """The posterior density of ln(τ² + size) at nodes (B, G), moves and variances (B, G, p)."""

    log: Array
    moves: Array
    variances: Array


@frozen
class Posterior:
    """The posterior of τ² of B units, and of their parameters.

    Attributes
    ----------
    nodes, weights : (B, G) arrays
        Values of τ² and their probability.
    moves, variances : (B, G, p) arrays
        Shifts of the parameters of all parts at τ², and their variances c; those of one output
        after those of another.
    size : (B,) array
        Harmonic mean of the stated variances: the most precise readings are the first to show τ.
    """

    nodes: Array
    weights: Array
    moves: Array
    variances: Array
    size: Array

    @cached_property
    def summary(self) -> tuple[Array, Array, Array]:
        """τ² whose V is the posterior mean of 1/V, u of τ, and the dof of V, (B,) each."""
        precision = 1.0 / (self.size[:, None] + self.nodes)
        mean = self._mean(precision)
        spread = self._mean((precision - mean[:, None]) ** 2)
        with np.errstate(divide="ignore", over="ignore"):
            dof = 2.0 * mean**2 / spread
        sd = np.sqrt(self.nodes)
        u = np.sqrt(self._mean((sd - self._mean(sd)[:, None]) ** 2))
        return np.maximum(1.0 / mean - self.size, 0.0), u, np.minimum(dof, _MOST_DOF)

    def _mean(self, values: Array) -> Array:
        return np.asarray(np.einsum("bg,bg->b", self.weights, values))

    def of(self, units: Mask | Places) -> "Posterior":
        """Return some of the units."""
        arrays = (self.nodes, self.weights, self.moves, self.variances, self.size)
        return Posterior(*(each[units] for each in arrays))

    def expanded(self, moves: Array) -> Array:
        """Return U (B, p) about estimates that moved by `moves` (B, p), at 95 %."""
        return self._half(moves, _COVERAGE)

    @cached_property
    def centred(self) -> Array:
        """U (B, p) about estimates that did not move, at 95 %."""
        return self.expanded(np.zeros((len(self.size), self.moves.shape[2])))

    def _half(self, moves: Array, share: float) -> Array:
        means = self.moves - moves[:, None]
        return _half_interval(means, np.sqrt(self.variances), self.weights, share)

    @property
    def shape(self) -> Array:
        """Degrees of freedom (B,) of the Student's t whose tails are those of the parameters."""
        return dof_of_tails(median(self.tails, axis=1))

    @cached_property
    def tails(self) -> Array:
        """How much wider (B, p) U is than an inner interval."""
        moves = np.zeros((len(self.size), self.moves.shape[2]))
        return np.asarray(self.centred / self._half(moves, _INNER))


def stated_weight(dof: float) -> float:
    """Return the weight of τ² = 0 at so many degrees of freedom, in units of ln V."""
    return float(_STATED_WEIGHT * max(_FEW / dof, 1.0) ** _RISE)


class EvaluateExcess(Protocol):
    """What knows the posterior density at values of τ² (B, G)."""

    def __call__(self, nodes: Array, *, whole: bool) -> Found:
        """Return it; shifts and variances of parameters if `whole`."""


def integrate(
    evaluate: EvaluateExcess,
    dof: float,
    size: Array,
    squares: tuple[Array, Array],
    *,
    stated: bool = True,
) -> Posterior:
    """Return the posterior of an excess variance, and of parameters.

    Parameters
    ----------
    evaluate : EvaluateExcess
    dof : float
        Degrees of freedom, above 0.
    size : (B,) array
        Typical stated variance.
    squares : tuple of two (B,) arrays
        Sums of squared residuals that bracket how noisy readings can be.
    stated : bool
        The stated variance may be all there is, and is not only where the search ends.
    """
    least = np.minimum(*squares) / (dof + 10.0 * np.sqrt(dof) + 30.0)
    # Large V are unlikely as V^(−ν/2); a tail of 1e-6 is cut off.
    low = np.log(np.maximum(size, least))
    high = np.log(np.maximum(np.maximum(*squares), size))
    high = high + 28.0 / dof + min(0.5, 10.0 / np.sqrt(dof))
    count = next(nodes for most, nodes in _NODES if dof < most)
    searched = np.ones(len(size), dtype=np.bool_)
    for _ in range(_NARROWED):
        x = np.linspace(low, high, count // 2, axis=1)
        log = evaluate(_nodes(x, size), whole=False).log
        probable = log > log.max(axis=1, keepdims=True) - NEGLIGIBLE / 2.0
        first, last = _ends(x, probable)
        low, high = np.where(searched, first, low), np.where(searched, last, high)
        searched &= 4 * probable.sum(axis=1) <= count // 2
        if not searched.any():
            break
    x = np.linspace(low, high, count, axis=1)
    nodes = np.concatenate([np.zeros((len(size), 1)), _nodes(x, size)], axis=1)
    found = evaluate(nodes, whole=True)
    log = found.log[:, 1:]
    top = (found.log if stated else log).max(axis=1, keepdims=True)
    weights = np.exp(log - top) * (x[:, 1:2] - x[:, :1])
    weights[:, [0, -1]] /= 2.0
    at_stated = np.zeros_like(top)
    if stated:
        at_stated = stated_weight(dof) * np.exp(found.log[:, :1] - top)
    weights = np.concatenate([at_stated, weights], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    return Posterior(nodes, weights, found.moves, found.variances, size)


def _nodes(x: Array, size: Array) -> Array:
    return np.asarray(np.maximum(np.exp(x) - size[:, None], 0.0))


def _ends(x: Array, probable: Mask) -> tuple[Array, Array]:
    """Return the nodes (B,) outside of which the density is negligible."""
    rows, count = np.arange(len(x)), x.shape[1]
    first = np.argmax(probable, axis=1)
    last = count - 1 - np.argmax(probable[:, ::-1], axis=1)
    return x[rows, np.maximum(first - 1, 0)], x[rows, np.minimum(last + 1, count - 1)]


def _half_interval(means: Array, sds: Array, weights: Array, share: float) -> Array:
    """Return half the intervals (B, p) about zero that hold a share of mixtures (B, G, p)."""
    shape = sds / sds[:, :1]
    if np.ptp(shape, axis=2).max() > _SAME or (np.abs(means) > _SAME * sds).any():
        return _search_half(means, sds, weights, share)
    # where all stated variances are equal, all mixtures are one but for their size
    one = _search_half(means[:, :, :1], sds[:, :, :1], weights, share)
    return np.asarray(one * sds[:, 0] / sds[:, 0, :1])


def _search_half(means: Array, sds: Array, weights: Array, share: float) -> Array:
    count, nodes, p = means.shape
    step = max(1, _AT_ONCE // (nodes * p))
    some = [slice(first, first + step) for first in range(0, count, step)]
    return np.concatenate([_halley(means[k], sds[k], weights[k], share) for k in some])


def _halley(means: Array, sds: Array, weights: Array, share: float) -> Array:
    """Search from the interval of a normal law of the same spread, in units of that spread.

    The first step leads only to its cube, for which single precision does.
    """
    spread = np.sqrt(np.einsum("bg,bgp->bp", weights, sds * sds + means * means))
    sds = np.maximum(sds, _POINT * spread[:, None])
    precision = spread[:, None] / sds
    mixture = means / sds, precision, weights
    low = np.zeros(spread.shape)
    high = 2.0 * np.max((np.abs(mixture[0]) + 2.0) / precision, axis=1)
    guess = np.full(spread.shape, coverage_factor(share, math.inf))
    for trial in range(60):
        kind = np.dtype(np.float64 if trial else np.float32)
        inside, density, falls = _mixed(guess, *(np.asarray(each, kind) for each in mixture))
        low = np.where(inside < share, guess, low)
        high = np.where(inside < share, high, guess)
        density = np.maximum(density, 1e-30)
        step = (share - inside) * _AREA / density
        following = guess + step / (1.0 - 0.5 * step * falls / density)
        near = np.abs(following - guess) <= _NEAR * guess
        bad = ~near & ~((following > low) & (following < high))
        following = np.where(bad, 0.5 * (low + high), following)
        if trial and near.all():
            break
        guess = following
    return np.asarray(following * spread)


def _mixed(half: Array, means: Array, precision: Array, weights: Array) -> tuple[Array, ...]:
    """Return what lies within ±half (B, p), its density and how this falls, by √2π the larger.

    Of normal laws (B, G, p) with these precisions, 1/sd, and means over their sds.
    """
    middle = half[:, None].astype(means.dtype) * precision
    above, below = middle - means, middle + means
    normal = [np.exp(-0.5 * z * z) for z in (above, below)]
    covered = erf(above / _ROOT, normal[0]) + erf(below / _ROOT, normal[1])
    density = (normal[0] + normal[1]) * precision
    falls = (above * normal[0] + below * normal[1]) * precision**2
    of_half, *others = (
        np.einsum("bg,bgp->bp", weights, each) for each in (covered, density, falls)
    )
    return of_half / 2.0, *others


def dof_of_tails(ratios: Array) -> Array:
    """Return the degrees of freedom (k,) of the t whose outer interval is so much the wider."""
    return np.array([_dof_of_tail(each) for each in ratios.tolist()])


def _dof_of_tail(ratio: float) -> float:
    low, high = 0, _SHAPES
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _tail(middle) > ratio else (low, middle)
    share = (_tail(low) - ratio) / (_tail(low) - _tail(high))
    return float(_MOST_DOF ** ((low + min(max(share, 0.0), 1.0)) / _SHAPES))


def _tail(step: int) -> float:
    """Return how much wider the outer interval is than the inner one, at a step of dof."""
    dof = _MOST_DOF ** (step / _SHAPES)
    return coverage_factor(_COVERAGE, dof) / coverage_factor(_INNER, dof)


def standard_uncertainty(expanded: Array, dof: Array) -> Array:
    """Return u = U/k of U at 95 % with degrees of freedom, arrays of one shape."""
    return np.asarray(expanded / coverage_factors(_COVERAGE, dof))


_COARSE, _FINE = 12, 18  # nodes a side
_BEYOND = 18.0  # of -2 ln, to which a grid of both reaches: 4.2 standard deviations
_SHARES = np.array([[0.5], [0.16], [0.84]])
_WIDENED = 0.1  # of a range found before, to either side, as it may have moved


@frozen
class Both:
    """The posterior of excess variance and orientation errors of B units.

    Attributes
    ----------
    posterior : Posterior
        Of τ² and the parameters, over the nodes of both.
    factors : (B, C) array
        The values of F, from small to large, equally far apart in ln F.
    density : (B, C) array
        Probability between two nodes of ln F, were it everywhere that at the node.
    at_least : (B,) array
        Probability of the least F by itself.
    ends : (2, 2, B) array
        Where ln(τ² + size) and ln F begin and end to be probable.
    """

    posterior: Posterior
    factors: Array
    density: Array
    at_least: Array
    ends: Array

    @cached_property
    def quantiles(self) -> Array:
        """The posterior median of F and the ends of its central 68 %, (3, B).

        The logarithm of its density in ln F is straight between nodes.
        """
        density = np.maximum(self.density, _FAINT)
        rise = np.diff(np.log(density), axis=1)
        rise = np.where(np.abs(rise) < _LEVEL, _LEVEL, rise)
        part = density[:, :-1] * np.expm1(rise) / rise
        part *= (1.0 - self.at_least[:, None]) / part.sum(axis=1, keepdims=True)
        below = self.at_least[:, None] + np.cumsum(part, axis=1)
        at = (below < _SHARES[..., None]).sum(axis=2).clip(max=part.shape[1] - 1)
        rows = np.arange(len(part))
        missing = (below[rows, at] - _SHARES) / part[rows, at]
        rise, low, high = rise[rows, at], self.factors[rows, at], self.factors[rows, at + 1]
        fraction = np.log1p(np.clip(1.0 - missing, 0.0, 1.0 - _POINT) * np.expm1(rise)) / rise
        return np.asarray(low * (high / low) ** fraction)


class Evaluate(Protocol):
    """What knows the posterior density at all pairs of factors (B, C) and values of τ² (B, G)."""

    def __call__(self, factors: Array, nodes: Array, *, whole: bool) -> Found:
        """Return it, factors running fastest; shifts and variances of parameters if `whole`."""


def integrate_grid(
    evaluate: Evaluate,
    dof: float,
    size: Array,
    squares: Array,
    slopes: Array,
    *,
    least: Array | None,
    stated: bool,
    near: Array | None = None,
) -> Both:
    """Return the posterior of excess variance and orientation errors, and of parameters if `near`.

    Parameters
    ----------
    evaluate : Evaluate
    dof : float
        Degrees of freedom, above 0.
    size : (B,) array
        Typical stated variance.
    squares : (B,) array
        Sum of squared residuals at the listed positions.
    slopes : (B,) array
        Sum of squared changes of the readings by orientation errors of one sd.
    least : (B,) array or None
        The smallest factor of the grid; None: the orientation sds are a lower bound, and may be
        right, as the noise is.
    stated : bool
        The stated noise may be all there is.
    near : (2, 2, B) array or None
        `Both.ends` about the solutions before these.
    """
    count, most = len(size), squares + size
    tail = 28.0 / dof + 0.5
    bottom = np.zeros(count) if least is None else np.log(least)
    felt = np.maximum(slopes, _UNFELT * most)
    x_ends = np.log(size), np.log(most) + tail
    y_ends = bottom, np.maximum(np.log(most / felt), bottom) + tail
    widest = np.array([x_ends, y_ends])
    ends = widest
    if near is not None:
        wider = _WIDENED * np.diff(near, axis=1) * [[-1.0], [1.0]]
        around = np.clip(near + wider, widest[:, :1], widest[:, 1:])
        ends = np.where(np.diff(around, axis=1) > _LEVEL, around, widest)
    for side in (_COARSE, _COARSE, _FINE) if near is None else (_FINE,):
        x, y = (np.linspace(low, high, side, axis=1) for low, high in ends)
        tau2 = np.concatenate([np.zeros((count, int(stated))), _nodes(x, size)], axis=1)
        found = evaluate(np.exp(y), tau2, whole=near is not None)
        log = found.log.reshape(count, -1, side)
        ends = np.array([_probable(x, log[:, -side:].max(axis=2)), _probable(y, log.max(axis=1))])
    dx, dy = (each[:, 1] - each[:, 0] for each in (x, y))
    weights = np.exp(log - log.max(axis=(1, 2), keepdims=True)) * dx[:, None, None]
    weights[:, [-side, -1]] /= 2.0
    if stated:
        weights[:, 0] *= stated_weight(dof) / dx[:, None]
    density = weights.sum(axis=1)
    weights[:, :, [0, -1]] /= 2.0
    at_least = np.zeros(count)
    if least is None:
        at_stated = np.where(y[:, 0] == 0.0, stated_weight(dof) / dy, 0.0)
        weights[:, :, 0] *= 1.0 + 2.0 * at_stated[:, None]
        at_least = at_stated * density[:, 0]
    total = weights.sum(axis=(1, 2))
    weights /= total[:, None, None]
    nodes = np.repeat(tau2, side, axis=1)
    posterior = Posterior(nodes, weights.reshape(count, -1), found.moves, found.variances, size)
    return Both(posterior, np.exp(y), density / total[:, None], at_least / total, ends)


def _probable(x: Array, log: Array) -> tuple[Array, Array]:
    """Return the ranges (B,) of nodes where something is probable, and one more to either side."""
    return _ends(x, log > log.max(axis=1, keepdims=True) - _BEYOND / 2.0)

"""The posterior of scatter and placement together, over a grid of both, of B units at once.

Readings have the variances Σ + τ² + F s² J J' with stated Σ, s and J, and two numbers that nobody
stated: the scatter τ² and the factor F on the squares of the orientation sds
(`multipos.estimation.placed_scatter`). The posterior density of ln(τ² + size) and ln F is known at
any nodes; it is integrated by the trapezoidal rule over a grid that was narrowed to where something
is probable. What a claim that τ² = 0 weighs stands in the first row of the grid, and what one that
F = 1 weighs in its first column. What is left of parameters is that of
`multipos.estimation.posteriors`. A single fit is a batch of one.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from multipos.estimation.posteriors import NEGLIGIBLE, Found, Posterior, belief
from multipos.numerics.arrays import Array

_COARSE, _FINE = 16, 24  # nodes a side
_NARROWED = 3  # times


@dataclass(frozen=True, eq=False)
class Both:
    """The posterior of scatter and placement of B units.

    Attributes
    ----------
    posterior : Posterior
        Of τ² and the parameters, over the nodes of both.
    factors : (B, C) array
        The values of F, from small to large.
    weights : (B, C) array
        Their probability.
    """

    posterior: Posterior
    factors: Array
    weights: Array

    @property
    def factor(self) -> Array:
        """The posterior median of F (B,)."""
        return self._quantile(0.5)

    @property
    def span(self) -> tuple[Array, Array]:
        """The central 68 % of F, (B,) each."""
        return self._quantile(0.16), self._quantile(0.84)

    def _quantile(self, share: float) -> Array:
        total = np.cumsum(self.weights, axis=1)
        place = np.minimum((total < share).sum(axis=1), total.shape[1] - 1)
        return np.asarray(self.factors[np.arange(len(place)), place])


class Evaluate(Protocol):
    """What knows the posterior density at factors and values of τ², (B, G) each."""

    def __call__(self, factors: Array, nodes: Array, *, whole: bool) -> Found:
        """Return it, with moves and variances of the parameters if `whole`."""


def integrate_grid(
    evaluate: Evaluate,
    dof: float,
    size: Array,
    squares: Array,
    slopes: Array,
    *,
    least: Array | None,
    believed: bool,
) -> Both:
    """Return the posterior of scatter, placement and parameters.

    Parameters
    ----------
    evaluate : Evaluate
    dof : float
        Degrees of freedom, above 0.
    size : (B,) array
        Of the floors.
    squares : (B,) array
        Sum of squared residuals at the listed positions.
    slopes : (B,) array
        Sum of the squares of what a turn by its sd does to each position.
    least : (B,) array or None
        The smallest factor that is looked at; None: the orientation sds are a floor and a claim,
        as the noise is.
    believed : bool
        The stated noise may be all there is.
    """
    count, whole = len(size), squares + size
    tail = 28.0 / dof + 0.5
    x_ends = np.log(size), np.log(whole) + tail
    bottom = np.zeros(count) if least is None else np.log(least)
    y_ends = bottom, np.maximum(np.log(whole / slopes), bottom) + tail
    for side in (*[_COARSE] * _NARROWED, _FINE):
        x, y = np.linspace(*x_ends, side, axis=1), np.linspace(*y_ends, side, axis=1)
        tau2 = np.concatenate(
            [np.zeros((count, 1)), np.maximum(np.exp(x) - size[:, None], 0.0)], axis=1
        )
        nodes, factors = np.repeat(tau2, side, axis=1), np.tile(np.exp(y), (1, side + 1))
        found = evaluate(factors, nodes, whole=side == _FINE)
        log = found.log.reshape(count, side + 1, side)
        x_ends = _told(x, log[:, 1:].max(axis=2))
        y_ends = _told(y, log.max(axis=1))
    dx, dy = (each[:, 1] - each[:, 0] for each in (x, y))
    weights = np.exp(log - log.max(axis=(1, 2), keepdims=True)) * dx[:, None, None]
    weights[:, [1, -1]] /= 2.0
    weights[:, 0] *= believed * belief(dof) / dx[:, None]
    weights[:, :, [0, -1]] /= 2.0
    if least is None:
        claimed = belief(dof) / dy[:, None] * weights[:, :, 0] * 2.0
        weights[:, :, 0] += np.where(y[:, :1] == 0.0, claimed, 0.0)
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    posterior = Posterior(nodes, weights.reshape(count, -1), found.moves, found.variances, size)
    return Both(posterior, np.exp(y), weights.sum(axis=1))


def _told(x: Array, log: Array) -> tuple[Array, Array]:
    """Return the ranges (B,) of nodes where something is probable, and one more to either side."""
    told = log > log.max(axis=1, keepdims=True) - NEGLIGIBLE / 2.0
    rows, last = np.arange(len(x)), x.shape[1] - 1
    first = np.maximum(np.argmax(told, axis=1) - 1, 0)
    final = np.minimum(last - np.argmax(told[:, ::-1], axis=1) + 1, last)
    return x[rows, first], x[rows, final]

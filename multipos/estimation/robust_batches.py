"""Robust fits of many units at known orientations, which read their noise from the residuals.

Each output of each unit goes the way of `multipos.estimation.robustness`, all of them in step: from
the plain fit by the search of `multipos.estimation.robust_search` under Huber's loss with a noise
of any size, then with one for which the median of q is that of the normal law, in turn until that
settles, and last under the loss that was asked for.

A unit is left to `fit` where a search has not ended, and where a position is beyond doubt, so that
it is set aside by name.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import (
    ROUNDING,
    Estimates,
    SharedDesign,
    fit_output,
    join_estimates,
    rms_of,
)
from multipos.estimation.losses import Loss, loss_slope, loss_weight
from multipos.estimation.problem import RELATIVE_NOISE
from multipos.estimation.robust_search import Ended, Linear, search_linear
from multipos.estimation.robustness import BEYOND_DOUBT, FINEST, ROUNDS, SETTLED, huber_factors
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.numerics.quantiles import chi2_quantile

_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_HUBER: Loss = "huber"  # under which the noise is found, whatever the loss


def estimate_robust(shared: SharedDesign, values: Sequence[Array], name: Loss) -> Estimates:
    """Fit B units under a robust loss.

    Parameters
    ----------
    shared : SharedDesign
    values : sequence of M arrays (B, n)
        Readings of each output.
    name : str
        Of the loss.
    """
    count, n = values[0].shape
    step = max(1, _AT_ONCE // n)
    with np.errstate(all="ignore"):  # a unit may run away, and is then left out
        parts = [
            _estimate(shared, [y[first : first + step] for y in values], name)
            for first in range(0, count, step)
        ]
    return join_estimates(parts)


class _Worth(NamedTuple):
    """One output of B units."""

    parameters: Array  # (B, p)
    u: Array  # (B, p)
    dof: Array  # (B,)
    residuals: Array  # (B, n)
    plain: Array  # of the plain fit, (B, n)
    sound: NDArray[np.bool_]


def _estimate(shared: SharedDesign, values: Sequence[Array], name: Loss) -> Estimates:
    given = zip(shared.designs, shared.inverses, shared.cofactors, values, strict=True)
    found = [_fit(*each, name) for each in given]
    parameters = np.concatenate([each.parameters for each in found], axis=1)
    u = np.concatenate([each.u for each in found], axis=1)
    dof = np.concatenate([np.broadcast_to(each.dof[:, None], each.u.shape) for each in found], 1)
    rms, inverse, inverted = rms_of(shared, parameters, values, [each.residuals for each in found])
    sound = inverted & (np.abs(parameters).max(axis=1) <= LARGEST)
    sound &= np.all([each.sound for each in found], axis=0)
    plain = tuple(each.plain for each in found)
    return Estimates(parameters, u, dof, rms, plain, inverse, sound)


def _fit(design: Array, inverse: Array, cofactor: Array, y: Array, name: Loss) -> _Worth:
    """Fit one output of B units."""
    n, p = design.shape
    b, r = fit_output(design, inverse, y)
    linear = Linear(design, b, r)
    sound = np.einsum("bn,bn->b", r, r) > ROUNDING**2 * np.einsum("bn,bn->b", y, y)
    spread = np.mean((y - y.mean(axis=1, keepdims=True)) ** 2, axis=1)
    variance = np.tile(RELATIVE_NOISE**2 * spread[:, None], n)
    ended = search_linear(linear, np.zeros_like(b), variance, np.flatnonzero(sound), _HUBER)
    ended = _settle_noise(linear, ended, variance, (FINEST * np.abs(y).max(axis=1)) ** 2)
    q = ended.residuals**2 / variance
    sound = ended.converged & (q.max(axis=1) <= chi2_quantile(1.0 - BEYOND_DOUBT, 1.0))
    if name != _HUBER:
        ended = search_linear(linear, ended.moves, variance, np.flatnonzero(sound), name)
        sound = ended.converged
        q = ended.residuals**2 / variance
    weight = loss_weight(name, q, linear.degrees)
    counted = np.maximum(weight.sum(axis=1) - p, 1.0)
    factor = huber_factors(q, linear.degrees, weight, loss_slope(name, q, linear.degrees), counted)
    u = np.sqrt(cofactor * (variance[:, 0] * factor)[:, None])
    return _Worth(b + ended.moves, u, counted, ended.residuals, r, sound)


def _settle_noise(linear: Linear, ended: Ended, variance: Array, finest: Array) -> Ended:
    """Return where searches end under the noise of the median q; `variance` follows."""
    n, p = linear.design.shape
    typical = chi2_quantile(0.5, 1.0)
    converged = ended.converged.copy()
    units = np.flatnonzero(converged)
    for _ in range(ROUNDS):
        if not len(units):
            break
        q = ended.residuals[units] ** 2 / variance[units]
        ratio = median(q / typical, axis=1) * n / (n - p)
        ratio = np.maximum(ratio, finest[units] / variance[units, 0])
        variance[units] *= ratio[:, None]
        ended = search_linear(linear, ended.moves, variance, units, _HUBER)
        converged[units] = ended.converged[units]
        units = units[(np.abs(np.log(ratio)) >= SETTLED) & converged[units]]
    return ended._replace(converged=converged)

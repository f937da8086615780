"""Robust losses: how much a position far from the others still counts.

`loss` returns rho of squared misfits, `loss_weight` how much each position counts, `loss_slope`
what scales the covariance, and `counted` how many degrees of freedom the weights leave.

With q the squared, standardised misfit of a position and m its degrees of freedom, z² = q/m and
the tuning constant c of each loss (95 % efficiency under the normal law),

    huber     rho = q                          for z <= c,   m (2 c z − c²)  beyond,        (1)
    soft-l1   rho = 2 m c² (sqrt(1 + z²/c²) − 1),                                           (2)
    cauchy    rho = m c² ln(1 + z²/c²),                                                     (3)

and the weight is the derivative d rho / d q. Without a loss rho = q.

References
----------
P. J. Huber, *Robust Statistics*, 1981; Z. Zhang 1997, *Parameter estimation techniques*, table 1
(the constants).
"""

from typing import Literal

import numpy as np

from multipos.numerics.arrays import Array

EFFICIENCY = 0.95  # of each loss at its constant, under the normal law
Loss = Literal["huber", "soft-l1", "cauchy"]
LOSSES: dict[Loss, float] = {"huber": 1.345, "soft-l1": 1.345, "cauchy": 2.385}
_USUAL: dict[Loss, float] = {"huber": 0.9599, "soft-l1": 0.8507, "cauchy": 0.8774}  # mean weight


def loss(name: Loss | None, q: Array, degrees: Array) -> Array:
    """Return rho (n,) of squared misfits q (n,) with `degrees` of freedom each."""
    if name is None:
        return q
    c2 = degrees * LOSSES[name] ** 2
    if name == "huber":
        return np.where(q <= c2, q, 2.0 * np.sqrt(c2 * np.maximum(q, c2)) - c2)
    if name == "soft-l1":
        # as it stands in (2), small q would cancel
        return np.asarray(2.0 * q / (1.0 + np.sqrt(1.0 + q / c2)))
    return np.asarray(c2 * np.log1p(q / c2))


def loss_slope(name: Loss | None, q: Array, degrees: Array) -> Array:
    """Return the slope psi' (n,) of psi(z) = z rho'(z²), which scales the covariance."""
    if name is None:
        return np.ones_like(q)
    x = q / (degrees * LOSSES[name] ** 2)
    if name == "huber":
        return np.where(x <= 1.0, 1.0, 0.0)
    if name == "soft-l1":
        return np.asarray((1.0 + x) ** -1.5)
    return np.asarray((1.0 - x) / (1.0 + x) ** 2)


def loss_weight(name: Loss | None, q: Array, degrees: Array) -> Array:
    """Return d rho / d q (n,): 1 for a position that fits, less for one that does not."""
    if name is None:
        return np.ones_like(q)
    c2 = degrees * LOSSES[name] ** 2
    if name == "huber":
        return np.sqrt(c2 / np.maximum(q, c2))
    if name == "soft-l1":
        return np.asarray(1.0 / np.sqrt(1.0 + q / c2))
    return np.asarray(1.0 / (1.0 + q / c2))


def counted(name: Loss, weight: Array, degrees: Array) -> Array:
    """Return how many degrees of freedom weights (…, n) leave, in units of what Huber's would.

    Under the normal law the mean weight of others is smaller, of positions that all fit.
    """
    share = _USUAL["huber"] / _USUAL[name]
    return np.asarray(np.minimum(share * np.sum(weight * degrees, axis=-1), degrees.sum()))

"""Control charts of one number of units in their order: individual values and their EWMA.

- `judge_control` returns what a chart says of values.
- `individual_limits`, `ewma_limits` and `ewma` are its parts.

With the moving range R_t = |x_t − x_{t−1}| and d₂ = 2/√π, of two normal values,

    centre x̄,    limits x̄ ± 3 mean(R)/d₂                                                    (1)

of individual values; what is slow does not widen them, as it does a standard deviation. Small moves
that last show in z_t = λ x_t + (1 − λ) z_{t−1}, z_0 the target, with the limits

    target ± 3 s √(λ/(2 − λ)).                                                              (2)

Sources: NIST/SEMATECH e-Handbook of Statistical Methods, sections 6.3.2.2 and 6.3.2.4.
"""

from typing import Any, NamedTuple

import numpy as np

from multipos.numerics.arrays import Array

_D2 = 2.0 / np.sqrt(np.pi)
_SIGMAS = 3.0
_NOTHING = 1e-17  # weight of values that lie too far back to be seen
WEIGHT = 0.3  # λ: a move of one standard deviation shows after ten units


class Limits(NamedTuple):
    """Centre and control limits."""

    centre: float
    lcl: float
    ucl: float


def individual_limits(values: Array) -> Limits:
    """Return centre and limits of individual values (n,), eq. (1)."""
    centre = float(np.mean(values))
    half = _SIGMAS * float(np.mean(np.abs(np.diff(values)))) / _D2
    return Limits(centre, centre - half, centre + half)


def ewma(values: Array, target: float, weight: float = WEIGHT) -> Array:
    """Return the exponentially weighted moving average (n,) of values, from a target on."""
    length = min(len(values), int(np.ceil(np.log(_NOTHING) / np.log1p(-weight))))
    kernel = weight * (1.0 - weight) ** np.arange(length)
    return np.asarray(target + np.convolve(values - target, kernel)[: len(values)])


def ewma_limits(target: float, sd: float, weight: float = WEIGHT) -> Limits:
    """Return the limits of an EWMA in the long run, eq. (2)."""
    half = _SIGMAS * sd * np.sqrt(weight / (2.0 - weight))
    return Limits(target, target - half, target + half)


def judge_control(values: Array) -> dict[str, Any]:
    """Return the limits of values (n,) in their order, and how many are beyond either chart's."""
    limits = individual_limits(values)
    sd = (limits.ucl - limits.centre) / _SIGMAS
    slow = ewma_limits(limits.centre, sd)
    smooth = ewma(values, limits.centre)
    beyond = (values < limits.lcl) | (values > limits.ucl)
    drifted = (smooth < slow.lcl) | (smooth > slow.ucl)
    return {
        "centre": limits.centre,
        "lcl": limits.lcl,
        "ucl": limits.ucl,
        "beyond": int(beyond.sum()),
        "ewma_lcl": slow.lcl,
        "ewma_ucl": slow.ucl,
        "ewma_beyond": int(drifted.sum()),
    }

"""Rests whose means do not settle have a law of noise in common.

`settle_together` raises the u of rests by that law, which `find_law` finds.

One rest hardly tells flicker noise or a random walk from white noise where white noise is the
larger; many rests of one sensor do. The slowest cosines of a rest of b batch means z, equivalent to
n samples of standard deviation s,

    ρ_k = 2/b² [ Σ_i z_i cos π k (i − ½)/b ]² / (g s²/n),     k = 1 … 8,                    (1)

with g the median of n/n_eff of the rests, are independent, each χ² on one degree of freedom times

    m_k = α + A λ^γ φ_k.                                                                    (2)

Where samples remember nothing beyond a tenth of a rest that is 1. Flicker noise has γ = 1 and φ_k
nearly 1/k, a random walk γ = 2 and φ_k = 1/k², λ being the length of a rest over the median length.

White noise is rejected where the mean of ρ_k, weighted by k^−3/2, which is nearly as good as the
best weights for either law, is beyond chance; or where ρ_1 and ρ_2 are so against ρ_5 … ρ_8 and a
memory, m_k = a/(1 + k²/κ²), explains less. It must be rejected without the rest that speaks loudest
as well, so that one disturbed rest says nothing about the others, and what sticks out far takes no
part at all. Outputs are taken together unless they differ beyond chance. α, 1 or below it, A and
the law then follow by maximum likelihood [1]_, and

    u² = (g s²/n) (α + μ A λ^γ)                                                             (3)

is the variance of a mean about that of a stretch sixteen times as long with the rest in its middle,
μ = 2.39 of flicker noise and 11.6 of a walk: this is what is promised where no mean settles. Its
degrees of freedom are those that the likelihood leaves to A.

References
----------
.. [1] P. Whittle, Ark. Mat. 2 (1953), 423–434 (the likelihood of ρ_k).
.. [2] C. A. Greenhall, W. J. Riley, 35th PTTI Meeting, 2003: phases of flicker noise and of a walk
   have the generalised covariances t² ln|t| and |t|³, from which φ_k and μ follow.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from multipos.logs.rest_means import COSINES, RestMean
from multipos.numerics.arrays import Array, Mask, median
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_tail

_LEAST = 64  # samples of a rest, below which eight cosines are no longer like χ²
_LEVEL = 0.045  # at which the weighted mean rejects white noise
_FALL = 0.01  # at which ρ_1 and ρ_2 do
_MANY = 36  # means, of which fewer must speak louder, as their u would be raised by more
_OTHERS = 2.5  # times these levels are enough without the loudest rest
_DIFFER = 0.01  # at which outputs are each for itself
_APART = 1e-3  # chance at which a rest is so far beyond the median that it takes no part
_WALK, _LOWER = 1.0, 2.0  # of the log likelihood, that a walk and α below 1 must explain more
_MEMORIES = np.geomspace(3.0, 100.0, 12)  # κ: of a memory up to a tenth of a rest
_RATIOS = np.geomspace(0.03, 1e4, 80)  # A/α
_STEP = float(np.log(_RATIOS[1] / _RATIOS[0])) / sqrt(12.0)  # what lies between two of them
_STRETCH = 16.0  # rest lengths, to whose mean u refers
_NOTHING = 1e-9  # of the slow cosines, below which the others are rounding
_BLOCKS = 128  # enough for integrals over a rest

_ORDER = np.arange(1, COSINES + 1)
_WEIGHT = _ORDER**-1.5 / np.sum(_ORDER**-1.5)
_DOF = 1.0 / float(_WEIGHT @ _WEIGHT)  # of the weighted mean of one rest
_NEEDED = ("n", "sd", "u", "drift_factor")  # of a rest


class Law(NamedTuple):
    """Eq. (2) of some outputs: whether it is a walk, α, A, and the standard deviation of A."""

    walk: bool
    lowest: float
    amplitude: float
    spread: float

    def square(self, length: Array) -> tuple[Array, Array]:
        """Return eq. (3) over g s²/n for every λ (R,), and its degrees of freedom."""
        slow = _growths()[self.walk] * length ** (1 + self.walk)
        square = self.lowest + slow * self.amplitude
        return square, 2.0 * (square / (slow * self.spread)) ** 2


def settle_together(found: Sequence[RestMean], lengths: Array) -> list[RestMean]:
    """Return rests with the u by the law that they have in common, where it is the larger.

    Parameters
    ----------
    found : sequence of R RestMean
        Of one sensor.
    lengths : (R,) array
        Of the rests, in one unit.
    """
    n, sd, u, drift_factor = (np.array([getattr(r, k) for r in found]) for k in _NEEDED)
    white = sd**2 / n[:, None]
    cosines = np.array([each.cosines for each in found])
    usable = (white > 0.0) & (u > 0.0) & cosines.any(axis=2) & (n >= _LEAST)[:, None]
    if len(found) < 2 or not usable.any():
        return list(found)
    memory = _medians((u / drift_factor) ** 2 / np.where(usable, white, 1.0), usable)
    rho = cosines / memory[:, None]
    size = rho @ _WEIGHT
    usable &= _are_usual(size / _medians(size, usable), usable)[:, None]
    length = lengths / float(median(lengths))
    square, dof = np.zeros(sd.shape), np.ones(sd.shape)
    for outputs in _alike(size, usable):
        law = find_law(rho[:, outputs], usable[:, outputs], length)
        if law is not None:
            by, own = law.square(length)
            square[:, outputs] = by[:, None] * (memory * white)[:, outputs]
            dof[:, outputs] = own[:, None]
    more = (square > u**2) & (u > 0.0)
    return [
        _raised(each, more[i], square[i], dof[i]) if more[i].any() else each
        for i, each in enumerate(found)
    ]


def _raised(each: RestMean, more: Mask, square: Array, dof: Array) -> RestMean:
    u = np.where(more, np.sqrt(square), each.u)
    ratio = np.ones_like(u)
    ratio[more] = (u * each.drift_factor)[more] / each.u[more]
    dof = np.where(more, np.clip(dof, 1.0, each.dof), each.dof)
    return replace(each, u=u, dof=dof, common=ratio)


def _medians(values: Array, usable: Mask) -> Array:
    """Return the median of the usable of each output (M,), 1 where nothing is."""
    columns = zip(values.T, usable.T, strict=True)
    return np.array([float(median(v[t])) if t.any() else 1.0 for v, t in columns])


def _are_usual(size: Array, usable: Mask) -> Mask:
    """Tell of which rests (R,) the outputs together are not far beyond the median of all."""
    count = np.maximum(usable.sum(axis=1), 1)
    most = {c: _most(_DOF * c) for c in set(count.tolist())}
    limit = np.array([most[c] for c in count.tolist()])
    mean = np.where(usable, size, 0.0).sum(axis=1) / count
    return np.asarray(mean <= limit * float(median(mean[usable.any(axis=1)])))


@cache
def _most(dof: float) -> float:
    return chi2_quantile(1.0 - _APART, dof) / chi2_quantile(0.5, dof)


def _alike(size: Array, usable: Mask) -> list[list[int]]:
    """Return the outputs that are judged together: all that tell something, or each."""
    count = usable.sum(axis=0)
    outputs = np.flatnonzero(count).tolist()
    each = (size * usable).sum(axis=0)[outputs] / count[outputs]
    dof = _DOF * count[outputs]
    together = float(each @ dof / dof.sum())
    off = float(4.5 * dof @ (np.cbrt(each / together) - 1.0) ** 2)  # as a cube root is normal
    if len(outputs) == 1 or chi2_tail(off, len(outputs) - 1.0) > _DIFFER:
        return [outputs]
    return [[j] for j in outputs]


def find_law(rho: Array, usable: Mask, length: Array) -> Law | None:
    """Return the law that rests have in common; None where they may have white noise.

    Parameters
    ----------
    rho : (R, M, 8) array
    identifiable : (R, M) array
        Which of them take part.
    length : (R,) array
        λ.
    """
    others = usable.copy()
    others[int(np.where(usable, rho @ _WEIGHT, 0.0).sum(axis=1).argmax())] = False
    rows, without = rho[usable], rho[others]
    if not len(without):
        return None
    level = min(1.0, len(rows) / _MANY) ** 2
    grown = _is_large(rows, level * _LEVEL) and _is_large(without, level * _OTHERS * _LEVEL)
    falls = _falls(rows, level * _FALL) and _falls(without, level * _OTHERS * _FALL)
    if not grown and not falls:
        return None
    law, likelihood = _most_likely(rows, np.broadcast_to(length[:, None], usable.shape)[usable])
    return law if grown or likelihood > _with_memory(rows) + _LOWER else None


def _is_large(rows: Array, level: float) -> bool:
    dof = _DOF * len(rows)
    return chi2_tail(dof * float(rows.mean(axis=0) @ _WEIGHT), dof) < level


def _falls(rows: Array, level: float) -> bool:
    mean = rows.mean(axis=0)
    slow, quick = float(mean[:2].mean()), float(mean[4:].mean())
    ratio = slow / max(quick, _NOTHING * slow) if slow else 0.0
    return f_tail(ratio, 2.0 * len(rows), 4.0 * len(rows)) < level


def _with_memory(rows: Array) -> float:
    """Return the log likelihood of the best memory, whatever it is at zero frequency."""
    shape = 1.0 / (1.0 + (_ORDER / _MEMORIES[:, None]) ** 2)
    level = (rows.mean(axis=0) / shape).mean(axis=1)
    logs = COSINES * np.log(level) + np.log(shape).sum(axis=1) + COSINES
    return float(-0.5 * len(rows) * logs.min())


def _most_likely(rows: Array, length: Array) -> tuple[Law, float]:
    """Return the law of rows (N, 8) of lengths (N,), and its log likelihood less what it costs."""
    found = []
    for walk, phi in enumerate(_shapes()):
        shape = length[:, None] ** (1 + walk) * phi
        means = (1.0 + ratio * shape for ratio in _RATIOS.tolist())  # one by one: logs may be long
        plain, left = np.array([(np.log(m).sum(), (rows / m).sum()) for m in means]).T
        lower = np.minimum(left / rows.size, 1.0)  # the likeliest α
        for lowest, cost in ((np.ones_like(lower), 0.0), (lower, _LOWER)):
            logs = -0.5 * (rows.size * np.log(lowest) + plain + left / lowest)
            best, amplitude = int(logs.argmax()), lowest * _RATIOS
            weight = np.exp(logs - logs[best]) * _RATIOS  # of A, even in A
            weight /= weight.sum()
            spread = sqrt(float(weight @ (amplitude - weight @ amplitude) ** 2))
            spread = max(spread, _STEP * float(amplitude[best]))
            law = Law(bool(walk), float(lowest[best]), float(amplitude[best]), spread)
            found.append((law, float(logs[best]) - cost - walk * _WALK))
    return max(found, key=lambda each: each[1])


@cache
def _shapes() -> tuple[Array, Array]:
    """Return φ_k of flicker noise and of a walk."""
    lag = np.subtract.outer(np.arange(_BLOCKS), np.arange(_BLOCKS))
    between = 2.0 * _square_log(lag) - _square_log(lag + 1) - _square_log(lag - 1)
    cosine = np.cos(np.pi * np.outer(np.arange(_BLOCKS) + 0.5, _ORDER) / _BLOCKS)
    flicker = np.einsum("ik,ij,jk->k", cosine, between, cosine) / _BLOCKS**2
    return flicker, 1.0 / _ORDER**2


@cache
def _growths() -> tuple[float, float]:
    """Return μ of flicker noise and of a walk: the mean of a rest less that of its stretch."""
    ends = np.array([0.5, -0.5, _STRETCH / 2.0, -_STRETCH / 2.0])
    weight = np.array([1.0, -1.0, -1.0 / _STRETCH, 1.0 / _STRETCH])
    lag = np.subtract.outer(ends, ends)
    return (
        float(weight @ _square_log(lag) @ weight) / 2.0,
        float(weight @ np.abs(lag) ** 3 @ weight) * pi**2 / 12.0,
    )


def _square_log(t: Array) -> Array:
    """Return t² ln|t|."""
    return np.asarray(t**2 * np.log(np.where(t == 0.0, 1.0, np.abs(t))))

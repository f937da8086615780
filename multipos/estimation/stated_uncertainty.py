"""Stated uncertainties of readings that are themselves uncertain, and forces that are.

`shrink_variances` returns readings whose u are those of eq. (1), `shrunk` those of many units and
`take_stated` their stated noise, piece by piece `taken_by_blocks`. `with_stated_dof`,
`combined_dof` and `combined_jointly` give the degrees of freedom of eq. (3), and
`add_reference_noise` adds eq. (4).

**Few degrees of freedom.** The u_k of the readings of one output are estimates with d_k degrees of
freedom. Weights 1/u_k² of few of them favour those that came out small by chance, so that each is
shrunk towards what all of them have in common, a scaled inverse χ² of d_0 degrees of freedom about
s_0² [1]_:

    ũ_k² = (d_0 s_0² + d_k u_k²)/(d_0 + d_k),                                              (1)
    ψ'(d_0/2) = var(e) − mean ψ'(d_k/2),     ln s_0² = mean(e) + ψ(d_0/2) − ln(d_0/2),       (2)

with e_k = ln u_k² − ψ(d_k/2) + ln(d_k/2). Where the u_k differ by no more than chance allows, d_0
is infinite and all become one, Σ d_k u_k²/Σ d_k; where they truly differ, each stays what it is.

Rests of a log with few effective samples (`dof` below 30 in most of them) do not satisfy (1): the
correlation of their noise is estimated too, from the same few samples, and their u differ by
factors where rests are equally noisy. They are weighted by their numbers of samples N_k,

    ũ_k² = q/N_k,    q the lower quartile of N_k u_k² of all outputs,                       (1a)

a variance above which the residuals of the fit determine the excess. A hand moves the outputs
across gravity most, others in each rest: what one output shows by chance is not its own noise.

The stated variances of a fit then have by Welch and Satterthwaite

    ν_c = (Σ ũ_k²)²/Σ (ũ_k⁴/d_k),     1/ν' = 1/ν + w²/ν_c,                                  (3)

where w is the fraction that they are of the variance of the readings, the rest being excess
variance with its own ν. Where ν is infinite, U grows by k(ν_c)/k(∞).

**Uncertain forces.** A reading at a force f + δ, δ with standard uncertainties u_f of its
components, moves by J δ, J = dh/df, so that the readings of position k have the covariance

    V_k = U_k + J_k diag(u_f²) J_kᵀ,                                                        (4)

U_k the stated one. J is that of a first fit, which determines the scale factors well enough for a
weight. Readings without stated noise get one far below their residuals
(`multipos.estimation.excess_variance` finds the rest), so that their noise stays that of the
residuals.

References
----------
.. [1] G. K. Smyth, Stat. Appl. Genet. Mol. Biol. 3 (2004), article 3, section 6.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.estimation.problem import Solution
from multipos.finding import Finding
from multipos.numerics.arrays import Array, Mask
from multipos.numerics.polygamma import digamma, inverse_trigamma, trigamma
from multipos.positions.readings import Readings

_KNOWN = 1000.0  # degrees of freedom from which on u is taken as known
_FEW = 30.0  # below which a finding says so
_LEAST, _MOST = 1e-140, 1e140  # of u, whose squares are numbers still
_RATIO = 1e3  # times that uncertainties of a unit may differ, where weights have digits left
_FEWEST = 3  # readings that determine what they have in common


def shrink_variances(readings: Readings) -> Readings:
    """Return readings whose uncertainties are those of eq. (1), where they have few dof."""
    if readings.dof is None or readings.u is None:
        return readings
    u = shrunk(readings.u[None], readings.dof[None])[0]
    least = float(readings.dof.min())
    if least >= _FEW:
        return replace(readings, u=u)
    few = np.mean(readings.dof < _FEW, axis=0) > 0.5
    text = (
        f"stated uncertainties of readings have as few as {least:.2g} dof: their variances were "
        "pooled in part, which U includes"
    )
    if readings.samples is not None and few.any():
        u = np.where(few, _by_samples(readings.u, readings.dof, readings.samples), u)
        text = (
            f"stated uncertainties of readings have as few as {least:.2g} dof: rests are weighted "
            "by their numbers of samples, and U follows from residuals"
        )
    found = Finding("few-dof", "note", text)
    return replace(readings, u=u, findings=(*readings.findings, found))


def _by_samples(u: Array, dof: Array, samples: Array) -> Array:
    """Return ũ of eq. (1a), of the readings with few degrees of freedom; the others stay."""
    few = dof < _FEW
    if not few.any():
        return u
    rest = np.broadcast_to(samples[:, None], u.shape)
    each = np.sort((rest * u**2)[few])
    return np.where(few, np.sqrt(each[(len(each) - 1) // 4] / rest), u)


class StatedNoise(NamedTuple):
    """The stated noise of many units.

    Attributes
    ----------
    u : (B, n, M) array
        As it weighs readings: that of eq. (1) where it has degrees of freedom, and 1 of units whose
        noise cannot be weights.
    dof : (B, n, M) array or None
    sound : (B,) array of bool
        Units whose noise can be weights, and of which nothing is an error.
    """

    u: Array
    dof: Array | None
    sound: Mask


def take_stated(stated: Sequence[Array], stated_dof: Sequence[Array]) -> StatedNoise:
    """Return the stated noise of many units.

    Parameters
    ----------
    stated : M arrays (B, n)
        Standard uncertainties of the readings.
    stated_dof : M arrays (B, n), or none
        Their degrees of freedom.
    """
    u = np.stack(list(stated), axis=2)
    sound = ((u > _LEAST) & (u < _MOST)).all(axis=(1, 2))
    sound &= u.max(axis=(1, 2)) < _RATIO * u.min(axis=(1, 2))
    if not stated_dof:
        return StatedNoise(np.where(sound[:, None, None], u, 1.0), None, sound)
    dof = np.stack(list(stated_dof), axis=2)
    sound &= ((dof >= 1.0) & np.isfinite(dof)).all(axis=(1, 2))
    u, dof = (np.where(sound[:, None, None], each, 1.0) for each in (u, dof))
    return StatedNoise(shrunk(u, dof), dof, sound)


def taken_by_blocks(
    values: Sequence[Array], stated: Sequence[Array], stated_dof: Sequence[Array], readings: int
) -> Iterator[tuple[Array, StatedNoise | None]]:
    """Yield values (M, B, n) of so many readings of an output at a time, and their stated noise.

    Parameters
    ----------
    values, stated, stated_dof
        M arrays (B, n) each; of the last two there may be none.
    """
    count, n = values[0].shape
    step = max(1, readings // n)
    for first in range(0, count, step):
        rows = slice(first, first + step)
        y, u, dof = ([each[rows] for each in arrays] for arrays in (values, stated, stated_dof))
        yield np.stack(y), take_stated(u, dof) if u else None


def shrunk(u: Array, dof: Array) -> Array:
    """Return ũ of eq. (1), of B units, from u and their degrees of freedom, (B, n, M) each.

    Where fewer than three readings of an output are left to have something in common, u stays.
    """
    few = dof < _KNOWN
    count = np.sum(few, axis=1, keepdims=True)
    drawn = few & (count >= _FEWEST)
    if not drawn.any():
        return u
    count = np.maximum(count, _FEWEST)
    square, dof = np.where(few, u**2, 1.0), np.where(few, dof, 1.0)
    half = dof / 2.0
    e = np.log(square) - digamma(half) + np.log(half)
    mean = np.sum(few * e, axis=1, keepdims=True) / count
    excess = np.sum(few * (e - mean) ** 2, axis=1, keepdims=True) / (count - 1)
    excess -= np.sum(few * trigamma(half), axis=1, keepdims=True) / count
    equal = excess <= 0.0  # as far as chance allows
    prior = 2.0 * inverse_trigamma(np.where(equal, 1.0, excess))
    common = np.exp(mean + digamma(prior / 2.0) - np.log(prior / 2.0))
    total = np.sum(few * dof, axis=1, keepdims=True)
    pooled = np.sum(few * dof * square, axis=1, keepdims=True) / np.where(total > 0.0, total, 1.0)
    together = np.where(equal, pooled, (prior * common + dof * square) / (prior + dof))
    return np.where(drawn, np.sqrt(together), u)


def with_stated_dof(solution: Solution, readings: Readings, *, joint: bool) -> Solution:
    """Return a solution with the degrees of freedom of the readings' uncertainties, eq. (3).

    Parameters
    ----------
    solution : Solution
    readings : Readings
    joint : bool
        Whether parameters rest on all outputs together.
    """
    if readings.dof is None or readings.u is None:
        return solution
    excess = np.zeros(readings.dof.shape[1])
    found = solution.variance_components
    if found is not None and found.rest_to_rest is not None:
        excess = np.array([found.rest_to_rest[o].value ** 2 for o in solution.model.outputs])
    spread = _spread(readings.u[None] ** 2, readings.dof[None], excess)[0]
    if joint:
        spread = np.full(len(spread), spread.max())
    each = solution.model.per_parameter(spread, spread.max())
    with np.errstate(divide="ignore"):
        # infinite: nothing was estimated from residuals, and it stays
        dof = np.where(np.isinf(solution.dof), np.inf, 1.0 / (1.0 / solution.dof + spread))
        own = 1.0 / (1.0 / solution.parameter_dof + each)
    return replace(solution, dof=dof, parameter_dof=own)


def combined_dof(dof: Array, variance: Array, stated_dof: Array, excess: Array) -> Array:
    """Return degrees of freedom (B, M) with those of the variances, eq. (3), of B units.

    Parameters
    ----------
    dof, excess : (B, M) arrays
        Of the variance of a reading, and τ².
    variance, stated_dof : (B, n, M) arrays
        Stated variances and their degrees of freedom.
    """
    return np.asarray(1.0 / (1.0 / dof + _spread(variance, stated_dof, excess)))


def combined_jointly(dof: Array, noise: StatedNoise, excess: Array) -> Array:
    """Return degrees of freedom (B, p) of parameters that rest on all outputs together, eq. (3).

    Parameters
    ----------
    dof : (B, p) array
        Of the parameters.
    noise : StatedNoise
    excess : (B, M) array
        τ² of the outputs.
    """
    if noise.dof is None:
        return dof
    spread = _spread(noise.u**2, noise.dof, excess).max(axis=1)
    return np.asarray(1.0 / (1.0 / dof + spread[:, None]))


def _spread(variance: Array, dof: Array, excess: Array) -> Array:
    """Return w²/ν_c of eq. (3), (B, M)."""
    stated_dof = np.sum(variance, axis=1) ** 2 / np.sum(variance**2 / dof, axis=1)
    share = variance.mean(axis=1) / (variance.mean(axis=1) + excess)
    return np.asarray(share**2 / stated_dof)


_LEAST_SD = 1e-3  # of a residual standard deviation: negligible against the excess variance
_CORRELATED = 0.01  # below which outputs of one reading count as independent


def add_reference_noise(readings: Readings, solution: Solution) -> Readings:
    """Return readings whose noise holds what the forces add, eq. (4).

    Unchanged where the forces are exact, or no residuals are left to estimate the noise from.
    """
    stated = readings.noise
    if readings.reference_u is None or not readings.reference_u.any():
        return readings
    if stated is None and not np.isfinite(solution.residual_sd).all():
        return readings
    n, m = readings.values.shape
    slopes = solution.model.force_jacobian(
        solution.parameters, solution.reference, readings.environment
    )
    moved = slopes * readings.reference_u[:, None, :]
    blocks = moved @ moved.transpose(0, 2, 1)
    if stated is None:
        variance = np.maximum(_LEAST_SD * solution.residual_sd, np.finfo(float).tiny ** 0.5)
        stated = np.tile(variance**2, n)
    variances = np.einsum("nmm->nm", blocks)
    apart = blocks - variances[:, :, None] * np.eye(m)
    if stated.ndim == 1:
        total = stated.reshape(n, m) + variances
        size = np.sqrt(total[:, :, None] * total[:, None, :])
        if (np.abs(apart) <= _CORRELATED * size).all():
            return replace(readings, u=np.sqrt(total), covariance=None)
        stated = np.diag(stated)
    covariance = stated.copy().reshape(n, m, n, m)
    covariance[np.arange(n), :, np.arange(n), :] += blocks
    return replace(readings, u=None, covariance=covariance.reshape(n * m, n * m))

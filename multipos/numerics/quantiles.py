"""Quantiles and tails of the four laws behind every stated confidence.

An estimate with standard uncertainty u on ν degrees of freedom is stated with expanded uncertainty

    U = k u,    P(|T_ν| ≤ k) = confidence        (JCGM 100, G.3),

where T_ν is Student's t, and the normal law at ν = ∞ (the reading noise is known beforehand). Sums
of squares are judged by χ²_ν against a known variance, and by F_{k,ν} = (χ²_k/k) / (χ²_ν/ν) against
one estimated on ν degrees of freedom; at ν = ∞ the second is χ²_k/k.

=====================  ============================================================
`coverage_factor`      k of a two-sided interval, `coverage_factors` of many
`t_tail`               p value of an estimate over its u, both sides
`f_tail`, `f_quantile` variances compared: terms entering a model, lack of fit
`chi2_tail`            residuals against claimed noise
=====================  ============================================================

Degrees of freedom may be fractional (Welch–Satterthwaite) and infinite; where they are not positive
the question has no answer, and nan is returned. Scalars in, float out: a fit asks for a handful;
only `coverage_factors` is for those of many units.

The short tail is used throughout: 1 − p keeps no digits below 1e-16, so a two-sided factor is
computed from (1 − confidence)/2 and not from 1 − (1 − confidence)/2. Up to a thousand degrees of
freedom the functions are those of `multipos.numerics.incomplete`, beyond SciPy's.
"""

import math
from functools import lru_cache

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import SMALLEST, Array
from multipos.numerics.incomplete import LARGEST, beta_tails, gamma_tails, solve

_KEPT = 256  # quantiles: a fit asks for the same one of each of its parameters
_MANY = 100  # degrees of freedom from which on SciPy is worth its import
_KNOWN = 1e6  # beyond which the difference of two tails is rounding


def check_confidence(confidence: float) -> None:
    """Refuse what is no probability of an interval.

    Raises
    ------
    UsageError
        It does not lie between 0 and 1, or as near to 0 as no interval is short.
    """
    if not SMALLEST <= confidence < 1.0:
        raise UsageError(f"--confidence must lie between 0 and 1, got {confidence}.")


def coverage_factor(confidence: float, dof: float) -> float:
    """Half width k, in standard uncertainties, of the two-sided interval that covers `confidence`.

    Returns nan where `dof` is nan or not positive: no variance was estimated.
    """
    return -t_quantile((1.0 - confidence) / 2.0, dof)


def coverage_factors(confidence: float, dof: Array) -> Array:
    """Return `coverage_factor` of degrees of freedom, an array of any shape.

    Many different ones come from SciPy's quantiles, after a step of Newton's on its tails.
    """
    each = dof.ravel().tolist()
    if len(set(each)) < _MANY:  # `coverage_factor` keeps what it has found
        return np.array([coverage_factor(confidence, nu) for nu in each]).reshape(dof.shape)
    from scipy.special import betainc, gammaln, ndtri, stdtrit

    different, place = np.unique(dof, return_inverse=True)
    nu = np.where(different > 0.0, different, np.nan)
    p = (1.0 - confidence) / 2.0
    with np.errstate(invalid="ignore"):  # nan and infinite degrees of freedom
        k = -stdtrit(nu, p)
        constant = gammaln((nu + 1.0) / 2.0) - gammaln(nu / 2.0) - 0.5 * np.log(nu * np.pi)
        density = 2.0 * np.exp(constant - (nu + 1.0) / 2.0 * np.log1p(k**2 / nu))
        better = k + (betainc(nu / 2.0, 0.5, nu / (nu + k**2)) - 2.0 * p) / density
    k = np.where(nu < _KNOWN, better, k)
    return np.asarray(np.where(np.isinf(nu), -ndtri(p), k)[place].reshape(dof.shape))


@lru_cache(_KEPT)
def t_quantile(p: float, dof: float) -> float:
    """Student's t that is not exceeded with probability `p`; normal at infinite `dof`."""
    if not dof > 0.0:
        return math.nan
    if math.isinf(dof):
        return normal_quantile(p)
    if not 0.0 < p < 1.0 or dof > 2.0 * LARGEST:
        from scipy.special import stdtrit

        return float(stdtrit(dof, p))
    if p > 0.5:
        return -t_quantile(1.0 - p, dof)
    central = 1.0 - 2.0 * p
    if central == 0.0:
        return 0.0
    if central < 0.5:
        return -solve(lambda t: _t_tails(t, dof)[1], central, 1.0)
    return -solve(lambda t: _t_tails(t, dof)[0], 2.0 * p, 1.0)


def t_tail(t: float, dof: float) -> float:
    """Probability that a Student t is farther from zero than `t`, both sides together."""
    if not dof > 0.0:
        return math.nan
    if math.isinf(dof):
        return math.erfc(abs(t) / math.sqrt(2.0))
    if not math.isfinite(t) or dof > 2.0 * LARGEST:
        from scipy.special import stdtr

        return 2.0 * float(stdtr(dof, -abs(t)))
    return _t_tails(abs(float(t)), float(dof))[0]


def _t_tails(t: float, dof: float) -> tuple[float, float]:
    """Return the probabilities beyond ±t and between."""
    root = math.hypot(t, math.sqrt(dof))
    return beta_tails(dof / root / root, (t / root) ** 2, dof / 2.0, 0.5)


@lru_cache(_KEPT)
def normal_quantile(p: float) -> float:
    """Standard normal value that is not exceeded with probability `p`."""
    if not 0.0 < p < 1.0:
        return {0.0: -math.inf, 1.0: math.inf}.get(p, math.nan)
    if p >= 0.5:
        return 0.0 if p == 0.5 else -normal_quantile(1.0 - p)
    if p > 0.25:
        return -solve(lambda z: math.erf(z / math.sqrt(2.0)), 1.0 - 2.0 * p, 1.0)
    return -solve(lambda z: math.erfc(z / math.sqrt(2.0)), 2.0 * p, 1.0)


@lru_cache(_KEPT)
def f_quantile(p: float, k: float, dof: float) -> float:
    """Ratio of variances on `k` and `dof` degrees of freedom not exceeded with probability `p`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if math.isinf(dof):
        return chi2_quantile(p, k) / k
    if not 0.0 < p < 1.0 or max(k, dof) > 2.0 * LARGEST:
        from scipy.special import fdtri

        return float(fdtri(k, dof, p))
    if p < 0.5:
        return solve(lambda f: _f_tails(f, k, dof)[1], p, 1.0)
    return solve(lambda f: _f_tails(f, k, dof)[0], 1.0 - p, 1.0)


def f_tail(f: float, k: float, dof: float) -> float:
    """Probability that a ratio of variances on `k` and `dof` degrees of freedom exceeds `f`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if math.isinf(dof):
        return chi2_tail(k * f, k)
    if not math.isfinite(f) or max(k, dof) > 2.0 * LARGEST:
        from scipy.special import fdtrc

        return float(fdtrc(k, dof, f))
    return _f_tails(float(f), float(k), float(dof))[0]


def _f_tails(f: float, k: float, dof: float) -> tuple[float, float]:
    """Return the probabilities above and below a ratio of variances."""
    whole = k * f + dof
    return beta_tails(dof / whole, k * f / whole, dof / 2.0, k / 2.0)


@lru_cache(_KEPT)
def chi2_quantile(p: float, dof: float) -> float:
    """Sum of `dof` squared standard normals that is not exceeded with probability `p`."""
    if not dof > 0.0:
        return math.nan
    if not 0.0 < p < 1.0 or dof > 2.0 * LARGEST:
        from scipy.special import gammaincinv  # chdtri wants 1 − p, which loses a small p

        return 2.0 * float(gammaincinv(dof / 2.0, p))
    if p < 0.5:
        return 2.0 * solve(lambda x: gamma_tails(dof / 2.0, x)[0], p, dof / 2.0)
    return 2.0 * solve(lambda x: gamma_tails(dof / 2.0, x)[1], 1.0 - p, dof / 2.0)


def chi2_tail(x: float, dof: float) -> float:
    """Probability that the sum of `dof` squared standard normals exceeds `x`."""
    if not dof > 0.0:
        return math.nan
    if not math.isfinite(x) or dof > 2.0 * LARGEST:
        from scipy.special import chdtrc

        return float(chdtrc(dof, x))
    return gamma_tails(float(dof) / 2.0, float(x) / 2.0)[1]

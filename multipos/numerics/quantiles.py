"""Quantiles and tails of the four laws behind every stated confidence.

An estimate with standard uncertainty u on ν degrees of freedom is stated with expanded uncertainty

    U = k u,    P(|T_ν| ≤ k) = confidence        (JCGM 100, G.3),

where T_ν is Student's t, and the normal law at ν = ∞ (the reading noise is known beforehand). Sums
of squares are judged by χ²_ν against a known variance, and by F_{k,ν} = (χ²_k/k) / (χ²_ν/ν) against
one estimated on ν degrees of freedom; at ν = ∞ the second is χ²_k/k.

=====================  ============================================================
`coverage_factor`      k of a two-sided interval
`t_tail`               p value of an estimate over its u, both sides
`f_tail`, `f_quantile` variances compared: terms entering a model, lack of fit
`chi2_tail`            residuals against claimed noise
=====================  ============================================================

Degrees of freedom may be fractional (Welch–Satterthwaite) and infinite; where they are not positive
the question has no answer, and nan is returned. Scalars in, float out: a fit asks for a handful.

The short tail is used throughout: 1 − p keeps no digits below 1e-16, so a two-sided factor is
computed from (1 − confidence)/2 and not from 1 − (1 − confidence)/2.
"""

from __future__ import annotations

import math


def coverage_factor(confidence: float, dof: float) -> float:
    """Half width k, in standard uncertainties, of the two-sided interval that covers `confidence`.

    Returns nan where `dof` is nan or not positive: no variance was estimated.
    """
    return -t_quantile((1.0 - confidence) / 2.0, dof)


def t_quantile(p: float, dof: float) -> float:
    """Student's t that is not exceeded with probability `p`; normal at infinite `dof`."""
    if not dof > 0.0:
        return math.nan
    if math.isinf(dof):
        return normal_quantile(p)
    from scipy.special import stdtrit

    return float(stdtrit(dof, p))


def t_tail(t: float, dof: float) -> float:
    """Probability that a Student t is farther from zero than `t`, both sides together."""
    if not dof > 0.0:
        return math.nan
    from scipy.special import ndtr, stdtr

    return 2.0 * float(ndtr(-abs(t)) if math.isinf(dof) else stdtr(dof, -abs(t)))


def normal_quantile(p: float) -> float:
    """Standard normal value that is not exceeded with probability `p`."""
    from scipy.special import ndtri

    return float(ndtri(p))


def f_quantile(p: float, k: float, dof: float) -> float:
    """Ratio of variances on `k` and `dof` degrees of freedom not exceeded with probability `p`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if math.isinf(dof):
        return chi2_quantile(p, k) / k
    from scipy.special import fdtri

    return float(fdtri(k, dof, p))


def f_tail(f: float, k: float, dof: float) -> float:
    """Probability that a ratio of variances on `k` and `dof` degrees of freedom exceeds `f`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if math.isinf(dof):
        return chi2_tail(k * f, k)
    from scipy.special import fdtrc

    return float(fdtrc(k, dof, f))


def chi2_quantile(p: float, dof: float) -> float:
    """Sum of `dof` squared standard normals that is not exceeded with probability `p`."""
    if not dof > 0.0:
        return math.nan
    from scipy.special import gammaincinv  # chdtri wants 1 − p, which loses a small p

    return 2.0 * float(gammaincinv(dof / 2.0, p))


def chi2_tail(x: float, dof: float) -> float:
    """Probability that the sum of `dof` squared standard normals exceeds `x`."""
    if not dof > 0.0:
        return math.nan
    from scipy.special import chdtrc

    return float(chdtrc(dof, x))

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
freedom the functions are those of `multipos.numerics.quantiles`, beyond SciPy's.

Incomplete gamma and beta functions, by series and continued fractions.

They are what the laws behind a stated confidence need, in the few values that a fit asks for:
importing `scipy.special` takes longer than such a fit. With a and b up to `LARGEST` their
logarithms of factorials keep twelve digits; beyond, SciPy's expansions are the better way.

    P(a, x) = γ(a, x)/Γ(a),   Q = 1 − P,   I_x(a, b) = B(x; a, b)/B(a, b)

by the series [1]_ (6.5.29) below x = a + 1 and the fraction (6.5.31) above; and by the fraction
(26.5.8) up to x = (a + 1)/(a + b + 2), of 1 − x beyond. What is small keeps its digits: each is
computed as itself, and the other as one less it.

Digamma and trigamma of positive arguments, by recurrence and their asymptotic series.

    ψ(x) = ln x − 1/2x − 1/12x² + 1/120x⁴ − 1/252x⁶ + …,     ψ(x) = ψ(x + 1) − 1/x,        (1)
    ψ'(x) = 1/x + 1/2x² + 1/6x³ − 1/30x⁵ + 1/42x⁷ − …,       ψ'(x) = ψ'(x + 1) + 1/x².     (2)

From x = 10 on the first term left out is below 1e-11. SciPy has both, but takes longer to import
than a fit takes.

References
----------
.. [1] M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 1964.
M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 6.3.5, 6.3.18, 6.4.6, 6.4.12.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from multipos.errors import UsageError
from multipos.numerics.arrays import SMALLEST, Array

LARGEST = 500.0
_STEPS = 10_000
_EPS = 1e-16
_TINY = 1e-300


def gamma_tails(a: float, x: float) -> tuple[float, float]:
    """Return P(a, x) and Q(a, x)."""
    if x <= 0.0:
        return 0.0, 1.0
    scale = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        step = a
        while abs(term) > _EPS * abs(total):
            step += 1.0
            term *= x / step
            total += term
        lower = scale * total
        return lower, 1.0 - lower
    b = x + 1.0 - a
    upper = scale / _fraction(b, lambda n: (-n * (n - a), b + 2.0 * n))
    return 1.0 - upper, upper


def beta_tails(x: float, y: float, a: float, b: float) -> tuple[float, float]:
    """Return I_x(a, b) and its complement; y = 1 − x is given, so that either may be small."""
    if x <= 0.0 or y <= 0.0:
        return (0.0, 1.0) if x <= 0.0 else (1.0, 0.0)
    if x > (a + 1.0) / (a + b + 2.0):
        upper = _beta_lower(y, x, b, a)
        return 1.0 - upper, upper
    lower = _beta_lower(x, y, a, b)
    return lower, 1.0 - lower


def _beta_lower(x: float, y: float, a: float, b: float) -> float:
    front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    scale = math.exp(front + a * math.log(x) + b * math.log(y)) / a

    def term(n: int) -> tuple[float, float]:
        m = n // 2
        if n % 2:
            return -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)), 1.0
        return m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)), 1.0

    return scale / _fraction(1.0, term)


def _fraction(first: float, term: Callable[[int], tuple[float, float]]) -> float:
    """Return b_0 + a_1/(b_1 + a_2/(b_2 + …)) by Lentz's algorithm; `term` gives a_n and b_n."""
    value, c, d = first, first, 0.0
    for n in range(1, _STEPS):
        a, b = term(n)
        d = 1.0 / (b + a * d or _TINY)
        c = b + a / c or _TINY
        value *= c * d
        if abs(c * d - 1.0) < _EPS:
            break
    return value


def solve(function: Callable[[float], float], target: float, start: float) -> float:
    """Return the positive x at which a monotone positive function has a value.

    The logarithm of the function is all but linear in that of x far out on either side: a
    bracket is halved, or cut where the line between its ends meets the value, whichever is better.
    """
    goal = math.log(target)

    def off(u: float) -> float:
        return math.log(max(function(math.exp(u)), _TINY)) - goal

    low = high = math.log(start)
    at_low = at_high = off(low)
    rising = off(low + 1e-3) > at_low
    step = 0.5
    while at_low * at_high > 0.0:
        if (at_low < 0.0) == rising:
            low, at_low, high = high, at_high, high + step
            at_high = off(high)
        else:
            high, at_high, low = low, at_low, low - step
            at_low = off(low)
        step *= 2.0
    for _ in range(200):
        if at_low == 0.0 or at_high == 0.0 or high - low <= 2e-16 * max(abs(low), abs(high), 1.0):
            break
        middle = low - at_low * (high - low) / (at_high - at_low)
        if not low < middle < high:
            middle = 0.5 * (low + high)
        at = off(middle)
        if at * at_low > 0.0:
            low, at_low, at_high = middle, at, 0.5 * at_high
        else:
            high, at_high, at_low = middle, at, 0.5 * at_low
    return math.exp(low if abs(at_low) < abs(at_high) else high)


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


_FAR = 10.0  # where the series are good
_STEPS_POLYGAMMA = 60  # of Newton's iteration; a handful is needed


def digamma(x: Array) -> Array:
    """Return ψ of each x > 0 by eq. (1)."""
    far, low = _shifted(x)
    square = 1.0 / far**2
    series = np.log(far) - 0.5 / far
    series -= square * (1 / 12 - square * (1 / 120 - square * (1 / 252 - square / 240)))
    return np.asarray(series - sum(np.where(there, 1.0 / y, 0.0) for y, there in low))


def trigamma(x: Array) -> Array:
    """Return ψ' of each x > 0 by eq. (2)."""
    far, low = _shifted(x)
    square = 1.0 / far**2
    series = 1.0 / far + 0.5 * square
    series += square / far * (1 / 6 - square * (1 / 30 - square * (1 / 42 - square / 30)))
    return np.asarray(series + sum(np.where(there, 1.0 / y**2, 0.0) for y, there in low))


def inverse_trigamma(value: Array) -> Array:
    """Return the x > 0 whose ψ' is each value above 0, by Newton's iteration in 1/ψ'."""
    x = np.asarray(0.5 + 1.0 / value)
    searched = np.ones(x.shape, dtype=np.bool_)
    for _ in range(_STEPS_POLYGAMMA):
        here = trigamma(x)
        # 1/ψ' is nearly straight; its slope is that of ψ'(x) ≈ 1/(x − 1/2)
        step = (1.0 / value - 1.0 / here) * _slope(x, here)
        x = np.where(searched, np.maximum(x + step, x / 2.0), x)
        searched &= np.abs(step) > 1e-12 * x
        if not searched.any():
            break
    return x


def _slope(x: Array, here: Array) -> Array:
    """Return dx/d(1/ψ') at x."""
    step = 1e-6 * x
    above = trigamma(x + step)
    return np.asarray(step / (1.0 / above - 1.0 / here))


def _shifted(x: Array) -> tuple[Array, list[tuple[Array, NDArray[np.bool_]]]]:
    """Return arguments raised to where the series are good, and the steps on the way."""
    y = np.array(x, dtype=np.float64)
    low = []
    for _ in range(int(_FAR)):
        there = y < _FAR
        low.append((y.copy(), there))
        y = np.where(there, y + 1.0, y)
    return y, low


def coverage_by_tenths(confidence: float, dof: Array) -> Array:
    """Return the coverage factor of each dof, rounded down to a tenth to look up each but once."""
    lowered = np.where(np.isfinite(dof), np.floor(dof * 10.0) / 10.0, dof)
    different, place = np.unique(lowered, return_inverse=True)
    factors = np.array([coverage_factor(confidence, nu) for nu in different.tolist()])
    return np.asarray(factors[place.reshape(dof.shape)])

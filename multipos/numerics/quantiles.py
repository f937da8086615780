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
`chi2_tail`            residuals against stated noise
=====================  ============================================================

Degrees of freedom may be fractional (Welch–Satterthwaite) and infinite; where they are not positive
the question has no answer, and nan is returned. Scalars in, float out: a fit asks for a handful;
only `coverage_factors` is for those of many units.

The short tail is used throughout: 1 − p keeps no digits below 1e-16, so a two-sided factor is
computed from (1 − confidence)/2 and not from 1 − (1 − confidence)/2.

Incomplete gamma and beta functions, by series and continued fractions.

They are what the laws behind a stated confidence need, in the few values that a fit asks for:
importing `scipy.special` takes longer than such a fit. With a and b up to `LARGEST` their
logarithms of factorials keep twelve digits; beyond, the factor before the series is written with
the remainder δ of Stirling's formula and the deviance D, which lose none [2]_,

    x^a e^−x/Γ(a + 1) = exp(−δ(a) − D(a, x))/√(2π a),     D(a, m) = a ln(a/m) + m − a.

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
.. [2] C. Loader, *Fast and accurate computation of binomial probabilities*, 2000.
.. [3] M. J. Wichura, Algorithm AS 241, Applied Statistics 37, 1988.
.. [4] W. J. Cody, *Rational Chebyshev approximations for the error function*, 1969.
M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 6.3.5, 6.3.18, 6.4.6, 6.4.12.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import SMALLEST, Array, Mask

LARGEST = 500.0
_STEPS = 100_000
_NEARLY_NORMAL = 1e5  # degrees of freedom from which on t has its expansion
_FEW = 30  # values that are worked out one by one: as arrays they take longer
_NORMAL = 1e9  # degrees of freedom from which on a law is taken as normal
_EPS = 1e-16
_ROUNDING = 1e-15  # of a logarithm, which the function's own rounding moves
_TINY = 1e-300


def gamma_tails(a: float, x: float) -> tuple[float, float]:
    """Return P(a, x) and Q(a, x)."""
    if x <= 0.0:
        return 0.0, 1.0
    if a > LARGEST:
        scale = math.exp(-_stirling(a) - _deviance(a, x)) * math.sqrt(a / (2.0 * math.pi))
    else:
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
    if max(a, b) > LARGEST:
        n = a + b
        size = (
            _stirling(n) - _stirling(a) - _stirling(b) - _deviance(a, n * x) - _deviance(b, n * y)
        )
        scale = math.exp(size) * math.sqrt(b / (2.0 * math.pi * a * n))
    else:
        front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
        scale = math.exp(front + a * math.log(x) + b * math.log(y)) / a

    def term(n: int) -> tuple[float, float]:
        m = n // 2
        if n % 2:
            return -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)), 1.0
        return m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)), 1.0

    return scale / _fraction(1.0, term)


def _stirling(a: float) -> float:
    """Return δ(a) = ln Γ(a + 1) − (a + ½) ln a + a − ½ ln 2π."""
    if a < 20.0:
        return math.lgamma(a + 1.0) - (a + 0.5) * math.log(a) + a - 0.5 * math.log(2.0 * math.pi)
    s = 1.0 / a**2
    return (1 / 12 - s * (1 / 360 - s * (1 / 1260 - s * (1 / 1680 - s / 1188)))) / a


def _deviance(a: float, m: float) -> float:
    """Return D(a, m) without the digits that its terms cancel where m is near a."""
    v = (a - m) / (a + m)
    if abs(v) > 0.1:
        return a * math.log(a / m) + m - a
    total, term, n = (a - m) * v, 2.0 * a * v, 1
    while True:
        term *= v * v
        after = total + term / (2 * n + 1)
        if after == total:
            return total
        total, n = after, n + 1


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
    bracket is cut where the line between its ends meets the value, of which one that stays twice
    is halved (Illinois).
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
    last, side = math.inf, 0
    for _ in range(200):
        if at_low == 0.0 or at_high == 0.0 or high - low <= 2e-16 * max(abs(low), abs(high), 1.0):
            break
        middle = low - at_low * (high - low) / (at_high - at_low)
        if not low < middle < high:
            middle = 0.5 * (low + high)
        at = off(middle)
        if abs(middle - last) <= _ROUNDING * max(abs(middle), 1.0):
            return math.exp(middle)
        last = middle
        if (at > 0.0) == (at_low > 0.0):
            low, at_low = middle, at
            at_high, side = (0.5 * at_high if side < 0 else at_high), -1
        else:
            high, at_high = middle, at
            at_low, side = (0.5 * at_low if side > 0 else at_low), 1
    return math.exp(low if abs(at_low) < abs(at_high) else high)


_KEPT = 256  # quantiles: a fit asks for the same one of each of its parameters
_MANY = 100  # degrees of freedom from which on SciPy is imported
_ARRAY = 600  # values from which on passes over all are quicker than one by one
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

    Many different ones come from SciPy's quantiles, where it is installed, after a step of Newton's
    on its tails.
    """
    different, place = np.unique(dof, return_inverse=True)
    found = _many_factors(confidence, different) if len(different) >= _MANY else None
    if found is None:  # `coverage_factor` keeps what it has found
        found = np.array([coverage_factor(confidence, nu) for nu in different.tolist()])
    return np.asarray(found[place.reshape(dof.shape)])


def _many_factors(confidence: float, different: Array) -> Array | None:
    """Return the factors by SciPy, None where it is not installed."""
    try:
        from scipy.special import betainc, gammaln, ndtri, stdtrit
    except ImportError:
        return None
    nu = np.where(different > 0.0, different, np.nan)
    p = (1.0 - confidence) / 2.0
    with np.errstate(invalid="ignore"):  # nan and infinite degrees of freedom
        k = -stdtrit(nu, p)
        constant = gammaln((nu + 1.0) / 2.0) - gammaln(nu / 2.0) - 0.5 * np.log(nu * np.pi)
        density = 2.0 * np.exp(constant - (nu + 1.0) / 2.0 * np.log1p(k**2 / nu))
        better = k + (betainc(nu / 2.0, 0.5, nu / (nu + k**2)) - 2.0 * p) / density
    k = np.where(nu < _KNOWN, better, k)
    return np.asarray(np.where(np.isinf(nu), -ndtri(p), k))


@lru_cache(_KEPT)
def t_quantile(p: float, dof: float) -> float:
    """Student's t that is not exceeded with probability `p`; normal at infinite `dof`."""
    if not dof > 0.0:
        return math.nan
    if not 0.0 < p < 1.0:
        return normal_quantile(p)
    if dof > _NEARLY_NORMAL:  # [1]_ (26.7.5), whose next term is z⁷/384ν³
        z = normal_quantile(p)
        second = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * dof)
        return z + ((z**3 + z) / 4.0 + second) / dof
    if p > 0.5:
        return -t_quantile(1.0 - p, dof)
    central = 1.0 - 2.0 * p
    if central == 0.0:
        return 0.0
    z = -normal_quantile(p)
    start = z + (z**3 + z) / (4.0 * max(dof, 1.0))
    if central < 0.5:
        return -solve(lambda t: _t_tails(t, dof)[1], central, start)
    return -solve(lambda t: _t_tails(t, dof)[0], 2.0 * p, start)


def t_tail(t: float, dof: float) -> float:
    """Probability that a Student t is farther from zero than `t`, both sides together."""
    if not dof > 0.0:
        return math.nan
    if not math.isfinite(t) or dof > _NORMAL:
        return math.erfc(abs(t) / math.sqrt(2.0))
    return _t_tails(abs(float(t)), float(dof))[0]


def t_tails(square: Array, dof: Array) -> Array:
    """Return `t_tail` of many, each by t², with as many degrees of freedom or as broadcast."""
    square, dof = np.broadcast_arrays(square, dof)
    if dof.max(initial=0.0) > 2.0 * LARGEST or dof.size <= _FEW:
        pairs = zip(np.sqrt(square).ravel().tolist(), dof.ravel().tolist(), strict=True)
        return np.array([t_tail(*each) for each in pairs]).reshape(dof.shape)
    x, half = dof / (dof + square), dof / 2.0
    near = x > (half + 1.0) / (half + 2.5)  # I_x(ν/2, 1/2), or one less I_(1−x)(1/2, ν/2)
    a, b, x = np.where(near, 0.5, half), np.where(near, half, 0.5), np.where(near, 1.0 - x, x)
    different, place = np.unique(half, return_inverse=True)
    norm = [math.lgamma(h + 0.5) - math.lgamma(h) - math.lgamma(0.5) for h in different.tolist()]
    front = np.array(norm)[place.reshape(half.shape)]
    value, c, d = np.ones(x.shape), np.ones(x.shape), np.zeros(x.shape)
    for n in range(1, _STEPS):  # Lentz's algorithm, as in `_fraction`
        m = n // 2
        term = m * (b - m) if n % 2 == 0 else -(a + m) * (a + b + m)
        term = term * x / ((a + n - 1.0) * (a + n))
        d, c = 1.0 / (1.0 + term * d), 1.0 + term / c
        value *= c * d
        if (np.abs(c * d - 1.0) < _ROUNDING).all():
            break
    with np.errstate(divide="ignore"):
        lower = np.exp(front + a * np.log(x) + b * np.log1p(-x)) / (a * value)
    return np.asarray(np.where(near, 1.0 - lower, lower))


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


def normal_quantiles(p: Array) -> Array:
    """Return `normal_quantile` of many, by the rational functions of [3]_."""
    q = p - 0.5
    tail = np.sqrt(-np.log(np.minimum(p, 1.0 - p)))
    r = np.where(
        np.abs(q) <= 0.425, 0.180625 - q * q, np.where(tail <= 5.0, tail - 1.6, tail - 5.0)
    )
    near, far, farthest = (np.polyval(above, r) / np.polyval(below, r) for above, below in _AS241)
    outside = np.where(tail <= 5.0, far, farthest)
    return np.where(np.abs(q) <= 0.425, q * near, np.sign(q) * outside)


# Coefficients of [3]_, highest power first: near the middle, in the tails, far out.
_RATIONAL = """
2509.0809287301226727 33430.575583588128105 67265.770927008700853 45921.953931549871457
13731.693765509461125 1971.5909503065514427 133.14166789178437745 3.3871328727963666080
5226.495278852854561 28729.085735721942674 39307.89580009271061 21213.794301586595867
5394.1960214247511077 687.1870074920579083 42.313330701600911252 1.0
7.74545014278341407640e-4 0.0227238449892691845833 0.24178072517745061177 1.27045825245236838258
3.64784832476320460504 5.7694972214606914055 4.6303378461565452959 1.42343711074968357734
1.05075007164441684324e-9 5.475938084995344946e-4 0.0151986665636164571966
0.14810397642748007459 0.68976733498510000455 1.6763848301838038494 2.05319162663775882187 1.0
2.01033439929228813265e-7 2.71155556874348757815e-5 0.0012426609473880784386
0.026532189526576123093 0.29656057182850489123 1.7848265399172913358 5.4637849111641143699
6.6579046435011037772
2.04426310338993978564e-15 1.4215117583164458887e-7 1.8463183175100546818e-5
7.868691311456132591e-4 0.0148753612908506148525 0.13692988092273580531 0.59983220655588793769
1.0
"""
_AS241 = np.array(_RATIONAL.split(), dtype=np.float64).reshape(3, 2, 8)


def erf(z: Array, decay: Array | None = None) -> Array:
    """Return the error function of each number, by the rational functions of [4]_.

    Parameters
    ----------
    z : array
    decay : array, optional
        exp(−z²), if it is known.
    """
    if z.size < _ARRAY:
        return np.array([*map(math.erf, z.ravel().tolist())]).reshape(z.shape)
    x = np.minimum(np.abs(z), 6.0)  # beyond which it is one
    small, square = x <= 0.46875, x * x
    found = np.exp(-square) if decay is None else decay.copy()
    found *= _polynomial(_CODY[2], x) / _polynomial(_CODY[3], x)
    np.subtract(1.0, found, out=found)
    if small.any():
        few = square[small]
        found[small] = x[small] * _polynomial(_CODY[0], few) / _polynomial(_CODY[1], few)
    return np.asarray(np.copysign(found, z))


def _polynomial(coefficients: list[float], x: Array) -> Array:
    """Return a polynomial, highest power first, as `np.polyval` in half the passes."""
    first, *others = coefficients
    value = np.full_like(x, first)
    for each in others:
        value *= x
        value += each
    return value


# Coefficients of [4]_, highest power first: up to .46875, of z², and beyond, of z, each over the
# next.
_RATIONAL_ERF = """
1.85777706184603153e-1 3.1611237438705656 113.864154151050156 377.485237685302021
3209.37758913846947;
1.0 23.6012909523441209 244.024637934444173 1282.61652607737228 2844.23683343917062;
2.15311535474403846e-8 0.564188496988670089 8.88314979438837594 66.1191906371416295
298.635138197400131 881.95222124176909 1712.04761263407058 2051.07837782607147 1230.33935479799725;
1.0 15.7449261107098347 117.693950891312499 537.181101862009858 1621.38957456669019
3290.79923573345963 4362.61909014324716 3439.36767414372164 1230.33935480374942
"""
_CODY = [[*map(float, line.split())] for line in _RATIONAL_ERF.split(";")]


def beta_quantile(p: float, a: float, b: float) -> float:
    """Value that a variable of the beta law does not exceed with probability `p`."""

    def lower(odds: float) -> float:
        return beta_tails(odds / (1.0 + odds), 1.0 / (1.0 + odds), a, b)[0]

    odds = solve(lower, p, a / b) if p < 0.5 else 0.0
    if p >= 0.5:  # by the upper tail, which keeps its digits
        odds = solve(lambda o: beta_tails(o / (1 + o), 1 / (1 + o), a, b)[1], 1.0 - p, a / b)
    return odds / (1.0 + odds)


_LOG_NODES = np.linspace(math.log(1e-3), math.log(1e4), 400)  # of f, in `f_log_tails`


@lru_cache(_KEPT)
def f_quantile(p: float, k: float, dof: float) -> float:
    """Ratio of variances on `k` and `dof` degrees of freedom not exceeded with probability `p`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if not 0.0 < p < 1.0:
        return {0.0: 0.0, 1.0: math.inf}.get(p, math.nan)
    if dof > _NORMAL:
        return chi2_quantile(p, k) / k
    if p < 0.5:
        return solve(lambda f: _f_tails(f, k, dof)[1], p, 1.0)
    return solve(lambda f: _f_tails(f, k, dof)[0], 1.0 - p, 1.0)


def f_tail(f: float, k: float, dof: float) -> float:
    """Probability that a ratio of variances on `k` and `dof` degrees of freedom exceeds `f`."""
    if not (k > 0.0 and dof > 0.0):
        return math.nan
    if not 0.0 < f < math.inf:
        return math.nan if math.isnan(f) else float(f <= 0.0)
    if dof > _NORMAL:
        return chi2_tail(k * f, k)
    return _f_tails(float(f), float(k), float(dof))[0]


def f_log_tails(f: Array, k: float, dof: float) -> Array:
    """Return ln of `f_tail` of many f, to .005: straight in ln f between nodes."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.interp(np.log(f), _LOG_NODES, _at_nodes(k, dof)))


@lru_cache(_KEPT)
def _at_nodes(k: float, dof: float) -> Array:
    tails = [f_tail(math.exp(each), k, dof) for each in _LOG_NODES.tolist()]
    return np.asarray(np.log(np.maximum(tails, np.finfo(float).tiny)))


def _f_tails(f: float, k: float, dof: float) -> tuple[float, float]:
    """Return the probabilities above and below a ratio of variances."""
    whole = k * f + dof
    return beta_tails(dof / whole, k * f / whole, dof / 2.0, k / 2.0)


@lru_cache(_KEPT)
def chi2_quantile(p: float, dof: float) -> float:
    """Sum of `dof` squared standard normals that is not exceeded with probability `p`."""
    if not dof > 0.0:
        return math.nan
    if not 0.0 < p < 1.0:
        return {0.0: 0.0, 1.0: math.inf}.get(p, math.nan)
    if dof > _NORMAL:  # Wilson and Hilferty
        return (
            dof * (1.0 - 2.0 / (9.0 * dof) + normal_quantile(p) * math.sqrt(2.0 / 9.0 / dof)) ** 3
        )
    if p < 0.5:
        return 2.0 * solve(lambda x: gamma_tails(dof / 2.0, x)[0], p, dof / 2.0)
    return 2.0 * solve(lambda x: gamma_tails(dof / 2.0, x)[1], 1.0 - p, dof / 2.0)


def chi2_tail(x: float, dof: float) -> float:
    """Probability that the sum of `dof` squared standard normals exceeds `x`."""
    if not dof > 0.0:
        return math.nan
    if not math.isfinite(x):
        return math.nan if math.isnan(x) else float(x < 0.0)
    if dof > _NORMAL:
        z = ((x / dof) ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * dof)) / math.sqrt(2.0 / 9.0 / dof)
        return 0.5 * math.erfc(z / math.sqrt(2.0))
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


def _shifted(x: Array) -> tuple[Array, list[tuple[Array, Mask]]]:
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

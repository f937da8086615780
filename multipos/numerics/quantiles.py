"""Quantiles and tails of the four laws behind every stated confidence.

`coverage_factor` is k of a two-sided interval, `coverage_factors` that of many degrees of freedom
and `coverage_by_tenths` that of degrees rounded down to a tenth. Of Student's law there are
`t_quantile`, `t_tail` and, of many, `t_tails`; of the normal law `normal_quantile`,
`normal_quantiles` and `erf`; of ratios of variances `f_quantile`, `f_tail` and, of many,
`f_log_tails`; of sums of squares `chi2_quantile` and `chi2_tail`; of the beta law `beta_quantile`.
`solve` inverts a monotone function, and `check_confidence` refuses what is no probability.

An estimate with standard uncertainty u on ν degrees of freedom is stated with expanded uncertainty

    U = k u,    P(|T_ν| ≤ k) = confidence        (JCGM 100, G.3),

where T_ν is Student's t, and the normal law at ν = ∞ (the reading noise is known beforehand). Sums
of squares are judged by χ²_ν against a known variance, and by F_{k,ν} = (χ²_k/k) / (χ²_ν/ν) against
one estimated on ν degrees of freedom; at ν = ∞ the second is χ²_k/k.

Degrees of freedom may be fractional (Welch–Satterthwaite) and infinite; where they are not positive
the question has no answer, and nan is returned. Scalars in, float out, but for those of many: a fit
asks for a handful, in less time than it takes to import `scipy.special`.

The short tail is used throughout: 1 − p keeps no digits below 1e-16, so a two-sided factor is
computed from (1 − confidence)/2 and not from 1 − (1 − confidence)/2.

References
----------
.. [1] M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 1964.
.. [2] M. J. Wichura, Algorithm AS 241, Applied Statistics 37, 1988.
.. [3] W. J. Cody, *Rational Chebyshev approximations for the error function*, 1969.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from multipos.errors import UsageError
from multipos.numerics.arrays import SMALLEST, Array
from multipos.numerics.incomplete import LARGEST, STEPS, TINY, beta_tails, gamma_tails

_NEARLY_NORMAL = 1e5  # degrees of freedom from which on t has its expansion
_FEW = 30  # values that are worked out one by one: as arrays they take longer
_NORMAL = 1e9  # degrees of freedom from which on a law is taken as normal
_ROUNDING = 1e-15  # of a logarithm, which the function's own rounding moves


def solve(function: Callable[[float], float], target: float, start: float) -> float:
    """Return the positive x at which a monotone positive function has a value.

    The logarithm of the function is all but linear in that of x far out on either side: a
    bracket is cut where the line between its ends meets the value, of which one that stays twice
    is halved (Illinois).
    """
    goal = math.log(target)

    def off(u: float) -> float:
        return math.log(max(function(math.exp(u)), TINY)) - goal

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
    for n in range(1, STEPS):  # Lentz's algorithm, as in `_fraction`
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
    """Return `normal_quantile` of many, by the rational functions of [2]_."""
    q = p - 0.5
    tail = np.sqrt(-np.log(np.minimum(p, 1.0 - p)))
    r = np.where(
        np.abs(q) <= 0.425, 0.180625 - q * q, np.where(tail <= 5.0, tail - 1.6, tail - 5.0)
    )
    near, far, farthest = (np.polyval(above, r) / np.polyval(below, r) for above, below in _AS241)
    outside = np.where(tail <= 5.0, far, farthest)
    return np.where(np.abs(q) <= 0.425, q * near, np.sign(q) * outside)


# Coefficients of [2]_, highest power first: near the middle, in the tails, far out.
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
    """Return the error function of each number, by the rational functions of [3]_.

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


# Coefficients of [3]_, highest power first: up to .46875, of z², and beyond, of z, each over the
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


def coverage_by_tenths(confidence: float, dof: Array) -> Array:
    """Return the coverage factor of each dof, rounded down to a tenth to look up each but once."""
    lowered = np.where(np.isfinite(dof), np.floor(dof * 10.0) / 10.0, dof)
    different, place = np.unique(lowered, return_inverse=True)
    factors = np.array([coverage_factor(confidence, nu) for nu in different.tolist()])
    return np.asarray(factors[place.reshape(dof.shape)])

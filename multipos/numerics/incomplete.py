"""Incomplete gamma and beta functions, by series and continued fractions.

`gamma_tails` returns both parts of the gamma function, `beta_tails` those of the beta function.

They are what the laws behind a stated confidence need, in the few values that a fit asks for:
importing `scipy.special` takes longer than such a fit. With a and b up to `LARGEST` their
logarithms of factorials keep twelve digits; beyond, the factor before the series is written with
the remainder δ of Stirling's formula and the deviance D, which lose none [2]_,

    x^a e^−x/Γ(a + 1) = exp(−δ(a) − D(a, x))/√(2π a),     D(a, m) = a ln(a/m) + m − a.

    P(a, x) = γ(a, x)/Γ(a),   Q = 1 − P,   I_x(a, b) = B(x; a, b)/B(a, b)

by the series [1]_ (6.5.29) below x = a + 1 and the fraction (6.5.31) above; and by the fraction
(26.5.8) up to x = (a + 1)/(a + b + 2), of 1 − x beyond. What is small keeps its digits: each is
computed as itself, and the other as one less it.

References
----------
.. [1] M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 1964.
.. [2] C. Loader, *Fast and accurate computation of binomial probabilities*, 2000.
"""

import math
from collections.abc import Callable

LARGEST = 500.0
STEPS = 100_000
_EPS = 1e-16
TINY = 1e-300


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
    for n in range(1, STEPS):
        a, b = term(n)
        d = 1.0 / (b + a * d or TINY)
        c = b + a / c or TINY
        value *= c * d
        if abs(c * d - 1.0) < _EPS:
            break
    return value

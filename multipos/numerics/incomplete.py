"""Incomplete gamma and beta functions, by series and continued fractions.

They are what the laws behind a stated confidence need, in the few values that a fit asks for:
importing `scipy.special` takes longer than such a fit. With a and b up to `LARGEST` their
logarithms of factorials keep twelve digits; beyond, SciPy's expansions are the better way.

    P(a, x) = γ(a, x)/Γ(a),   Q = 1 − P,   I_x(a, b) = B(x; a, b)/B(a, b)

by the series [1]_ (6.5.29) below x = a + 1 and the fraction (6.5.31) above; and by the fraction
(26.5.8) up to x = (a + 1)/(a + b + 2), of 1 − x beyond. What is small keeps its digits: each is
computed as itself, and the other as one less it.

References
----------
.. [1] M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 1964.
"""

import math
from collections.abc import Callable

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

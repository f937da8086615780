"""Digamma and trigamma of positive arguments, by recurrence and their asymptotic series.

`digamma` returns ψ, `trigamma` ψ', and `inverse_trigamma` the x whose ψ' is given.

    ψ(x) = ln x − 1/2x − 1/12x² + 1/120x⁴ − 1/252x⁶ + …,     ψ(x) = ψ(x + 1) − 1/x,        (1)
    ψ'(x) = 1/x + 1/2x² + 1/6x³ − 1/30x⁵ + 1/42x⁷ − …,       ψ'(x) = ψ'(x + 1) + 1/x².     (2)

From x = 10 on the first term left out is below 1e-11. SciPy has both, but takes longer to import
than a fit takes.

References
----------
M. Abramowitz, I. A. Stegun, *Handbook of Mathematical Functions*, 6.3.5, 6.3.18, 6.4.6, 6.4.12.
"""

import numpy as np

from multipos.numerics.arrays import Array, Mask

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

"""Error-free transformations against rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from multipos.numerics import exact_sums

EPS = 2.0**-53  # relative error of one rounding

# the error of a product must not underflow, nor the split overflow
NUMBERS = st.floats(-1e100, 1e100).filter(lambda x: x == 0.0 or abs(x) > 1e-100)


@given(a=NUMBERS, b=NUMBERS)
def test_product_loses_nothing(a, b):
    p, e = exact_sums.two_product(np.array(a), np.array(b))
    assert p == a * b
    assert Fraction(float(p)) + Fraction(float(e)) == Fraction(a) * Fraction(b)


@given(numbers=st.lists(NUMBERS, min_size=1, max_size=40))
def test_high_parts_add_exactly(numbers):
    """The high parts lose nothing, the rest no more than (n ε)² of the largest term."""
    high, rest = exact_sums.fold(np.array(numbers), np.zeros(len(numbers)))
    exact = sum(map(Fraction, numbers))
    largest, n = max(map(abs, numbers)), len(numbers)
    assert abs(Fraction(float(high)) + Fraction(float(rest)) - exact) <= (
        Fraction(4 * n * n * EPS) ** 2 * Fraction(largest)
    )


@given(a=NUMBERS)
def test_split_halves_are_short(a):
    high, low = exact_sums.split(np.array(a))
    assert Fraction(float(high)) + Fraction(float(low)) == Fraction(a)
    for half in (float(high), float(low)):
        assert float(half * half) == Fraction(half) ** 2  # 26 bits: the square is exact


@pytest.mark.parametrize("block", [1, 16, 1 << 15])
@pytest.mark.parametrize(("n", "p", "k"), [(1, 1, 1), (7, 3, 1), (24, 5, 2), (53, 4, 3)])
@pytest.mark.parametrize("weighted", [False, True])
def test_residuals_survive_cancellation(monkeypatch, block, n, p, k, weighted):
    """y is X b + v r rounded: what is left is rounding, and must come out to its own last bits."""
    monkeypatch.setattr(exact_sums, "_BLOCK", block)
    rng = np.random.default_rng(n + p + k)
    X, b, r = rng.standard_normal((n, p)), rng.standard_normal((p, k)), rng.standard_normal((n, k))
    v = rng.uniform(0.1, 10.0, n) if weighted else np.ones(n)
    exact_model = _matmul(X, b) + _fractions(v)[:, None] * _fractions(r)
    y = exact_model.astype(np.float64)
    f = exact_sums.residual(y, X, b, r, v if weighted else None)
    exact = _fractions(y) - exact_model
    # rounding of the result, and (n ε)² of the terms: p + 2 terms of size 10 at most
    bound = EPS * np.abs(exact.astype(np.float64)) + ((p + 2) * EPS) ** 2 * 100
    assert (np.abs((_fractions(f) - exact).astype(np.float64)) <= bound).all()


@pytest.mark.parametrize("block", [1, 16, 1 << 15])
@pytest.mark.parametrize(("n", "p", "k"), [(2, 1, 1), (7, 3, 1), (24, 5, 2), (53, 4, 3)])
def test_cross_residuals_survive_cancellation(monkeypatch, block, n, p, k):
    # eq. (2) of estimation.known
    monkeypatch.setattr(exact_sums, "_BLOCK", block)
    rng = np.random.default_rng(n + p + k)
    X, r = rng.standard_normal((n, p)), rng.standard_normal((n, k))
    exact_product = _matmul(X.T, r)
    c = exact_product.astype(np.float64)
    g = exact_sums.cross_residual(X, r, c)
    exact = _fractions(c) - exact_product
    bound = EPS * np.abs(exact.astype(np.float64)) + (n * EPS) ** 2 * 100
    assert (np.abs((_fractions(g) - exact).astype(np.float64)) <= bound).all()
    np.testing.assert_allclose(exact_sums.cross_residual(X, r), -c, rtol=2 * EPS, atol=0)


def test_product_is_rounded_once():
    rng = np.random.default_rng(3)
    X, b = rng.standard_normal((9, 4)), rng.standard_normal((4, 2))
    exact = _matmul(X, b).astype(np.float64)
    np.testing.assert_allclose(exact_sums.product(X, b), exact, rtol=2 * EPS, atol=0)


def test_plain_arithmetic_would_fail():
    """The case is hard: 1e16 + 1 − 1e16, in a sum of products."""
    X, b = np.array([[1e8, 1.0, -1e8]]), np.array([[1e8], [1.0], [1e8]])
    zero = np.zeros((1, 1))
    assert (X @ b)[0, 0] in (0.0, 2.0)
    assert exact_sums.residual(zero, X, b, zero)[0, 0] == -1.0


def _fractions(a):
    return np.vectorize(Fraction, otypes=[object])(a)


def _matmul(a, b):
    return _fractions(a) @ _fractions(b)

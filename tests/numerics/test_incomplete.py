"""Incomplete gamma and beta functions against closed forms and against SciPy's."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from multipos.numerics.incomplete import LARGEST, beta_tails, gamma_tails
from multipos.numerics.quantiles import solve, t_tail, t_tails

SHAPE = st.floats(0.25, LARGEST)


@pytest.mark.parametrize("x", [1e-9, 0.3, 1.0, 2.5, 40.0])
def test_gamma_of_one_and_of_a_half(x):
    lower, upper = gamma_tails(1.0, x)
    assert lower == pytest.approx(-math.expm1(-x), rel=1e-13)
    assert upper == pytest.approx(math.exp(-x), rel=1e-13)
    assert gamma_tails(0.5, x)[0] == pytest.approx(math.erf(math.sqrt(x)), rel=1e-13)


@pytest.mark.parametrize("x", [1e-12, 0.2, 0.5, 0.9, 1 - 1e-9])
def test_beta_with_whole_shapes(x):
    y = 1.0 - x
    assert beta_tails(x, y, 1.0, 3.0)[0] == pytest.approx(
        -math.expm1(3 * math.log1p(-x)), rel=1e-12
    )
    assert beta_tails(x, y, 2.0, 1.0)[0] == pytest.approx(x * x, rel=1e-13)
    assert beta_tails(x, y, 2.0, 2.0)[1] == pytest.approx(y * y * (3.0 - 2.0 * y), rel=1e-12)


def test_the_ends():
    assert gamma_tails(2.0, 0.0) == (0.0, 1.0)
    assert beta_tails(0.0, 1.0, 2.0, 3.0) == (0.0, 1.0)
    assert beta_tails(1.0, 0.0, 2.0, 3.0) == (1.0, 0.0)
    # where the fraction of x gives way to that of 1 - x: a = b, a half each
    assert beta_tails(0.5, 0.5, 3.0, 3.0) == pytest.approx((0.5, 0.5), rel=1e-14)


# The logarithms of factorials are of size 2600 at most, and exact to their last digit: 3e-13 each.
SAME = 2e-12


@given(a=SHAPE, x=st.floats(1e-3, 2.0))
def test_gamma_is_scipys(a, x):
    lower, upper = gamma_tails(a, a * x)
    assert lower == pytest.approx(special.gammainc(a, a * x), rel=SAME, abs=1e-290)
    assert upper == pytest.approx(special.gammaincc(a, a * x), rel=SAME, abs=1e-290)


@given(a=SHAPE, b=SHAPE, x=st.floats(1e-3, 0.999))
def test_beta_is_scipys(a, b, x):
    lower, upper = beta_tails(x, 1.0 - x, a, b)
    # 1 - x is rounded, which b multiplies
    assert lower == pytest.approx(special.betainc(a, b, x), rel=1e-10, abs=1e-290)
    assert upper == pytest.approx(special.betainc(b, a, 1.0 - x), rel=1e-10, abs=1e-290)


@pytest.mark.parametrize("start", [1e-6, 1.0, 1e6])
def test_solve_from_anywhere(start):
    assert solve(lambda x: x**3, 8.0, start) == pytest.approx(2.0, rel=1e-14)
    assert solve(lambda x: math.exp(-x), 1e-5, start) == pytest.approx(-math.log(1e-5), rel=1e-13)


def test_tails_of_t_at_once_by_hand():
    """Cauchy's law for one degree of freedom, 1 − t/sqrt(2 + t²) for two."""
    t = np.array([0.0, 0.1, 1.0, 4.0, 300.0])
    found = t_tails(t**2, np.array([[1.0], [2.0]]))
    np.testing.assert_allclose(found[0], 1.0 - 2.0 / np.pi * np.arctan(t), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found[1], 1.0 - t / np.sqrt(2.0 + t**2), rtol=1e-10, atol=1e-15)
    nu = np.array([3.7, 120.0, 900.0])
    one = [[t_tail(each, dof) for each in t.tolist()] for dof in nu.tolist()]
    np.testing.assert_allclose(t_tails(t**2, nu[:, None]), one, rtol=1e-11)

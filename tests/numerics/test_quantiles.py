"""Quantiles and tails against closed forms, printed tables and each other."""

import math

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from multipos.numerics.polygamma import digamma, inverse_trigamma, trigamma
from multipos.numerics.quantiles import (
    beta_quantile,
    chi2_quantile,
    chi2_tail,
    coverage_factor,
    coverage_factors,
    erf,
    f_log_tails,
    f_quantile,
    f_tail,
    normal_quantile,
    normal_quantiles,
    solve,
    t_quantile,
    t_tail,
)

PROBABILITY = st.floats(0.001, 0.999)
DOF = st.floats(0.5, 1e6)

# SciPy before 1.17 ends its search for a quantile early: of t where the tail is off by up to 2e-8,
# of F at dof of 1e10 by 2e-7, both far below the four digits that a coverage factor is printed with
EARLY = tuple(map(int, scipy.__version__.split(".")[:2])) < (1, 17)
T_SEARCH, F_SEARCH = (1e-7, 1e-6) if EARLY else (0.0, 0.0)


# --- closed forms; 1e-13 is some hundred roundings, the tails being conditioned like 1/p

P = [0.001, 0.05, 0.3, 0.5, 0.6, 0.9, 0.975, 0.999]


@pytest.mark.parametrize("p", P)
def test_t_with_one_degree_of_freedom_is_cauchy(p):
    tangent = math.tan(math.pi * (p - 0.5))
    assert t_quantile(p, 1) == pytest.approx(tangent, rel=max(1e-13, T_SEARCH), abs=1e-15)


@pytest.mark.parametrize("p", P)
def test_t_with_two_degrees_of_freedom(p):
    a = 2 * p - 1
    root = a * math.sqrt(2 / (1 - a * a))
    assert t_quantile(p, 2) == pytest.approx(root, rel=max(1e-13, T_SEARCH), abs=1e-15)


@pytest.mark.parametrize("t", [-30.0, -1.0, 0.0, 0.3, 2.0, 12.7])
def test_t_tails_with_one_and_two_degrees_of_freedom(t):
    cauchy = 2 / math.pi * math.atan2(1, abs(t))
    assert t_tail(t, 1) == pytest.approx(cauchy, rel=1e-13)
    assert t_tail(t, 2) == pytest.approx(1 - abs(t) / math.sqrt(2 + t * t), rel=1e-10)


@pytest.mark.parametrize("x", [0.0, 0.01, 1.0, 10.0, 100.0])
def test_chi2_tails_with_one_and_two_degrees_of_freedom(x):
    assert chi2_tail(x, 1) == pytest.approx(math.erfc(math.sqrt(x / 2)), rel=1e-13)
    assert chi2_tail(x, 2) == pytest.approx(math.exp(-x / 2), rel=1e-13)


@pytest.mark.parametrize("p", [1e-12, *P])
def test_chi2_quantile_with_two_degrees_of_freedom(p):
    assert chi2_quantile(p, 2) == pytest.approx(-2 * math.log1p(-p), rel=1e-13)


@pytest.mark.parametrize("dof", [0.7, 1, 2, 13, 1000.5])
@pytest.mark.parametrize("p", P)
def test_f_with_two_degrees_of_freedom_above(p, dof):
    f = dof / 2 * ((1 - p) ** (-2 / dof) - 1)
    assert f_quantile(p, 2, dof) == pytest.approx(f, rel=1e-12)
    assert f_tail(f, 2, dof) == pytest.approx(1 - p, rel=1e-12)
    assert f_tail(-dof / 2, 2, dof) == 1.0  # by rounding of sums that differ in nothing


# --- printed tables: JCGM 100 table G.2 for t, Abramowitz and Stegun tables 26.8, 26.9 and
# 26.10 (and any textbook) for the rest, to the digits printed


@pytest.mark.parametrize(
    ("dof", "confidence", "k"),
    [
        (1, 0.95, 12.71),
        (1, 0.9973, 235.80),
        (2, 0.95, 4.30),
        (5, 0.95, 2.57),
        (5, 0.9545, 2.65),
        (10, 0.6827, 1.05),
        (20, 0.99, 2.85),
        (100, 0.95, 1.984),
        (math.inf, 0.90, 1.645),
        (math.inf, 0.95, 1.960),
        (math.inf, 0.99, 2.576),
    ],
)
def test_coverage_factor_meets_the_guide(dof, confidence, k):
    digits = len(str(k).split(".")[1])
    assert coverage_factor(confidence, dof) == pytest.approx(k, abs=0.51 * 10**-digits)


def test_published_values():
    assert t_quantile(0.975, 1) == pytest.approx(12.7062, abs=5e-5)
    assert t_quantile(0.975, 30) == pytest.approx(2.0423, abs=5e-5)
    assert (normal_quantile(0.0), normal_quantile(1.0)) == (-math.inf, math.inf)
    assert math.isnan(normal_quantile(1.5))
    assert normal_quantile(0.975) == pytest.approx(1.959963984540054, rel=1e-15)
    assert f_quantile(0.90, 7, 13) == pytest.approx(2.2341, abs=5e-5)
    assert f_quantile(0.95, 3, 10) == pytest.approx(3.7083, abs=5e-5)
    assert chi2_quantile(0.95, 1) == pytest.approx(3.8415, abs=5e-5)
    assert chi2_quantile(0.95, 5) == pytest.approx(11.0705, abs=5e-5)
    assert chi2_quantile(0.999, 10) == pytest.approx(29.588, abs=5e-4)


# --- one against another


@given(p=PROBABILITY, dof=DOF)
def test_t_quantile_and_tail_are_inverse(p, dof):
    both = pytest.approx(2 * min(p, 1 - p), rel=max(1e-9, T_SEARCH))
    assert t_tail(t_quantile(p, dof), dof) == both


@given(p=PROBABILITY, k=st.floats(1.0, 1e6), dof=DOF)  # k counts terms, one at least
def test_f_quantile_and_tail_are_inverse(p, k, dof):
    assert f_tail(f_quantile(p, k, dof), k, dof) == pytest.approx(1 - p, rel=1e-7)


@given(p=PROBABILITY, dof=DOF)
def test_chi2_quantile_and_tail_are_inverse(p, dof):
    assert chi2_tail(chi2_quantile(p, dof), dof) == pytest.approx(1 - p, rel=1e-9)


@given(confidence=st.floats(0.5, 0.999), dof=DOF)
def test_t_squared_is_f(confidence, dof):
    k = coverage_factor(confidence, dof)
    assert k * k == pytest.approx(f_quantile(confidence, 1, dof), rel=1e-7)


@given(confidence=st.floats(0.5, 0.999), dof=st.floats(1, 1e5))
def test_fewer_degrees_of_freedom_widen_the_interval(confidence, dof):
    assert coverage_factor(confidence, dof) > coverage_factor(confidence, 1.1 * dof)
    assert coverage_factor(confidence, dof) > coverage_factor(confidence, math.inf)


# --- limits


@pytest.mark.parametrize("p", P)
def test_infinite_degrees_of_freedom_are_the_limit(p):
    # the next term of t in 1/dof is (z³ + z)/4 dof: below 1e-11 relative at 1e12
    assert t_quantile(p, math.inf) == normal_quantile(p)
    assert t_quantile(p, 1e12) == pytest.approx(normal_quantile(p), rel=1e-11, abs=1e-15)
    assert f_quantile(p, 3, math.inf) == pytest.approx(chi2_quantile(p, 3) / 3, rel=1e-15)
    limit = pytest.approx(f_quantile(p, 3, math.inf), rel=max(1e-8, F_SEARCH))
    assert f_quantile(p, 3, 1e10) == limit


def test_tails_at_infinite_degrees_of_freedom():
    assert t_tail(1.959963984540054, math.inf) == pytest.approx(0.05, rel=1e-14)
    assert f_tail(2.0, 3, math.inf) == chi2_tail(6.0, 3)


def test_far_tails_keep_their_digits():
    assert t_tail(1e10, 1) == pytest.approx(2e-10 / math.pi, rel=1e-12)
    assert coverage_factor(1 - 2**-40, 1) == pytest.approx(2**41 / math.pi, rel=1e-12)


@pytest.mark.parametrize("dof", [0.0, -1.0, math.nan])
def test_without_degrees_of_freedom_there_is_no_answer(dof):
    values = [
        coverage_factor(0.95, dof),
        t_tail(1.0, dof),
        f_quantile(0.9, 2, dof),
        f_quantile(0.9, dof, 2),
        f_tail(1.0, 2, dof),
        f_tail(1.0, dof, 2),
        chi2_quantile(0.9, dof),
        chi2_tail(1.0, dof),
    ]
    assert all(math.isnan(value) for value in values)


def test_floats_are_returned():
    assert type(coverage_factor(0.95, 5)) is float
    assert type(f_tail(2.0, 3, 4)) is float


@pytest.mark.parametrize("confidence", [0.68, 0.95, 0.999])
def test_factors_of_many_are_those_of_each(confidence):
    dof = np.append(np.geomspace(0.5, 2e3, 150), [np.inf, np.nan, 0.0, 1e5, 1e12])
    each = [coverage_factor(confidence, nu) for nu in dof.tolist()]
    found = coverage_factors(confidence, dof.reshape(5, -1)).ravel()
    np.testing.assert_allclose(found[:-2], each[:-2], rtol=1e-11)  # what a difference of tails has
    np.testing.assert_allclose(found[-2:], each[-2:], rtol=max(T_SEARCH, 1e-11))
    np.testing.assert_array_equal(coverage_factors(confidence, dof[:3]), each[:3])


def test_a_root_is_met_within_few_steps():
    """By Illinois the error goes with the power 1.44 of that before: some ten of e^x − 5."""
    asked = []

    def function(x):
        asked.append(x)
        return np.expm1(x)

    assert solve(function, 4.0, 1.0) == pytest.approx(np.log(5.0), rel=1e-14)
    assert len(asked) < 20


@pytest.mark.parametrize("z", [-2.5, 0.0, 1.0, 3.0])
def test_chi2_of_very_many_degrees_of_freedom_by_cornish_and_fisher(z):
    """ν + z √2ν + 2 (z² − 1)/3, of which the next term is below 1e-5 at 1e10."""
    dof, p = 1e10, 0.5 * math.erfc(-z / math.sqrt(2.0))
    x = dof + z * math.sqrt(2.0 * dof) + 2.0 * (z**2 - 1.0) / 3.0
    assert chi2_quantile(p, dof) == pytest.approx(x, rel=0, abs=0.01)
    assert chi2_tail(x, dof) == pytest.approx(1.0 - p, rel=1e-6)


@pytest.mark.parametrize("p", [0.6, 0.975, 0.9995])
def test_t_of_many_degrees_of_freedom_is_the_inverse_of_its_tail(p):
    """A series beyond some dof, an incomplete beta function for the tail."""
    for dof in (1.2e5, 1e6):
        assert t_tail(t_quantile(p, dof), dof) == pytest.approx(2.0 * (1.0 - p), rel=1e-10)


def test_digamma_and_trigamma_of_known_numbers():
    # eqs. (1), (2) of numerics.polygamma
    x = np.array([0.5, 1.0, 2.0, 30.0, 1e4, 1e-3])
    np.testing.assert_allclose(digamma(x), special.digamma(x), rtol=1e-10)
    np.testing.assert_allclose(trigamma(x), special.polygamma(1, x), rtol=1e-10)
    assert float(trigamma(np.array(1.0))) == pytest.approx(np.pi**2 / 6, rel=1e-10)  # Basel
    value = np.array([1e-4, 0.3, 1.0, 50.0, 1e4])
    np.testing.assert_allclose(trigamma(inverse_trigamma(value)), value, rtol=1e-9)


def test_tails_between_nodes():
    f = np.geomspace(1e-3, 300.0, 57)
    exact = np.log([f_tail(each, 2.0, 17.0) for each in f.tolist()])
    assert np.abs(f_log_tails(f, 2.0, 17.0) - exact).max() < 0.005


def test_normal_quantiles_of_many_and_of_the_beta_law():
    """AS 241 to its sixteen digits over its three ranges; SciPy's functions are another's."""
    p = np.array([1e-300, 1e-12, 1e-11, 1e-3, 0.07, 0.08, 0.3, 0.5, 0.9, 0.925, 0.93, 1 - 1e-12])
    np.testing.assert_allclose(normal_quantiles(p), special.ndtri(p), rtol=5e-15)
    for a, b in ((0.5, 3.0), (12.0, 1.0), (700.0, 900.0)):
        found = [beta_quantile(each, a, b) for each in (0.01, 0.4, 0.5, 0.99)]
        scipys = special.betaincinv(a, b, [0.01, 0.4, 0.5, 0.99])
        np.testing.assert_allclose(found, scipys, rtol=1e-9)


def test_a_search_begins_on_either_side_of_what_rises_or_falls():
    for start in (1e-3, 2.0, 1e3):
        assert solve(lambda x: x**3, 8.0, start) == pytest.approx(2.0, rel=1e-14)
        assert solve(lambda x: 1.0 / x, 0.5, start) == pytest.approx(2.0, rel=1e-14)


@pytest.mark.parametrize("count", [100, 10_001])
def test_the_error_function_of_many_numbers_is_that_of_each(count):
    z = np.append(np.linspace(-7.0, 7.0, count), [np.inf, -np.inf, np.nan, 1e-300])
    np.testing.assert_allclose(erf(z), special.erf(z), rtol=1e-15, atol=0.0)

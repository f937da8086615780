"""Published uncertainty problems, through the project's own functions, and two outside programs.

GUM H.2 and H.3 (JCGM 100:2008, annex H), the weighted straight lines of ISO/TS 28037:2010, and
Pearson's data with York's weights, which has errors in both columns.
"""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from profile_oracle import fit_residuals, search_interval

from multipos.numerics.least_squares import solve
from multipos.uncertainty.propagation import welch_satterthwaite

# H.3: corrections of a thermometer [degC] at temperatures [degC], table H.6
THERMOMETER = np.array(
    [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
)
CORRECTION = -np.array(
    [0.171, 0.169, 0.166, 0.159, 0.164, 0.165, 0.156, 0.157, 0.159, 0.161, 0.160]
)
# H.2: table H.2, five sets of V [V], I [mA], phase [rad]
VOLTS = np.array([5.007, 4.994, 5.005, 4.990, 4.999])
MILLIAMPERES = np.array([19.663, 19.639, 19.640, 19.685, 19.678])
PHASE = np.array([1.0456, 1.0438, 1.0468, 1.0428, 1.0433])
# Pearson's points and York's weights, D. York, Canadian Journal of Physics 44, 1966
PEARSON_X = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
PEARSON_Y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
WEIGHT_X = np.array([1000.0, 1000.0, 500.0, 800.0, 200.0, 80.0, 60.0, 20.0, 1.8, 1.0])
WEIGHT_Y = np.array([1.0, 1.8, 4.0, 8.0, 20.0, 20.0, 70.0, 70.0, 100.0, 500.0])


def propagate(function, values, covariance):
    """Return function(values) and its covariance to first order (JCGM 100, eq. (13); JCGM 102)."""
    nudges = np.diag(1e-5 * np.abs(values))
    above, below = function(values + nudges), function(values - nudges)
    gradient = (above - below).T / (2.0 * np.diag(nudges))
    return function(values[None])[0], gradient @ covariance @ gradient.T


def thermometer_line():
    X = np.column_stack([np.ones(11), THERMOMETER - 20.0])
    found = solve(X, CORRECTION)
    return found, found.cofactor * found.rss / found.dof


def test_gum_h3_line():
    found, covariance = thermometer_line()
    u = np.sqrt(np.diag(covariance))
    assert np.round(found.coefficients[0], 4) == -0.1712
    assert np.round(found.coefficients[1], 5) == 0.00218
    assert np.round(u[0], 4) == 0.0029
    assert np.round(u[1], 5) == 0.00067
    assert np.round(covariance[0, 1] / u[0] / u[1], 3) == -0.930
    assert np.round(math.sqrt(found.rss / found.dof), 4) == 0.0035


def test_gum_h3_prediction():
    found, covariance = thermometer_line()
    value, variance = propagate(
        lambda b: b @ np.array([[1.0], [10.0]]), found.coefficients, covariance
    )
    assert np.round(value[0], 4) == -0.1494
    assert np.round(math.sqrt(variance[0, 0]), 4) == 0.0041


def test_gum_h3_with_a_common_offset():
    _, covariance = thermometer_line()
    u1 = math.sqrt(covariance[0, 0])
    assert round(math.hypot(u1, 0.005), 5) == 0.00577
    assert round(float(welch_satterthwaite([u1, 0.005], [9, math.inf])), 2) == 145.38


def impedance(v):
    volts, amperes, phase = v[:, 0], v[:, 1] / 1000.0, v[:, 2]
    Z = volts / amperes
    return np.column_stack([Z * np.cos(phase), Z * np.sin(phase), Z])


def test_gum_h2_simultaneous_resistance_and_reactance():
    # eq. (1) of uncertainty.propagation
    data = np.array([VOLTS, MILLIAMPERES, PHASE])
    covariance = np.cov(data) / 5.0
    value, C = propagate(impedance, data.mean(axis=1), covariance)
    u = np.sqrt(np.diag(C))
    assert_allclose(np.round(value, 3), [127.732, 219.847, 254.260])
    # u(X) is printed 0.295 from the rounded table; unrounded data give 0.2956
    assert_allclose(u, [0.071, 0.295, 0.236], atol=7e-4)
    r = C / np.outer(u, u)
    assert_allclose(np.round([r[0, 1], r[0, 2], r[1, 2]], 3), [-0.588, -0.485, 0.993])


@pytest.mark.parametrize(
    ("y", "u", "a", "b", "u_a", "u_b", "covariance", "chi2"),
    [
        ([3.3, 5.6, 7.1, 9.3, 10.7, 12.1], [0.5] * 6, 1.867, 1.757, 0.465, 0.120, -0.050, 1.665),
        (
            [3.2, 4.3, 7.6, 8.6, 11.7, 12.8],
            [0.5] * 3 + [1.0] * 3,
            0.885,
            2.057,
            0.530,
            0.178,
            -0.082,
            4.131,
        ),
    ],
    ids=["equal weights", "unequal weights"],
)
def test_iso_28037_weighted_line(y, u, a, b, u_a, u_b, covariance, chi2):
    X = np.column_stack([np.ones(6), np.arange(1.0, 7.0)])
    found = solve(X, np.array(y), covariance=np.array(u) ** 2)
    assert_allclose(np.round(found.coefficients, 3), [a, b])
    assert_allclose(np.round(np.sqrt(np.diag(found.cofactor)), 3), [u_a, u_b])
    assert round(found.cofactor[0, 1], 3) == covariance
    assert round(found.rss, 3) == chi2


def york(p):
    """Distance of the points to the line, over its standard deviation: errors in both columns."""
    return (PEARSON_Y - p[0] - p[1] * PEARSON_X) / np.sqrt(1 / WEIGHT_Y + p[1] ** 2 / WEIGHT_X)


def test_pearson_york():
    found = fit_residuals(york, [5.0, -0.5])
    assert found[1] == pytest.approx(-0.480533407, abs=2e-9)
    assert found[0] == pytest.approx(5.47991022, abs=2e-8)
    assert float(np.sum(york(found) ** 2)) == pytest.approx(11.8663531941, abs=1e-9)


def test_pearson_york_by_least_squares_of_points_and_line():
    """The same line with every true abscissa an unknown: Gauss–Newton on `solve`."""
    xi, line = PEARSON_X.copy(), np.array([5.0, -0.5])
    for _ in range(60):
        n = len(xi)
        X = np.zeros((2 * n, n + 2))
        X[:n, 0], X[:n, 1], X[:n, 2:] = 1.0, xi, line[1] * np.eye(n)
        X[n:, 2:] = np.eye(n)
        left = np.concatenate([PEARSON_Y - line[0] - line[1] * xi, PEARSON_X - xi])
        found = solve(X, left, covariance=1 / np.concatenate([WEIGHT_Y, WEIGHT_X]))
        line, xi = line + found.coefficients[:2], xi + found.coefficients[2:]
    assert_allclose(line, [5.47991022, -0.480533407], atol=2e-8)
    # the covariance of known weights; York's tables scale it by S/(n - 2)
    assert_allclose(np.sqrt(np.diag(found.cofactor))[:2], [0.2950, 0.0580], atol=5e-4)


def test_profile_of_pearson_york_bends():
    best = fit_residuals(york, [5.0, -0.5])
    low, high = search_interval(york, best, 1, u=0.058)
    assert low < best[1] < high
    assert (high - low) / 2 == pytest.approx(1.96 * 0.058, rel=0.05)
    for end in (low, high):
        rest = fit_residuals(lambda p, end=end: york([p[0], end]), [best[0]])
        excess = np.sum(york([rest[0], end]) ** 2) - np.sum(york(best) ** 2)
        assert excess == pytest.approx(1.959964**2, rel=1e-5)


# --- outside programs


def test_gtc_agrees_on_the_straight_line():
    type_a = pytest.importorskip("GTC.type_a")
    line = type_a.line_fit(list(THERMOMETER - 20.0), list(CORRECTION)).a_b
    found, covariance = thermometer_line()
    assert_allclose([p.x for p in line], found.coefficients, rtol=1e-10)
    assert_allclose([p.u for p in line], np.sqrt(np.diag(covariance)), rtol=1e-10)
    gtc = pytest.importorskip("GTC")
    shifted = line[0] + gtc.ureal(0.0, 0.005)
    assert shifted.u == pytest.approx(0.00577, abs=5e-6)
    assert shifted.df == pytest.approx(145.38, abs=0.005)


def test_uncertainties_agrees_on_propagation():
    uncertainties = pytest.importorskip("uncertainties")
    umath = pytest.importorskip("uncertainties.umath")
    data = np.array([VOLTS, MILLIAMPERES, PHASE])
    covariance = np.cov(data) / 5.0
    v, i, phase = uncertainties.correlated_values(data.mean(axis=1), covariance)
    Z = v / (i / 1000.0)
    theirs = uncertainties.covariance_matrix([Z * umath.cos(phase), Z * umath.sin(phase), Z])
    _, ours = propagate(impedance, data.mean(axis=1), covariance)
    assert_allclose(ours, theirs, rtol=1e-7)

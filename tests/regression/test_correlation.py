"""Robust covariance against its definition, and against the false alarms it is there to prevent."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.numerics.terms import parse_terms
from multipos.regression import correlation, whitening
from multipos.regression.correlation import (
    bandwidth,
    effective_size,
    hac_covariance,
    lag_one,
    time_order,
    wald,
    window_dof,
)
from multipos.regression.robust import RobustFit, robust_test


def autoregressive(rng, n, rho, columns=1):
    x = rng.standard_normal((n + 300, columns))
    for i in range(1, n + 300):
        x[i] += rho * x[i - 1]
    return x[300:]


def test_moving_sums_are_the_triangular_kernel():
    rng = np.random.default_rng(1)
    g = rng.standard_normal((80, 3))
    starts, width = np.array([0, 30, 31]), 7
    runs = [g[:30], g[30:31], g[31:]]
    expected = np.zeros((3, 3))
    for run in runs:
        for lag in range(-width + 1, width):
            for i in range(len(run)):
                if 0 <= i + lag < len(run):
                    expected += (1 - abs(lag) / width) * np.outer(run[i], run[i + lag])
    assert_allclose(correlation._moving_power(g, starts, width), expected, rtol=1e-12, atol=1e-12)


def test_independent_rows_give_the_heteroscedastic_sandwich():
    """Without correlation to whiten and B = 1, (1) is White's covariance."""
    rng = np.random.default_rng(2)
    X = np.column_stack((np.ones(6), rng.standard_normal(6)))
    e = np.array([1.0, -2.0, 3.0, -1.0, 2.0, -2.5])
    order = time_order(np.arange(0.0, 60.0, 10.0))
    apart = correlation.TimeOrder(order.order, np.arange(6))  # every row a run of its own
    cofactor = np.linalg.inv(X.T @ X)
    white = cofactor @ (X * e[:, None] ** 2).T @ X @ cofactor
    assert_allclose(hac_covariance(X, e, cofactor, apart), white * 6 / 4, rtol=1e-12)


def test_rows_in_any_order_and_gaps():
    rng = np.random.default_rng(4)
    time = np.concatenate((np.arange(50.0), 500 + np.arange(50.0)))
    shuffle = rng.permutation(100)
    X = np.column_stack((np.ones(100), autoregressive(rng, 100, 0.7)))
    e = autoregressive(rng, 100, 0.7)[:, 0]
    cofactor = np.linalg.inv(X.T @ X)
    order, shuffled = time_order(time), time_order(time[shuffle])
    assert order.run.max() == 1
    assert_allclose(
        hac_covariance(X[shuffle], e[shuffle], cofactor, shuffled),
        hac_covariance(X, e, cofactor, order),
        rtol=1e-10,
    )
    some = np.arange(10, 90)
    part = shuffled.of(some)
    assert sorted(part.order.tolist()) == list(range(80))
    assert (np.diff(time[shuffle][some][part.order]) > 0).all()


def test_bandwidth_is_andrews_rule():
    # eq. (2) of regression.correlation
    # ρ = 1/2: α = 4/4/(1/4 · 9/4) = 16/9, 1.1447 (16000/9)^(1/3) = 13.87
    assert bandwidth(0.5, 1000) == 14
    # ρ = 0.2: α = 0.16/(0.64 · 1.44) = 0.1736, 1.1447 · 173.6^(1/3) = 6.39
    assert bandwidth(0.2, 1000) == 7
    assert bandwidth(-0.3, 1000) == 1
    assert bandwidth(0.99, 30) == 10
    # ρ is taken as 0.97 at most: α = 3.7636/(0.03² 1.97²) = 1077.5, 1.1447 (1.0775e6)^(1/3) = 117.4
    assert bandwidth(0.99, 1000) == 118


# Sixteen residuals of ±1: 11 of the 15 neighbours agree and 4 differ, so γ = 16 and the sum of
# products is 7; as a correlation 7/16 · 16/15 = 7/15.
WAVE = np.array([1, 1, -1, -1, -1, -1, 1, 1, 1, 1, -1, -1, -1, -1, 1, 1], dtype=float)
# whitened with a = 7/15 + (1 + 3 · 7/15)/16 = 37/60: 16 − 1 − 4 agreeing neighbours leave 23/60,
# 4 others 97/60, and the first value is √(1 − a²) of itself; in units of 1/3600
WAVE_POWER = (3600 - 37**2) + 11 * 23**2 + 4 * 97**2
LONG_RUN = WAVE_POWER / 23**2  # over (1 − a)²


def test_a_short_wave_by_hand():
    order = time_order(np.arange(16.0))
    assert lag_one(WAVE, order) == (pytest.approx(7 / 15, rel=1e-12), False)  # 1 %: 2.33/√15 = .60
    twice = np.tile(WAVE, 2)  # one more neighbour agrees: 15/32 · 32/31, 2.33/√31 = .42
    assert lag_one(twice, time_order(np.arange(32.0))) == (pytest.approx(15 / 31, rel=1e-12), True)
    # whitened neighbours are correlated by .09 only: B = 1, and n_eff of eq. (3) is n γ/S_e
    assert effective_size(WAVE, order) == pytest.approx(16 * 16 / LONG_RUN, rel=1e-12)
    # α = 4 (7/15)²/(1 − (7/15)²)² = 1.424, 1.1447 (16 · 1.424)^(1/3) = 3.24: B = 4, ν = 3 · 16/8
    assert window_dof(WAVE, order) == 6.0


def test_hac_covariance_of_a_mean_by_hand():
    """Of sixteen rows of a constant: S over 16², times 16/15."""
    # eq. (1) of regression.correlation
    order = time_order(np.arange(16.0))
    found = hac_covariance(np.ones((16, 1)), WAVE, np.array([[1 / 16]]), order)
    assert_allclose(found, LONG_RUN / 16**2 * 16 / 15, rtol=1e-12)


def test_f_robust_by_hand():
    """Eq. (4): b = (2, 1) with variances 1 and 1/4, (4 + 4)/2 · (9 − 2 + 1)/9 = 32/9 on 2 and 8."""
    # eq. (4) of regression.correlation
    terms, b = parse_terms("1 + t + v"), np.array([7.0, 2.0, 1.0])
    covariance = np.diag([100.0, 1.0, 0.25])
    F = (100.0, 2, 17)
    found = robust_test(RobustFit(covariance, 9.0, 20.0, 0.5), np.eye(3), terms, b, F, 0.95)
    assert pytest.approx(32 / 9, rel=1e-12) == found.F
    assert found.dof == (2, 8.0)
    assert found.p == pytest.approx((17 / 9) ** -4, rel=1e-9)  # of 2 and ν: (1 + 2 F/ν)^(−ν/2)
    assert found.t_dof == 9.0


def test_more_than_five_intervals_are_a_gap():
    assert time_order([0.0, 1.0, 2.0, 7.0, 8.0]).run.tolist() == [0, 0, 0, 0, 0]
    parted = time_order([0.0, 1.0, 2.0, 7.1, 8.1])
    assert parted.run.tolist() == [0, 0, 0, 1, 1]
    # rows left out part runs as well, also beside a gap
    few = parted.of(np.array([0, 1, 4])).run
    assert few[0] == few[1] != few[2]


def test_effective_size_of_a_known_process():
    """n (1 − ρ)/(1 + ρ) for a first-order process; ten runs of 5000 rows know it to some 10 %."""
    # eq. (3) of regression.correlation
    rng = np.random.default_rng(5)
    order = time_order(np.arange(5000.0))
    for rho in (0.0, 0.5, 0.9):
        found = np.mean(
            [effective_size(autoregressive(rng, 5000, rho)[:, 0], order) for _ in range(10)]
        )
        assert found == pytest.approx(5000 * (1 - rho) / (1 + rho), rel=0.1)


def test_lag_one_tells_correlation_from_chance():
    rng = np.random.default_rng(6)
    order = time_order(np.arange(300.0))
    assert lag_one(autoregressive(rng, 300, 0.5)[:, 0], order)[1]
    alarms = sum(lag_one(rng.standard_normal(300), order)[1] for _ in range(1000))
    # 1 % of 1000, three and a half binomial standard deviations
    assert alarms <= 10 + 3.5 * math.sqrt(10)


def test_wald_is_the_overall_f():
    rng = np.random.default_rng(7)
    X = np.column_stack((np.ones(40), rng.standard_normal((40, 3))))
    y = rng.standard_normal(40)
    fit = solve(X, y)
    C = fit.cofactor * fit.rss / fit.dof
    F, k = wald(fit.coefficients[1:], C[1:, 1:])
    explained = ((y - fit.residuals - y.mean()) ** 2).sum()
    assert k == 3
    assert pytest.approx((explained / 3) / (fit.rss / fit.dof), rel=1e-10) == F


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rho", "n", "limit"), [(0.0, 500, 0.07), (0.5, 500, 0.09), (0.9, 500, 0.13), (0.9, 2000, 0.11)]
)
def test_false_alarms_of_f_robust(rho, n, limit):
    """Nothing is there to find. The classical F sees something in a quarter to nine tenths."""
    rng = np.random.default_rng(8)
    runs, level, robust, classical = 400, 0.05, 0, 0
    order = time_order(np.arange(float(n)))
    for _ in range(runs):
        w = autoregressive(rng, n, rho, 5)
        X = np.column_stack((np.ones(n), w[:, 1:]))
        fit = solve(X, w[:, 0])
        C = hac_covariance(X, fit.residuals, fit.cofactor, order)
        F, k = wald(fit.coefficients[1:], C[1:, 1:])
        nu = window_dof(fit.residuals, order)
        robust += f_tail(F * (nu - k + 1) / nu, k, nu - k + 1) < level
        F, k = wald(fit.coefficients[1:], fit.cofactor[1:, 1:] * fit.rss / fit.dof)
        classical += f_tail(F, k, n - 5) < level
    # `limit` is the rate the theory page states for the case, rounded up; binomial at 1e-3
    bound = runs * limit + normal_quantile(0.999) * math.sqrt(runs * limit * (1 - limit))
    assert robust <= bound
    if rho:
        assert classical > 2 * robust


def test_the_basis_of_a_design_spans_it_without_what_depends_on_other_columns():
    """By least squares of NumPy: columns of scales apart by 1e12, one twice and one of zeros."""
    rng = np.random.default_rng(4)
    X = rng.standard_normal((60, 5)) * [1.0, 1e6, 1e-6, 1.0, 1.0]
    X = np.column_stack([X, 2.0 * X[:, 1] - 1e6 * X[:, 0], np.zeros(60)])
    basis, y = whitening._basis(X), rng.standard_normal(60)
    assert_allclose(basis.T @ basis, np.eye(5), atol=1e-14)
    unit = X[:, :5] / np.linalg.norm(X[:, :5], axis=0)
    left = y - unit @ np.linalg.lstsq(unit, y, rcond=None)[0]
    assert_allclose(y - basis @ (basis.T @ y), left, atol=1e-13)


def test_a_variable_of_the_period_of_its_noise_is_not_significant():
    # sin and cos are orthogonal: the slope of one on the other is none, in any law of noise
    turn = 2.0 * np.pi * np.arange(600) / 20.0
    columns = {"x": np.sin(turn), "y": np.cos(turn)}
    segment = mp.regress(columns, response="y", variables="x").to_dict()["segments"][0]
    assert segment["F"] < 1e-9
    assert segment["F_robust"] < 1.0

"""Robust covariance against its definition, and against the false alarms it is there to prevent."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from multipos import correlation
from multipos.correlation import (
    bandwidth,
    cluster_covariance,
    effective_size,
    hac_covariance,
    lag_one,
    time_order,
    wald,
    window_dof,
)
from multipos.least_squares import solve
from multipos.quantiles import f_tail, normal_quantile


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


def test_clusters_against_the_definition():
    rng = np.random.default_rng(3)
    X, e = rng.standard_normal((12, 2)), rng.standard_normal(12)
    cluster = np.repeat([5, 1, 9, 2], 3)
    cofactor = np.linalg.inv(X.T @ X)
    S = sum(
        np.outer(s, s)
        for s in (X[cluster == c].T @ e[cluster == c] for c in np.unique(cluster))
    )  # fmt: skip
    found, m = cluster_covariance(X, e, cofactor, cluster)
    assert m == 4
    assert_allclose(found, cofactor @ S @ cofactor * (4 / 3) * (11 / 10), rtol=1e-12)


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
        hac_covariance(X, e, cofactor, order), rtol=1e-10,
    )  # fmt: skip
    some = np.arange(10, 90)
    part = shuffled.of(some)
    assert sorted(part.order.tolist()) == list(range(80))
    assert (np.diff(time[shuffle][some][part.order]) > 0).all()


def test_bandwidth_is_andrews_rule():
    rho, n = 0.5, 1000
    alpha = 4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)
    assert bandwidth(rho, n) == int(1.1447 * (alpha * n) ** (1 / 3)) + 1
    assert bandwidth(-0.3, n) == 1
    assert bandwidth(0.99, 30) == 10


def test_effective_size_of_a_known_process():
    """n (1 − ρ)/(1 + ρ) for a first-order process; ten runs of 5000 rows know it to some 10 %."""
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
@pytest.mark.parametrize(("rho", "n", "limit"), [(0.0, 500, 0.07), (0.5, 500, 0.09),
                                                 (0.9, 500, 0.13), (0.9, 2000, 0.11)])  # fmt: skip
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

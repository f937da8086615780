"""Rows made independent: the filter by hand, its estimate, and what tests of terms then do."""

import math

import numpy as np
import pytest

import multipos as mp
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.regression.correlation import time_order
from multipos.regression.whitening import Law, Whitening, find_law, whitening_of


def slow(rng, n, rho, columns=1):
    w = rng.standard_normal((n, columns))
    w[1:] *= math.sqrt(1.0 - rho**2)
    for i in range(1, n):
        w[i] += rho * w[i - 1]
    return w


def test_the_filter_by_hand():
    """ρ = 1/2, θ = 1/4: r = (1 − 1/4 + 1/16)/(3/4) = 13/12; two runs, told by the gap in time."""
    order = time_order([0.0, 1.0, 2.0, 20.0, 21.0])
    white = Whitening(order, Law(0.5, 0.25, np.empty(0)))(np.array([13.0, 2.0, 4.0, 13.0, 8.0]))
    first = 13.0 / math.sqrt(13.0 / 12.0)
    one = 2.0 - 6.5 + 0.25 * 12.0  # the memory of the first row is z/r = 12
    two = 4.0 - 1.0 + 0.25 * one
    np.testing.assert_allclose(white, [first, one, two, first, 8.0 - 6.5 + 3.0], rtol=1e-14)


def test_rows_are_filtered_in_time_and_stand_where_they_stood():
    rng = np.random.default_rng(1)
    time, z = np.arange(50.0), rng.standard_normal((50, 2))
    shuffle = rng.permutation(50)
    further = np.array([0.3, -0.1])
    plain = Whitening(time_order(time), Law(0.8, 0.2, further))(z)
    mixed = Whitening(time_order(time[shuffle]), Law(0.8, 0.2, further))(z[shuffle])
    np.testing.assert_array_equal(mixed, plain[shuffle])


def test_the_covariance_of_the_noise_becomes_the_identity():
    """W V W' of a known first-order process, column by column of W = filter of the identity."""
    rho, n = 0.9, 12
    V = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / (1.0 - rho**2)
    W = Whitening(time_order(np.arange(float(n))), Law(rho, 0.0, np.empty(0)))(np.eye(n))
    np.testing.assert_allclose(W @ V @ W.T, np.eye(n), atol=1e-13)


def test_what_is_estimated():
    """First order, and slow with white noise: ρ = .95, 2 % known from 3000 rows."""
    rng = np.random.default_rng(2)
    n = 3000
    order, ones = time_order(np.arange(float(n))), np.ones((n, 1))
    alone = find_law(ones, slow(rng, n, 0.95)[:, 0], order)
    assert alone.rho == pytest.approx(0.95, abs=0.02)
    assert alone.theta < 0.1
    both = find_law(ones, 0.4 * slow(rng, n, 0.95)[:, 0] + 0.3 * rng.standard_normal(n), order)
    assert both.rho == pytest.approx(0.95, abs=0.04)
    assert both.theta > 0.3
    assert find_law(ones, rng.standard_normal(n), order) is None


@pytest.mark.slow
@pytest.mark.parametrize(("rho", "n"), [(0.9, 100), (0.9, 500), (0.99, 500)])
def test_false_alarms_of_terms(rho, n):
    """5 % are stated; 8 % are granted to the estimate of the correlation; binomial at 1e-3."""
    rng = np.random.default_rng(3)
    order, runs, alarms = time_order(np.arange(float(n))), 150, 0
    for _ in range(runs):
        X = np.column_stack([np.ones(n), slow(rng, n, rho, 4)])
        y = slow(rng, n, rho)[:, 0]
        white = whitening_of(order, find_law(X, y, order))
        A, v = (X, y) if white is None else (white(X), white(y))
        rss = [
            float(((v - B @ np.linalg.lstsq(B, v, rcond=None)[0]) ** 2).sum())
            for B in (A, A[:, :1])
        ]
        F = (rss[1] - rss[0]) / 4.0 / (rss[0] / (n - 5))
        alarms += f_tail(F, 4, n - 5) < 0.05
    assert alarms <= runs * 0.08 + normal_quantile(0.999) * math.sqrt(runs * 0.08 * 0.92)


@pytest.mark.slow
def test_false_terms_and_edges_are_as_rare_as_of_independent_rows():
    """Five candidates at .05 make 23 %; by rows as they stand it is 98 % and 37 % edges."""
    rng = np.random.default_rng(4)
    runs, n, terms, edges = 60, 300, 0, 0
    t = 10.0 + 40.0 * np.sin(np.arange(n) * 0.03)
    for _ in range(runs):
        noise, others = slow(rng, n, 0.9)[:, 0], slow(rng, n, 0.9, 5)
        columns = {f"x{j}": others[:, j] for j in range(5)} | {"y": noise}
        found = mp.regress(columns, response="y", variables="x0,x1,x2,x3,x4", stepwise=True)
        terms += len(found.segments[0].terms) > 1
        cut = mp.regress(
            {"v": t, "y": 0.01 * t + noise}, response="y", variables="v", segment="v:auto"
        )
        edges += bool(cut.edges)
    assert terms <= runs * 0.23 + normal_quantile(0.999) * math.sqrt(runs * 0.23 * 0.77)
    assert edges <= runs * 0.05 + normal_quantile(0.999) * math.sqrt(runs * 0.05 * 0.95)

"""Rows made independent: the filter by hand, its estimate, and what tests of terms then do."""

import math

import numpy as np
import pytest
from findings_bench import texts
from scipy import stats

import multipos as mp
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.regression.correlation import time_order
from multipos.regression.whitening import Law, Whitening, find_noise


def slow(rng, n, rho, columns=1):
    w = rng.standard_normal((n, columns))
    w[1:] *= math.sqrt(1.0 - rho**2)
    for i in range(1, n):
        w[i] += rho * w[i - 1]
    return w


def test_the_filter_by_hand():
    """ρ = 1/2, θ = 1/4: r = (1 − 1/4 + 1/16)/(3/4) = 13/12; two runs, told by the gap in time."""
    # eq. (2) of regression.whitening
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
    # eq. (1) of regression.whitening
    rho, n = 0.9, 12
    V = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / (1.0 - rho**2)
    W = Whitening(time_order(np.arange(float(n))), Law(rho, 0.0, np.empty(0)))(np.eye(n))
    np.testing.assert_allclose(W @ V @ W.T, np.eye(n), atol=1e-13)


def test_what_is_estimated():
    """First order, and slow with white noise: ρ = .95, 2 % known from 3000 rows."""
    rng = np.random.default_rng(2)
    n = 3000
    order, ones = time_order(np.arange(float(n))), np.ones((n, 1))
    alone = find_noise(ones, slow(rng, n, 0.95)[:, 0], order).law
    assert alone.rho == pytest.approx(0.95, abs=0.02)
    assert alone.theta < 0.1
    response = 0.4 * slow(rng, n, 0.95)[:, 0] + 0.3 * rng.standard_normal(n)
    both = find_noise(ones, response, order).law
    assert both.rho == pytest.approx(0.95, abs=0.04)
    assert both.theta > 0.3
    white = find_noise(ones, rng.standard_normal(n), order)
    assert white.law is None


def test_plausible_laws_are_those_as_likely_as_the_likeliest():
    """Eq. (3) with the filter as a matrix W, for which −ln|V|/2 is −ln r/2 of one run."""
    # eqs. (3), (4) of regression.whitening
    rng = np.random.default_rng(5)
    n = 60
    X = np.column_stack([np.ones(n), slow(rng, n, 0.9)])
    y = slow(rng, n, 0.9)[:, 0] + rng.standard_normal(n)
    order = time_order(np.arange(float(n)))

    def likelihood(law):
        W = Whitening(order, law._replace(further=np.empty(0)))(np.eye(n))
        weight = W.T @ W
        e = y - X @ np.linalg.solve(X.T @ weight @ X, X.T @ weight @ y)
        r = (1.0 - 2.0 * law.rho * law.theta + law.theta**2) / (1.0 - law.rho**2)
        logs = math.log(r) + np.linalg.slogdet(X.T @ weight @ X)[1]
        return -0.5 * (logs + (n - 2) * math.log(e @ weight @ e))

    laws = find_noise(X, y, order).plausible
    found = [likelihood(law) for law in laws]
    np.testing.assert_allclose(found, sorted(found, reverse=True), rtol=1e-12)
    assert found[0] - found[-1] <= 1.35
    assert len(found) > 10  # sixty rows leave much open
    for rho, theta in ((0.997, 0.0), (0.15, 0.0)):  # of the grid, but no likely ones
        assert (likelihood(Law(rho, theta, np.empty(0))) < found[0] - 1.35) == (
            not any(math.isclose(law.rho, rho) and law.theta == theta for law in laws)
        )


def test_f_robust_is_the_largest_p_of_the_plausible_laws():
    """Each law's F by generalised least squares, written out with its filter as a matrix."""
    rng = np.random.default_rng(6)
    n = 80
    x, y = slow(rng, n, 0.95, 2), slow(rng, n, 0.95)[:, 0] + rng.standard_normal(n)
    table = {"a": x[:, 0], "b": x[:, 1], "y": y + 0.3 * x[:, 0], "time": np.arange(float(n))}
    (segment,) = mp.regress(table, response="y", variables="a,b").segments
    X, order = np.column_stack([np.ones(n), x]), time_order(table["time"])
    largest = 0.0
    for law in find_noise(X, table["y"], order).plausible:
        W = Whitening(order, law)(np.eye(n))
        rss = [
            float(
                (
                    (W @ (table["y"] - B @ np.linalg.lstsq(W @ B, W @ table["y"], rcond=None)[0]))
                    ** 2
                ).sum()
            )
            for B in (X, X[:, :1])
        ]
        largest = max(largest, f_tail((rss[1] - rss[0]) / 2.0 / (rss[0] / (n - 3)), 2, n - 3))
    assert segment.robust.p == pytest.approx(largest, rel=1e-6)
    b = segment.coefficients[1]
    assert b.p_robust == pytest.approx(2 * stats.t.sf(abs(b.t_robust), segment.robust.t_dof))


def test_what_few_rows_leave_open_is_said():
    """Sixty rows of white noise on a slow ramp: F finds the slope, slow noise might as well."""
    rng = np.random.default_rng(7)
    n = 60
    ramp = np.linspace(-1.0, 1.0, n)
    table = {"T": ramp, "y": 0.55 * ramp + rng.standard_normal(n), "time": np.arange(float(n))}
    found = mp.regress(table, response="y", variables="T")
    (segment,) = found.segments
    assert segment.significant
    assert segment.robust.p > 0.05
    assert segment.robust.n_effective == n
    assert any("cannot separate white from slow noise" in said for said in texts(found))
    # ten times the slope is no such finding, and nothing is said
    clear = mp.regress(table | {"y": table["y"] + 5.0 * ramp}, response="y", variables="T")
    assert clear.segments[0].robust is None
    assert [finding.code for finding in clear.findings] == ["turn-on"]
    assert len(texts(clear)) == 1


def test_long_records_take_the_likeliest_law_alone():
    rng = np.random.default_rng(8)
    n = 3200
    order, ones = time_order(np.arange(float(n))), np.ones((n, 1))
    noise = find_noise(ones, slow(rng, n, 0.95)[:, 0], order)
    assert [law.rho for law in noise.plausible] == [noise.law.rho]
    assert find_noise(ones, rng.standard_normal(n), order).plausible == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rho", "white", "n"),
    [(0.9, 0.0, 100), (0.95, 0.75, 100), (0.95, 1.0, 100), (0.99, 0.75, 100), (0.99, 0.75, 300)],
)
def test_false_models(rho, white, n):
    """5 % are stated, 7 % are granted to the estimate of the law; binomial at 1e-3."""
    rng = np.random.default_rng(3)
    runs, alarms = 100, 0
    for _ in range(runs):
        x, y = slow(rng, n, rho, 4), slow(rng, n, rho)[:, 0] + white * rng.standard_normal(n)
        table = {f"x{j}": x[:, j] for j in range(4)} | {"y": y, "time": np.arange(float(n))}
        (segment,) = mp.regress(table, response="y", variables="x0,x1,x2,x3").segments
        alarms += (segment.p if segment.robust is None else segment.robust.p) < 0.05
    assert alarms <= runs * 0.07 + normal_quantile(0.999) * math.sqrt(runs * 0.07 * 0.93)


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

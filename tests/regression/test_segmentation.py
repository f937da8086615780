"""Segments: edges where the truth has them, none where it has none, and no jump on request."""

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from multipos.errors import MultiposError
from multipos.numerics.least_squares import solve
from multipos.numerics.selection import compress
from multipos.numerics.terms import evaluate_terms, parse_terms
from multipos.regression.rates import causal_rate, default_window, form_rate, smoothed_rate
from multipos.regression.segmentation import (
    Joined,
    find_edges,
    hinges,
    residual_sum,
    segment_of,
)


def test_edges_of_a_broken_line_are_found():
    rng = np.random.default_rng(1)
    t = rng.uniform(-45, 60, 2000)
    y = np.where(t < -20, 0.5 + 0.02 * t, 0.0) + np.where(t > 25, 0.3, 0.0)
    y += rng.normal(0, 0.02, len(t))
    edges = find_edges(t, np.column_stack((np.ones_like(t), t)), y, minimum=20)
    # a candidate every 1/48 of the rows: 2.2 °C
    assert_allclose(edges, (-20, 25), atol=2.5)


def test_no_edge_is_found_in_noise():
    rng = np.random.default_rng(2)
    t = np.linspace(0, 1, 500)
    X = np.column_stack((np.ones_like(t), t))
    found = [find_edges(t, X, rng.standard_normal(500), minimum=10) for _ in range(12)]
    assert sum(bool(edges) for edges in found) <= 1


def test_dynamic_programming_is_exhaustive_search():
    # eq. (1) of regression.segmentation
    rng = np.random.default_rng(3)
    t = np.arange(24.0)
    y = np.where(t < 7, 0.0, 2.0) + np.where(t > 16, t - 16, 0.0) + rng.normal(0, 0.05, 24)
    X = np.column_stack((np.ones_like(t), t))
    edges = find_edges(t, X, y, minimum=3)
    cuts = [int(np.searchsorted(t, edge)) for edge in edges]

    def cost(cuts):
        pieces = itertools.pairwise([0, *cuts, 24])
        return sum(residual_sum(compress(X[i:j], y[i:j])) for i, j in pieces)

    every = itertools.combinations(range(3, 22), len(cuts))
    allowed = [c for c in every if min(np.diff([0, *c, 24])) >= 3]
    assert cost(cuts) == pytest.approx(min(cost(c) for c in allowed), rel=1e-10)


@pytest.mark.parametrize(
    ("columns", "gain"),
    [
        # n ln(rss_1/rss_2) must pass (p + 1) ln n
        (1, 2 * math.log(40) / 40),
        (2, 3 * math.log(40) / 40),
    ],
)
def test_an_edge_costs_its_coefficients_and_one_more(columns, gain):
    """Eq. (2) by hand, where the 40 rows can be cut at one place only.

    About two levels ±d the rows scatter by ±1: rss is 40 (1 + d²) in one piece and 40 in two. The
    second column explains nothing in either half.
    """
    # eq. (2) of regression.segmentation
    t = np.repeat([0.0, 1.0], 20)
    X = np.column_stack((np.ones(40), np.tile([1.0, 1.0, -1.0, -1.0], 10)))[:, :columns]
    scatter = np.tile([1.0, -1.0], 20)
    for factor, edges in ((0.98, ()), (1.02, (0.5,))):
        d = math.sqrt(math.exp(factor * gain) - 1.0)
        y = scatter + d * (2.0 * t - 1.0)
        assert find_edges(t, X, y, minimum=5) == edges


def test_equal_values_are_never_parted():
    t = np.repeat([0.0, 1.0, 2.0, 3.0], 10)
    rng = np.random.default_rng(4)
    y = np.where(t > 1.5, 5.0, 0.0) + rng.normal(0, 0.1, 40)
    assert find_edges(t, np.ones((40, 1)), y, minimum=5) == (1.5,)


def test_an_edge_belongs_to_the_segment_above():
    assert segment_of(np.array([-1.0, 0.0, 1.0, 2.0]), (0.0, 2.0)).tolist() == [0, 1, 1, 2]


def test_hinges_vanish_at_their_edge():
    columns = {"t": np.array([-1.0, 2.0, 3.0]), "v": np.array([5.0, 7.0, 2.0])}
    found = hinges(parse_terms("1 + t + v + t^2*v"), "t", (2.0,), both=False)
    assert [str(h.term) for h in found] == ["t", "t^2*v"]
    assert_allclose(found[0].evaluate(columns), [0, 0, 1])
    assert_allclose(found[1].evaluate(columns), [0, 0, (9 - 4) * 2])


# --- edges without a jump


def joined_of(terms, t):
    terms = parse_terms(terms)
    return evaluate_terms(terms, {"t": t}, len(t)), Joined(terms, "t", {"t": t}, lambda each: each)


@pytest.mark.parametrize("terms", ["1 + t", "1 + t + t^2"])
def test_kinks_without_noise_are_found_to_rounding(terms):
    t = np.random.default_rng(8).uniform(-40.0, 60.0, 400)
    y = 0.3 * t + 0.5 * np.maximum(t + 13.7, 0.0) - 0.9 * np.maximum(t - 21.3, 0.0)
    X, joined = joined_of(terms, t)
    assert_allclose(find_edges(t, X, y, minimum=8, joined=joined), (-13.7, 21.3), atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_kink_is_where_every_place_was_tried(seed):
    """The least residual sum of lines that meet, by a fit at each of 2,000 places."""
    rng = np.random.default_rng(seed)
    t, kink = np.sort(rng.uniform(-40.0, 60.0, 120)), rng.uniform(-20.0, 40.0)
    y = 0.01 * t + 0.02 * np.maximum(t - kink, 0.0) + rng.normal(0.0, 0.02, 120)
    X, joined = joined_of("1 + t", t)
    (edge,) = find_edges(t, X, y, minimum=12, joined=joined)

    def rss(e):
        D = np.column_stack((np.ones_like(t), t, np.maximum(t - e, 0.0)))
        return float(((y - D @ np.linalg.lstsq(D, y, rcond=None)[0]) ** 2).sum())

    assert rss(edge) <= min(map(rss, np.linspace(t[12], t[-13], 2000))) * (1.0 + 1e-4)


def test_a_change_of_an_edge_is_the_difference_quotient():
    # eq. (4) of regression.segmentation
    t = np.linspace(-3.0, 5.0, 41)
    v = np.cos(t)
    terms = parse_terms("1 + t + v + t^2*v")
    joined = Joined(terms, "t", {"t": t, "v": v}, lambda each: each)
    d, h, edges = np.array([0.7, -0.4]), 1e-6, (1.13,)
    moved = (joined.changes((edges[0] + h,)) - joined.changes((edges[0] - h,))) @ d / (2.0 * h)
    assert_allclose(joined.moves(edges, d)[:, 0], moved, atol=1e-9)


def test_joined_segments_have_as_many_values_as_their_highest_power_needs():
    """Soaks at 11 temperatures: a quadratic that one soak, or two, determines is none."""
    t = np.repeat(np.linspace(-40.0, 60.0, 11), 12)
    noise = 1e-3 * np.random.default_rng(9).normal(size=len(t))
    for kink in (50.0, 27.0):  # of the first only two soaks are beyond
        y = 0.01 * t + 0.05 * np.maximum(t - kink, 0.0) + noise
        X, joined = joined_of("1 + t + t^2", t)
        edges = find_edges(t, X, y, minimum=6, joined=joined)
        of = segment_of(t, edges)
        assert min(len(np.unique(t[of == i])) for i in range(len(edges) + 1)) >= 3
    X, joined = joined_of("1 + t", t)  # between soaks an edge is where the lines meet
    assert_allclose(find_edges(t, X, y, minimum=6, joined=joined), (27.0,), atol=0.05)


# --- rates


def test_rate_of_a_ramp_is_exact_at_any_spacing():
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.1, 2.0, 5000)) + 1e6  # an epoch must not cost digits
    rate = smoothed_rate(time, -45 + 0.25 * (time - time[0]), window=12.0)
    assert_allclose(rate, 0.25, rtol=1e-7)


def test_rate_is_the_least_squares_slope_of_each_window():
    rng = np.random.default_rng(6)
    time = np.cumsum(rng.uniform(0.5, 1.5, 60))
    values = rng.standard_normal(60)
    rate = smoothed_rate(time, values, window=5.0)
    for k in (0, 1, 30, 59):
        near = np.abs(time - time[k]) <= 2.5
        slope = solve(np.column_stack((np.ones(near.sum()), time[near])), values[near])
        assert rate[k] == pytest.approx(slope.coefficients[1], rel=1e-9)


def test_rate_by_hand():
    """Rows within 1.5 of t = 2 are 1, 2, 3.5, with means 13/6 and 4: Σ tv = 21/6, Σ t² = 19/6."""
    # eq. (1) of regression.rates
    rate = smoothed_rate(np.array([0.0, 1.0, 2.0, 3.5]), np.array([9.0, 2.0, 5.0, 5.0]), window=3.0)
    assert rate[2] == pytest.approx(21 / 19, rel=1e-12)
    assert rate[3] == pytest.approx(0.0, abs=1e-12)  # 2 and 3.5


def test_rate_noise_is_as_stated():
    rng = np.random.default_rng(7)
    time = np.arange(20_000) * 0.1
    rate = smoothed_rate(time, rng.normal(0, 0.1, 20_000), window=10.0)
    # √12 s/(w √r): some 200 independent windows know a standard deviation to 5 %
    assert rate[200:-200].std() == pytest.approx(12**0.5 * 0.1 / (10 * 100**0.5), rel=0.15)
    assert default_window(time) == pytest.approx(2.0)


def test_rate_refuses_what_has_none():
    time = np.array([0.0, 1.0, 1.0])
    with pytest.raises(MultiposError, match="does not increase at row 3"):
        form_rate(time, time, window=5.0, causal=False, run=None)
    with pytest.raises(MultiposError, match=r"window of 1 about row 1; give a longer"):
        smoothed_rate(np.array([0.0, 10.0, 20.0]), np.array([1.0, 2.0, 3.0]), window=1.0)
    with pytest.raises(MultiposError, match="about row 3;"):
        smoothed_rate(np.array([0.0, 0.4, 10.0]), np.array([1.0, 2.0, 3.0]), window=1.0)


def test_a_response_that_is_nothing_has_no_edges():
    values = np.arange(60.0)
    design = np.column_stack([np.ones(60), values])
    for response in (np.zeros(60), np.full(60, 1e-200)):
        assert find_edges(values, design, response, minimum=5) == ()


@pytest.mark.parametrize(("values", "edges"), [((20.0, 30.0), (25.0,)), ((20.0, 20.0), ())])
def test_one_kind_of_value_has_no_edge_and_two_have_one(values, edges):
    t = np.repeat(values, 12)
    y = np.repeat([0.0, 1.0], 12) + 1e-3 * np.random.default_rng(7).normal(size=24)
    assert find_edges(t, np.ones((24, 1)), y, minimum=4) == edges


def test_causal_rate_by_hand():
    """w = 4, T = 1: the first step by hand, ahead = 2, followed = 1, rate = (1 − 0) / 2."""
    # eq. (2) of regression.rates
    rate = causal_rate(np.array([0.0, 1.0, 2.0]), np.array([0.0, 2.0, 2.0]), window=4.0)
    # second: ahead 1 + 0, followed .5, rate .5 + (.5 − .5)/2
    assert rate.tolist() == [0.0, 0.5, 0.5]


def test_causal_rate_of_a_ramp_is_exact_at_any_spacing():
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.1, 3.0, 400))
    rate = causal_rate(time, 5.0 - 0.25 * time, window=8.0)
    # what is left of the start falls by 1/(1 + Δt/T) a row, 400 rows of .1 to 3, T = 2
    np.testing.assert_allclose(rate[200:], -0.25, rtol=1e-12)


def test_causal_rate_is_as_late_as_half_its_window_and_as_quiet_as_said():
    """Lag of a ramp's start by its area, w/2; noise s √Δt / (2 T^1.5), T = w/4."""
    step, window = 0.01, 4.0
    time = step * np.arange(200_000)
    ramp = causal_rate(time, np.maximum(time - 5.0, 0.0), window=window)
    assert step * (1.0 - ramp[time >= 5.0]).sum() == pytest.approx(window / 2, rel=0.01)
    noise = np.random.default_rng(2).normal(0.0, 0.1, len(time))
    expected = 0.1 * np.sqrt(step) / 2.0
    # 200000 rows over a memory of some 400: a few percent of scatter; Δt/T adds half a percent
    assert causal_rate(time, noise, window=window).std() == pytest.approx(expected, rel=0.1)

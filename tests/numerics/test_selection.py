"""Selection against Hald's published path, refits, and its stated error rates."""

import math

import hald
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from multipos.errors import UsageError
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.numerics.selection import (
    Thresholds,
    akaike_criterion,
    compress,
    join,
    select_stepwise,
    thresholds,
)
from multipos.positions.scheme import read_scheme

NAMES = ["1", "x1", "x2", "x3", "x4"]
HALD = compress(hald.DESIGN, hald.RESPONSE)
HALF_UNIT = 0.5e-4  # of the last digit of the published F


def rss_of(X, y, columns):
    return float(solve(X[:, list(columns)], y).rss) if columns else float(y @ y)


# --- Hald


@pytest.mark.parametrize(("enter", "remove"), [(0.06, 0.10), (0.10, 0.15), (0.15, 0.20)])
def test_hald_path_with_every_f(enter, remove):
    # eq. (2) of numerics.selection
    found = select_stepwise(HALD, NAMES, Thresholds(enter, remove), forced=[0])
    assert [(s.action, s.term) for s in found.path] == [p[:2] for p in hald.PATH]
    assert_allclose([s.F for s in found.path], [p[2] for p in hald.PATH], rtol=0, atol=HALF_UNIT)
    assert [s.step for s in found.path] == [1, 2, 3, 4]
    assert found.columns == (0, 1, 2)
    assert [s.dof for s in found.path] == [11, 10, 9, 9]
    assert found.runner_up.term == "x4"


@pytest.mark.parametrize("size", [1e-155, 1e-120, 1e120])
def test_the_length_of_a_column_changes_no_f(size):
    """Which goes in and out again, whose square is no number."""
    long = compress(hald.DESIGN * [1.0, 1.0, 1.0, 1.0, size], hald.RESPONSE)
    found = select_stepwise(long, NAMES, Thresholds(0.06, 0.10), forced=[0])
    assert [(s.action, s.term) for s in found.path] == [p[:2] for p in hald.PATH]
    assert_allclose([s.F for s in found.path], [p[2] for p in hald.PATH], rtol=0, atol=HALF_UNIT)


def test_the_zero_of_a_column_changes_no_f():
    """Beside a constant; and a column that varies by 1e-5 of itself is not collinear with it."""
    moved = compress(hald.DESIGN + 1e6 * np.eye(5)[4], hald.RESPONSE)
    found = select_stepwise(moved, NAMES, Thresholds(0.06, 0.10), forced=[0])
    assert [(s.action, s.term) for s in found.path] == [p[:2] for p in hald.PATH]
    assert_allclose([s.F for s in found.path], [p[2] for p in hald.PATH], rtol=0, atol=HALF_UNIT)
    assert found.collinear == ()


def test_hald_default_thresholds_stop_at_x1_x4():
    found = select_stepwise(HALD, NAMES, Thresholds(), forced=[0])
    assert found.columns == (0, 1, 4)
    assert found.runner_up.term == "x2"
    assert pytest.approx(5.0259, abs=HALF_UNIT) == found.runner_up.F
    assert found.runner_up.p == pytest.approx(f_tail(found.runner_up.F, 1, 9), rel=1e-12)
    assert 0.05 < found.runner_up.p < 0.06
    assert found.F_to_enter > found.runner_up.F


def test_every_f_of_a_step_is_that_of_two_fits():
    found = select_stepwise(HALD, NAMES, Thresholds(0.06, 0.10), forced=[0])
    inside = {0}
    X, y = hald.DESIGN, hald.RESPONSE
    for step in found.path:
        here = rss_of(X, y, sorted(inside))
        for tested in step.tested:
            j = NAMES.index(tested.term)
            other = rss_of(X, y, sorted(inside ^ {j}))
            larger, smaller = max(here, other), min(here, other)
            dof = 13 - len(inside | {j})
            assert pytest.approx((larger - smaller) / (smaller / dof), rel=1e-9) == tested.F
            assert tested.p == pytest.approx(f_tail(tested.F, 1, dof), rel=1e-8)
        ranked = [t.F for t in step.tested if t.action == step.action and t.term != step.term]
        best = max if step.action == "add" else min
        assert best(ranked) == step.runner_up.F
        inside ^= {NAMES.index(step.term)}


def test_the_criterion_by_hand():
    """Ten rows, rss 10, two coefficients and the variance: K = 3."""
    assert akaike_criterion(10.0, 10, 2) == pytest.approx(0 + 6 + 24 / 6)
    assert math.isinf(akaike_criterion(1.0, 4, 2))


# --- against refits, whatever the problem


@pytest.mark.parametrize("n", [3, 50, 2000, 20_000])
def test_compressed_rows_are_all_rows(n):
    # eq. (1) of numerics.selection
    rng = np.random.default_rng(n)
    X, y = rng.standard_normal((n, 6)), rng.standard_normal(n)
    whole = compress(X, y)
    parts = join([compress(X[: n // 3], y[: n // 3]), compress(X[n // 3 :], y[n // 3 :])])
    both = np.column_stack((X, y))
    for triangle in (whole, parts):
        assert triangle.rows == n
        assert_allclose(triangle.R.T @ triangle.R, both.T @ both, rtol=1e-11, atol=1e-11 * n)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), enter=st.sampled_from([0.05, 0.2, 0.5]))
def test_it_ends_and_every_model_on_the_path_is_new(seed, enter):
    """Nearly equal columns make terms go in and out; no model comes back, as the proof says."""
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((30, 3))
    X = np.column_stack((np.ones(30), base, base @ rng.standard_normal((3, 6))))
    X[:, 4:] += 0.2 * rng.standard_normal((30, 6))
    names = [str(j) for j in range(10)]
    found = select_stepwise(
        compress(X, rng.standard_normal(30) + X[:, 5]),
        names,
        Thresholds(enter, enter + 0.01),
        forced=[0],
    )
    inside, seen = {"0"}, {frozenset({"0"})}
    for step in found.path:
        inside ^= {step.term}
        assert frozenset(inside) not in seen
        seen.add(frozenset(inside))


# --- rules


def test_hierarchy_keeps_what_a_term_stands_on():
    rng = np.random.default_rng(1)
    t = rng.uniform(-1, 1, 60)
    X = np.column_stack((np.ones(60), t, t**2))
    y = t**2 + rng.normal(0, 0.01, 60)  # t itself has no part in it
    free = select_stepwise(compress(X, y), ["1", "t", "t^2"], Thresholds(), forced=[0])
    assert free.columns == (0, 2)
    rules = [frozenset(), frozenset(), frozenset({1})]
    full = compress(X, y)
    forward = select_stepwise(
        full, ["1", "t", "t^2"], Thresholds(0.98, 0.99), forced=[0], requires=rules
    )
    assert [s.term for s in forward.path] == ["t", "t^2"]


def test_collinear_columns_stay_out_and_are_named():
    rng = np.random.default_rng(2)
    a = rng.standard_normal(40)
    X = np.column_stack((np.ones(40), a, 2 * a - 3, np.full(40, 7.0), rng.standard_normal(40)))
    names = ["1", "a", "b", "c", "d"]
    found = select_stepwise(compress(X, a + rng.normal(0, 1, 40)), names, Thresholds(), forced=[0])
    assert len({1, 2} & set(found.columns)) == 1
    assert set(found.collinear) == {"a" if 2 in found.columns else "b", "c"}


def test_as_many_terms_as_rows_let_forward_selection_go():
    """The paper's 21 rows for 21 factors."""
    rng = np.random.default_rng(3)
    X = np.column_stack((np.ones(21), rng.standard_normal((21, 20))))
    y = 3 * X[:, 4] + rng.standard_normal(21)
    names = [str(j) for j in range(21)]
    assert 4 in select_stepwise(compress(X, y), names, Thresholds(), forced=[0]).columns


def test_empty_model_is_an_answer():
    rng = np.random.default_rng(4)
    X = np.column_stack((np.ones(50), rng.standard_normal(50)))
    found = select_stepwise(
        compress(X, rng.standard_normal(50)), ["1", "a"], Thresholds(1e-6, 1e-5), forced=[0]
    )
    assert found.columns == (0,)
    assert found.path == ()


def test_exact_response_ends_the_search():
    rng = np.random.default_rng(5)
    X = np.column_stack((np.ones(30), rng.standard_normal((30, 5))))
    found = select_stepwise(
        compress(X, 2 * X[:, 1] - X[:, 3]), [str(j) for j in range(6)], Thresholds(), forced=[0]
    )
    assert found.columns == (0, 1, 3)


@pytest.mark.parametrize("level", np.random.default_rng(1).uniform(-1.0, 1.0, 8))
def test_a_constant_is_explained_by_the_constant(level):
    """What is left of it is rounding, 1e-16 of it, which other columns may explain by chance."""
    up = read_scheme("fibonacci-24").up
    X = np.column_stack((np.ones(24), up, up**2))
    found = select_stepwise(
        compress(X, np.full(24, level)), list("1xyzabc"), Thresholds(), forced=[0]
    )
    assert found.columns == (0,)


def test_f_thresholds():
    strict = select_stepwise(HALD, NAMES, Thresholds(f_enter=5.1, f_remove=5.0), forced=[0])
    assert strict.columns == (0, 1, 4)
    loose = select_stepwise(HALD, NAMES, Thresholds(f_enter=4.0, f_remove=3.9), forced=[0])
    assert [s.term for s in loose.path] == ["x4", "x1", "x2", "x4"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((0.2, 0.1, None, None), "--remove must not be below --enter"),
        ((None, None, 3.0, 4.0), "--f-remove must not be above --f-enter"),
        ((None, None, math.inf, 4.0), "both finite"),
        ((None, None, 3.0, None), "go together"),
        ((0.1, None, 3.0, 2.0), "give one kind"),
    ],
)
def test_thresholds_that_could_cycle_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        thresholds(*options)


def test_one_threshold_keeps_the_default_of_the_other():
    assert thresholds(0.06, None, None, None) == Thresholds(0.06, 0.10)
    assert thresholds(0.15, None, None, None) == Thresholds(0.15, 0.30)
    assert thresholds(None, 0.02, None, None) == Thresholds(0.01, 0.02)


# --- rates


@pytest.mark.slow
def test_true_terms_are_found_and_false_ones_come_at_the_stated_rate():
    """Orthogonal columns: each of the 17 false terms is tested on its own, at `enter`."""
    rng = np.random.default_rng(6)
    n, runs, level = 200, 400, 0.05
    X = np.column_stack((np.ones(n), np.linalg.qr(rng.standard_normal((n, 21)))[0][:, :20]))
    X[:, 1:] = np.linalg.qr(X)[0][:, 1:] * math.sqrt(n)
    names = [str(j) for j in range(21)]
    true, missed, false = (2, 7, 11), 0, 0
    for _ in range(runs):
        y = 0.5 * X[:, true].sum(axis=1) + rng.standard_normal(n)
        found = select_stepwise(compress(X, y), names, Thresholds(level, 0.1), forced=[0])
        missed += len(set(true) - set(found.columns))
        false += len(set(found.columns) - {0, *true})
    # power at 0.5 √200 = 7.1 standard errors: a miss is a 5-sigma event
    assert missed == 0
    trials = runs * 17
    sd = math.sqrt(trials * level * (1 - level))
    bound = normal_quantile(1 - 1e-4)
    # each false term that is in takes its own chance part out of s², so the rest pass a little
    # more easily: (1 + 17 · 0.05 · 4.6/180), 2 % of the rate at most
    assert trials * level - bound * sd < false < 1.05 * trials * level + bound * sd

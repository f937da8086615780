"""Selection against Hald's published path and subsets, refits, and its stated error rates."""

import math
from itertools import combinations

import hald
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from multipos.errors import MultiposError, UsageError
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import f_tail, normal_quantile
from multipos.numerics.selection import (
    Guard,
    Thresholds,
    all_subsets,
    compress,
    criteria,
    join,
    residual_sums,
    select_backward,
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


def test_hald_backward_reaches_x1_x2():
    found = select_backward(HALD, NAMES, Thresholds(), forced=[0])
    assert [(s.action, s.term) for s in found.path] == [("remove", "x3"), ("remove", "x4")]
    assert found.columns == (0, 1, 2)


def test_backward_removes_the_weakest_of_terms_that_cancel():
    """Whatever its F: 13 rows less 5 terms, then less 4, are left."""
    full = Guard(HALD, np.zeros(5), lambda columns, b: len(columns) > 3)
    found = select_backward(HALD, NAMES, Thresholds(remove=1.0), forced=[0], guard=full)
    assert [(step.term, step.dof) for step in found.path] == [("x3", 8), ("x4", 9)]
    assert found.columns == (0, 1, 2)


def test_hald_all_sixteen_subsets():
    rss = residual_sums(HALD, [0])
    for index, value in enumerate(rss):
        columns = tuple(j + 1 for j in range(4) if index >> j & 1)
        assert value == pytest.approx(hald.SUBSETS[columns], abs=0.005)
        assert value == pytest.approx(rss_of(hald.DESIGN, hald.RESPONSE, (0, *columns)), rel=1e-12)
    best = all_subsets(HALD, forced=[0])
    assert len(best) == 16
    assert best[0].columns == (0, 1, 2)
    assert best[0].r2 == pytest.approx(0.97868, abs=5e-6)
    assert all_subsets(HALD, forced=[0], criterion="adjusted_r2")[0].columns == (0, 1, 2, 4)


def test_criteria_by_hand():
    """Ten rows, rss 10, two coefficients and the variance: K = 3."""
    aicc, bic = criteria(10.0, 10, 2)
    assert aicc == pytest.approx(0 + 6 + 24 / 6)
    assert bic == pytest.approx(3 * math.log(10))
    assert criteria(20.0, 10, 2)[1] - bic == pytest.approx(10 * math.log(2))
    assert math.isinf(criteria(1.0, 4, 2)[0])


@pytest.mark.parametrize(("forced", "total"), [([0], 12), ([], 13)])
def test_adjusted_r2_of_hald_by_hand(forced, total):
    """x1 and x2 leave 57.904 on 10, of 2715.763 on 12; of y'y on 13 where no constant must be."""
    chosen = next(s for s in all_subsets(HALD, forced=forced) if s.columns == (0, 1, 2))
    tss = 2715.763 if forced else float(hald.RESPONSE @ hald.RESPONSE)
    assert chosen.adjusted_r2 == pytest.approx(1 - (57.904 / 10) / (tss / total), abs=2e-6)


# --- against refits, whatever the problem


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(9, 40), forced=st.booleans())
def test_subsets_against_refits(seed, n, forced):
    rng = np.random.default_rng(seed)
    X = np.column_stack((np.ones(n), (rng.standard_normal((n, 4)) + 3) * [1.0, 1e6, 1e-6, 50.0]))
    y = rng.standard_normal(n)
    always = [0] if forced else []
    free = [j for j in range(5) if j not in always]
    rss = residual_sums(compress(X, y), always)
    for size in range(len(free) + 1):
        for chosen in combinations(range(len(free)), size):
            columns = sorted([*always, *(free[j] for j in chosen)])
            assert rss[sum(1 << j for j in chosen)] == pytest.approx(
                rss_of(X, y, columns), rel=1e-8
            )


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
    kept = select_backward(full, ["1", "t", "t^2"], Thresholds(), forced=[0], requires=rules)
    assert kept.columns == (0, 1, 2)
    forward = select_stepwise(
        full, ["1", "t", "t^2"], Thresholds(0.98, 0.99), forced=[0], requires=rules
    )
    assert [s.term for s in forward.path] == ["t", "t^2"]
    assert {s.columns for s in all_subsets(full, forced=[0], requires=rules)} == {
        (0,),
        (0, 1),
        (0, 1, 2),
    }


def test_collinear_columns_stay_out_and_are_named():
    rng = np.random.default_rng(2)
    a = rng.standard_normal(40)
    X = np.column_stack((np.ones(40), a, 2 * a - 3, np.full(40, 7.0), rng.standard_normal(40)))
    names = ["1", "a", "b", "c", "d"]
    found = select_stepwise(compress(X, a + rng.normal(0, 1, 40)), names, Thresholds(), forced=[0])
    assert len({1, 2} & set(found.columns)) == 1
    assert set(found.collinear) == {"a" if 2 in found.columns else "b", "c"}
    rss = residual_sums(compress(X, a), [0])
    assert all(np.isinf(rss[i]) for i in range(16) if i & 3 == 3 or i & 4)
    with pytest.raises(MultiposError, match=r"cannot be separated from"):
        select_backward(compress(X, a), names, Thresholds(), forced=[0])


def test_saturated_model_refuses_backward_and_lets_forward_go():
    """The paper's 21 rows for 21 factors."""
    rng = np.random.default_rng(3)
    X = np.column_stack((np.ones(21), rng.standard_normal((21, 20))))
    y = 3 * X[:, 4] + rng.standard_normal(21)
    names = [str(j) for j in range(21)]
    with pytest.raises(MultiposError, match=r"saturated: 21 rows for 21 terms"):
        select_backward(compress(X, y), names, Thresholds(), forced=[0])
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


def test_as_many_rows_as_columns_leave_what_least_squares_leave():
    rng = np.random.default_rng(6)
    X, y = rng.standard_normal((4, 4)), rng.standard_normal(4)
    for index, value in enumerate(residual_sums(compress(X, y))):
        columns = tuple(j for j in range(4) if index >> j & 1)
        assert value == pytest.approx(rss_of(X, y, columns), abs=1e-12)

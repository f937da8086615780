"""Numbers of regressions by hand or by a second route, at points without symmetry."""

import hashlib
import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import f as fisher
from scipy.stats import t

from multipos.errors import MultiposError
from multipos.numerics.selection import Selection, Thresholds
from multipos.numerics.terms import parse_terms
from multipos.regression import piecewise, segmentation, variation
from multipos.regression.correlation import _long_run, bandwidth, time_order
from multipos.regression.junctions import _junction, find_junctions
from multipos.regression.observations import _same, _still, _usual_time, _usual_window, join_runs
from multipos.regression.piecewise import _fit, _require_rows, _segment, _Whole
from multipos.regression.prediction import hold_inside
from multipos.regression.rates import default_window, rows_of_runs
from multipos.regression.region import Region
from multipos.regression.regression import Regression, _balance
from multipos.regression.robust import _by_law, _general, _tested, robust_fit
from multipos.regression.runs import within_runs
from multipos.regression.segment import Between, combined_variance
from multipos.regression.segmentation import hinges
from multipos.regression.whitening import (
    _autoregression,
    _filtered,
    _first_variance,
    _law,
    _less,
    _likelihoods,
)
from multipos.reports.regression_text import has_own_path, terms_table


@dataclass
class Data:
    response: np.ndarray
    run: np.ndarray


class Rows(SimpleNamespace):
    def __init__(self, response, columns):
        super().__init__(response=response, columns=columns, run=None)

    def __len__(self):
        return len(self.response)


def ages_of(*lengths):
    return np.concatenate([np.arange(length) for length in lengths])


def test_likelihoods_of_laws_by_dense_covariances():
    """Of a mean and a slope beside noise whose covariance is that of the filter, in two runs."""
    rng = np.random.default_rng(3)
    n, age = 40, ages_of(23, 17)
    X = np.column_stack([np.ones(n), rng.normal(size=n)])
    e = rng.normal(size=n)
    for i in range(1, n):
        e[i] += 0.6 * e[i - 1] if age[i] else 0.0
    found = _likelihoods(np.column_stack([X, e]), age)
    for rho, share in list(found)[::7]:
        theta = rho * share
        W = _filtered(np.eye(n), age, rho, theta)
        V = np.linalg.inv(W.T @ W)
        weights = np.linalg.inv(V)
        b = np.linalg.solve(X.T @ weights @ X, X.T @ weights @ e)
        square = (e - X @ b) @ weights @ (e - X @ b)
        by_hand = -0.5 * np.linalg.slogdet(V)[1] - 0.5 * np.linalg.slogdet(X.T @ weights @ X)[1]
        by_hand -= 0.5 * (n - 2) * math.log(square)
        assert found[rho, share] == pytest.approx(by_hand, abs=1e-6)
    best = max(found, key=found.__getitem__)
    near = [one for one in found if one[1] == best[1] and one != best]
    assert min(abs(one[0] - best[0]) for one in near) < 0.1  # the grid is finer at its top
    assert all(0.0 <= rho < 0.9995 and 0.0 <= share < 1.0 for rho, share in found)


def test_the_first_variance_is_that_of_the_process():
    """x = ρ x' + e − θ e': its variance is a sum over all that went before."""
    rho, theta = 0.8, 0.3
    weights = [1.0, *((rho - theta) * rho ** np.arange(200.0))]
    assert _first_variance(rho, theta) == pytest.approx(np.square(weights).sum(), rel=1e-12)


def test_rows_less_those_before_within_their_run():
    z = np.array([3.0, 5.0, -2.0, 7.0, 11.0])
    assert_allclose(_less(z, 0.4, ages_of(3, 2), 1), [3.0, 3.8, -4.0, 7.0, 8.2])
    assert_allclose(_less(z, 0.4, ages_of(3, 2), 2), [3.0, 5.0, -3.2, 7.0, 11.0])


@pytest.mark.parametrize(("n", "order"), [(400, 3), (39, 1), (19, 0)])
def test_an_autoregression_has_the_order_of_least_criterion(n, order):
    """n ln(e'e/n) + q ln n over q up to a twentieth of the rows, and six."""
    rng = np.random.default_rng(5)
    e, age = rng.normal(size=n), ages_of(n - n // 3, n // 3)
    for i in range(2, n):
        if age[i] >= 2:
            e[i] += 0.5 * e[i - 1] - 0.6 * e[i - 2]
    found, scores = [], []
    for q in range(min(n // 20, 6) + 1):
        rows = [[e[i - lag] if age[i] >= lag else 0.0 for lag in range(1, q + 1)] for i in range(n)]
        lagged = np.array(rows).reshape(n, q)
        a = np.linalg.lstsq(lagged, e, rcond=None)[0] if q else np.zeros(0)
        left = e - lagged @ a
        found.append(a)
        scores.append(n * math.log(left @ left / n) + q * math.log(n))
    best = found[int(np.argmin(scores))]
    assert len(best) <= order
    assert_allclose(_autoregression(e, age), best, rtol=1e-9)


def test_the_long_run_power_of_scores_row_by_row():
    """Whitened by the correlation of neighbours, corrected; sums with Bartlett's weights; back."""
    rng = np.random.default_rng(8)
    n, run = 60, np.repeat([0, 1], [35, 25])
    g = rng.normal(size=(n, 2))
    for i in range(1, n):
        g[i] += [0.5 * g[i - 1, 0], -0.3 * g[i - 1, 1]] if run[i] == run[i - 1] else 0.0
    order = SimpleNamespace(order=np.arange(n), run=run)
    beside = [i for i in range(1, n) if run[i] == run[i - 1]]
    h, a = g.copy(), np.zeros(2)
    for j in range(2):
        a[j] = sum(g[i, j] * g[i - 1, j] for i in beside) / (g[:, j] @ g[:, j]) * n / len(beside)
        a[j] += (1.0 + 3.0 * a[j]) / n if a[j] > 0.0 else 0.0
        for i in range(n):
            h[i, j] = g[i, j] - a[j] * g[i - 1, j] if i in beside else g[i, j]
            h[i, j] *= 1.0 if i in beside else math.sqrt(1.0 - a[j] ** 2)
    left = sum(h[i] @ h[i - 1] for i in beside) / np.sum(h**2)
    B = bandwidth(abs(left), n)
    S = np.zeros((2, 2))
    for i in range(n):
        for k in range(n):
            if run[i] == run[k] and abs(i - k) < B:
                S += (1.0 - abs(i - k) / B) * np.outer(h[i], h[k])
    wanted = S / np.outer(1.0 - a, 1.0 - a)
    assert_allclose(_long_run(g, order), wanted, rtol=1e-9)


def test_a_third_of_the_rows_is_the_widest_band():
    """α = 4·.25/(.25·2.25) = 16/9 at .5: 1.1447 (16/9·90)^(1/3) = 6.2."""
    assert bandwidth(0.5, 90) == 7
    assert bandwidth(0.96, 90) == 30
    assert bandwidth(0.99, 10**6) == bandwidth(0.97, 10**6)


def test_columns_that_are_one_but_for_size_and_zero():
    x = np.array([1.0, 2.0, 4.0, 8.5])
    off = 3e-10 * np.array([1.0, -1.0, 1.0, -1.0])
    assert _same(x, -3.0 * x, False)
    assert not _same(x, 3.0 * x + 1.0, False)
    assert _same(x, 3.0 * x + 1.0, True)
    assert not _same(x, x + 10.0 * off, True)
    assert _same(x, x + 0.1 * off, True)
    assert _still(np.array([1.0, 1.0 + 5e-15]), True)
    assert not _still(np.array([1.0, 1.0 + 5e-14]), True)
    assert not _still(np.array([1.0, 1.0]), False)
    assert _still(np.zeros(2), False)


def test_rows_less_what_differs_between_runs():
    """Each column less the mean of its run, and the mean of these means added."""
    run = np.array([4, 4, 9, 9, 9])
    design, y = (
        np.array([[1.0, 3.0], [2.0, 5.0], [4.0, 1.0], [8.0, 2.0], [3.0, 9.0]]),
        np.arange(5.0),
    )
    X, data = within_runs(design, Data(y, run))
    for found, column in zip([*X.T, data.response], [*design.T, y], strict=True):
        first, second = column[:2].mean(), column[2:].mean()
        wanted = np.concatenate([column[:2] - first, column[2:] - second]) + (first + second) / 2
        assert_allclose(found, wanted)


def test_numbers_of_a_segment_by_their_definitions(monkeypatch):
    rng = np.random.default_rng(2)
    n = 12
    X = np.column_stack([np.ones(n), rng.normal(size=n)])
    y = X @ [3.0, 0.5] + rng.normal(size=n)
    H = X @ np.linalg.pinv(X)
    e = y - H @ y
    terms = parse_terms("1 + t")
    selection = Selection((0, 1))
    fit = SimpleNamespace(
        residuals=e, leverage=np.diag(H), dof=n - 2, design=X, selection=selection,
        chosen=(0, 1), values=np.zeros(2), covariance=np.eye(2),
    )  # fmt: skip
    monkeypatch.setattr(piecewise, "_tested", lambda *_: (3.4, 1))
    data = Rows(y, {"t": X[:, 1]})
    plan = SimpleNamespace(terms=terms, confidence=0.9, variables=("t",))

    def segment(rows, kept):
        whole = SimpleNamespace(
            plan=plan, data=data, parts=[rows], spans=[(0, 1)],
            local=lambda chosen, s: (kept, np.eye(2)[: len(kept)]),
        )  # fmt: skip
        return _segment(whole, fit, 0, None)

    whole = segment(np.arange(n), terms)
    assert whole.rms == pytest.approx(math.sqrt(e @ e / (n - 2)))
    assert whole.r2 == pytest.approx(np.corrcoef(y, H @ y)[0, 1] ** 2)
    assert whole.adjusted_r2 == pytest.approx(1.0 - (e @ e / (n - 2)) / y.var(ddof=1))
    left_out = []
    for i in range(n):
        rest = np.arange(n) != i
        left_out.append(y[i] - X[i] @ np.linalg.lstsq(X[rest], y[rest], rcond=None)[0])
    assert whole.press == pytest.approx(np.sqrt(np.mean(np.square(left_out))))
    assert whole.p == pytest.approx(fisher.sf(3.4, 1, n - 2))
    assert whole.F_critical == pytest.approx(fisher.ppf(0.9, 1, n - 2))
    assert whole.aicc == pytest.approx(n * math.log(e @ e / n) + 2 * 3 * n / (n - 3 - 1))
    assert whole.limits == {"t": (X[:, 1].min(), X[:, 1].max())}
    rows = np.array([1, 4, 5, 7, 10])
    part = segment(rows, terms)
    own = e[rows] @ e[rows] / (5 - np.diag(H)[rows].sum())
    assert part.rms == pytest.approx(math.sqrt(own))
    assert part.r2 == pytest.approx(1.0 - e[rows] @ e[rows] / (4 * y[rows].var(ddof=1)))
    assert part.adjusted_r2 == pytest.approx(1.0 - own / y[rows].var(ddof=1))
    bare = segment(rows, terms[1:])
    assert bare.r2 == pytest.approx(1.0 - e[rows] @ e[rows] / (y[rows] @ y[rows]))
    assert bare.adjusted_r2 == pytest.approx(1.0 - own / (y[rows] @ y[rows] / 5))


def test_terms_of_a_segment_are_those_of_the_whole_with_its_hinges():
    terms = parse_terms("1 + t + t^2 + t*v")
    chosen = [*terms, *hinges(terms, "t", (2.0, 5.0), both=True)]
    b = np.random.default_rng(6).normal(size=len(chosen))
    at = {"t": np.array([0.7, 3.3, 6.1]), "v": np.array([1.7, -0.4, 2.2])}
    whole = sum(value * column.evaluate(at) for value, column in zip(b, chosen, strict=True))
    of = SimpleNamespace(columns=chosen, edges=(2.0, 5.0))
    for i in range(3):
        own, L = _Whole.local(of, range(len(chosen)), i)
        here = sum(value * term.evaluate(at) for value, term in zip(L @ b, own, strict=True))
        assert here[i] == pytest.approx(whole[i], rel=1e-10)


@pytest.mark.parametrize(("continuous", "shown"), [(True, [1, 3]), (False, [0, 1, 2, 3])])
def test_segments_that_are_fitted_together_share_their_path(continuous, shown):
    """Two of a rising branch and two of a falling one."""
    segments = [SimpleNamespace(branch=b) for b in ("rising", "rising", "falling", "falling")]
    r = SimpleNamespace(segments=segments, continuous=continuous)
    assert [i for i in range(4) if has_own_path(r, i)] == shown


def test_a_balance_is_of_one_variable():
    points = [
        {"T": -7.0, "predicted": 0.3, "U": 0.02, "outside": False},
        {"T": 25.0, "predicted": None, "U": 0.05, "outside": True},
    ]
    found = _balance(points)
    assert (found.variable, found.at.tolist()) == ("T", [-7.0, 25.0])
    assert_allclose((found.predicted, found.U), [[0.3, np.nan], [0.02, 0.05]])
    assert found.outside.tolist() == [False, True]
    points[1] = {"p": 25.0} | {name: value for name, value in points[1].items() if name != "T"}
    with pytest.raises(ValueError, match="not of one variable"):
        _balance(points)


def test_a_variance_is_at_least_its_rounding():
    """Of 3 a + 2 b with u 2 and 3, r = −1: nothing but what 2⁻⁵² of (6 + 6)² leaves unknown."""
    C = np.array([[4.0, -6.0], [-6.0, 9.0]])
    found = combined_variance(np.array([[3.0, 2.0], [3.0, 0.0]]), C)
    assert_allclose(found, [144.0 * 2.0**-52, 36.0], rtol=1e-12)
    rounded = np.array([[-1e-40, 0.0], [0.0, 9.0]])  # what is zero may round to less
    assert_allclose(combined_variance(np.array([[3.0, 2.0]]), rounded), [36.0])


def test_leverage_of_a_region_is_the_square_of_its_factor():
    terms = parse_terms("1 + t + t*v")
    factor = np.array([[0.3, 0.0, -0.2], [0.0, 0.7, 0.5]])
    at = {"t": np.array([0.7, -3.3]), "v": np.array([1.7, 0.4])}
    values = np.stack([np.ones(2), at["t"], at["t"] * at["v"]])
    found = Region(terms, factor, 1.0).leverage(at, 2)
    assert_allclose(found, np.sum((factor @ values) ** 2, axis=0))


def test_a_jump_between_two_segments_where_it_is_largest():
    """Rows near the edge, the largest difference of both and its U by the fewer of freedom."""
    C = [np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([[0.03, -0.02], [-0.02, 0.05]])]
    values, v = [np.array([1.0, 2.0]), np.array([1.3, 1.4])], np.array([0.5, -3.0, 2.0, 9.0])

    def segment(i, dof, covariance):
        return SimpleNamespace(
            values=values[i], robust_covariance=covariance, robust_dof=dof,
            design=lambda columns, rows: np.column_stack([np.ones(len(rows)), v[rows]]),
        )  # fmt: skip

    below, above = segment(0, 7.0, C[0]), segment(1, 6.5, 4.0 * C[1])
    found = _junction(below, above, {}, np.array([0, 1, 2]), 5.0, 0.9)
    x = np.array([1.0, -3.0])
    u = math.sqrt(x @ C[0] @ x + 4.0 * x @ C[1] @ x)
    assert found.jump == pytest.approx(0.3 + 0.6 * 3.0)
    assert pytest.approx(t.ppf(0.95, 6.5) * u, rel=1e-6) == found.U
    assert find_junctions([], Rows(v, {}), None, (), 0.9) == ()


def test_columns_are_held_inside_what_a_segment_was_fitted_to():
    region = SimpleNamespace(leverage=lambda at, n: at["v"] ** 2, limit=4.0)
    segments = [
        SimpleNamespace(
            used=("t", "v"), limits={"v": (-1.0, 3.0)}, range=(0.0, 5.0), region=region
        ),
        SimpleNamespace(used=("t", "v"), limits={"v": (-9.0, 9.0)}, range=(5.0, 8.0), region=None),
    ]
    regression = SimpleNamespace(segments=segments, segment_variable="t")
    columns = {
        "t": np.array([0.0, -0.1, 4.0, 4.0, 4.0, 8.0, 8.1]),
        "v": np.array([-1.0, 0.0, -1.1, 2.1, 1.9, 9.0, 0.0]),
    }
    beyond, held = hold_inside(regression, columns, np.array([0, 0, 0, 0, 0, 1, 1]))
    assert beyond.tolist() == [False, True, True, True, False, False, True]
    assert held["t"].tolist() == [0.0, 0.0, 4.0, 4.0, 4.0, 8.0, 8.0]
    assert held["v"].tolist() == [-1.0, 0.0, -1.0, 2.1, 1.9, 9.0, 0.0]


def test_a_law_is_tested_by_wald_and_what_is_later_makes_no_less_of_it():
    values, C = np.array([5.0, 0.4, -0.3]), np.diag([1.0, 0.02, 0.03])
    F = (0.16 / 0.02 + 0.09 / 0.03) / 2
    one = SimpleNamespace(values=values, covariance=C, dof=9, later=None)
    slopes = np.eye(3)[1:]
    found = _by_law(one, slopes, 0.5)
    assert (found.F, found.p) == (pytest.approx(F), pytest.approx(fisher.sf(F, 2, 9)))
    later = SimpleNamespace(values=values, covariance=4.0 * C, dof=7, later=None)
    one.later = later
    assert pytest.approx(F) == _by_law(one, slopes, found.p).F
    assert pytest.approx(F / 4) == _by_law(one, slopes, found.p * 1.01).F
    assert math.isnan(_tested(3.0, 0, 5.0).p)
    assert math.isnan(_tested(3.0, 2, 0.0).p)


def test_tables_of_several_runs_are_named_as_they_can_be_told_apart(tmp_path):
    """By their files' names, else by their paths, else by number; with what stood there before."""
    for folder, name, value in (("a", "x", 1), ("a", "y", 2), ("b", "x", 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / f"{name}.csv").write_text(f"v,run\n{value},p\n{value},\n")
    ax, ay, bx = (tmp_path / name for name in ("a/x.csv", "a/y.csv", "b/x.csv"))
    table, run = join_runs([ax, ay], "run")
    assert list(table.text(run)) == ["x p", "x", "y p", "y"]
    table, run = join_runs([ax, bx], "run")
    assert list(table.text(run)) == [f"{ax} p", str(ax), f"{bx} p", str(bx)]
    each = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (ax, bx)]
    assert table.sha256 == hashlib.sha256("".join(each).encode()).hexdigest()
    columns = [{"v": [4.0, 5.0], "run": ["q", "q"]}, {"v": [6.0, 7.0], "run": ["q", "q"]}]
    table, run = join_runs(columns, "run")
    assert list(table.text(run)) == ["1 q", "1 q", "2 q", "2 q"]
    assert table.sha256 is None  # of what is no file


def test_rows_of_runs_and_their_usual_window():
    run = np.array([2, 0, 2, 1, 0, 2, 0, 0])
    assert [rows.tolist() for rows in rows_of_runs(run)] == [[1, 4, 6, 7], [3], [0, 2, 5]]
    time = np.array([0.0, 0.0, 2.0, 7.0, 1.0, 4.0, 2.0, 3.0])
    each = [default_window(time[[1, 4, 6, 7]]), default_window(time[[0, 2, 5]])]
    assert _usual_window(time, run) == pytest.approx(np.mean(each))
    assert _usual_window(np.sort(time), None) == default_window(np.sort(time))


@pytest.mark.parametrize(("dof", "rss"), [(0, 1.0), (5, 0.0)])
def test_what_leaves_nothing_has_no_robust_covariance(dof, rss):
    assert robust_fit(SimpleNamespace(dof=dof, rss=rss), None, None) is None


def test_leverage_is_the_sum_of_squares_of_a_factor():
    terms, factor = parse_terms("1 + t"), np.array([[0.3, -0.2], [0.0, 0.5]])
    t_ = np.arange(7.0)
    values = np.stack([np.ones(7), t_])
    found = Region(terms, factor, 1.0).leverage({"t": t_}, 7)
    assert_allclose(found, np.sum((factor @ values) ** 2, axis=0))


# --- cuts


def least_squares(X, y):
    return np.linalg.lstsq(X, y, rcond=None)[1][0]


def test_an_edge_is_polished_among_finer_cuts():
    """One after the other, between its bins and the fewest rows, by the sum of both sides."""
    rng = np.random.default_rng(6)
    n, minimum = 48, 5
    v = np.sort(rng.uniform(0.0, 9.0, n))
    X = np.column_stack([np.ones(n), v])
    y = np.where(v < v[19], 1.3 * v, 4.0 - v) + np.where(v < v[33], 0.0, 3.0)
    y = y + 0.05 * rng.normal(size=n)
    cuts = [0, 6, 13, 22, 30, 37, 48]
    data = segmentation._Sorted(v, X, y, cuts, minimum, 1)
    for start, end in ((0, 6), (3, 20), (14, 21), (6, 37), (14, 48)):
        found = segmentation.residual_sum(data.triangle(start, end))
        assert found == pytest.approx(least_squares(X[start:end], y[start:end]))
    cost, edges = segmentation._polish(data, (3, 4))
    wanted, first, second = [22, 30], [*range(13, 31)], [*range(22, 38)]
    for i, fine in enumerate((first, second)):
        start, end = (0, wanted[1]) if i == 0 else (wanted[0], n)
        fine = [j for j in fine if start + minimum <= j <= end - minimum]
        sums = [
            least_squares(X[start:j], y[start:j]) + least_squares(X[j:end], y[j:end]) for j in fine
        ]
        wanted[i] = fine[int(np.argmin(sums))]
    assert edges == tuple(wanted) == (19, 33)
    parts = ((0, 19), (19, 33), (33, 48))
    assert cost == pytest.approx(sum(least_squares(X[a:b], y[a:b]) for a, b in parts))


def test_terms_about_the_means_of_their_variables():
    """A sum of products of what variables are about their means is the term again."""
    rng = np.random.default_rng(2)
    columns = {"u": rng.normal(size=9) + 2.0, "v": rng.normal(size=9) * 3.0 - 1.5}
    sizes = variation.Contributions(columns, 7.0)
    about = {name: column - column.mean() for name, column in columns.items()}
    for term in parse_terms("u^3*v^2 + |u|*v^2 + v"):
        total = sum(
            weight * variation._evaluate(product, about, columns)
            for product, weight in sizes._expanded(term).items()
        )
        assert_allclose(total, term.evaluate(columns))
    terms = parse_terms("v^2 + v")
    # about its mean m v² is (v − m)² + 2 m (v − m) and a constant; 2 spans for the second degree
    m, w = columns["v"].mean(), np.abs(about["v"]).max()
    for b, a in ((0.9, -1.8 * m), (1.1, -2.2 * m)):
        largest = abs(b) * np.abs(about["v"] ** 2).max()
        span = variation.Contributions(columns, largest / 2.0 * 1.01)
        assert not span.cancel(terms, np.array([b, a]))
        span = variation.Contributions(columns, largest / 2.0 * 0.99)
        assert span.cancel(terms, np.array([b, a]))
    only = [terms[1]]
    assert variation.Contributions(columns, 0.99 * 2.5 * w).cancel(only, np.array([-2.5]))
    assert not variation.Contributions(columns, 1.01 * 2.5 * w).cancel(only, np.array([-2.5]))


def test_the_rounding_of_a_leverage():
    """2 unit Σ |G x| (|G| |x|), whose square h is."""
    rng = np.random.default_rng(3)
    G, x = rng.normal(size=(2, 3)), rng.normal(size=5)
    terms = tuple(parse_terms("1 + v + v^2"))
    found = Region(terms, G, 1.0).rounding({"v": x}, 5, 1e-3)
    for h, value in zip(found, x, strict=True):
        row = np.array([1.0, value, value**2])
        wanted = sum(abs(g @ row) * (np.abs(g) @ np.abs(row)) for g in G)
        assert h == pytest.approx(2e-3 * wanted)


def test_coefficients_of_a_segment_stand_with_their_u():
    one = SimpleNamespace(term="v^2", value=-2.5, u=0.013, t=-192.3, p=0.04)
    table = terms_table(SimpleNamespace(robust=None, coefficients=[one]), "")
    assert table.rows == (("v^2", "-2.500(13)", "-192.3", "0.040"),)


def test_a_gap_is_more_than_five_usual_steps():
    """Steps of .4: 1.9 is none, 2.1 is one."""
    t = np.cumsum([0.0, 0.4, 0.4, 1.9, 0.4, 2.1, 0.4, 0.4])
    found = time_order(t[::-1])
    assert found.order.tolist() == list(range(7, -1, -1))
    assert found.run.tolist() == [0, 0, 0, 0, 0, 1, 1, 1]


def test_what_a_law_leaves_of_residuals_is_that_of_least_squares():
    """Of filtered columns beside the filtered response; its autoregression goes on."""
    rng = np.random.default_rng(3)
    both = np.linalg.qr(rng.normal(size=(60, 5)).cumsum(axis=0))[0]
    age = np.concatenate([np.arange(40), np.arange(20)])
    law = _law(both, age, (0.8, 0.4))
    white = _filtered(both, age, 0.8, 0.32)
    b = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
    rest = white[:, -1] - white[:, :-1] @ b
    assert (law.rho, law.theta) == (0.8, pytest.approx(0.32))
    assert_allclose(law.further, _autoregression(rest, age), rtol=1e-6, atol=1e-9)
    assert len(_law(both, age, (0.0, 0.0)).further) == 0


def test_zeros_of_runs_take_degrees_of_freedom():
    fit = SimpleNamespace(coefficients=np.ones(2), cofactor=np.eye(2), rss=12.0, dof=9)
    found = _general(fit, 3)
    assert (found.dof, found.covariance.tolist()) == (6, (2.0 * np.eye(2)).tolist())
    assert _general(fit, 9) is None
    plan = SimpleNamespace(limits=None, constant=True)
    _require_rows(plan, 5, 5, "A segment")
    with pytest.raises(MultiposError, match="A segment has 4 rows for 5 terms"):
        _require_rows(plan, 4, 5, "A segment")
    plan.limits = Thresholds()
    _require_rows(plan, 3, 9, "A segment")
    with pytest.raises(MultiposError, match="has 2 rows"):
        _require_rows(plan, 2, 9, "A segment")
    plan.limits, data = None, SimpleNamespace(response=np.ones(3))
    whole = SimpleNamespace(plan=plan, design=np.ones((3, 2)), data=data, lost=2, where="A segment")
    with pytest.raises(MultiposError, match="A segment has 3 rows for 4 terms"):
        _fit(whole, alone=True)


def test_rows_that_cool_have_segments_of_their_own():
    """Edges at 0 and 2: three of heating, then three of cooling; a row at rest is as before it."""
    one = SimpleNamespace(segment_variable="t", branch_column="rate", edges=(0.0, 2.0))
    columns = {"t": np.array([-1.0, 0.5, 3.0, 3.0, 1.0, -2.0]),
               "rate": np.array([0.0, 1.0, 1.0, 0.0, -1.0, 0.0])}  # fmt: skip
    assert Regression.segment_of(one, columns).tolist() == [0, 1, 2, 2, 4, 3]
    one.segment_variable, one.edges = None, ()
    assert Regression.segment_of(one, columns).tolist() == [0, 0, 0, 0, 1, 1]
    one.branch_column = None
    assert Regression.segment_of(one, columns).tolist() == [0] * 6


def test_what_runs_differ_by_is_about_the_centre():
    """z = (1, v − v̄): Ψ of (.04, .01; .01, .09) at v = 5 about 2 is .04 + 2·3·.01 + 9·.09."""
    between = Between(4, "v", 2.0, np.array([[0.04, 0.01], [0.01, 0.09]]))
    columns, rows = {"v": np.array([7.0, 5.0, 2.0])}, np.array([1, 2])
    assert_allclose(between.columns(columns, rows), [[1.0, 3.0], [1.0, 0.0]])
    assert_allclose(between.variance(columns, rows), [0.04 + 0.06 + 0.81, 0.04])
    assert (between.sd, between.slope_sd, between.dof) == (pytest.approx(0.2), 0.3, 3)


def test_the_time_column_by_its_name():
    """`time` of numbers in any order; another name where it never falls and is no variable."""
    rising, falling = np.array([0.0, np.nan, 2.0, 2.0]), np.array([0.0, 3.0, 2.0, 4.0])
    columns = {"v": rising, "t_s": rising, "seconds": falling, "time": falling}

    def asked(names, used=(), text=()):
        table = SimpleNamespace(
            columns=dict.fromkeys(names), is_text=lambda name: name in text,
            number=lambda name, empty: columns[name],
        )  # fmt: skip
        return _usual_time(table, used)

    assert asked(columns) == "time"
    assert asked(columns, text=("time",)) == "t_s"
    assert asked(columns, used=("time", "t_s")) is None
    assert asked(("v", "seconds")) is None

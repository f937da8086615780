"""Numbers of static records by hand or by a second route, at points without symmetry."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import nnls
from scipy.stats import chi2, t

import multipos as mp
from multipos.bias_stability import allan, analysis, noise_laws, trends
from multipos.bias_stability.allan import _pairs, _products, octaves, phase_covariance, starts
from multipos.bias_stability.analysis import _check_alike, _is_steady, _movements
from multipos.bias_stability.noise_laws import _best, _is_rejected, _not_negative
from multipos.bias_stability.record_values import Values
from multipos.bias_stability.stability_result import _is_whole
from multipos.bias_stability.stability_text import _shown, stability_sentence
from multipos.bias_stability.static_records import _require_one_g


def test_phases_covary_by_the_laws_of_their_noise():
    # eq. (3) of bias_stability.allan
    lag = 2.7
    by_hand = [-lag / 2.0, lag**2 * math.log(lag) / (2.0 * math.pi), lag**3 / 12.0]
    assert_allclose(phase_covariance(np.array([-lag, 0.0]))[:, 0], by_hand)
    assert_allclose(phase_covariance(np.array([-lag, 0.0]))[:, 1], 0.0)


@pytest.mark.parametrize("lag", [-6, -2, 0, 3, 5, 8])
def test_pairs_of_so_many_starts_apart_are_counted(lag):
    count = sum(i - j == lag for i in range(5) for j in range(7))
    assert _pairs(np.array([float(lag)]), 5, 7) == count


def test_products_of_flicker_and_walk_are_sums_over_all_pairs():
    """Second differences of phases a lag apart covary by R; their squares by twice its square."""
    records, lengths = ((60, 2), (37, 1)), (1, 2, 4)
    lags = np.roll(np.arange(-60, 61), -60)  # a lag is its own place
    total = [sum(k * starts(n, m) for n, k in records) for m in lengths]

    def apart(law, m, k, lag):
        weights = (1.0, -2.0, 1.0)
        places = [(a * m - b * k, weights[a] * weights[b]) for a in range(3) for b in range(3)]
        return sum(w * phase_covariance(np.array(lag + place))[law] for place, w in places)

    found = _products(lengths, records)
    for law, other in ((0, 0), (1, 1), (2, 2), (0, 2), (1, 2)):
        for i, m in enumerate(lengths):
            for j, k in enumerate(lengths[i:], i):
                product = apart(law, m, k, lags) * apart(other, m, k, lags)
                square = sum(
                    times
                    * product[np.subtract.outer(range(starts(n, m)), range(starts(n, k)))].sum()
                    for n, times in records
                )
                by_hand = 2.0 * square / (2.0 * m**2 * total[i] * 2.0 * k**2 * total[j])
                assert found[law, other, i, j] == pytest.approx(by_hand, rel=0.05)
                assert found[law, other, j, i] == found[law, other, i, j]


def test_least_squares_without_negative_parts():
    rng = np.random.default_rng(4)
    for _ in range(20):
        A, y = rng.normal(size=(6, 3)), rng.normal(size=6)
        assert_allclose(_not_negative(A, y), nnls(A, y)[0], atol=1e-10)


@pytest.mark.parametrize(
    ("gain", "count", "laws"), [(3.9, 9, 3), (4.1, 9, 4), (4.1, 6, 3), (4.1, 7, 4)]
)
def test_quantisation_must_explain_so_much_more(gain, count, laws, monkeypatch):
    fits = {3: SimpleNamespace(chi2=20.0, laws=3), 4: SimpleNamespace(chi2=20.0 - gain, laws=4)}
    monkeypatch.setattr(noise_laws, "_fit", lambda *arguments: fits[arguments[-1]])
    assert _best(range(count), np.zeros(count), (), 2).laws == laws


@pytest.mark.parametrize(("by", "rejected"), [(0.999, False), (1.001, True)])
def test_a_curve_is_rejected_at_one_in_a_thousand(by, rejected):
    assert _is_rejected(SimpleNamespace(dof=5, chi2=by * chi2.isf(1e-3, 5))) is rejected
    assert not _is_rejected(SimpleNamespace(dof=0, chi2=1e9))
    poor, rich = SimpleNamespace(likelihood=50.0), SimpleNamespace()
    rich.likelihood = 50.0 - by * chi2.isf(1e-4, 3)
    assert trends._better(rich, poor, 3) == rejected


def test_a_warm_up_is_looked_for_inside_the_records(monkeypatch):
    """From two blocks, 14 samples, to a third of the longest, 100; forty times between."""
    seen = []

    def square(record, names, constant):
        if record is records[0]:
            seen.append(constant)
        return abs(math.log(constant / 40.0))

    def described(records, lengths, names, constant):
        value = SimpleNamespace(value=settled[0] * constant)
        return SimpleNamespace(time_constant=value, names=names)

    monkeypatch.setattr(trends, "_left_white", square)
    monkeypatch.setattr(trends, "_describe", described)
    records = [SimpleNamespace(length=5, samples=300), SimpleNamespace(length=7, samples=200)]
    settled = [1.0]
    found = trends._warming(records, (), ("t",))
    assert (len(seen), seen[0], seen[-1]) == (40, pytest.approx(14.0), pytest.approx(100.0))
    assert found.time_constant.value == min(seen, key=lambda one: abs(math.log(one / 40.0)))
    assert found.names == ("t", trends.DRIFT, trends.WARM_UP)
    for settled[0] in (0.3, 2.7):
        assert trends._warming(records, (), ()) is None
    assert trends._warming([SimpleNamespace(length=17, samples=102)], (), ()) is None


def test_a_time_constant_is_first_tried_in_white_noise():
    """The same squares by the whitened fit, whose covariance is then 1/L of the identity."""
    values = np.exp(-np.arange(60) / 9.0) + 0.1 * np.random.default_rng(3).standard_normal(60)
    record = trends.Blocks(480, 8, values, np.linspace(0.0, 1.0, 60) ** 2, np.zeros(0))
    names = (trends.TEMPERATURE, trends.DRIFT, trends.WARM_UP)
    white = trends._least_squares([record], names, 70.0, trends._WHITE).square
    assert_allclose(trends._left_white(record, names, 70.0), white, rtol=1e-8)


def test_noise_that_is_left_is_of_lengths_that_the_records_have_often(monkeypatch):
    given = []
    monkeypatch.setattr(trends, "fit_laws", lambda *arguments: given.append(arguments))
    monkeypatch.setattr(trends, "_left_over", lambda record, trend, used: trend * np.array(used))
    records = [SimpleNamespace(samples=240), SimpleNamespace(samples=100)]
    lengths = octaves(240)
    trends._noise(records, lengths, [2.0, 3.0])
    used, curve, samples = given[0]
    assert (used, samples) == ([1, 2, 4, 8, 16], [240, 100])
    m = np.array(used)
    counts = np.array([starts(240, k) + starts(100, k) for k in used])
    assert_allclose(curve, 5.0 * m / (2.0 * m**2 * counts))
    trends._noise([SimpleNamespace(samples=20)], octaves(20), [1.0])
    assert given[1][0] == list(octaves(20)[:4])


def record(**more):
    own = {
        "source": "s", "names": ("a", "b"), "unit": "g", "rate": 100.0, "temperature": None,
        "sums": np.array([[3.0, 5.0, 7.0], [2.0, 4.0, 9.0]]), "samples": 12,
        "length": 4, "blocks": np.arange(6.0).reshape(2, 3),
    }  # fmt: skip
    return SimpleNamespace(**own | more)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"names": ("a", "c")}, "its outputs are a, c"),
        ({"unit": "V"}, "its outputs are in V"),
        ({"rate": 101.01}, "101.01 Hz"),
        ({"rate": 98.99}, "98.99 Hz"),
        ({"temperature": np.ones(3)}, "no temperature"),
        ({"sums": np.array([[3.0, 5.0], [0.0, 0.0]])}, "'b' never changes"),
        ({"rate": 100.99}, None),
        ({"rate": 99.01}, None),
    ],
)
def test_records_that_are_pooled_are_alike(change, said):
    if said is None:
        _check_alike([record(), record(**change)])
        return
    with pytest.raises(mp.MultiposError, match=said):
        _check_alike([record(), record(**change)])


def test_the_deviation_of_records_together_by_hand():
    raw = [record(samples=12), record(samples=6, sums=np.array([[1.0, 0.5], [6.0, 2.5]]))]
    values = Values(raw, (1, 2, 4), "g", 0.95)
    counts = [
        starts(12, 1) + starts(6, 1),
        starts(12, 2) + starts(6, 2),
        starts(12, 4) + starts(6, 4),
    ]
    by_hand = np.sqrt(np.array([8.0, 6.5, 9.0]) / (2.0 * np.array([1, 4, 16]) * counts))
    assert_allclose(values._deviation(1), by_hand)


@pytest.mark.parametrize(("means", "told"), [((0.5, 0.049), False), ((0.5, 0.051), True)])
def test_a_temperature_coefficient_in_ppm_of_what_an_output_reads(means, told):
    raw = [record()]
    values = Values(raw, (1, 2, 4), "g", 0.9)
    values._means = np.array(means)
    one = SimpleNamespace(value=3e-5, u=4e-6, dof=7.0)
    found = values._temperature(SimpleNamespace(coefficients={trends.TEMPERATURE: one}), 1)
    k = t.ppf(0.95, 7.0)
    assert pytest.approx(k * 4e-6) == found.change.U
    assert found.micro_g.value == pytest.approx(30.0)
    if told:
        assert found.ppm.value == pytest.approx(1e6 * 3e-5 / 0.051)
        assert pytest.approx(1e6 * k * 4e-6 / 0.051) == found.ppm.U
    else:
        assert found.ppm is None
    assert values._temperature(SimpleNamespace(coefficients={}), 1) is None


def test_a_movement_is_told_by_its_time(monkeypatch):
    """The middle of block 7 of 40 samples at 16 Hz: 18.75 s."""
    found = {0.0: None, 3.0: SimpleNamespace(block=7, jump=0.0123, count=3)}
    monkeypatch.setattr(analysis, "find_movement", lambda means: found[means[0]])
    (said,) = _movements(record(length=40, rate=16.0))
    assert said.outputs == ("b",)
    assert said.text.startswith("s: b jumps by 0.012 near 19 s, the largest of 3 movements")


@pytest.mark.parametrize("size", [1e3 * 2, 9.8 * 2, 9.8 / 2, 0.102 / 2, 0.102 * 2])
def test_a_force_of_one_g_in_another_unit_is_refused_within_a_factor_of_two(size):
    field = SimpleNamespace(same_everywhere=True)
    c = SimpleNamespace(field=field, model=SimpleNamespace(unit="g"))

    def force(by):
        return np.array([[0.6], [-0.8], [0.0]]) * [size * by, 0.1 * size, 7.0 * size]

    inside, outside = (0.99, 1.01) if size in (2e3, 19.6, 0.204) else (1.01, 0.99)
    with pytest.raises(mp.MultiposError, match="where 1 g is meant"):
        _require_one_g("s", c, force(inside))
    _require_one_g("s", c, force(outside))
    _require_one_g(
        "s", SimpleNamespace(field=SimpleNamespace(same_everywhere=False)), force(inside)
    )
    _require_one_g("s", c, force(inside)[:2])


def test_a_coefficient_of_nothing_is_shown_by_its_bound():
    assert _shown(SimpleNamespace(value=0.0, u=2.0, U=3.4), 1.5) == "< 5.1"
    assert _shown(SimpleNamespace(value=4.0, u=0.2, U=0.4), 1.5) == "6.00(30)"


def test_a_record_without_a_change_of_temperature_is_steady():
    assert _is_steady(record(temperature=np.full(3, 21.0)))
    assert not _is_steady(record(temperature=np.array([21.0, 21.5])))
    assert not _is_steady(record())


def test_a_file_is_whole_where_everything_is_about_the_same_outputs():
    spread = {"a": 1, "b": 2}
    columns = {"a": [1.0, 2.0], "b": [3.0, 4.0]}
    one = {"temperature": None, "time": [0.0, 1.0], "zero": columns, "settled": columns}

    def whole(taus=((1.0, 2.0), (1.0, 2.0)), records=(one,), turn_on=None):
        outputs = {name: SimpleNamespace(tau=tau) for name, tau in zip("ab", taus, strict=False)}
        found = SimpleNamespace(outputs=outputs, run_to_run=spread, turn_on=turn_on)
        found.records = [SimpleNamespace(**each) for each in records]
        found.tau = taus[0] if taus else None
        return _is_whole(found)

    assert whole()
    assert not whole(((1.0, 2.0), (1.0, 3.0)))
    assert not whole((), ())
    assert not whole(turn_on={"a": 1})
    for change in (
        {"temperature": [20.0]},
        {"zero": {**columns, "b": [3.0]}},
        {"settled": {"a": 1}},
        {"zero": {"a": [1.0, 2.0]}},
    ):
        assert not whole(records=[one, {**one, **change}])
    assert whole(records=[one, {**one, "temperature": [20.0, 21.0]}])


def test_a_time_constant_moves_and_is_known_as_in_one_fit_of_all():
    """Its step and u by the normal equations of Gauss and Newton, ln T_w among their unknowns."""
    rng = np.random.default_rng(6)
    blocks = trends.Blocks(640, 16, np.zeros(40), None, np.zeros(1))
    values = 3.0 * np.exp(-blocks.time / 130.0) + 0.3 * rng.standard_normal(40)
    squares = np.array([2.0, 0.3, 0.01])
    names = (trends.DRIFT, trends.WARM_UP)
    found = trends._least_squares(
        [replace(blocks, values=values)], names, 150.0, SimpleNamespace(squares=squares)
    )
    late = np.exp(-blocks.time / 150.0)
    X = np.column_stack([np.ones(40), blocks.time - blocks.time.mean(), late])
    W = np.linalg.inv(trends._covariance(40, 16, squares))
    b = np.linalg.solve(X.T @ W @ X, X.T @ W @ values)
    J = np.column_stack([X, b[-1] * blocks.time / 150.0 * late])
    V = np.linalg.inv(J.T @ W @ J)
    assert found.time_constant.u == pytest.approx(150.0 * math.sqrt(V[-1, -1]), rel=1e-6)
    assert found.step == pytest.approx((V @ J.T @ W @ (values - X @ b))[-1], rel=1e-6)


@pytest.mark.parametrize("ratio", [2.0, 64.0])
def test_lags_of_two_lengths_are_where_windows_meet_with_the_weights_of_trapezoids(ratio):
    lags, weights, _ = allan._kernels(ratio, 4)
    for values in (np.ones(len(lags)), lags, np.cos(lags)):
        expected = np.sum(np.diff(lags) * (values[1:] + values[:-1])) / 2.0
        assert weights @ values == pytest.approx(expected, rel=1e-12, abs=1e-12)
    # where an edge of one window meets an edge of the other, and close by on both sides
    for edge in (-1.0, ratio - 1.0, 2.0 * ratio - 1.0):
        close = edge + np.arange(-15.0, 16.0) / 4.0
        inside = close[np.abs(close - (ratio - 1.0)) <= 2.0 * ratio + 1.0]
        assert len(inside) >= 16
        assert set(inside.tolist()) <= set(lags.tolist())


def overlap(lag, ratio):
    """∫ of what is −1 and then +1 over 1 each, by the same over `ratio`, that much apart."""
    total = 0.0
    for i, a in enumerate((lag, lag + 1.0)):
        for j, b in enumerate((0.0, ratio)):
            common = min(a + 1.0, b + ratio) - max(a, b)
            total += (1.0 if i == j else -1.0) * max(common, 0.0)
    return total


@pytest.mark.parametrize(
    ("ratio", "strides", "within"), [(2.0, 16, 2e-3), (3.5, 8, 1e-2), (24.0, 16, 5e-3)]
)
def test_second_differences_of_two_lengths_covary_by_windows(ratio, strides, within):
    """White noise by overlaps, at every lag and as the mean of its squares; the others by R."""
    lags, weights, s = allan._kernels(ratio, strides)
    assert_allclose(s[0], [overlap(lag, ratio) for lag in lags.tolist()], atol=1e-12)
    fine = np.arange(-2.0, 2.0 * ratio, 1.0 / 256) + 1.0 / 512
    square = np.mean([overlap(lag, ratio) ** 2 for lag in fine.tolist()]) * (2.0 * ratio + 2.0)
    assert weights @ s[0] ** 2 == pytest.approx(square, rel=within)
    apart = lags + np.arange(3.0)[:, None, None] - ratio * np.arange(3.0)[:, None]
    second = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    for law, R in ((1, apart**2 * np.log(np.abs(apart) + (apart == 0.0)) / (2.0 * np.pi)),
                   (2, np.abs(apart) ** 3 / 12.0)):  # fmt: skip
        assert_allclose(s[law], np.einsum("ij,ijk->k", second, R), atol=1e-9)
    steps = np.einsum("ij,ijk->k", second, np.abs(apart) < 0.5 / strides)
    assert_allclose(s[3], steps)
    reach = abs(lags - (ratio - 1.0)).max()
    if ratio > 4.0:
        assert 2.0 * ratio < reach <= 2.0 * ratio + 1.0
    else:
        assert reach == pytest.approx(2.0 * ratio + 1.0)
        assert len(lags) == 2 * round((2.0 * ratio + 1.0) * strides) + 1


@pytest.mark.parametrize(
    ("chi2", "first", "factor"),
    [((16.2, 0.0, 0.0, 0.0), 0, 1.0), ((16.4, 12.5, 8.5, 4.5), 0, 16.4 / 3.0),
     ((40.0, 35.9, 32.0, 28.0), 1, 35.9 / 2.0), ((40.0, 37.0, 31.9, 28.0), 2, 31.9),
     ((40.0, 37.0, 8.0, 28.0), 2, 1.0), ((40.0, 37.0, 34.0, 0.0), 3, 1.0)],
)  # fmt: skip
def test_the_shortest_times_are_left_out_where_each_takes_four_of_chi_square(
    chi2, first, factor, monkeypatch
):
    """Beyond chance, 16.3 on three degrees and 10.8 on one; what is left then widens u."""

    def best(lengths, variances, records, first):
        return noise_laws.Laws(np.ones(3), np.eye(3), first, chi2[first], 3 - first)

    monkeypatch.setattr(noise_laws, "_best", best)
    found = noise_laws.fit_laws([1, 2, 4, 8, 16, 32, 64], np.ones(7), [100])
    assert found.first == first
    assert_allclose(found.covariance, factor * np.eye(3))
    seen = noise_laws.fit_laws([1, 2, 4, 8, 16, 32, 64], np.array([1.0, 1.0, 0, 0, 0, 0, 0]), [100])
    assert seen.first == min(first, 1 if chi2[1] + 4.0 < chi2[0] else 0)


@pytest.mark.parametrize(("chi2", "laws"), [(5.9, 4), (6.1, 3)])
def test_quantisation_explains_four_of_chi_square_or_is_none(chi2, laws, monkeypatch):
    def fit(lengths, variances, records, first, count):
        return noise_laws.Laws(
            np.ones(count), np.eye(count), first, 10.0 if count == 3 else chi2, 2
        )

    monkeypatch.setattr(noise_laws, "_fit", fit)
    assert len(noise_laws._best(range(7), np.ones(7), [100], 2).squares) == laws
    assert len(noise_laws._best(range(7), np.ones(7), [100], 3).squares) == 3  # of four lengths


def test_block_means_covary_by_hand():
    """A constant is added to flicker and walk, which the mean takes up: 2 · 3 L / 2 of walk."""
    index = np.abs(np.subtract.outer(range(4), range(4)))
    next_to = np.where(index == 0, 2.0, np.where(index == 1, -1.0, 0.0))
    by_hand = {  # of the squares 2 at L = 5: N²/L, L (−k/2) and −L/6 at k = 0, Q²/L²
        (2.0, 0.0, 0.0): 2.0 / 5.0 * np.eye(4),
        (0.0, 0.0, 2.0): 2.0 * 5.0 * (3.0 - index / 2.0 - np.eye(4) / 6.0),
        (0.0, 0.0, 0.0, 2.0): 2.0 / 25.0 * next_to,
    }
    for squares, expected in by_hand.items():
        found = trends._covariance(4, 5, np.array(squares))
        assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_a_warm_up_pays_for_a_constant_and_a_size_of_each_record(monkeypatch):
    """Of two records: two drifts beside, and with the time constant five parameters more."""
    asked = []
    monkeypatch.setattr(trends, "_better", lambda *given: bool(asked.append(given[-1])))
    monkeypatch.setattr(trends, "_warming", lambda *_: object())
    monkeypatch.setattr(
        trends,
        "_describe",
        lambda *_: SimpleNamespace(
            laws=SimpleNamespace(squares=None), coefficients={}, likelihood=0.0
        ),
    )
    coefficients = SimpleNamespace(coefficients={trends.DRIFT: None})
    monkeypatch.setattr(trends, "_least_squares", lambda *_: coefficients)
    trends.describe([SimpleNamespace(temperature=None)] * 2, ())
    assert asked == [2, 5]


def test_a_trend_of_several_records_is_their_weighted_mean():
    """Weights 10, 5 and 2.5; beyond chance u is by the scatter, on two degrees of freedom."""
    found = trends._pooled([1.0, 3.0, 4.0], [0.1, 0.2, 0.4])
    mean = (10.0 + 15.0 + 10.0) / 17.5
    scatter = (10.0 * (1 - mean) ** 2 + 5.0 * (3 - mean) ** 2 + 2.5 * (4 - mean) ** 2) / 2
    assert (found.value, found.dof) == (pytest.approx(mean), 2.0)
    assert found.u == pytest.approx(math.sqrt(scatter / 17.5))
    alike = trends._pooled([2.0, 2.1, 1.9], [0.1, 0.2, 0.4])
    assert (alike.u, alike.dof) == (pytest.approx(1.0 / math.sqrt(17.5)), math.inf)


def test_coefficients_that_go_together_have_a_huge_covariance():
    """Of two equal columns of size 7 the second is taken to have 1e-13 of it left."""
    X = np.random.default_rng(2).normal(size=(9, 3))
    assert_allclose(trends._covariance_of(X), np.linalg.inv(X.T @ X), rtol=1e-9)
    column = 7.0 * X[:, 0] / np.linalg.norm(X[:, 0])
    found = trends._covariance_of(np.column_stack([column, column]))
    left = 7e-13
    assert_allclose(np.diag(found), [1.0 / 49.0 + 1.0 / left**2, 1.0 / left**2], rtol=1e-6)


def test_what_is_not_known_of_an_output_is_not_the_largest():
    def output(white, walk):
        sizes = {"white_noise": white, "bias_instability": walk}
        return SimpleNamespace(**{n: SimpleNamespace(value=v, U=9.0) for n, v in sizes.items()})

    found = SimpleNamespace(
        unit="g", records=[1, 2],
        outputs={"a": output(math.nan, None), "b": output(2e-4, 0.0), "c": output(1e-4, math.nan)},
    )  # fmt: skip
    said = stability_sentence(found)
    assert said.startswith("a, b, c over 2 records: white noise up to 200 µg/√Hz (b), bias inst")
    assert said.endswith("instability below 9e+06 µg (b).")

"""White noise, flicker and random walk are recovered, and U covers them."""

from types import SimpleNamespace

import numpy as np
import pytest
from noise_bench import flicker, walk, white
from numpy.testing import assert_allclose
from scipy.optimize import nnls

from multipos.bias_stability.allan import Phases, law_variances, octaves, starts
from multipos.bias_stability.noise_laws import Laws, _not_negative, degrees_of_freedom, fit_laws
from multipos.bias_stability.trends import _left_over, _pooled

N = 8192


def laws_of(samples, share=8):
    lengths = [m for m in octaves(len(samples)) if m <= len(samples) / share]
    with Phases() as phases:
        phases.feed(samples)
        sums = phases.sums(lengths)
    variances = sums / [2.0 * m**2 * starts(len(samples), m) for m in lengths]
    return fit_laws(lengths, variances, [len(samples)])


def test_exact_curves_give_their_laws():
    # eq. (2) of bias_stability.allan
    lengths = octaves(100_000)
    truth = np.array([4.0, 0.01, 1e-6])
    curve = law_variances(np.array(lengths, dtype=float))[:, :3] @ truth
    found = fit_laws(lengths, curve, [100_000])
    assert_allclose(found.squares, truth, rtol=1e-6)
    assert (found.first, found.dof) == (0, len(lengths) - 3)
    assert found.chi2 == pytest.approx(0.0, abs=1e-12)
    assert_allclose(found.deviation(np.array(lengths, dtype=float)) ** 2, curve, rtol=1e-6)


def test_quantisation_is_told_from_white_noise():
    lengths = octaves(100_000)
    truth = np.array([1.0, 0.0, 0.0, 1.0])
    curve = law_variances(np.array(lengths, dtype=float)) @ truth
    assert_allclose(fit_laws(lengths, curve, [100_000]).squares, truth, atol=1e-6)


def test_a_filter_at_short_times_is_left_out():
    rng = np.random.default_rng(3)
    kernel = np.hanning(18)[1:-1]
    samples = np.convolve(white(rng, 200_000), kernel / kernel.sum(), mode="valid")
    found = laws_of(samples)
    assert found.first >= 3  # the filter is sixteen samples long
    # What is left of the filter at the first time that is used is as large as the noise there.
    assert found.root(0, 1.0)[0] == pytest.approx(1.0, rel=0.05)


def test_without_the_shortest_time_the_rest_is_as_if_it_had_never_been():
    lengths = octaves(3000)
    curve = law_variances(np.array(lengths, dtype=float))[:, :3] @ [4.0, 0.01, 1e-4]
    curve[0] *= 0.3
    found, alone = fit_laws(lengths, curve, [3000]), fit_laws(lengths[1:], curve[1:], [3000])
    assert (found.first, alone.first) == (1, 0)
    assert_allclose(found.covariance, alone.covariance, rtol=1e-12)


def test_u_of_a_coefficient_by_hand():
    # eq. (1) of bias_stability.noise_laws
    laws = Laws(np.array([4.0, 0.0, 1.0]), np.diag([0.04, 0.09, 4.0]), 0, 0.0, 1)
    # 4 ± .2: above 2.0494, below 1.9494, the wider side; 0 + .3; 1 ± 2: 1.7321 above, 0 below.
    assert_allclose(laws.root(0, 1.0), (2.0, 2.0 - np.sqrt(3.8)))
    assert_allclose(laws.root(1, 1.0), (0.0, np.sqrt(0.3)))
    assert_allclose(laws.root(2, 1.0), (1.0, 1.0))


@pytest.mark.parametrize(
    ("N_", "B", "K"),
    [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.01), (1.0, 0.1, 0.0)],
    ids=["white", "flicker", "walk", "white and walk", "white and flicker"],
)
def test_u_covers_the_coefficients(N_, B, K):
    rng = np.random.default_rng(7)
    runs = 40
    inside = np.zeros(3)
    for _ in range(runs):
        samples = white(rng, N, N_) + flicker(rng, N, B) + walk(rng, N, K)
        found = laws_of(samples)
        for law, truth in enumerate((N_, B, K)):
            value, U = found.root(law, 1.96)
            inside[law] += abs(value - truth) <= U
    # Of 40 at 95 % fewer than 33 are inside once in 1000 runs; what is zero is covered more often.
    assert (inside >= 33).all()


def test_a_curve_that_no_law_is_like_has_wide_ones():
    rng = np.random.default_rng(9)
    wave = 30.0 * np.sin(np.arange(N) / 800.0)
    found = laws_of(wave + white(rng, N))
    assert found.chi2 / found.dof > 10.0
    assert np.isfinite(found.squares).all()
    value, U = found.root(2, 1.96)
    assert U / value > 0.5


def test_flicker_noise_gives_its_instability():
    rng = np.random.default_rng(8)
    found = np.array([laws_of(flicker(rng, N)).root(1, 1.0) for _ in range(40)])
    # Forty means of 3 % each are good to half a percent; what sampling adds may cost one more.
    assert abs(found[:, 0].mean() - 1.0) < 0.02
    # A standard deviation of 40 is known to 11 %.
    assert_allclose(found[:, 0].std(), found[:, 1].mean(), rtol=0.4)


def test_degrees_of_freedom_follow_the_noise_that_is_there():
    lengths = octaves(10_000)
    white_only = Laws(np.array([1.0, 0.0, 0.0]), np.eye(3), 0, 0.0, 1)
    with_walk = Laws(np.array([1.0, 0.0, 1.0]), np.eye(3), 0, 0.0, 1)
    few, many = (degrees_of_freedom(x, lengths, [10_000]) for x in (with_walk, white_only))
    assert (few < many)[3:].all()
    assert few[-1] > 1.0


def test_what_a_trend_leaves_of_squared_differences():
    """By sums over blocks of ten samples, with the trend taken off; of a slope c: c² m⁴ each."""
    rng = np.random.default_rng(6)
    v, trend = rng.normal(size=30), 0.05 * np.arange(30.0)
    record = SimpleNamespace(
        length=10, values=v + trend, samples=300, sums=np.array([1e9, 1e-9, 0.0, 0.0])
    )
    found = _left_over(record, trend, [5, 4, 30, 80])
    squares = {5: 291.0, 4: 293.0, 30: 241.0, 80: 141.0}  # n − 2m + 1
    assert found[0] == pytest.approx(1e9 - squares[5] * (0.05 / 10) ** 2 * 5**4, rel=1e-12)
    assert 0.0 < found[1] < 1e-9
    w = v - (v + trend).mean()
    for place, m in ((2, 30), (3, 80)):
        k = m // 10
        ends = range(len(w) - 2 * k + 1)
        z = [10.0 * (w[i + k : i + 2 * k].sum() - w[i : i + k].sum()) for i in ends]
        assert found[place] == pytest.approx(squares[m] * np.mean(np.square(z)), rel=1e-9)


@pytest.mark.parametrize(
    ("values", "variances", "mean", "u", "dof"),
    [
        ([5.0], [4.0], 5.0, 2.0, np.inf),
        ([1.0, 3.0], [1.0, 1.0], 2.0, 1.0, 1.0),  # scatter of 2 over 1: u is √(2/2)
        ([0.0, 1.0], [1.0, 4.0], 0.2, np.sqrt(0.8), np.inf),
    ],
)
def test_trends_of_records_together_by_hand(values, variances, mean, u, dof):
    found = _pooled(values, variances)
    assert (found.value, found.u) == (pytest.approx(mean), pytest.approx(u))
    assert found.dof == dof


def test_least_squares_without_negative_parts():
    rng = np.random.default_rng(4)
    for _ in range(20):
        A, y = rng.normal(size=(6, 3)), rng.normal(size=6)
        assert_allclose(_not_negative(A, y), nnls(A, y)[0], atol=1e-10)

"""The Allan deviation against another program, and its covariance against sums by hand."""

import numpy as np
import pytest
from noise_bench import flicker, walk, white
from numpy.testing import assert_allclose

from multipos.bias_stability import allan
from multipos.bias_stability.allan import (
    FLICKER,
    Phases,
    flicker_excess,
    law_variances,
    octaves,
    pooled_variances,
    starts,
    variance_covariance,
)


def curve(samples, *, pieces=1):
    lengths = octaves(len(samples))
    with Phases() as phases:
        for piece in np.array_split(samples, pieces):
            phases.feed(piece)
        sums = phases.sums(lengths)
    return lengths, sums / [2.0 * m**2 * starts(len(samples), m) for m in lengths]


@pytest.mark.parametrize("pieces", [1, 7])
@pytest.mark.parametrize("piece", [1 << 16, 1000])
def test_the_overlapping_deviation_is_that_of_allantools(pieces, piece, monkeypatch):
    allantools = pytest.importorskip("allantools")
    monkeypatch.setattr(allan, "_PIECE", piece)
    rng = np.random.default_rng(1)
    samples = 1.0 + 1e-3 * (white(rng, 20_001) + walk(rng, 20_001, 0.01))
    lengths, variances = curve(samples, pieces=pieces)
    taus, theirs, _, counts = allantools.oadev(samples, rate=1.0, data_type="freq", taus=lengths)
    assert_allclose(taus, lengths)
    assert_allclose([starts(len(samples), m) for m in lengths], counts)
    assert_allclose(np.sqrt(variances), theirs, rtol=1e-9)  # rounding of their longer sums


def test_small_sums_by_hand():
    # y = 1, 2, 4, 8, 16, 32: phases 0 1 3 7 15 31 63; over one sample z = 1 2 4 8 16, over two
    # z = x4 − 2 x2 + x0 = 9, x5 − 2 x3 + x1 = 18, x6 − 2 x4 + x2 = 36.
    lengths, variances = curve(np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]))
    assert lengths == [1, 2]
    assert_allclose(variances, [341.0 / (2 * 5), (81 + 324 + 1296) / (2 * 4 * 3)], rtol=1e-15)


def test_samples_far_from_zero_keep_their_digits():
    """Alternating by 2⁻¹⁰ about 10⁹, which a sum of 20,000 would leave no digit of: z = ±2⁻¹⁰."""
    _, variances = curve(1e9 + 2.0**-10 * (np.arange(20_000) % 2))
    assert variances[0] == pytest.approx(2.0**-20 / 2.0, rel=1e-9, abs=0.0)


def test_published_deviations_of_the_nbs_and_the_thousand_point_set():
    """W. J. Riley, *The Calculation of Time Domain Frequency Stability*: its two sets of data."""
    # eq. (1) of bias_stability.allan
    nbs = np.array([892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0])
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    for samples, lengths, published in (
        (nbs, [1, 2], ["91.22945", "85.95287"]),
        (
            np.array(numbers) / 2147483647,
            [1, 10, 100],
            ["2.922319e-01", "9.159953e-02", "3.241343e-02"],
        ),
    ):
        with Phases() as phases:
            phases.feed(samples)
            sums = phases.sums(lengths)
        scale = [2.0 * m**2 * starts(len(samples), m) for m in lengths]
        for found, digits in zip(np.sqrt(sums / scale), published, strict=True):
            written = f"{found:.6e}" if "e" in digits else f"{found:.5f}"
            assert written == digits


def matrix_covariance(lengths, n, noise):
    """Eq. (4) as sums over all pairs, from the covariance (n, n) of the samples themselves."""
    rows = []
    for m in lengths:
        D = np.zeros((n - 2 * m + 1, n))
        for i in range(len(D)):
            D[i, i : i + m], D[i, i + m : i + 2 * m] = -1.0, 1.0
        rows.append(D)
    found = np.empty((len(lengths), len(lengths)))
    for i, (D, m) in enumerate(zip(rows, lengths, strict=True)):
        for j, (E, k) in enumerate(zip(rows, lengths, strict=True)):
            s = D @ noise @ E.T
            found[i, j] = 2.0 * np.sum(s**2) / (2.0 * m**2 * len(D)) / (2.0 * k**2 * len(E))
    return found


def test_the_covariance_of_white_noise_is_the_sum_over_all_pairs():
    # eq. (4) of bias_stability.allan
    n = 300
    lengths = octaves(n)
    expected = matrix_covariance(lengths, n, np.eye(n))
    found = variance_covariance(np.array([1.0, 0.0, 0.0]), lengths, [n])
    size = np.sqrt(np.diag(expected))
    # Sixteen lags an averaging time, and a coarse grid where one window is far longer: 3 %.
    assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=0.03)
    assert_allclose(np.diag(found)[:4], np.diag(expected)[:4], rtol=1e-12)  # there all lags


def test_the_covariance_of_a_walk_and_of_quantisation_is_the_sum_over_all_pairs():
    n = 300
    lengths = octaves(n)
    i = np.arange(1.0, n + 1.0)
    # A walk that is averaged over each sample; quantisation of the phases.
    between = np.minimum.outer(i, i) - 0.5 - np.diag(np.full(n, 1.0 / 6.0))
    phases = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    # Quantisation is as wide as a sample and falls between lags, which serves shares, not digits.
    # eq. (3) of bias_stability.allan
    for law, noise, tolerance in ((2, between, 0.03), (3, phases, 0.15)):
        expected = matrix_covariance(lengths, n, noise)
        found = variance_covariance(np.eye(4)[law], lengths, [n])
        size = np.sqrt(np.diag(expected))
        outer = np.outer(size, size)
        assert_allclose(found / outer, expected / outer, atol=tolerance)
        assert_allclose(np.diag(found), size**2, rtol=0.03)


@pytest.mark.parametrize(("law", "alpha"), [(0, 0), (1, -1), (2, -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(law, alpha):
    ci = pytest.importorskip("allantools.ci")
    n = 20_000
    lengths = octaves(n)[6:]  # below them the program takes samples as averages, which ours are not
    theta = np.eye(4)[law]
    variance = law_variances(np.array(lengths, dtype=float)) @ theta
    found = 2.0 * variance**2 / np.diag(variance_covariance(theta, lengths, [n]))
    theirs = [ci.edf_greenhall(alpha, 2, m, n + 1, overlapping=True) for m in lengths]
    assert_allclose(found, theirs, rtol=0.02)  # theirs are fitted tables, good to 1 to 2 %


def test_the_excess_of_sampled_flicker_noise_is_that_of_its_spectrum():
    f = (np.arange(1 << 18) + 0.5) / (1 << 19)
    for m in (1, 2, 4, 8, 16):
        window = 2.0 * np.sin(np.pi * m * f) ** 4 / (m * np.sin(np.pi * f)) ** 2
        whole = float(np.mean(window / (2.0 * np.sin(np.pi * f))))  # B²/2πf, from both sides
        assert whole / FLICKER - 1.0 == pytest.approx(
            float(flicker_excess(np.array([m]))[0]) / FLICKER, rel=0.06
        )


def test_sums_of_records_are_added_over_all_their_pairs():
    found = pooled_variances([np.array([2.0, 4.0, 9.0]), np.array([6.0, 2.5])], (1, 2, 4), [12, 6])
    # of 12 samples 11, 9 and 5 second differences, of 6 5 and 3
    assert_allclose(found, [8.0 / (2 * 16), 6.5 / (8 * 12), 9.0 / (32 * 5)])


def test_records_are_pooled():
    # Two alike have half the variance, and a short one takes no part in long averages.
    theta = np.array([1.0, 0.1, 0.01])
    lengths = octaves(3000)
    one = variance_covariance(theta, lengths, [3000])
    assert_allclose(variance_covariance(theta, lengths, [3000, 3000]), one / 2.0, rtol=1e-12)
    with_short = variance_covariance(theta, lengths, [3000, 300])
    assert_allclose(with_short[-1, -1], one[-1, -1], rtol=1e-12)
    assert with_short[0, 0] < one[0, 0]


@pytest.mark.parametrize(("make", "law"), [(white, 0), (flicker, 1), (walk, 2)])
def test_simulated_noise_has_the_variances_of_its_law(make, law):
    rng = np.random.default_rng(5)
    runs, n = 40, 4096
    found = np.array([curve(make(rng, n))[1] for _ in range(runs)])
    lengths = octaves(n)
    expected = law_variances(np.array(lengths, dtype=float))[:, law]
    u = np.sqrt(np.diag(variance_covariance(np.eye(4)[law], lengths, [n])) / runs)
    first = 3 if law == 1 else 0  # sampled flicker noise has more than its law at short times
    assert (np.abs(found.mean(axis=0) - expected)[first:] <= 4.0 * u[first:]).all()
    spread = found.std(axis=0, ddof=1) / u / np.sqrt(runs)
    # A standard deviation of 40 is known to 11 %, of skewed variances to some 25 %.
    assert (np.abs(spread - 1.0)[3:] < 0.6).all()

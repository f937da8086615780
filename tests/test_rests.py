"""Static detection and the uncertainty of means, against truth made here."""

import re

import numpy as np
import pytest
from logs import ar1, shared

from multipos import MultiposError, UsageError
from multipos.rest_means import RestSum
from multipos.rests import PIECE, Finder, Windows, choose_grid, detect_static


def session(rng, *, noise=1e-3, rests=6, still=1000, moving=200, phi=0.0):
    """Rests at different values, with moves between them; return samples (n, 3) and rests."""
    parts, truth, at = [], [], 0
    for k in range(rests):
        level = np.array([np.cos(k), np.sin(2.0 * k), np.cos(3.0 * k)])
        parts.append(level + noise * ar1(rng, (3, still), phi).T)
        truth.append((at, at + still))
        at += still
        if k < rests - 1:
            parts.append(level + rng.normal(scale=0.3, size=(moving, 3)).cumsum(axis=0) / 5.0)
            at += moving
    return np.concatenate(parts), truth


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 2e-2])
@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_finds_the_rests_without_tuning(noise, phi):
    samples, truth = session(np.random.default_rng(3), noise=noise, phi=phi)
    rests, threshold = detect_static(samples, rate=100.0)
    assert len(rests) == len(truth)
    for rest, (start, end) in zip(rests, truth, strict=True):
        # Inside, and no more than a window short at either end.
        assert start <= rest.start <= start + 96
        assert end - 96 <= rest.end <= end
    assert 2.0 * noise < threshold < 5.0 * noise


def test_a_step_without_a_moving_sample_parts_two_rests():
    rng = np.random.default_rng(0)
    samples = np.repeat([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], 960, axis=0)
    samples = samples + 1e-3 * rng.normal(size=samples.shape)
    rests, _ = detect_static(samples)
    assert len(rests) == 3
    # 960 is a multiple of the block, so the step falls between two blocks.
    assert rests[0].end <= 960 <= rests[1].start
    assert rests[1].end <= 1920 <= rests[2].start


def test_any_axis_counts():
    rng = np.random.default_rng(1)
    samples = 1e-3 * rng.normal(size=(6000, 3))
    samples[2500:3500, 2] += np.sin(np.arange(1000) / 20.0)  # a wobble that z alone sees
    rests, _ = detect_static(samples, rate=100.0)
    assert [rest.end <= 2500 or rest.start >= 3500 for rest in rests] == [True, True]


@pytest.mark.parametrize("value", [1e30, -1e308, np.inf, np.nan])
def test_no_sample_is_beyond_what_sensors_give(value):
    samples, _ = session(np.random.default_rng(5))
    samples[700, 1] = value
    with pytest.raises(
        MultiposError, match=re.escape(f"`samples[700, 1]` is {value:g}, no reading")
    ):
        detect_static(samples)


def test_a_unit_so_large_that_readings_vanish_is_no_matter():
    samples, _ = session(np.random.default_rng(5))
    for size in (1e-80, 1e-320):
        rests, threshold = detect_static(size * samples)
        assert len(rests) == 1  # nothing moves by the 1e-18 that is told from nothing
        assert threshold > 0.0


def test_pieces_do_not_matter():
    samples, _ = session(np.random.default_rng(5))
    whole, threshold = detect_static(samples, rate=100.0)
    grid = choose_grid(100.0, None)
    windows, finder = Windows(grid.block), Finder(grid, threshold)
    for start in range(0, len(samples), 77):
        finder.add(windows.feed(np.ascontiguousarray(samples[start : start + 77].T))[1])
    assert finder.rests(len(samples)) == whole
    assert PIECE > 77


def test_a_threshold_of_the_user_is_used():
    samples, truth = session(np.random.default_rng(2))
    rests, threshold = detect_static(samples, rate=100.0, threshold=0.01)
    assert (len(rests), threshold) == (len(truth), 0.01)


def test_the_shortest_rest_is_the_users():
    samples, _ = session(np.random.default_rng(2), still=1000)
    assert len(detect_static(samples, rate=100.0, min_duration=9.0)[0]) == 6
    assert detect_static(samples, rate=100.0, min_duration=11.0)[0] == []


def test_a_coarse_converter_is_no_problem():
    samples, truth = session(np.random.default_rng(4), noise=1e-3)
    coarse = (
        np.round(samples / 5e-3) * 5e-3
    )  # noise of a fifth of a step: many windows are constant
    assert len(detect_static(coarse, rate=100.0)[0]) == len(truth)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.ones((1000, 3)), "every sample of the log is the same"),
        (np.random.default_rng(0).normal(size=(50, 3)), "fewer than one rest"),
        (np.sin(np.arange(6000) / 50.0)[:, None] * [1.0, 0.5, 0.2], "no rest"),
    ],
)
def test_a_log_without_rest_says_so(samples, message):
    with pytest.raises(MultiposError, match=message):
        detect_static(samples, rate=100.0)


@pytest.mark.parametrize(
    ("rate", "duration", "message"),
    [
        (None, 2.0, "--rate or --time-column"),
        (0.0, None, "--rate must be above 0"),
        (1e308, None, r"--rate must be above 0, from 1e-12 to 1e\+07 Hz"),
        (1e-300, None, "--rate must be above 0, from 1e-12"),
        (100.0, -1.0, "--min-duration must be above 0"),
    ],
)
def test_impossible_sizes(rate, duration, message):
    with pytest.raises(UsageError, match=message):
        choose_grid(rate, duration)


def test_real_log_has_its_rests():
    samples = np.loadtxt(shared("mpu9150_imu0.log"))[:, :3]
    assert len(detect_static(samples)[0]) == 23
    assert len(detect_static(samples, rate=100.0)[0]) == 23


# --- the mean and its uncertainty


def means_of(series):
    found = []
    for row in series:
        taken = RestSum(len(row), 1)
        taken.feed(row[None])
        found.append(taken.result())
    return found


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9, 0.95])
@pytest.mark.parametrize("n", [1000, 3000])
def test_standard_error_is_the_true_scatter(phi, n):
    """The issue's claim: within 10 % of the scatter, which for AR(1) has a closed form."""
    count = 200
    found = means_of(ar1(np.random.default_rng(n), (count, n), phi))
    lags = np.arange(1, n)
    true = np.sqrt((1.0 + 2.0 * np.sum((1.0 - lags / n) * phi**lags)) / n)
    reported = np.sqrt(np.mean([each.u[0] ** 2 for each in found]))
    assert abs(reported / true - 1.0) < 0.10
    # The truth by hand and the scatter of these means must agree: χ² at 200 means, 99.9 %.
    scatter = np.std([each.mean[0] for each in found], ddof=1)
    assert 0.84 < scatter / true < 1.17
    effective = np.median([each.effective[0] for each in found])
    assert abs(effective * true**2 - 1.0) < 0.2


def test_means_are_exact_and_do_not_depend_on_pieces():
    rng = np.random.default_rng(11)
    samples = 1e6 + rng.normal(size=(2, 5003))  # an offset that would eat a naive variance
    whole, parts = RestSum(5003, 2), RestSum(5003, 2)
    whole.feed(samples)
    for start in range(0, 5003, 251):
        parts.feed(samples[:, start : start + 251])
    a, b = whole.result(), parts.result()
    np.testing.assert_allclose(a.mean, samples.mean(axis=1), rtol=1e-15)
    np.testing.assert_allclose(a.sd, samples.std(axis=1, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(b.sd, a.sd, rtol=1e-9)
    np.testing.assert_allclose(b.u, a.u, rtol=1e-6)
    np.testing.assert_array_equal(a.high, samples.max(axis=1))


def test_constant_samples_have_no_spread():
    (found,) = means_of(np.full((1, 300), 0.1))
    assert (found.mean[0], found.sd[0], found.u[0], found.longest[0]) == (0.1, 0.0, 0.0, 300)
    assert (found.at_low[0], found.at_high[0]) == (300, 300)


def test_longest_run_counts_across_pieces():
    taken = RestSum(12, 1)
    for piece in ([1, 2, 2], [2, 2], [2, 3, 3, 1], [1, 1, 5]):
        taken.feed(np.array([piece], dtype=float))
    assert taken.result().longest[0] == 5


def test_drift_is_found_and_noise_is_not():
    rng = np.random.default_rng(8)
    noise = ar1(rng, (200, 1000), 0.8)
    still = means_of(noise)
    z = np.array([each.drift[0] / each.drift_u[0] for each in still])
    # A standardised drift: its variance is near 1, a little above because u is an estimate.
    assert 0.8 < np.mean(z**2) < 1.6
    (moved,) = means_of(noise[:1] + np.linspace(0.0, 3.0, 1000))
    assert abs(moved.drift[0] - still[0].drift[0] - 3.0) < 0.01
    assert moved.drift[0] > 5.0 * moved.drift_u[0]

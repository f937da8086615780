"""Static detection and the uncertainty of means, against truth made here."""

from itertools import groupby, pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import rest_slow
from log_bench import ar1, shared
from scipy.special import ndtr

import multipos as mp
from multipos import MultiposError, UsageError
from multipos.logs import rest_means as of_rests
from multipos.logs.rest_means import (
    _EDGE,
    RestSum,
    _allan_line,
    _allan_variance,
    _criterion,
    _edge,
    _lines,
    autocovariances,
    density_with_dof,
    rest_means,
)
from multipos.logs.rests import (
    Finder,
    Grid,
    Limits,
    Spikes,
    Survey,
    Windows,
    _change,
    _first_peak,
    _onset,
    _smooth,
    choose_grid,
)


def rests_in(samples, **options):
    """Return the rows of the rests in samples (n, 3), and the threshold that found them."""
    found = mp.average(samples, outputs=("ax", "ay", "az"), **options)
    return [rest.rows for rest in found.rests], found.threshold


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
    rests, threshold = rests_in(samples, rate=100.0)
    assert len(rests) == len(truth)
    for rest, (start, end) in zip(rests, truth, strict=True):
        # Hardly into the motion, and no more than a few samples short at either end.
        assert start - 10 <= rest.start <= start + 50
        assert end - 50 <= rest.end <= end + 10
    assert 2.0 * noise < threshold < 5.0 * noise


def test_a_step_without_a_moving_sample_parts_two_rests():
    rng = np.random.default_rng(0)
    samples = np.repeat([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], 960, axis=0)
    samples = samples + 1e-3 * rng.normal(size=samples.shape)
    rests, _ = rests_in(samples)
    assert len(rests) == 3
    assert rests == [(0, 960), (960, 1920), (1920, 2880)]


def test_any_axis_counts():
    rng = np.random.default_rng(1)
    samples = 1e-3 * rng.normal(size=(6000, 3))
    samples[2500:3500, 2] += np.sin(np.arange(1000) / 20.0)  # a wobble that z alone sees
    rests, _ = rests_in(samples, rate=100.0)
    assert [rest.end <= 2505 or rest.start >= 3495 for rest in rests] == [True, True]


@pytest.mark.parametrize("value", [1e30, -1e308, np.inf, np.nan])
def test_no_sample_is_beyond_what_sensors_give(value):
    samples, _ = session(np.random.default_rng(5))
    samples[700, 1] = value
    with pytest.raises(MultiposError, match=r"row 701, column 'ay': .* leave the row out\."):
        rests_in(samples)


def test_a_unit_so_large_that_readings_vanish_is_no_matter():
    samples, _ = session(np.random.default_rng(5))
    for size in (1e-80, 1e-320):  # nothing moves by the 1e-18 that differs from nothing
        with pytest.raises(MultiposError, match=r"one rest only, .* at threshold 3\.27e-18"):
            rests_in(size * samples)


def test_pieces_do_not_matter():
    samples, _ = session(np.random.default_rng(5))
    samples[300, 1] = samples[1250, 2] = 9.0
    spikes, whole = Spikes(3), Spikes(3)
    grid = choose_grid(100.0, None)
    windows, finder = Windows(grid.block), Finder(grid, Limits(4e-3))
    for start in range(0, len(samples), 77):
        piece = spikes.feed(np.ascontiguousarray(samples[start : start + 77].T))
        finder.add(windows.feed(piece)[1])
    finder.add(windows.feed(spikes.finish())[1])
    columns = np.concatenate([whole.feed(samples.T), whole.finish()], axis=1)
    assert sorted(whole.found) == sorted(spikes.found)
    assert {(300, 1, 9.0), (1250, 2, 9.0)} <= set(whole.found)
    together = Finder(grid, Limits(4e-3))
    together.add(Windows(grid.block).feed(columns)[1])
    assert finder.runs() == together.runs()
    assert len(finder.runs()) == 6


def test_a_threshold_of_the_user_is_used():
    samples, truth = session(np.random.default_rng(2))
    rests, threshold = rests_in(samples, rate=100.0, threshold=0.01)
    assert (len(rests), threshold) == (len(truth), 0.01)


def test_standard_deviation_of_a_window_by_hand():
    """Sixteen steps of one scatter by 16 · 255/12 = 340, means of pairs by 2²·8·63/12 = 168."""
    # eqs. (1), (2) of logs.rests
    ramp = np.arange(18.0) + 1e6  # blocks of two: two windows, the second a block later
    means, sd = Windows(2).feed(np.array([0.1 * ramp, ramp]))
    np.testing.assert_allclose(means[1], [1e6 + 7.5, 1e6 + 9.5], rtol=1e-14)
    np.testing.assert_allclose(sd[0], np.sqrt(340 / 15), rtol=1e-9)
    np.testing.assert_allclose(sd[1], np.sqrt(168 / 7), rtol=1e-9)


def test_sizes_of_windows_by_hand():
    grid = choose_grid(160.0, None)  # windows of half a second, and four of them
    assert (grid, grid.window) == (Grid(10, 320, adapts=True), 80)
    assert choose_grid(None, None) == Grid(6, 192, adapts=True)
    assert choose_grid(200.0, 0.2) == Grid(5, 40)  # a window of the shortest rest
    assert choose_grid(160.0, 3.0) == Grid(10, 480)
    assert choose_grid(4.0, None) == Grid(2, 64, adapts=True)


@pytest.mark.parametrize(
    ("hill", "factor"),
    [(None, 10**0.5), (0.53, 10**0.40), (0.47, 10**0.60)],
    ids=["nothing between", "above the middle", "below the middle"],
)
def test_the_threshold_is_between_2_5_and_4_times_the_peak(hill, factor):
    """In hundredths of a decade 40 to 60 above the peak: 2.5 to 4.0 times, in the middle 3.2."""
    peak = 10**-2.995
    survey = Survey(1, Grid(12, 192))
    samples = 1e-5 * np.arange(300.0)[np.newaxis, :]
    survey.add(samples, np.zeros((1, 1000)), np.full((2, 1000), peak))
    if hill is not None:
        survey.add(samples, np.zeros((1, 100)), np.full((2, 100), peak * 10**hill))
    assert survey.limits().size == pytest.approx(peak * factor, rel=1e-9)


@pytest.mark.parametrize(("share", "refused"), [(0.049, False), (0.051, True)])
def test_noise_beyond_a_twentieth_of_the_range_is_no_rest(share, refused):
    peak = 10**-2.995
    survey = Survey(1, Grid(12, 192))
    means = peak / share * np.where(np.arange(1000) % 2, 1.0, -1.0)[np.newaxis, :]
    survey.add(1e-5 * np.arange(300.0)[np.newaxis, :], means, np.full((2, 1000), peak))
    if refused:
        with pytest.raises(MultiposError, match="5 % of what the positions"):
            survey.limits()
    else:
        assert survey.limits().size > peak


def test_a_sensor_is_no_better_than_its_resolution():
    """A step of 0.01 is a noise of at least 0.01/√12 = 10^-2.54; its bin has the middle 10^-2.535.

    The threshold is half a decade above.
    """
    survey = Survey(1, Grid(12, 192))
    survey.add(0.01 * np.array([[0.0, 1.0] * 150]), np.zeros((1, 1000)), np.zeros((2, 1000)))
    assert survey.limits().size == pytest.approx(10**-2.035, rel=1e-9)


def test_the_shortest_rest_is_the_users():
    samples, _ = session(np.random.default_rng(2), still=1000)
    assert len(rests_in(samples, rate=100.0, min_duration=9.0)[0]) == 6
    with pytest.raises(MultiposError, match=r"less than 11 s; --min-duration 9\.99 takes them in"):
        rests_in(samples, rate=100.0, min_duration=11.0)


def test_a_coarse_converter_is_no_problem():
    samples, truth = session(np.random.default_rng(4), noise=1e-3)
    coarse = (
        np.round(samples / 5e-3) * 5e-3
    )  # noise of a fifth of a step: many windows are constant
    assert len(rests_in(coarse, rate=100.0)[0]) == len(truth)


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
        rests_in(samples, rate=100.0)


@pytest.mark.parametrize(
    ("rate", "duration", "message"),
    [
        (None, 2.0, "--rate or --time-column"),
        (0.0, None, "--rate must be above 0"),
        (1e308, None, r"--rate must be above 0, from 1e-12 to 1e\+07 Hz"),
        (1e-300, None, "--rate must be above 0, from 1e-12"),
        (100.0, -1.0, "--min-duration must be above 0"),
        (100.0, 1e308, r"--min-duration must be above 0, up to 1e\+09 s, got 1e\+308"),
    ],
)
def test_impossible_sizes(rate, duration, message):
    with pytest.raises(UsageError, match=message):
        choose_grid(rate, duration)


def test_real_log_has_its_rests():
    samples = np.loadtxt(shared("mpu9150_imu0.log"))[:, :3]
    assert len(rests_in(samples)[0]) == 23
    assert len(rests_in(samples, rate=100.0)[0]) == 23


# --- the mean and its uncertainty


def means_of(series):
    found = []
    for row in series:
        taken = RestSum(len(row), 1)
        taken.feed(row[None])
        found.append(rest_means([taken])[0])
    return found


@pytest.mark.parametrize(
    ("phi", "n"),
    rest_slow([(0.0, 1000), (0.9, 1000), (0.95, 1000), (0.5, 1000), (0.95, 3000)], quick=3),
)
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
    a, b = rest_means([whole])[0], rest_means([parts])[0]
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
    assert rest_means([taken])[0].longest[0] == 5


def test_longest_runs_of_several_outputs():
    """Runs of whole numbers by going through them one by one, in pieces of any length."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        samples = rng.integers(0, 2, size=(3, 40)).astype(float)
        taken = RestSum(40, 3)
        cuts = np.sort(rng.integers(0, 41, 4)).tolist()
        for start, end in pairwise([0, *cuts, 40]):
            taken.feed(samples[:, start:end])
        runs = [max(len([*run]) for _, run in groupby(row)) for row in samples.tolist()]
        assert rest_means([taken])[0].longest.tolist() == runs


def test_rests_beside_each_other_are_as_each_alone():
    """Rests of any length: white, wandering, in whole steps, and with a constant output.

    Zeros stand behind the shorter ones, so that sums round otherwise; 1e-9 is far above a thousand
    roundings and far below any uncertainty. A drift may be nothing beside the noise.
    """
    rng = np.random.default_rng(6)
    sums = []
    for i, n in enumerate([2, 9, 60, 500, 513, 1100, 2500, 130, 1023, 4000, 700, 1500] * 6):
        samples = rng.normal(size=(2, n))
        samples = [samples, np.cumsum(samples, axis=1), np.round(samples)][i % 3]
        samples[1] = samples[1] if i % 5 else 0.25
        sums.append(RestSum(n, 2))
        sums[-1].feed(samples)
    for together, taken in zip(rest_means(sums), sums, strict=True):
        (alone,) = rest_means([taken])
        for name in ("mean", "sd", "u", "drift_u", "edge", "dof", "drift_factor"):
            np.testing.assert_allclose(
                getattr(together, name), getattr(alone, name), rtol=1e-9, atol=0, err_msg=name
            )
        np.testing.assert_allclose(
            together.drift / alone.sd.max(), alone.drift / alone.sd.max(), atol=1e-9
        )


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


# Sixteen values of ±1 without mean or slope: the fourteen inner neighbours and the rest agree 11
# times and differ 4 times, so the lag-1 correlation is r = (11 − 4)/16 = 7/16.
WAVE = np.array([1, 1, -1, -1, -1, -1, 1, 1, 1, 1, -1, -1, -1, -1, 1, 1], dtype=float)


def zero_density(z, removed):
    """Return b u² of eq. (1) of one row."""
    count = np.array([len(z)])
    return density_with_dof(autocovariances(z[None], count), count, np.array([removed]))[0]


def test_spectral_density_of_a_short_series_by_hand():
    """Eq. (1): order 1 has AICc 16 ln(1 − 49/256) + 64/13 = 1.5, order 0 has 32/14 = 2.3.

    So b u² is (1 − r²)/(1 − r)² = (1 + r)/(1 − r) = 23/9 before the last factor, n_eff = 16 · 9/23,
    and 1 − m/n_eff = 1 − 23 m/144.
    """
    # eq. (1) of logs.rest_means
    assert zero_density(WAVE, 0) == pytest.approx(23 / 9, rel=1e-12)
    assert zero_density(WAVE, 1) == pytest.approx(23 / 9 / (121 / 144), rel=1e-12)
    assert zero_density(WAVE, 2) == pytest.approx(23 / 9 / (98 / 144), rel=1e-12)


def test_order_of_the_autoregression_by_hand():
    """Of 16 values order 1 is better where 16 ln(1 − r²) < 32/14 − 64/13: r² > 0.1520."""
    ends = WAVE.copy()
    ends[[0, 1, -2, -1]] *= (
        2.0  # γ_0 = 28/16, γ_1 = 11/16: r² = 0.1543, and (1 + r)/(1 − r) = 39/17
    )
    assert zero_density(ends, 0) == pytest.approx(28 / 16 * 39 / 17, rel=1e-12)
    first = WAVE.copy()
    first[0] = 3.0  # γ_0 = 24/16, γ_1 = 9/16: r² = 0.1406
    assert zero_density(first, 0) == pytest.approx(24 / 16, rel=1e-12)


def test_second_order_by_hand_from_twenty_values_on():
    """Lags 1/20 and −18/20: φ = 2/21, −19/21, σ² = 399/400 · 80/441 = 19/105, over (38/21)²."""
    pairs = np.tile([1.0, 1.0, -1.0, -1.0], 5)
    assert zero_density(pairs, 0) == pytest.approx(21 / 380, rel=1e-12)
    assert zero_density(pairs[:19], 0) == pytest.approx(1.0, rel=1e-12)  # lag 1 is zero


def test_mean_and_drift_of_a_short_rest_by_hand():
    """Without a slope the line leaves what the mean leaves; in units of 1e-3 about 0.5."""
    rest = RestSum(16, 1)
    rest.feed(0.5 + 1e-3 * WAVE[np.newaxis, :])
    found = rest_means([rest])[0]
    assert found.mean == pytest.approx([0.5], rel=1e-12)
    assert found.sd == pytest.approx([1e-3 * np.sqrt(16 / 15)], rel=1e-9)
    # u² = 368/121/16 = 23/121 with m = 1
    assert found.u == pytest.approx([1e-3 * np.sqrt(23) / 11], rel=1e-9)
    assert found.effective == pytest.approx([16 / 15 * 121 / 23], rel=1e-9)
    # 368/98/16 = 23/98 with m = 2, and √12 of its root
    assert found.drift == pytest.approx([0.0], abs=1e-15)
    assert found.drift_u == pytest.approx([1e-3 * np.sqrt(12 * 23 / 98)], rel=1e-9)
    # the first value lies 1 off, of which noise explains √(368/98)
    assert found.edge == pytest.approx([np.sqrt(98 / 368)], rel=1e-9)


def test_edges_are_a_tenth_of_a_rest():
    """The first two of twenty are 4 off their mean, the last two 1; noise is that of the drift."""
    samples = np.array([5, 3, -2, 1, -3, 0, 2, -4, 1, -2, 3, -3, 0, 1, -2, 2, -4, 0, 1, 1.0])
    assert samples.sum() == 0.0
    for series in (samples, samples[::-1]):
        rest = RestSum(20, 1)
        rest.feed(series[np.newaxis, :])
        found = rest_means([rest])[0]
        noise = found.drift_u / np.sqrt(12.0) * np.sqrt(20 / 2)  # of the mean of two
        assert found.edge == pytest.approx(4.0 / noise, rel=1e-9)


def test_rests_are_kept_as_512_to_1023_means():
    for n, length in ((1023, 1), (1024, 2)):
        rest = RestSum(n, 1)
        rest.feed((-1.0) ** np.arange(n)[np.newaxis, :])
        # means of two are all equal and leave no noise of the drift
        assert (rest_means([rest])[0].drift_u[0] == 0.0) == (length == 2)


def test_extremes_are_counted_over_pieces():
    rest = RestSum(7, 1)
    for piece in ([0.0, 1.0, 1.0], [1.0, 0.0], [0.5, 0.5]):
        rest.feed(np.array([piece]))
    found = rest_means([rest])[0]
    assert (found.low, found.at_low, found.high, found.at_high, found.longest) == (0, 2, 1, 3, 3)


def test_drift_is_the_rise_of_the_line_over_the_rest():
    rest = RestSum(20, 1)
    rest.feed(np.arange(20.0)[np.newaxis, :] * 0.25)
    assert rest_means([rest])[0].drift == pytest.approx([20 * 0.25], rel=1e-12)


def test_motion_begins_where_a_parabola_explains_most():
    """The onset by least squares of c (i − k)² at every k, where eq. (3) has grown."""
    # eqs. (3), (4) of logs.rests
    rng = np.random.default_rng(3)
    samples = rng.standard_normal((3, 400))
    samples[0, 250:] += 0.05 * np.arange(150.0) ** 2
    reach = 200
    limits = SimpleNamespace(size=np.zeros(3))
    z = (samples - samples[:, :reach].mean(axis=1, keepdims=True))[:, reach:]
    z /= samples[:, :reach].std(axis=1)[:, None]
    gain = np.sum(z**2 * (1.0 - 1.0 / 6.0) - np.log(6.0), axis=0) / 2.0
    seen = int(np.argmax(np.abs(z).max(axis=0) > 8.0)) + 1
    total = np.concatenate([[0.0], np.cumsum(gain)])[: seen + 1]
    assert total[-1] - total.min() > 12.0
    change = int(np.argmin(total))
    i = np.arange(1.0, seen + 1.0)
    left = []
    for k in range(change + 1):
        ramp = np.maximum(i - k, 0.0) ** 2
        c = z[:, :seen] @ ramp / (ramp @ ramp)
        left.append(np.sum((z[:, :seen] - c[:, None] * ramp) ** 2))
    found = _change(samples, reach, limits)
    assert abs(found - int(np.argmin(left))) <= 3  # a memory by chance allows for a few
    assert abs(found - 50) < 8


def test_what_rounding_leaves_by_the_normal_distribution():
    """The mean rounded value of noise at every place in a step, less the place, squared."""
    # eq. (4) of logs.rest_means
    place, code = np.arange(200) / 200.0, np.arange(-8, 9)
    for v in (0.01, 0.04, 0.1):
        edges = (code[:, None] + [-0.5, 0.5] - place[:, None, None]) / np.sqrt(v)
        off = np.sum(code * np.diff(ndtr(edges), axis=2)[:, :, 0], axis=1) - place
        rounded = np.interp(v, of_rests._NOISE, of_rests._ROUNDED)
        assert rounded == pytest.approx(
            np.mean(off**2), rel=0.01, abs=1e-6
        )  # nodes lie .0025 apart


def test_u_of_a_mean_that_does_not_settle_by_the_line_of_its_allan_variances():
    """Of a walk, by NumPy's polynomial through ln σ² at five lengths: √2 σ at the whole rest."""
    # eq. (3) of logs.rest_means
    samples = np.cumsum(np.random.default_rng(8).standard_normal(640))
    total = RestSum(640, 1)
    total.feed(samples[None])
    (rest,) = rest_means([total])
    phases = np.concatenate([[0.0], np.cumsum(samples - samples.mean())])
    logs, x, weights = [], [], []
    for part, weight in of_rests._PARTS:
        m = 640 // part
        second = phases[2 * m :] - 2.0 * phases[m:-m] + phases[: -2 * m]
        logs.append(np.log(np.mean(second**2) / (2.0 * m**2)))
        x.append(np.log(m / 640))
        weights.append(np.sqrt(weight))
    slope, end = np.polyfit(x, logs, 1, w=weights)
    assert slope > 0.3
    assert rest.u[0] == pytest.approx(np.sqrt(2.0 * np.exp(end)), rel=1e-9)


def test_an_onset_is_where_a_square_begins():
    """Samples that are the ramp itself are explained by none as well."""
    z = np.maximum(np.arange(1.0, 21.0) - 12.0, 0.0)[None] ** 2
    assert _onset(z, 15, 0.0) == 12
    assert _onset(z, 9, 0.0) == 9  # no more than that
    assert _onset(z, 15, 1e9) == 15  # all explain as much as any


def test_the_first_peak_of_a_histogram_is_a_fifth_of_the_highest():
    assert _first_peak(np.array([0.0, 3.0, 1.0, 10.0, 2.0])) == 1
    assert _first_peak(np.array([0.0, 1.9, 1.0, 10.0, 2.0])) == 3
    # of a hundredth of a decade each, by a kernel of .05 that ends at four of it
    spread = _smooth(np.eye(1, 101, 50)[0])
    np.testing.assert_allclose(
        spread[[50, 45, 55, 70, 71]], [1, *[np.exp(-0.5)] * 2, np.exp(-8), 0]
    )


def test_lines_ends_and_orders_of_batches_by_hand():
    """A rise over three batches, of which a fourth is no part; ends of 3 over the root of 4/2."""
    rise, left = _lines(np.array([[[-1.0, 0.0, 1.0, 0.0]]]), np.array([[3]]))
    np.testing.assert_allclose(rise, [[3.0]])
    np.testing.assert_allclose(left, 0.0, atol=1e-15)
    batches = np.zeros(2 * _EDGE)
    batches[:2], batches[-2:] = 3.0, -1.0
    phases = np.concatenate([[0.0], np.cumsum(batches)])[None, None]
    count = np.array([[2 * _EDGE]])
    np.testing.assert_allclose(_edge(phases, count, np.array([[4.0]])), 3.0 / np.sqrt(2.0))
    phases[..., -3:] += np.array([0.0, -4.0, -8.0])  # of the last two −5 each
    np.testing.assert_allclose(_edge(phases, count, np.array([[4.0]])), 5.0 / np.sqrt(2.0))
    assert _edge(phases, count, np.zeros((1, 1))) == 0.0
    # AICc: n ln σ² + 2 (k + 1) n/(n − k − 2)
    found = _criterion(np.array([np.e]), 1, np.array([10]))
    assert found == pytest.approx(10.0 + 40.0 / 7.0, rel=1e-12)


def test_the_line_of_allan_variances_is_that_of_weighted_least_squares():
    rng = np.random.default_rng(5)
    phases = rng.normal(size=(2, 3, 41)).cumsum(axis=2)
    lengths, end = np.array([[1, 2, 4], [1, 3, 6]]), np.array([40, 30])
    weights = np.array([3.0, 2.0, 1.0])
    slope, height, variance = _allan_line(phases, lengths, weights, end)
    for rest in range(2):
        x = np.log(lengths[rest] / end[rest])
        curve = [
            np.log(_allan_variance(phases[rest, :, : end[rest] + 1], m)) for m in lengths[rest]
        ]
        line = np.polyfit(x, curve, 1, w=np.sqrt(weights))
        np.testing.assert_allclose([slope[rest], height[rest]], line, rtol=1e-9)
        design = np.column_stack([x, np.ones(3)])
        covariance = np.linalg.inv(design.T @ (weights[:, None] * design))
        assert variance[rest] == pytest.approx(covariance[1, 1], rel=1e-9)

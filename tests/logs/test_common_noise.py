"""What all rests of a log together say of their noise, on noise made here."""

import math

import numpy as np
import pytest
from findings_bench import texts
from scipy.fft import dct
from scipy.integrate import quad
from scipy.special import stdtrit
from scipy.stats import f

import multipos as mp
from multipos.logs import common_noise
from multipos.logs.common_noise import settle_together
from multipos.logs.rest_means import RestSum, rest_means

N = 400


def settled(rests):
    """Rests (M, n) as each of them tells, and as all do together."""
    sums = []
    for samples in rests:
        sums.append(RestSum(samples.shape[1], len(samples)))
        sums[-1].feed(samples)
    alone = rest_means(sums)
    return alone, settle_together(alone, np.array([each.n for each in alone], dtype=np.float64))


def stacked(rests, name):
    return np.array([getattr(each, name) for each in rests])


def white(rng, count, n=N):
    return [rng.standard_normal((3, n)) for _ in range(count)]


def walk(rng, total, corner):
    """A walk whose Allan variance is that of white noise of sd 1 over so many samples."""
    return math.sqrt(3.0) / corner * np.cumsum(rng.standard_normal((3, total)), axis=1)


def flicker(rng, total, corner):
    """Noise of density B²/f over a band, B² by its flat Allan variance of 2 ln 2 B²/π."""
    f = np.fft.rfftfreq(4 * total)
    f[0] = np.inf
    white = rng.standard_normal((2, 3, len(f)))
    # E|x_f|² = n S(f) with S = B²/(2π f), half of it in each part
    square = math.pi / (2.0 * math.log(2.0) * corner)
    size = np.sqrt(4 * total * square / (4.0 * math.pi * f))
    return np.fft.irfft(size * (white[0] + 1j * white[1]), 4 * total)[:, :total]


def session(rng, noise, corner, count=12, n=N):
    """Rests of white and slow noise, and the mean of the slow noise over sixteen rest lengths."""
    slow = noise(rng, (16 + 2 * count) * n, corner * n)
    starts = [8 * n + 2 * n * i for i in range(count)]
    rests = [slow[:, a : a + n] + rng.standard_normal((3, n)) for a in starts]
    middles = [a + n // 2 for a in starts]
    truth = [slow[:, m - 8 * n : m + 8 * n].mean(axis=1) for m in middles]
    return rests, np.array(truth)


def test_shapes_and_growths_against_their_spectra():
    """Cosines and contrasts of flicker noise as integrals over 1/f, of a walk by hand."""
    # eq. (2) of logs.common_noise

    def power(f, k):  # of cos πkt over 0 … 1
        away = np.array([f - k / 2.0, f + k / 2.0])
        return abs(0.5 * np.sum(np.sinc(away) * np.exp(-1j * np.pi * away))) ** 2

    flicker_shape, walk_shape = common_noise._shapes()
    for k in (1, 2, 5, 8):
        inside = quad(lambda f, k=k: 2.0 * power(f, k) / f, 1e-9, 60.0, limit=2000)[0]
        # blocks of 1/128 take some (8/128)² off the last of them
        assert flicker_shape[k - 1] == pytest.approx(inside, rel=4e-3)
        assert walk_shape[k - 1] == 1.0 / k**2
    contrast = quad(lambda f: (np.sinc(f) - np.sinc(16.0 * f)) ** 2 / f, 1e-9, 60.0, limit=2000)[0]
    growths = common_noise._growths()
    assert growths[0] == pytest.approx(contrast, rel=1e-3)  # of 1e-4 above 60
    # of a walk about its middle with a = 1/2 and b = 8: a/6 + b/6 − a/2 + a²/(6 b), K² = π² A
    assert growths[1] == pytest.approx(math.pi**2 * (1 / 12 + 8 / 6 - 1 / 4 + 0.25 / 48), rel=1e-12)


@pytest.mark.parametrize(("noise", "corner"), [(flicker, 0.3), (flicker, 0.03), (walk, 0.1)])
def test_slow_noise_is_known_by_all_and_u_holds_the_session(noise, corner):
    rng = np.random.default_rng(11)
    held, before = [], []
    for _ in range(8):
        rests, truth = session(rng, noise, corner)
        alone, together = settled(rests)
        said = np.maximum(stacked(together, "common"), stacked(together, "drift_factor")) > 1.0
        assert said.mean() > 0.9
        for found, kept in ((alone, before), (together, held)):
            error = np.abs(stacked(found, "mean") - truth)
            kept.append(error <= stdtrit(stacked(found, "dof"), 0.975) * stacked(found, "u"))
    # neighbours are alike: 288 means are worth some 50, of which 86 % are held but once in 100
    assert np.mean(held) > 0.86
    assert np.mean(before) < 0.75


def test_white_noise_keeps_its_u():
    """Levels of 4.5 and 1 %, less without the loudest: some 3 of 100 logs, so 8 are one in 100."""
    rng = np.random.default_rng(5)
    raised = 0
    for _ in range(60):
        lengths = rng.integers(100, 1500, 12)
        _, together = settled([rng.standard_normal((3, n)) for n in lengths])
        raised += bool((stacked(together, "common") > 1.0).any())
    assert raised <= 6


def test_a_disturbed_rest_and_a_memory_say_nothing_about_the_others():
    rng = np.random.default_rng(2)
    raised = {"bump": 0, "memory": 0}
    for _ in range(25):
        rests = white(rng, 12)
        rests[4] += 3.0 * np.sin(np.linspace(0.0, 3.0, N))
        raised["bump"] += bool((stacked(settled(rests)[1], "common") > 1.0).any())
        remembered = rng.standard_normal((12, 3, 2 * N))
        for i in range(1, 2 * N):  # worth a twentieth of the samples
            remembered[..., i] = 0.905 * remembered[..., i - 1] + 0.426 * remembered[..., i]
        raised["memory"] += bool((stacked(settled(remembered[..., N:])[1], "common") > 1.0).any())
    assert max(raised.values()) <= 4  # of a mean of one; 5 is one in 200


def test_outputs_that_differ_are_each_for_itself():
    rng = np.random.default_rng(4)
    rests, _ = session(rng, flicker, 0.03)
    for samples in rests:
        samples[1] = rng.standard_normal(N)
        samples[2] = 0.25  # stuck
    _, together = settled(rests)
    common = stacked(together, "common")
    own = stacked(together, "drift_factor")  # where that of a rest alone is larger still
    assert (np.maximum(common, own)[:, 0] > 1.5).all()
    assert (common[:, 0] > 1.0).any()
    assert (common[:, 1:] == 1.0).all()


def test_a_rest_alone_and_rests_of_a_few_samples_are_left_as_they_are():
    rng = np.random.default_rng(1)
    for rests in (white(rng, 1), white(rng, 5, 40), [np.zeros((3, 200))] * 3):
        alone, together = settled(rests)
        assert all(a is b for a, b in zip(alone, together, strict=True))
    square = [np.tile([1.0, -1.0], (3, N))] * 4  # whose slow cosines are nothing
    np.testing.assert_array_equal(stacked(settled(square)[1], "common"), 1.0)


def test_a_log_says_once_that_its_means_do_not_settle():
    rng = np.random.default_rng(3)
    up = np.repeat(mp.read_scheme("icosahedron-12").up, 500, axis=0)
    slow = walk(rng, len(up), 100.0).T
    samples = up + 1e-3 * (slow + rng.standard_normal(up.shape))
    log = dict(zip(("ax", "ay", "az"), samples.T, strict=True))
    log["time"] = np.arange(len(up)) / 100.0
    sections = {str(i): {"start": 500 * i, "end": 500 * (i + 1)} for i in range(12)}
    found = mp.average(log, sections=sections)
    (said,) = [text for text in texts(found) if "flicker noise" in text]
    assert said.startswith("flicker noise on 'ax', 'ay', 'az': longer averaging")
    assert not any("independent samples" in text for text in texts(found))
    u = found.readings.u
    assert (u > 3.0 * 1e-3 / math.sqrt(500)).all()
    assert (found.readings.dof < 499).all()


def test_the_law_of_very_many_rests_is_known_no_better_than_its_grid():
    mean = 1.0 + common_noise._shapes()[0]
    rows = np.random.default_rng(6).chisquare(1, (20_000, 1, 8)) * mean
    law = common_noise.find_law(rows, np.ones((20_000, 1), dtype=bool), np.ones(20_000))
    assert law is not None
    assert not law.walk
    assert law.amplitude == pytest.approx(1.0, rel=0.2)  # nodes are 17 % apart
    assert law.spread == pytest.approx(0.05 * law.amplitude, rel=0.1)  # a step over √12


def test_slow_cosines_against_quick_ones_by_f():
    """Means 3 and 1 of three rests: F of 3 on 6 and 12 degrees of freedom."""
    rows = np.tile([4.0, 2.0, 9.0, 9.0, 0.5, 1.5, 0.5, 1.5], (3, 1))
    p = float(f.sf(3.0, 6, 12))
    assert common_noise._falls(rows, 1.01 * p)
    assert not common_noise._falls(rows, 0.99 * p)


def test_one_loud_rest_of_nine_says_nothing_and_all_of_them_do():
    whole = np.ones((9, 1, 8))
    whole[:, 0, 0] = 11.0
    usable, length = np.ones((9, 1), dtype=bool), np.ones(9)
    one = np.ones((9, 1, 8))
    one[4, 0, 0] = 91.0  # as much together
    assert common_noise.find_law(one, usable, length) is None
    assert common_noise.find_law(whole, usable, length).walk


def test_what_a_law_promises_by_hand():
    # eq. (3) of logs.common_noise
    # μ as the module says, by three digits
    for walk, power, growth in ((False, 1, 2.39), (True, 2, 11.6)):
        law = common_noise.Law(walk, 0.8, 0.5, 0.1)
        square, dof = law.square(np.array([1.0, 2.0]))
        expected = 0.8 + growth * 0.5 * np.array([1.0, 2.0]) ** power
        np.testing.assert_allclose(square, expected, rtol=4e-3)
        spread = growth * 0.1 * np.array([1.0, 2.0]) ** power
        np.testing.assert_allclose(dof, 2.0 * (expected / spread) ** 2, rtol=2e-2)


def test_slow_cosines_are_those_of_scipy():
    # eq. (1) of logs.common_noise
    samples = np.random.default_rng(4).standard_normal((2, 600)).cumsum(axis=1)
    total = RestSum(600, 2)
    total.feed(samples)
    (rest,) = rest_means([total])
    square = 2.0 / 600**2 * (dct(samples, axis=1)[:, 1:9] / 2.0) ** 2
    expected = square / (rest.sd**2 / 600)[:, None]
    # ours are of 64 blocks, whose cosines are off by some (πk/128)²
    np.testing.assert_allclose(rest.cosines, expected, rtol=0, atol=2e-3 * expected.max())

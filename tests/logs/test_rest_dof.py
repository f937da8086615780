"""How well the u of a rest is known, and rests whose mean drifts."""

import math

import numpy as np
import pytest
from findings_bench import texts

import multipos as mp
from multipos.logs.rest_means import RestSum, autocovariances, density_with_dof, rest_means

N = 1000


def rest(samples):
    found = RestSum(samples.shape[1], len(samples))
    found.feed(samples)
    return rest_means([found])[0]


def remembering(rng, rows, effective, n=N):
    """Samples of an autoregression of first order worth so many independent ones, sd 1."""
    phi = (1.0 - effective / n) / (1.0 + effective / n)
    x = rng.standard_normal((rows, n))
    for i in range(1, n):
        x[:, i] = phi * x[:, i - 1] + math.sqrt(1.0 - phi**2) * x[:, i]
    return x


def flicker(rng, rows, n=N):
    """A stretch of noise of density 1/f that is sixteen times as long, sd 1."""
    f = np.fft.rfftfreq(16 * n)
    f[0] = np.inf
    density = rng.standard_normal((rows, len(f))) + 1j * rng.standard_normal((rows, len(f)))
    x = np.fft.irfft(density / np.sqrt(f), 16 * n)
    return (x / x.std())[:, 8 * n : 9 * n]


@pytest.mark.parametrize(("removed", "density"), [(0, 19.0), (1, 38.0)])
def test_a_mean_takes_half_of_a_density_at_most(removed, density):
    """φ = .9 of ten means: .19/.1² = 19 times the variance; what 1.9 of them lose is half."""
    found, _ = density_with_dof(np.array([[1.0, 0.9]]), np.array([10]), np.array([removed]))
    assert found == pytest.approx([density])


def test_degrees_of_freedom_by_the_delta_method():
    # eq. (2) of logs.rest_means
    rng = np.random.default_rng(7)
    z = remembering(rng, 1, 50.0, 400)
    z -= z.mean()
    lag = [float((z[:, : 400 - k] * z[:, k:]).sum()) / 400 for k in (0, 1)]
    phi = lag[1] / lag[0]
    count = np.array([400])
    density, dof = density_with_dof(autocovariances(z, count), count, np.zeros(1))
    assert density == pytest.approx(lag[0] * (1 - phi**2) / (1 - phi) ** 2, rel=1e-12)  # order 1
    # var phi = (1 − phi²)/b, and ln u² has the derivative 2/(1 − phi); var ln s² = 2/b
    spread = 2 / 400 + 4 * (1 - phi**2) / (400 * (1 - phi) ** 2)
    assert dof == pytest.approx(2 / spread - 1, rel=1e-9)
    white = rest(rng.standard_normal((50, N))).dof
    assert np.median(white) == pytest.approx(N - 1)  # some are taken to remember a little
    assert white.min() > 30.0


@pytest.mark.parametrize("memory", [(0.0, -0.8), (0.5, 0.2, 0.2)])
def test_higher_orders_by_solving_their_equations(memory):
    """Every order by a linear system of its own; rows of other lengths beside it change nothing."""
    rng = np.random.default_rng(3)
    rows = []
    for n in (300, 45, 700):
        x = rng.standard_normal(n)
        for i in range(len(memory), n):
            x[i] += sum(phi * x[i - k] for k, phi in enumerate(memory, 1))
        rows.append(x - x.mean())
    expected = [by_linear_systems(z) for z in rows]
    lagged = np.concatenate([autocovariances(z[None], np.array([len(z)])) for z in rows])
    found = density_with_dof(lagged, np.array([len(z) for z in rows]), np.zeros(3))
    assert found[0] == pytest.approx([density for density, _, _ in expected], rel=1e-9)
    assert found[1] == pytest.approx([dof for _, dof, _ in expected], rel=1e-9)
    assert max(order for _, _, order in expected) >= 2


def test_scatter_below_the_least_number_is_none():
    density, dof = density_with_dof(np.full((1, 31), 1e-310), np.array([400]), np.zeros(1))
    assert (density.tolist(), dof.tolist()) == ([0.0], [np.inf])


def by_linear_systems(z):
    """Density, degrees of freedom and order: eqs. (1) and (2) with m = 0, as they are written."""
    b = len(z)
    lag = np.array([float(z[: b - k] @ z[k:]) / b for k in range(31)])
    tried = []
    for p in range(min(b // 10, int(10 * math.log10(b))) + 1):
        gamma = lag[np.abs(np.subtract.outer(np.arange(p), np.arange(p)))]
        phi = np.linalg.solve(gamma, lag[1 : p + 1]) if p else np.zeros(0)
        square = lag[0] - float(phi @ lag[1 : p + 1])
        density = square / (1 - phi.sum()) ** 2
        inner = float(np.ones(p) @ np.linalg.solve(gamma, np.ones(p))) if p else 0.0
        spread = 2 / b + 4 * density * inner / b
        tried.append((b * math.log(square) + 2 * (p + 1) * b / (b - p - 2), density, spread, p))
    _, density, spread, p = min(tried)
    return density, 2 / spread - 1, p


@pytest.mark.parametrize("effective", [10, 30])
def test_t_covers_the_mean_of_few_effective_samples(effective):
    from scipy.special import stdtrit

    rng = np.random.default_rng(effective)
    runs = 600
    found = rest(remembering(rng, runs, effective))
    size = np.abs(found.mean) / found.u
    inside = float(np.mean(size < stdtrit(found.dof, 0.975)))
    sd = math.sqrt(0.95 * 0.05 / runs)
    assert 0.95 - 3.3 * sd < inside  # 1 in 1000
    assert inside < 0.985  # a few are taken for flicker noise
    known = float(np.mean(size[found.drift_factor == 1.0] < 1.96))
    assert known < 0.95 if effective == 10 else True


def test_noise_that_does_not_settle_is_known_and_u_raised():
    rng = np.random.default_rng(3)
    runs = 200
    named = {
        "white": rest(rng.standard_normal((runs, N))).drift_factor > 1.0,
        "memory": rest(remembering(rng, runs, 100.0)).drift_factor > 1.0,
        "flicker": rest(flicker(rng, runs)).drift_factor > 1.0,
        "walk": rest(np.cumsum(rng.standard_normal((runs, N)), axis=1)).drift_factor > 1.0,
    }
    share = {name: float(np.mean(each)) for name, each in named.items()}
    assert share["white"] <= 0.02
    assert share["memory"] <= 0.05
    assert share["flicker"] >= 0.7
    assert share["walk"] >= 0.4  # the others have a u as large already


def test_u_of_flicker_noise_holds_the_zero_of_a_long_session():
    from scipy.special import stdtrit

    found = rest(flicker(np.random.default_rng(5), 300))
    size = np.abs(found.mean)  # the long record has zero mean
    assert np.mean(size < stdtrit(found.dof, 0.975) * found.u) > 0.85
    assert np.mean(size < 1.96 * found.u / found.drift_factor) < 0.65  # what it was


def test_the_file_carries_degrees_of_freedom_and_the_rest_says_few(tmp_path):
    rng = np.random.default_rng(2)
    up = mp.read_scheme("faces-6").up
    noise = remembering(rng, 3 * len(up), 12.0, 500).reshape(len(up), 3, 500)
    samples = np.concatenate(
        [u[:, None] + 1e-3 * each for u, each in zip(up, noise, strict=True)], 1
    )
    log = dict(zip(("ax", "ay", "az"), samples, strict=True))
    log["time"] = np.arange(samples.shape[1]) / 100.0
    sections = {str(i + 1): {"start": 500 * i, "end": 500 * (i + 1)} for i in range(6)}
    found = mp.average(log, sections=sections, scheme="faces-6")
    assert any("independent ones" in note for note in texts(found.rests[0]))
    assert set(found.to_dict()["positions"][0]["dof"]) == {"ax", "ay", "az"}
    found.save(tmp_path / "readings.csv")
    read = mp.read_readings(tmp_path / "readings.csv")
    np.testing.assert_array_equal(read.dof, found.readings.dof)
    assert read.outputs == ("ax", "ay", "az")
    few = mp.fit(read, scheme="faces-6")
    assert any("weighted by their numbers of samples" in note for note in texts(few))
    same = mp.Readings(read.values, up=up, u=few.readings.u, outputs=read.outputs)
    assert (few.parameter_dof < mp.fit(same).parameter_dof).all()
    saved = tmp_path / "cal.json"
    few.save(saved)
    np.testing.assert_array_equal(mp.load(saved).readings.dof, read.dof)

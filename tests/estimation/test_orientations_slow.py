"""Uncertain and unknown orientations by simulation: convergence, efficiency, coverage."""

from dataclasses import dataclass

import numpy as np
import pytest
from orientation_bench import MATRIX, QUADRATIC, Sensor, lower, readings_of, scatter
from scipy import stats

import multipos as mp
from multipos.numerics.rotations import rotation_matrix
from multipos.positions.scheme import read_scheme

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_findings")]
UP = read_scheme("fibonacci-24").up
HAND_HELD = Sensor(matrix=lower(MATRIX))


# --- convergence: 500 of 500, whatever the unit


def any_sensor(rng):
    """Bias up to 0.5 g, scale factors ±50 %, axes leaning 10° in any direction; lower gauge."""
    scale = rng.uniform(0.5, 1.5, 3)
    axes = np.eye(3)
    for i in range(3):
        across = np.delete(np.eye(3), i, axis=0)
        azimuth, lean = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(0.0, 10.0))
        axes[i] = np.cos(lean) * axes[i] + np.sin(lean) * (
            np.cos(azimuth) * across[0] + np.sin(azimuth) * across[1]
        )
    return rng.uniform(-0.5, 0.5, 3), lower(scale[:, None] * axes)


@pytest.mark.parametrize(
    ("unit", "gain", "offset"), [("count", 16384.0, 32768.0), ("V", -0.66, 1.65)]
)
def test_every_start_finds_the_right_minimum(unit, gain, offset):
    rng = np.random.default_rng(500)
    found = 0
    for run in range(250):
        bias, matrix = any_sensor(rng)
        model = ("linear", "own-quadratic")[run % 2]
        sensor = Sensor(bias, matrix, QUADRATIC * (run % 2))
        turn = rotation_matrix(rng.standard_normal(3))
        values = sensor.read(UP @ turn.T) + 1e-4 * rng.standard_normal(UP.shape)
        cal = mp.fit(
            mp.Readings(offset + gain * values, unit=unit), model=model, unknown_orientation=True
        )
        theta = cal.parameters.copy()
        theta[[str(term) == "1" for _, term in cal.model.keys]] -= offset
        # a negative gain turns the axes, of which own scale factors are taken positive
        truth = np.sign(gain) ** (1 + cal.model.force_degrees) * sensor.truth(cal.model)
        worst = np.abs(theta / abs(gain) - truth).max()
        # u is of 1e-4 g; a false minimum is off by a tenth
        found += bool(cal.status.converged and worst < 5e-3)
    assert found == 250


def test_ten_degrees_of_orientation_error_converge():
    rng = np.random.default_rng(60)
    sensor, found = Sensor(), 0
    for _ in range(100):
        readings = readings_of(sensor, UP, rng, sd=1e-4, off_deg=10.0)
        cal = mp.fit(readings, orientation_sd=10.0, reading_sd=1e-4)
        pull = (cal.parameters - sensor.truth(cal.model)) / cal.u
        found += bool(cal.status.converged and np.abs(pull).max() < 5.0)
    assert found == 100


def fit_each(values, sensor, up=None, **options):
    """Fit sets of readings (runs, n, 3) in one call, each as `fit`: errors and expanded u."""
    table = dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T, strict=True))
    table["unit"] = np.repeat(np.arange(len(values)), values.shape[1])
    if up is not None:
        listed = np.tile(up, (len(values), 1)).T
        table |= dict(zip(("up_x", "up_y", "up_z"), listed, strict=True))
    found = mp.fit_many(table, unit_column="unit", **options)
    cal = mp.fit(mp.Readings(values[0], up=up), **options)
    value, u, dof = (
        np.column_stack([found[of + n] for n in cal.names]) for of in ("", "u_", "dof_")
    )
    U = u * stats.t.ppf(0.975, dof)
    np.testing.assert_allclose(U[0], cal.U, rtol=1e-6)
    return value - sensor.truth(cal.model), U


# --- efficiency


def cramer_rao(sensor, up, sd):
    """Return the bound on u: directions eliminated through the normal of the readings' surface.

    Readings y = b + M f lie on the ellipsoid whose normal at f is n = M^-T f: only n'(y − h) tells.
    """
    normal = np.linalg.solve(sensor.matrix.T, up.T).T
    rows = []
    for n, f in zip(normal, up, strict=True):
        slopes = [n[i] * x for i in range(3) for x in (1.0, *f[: i + 1])]
        rows.append(np.array(slopes) / np.sqrt(np.sum((n * sd) ** 2)))
    A = np.array(rows)
    return np.sqrt(np.diag(np.linalg.inv(A.T @ A)))


def test_scatter_reaches_the_cramer_rao_bound_with_unequal_noise():
    sd = np.array([2e-5, 1e-4, 4e-4])
    rng = np.random.default_rng(3)
    values = HAND_HELD.read(UP) + sd * rng.standard_normal((2500, *UP.shape))
    errors, expanded = fit_each(values, HAND_HELD, unknown_orientation=True, reading_sd=sd)
    bound = cramer_rao(HAND_HELD, UP, sd)
    scatter_ratio = np.std(errors, axis=0) / bound
    # 5 %, which is 3.5 standard deviations of a standard deviation from 2500 runs, and as much for
    # a claim that is not taken on trust: a scatter is allowed for, beside the quietest axis too
    assert np.abs(scatter_ratio - 1.0).max() < 0.1
    # one scatter beside all three axes is told by fifteen contrasts, most of the loudest axis
    price = np.mean(expanded, axis=0) / 1.96 / bound
    assert price.min() > 1.0
    assert price.max() < 1.8


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_five_times_better_than_least_squares(model):
    rng = np.random.default_rng(5)
    sensor = Sensor(quadratic=QUADRATIC * (model != "linear"))
    values = np.array(
        [readings_of(sensor, UP, rng, sd=1e-5, off_deg=0.01).values for _ in range(200)]
    )
    rms = [
        np.sqrt(np.mean(np.square(fit_each(values, sensor, UP, model=model, **how)[0]), axis=0))
        for how in ({"orientation_sd": 0}, {"orientation_sd": 0.01, "reading_sd": 1e-5})
    ]
    ratio = rms[0] / rms[1]
    cal = mp.fit(mp.Readings(values[0], up=UP), model=model)
    at = [i for i, name in enumerate(cal.names) if name.startswith(("bias", "scale"))]
    assert ratio[at].min() > 5.0


# --- coverage of what is claimed


@dataclass(frozen=True)
class Mode:
    """What a sensor is fitted with, and what is true of its noise [g] and directions [°]."""

    sensor: Sensor
    sd: float
    off_deg: float
    options: dict

    def simulate(self, scheme, runs):
        """Return errors and expanded uncertainties (runs, p) of many fits."""
        rng, up = np.random.default_rng(95), read_scheme(scheme).up
        values = np.array(
            [
                readings_of(self.sensor, up, rng, sd=self.sd, off_deg=self.off_deg).values
                for _ in range(runs)
            ]
        )
        free = "unknown_orientation" in self.options
        return fit_each(values, self.sensor, None if free else up, **self.options)


STATED = {"reading_sd": 1e-4, "orientation_sd": 0.02}
FAR = {"model": "own-quadratic", "reading_sd": 3e-5, "orientation_sd": 0.1}
MODES = {
    "listed": Mode(Sensor(), 1e-4, 0.0, {}),
    "uncertain": Mode(Sensor(), 1e-4, 0.02, STATED),
    "far": Mode(Sensor(quadratic=QUADRATIC), 3e-5, 0.1, FAR),
    "unknown": Mode(HAND_HELD, 1e-4, 0.0, {"unknown_orientation": True}),
}


@pytest.mark.parametrize(
    ("mode", "scheme", "runs"),
    [
        ("listed", "faces-corners-14", 2000),
        ("listed", "fibonacci-24", 2000),
        ("uncertain", "faces-corners-14", 1200),
        ("far", "fibonacci-24", 1200),
        ("unknown", "faces-corners-14", 1500),
        ("unknown", "fibonacci-24", 1500),
    ],
)
def test_intervals_cover(mode, scheme, runs):
    errors, U = MODES[mode].simulate(scheme, runs)
    # a claim that is right is not taken on trust, which makes U a little too long
    intervals_cover(errors, U, longer=0.02 if mode in ("uncertain", "far") else 0.0)


def intervals_cover(errors, U, longer=0.0):
    runs, hit = len(errors), np.abs(errors) <= U
    # of all parameters together: they share their noise, so runs are counted, not intervals
    se = hit.mean(axis=1).std() / np.sqrt(runs)
    assert se < 0.005
    near = max(0.01, 3.0 * se)
    assert 0.95 - near < hit.mean() < 0.95 + near + longer
    # each on its own by the binomial law, 4 standard deviations for the worst of twelve
    each = 4.0 * np.sqrt(0.95 * 0.05 / runs) + 0.002
    assert hit.mean(axis=0).min() > 0.95 - each
    assert hit.mean(axis=0).max() < 0.95 + each + longer


def test_intervals_of_noise_that_is_estimated_cover():
    rng, sensor, runs = np.random.default_rng(95), Sensor(), 400
    each = [
        mp.fit(readings_of(sensor, UP, rng, sd=1e-5, off_deg=0.01), orientation_sd="auto")
        for _ in range(runs)
    ]
    truth = sensor.truth(each[0].model)
    intervals_cover(np.array([c.parameters - truth for c in each]), np.array([c.U for c in each]))
    variances_are_unbiased_and_known_as_said([c.variance_components for c in each], runs)


def variances_are_unbiased_and_known_as_said(found, runs):
    for name, truth in (("reading_sd", 1e-5), ("orientation_sd_deg", 0.01)):
        value = np.array([entry[name]["value"] for entry in found])
        u = np.array([entry[name]["u"] for entry in found])
        logs = np.log(value / truth)
        # the posterior is symmetric in the logarithm, up to its boundary at zero
        assert abs(logs.mean()) < 4.0 * logs.std() / np.sqrt(runs) + 0.01
        # its u is the scatter: 14 % is 4 sd of a standard deviation from 400 runs, 5 % the skewness
        assert np.median(u / value) == pytest.approx(np.std(np.log(value)), rel=0.19)


@pytest.mark.parametrize("loss", ["huber", "soft-l1", "cauchy"])
def test_robust_intervals_are_honest_beside_an_outlier(loss):
    rng = np.random.default_rng(8)
    # 80 know the mean to 1.3 %: a U that is a fifth too short is seen in 95 of 100 tries
    runs, hit = 80, []
    for _ in range(runs):
        values = HAND_HELD.read(UP) + 1e-4 * rng.standard_normal(UP.shape)
        values[rng.integers(24), rng.integers(3)] += 0.05
        cal = mp.fit(mp.Readings(values), unknown_orientation=True, robust=loss)
        hit.append(np.abs(cal.parameters - HAND_HELD.truth(cal.model)) <= cal.U)
    # the factor on the covariance is asymptotic: at 24 positions it is good to 2 %
    assert 0.92 < np.mean(hit) < 0.975


def test_scattered_positions_are_scattered_as_said():
    """The bench itself: angles of N(0, sd²) about each of two axes."""
    rng = np.random.default_rng(1)
    up = np.tile(UP, (500, 1))
    angle = np.arccos(np.clip(np.einsum("ni,ni->n", up, scatter(up, 0.5, rng)), -1.0, 1.0))
    assert np.sqrt(np.mean(angle**2) / 2.0) == pytest.approx(np.radians(0.5), rel=0.02)

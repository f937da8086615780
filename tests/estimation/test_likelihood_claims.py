"""Claims about uncertain and unknown orientations: profiles, joint tests, trials, sensitivities."""

import math
from dataclasses import replace

import numpy as np
import pytest
from amounts import exactly
from log_bench import shared
from numpy.testing import assert_allclose
from profile_oracle import profile_interval
from scipy.optimize import least_squares

import multipos as mp
from multipos.diagnostics.score_tests import judge_included
from multipos.estimation.gains import estimator_gain, restate, return_to_optimum
from multipos.numerics.rotations import rotation_matrix
from multipos.positions.scheme import read_scheme
from multipos.uncertainty.budgets import read_budget
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.uncertainty.sensitivities import parameter_effects

M = np.array([[1.02, 0.03, -0.02], [0.01, 0.97, 0.04], [-0.03, 0.02, 1.01]])
BIAS = np.array([0.01, -0.02, 0.015])
GRAVITY = 9.81


def sense(force, quad=0.0):
    return force @ M.T + BIAS + quad * force**2


def scattered(up, off_deg, rng):
    turns = np.radians(off_deg) * rng.standard_normal(up.shape)
    return np.array([rotation_matrix(turn) @ one for turn, one in zip(turns, up, strict=True)])


def readings(n=24, *, sd=1e-3, off_deg=0.0, quad=0.0, seed=1, **more):
    rng = np.random.default_rng(seed)
    up = read_scheme(f"fibonacci-{n}").up
    values = sense(scattered(up, off_deg, rng), quad) + sd * rng.standard_normal((n, 3))
    return mp.Readings(values, unit="g", up=up, **more)


# --- the problem, stated again


@pytest.mark.parametrize(
    "options",
    [
        {"unknown_orientation": True},
        {"unknown_orientation": True, "gauge": "symmetric"},
        {"orientation_sd": 0.2},
        {"orientation_sd": 0.2, "reading_sd": 1e-3},
        {"orientation_sd": "auto"},
        {"orientation_sd": 0.001, "reading_sd": 1e-5},
        {"orientation_sd": 0.2, "convention": "gravity", "gravity": 9.7},
    ],
    ids=lambda options: " ".join(f"{key}={value}" for key, value in options.items()),
)
def test_a_file_is_enough_to_return_to_its_optimum(options, tmp_path):
    c = mp.fit(readings(off_deg=0.2), **options)
    c.save(tmp_path / "c.json")
    again = mp.load(tmp_path / "c.json")
    found = return_to_optimum(again, restate(again))
    assert found.converged
    # noise and solution were found in turn until ln variance moved by less than 1e-5
    assert_allclose(found.state.theta, c.parameters, atol=1e-4 * c.u.min())


def test_a_group_returns_to_its_optimum():
    up = read_scheme("fibonacci-24").up
    turn = rotation_matrix(np.array([0.3, -0.2, 0.5]))
    group = ("",) * 12 + ("b",) * 12
    rng = np.random.default_rng(2)
    true = np.where(np.arange(24)[:, None] < 12, up, up @ turn.T)
    values = sense(true) + 1e-4 * rng.standard_normal((24, 3))
    c = mp.fit(mp.Readings(values, unit="g", up=up, group=group), reading_sd=1e-4)
    found = return_to_optimum(c, restate(c))
    assert_allclose(found.state.theta, c.parameters, atol=1e-6 * c.u.min())


# --- profiles


@pytest.mark.parametrize("noise", [{"reading_sd": 1e-3}, {}], ids=["stated", "estimated"])
def test_profile_meets_the_linear_fit_where_orientations_are_certain(noise):
    data = readings()
    linear = exactly(data, pool=True, **noise)
    certain = exactly(data, orientation_sd=1e-5, **noise)  # degrees: 2e-4 of the noise
    for output, term in (("ax", "1"), ("ay", "x"), ("az", "z")):
        p = linear[output, term]
        ends = profile_interval(certain, output, term)
        # outputs have one noise in the one, and may be unequal in the other, on fewer dof
        assert_allclose(ends, [p.value - p.U, p.value + p.U], atol=0.2 * p.U)


@pytest.mark.parametrize(
    "options",
    [
        {"unknown_orientation": True},
        {"unknown_orientation": True, "reading_sd": 1e-3},
        {"unknown_orientation": True, "gauge": "symmetric"},
        {"orientation_sd": 0.2},
        {"orientation_sd": 0.2, "reading_sd": 1e-3},
        {"orientation_sd": "auto"},
        {"orientation_sd": 0.02, "reading_sd": 1e-5},
    ],
    ids=lambda options: " ".join(f"{key}={value}" for key, value in options.items()),
)
def test_profile_is_the_t_interval_where_nearly_linear(options):
    c = exactly(readings(off_deg=0.2), **options)
    for output, term in (("ax", "1"), ("ay", "y"), ("az", "x")):
        p = c[output, term]
        low, high = profile_interval(c, output, term)
        # noise of 1e-3 on a sphere of radius 1: 1 % of U; the profile takes the noise of outputs
        # for equal, and the sd of orientations for what was found, of which U allows for more
        assert_allclose([low, high], [p.value - p.U, p.value + p.U], atol=0.2 * p.U)


def test_profile_bends_where_the_noise_is_large():
    """At both ends, every unknown fitted anew by SciPy, the fit is worse as U² over C is."""
    c = mp.fit(readings(15, sd=0.05), unknown_orientation=True, reading_sd=0.05)
    index = c.model.index("ax", "x")
    low, high = profile_interval(c, "ax", "x")

    def cost(theta, angles):
        lat, lon = angles.reshape(2, 15)
        force = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]).T
        return ((c.readings.values - c.model.predict(theta, force, {})) / 0.05).ravel()

    f = c.reference
    start = np.concatenate([np.arcsin(f[:, 2]), np.arctan2(f[:, 1], f[:, 0])])
    others = np.delete(c.parameters, index)
    least = np.sum(cost(c.parameters, start) ** 2)
    whole = np.concatenate([c.parameters, start])
    slopes = least_squares(lambda v: cost(v[:9], v[9:]), whole, jac="3-point", max_nfev=1).jac
    variance = np.linalg.inv(slopes.T @ slopes)[index, index]  # under the noise that is stated
    for end in (low, high):
        found = least_squares(
            lambda v, end=end: cost(np.insert(v[:8], index, end), v[8:]),
            np.concatenate([others, start]),
            x_scale="jac",
            xtol=1e-13,
            ftol=1e-13,
            gtol=1e-13,
        )
        # the slopes are known to 1e-5
        assert 2 * found.cost - least == pytest.approx(c.U[index] ** 2 / variance, rel=1e-4)
    p = c["ax", "x"]
    assert abs((low + high) / 2 - p.value) > 0.02 * p.U  # it is not the symmetric interval


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
def test_coverage_of_profiles_of_an_uncertain_orientation():
    runs, inside = 150, 0
    truth = M[1, 0]
    for seed in range(runs):
        c = mp.fit(readings(12, sd=1e-3, off_deg=0.3, seed=seed), orientation_sd=0.3)
        low, high = profile_interval(c, "ay", "x")
        inside += low <= truth <= high
    assert inside / runs == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / runs))


# --- tests of terms, outputs together


@pytest.mark.parametrize(
    ("name", "p"), [("innalabs_24", 0.07), ("pointer_ee_24", 1e-5), ("pointer_ab_24", 7e-4)]
)
def test_second_order_of_real_recordings(name, p):
    """A term that is left out has the published p; one that is in is judged by its own U."""
    data = shared(f"{name}.csv")
    (test,) = [
        test
        for test in exactly(data, unknown_orientation=True).diagnostics.model_tests
        if test.term == "own^2"
    ]
    assert float(f"{test.p:.1g}") == p
    (test,) = judge_included(exactly(data, unknown_orientation=True, model="own-quadratic"))
    # axes of unequal noise leave U fewer degrees of freedom, whose tails are longer
    assert math.log(test.p / p) == pytest.approx(0.0, abs=math.log(30.0))


def test_included_terms_of_known_orientations_combine_the_outputs():
    from scipy.special import fdtrc

    c = exactly(readings(quad=1e-3), model="own-quadratic")
    (test,) = judge_included(c)
    ratios = [(c[f"quad_a{axis}"].value / c[f"quad_a{axis}"].u) ** 2 for axis in "xyz"]
    total = -2 * sum(math.log(fdtrc(1, 19, ratio)) for ratio in ratios)
    assert test.statistic == pytest.approx(total, rel=1e-9)
    assert (test.term, test.dof) == ("own^2", (6.0,))


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_the_report_shows_tests_of_terms(model, tmp_path):
    c = mp.fit(readings(quad=5e-3), model=model)
    mp.report(c, tmp_path / "r.md")
    said = (tmp_path / "r.md").read_text(encoding="utf-8")
    row = next(line for line in said.splitlines() if "own^2" in line and "in the model" in line)
    assert ("not in the model" in row) is (model == "linear")


# --- Monte Carlo


@pytest.mark.parametrize(
    "options",
    [{"orientation_sd": 0.2, "reading_sd": 1e-3}, {"orientation_sd": "auto"}],
    ids=["stated", "both estimated"],
)
def test_monte_carlo_of_an_uncertain_orientation(options):
    c = mp.fit(readings(off_deg=0.2), budget={"gain": {"u": 1e-5}}, **options)
    trials = 400
    found = simulate_budget(c, trials=trials, rng=2)
    # t has a larger sd than its u; its degrees of freedom here are 20 and more
    wider = 1.0 / np.sqrt(1.0 - 2.0 / c.parameter_dof)
    assert_allclose(found.u, c.u * wider, rtol=4 / math.sqrt(2 * trials) + 0.02)
    assert_allclose(found.mean, c.parameters, atol=4 * c.u.max() / math.sqrt(trials))


def test_monte_carlo_of_a_table_that_is_not_level():
    """Common tilt is most of it: the cross terms are as uncertain as the table."""
    rng = np.random.default_rng(3)
    up = read_scheme("dual-axis-48").up
    values = sense(up) + 1e-5 * rng.standard_normal(up.shape)
    c = mp.fit(mp.Readings(values, unit="g"), scheme="dual-axis-48", level_sd=0.1, reading_sd=1e-5)
    found = simulate_budget(c, trials=400, rng=4)
    assert_allclose(found.u, c.u, rtol=4 / math.sqrt(800))


# --- sensitivities


def world(c, name, step, component):
    """Readings of a world where a quantity is off by a step, with no first order used."""
    y = np.array(c.readings.values)
    if name == "gravity":
        return c.model.predict(c.parameters, c.reference * (1.0 + step / GRAVITY), {}) + c.residuals
    if name == "gain":
        return y * (1.0 + step)
    if name == "offset":
        return y + step
    if name == "resolution":
        y.flat[component] += step
        return y
    if name == "temperature":  # a scale factor of 1e-2 per degree
        return y + 1e-2 * step * (y - c.residuals - at_rest(c))
    tilt = rotation_matrix(math.radians(step) * np.eye(3)[component])
    rotation = c.readings.rotation
    turned = rotation @ tilt @ rotation.transpose(0, 2, 1)
    force = np.einsum("nij,nj->ni", turned, c.reference)
    return c.model.predict(c.parameters, force, {}) + c.residuals


def at_rest(c):
    return c.model.predict(c.parameters, np.zeros((1, 3)), {})


ROLLS = "roll-x-12+roll-y-12+roll-z-12"
TABLES = {
    "gravity": {"value": GRAVITY, "u": 1e-5},
    "gain": {"u": 1e-5},
    "offset": {"u": 1e-5},
    "resolution": {"step": 1e-5},
    "temperature": {"u": 0.1, "scale_per_degC": 1e-2},
    "level": {"u_deg": 1e-3},
}


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize(
    "options",
    [
        {"unknown_orientation": True},
        {"unknown_orientation": True, "gauge": "symmetric"},
    ],
    ids=["unknown", "symmetric"],
)
@pytest.mark.usefixtures("without_findings")
def test_sensitivities_of_the_likelihood_against_the_whole_estimator(name, options):
    """Readings of a world where the quantity is off, calibrated as if it were not.

    At uncertain orientations variance components are found anew in each world.
    """
    if name == "level":
        pytest.skip("orientations that were not used cannot be wrong")
    rng = np.random.default_rng(5)
    given = read_scheme(ROLLS)
    values = sense(given.up, 1e-3) + 1e-4 * rng.standard_normal(given.up.shape)
    options = {"model": "own-quadratic", "gravity": GRAVITY, "reading_sd": 1e-4, **options}
    c = exactly(mp.Readings(values, unit="g", positions=given.labels), **options)
    quantity = read_budget(TABLES).quantities[name]
    # gravity acts through the calibration's own
    c = replace(c, model=replace(c.model, field=replace(c.field, u=1e-5)))
    effects = parameter_effects(c, estimator_gain(c), quantity)
    step = {"gravity": 1e-2, "level": 1e-2, "temperature": 1e-1, "resolution": 1e-4}.get(name, 1e-3)
    components = {"resolution": (0, 40, 100), "level": (0, 1)}.get(name, (0,))
    for component in components:
        moved = [
            exactly(
                mp.Readings(
                    world(c, name, side * step, component), unit="g", positions=given.labels
                ),
                **options,
            ).parameters
            for side in (1.0, -1.0)
        ]
        found = (moved[0] - moved[1]) / (2.0 * step)
        # the gain leaves out second derivatives times residuals, 1e-4 of noise, some times over;
        # against the largest effect, for a reading across the force hardly has one
        assert_allclose(effects[:, component], found, atol=2e-3 * np.abs(effects).max())

"""The budget: sensitivities against the whole estimator, sums by hand, bad files by message."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import multipos as mp
from multipos.cli import main
from multipos.errors import MultiposError, UsageError
from multipos.estimation.gains import estimator_gain, gravity_effect
from multipos.files.trees import read_json
from multipos.positions.scheme import read_scheme
from multipos.sensor.simulation import turned
from multipos.uncertainty import sphere
from multipos.uncertainty.budgets import read_budget
from multipos.uncertainty.monte_carlo import _BLOCK, _until_stable
from multipos.uncertainty.propagation import evaluate_budget, state_budget, welch_satterthwaite
from multipos.uncertainty.sensitivities import parameter_effects, reading_moves
from multipos.uncertainty.sphere import evaluate_sphere
from multipos.uncertainty.unseen_terms import unseen_covariance

M = np.array([[1.02, 0.03, -0.02], [0.01, 0.97, 0.04], [-0.03, 0.02, 1.01]])
BIAS = np.array([0.01, -0.02, 0.015])
K2 = np.array([1e-3, -2e-3, 5e-4])
GRAVITY = 9.80123


def sense(force):
    """A triad with second-order terms, at force (n, 3)."""
    return force @ M.T + BIAS + K2 * force**2


KNOWN = {"orientation_sd": 0, "exclude": "none"}  # least squares of the listed orientations


def calibrate(scheme="dual-axis-48", noise=0.0, seed=1, **options):
    given = read_scheme(scheme)
    sign = -1.0 if options.get("convention") == "gravity" else 1.0
    size = options["gravity"] / 9.80665 if "gravity" in options else 1.0
    values = sense(sign * size * given.up)
    values = values + noise * np.random.default_rng(seed).standard_normal(values.shape)
    readings = mp.Readings(values, unit="g", positions=given.labels)
    stated = options.keys() & {"unknown_orientation", "level_sd", "closed_form"}
    known = {} if stated else KNOWN
    return mp.fit(readings, **known | {"scheme": scheme, "model": "own-quadratic", **options})


def rotation_vector(axis, angle):
    """Matrix of a turn about a unit axis, Rodrigues."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def true_forces(c, name, size, component):
    """The force that really acted when a quantity is off by `size`, with no first order used."""
    rotation, reference = c.readings.rotation, np.array(c.reference)
    radians = math.radians(size)
    if name == "gravity":
        return reference * (1.0 + size / GRAVITY)
    if name == "level":
        tilt = rotation_vector(np.eye(3)[component], radians)
        up = np.linalg.norm(reference, axis=1)[:, None] * (rotation @ tilt)[:, :, 2]
        return up if c.convention == "specific-force" else -up
    if name == "index":
        first, second = np.array([(1, 2) if abs(r[0, 0]) > 0.5 else (0, 2) for r in rotation]).T
        rows = np.arange(len(reference))
        angle = np.arctan2(reference[rows, second], reference[rows, first])
        wave = [np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)][component]
        turned = np.zeros_like(reference)
        length = np.linalg.norm(reference, axis=1)
        moved = angle + radians * wave / math.sqrt(2.0)
        turned[rows, first], turned[rows, second] = length * np.cos(moved), length * np.sin(moved)
        return turned
    raise AssertionError(name)


@pytest.mark.parametrize("closed_form", [False, True])
@pytest.mark.parametrize("convention", ["specific-force", "gravity"])
def test_gain_is_how_the_estimator_follows_each_reading(closed_form, convention):
    # eq. (1) of estimation.gains
    c = calibrate("song-qin-6", noise=1e-3, closed_form=closed_form, convention=convention)
    gain = estimator_gain(c)
    assert_allclose(gain @ c.readings.values.ravel(), c.parameters, atol=1e-14)
    for place in range(c.readings.values.size):
        values = np.array(c.readings.values)
        values.flat[place] += 1e-3
        moved = mp.fit(
            replace(c.readings, values=values, up=None, rotation=None),
            scheme="song-qin-6",
            model="own-quadratic",
            closed_form=closed_form,
            convention=convention,
        )
        assert_allclose((moved.parameters - c.parameters) / 1e-3, gain[:, place], atol=1e-11)


@pytest.mark.parametrize("kind", ["u", "covariance"])
def test_gain_of_weighted_fits(kind):
    rng = np.random.default_rng(3)
    given = read_scheme("icosahedron-12")
    n = 36
    if kind == "u":
        noise = {"u": rng.uniform(0.5, 2.0, (12, 3))}
    else:
        root = rng.standard_normal((n, n))
        noise = {"covariance": root @ root.T + n * np.eye(n)}
    y = sense(given.up)
    fits = [
        with_known_noise(
            mp.fit(mp.Readings(y + step, unit="g", **noise), scheme="icosahedron-12", **KNOWN)
        )
        for step in (0.0, rng.standard_normal(y.shape))
    ]
    difference = (fits[1].readings.values - fits[0].readings.values).ravel()
    moved = fits[1].parameters - fits[0].parameters
    assert_allclose(estimator_gain(fits[0]) @ difference, moved, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "components", "step"), [("gravity", 1, 1e-3), ("level", 2, 1e-2), ("index", 4, 1e-2)]
)
@pytest.mark.parametrize("convention", ["specific-force", "gravity"])
@pytest.mark.usefixtures("without_findings")
def test_sensitivities_against_the_whole_estimator(name, components, step, convention):
    """Readings of a world where the quantity is off, calibrated as if it were not."""
    # eqs. (1), (2) of uncertainty.sensitivities
    tables = {"gravity": {"value": GRAVITY, "u": 1e-5}, "level": {"u_deg": 1.0}}
    if convention == "specific-force":
        tables["index"] = {"u_deg": 1.0}
    elif name == "index":
        pytest.skip("the oracle is written for up vectors")
    c = calibrate(gravity=GRAVITY, convention=convention)
    quantity = read_budget(tables).quantities[name]
    effects = parameter_effects(c, estimator_gain(c), quantity)
    assert effects.shape == (15, components)
    for component in range(components):
        found = []
        for size in (step, -step):
            force = true_forces(c, name, size, component)
            moved = mp.fit(
                mp.Readings(sense(force), unit="g", positions=c.readings.positions),
                scheme="dual-axis-48",
                model="own-quadratic",
                convention=convention,
                gravity=GRAVITY,
                **KNOWN,
            )
            found.append(moved.parameters)
        # central differences: third order in the step is left, (step)² of the effect
        assert_allclose((found[0] - found[1]) / (2 * step), effects[:, component], atol=2e-9)


def test_a_table_that_is_not_level_moves_nothing_about_the_vertical():
    c = calibrate("song-qin-6")
    moves = reading_moves(c, read_budget({"level": {"u_deg": 1.0}}).quantities["level"])
    # position 1 of table 1, E-U-S: y is up; a tilt about east (x) moves up towards z alone
    assert_allclose(moves[0, :, 0] * 180 / math.pi, M @ [0, 0, 1.0], atol=1e-12)


def test_independent_placement_adds_up_over_positions():
    """Against random placements of every position, pushed through the whole estimator."""
    rng = np.random.default_rng(8)
    c = calibrate("icosahedron-12", reading_sd=1e-9)
    quantity = read_budget({"orientation": {"u_deg": 0.01}}).quantities["orientation"]
    effects = parameter_effects(c, estimator_gain(c), quantity)
    runs = 4000
    turns = np.radians(0.01) * rng.standard_normal((runs, 12, 3))
    forces = c.reference + np.cross(turns, c.reference)
    gain = estimator_gain(c)
    drawn = np.array([gain @ sense(force).ravel() for force in forces])
    stated_dof = np.linalg.norm(effects, axis=1) * 0.01
    # variance of a variance, 2/runs, at four standard deviations, and second order of 0.01°
    assert_allclose(drawn.std(axis=0), stated_dof, rtol=4 * math.sqrt(0.5 / runs) + 1e-3)


def test_each_contribution_by_hand():
    """Quantities whose effect is known without any estimator."""
    tables = {
        "gravity": {"value": GRAVITY, "u": 2e-4},
        "gain": {"U": 4e-5, "k": 2},
        "offset": {"half_width": 3e-4, "distribution": "triangular"},
        "temperature": {"u": 0.5, "bias_per_degC": 1e-4, "scale_per_degC": -2e-4},
    }
    c = calibrate("song-qin-6", reading_sd=1e-4, budget=tables)
    rows = {row.quantity: row for row in evaluate_budget(c).rows}
    degree = np.array([term.force_degree for _, term in c.model.keys])
    assert_allclose(
        rows["gravity"].contribution, degree * np.abs(c.parameters) * 2e-4 / GRAVITY, atol=1e-18
    )
    assert_allclose(rows["gain"].contribution, np.abs(c.parameters) * 2e-5, atol=1e-18)
    bias = degree == 0
    assert_allclose(rows["offset"].contribution[bias], 3e-4 / math.sqrt(6))
    assert_allclose(rows["offset"].contribution[~bias], 0.0, atol=1e-18)
    assert_allclose(rows["temperature"].contribution[bias], 0.5e-4)
    linear = degree == 1
    assert_allclose(rows["temperature"].contribution[linear], 1e-4 * np.abs(c.parameters[linear]))
    total = sum(row.contribution**2 for row in evaluate_budget(c).rows)
    assert_allclose(c.u**2, total)
    # of Welch and Satterthwaite, all but the noise known on infinitely many
    own = [row for row in evaluate_budget(c).rows if row.quantity == "readings"]
    noise = sum(row.contribution for row in own)  # each output's stand in a row of their own
    assert_allclose(c.parameter_dof, c.dof[0] * (c.u / noise) ** 4)


@pytest.mark.parametrize(
    ("size", "u"),
    [
        ({"half_width": 3.0}, 3 / math.sqrt(3)),
        ({"half_width": 3.0, "distribution": "rectangular"}, 3 / math.sqrt(3)),
        ({"half_width": 3.0, "distribution": "triangular"}, 3 / math.sqrt(6)),
        ({"half_width": 3.0, "distribution": "arcsine"}, 3 / math.sqrt(2)),
        ({"U": 3.0, "k": 2.58}, 3 / 2.58),
        ({"u": 3.0}, 3.0),
    ],
)
def test_sizes_of_a_budget_by_hand(size, u):
    """JCGM 100, 4.3.3, 4.3.7 and 4.3.9; the variance of an arcsine law of half-width a is a²/2."""
    # eq. (1) of uncertainty.budgets
    assert read_budget({"gain": size}).quantities["gain"].u == pytest.approx(u, rel=1e-15)


def test_a_temperature_term_of_the_model_is_used():
    given = read_scheme("dual-axis-48")
    temperature = np.linspace(10.0, 40.0, 48)
    values = sense(given.up) + 2e-3 * temperature[:, None]
    readings = mp.Readings(values, unit="g", environment={"temperature": temperature})
    c = mp.fit(
        readings,
        scheme="dual-axis-48",
        model="1 + x + y + z + own^2 + temperature",
        reading_sd=1e-4,
        budget={"temperature": {"u": 0.5}},
    )
    row = evaluate_budget(c).rows[-1]
    # a thermometer that is off in common shifts the bias by minus the coefficient per degree
    assert_allclose(row.contribution[:6], [1e-3, 0, 0, 0, 0, 0], atol=1e-12)


def test_what_the_residuals_show_is_not_added_again():
    tables = {"orientation": {"u_deg": 0.01}, "resolution": {"step": 1e-4}}
    estimated = calibrate(noise=1e-3, budget=tables)
    plain = calibrate(noise=1e-3)
    assert_allclose(estimated.covariance, plain.covariance, rtol=1e-12)
    # so does the scatter beside a stated noise, but not a noise that is known beforehand
    stated_dof = calibrate(noise=1e-3, reading_sd=1e-3)
    assert_allclose(
        mp.state_budget(stated_dof, tables).covariance, stated_dof.covariance, rtol=1e-12
    )
    known = with_known_noise(stated_dof)
    stated = mp.state_budget(known, tables)
    rows = {row.quantity: row for row in evaluate_budget(stated).rows}
    assert not rows["resolution"].contained.any()
    gain = estimator_gain(stated)
    assert_allclose(rows["resolution"].covariance, gain @ gain.T * 1e-8 / 12, atol=1e-22)
    assert (stated.u > known.u).all()


def test_index_error_has_the_stated_size_at_a_random_angle():
    given = read_scheme("roll-z-36")
    c = mp.fit(
        mp.Readings(sense(given.up)[:, :2], unit="g"), scheme="roll-z-36", inputs="x,y", axes="x,y"
    )
    quantity = read_budget({"index": {"u_deg": 0.01, "harmonics": [1, 3]}}).quantities["index"]
    moves = reading_moves(c, quantity)
    across = np.stack([-given.up[:, 1], given.up[:, 0]], axis=1)  # d up / d angle
    per_radian = across @ M[:2, :2].T + 0.0
    size = np.linalg.norm(moves, axis=2)
    assert_allclose(size, np.abs(per_radian) * math.pi / 180, atol=3e-3 * math.pi / 180)


# --- the sum and its degrees of freedom


def test_gum_g4_1_by_hand():
    """JCGM 100, G.4.1, example: relative u 0.25, 0.57, 0.82 % on 9, 4, 14 give ν_eff = 19."""
    # eq. (2) of uncertainty.propagation
    nu = float(welch_satterthwaite([0.25, 0.57, 0.82], [9, 4, 14]))
    assert round(nu, 1) == 19.0
    assert math.sqrt(0.25**2 + 0.57**2 + 0.82**2) == pytest.approx(1.03, abs=0.005)


def test_welch_satterthwaite_at_the_edges():
    assert math.isinf(welch_satterthwaite([1.0, 2.0], [math.inf, math.inf]))
    assert math.isinf(welch_satterthwaite([0.0, 0.0], [1, 2]))
    assert float(welch_satterthwaite([2.0, 0.0], [3, 1])) == pytest.approx(3.0)
    assert math.isinf(welch_satterthwaite([1e39, 1e-40], [math.inf, 2.0]))  # 2e316 says the same


def test_infinite_degrees_of_freedom_of_a_budget_can_be_read_back(tmp_path):
    said, unsaid = (
        calibrate(noise=1e-3, budget={"gain": {"u": 2e-3, **dof}})
        for dof in ({"dof": math.inf}, {})
    )
    said.save(tmp_path / "cal.json")
    assert_allclose(mp.load(tmp_path / "cal.json").covariance, unsaid.covariance, rtol=1e-15)


def test_effective_degrees_of_freedom_of_a_parameter():
    c = calibrate("song-qin-6", noise=1e-3, budget={"gain": {"u": 2e-3, "dof": 5}})
    plain = calibrate("song-qin-6", noise=1e-3)
    i = c.names.index("scale_ax")
    a, b = plain.u[i], 2e-3 * abs(c.parameters[i])
    assert c.u[i] == pytest.approx(math.hypot(a, b), rel=1e-12)
    assert c.parameter_dof[i] == pytest.approx((a * a + b * b) ** 2 / (a**4 / 1 + b**4 / 5))


def test_the_budget_travels_with_the_file(tmp_path):
    tables = {"gravity": {"value": GRAVITY, "u": 2e-4, "dof": 8}, "level": {"u_deg": 0.01}}
    c = calibrate("song-qin-6", noise=1e-3, budget=tables)
    c.save(tmp_path / "c.json")
    again = mp.load(tmp_path / "c.json")
    before, after = evaluate_budget(c), evaluate_budget(again)
    assert [row.quantity for row in before.rows] == [row.quantity for row in after.rows]
    for one, two in zip(before.rows, after.rows, strict=True):
        assert_allclose(one.covariance, two.covariance, rtol=1e-9, atol=1e-25)
    assert_allclose(after.dof, c.parameter_dof, rtol=1e-9)
    rows = read_json(tmp_path / "c.json", "multipos/calibration/1")["budget"]["rows"]
    assert [row["quantity"] for row in rows] == ["readings"] * 3 + ["gravity", "level"]
    assert rows[3]["dof"] == 8
    assert rows[3]["contribution"]["scale_ax"] == pytest.approx(before.rows[3].contribution[1])


def test_another_budget_can_be_asked_of_a_finished_calibration():
    c = calibrate(noise=1e-5, budget={"gain": {"u": 1e-5}})
    other = state_budget(c, {"level": {"u_deg": 0.001}})
    direct = calibrate(noise=1e-5, budget={"level": {"u_deg": 0.001}})
    assert_allclose(other.covariance, direct.covariance, rtol=1e-6, atol=1e-20)


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
def test_coverage_of_budgeted_intervals():
    """Scatter and a common gravity drawn anew each run: U covers as often as it says."""
    rng = np.random.default_rng(12)
    runs, inside, u_g = 1500, 0, 3e-3
    truth = np.array([*(np.column_stack([BIAS, M, K2])).ravel()])
    given = read_scheme("faces-corners-14")
    for _ in range(runs):
        true_g = GRAVITY + u_g * rng.standard_normal()
        force = given.up * true_g / 9.80665
        values = sense(force) + 2e-4 * rng.standard_normal((14, 3))
        c = mp.fit(
            mp.Readings(values, unit="g"),
            scheme="faces-corners-14",
            model="own-quadratic",
            budget={"gravity": {"value": GRAVITY, "u": u_g}},
        )
        inside += abs(c.parameters[1] - truth[1]) <= c.U[1]
    assert inside / runs == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / runs))


# --- over the sphere and beyond


def test_sphere_of_a_linear_fit_by_hand():
    up = read_scheme("faces-6").up
    c = with_known_noise(mp.fit(mp.Readings(up, unit="g"), scheme="faces-6", reading_sd=1e-3))
    # u² of force = u_bias² + f² u_scale², 1/6 + 1/2 at |f| = 1 in any direction
    found = evaluate_sphere(c)
    expected = 1e-3 * math.sqrt(1 / 6 + 1 / 2)
    for entry in found["force"].values():
        assert entry["worst"] == pytest.approx(expected, rel=1e-9)
        assert entry["k"] == pytest.approx(1.959964, abs=1e-6)
        assert entry["rms"] == pytest.approx(expected, rel=1e-9)
    # at 1 g the error across up turns it: the same size in radians, along any horizontal axis
    for entry in found["tilt_deg"].values():
        assert entry["worst"] == pytest.approx(math.degrees(expected), rel=1e-9)


def test_an_unseen_third_order_term_grows_beyond_what_was_applied():
    c = calibrate("faces-6", reading_sd=1e-5, budget={"third_order": {"u": 1e-3}})
    size = np.array([[1.0, 0, 0], [-1.0, 0, 0], [2.0, 0, 0], [5.0, 0, 0]])
    u = np.sqrt(unseen_covariance(c, size, {})[:, 0, 0])
    # x³ at the six faces looks like x: what is left is κ (f³ − f) along the own axis
    assert_allclose(u[:2], 0.0, atol=1e-15)
    assert_allclose(u[2:], [1e-3 * 6, 1e-3 * 120], rtol=0.02)
    raw = dict(zip(c.outputs, c.predict(size).T, strict=True))
    applied = mp.apply(c, raw, uncertainty=True, parameters_only=True)
    assert applied["u_f_x"][3] > u[3]


def test_degrees_of_freedom_beyond_what_was_applied_by_hand():
    """At 2 g 6 κ is added to u, known for certain: ν = 2 ((u² + 36 κ²)/u²)²."""
    # eq. (1) of uncertainty.unseen_terms
    up = read_scheme("faces-6").up
    values = up + 1e-5 * np.random.default_rng(1).standard_normal(up.shape)
    how = {"scheme": "faces-6", "model": "linear"}
    plain = evaluate_sphere(
        mp.fit(mp.Readings(values), **how, **KNOWN), size=2.0, directions="faces-6"
    )
    beyond = mp.fit(mp.Readings(values), budget={"third_order": {"u": 2e-6}}, **how, **KNOWN)
    for axis, entry in evaluate_sphere(beyond, size=2.0, directions="faces-6")["force"].items():
        u2 = plain["force"][axis]["worst"] ** 2
        assert plain["force"][axis]["dof"] == pytest.approx(2.0)
        # the sensor is nominal to some 1e-5
        assert entry["worst"] ** 2 == pytest.approx(u2 + 36 * 2e-6**2, rel=1e-3)
        assert entry["dof"] == pytest.approx(2 * ((u2 + 36 * 2e-6**2) / u2) ** 2, rel=1e-3)


def test_a_third_order_term_that_was_fitted_is_not_unseen():
    c = calibrate(
        "icosahedron-12", model="own-cubic", reading_sd=1e-5, budget={"third_order": {"u": 1e-3}}
    )
    assert_allclose(unseen_covariance(c, np.array([[3.0, 1.0, 2.0]]), {}), 0.0, atol=1e-24)


# --- files and options that are at fault


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[leveling]\nu_deg = 1", "[leveling]: no such quantity; a budget has gravity, level"),
        ("[level]\nu = 1", "[level]: unknown key 'u'; it takes u_deg, U_deg, k"),
        ("[level]\n", "give one of 'u_deg', 'U_deg' with 'k', or 'half_width_deg'; there is none"),
        ("[gain]\nu = 1\nU = 2\nk = 2", "there is 'u' and 'U'"),
        ("[gain]\nU = 2", "'U' needs its coverage factor 'k'"),
        ("[gain]\nU = 2\nk = 0", "'k' must be above 0"),
        ("[gain]\nu = 2\nk = 2", "'k' belongs to 'U'"),
        ("[gain]\nu = -1", "'u' must be 0 or more, got -1"),
        ("[gain]\nu = 'x'", "'u' must be a number, got 'x'"),
        ("[gain]\nu = inf", "'u' must be a number, got inf"),
        ("[orientation]\nu_deg = 1e308", "'u_deg' must be no more than 1e+40, got 1e+308"),
        ("[gravity]\nvalue = 5\nu = 1e300", "'u' must be no more than 1e+40, got 1e+300"),
        ("[gain]\nU = 1\nk = 1e-300", "'k' is 1e-300, too small for a coverage factor"),
        ("[gain]\nu = 1\ndof = 0", "'dof' must be above 0"),
        ("[gain]\nu = 1\ndof = 1e-9", "'dof' must be above 0, at least 0.1, got 1e-09"),
        ("[gain]\nu = 1\ndof = 1e300", "'dof' must be no more than 1e+40"),
        ("[gain]\nhalf_width = 1\ndistribution = 'normal'", "has no half-width"),
        ("[gain]\nu = 1\ndistribution = 'flat'", "unknown distribution 'flat'"),
        ("[gain]\nu = 1\neach_output = 3", "'each_output' must be true or false"),
        ("[gravity]\nu = 1e-5", "give 'value' [m/s^2] or 'latitude_deg'"),
        ("[gravity]\nvalue = 980.1\nu = 1e-5", "must be in m/s^2, such as 9.81, got 980.1"),
        ("[gravity]\nvalue = 9.81\nheight_m = 3\nu = 1e-5", "'height_m' needs 'latitude_deg'"),
        ("[gravity]\nlatitude_deg = 95\nu = 1e-5", "`latitude` must lie between"),
        ("[index]\nu_deg = 1\nharmonics = 'a'", "'harmonics' must be whole numbers"),
        ("[index]\nu_deg = 1\naxis = 'w'", "'axis' must be x, y or z"),
        ("[resolution]\nstep = 1\nu = 1", "'step' states the size already"),
        ("[temperature]\nu = 1", "state what a degree does with 'bias_per_degC'"),
        ("gain = 3", "write it as a table"),
        ("[gain", "not valid TOML"),
    ],
)
def test_a_bad_budget_is_named(text, message, tmp_path, capsys):
    (tmp_path / "b.toml").write_text(text, encoding="utf-8")
    demo(tmp_path)
    capsys.readouterr()
    argv = fit_argv(tmp_path, "--budget", str(tmp_path / "b.toml"), "-o", str(tmp_path / "c.json"))
    assert main(argv) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("multipos: error: ")
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "c.json").exists()


def demo(folder):
    assert main(["demo", "-o", str(folder)]) == 0


def fit_argv(folder, *options):
    return [
        "fit",
        str(folder / "readings.csv"),
        "--scheme",
        "song-qin-6",
        "--model",
        "own-quadratic",
        "--convention",
        "gravity",
        *options,
    ]


@pytest.mark.parametrize("headings", ["worst", "fixed", "random"])
def test_a_level_without_headings_is_covered_at_all_of_them(headings):
    """A table tilted by .3° (sd), under positions whose headings only the truth has.

    The worst for `cross_ax_y` turn every position so that its error adds up; u is then no smaller
    than the spread of the estimate over tables, and no larger than √3 of it.
    """
    rng = np.random.default_rng(5)
    up = mp.read_scheme("faces-corners-14").up
    n, u, trials = len(up), np.radians(0.3), 400
    level = {"level": {"u_deg": 0.3}}
    cal = calibrate("faces-corners-14", noise=1e-5, model="linear", budget=level)
    assert [f.level for f in cal.findings if f.code == "open-headings"] == ["note"]
    east = np.cross(up, np.array([0.3, 0.5, 0.8]))
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    frames = np.stack([east, np.cross(up, east)], axis=2)
    weights = np.linalg.pinv(np.column_stack([np.ones(n), up]))  # (4, n): bias and slopes of x
    of_tilt = np.einsum("k,ki->ki", weights[2], np.cross(frames, up[:, :, None], axis=1)[:, 0])
    turn = np.arctan2(of_tilt[:, 1], of_tilt[:, 0]) if headings == "worst" else np.zeros(n)
    errors = []
    for _ in range(trials):
        if headings == "random":
            turn = rng.uniform(0.0, 2.0 * np.pi, n)
        c, s = np.cos(turn), np.sin(turn)
        t = u * rng.standard_normal(2)
        by_heading = np.stack([c * t[0] - s * t[1], s * t[0] + c * t[1]], axis=1)
        tilted = up + np.cross(np.einsum("nij,nj->ni", frames, by_heading), up)
        errors.append(weights @ tilted[:, 0] - [0.0, 1.0, 0.0, 0.0])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    said = [cal[name].u for name in ("bias_ax", "scale_ax", "cross_ax_y", "cross_ax_z")]
    sampling = 1.0 + 2.0 / np.sqrt(2.0 * trials)
    assert (spread <= np.array(said) * sampling).all()
    if headings == "worst":
        assert said[2] <= np.sqrt(3.0) * spread[2] * sampling


def test_index_needs_a_shaft():
    quaternion = {
        "qw": np.full(4, 0.9),
        "qx": [0.1, 0.2, 0.3, 0.4],
        "qy": [0.3, -0.2, 0.1, 0.5],
        "qz": [0.2, 0.5, -0.7, 0.1],
    }
    columns = {**quaternion, "ax": [0.1, 0.5, 0.2, -0.3]}
    with pytest.raises(MultiposError, match="name the axis along the shaft"):
        mp.fit(columns, model="1 + x", reading_sd=0.1, budget={"index": {"u_deg": 0.01}})
    mp.fit(columns, model="1 + x", reading_sd=0.1, budget={"index": {"u_deg": 0.01, "axis": "z"}})


def test_gravity_is_stated_once():
    with pytest.raises(UsageError, match="both state"):
        calibrate("song-qin-6", gravity=9.8, budget={"gravity": {"value": 9.81, "u": 1e-5}})


def test_gravity_of_the_budget_is_used(tmp_path, capsys):
    (tmp_path / "b.toml").write_text(
        "[gravity]\nlatitude_deg = 45\nheight_m = 100\nhalf_width = 3e-4\n", encoding="utf-8"
    )
    demo(tmp_path)
    target = tmp_path / "c.json"
    assert main(fit_argv(tmp_path, "--budget", str(tmp_path / "b.toml"), "-o", str(target))) == 0
    capsys.readouterr()
    gravity = mp.load(target).gravity
    assert gravity.value == pytest.approx(mp.normal_gravity(45.0, 100.0), rel=1e-15)
    assert gravity.u == pytest.approx(3e-4 / math.sqrt(3))


def test_a_file_whose_parameters_nothing_determines_is_refused(tmp_path):
    up = read_scheme("all-26").up
    noise = 1e-4 * np.random.default_rng(2).standard_normal(up.shape)
    found = mp.fit(mp.Readings(up + noise, up=up), model="each = b + s*own/(1 + k*own^2)", **KNOWN)
    content = found.to_dict()
    content["own_model"]["outputs"]["each"] = "0*b + s*own/(1 + k*own^2)"  # b is in no reading
    path = tmp_path / "cal.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(mp.MultiposError, match="do not determine its parameters"):
        evaluate_budget(mp.load(path))


def test_a_stated_resolution_is_the_least_noise_of_readings():
    """JCGM 100, F.2.2.1: readings that repeat on a step q are known to q/√12 and no better."""
    up = mp.read_scheme("icosahedron-12").up
    rng, step = np.random.default_rng(1), 1e-3
    found = []
    for noise in (1e-6, 3e-3):
        values = up + noise * rng.standard_normal(up.shape)
        readings = mp.Readings(values, up=up, unit="g")
        budget = {"resolution": {"step": step}}
        pair = [mp.fit(readings, **KNOWN), mp.fit(readings, budget=budget, **KNOWN)]
        found.append([c["bias_ax"] for c in pair])
    quiet, loud = found
    assert quiet[0].u < 1e-6 < quiet[1].u
    # the mean of twelve; residuals of a rounding say nothing more
    assert quiet[1].u == pytest.approx(step / np.sqrt(12.0) / np.sqrt(12.0), rel=0.1)
    assert loud[1].u == pytest.approx(loud[0].u, rel=1e-12)


def test_tilt_follows_force_as_differences_say():
    # eq. (1) of uncertainty.sphere
    force = np.random.default_rng(7).standard_normal((6, 3))
    found = sphere._tilt_gradient(force)
    for i in range(3):
        others = [k for k in range(3) if k != i]

        def tilt(f, i=i, others=others):
            return np.arctan2(f[:, i], np.hypot(*f[:, others].T))

        for j in range(3):
            step = 1e-6 * np.eye(3)[j]
            slope = (tilt(force + step) - tilt(force - step)) / 2e-6
            assert_allclose(found[:, i, j], slope, rtol=0, atol=1e-8)


@pytest.mark.parametrize("model", ["own-quadratic", "each = b + s*own/(1 + k*own^2)"])
def test_parameters_follow_gravity_as_fits_with_another_one_do(model):
    """Readings of g + dg fitted with g are, but for the sign, those of g fitted with g + dg."""
    # eq. (3) of estimation.gains
    up = mp.read_scheme("all-26").up
    values = 0.02 + up / (1.0 + 0.03 * up**2) + 0.01 * up**2
    values += 1e-7 * np.random.default_rng(1).standard_normal(up.shape)
    step = 1e-4
    low, cal, high = (
        mp.fit(mp.Readings(values, up=up, unit="g"), model=model, gravity=9.8 + s * step)
        for s in (-1.0, 0.0, 1.0)
    )
    slopes = (low.parameters - high.parameters) / (2.0 * step)
    found = gravity_effect(cal)
    if model == "own-quadratic":
        assert_allclose(found, slopes, rtol=0, atol=1e-6)
    else:  # which the terms of second order leave residuals of: J f is that of the model
        assert_allclose(found, slopes, rtol=0, atol=2e-3)
    assert np.abs(found).max() > 0.09  # a scale factor of 1 over 9.8


def test_unseen_terms_are_read_by_their_kind():
    (found,) = read_budget({"unseen": {"own^3": 2e-4, "own^2": 1e-4}}).quantities.values()
    assert dict(found.settings) == {"own^2": 1e-4, "own^3": 2e-4}
    assert (found.u, found.unit, found.dof) == (1.0, "g", math.inf)
    with pytest.raises(MultiposError, match="unknown kind of term 'own'"):
        read_budget({"unseen": {"own": 1e-4}})


@pytest.mark.parametrize("size", [1e-9, 0.3, 3.0])
def test_vectors_are_turned_as_by_scipy(size):
    vectors = size * mp.read_scheme("fibonacci-12").up
    force = mp.read_scheme("icosahedron-12").up.copy()
    by_scipy = Rotation.from_rotvec(vectors).apply(force)
    np.testing.assert_allclose(turned(force, vectors), by_scipy, atol=1e-14)


def test_trials_go_on_until_averages_are_stable():
    """Equal blocks stay the same: as many as 100/(1 − p) and the first take; others never end."""
    block = np.random.default_rng(1).standard_normal((_BLOCK // 2, 1))
    done, stable = _until_stable(iter([block] * 9), 0.95, np.ones(1), np.full(1, 1e-6))
    assert (stable, len(done)) == (True, 2)
    fewest = 100.0 / (1.0 - 0.9999)
    blocks = int(np.ceil(fewest / len(block)))
    done, stable = _until_stable(iter([block] * 999), 0.9999, np.ones(1), np.full(1, 1e-6))
    assert (stable, len(done)) == (True, blocks)
    moving = iter([block + k for k in range(6)])
    done, stable = _until_stable(moving, 0.95, np.ones(1), np.full(1, 1e-6))
    assert (stable, len(done)) == (False, 6)

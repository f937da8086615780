"""One fit from a perfect table to a hand-held sensor: its limits, its figures and what it says."""

import json
import math
import re
import time
from dataclasses import replace
from types import SimpleNamespace

import log_bench
import numpy as np
import pytest
from amounts import exactly, few_and_many, rest_slow
from findings_bench import texts
from numpy.testing import assert_allclose
from orientation_bench import (
    BIAS,
    MATRIX,
    QUADRATIC,
    Sensor,
    lower,
    readings_of,
    scatter,
)
from scipy.optimize import least_squares

import multipos as mp
from multipos.estimation.gains import restate, return_to_optimum, uncertain_gain
from multipos.estimation.identifiability import (
    CANDIDATES,
    condition,
    helpful_positions,
    plausible_range,
)
from multipos.estimation.robustness import _huber_factor
from multipos.estimation.starts import _require_sphere
from multipos.estimation.uncertain import _scale_bias
from multipos.numerics.quantiles import chi2_quantile, f_tail
from multipos.numerics.rotations import rotation_matrix, step_on_sphere, tangent_basis
from multipos.positions.scheme import read_scheme
from multipos.sensor.model import build_model
from multipos.song_qin import TABLE_2

UP = read_scheme("fibonacci-24").up
SENSOR = Sensor()
SPREAD = read_scheme("all-26+roll-x-24").up  # whole attitudes are not needed of these


def rng():
    return np.random.default_rng(24)


def parts(cal):
    """Return the bias and the matrix, gauge undone, of a linear model."""
    linear = cal.model.linear_map({}) @ cal.parameters
    return linear[:, 0], linear[:, 1:]


def close(cal, truth, times=4.0):
    """Each parameter within so many u of the truth: 4 u fail once in 16,000 draws."""
    return bool((np.abs(cal.parameters - truth) < times * cal.u).all())


# --- the limits of the one likelihood


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_no_orientation_error_is_the_linear_fit_exactly(model):
    readings = readings_of(SENSOR, UP, rng())
    known = exactly(readings, model=model)
    zero = exactly(readings, model=model, orientation_sd=0.0)
    assert zero.estimator == "linear"
    assert (zero.parameters == known.parameters).all()
    assert (zero.covariance == known.covariance).all()


@pytest.mark.parametrize("model", ["linear", "own-quadratic"])
def test_small_orientation_error_tends_to_the_linear_fit(model):
    readings = readings_of(SENSOR, UP, rng())
    known = exactly(readings, model=model, reading_sd=1e-5)
    for sd_deg in (1e-5, 1e-7, 1e-9):
        # the prior's pull is (s/sigma)² of a residual, and s is a centre: up to e^1.1 of it twice
        tolerance = 20.0 * (np.radians(sd_deg) / 1e-5) ** 2
        small = exactly(readings, model=model, reading_sd=1e-5, orientation_sd=sd_deg)
        assert small.estimator == "uncertain-orientation"
        assert_allclose(small.parameters, known.parameters, rtol=0, atol=1e-5 * tolerance + 2e-15)
        assert_allclose(small.U, known.U, rtol=tolerance + 1e-3)  # two integrals, other nodes
        # of the tiny angles each is a residual's (s/sigma)², of readings up to 3 sigma off
        assert_allclose(small.reference, known.reference, atol=4e-5 * tolerance + 1e-15)


@pytest.mark.parametrize("sd_deg", [1e-300, 1e-20, 5e-324])
def test_an_error_below_the_rounding_of_a_direction_is_none(sd_deg):
    readings = readings_of(SENSOR, "all-26", rng())
    known = exactly(readings)
    listed = replace(readings, orientation_sd=np.full(len(readings), np.radians(sd_deg)))
    for small in (
        exactly(readings, orientation_sd=sd_deg),
        exactly(readings, level_sd=sd_deg),
        exactly(listed),
    ):
        assert small.estimator == "linear"
        assert (small.parameters == known.parameters).all()
        assert_allclose(small.covariance, known.covariance, rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize("orientation_sd", [0.5, "auto"])
def test_as_many_equations_as_unknowns_leave_no_uncertainty(orientation_sd):
    four = readings_of(SENSOR, read_scheme("faces-6").up[[0, 1, 2, 4]], rng())
    cal = mp.fit(four, orientation_sd=orientation_sd)
    assert_allclose(cal.residuals, 0.0, atol=1e-12)
    assert np.isnan(cal.u).all()
    assert any("no residuals to estimate the uncertainty" in w for w in texts(cal))
    if orientation_sd == "auto":
        cal = mp.fit(four, orientation_sd="auto", reading_sd=1e-5)
        assert np.isnan(cal.u).all()
        assert any("estimate the orientation sd from" in w for w in texts(cal))


def test_a_tilt_that_explains_all_residuals_leaves_finite_uncertainties():
    # One residual in five parameters, which the tilt of the table can take whole.
    one = mp.Readings(TABLE_2[:, :1], outputs=("ax",))
    cal = exactly(one, model="own-quadratic", scheme="song-qin-6", level_sd=0.5)
    assert np.isfinite(cal.u).all()


def test_a_model_that_feels_no_force_is_not_moved_by_a_level():
    readings = mp.Readings(TABLE_2)
    cal = mp.fit(readings, model="1", scheme="song-qin-6", level_sd=0.05)
    assert_allclose(cal.parameters, readings.values.mean(axis=0), rtol=1e-9)


@pytest.mark.parametrize("loss", ["huber", "soft-l1", "cauchy"])
def test_robust_noise_ends_at_what_the_digits_tell(loss):
    up = read_scheme("fibonacci-24").up
    exact = exactly(mp.Readings(up, up=up), robust=loss)  # no residual at all
    assert_allclose(exact.residuals, 0.0, atol=1e-14)
    assert (exact.u < 1e-14).all()
    assert (exact.parameter_dof > 0.0).all()
    # Six positions 10 degrees off explain any six readings: noise has no lower end of its own.
    with pytest.raises(mp.MultiposError, match="too many positions to estimate the noise"):
        exactly(readings_of(SENSOR, "faces-6", rng()), robust=loss, orientation_sd=9.8)


@pytest.mark.parametrize("model", ["linear", "each = b + s*own + common_k*own^2"])
def test_a_robust_noise_beside_orientation_errors_is_found_or_refused_soon(model):
    """Seven positions of .5 degrees, as the fuzzer found them: U was 7e-9 g after 30 seconds."""
    up = read_scheme("corners-8").up[:7]
    values = 1.01 * up + 1e-3 * rng().standard_normal(up.shape)
    begin = time.process_time()
    if model == "linear":  # seven readings along the force, of which the model takes six or more
        with pytest.raises(mp.MultiposError, match="state --reading-sd"):
            mp.fit(mp.Readings(values, up=up), model=model, robust="cauchy", orientation_sd=0.5)
    else:
        found = mp.fit(mp.Readings(values, up=up), model=model, robust="cauchy", orientation_sd=0.5)
        assert (found.residual_sd > 2e-4).all()
        assert (found.u > 2e-4).all()
    assert time.process_time() - begin < 15
    stated = mp.fit(
        mp.Readings(values, up=up, u=np.full((7, 3), 1e-3)), robust="cauchy", orientation_sd=0.5
    )
    assert (stated.u > 2e-4).all()


@pytest.mark.parametrize("true_deg", [0.0, 0.5])
def test_robust_noise_beside_stated_orientation_errors_is_that_of_the_readings(true_deg):
    """Positions as exact as stated, or far better: no noise of a fourth, and none is set aside."""
    # eq. (2) of estimation.robustness
    random = np.random.default_rng(9)
    sizes = []
    for _ in range(3):
        up = UP + np.radians(true_deg) * np.cross(random.standard_normal(UP.shape), UP)
        values = up / np.linalg.norm(up, axis=1, keepdims=True)
        values = values + 1e-4 * random.standard_normal(up.shape)
        cal = mp.fit(mp.Readings(values, up=UP), robust="huber", orientation_sd=0.5)
        assert all(each.code != "set-aside" for each in cal.findings)
        sizes.append(cal.residual_sd.mean())
    # of 12 degrees of freedom each, √(1/24) of the size by χ², half as much again by a median
    assert 0.5e-4 < np.median(sizes) < 1.6e-4


@pytest.mark.parametrize(("sets", "most"), few_and_many((8, 2), (40, 5)))
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_fits_of_good_readings_seldom_name_an_outlier(loss, sets, most):
    """One in a hundred by chance; of 80 no more than five, of 16 than two (p < .001)."""
    random, named = np.random.default_rng(11), 0
    for _ in range(sets):
        for up in (UP, read_scheme("icosahedron-12").up):
            values = up + 1e-3 * random.standard_normal(up.shape)
            cal = mp.fit(mp.Readings(values, up=up), robust=loss)
            named += bool(cal.diagnostics.outliers)
    assert named <= most


@pytest.mark.usefixtures("without_findings")
def test_robust_fits_of_few_positions_more_than_parameters_converge():
    """Twelve positions of unknown orientation for nine parameters: weights settle slowly."""
    random, up, failed = np.random.default_rng(2), read_scheme("icosahedron-12").up, 0
    for _ in range(20):
        values = up + 1e-3 * random.standard_normal(up.shape)
        try:
            mp.fit(mp.Readings(values), unknown_orientation=True, robust="huber")
        except mp.ConvergenceError:
            failed += 1
    assert failed <= 1


def test_unknown_orientations_need_scale_factors():
    readings = mp.Readings(readings_of(SENSOR, UP, rng()).values)
    with pytest.raises(mp.MultiposError, match="need the scale factor of every output"):
        mp.fit(readings, model="own^9", unknown_orientation=True)


def test_one_position_of_unknown_orientation_is_too_few():
    with pytest.raises(mp.RankError, match="1 positions give 1 equations for 9 parameters"):
        mp.fit(mp.Readings([[0.1, 0.2, 0.9]]), unknown_orientation=True)


@pytest.mark.parametrize("scheme", ["fibonacci-24", "all-26"])
def test_large_orientation_error_tends_to_unknown_orientation(scheme):
    readings = readings_of(SENSOR, scheme, rng(), off_deg=1.0)
    large = exactly(readings, reading_sd=1e-5, orientation_sd=170.0)
    unknown = exactly(mp.Readings(readings.values), unknown_orientation=True, reading_sd=1e-5)
    (b, M), (b0, M0) = parts(large), parts(unknown)
    # the prior of 3 rad still pulls with (sigma/s)² = 1e-11 of a turn
    assert_allclose(b, b0, rtol=0, atol=1e-9)
    assert_allclose(M @ M.T, M0 @ M0.T, atol=1e-9)
    force, force0 = (c.compensate(readings.values) for c in (large, unknown))
    size, size0 = (np.linalg.norm(f, axis=1) for f in (force, force0))
    assert_allclose(size, size0, atol=1e-9)
    at = [c.names.index("bias_ax") for c in (large, unknown)]
    # two integrals over other nodes
    assert large.U[at[0]] == pytest.approx(unknown.U[at[1]], rel=1e-2)


def test_symmetric_and_lower_gauge_are_one_sensor():
    readings = mp.Readings(readings_of(SENSOR, UP, rng()).values)
    first = mp.fit(readings, unknown_orientation=True)
    second = mp.fit(readings, unknown_orientation=True, gauge="symmetric")
    assert (first.model.gauge, second.model.gauge) == ("lower", "symmetric")
    (b, L), (b2, S) = parts(first), parts(second)
    assert_allclose(L, np.tril(L), atol=0)
    assert_allclose(S, S.T, atol=0)
    assert_allclose(b2, b, rtol=0, atol=1e-12)
    assert_allclose(S @ S.T, L @ L.T, atol=1e-12)
    assert second.rms == pytest.approx(first.rms, rel=1e-9)
    assert first.u[first.names.index("bias_ay")] == pytest.approx(
        second.u[second.names.index("bias_ay")], rel=1e-6
    )
    assert {p["name"] for p in first.to_dict()["parameters"]}.isdisjoint(
        {"cross_ax_y", "cross_ax_z", "cross_ay_z"}
    )


@pytest.mark.parametrize("gauge", ["lower", "symmetric"])
@pytest.mark.parametrize("model", ["linear", "own-quadratic", "own-cubic"])
def test_unknown_orientation_finds_the_sensor(model, gauge):
    root = lower(MATRIX)
    if gauge == "symmetric":
        values, vectors = np.linalg.eigh(MATRIX @ MATRIX.T)
        root = vectors * np.sqrt(values) @ vectors.T
    sensor = Sensor(matrix=root, quadratic=QUADRATIC if model != "linear" else np.zeros(3))
    readings = readings_of(sensor, "fibonacci-48", rng())
    cal = exactly(mp.Readings(readings.values), unknown_orientation=True, model=model, gauge=gauge)
    truth = sensor.truth(cal.model)
    truth[[str(term)[1:] == "^3" for _, term in cal.model.keys]] = 0.0
    assert close(cal, truth)
    # outputs whose noise may be unequal leave a parameter of one of them fewer than all together
    assert (cal.parameter_dof <= 48 - len(truth)).all()
    assert (cal.parameter_dof > (48 - len(truth)) / 3).all()
    assert cal.criterion == "maximum likelihood of the readings, equal reading noise"


def test_temperature_terms_go_with_the_gauge():
    t = np.linspace(-10.0, 50.0, 48)
    force = read_scheme("fibonacci-48").up
    matrix = lower(MATRIX)
    drift = 1e-4 * np.array([[1.0, 0, 0], [0.3, -2.0, 0], [0.1, 0.4, 1.5]])
    values = BIAS + force @ matrix.T + t[:, None] * (force @ drift.T)
    readings = mp.Readings(
        values + 1e-5 * rng().standard_normal(values.shape), environment={"temperature": t}
    )
    model = "1 + x + y + z + temperature*x + temperature*y + temperature*z"
    for gauge in ("lower", "symmetric"):
        cal = mp.fit(readings, model=model, unknown_orientation=True, gauge=gauge)
        assert len(cal.parameters) == 3 + 6 + 6
        assert cal.rms < 3e-5
    cal = mp.fit(readings, model=model, unknown_orientation=True)
    assert abs(cal["ay", "temperature*x"].value - 3e-5) < 4.0 * cal["ay", "temperature*x"].u


# --- real recordings


def shared(name):
    return mp.read_readings(log_bench.shared(name))


def joint_f(readings):
    """Return rms without and with K2, and the p value of the joint F-test of K2."""
    without = mp.fit(readings, unknown_orientation=True)
    with_k2 = mp.fit(readings, unknown_orientation=True, model="own-quadratic")
    rss, rss2 = (float(np.sum(c.residuals**2)) for c in (without, with_k2))
    nu = len(readings) - len(with_k2.parameters)
    f = (rss - rss2) / 3.0 / (rss2 / nu)
    return without.rms, with_k2.rms, f_tail(f, 3, nu)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (13107.0, 32768.25), (-0.66, 1.65)])
@pytest.mark.parametrize("gauge", ["lower", "symmetric"])
def test_innalabs_as_three_programs_found_it(gain, offset, gauge):
    readings = shared("innalabs_24.csv")
    readings = mp.Readings(offset + gain * readings.values, outputs=readings.outputs)
    cal = mp.fit(readings, unknown_orientation=True, gauge=gauge)
    bias = np.array([cal[output, "1"].value for output in cal.outputs])
    # all printed digits of the maximum likelihood line
    assert_allclose((bias - offset) / gain, [0.000856, -0.005183, 0.013553], atol=5.1e-7)
    assert cal.rms == pytest.approx(425.62e-6, abs=5.1e-9)
    assert (cal.parameters[list(cal.model.own_scales)] > 0.0).all()


@pytest.mark.parametrize(
    ("name", "without", "with_k2", "p"),
    [
        ("pointer_ee_24.csv", 583e-6, 205e-6, 1e-5),
        ("pointer_ab_24.csv", 688e-6, 345e-6, 7e-4),
        ("innalabs_24.csv", 426e-6, 319e-6, 0.07),
    ],
)
def test_second_order_is_kept_by_the_pointers_only(name, without, with_k2, p):
    found = joint_f(shared(name))
    assert found[:2] == pytest.approx((without, with_k2), abs=0.51e-6)
    assert found[2] == pytest.approx(p, rel=0.05)
    assert (found[2] < 0.05) == name.startswith("pointer")


# --- noise: stated, denied, estimated


def test_stated_noise_weighs_unequal_axes():
    sd = np.array([1e-5, 1e-4, 3e-5])
    sensor = Sensor(matrix=lower(MATRIX))
    values = sensor.read(UP) + sd * rng().standard_normal(UP.shape)
    cal = mp.fit(mp.Readings(values), unknown_orientation=True, reading_sd=sd)
    assert close(cal, sensor.truth(cal.model))
    assert (cal.parameter_dof > 24 - 9).all()  # what is stated tells more than residuals alone
    assert cal["ay", "1"].u > 1.5 * cal["ax", "1"].u
    u = mp.fit(mp.Readings(values, u=np.tile(sd, (24, 1))), unknown_orientation=True)
    assert (u.parameters == cal.parameters).all()


@pytest.mark.parametrize("mode", ["unknown", "uncertain"])
def test_denied_noise_is_added_to_and_said(mode):
    readings = readings_of(Sensor(matrix=lower(MATRIX)), UP, rng(), sd=1e-4, off_deg=0.005)
    how = {"unknown_orientation": True} if mode == "unknown" else {"orientation_sd": 0.005}
    cal = exactly(mp.Readings(readings.values, up=readings.up), reading_sd=1e-6, **how)
    honest = exactly(mp.Readings(readings.values, up=readings.up), **how)
    said = [w for w in texts(cal) if "exceed the stated noise" in w]
    assert len(said) == 1
    assert "variation between rests" in said[0]
    assert "--orientation-sd" not in said[0]  # it is given, or nothing is known of orientations
    scatter = cal.variance_components.rest_to_rest["ay"].value
    assert f"{scatter:.2g} reading" in said[0]
    # 15 or some 24 contrasts that no orientation touches
    assert scatter == pytest.approx(1e-4, rel=0.6)
    if mode == "unknown":  # a floor that is nothing is as good as none
        # but that the weights of unequal outputs are in the estimate here, and in U alone there
        assert_allclose(cal.U, honest.U, rtol=0.3)


def test_nothing_left_is_said():
    cal = mp.fit(mp.Readings(SENSOR.read(UP[::2][:9])), unknown_orientation=True)
    assert np.isnan(cal.u).all()
    assert "no-redundancy" in {each.code for each in cal.findings}
    stated = mp.fit(
        mp.Readings(SENSOR.read(UP[::2][:9])), unknown_orientation=True, reading_sd=1e-5
    )
    assert np.isfinite(stated.u).all()


def test_both_standard_deviations_are_estimated_and_how_well():
    readings = readings_of(SENSOR, UP, rng(), sd=2e-5, off_deg=0.02)
    cal = mp.fit(readings, orientation_sd="auto")
    found = cal.variance_components
    for name, truth in (("reading_sd", 2e-5), ("orientation_sd_deg", 0.02)):
        assert abs(found[name]["value"] - truth) < 3.0 * found[name]["u"]
        assert 0.05 < found[name]["u"] / found[name]["value"] < 0.35
    spread = found.orientation_sd_deg
    assert spread.low < spread.value < spread.high
    assert spread.source == "estimated"
    said = [w for w in texts(cal) if w.startswith("estimated reading noise")]
    assert "reading noise" in said[0]
    assert "orientation error" in said[0]
    assert "%" in said[0]
    # what was estimated is what the calibration carries, so that others can go on with it
    assert_allclose(
        np.degrees(cal.readings.orientation_sd), found["orientation_sd_deg"]["value"], rtol=1e-12
    )
    given = mp.fit(
        readings,
        orientation_sd=found["orientation_sd_deg"]["value"],
        reading_sd=found["reading_sd"]["value"],
    )
    # what was estimated is a floor and a centre there, beside which a little more is allowed for
    assert_allclose(cal.parameters, given.parameters, rtol=0, atol=0.2 * cal.u.max())
    assert_allclose(cal.u, given.u, rtol=0.1)
    assert (cal.parameter_dof < 200.0).all()
    loaded = cal.to_dict()["variance_components"]
    assert loaded["reading_sd"]["value"] == found["reading_sd"]["value"]


def test_beside_a_stated_noise_scatter_and_orientation_are_estimated():
    readings = readings_of(SENSOR, UP, rng(), sd=2e-5, off_deg=0.05)
    cal = exactly(readings, orientation_sd="auto", reading_sd=2e-5)
    found = cal.variance_components
    assert found.reading_sd is None
    assert found.rest_to_rest["ax"].value < 2e-5
    placed = found.orientation_sd_deg
    assert placed.determined
    assert placed.value == pytest.approx(0.05, rel=0.5)
    assert list(cal.to_dict()["variance_components"]) == ["rest_to_rest", "orientation_sd_deg"]
    (said,) = (w for w in texts(cal) if w.startswith("estimated"))
    assert f"orientation errors of {placed.value:.2g} degrees" in said
    low, high = map(float, re.search(r"\(68 %: ([\d.]+) to ([\d.]+)\)", said).groups())
    assert placed.u == pytest.approx((high - low) / 2.0, rel=0.1)  # ends are said to two digits
    six = exactly(readings_of(SENSOR, "faces-6", rng(), off_deg=0.02), orientation_sd="auto")
    assert any("noise and orientation errors are inseparable" in w for w in texts(six))


def test_noise_beside_a_tilt_of_the_table_has_the_right_size():
    """The prior of the tilt is absolute, so the noise cannot be any size."""
    scheme = read_scheme("roll-x-24+roll-y-24+roll-z-24")
    tilt = np.radians([0.2, -0.14])
    turned = scheme.rotation @ rotation_matrix(np.array([*tilt, 0.0]))
    values = SENSOR.read(turned[:, :, 2]) + 1e-5 * rng().standard_normal((72, 3))
    cal = exactly(mp.Readings(values), scheme=scheme, level_sd=0.3)
    assert_allclose(cal.residual_sd, 1e-5, rtol=0.2)
    assert close(cal, SENSOR.truth(cal.model))
    assert_allclose(cal.orientations.level_tilt_deg, np.degrees(tilt), atol=1e-3)
    tied = exactly(mp.Readings(values), scheme=scheme)
    assert tied.residual_sd.max() > 1e-3


def test_bias_of_second_order_is_stated_where_it_matters():
    noisy = readings_of(Sensor(matrix=np.eye(3)), "fibonacci-2000", rng(), sd=0.06)
    cal = mp.fit(mp.Readings(noisy.values), unknown_orientation=True)
    said = [w for w in texts(cal) if "sigma^2/g^2" in w]
    assert len(said) == 3
    assert float(said[0].split("about ")[1].split(",")[0]) == pytest.approx(0.06**2, rel=0.3)
    quiet = mp.fit(mp.Readings(readings_of(SENSOR, UP, rng()).values), unknown_orientation=True)
    assert not any("sigma^2" in w for w in texts(quiet))


def test_bias_of_second_order_by_hand():
    """Eq. (1) at g = 2: σ/(k g) = 0.005, 0.0055 and 0.012, and half of it where s² is their mean.

    Of x the others sum to 0.0055² + 0.012² = 1.7425e-4, half of that times k = 2 is 1.7425e-4.
    """
    # eq. (1) of estimation.uncertain
    model = build_model("linear", ("ax", "ay", "az"), ("x", "y", "z"))
    k, theta = np.array([2.0, 4.0, 5.0]), np.zeros(12)
    theta[list(model.own_scales)] = k
    sd, u = np.array([0.02, 0.044, 0.12]), np.full(12, 1e-6)
    mean = (0.005**2 + 0.0055**2 + 0.012**2) / 3
    for spread, stated in (
        (np.inf, ["0.00017", "0.00034", "0.00014"]),
        (np.sqrt(mean), ["8.7e-05", "0.00017", "6.9e-05"]),
    ):
        problem = SimpleNamespace(model=model, orientation_sd=np.full(5, spread))
        said = _scale_bias(problem, theta, u, sd, 2.0)
        assert [each.text.split("about ")[1].split(",")[0] for each in said] == stated
    # stated above a third of U
    unknown = SimpleNamespace(model=model, orientation_sd=np.full(5, np.inf))
    u[list(model.own_scales)] = [2.6e-4, 5.3e-4, 2.1e-4]
    assert [each.text.split("`")[1] for each in _scale_bias(unknown, theta, u, sd, 2.0)] == [
        "scale_ax",
        "scale_az",
    ]


def test_bias_of_second_order_is_what_is_stated():
    """Scale factors of a thousand fits, against eq. (1) of `uncertain`, unequal noise."""
    sd = np.array([0.02, 0.05, 0.03])
    up = read_scheme("fibonacci-3000").up
    generator = rng()
    for spread, share in ((None, 1.0), (np.degrees(0.05), None)):
        off = generator.standard_normal((3000, 2)) * (0.0 if spread is None else 0.05)
        force = step_on_sphere(up, tangent_basis(up), off)
        values = force + sd * generator.standard_normal(up.shape)
        how = {"unknown_orientation": True} if spread is None else {"orientation_sd": spread}
        cal = mp.fit(mp.Readings(values, up=up), reading_sd=sd, **how)
        for axis, output in zip("xyz", cal.outputs, strict=True):
            others = np.delete(sd, "xyz".index(axis))
            mean = float(np.mean(sd**2))
            part = 0.05**2 / (0.05**2 + mean) if share is None else share
            bias = part * float(np.sum(others**2)) / 2.0
            p = cal[output, axis]
            # eq. (1) is exact where noise is equal; a third of the bias is left for the rest
            assert abs(p.value - 1.0 - bias) < 3.0 * p.u + bias / 3.0


# --- mixed information


def test_known_uncertain_and_unknown_positions_together():
    generator = rng()
    sd_deg = np.full(24, 0.02)
    sd_deg[:4], sd_deg[4:9] = 0.0, np.nan
    force = np.where(sd_deg[:, None] == 0.0, UP, scatter(UP, 0.02, generator))
    listed = np.where(np.isnan(sd_deg)[:, None], np.nan, UP)
    values = SENSOR.read(force) + 1e-5 * generator.standard_normal(force.shape)
    readings = mp.Readings(values, up=listed, orientation_sd=np.radians(sd_deg))
    cal = mp.fit(readings, reading_sd=1e-5)
    assert cal.estimator == "uncertain-orientation"
    assert close(cal, SENSOR.truth(cal.model))
    assert_allclose(cal.reference[:4], UP[:4], atol=1e-15)
    # the unknown ones were found: as well as their two angles can be read
    assert_allclose(cal.reference[4:9], force[4:9], atol=6e-5)
    off = np.asarray(cal.orientations.orientation_error_deg)
    assert np.isnan(off[4:9]).all()
    assert (off[9:] > 0.0).all()
    # unknown positions tell less than uncertain ones, but something
    fewer = mp.fit(
        mp.Readings(
            values[sd_deg >= 0], up=UP[sd_deg >= 0], orientation_sd=np.radians(sd_deg[sd_deg >= 0])
        ),
        reading_sd=1e-5,
    )
    assert (cal.u <= fewer.u * (1.0 + 1e-9)).all()


def test_exact_positions_too_few_alone_are_helped_by_unknown_ones():
    up = np.vstack([np.eye(3), UP])
    sd = np.array([0.0, 0.0, 0.0, *[np.nan] * 24])
    values = SENSOR.read(up) + 1e-5 * rng().standard_normal(up.shape)
    listed = np.where(np.isnan(sd)[:, None], np.nan, up)
    cal = mp.fit(mp.Readings(values, up=listed, orientation_sd=sd), reading_sd=1e-5)
    assert cal.model.gauge is None
    assert close(cal, SENSOR.truth(cal.model))


def test_one_listed_position_does_not_fix_the_case():
    up = np.vstack([np.eye(3)[:1], UP])
    sd = np.array([0.0, *[np.nan] * 24])
    values = SENSOR.read(up) + 1e-5 * rng().standard_normal(up.shape)
    listed = np.where(np.isnan(sd)[:, None], np.nan, up)
    with pytest.raises(mp.RankError, match="11 of 12 parameters can be separated") as caught:
        mp.fit(mp.Readings(values, up=listed, orientation_sd=sd), reading_sd=1e-5)
    assert "add positions such as up" in str(caught.value)


def test_directions_that_differ_by_less_than_any_angle_are_refused_by_name():
    up = np.full((24, 3), 1e-150)
    up[:, 1] = np.repeat([1.0, -1.0], 12)
    readings = mp.Readings(SENSOR.read(UP), up=up, orientation_sd=np.full(24, 0.01))
    with pytest.raises(mp.RankError, match="`scale_ax` has no effect at these positions"):
        mp.fit(readings, model="1 + own")


TURN = rotation_matrix(np.array([0.7, -1.1, 0.4]))


def test_a_group_shares_one_unknown_rotation():
    """A cube with square faces, put down askew: up to a gauge, and no more."""
    values = SENSOR.read(UP @ TURN.T) + 1e-5 * rng().standard_normal(UP.shape)
    cal = mp.fit(mp.Readings(values, up=UP, group=("cube",) * 24), reading_sd=1e-5)
    sensor = Sensor(matrix=lower(MATRIX))
    assert cal.model.gauge == "lower"
    assert close(cal, sensor.truth(cal.model))
    # gauge: M T = L Q, so the rotation found is Q T
    turned = np.linalg.solve(lower(MATRIX), MATRIX) @ TURN
    found = rotation_matrix(np.radians(cal.orientations.group_rotation_deg["cube"]))
    assert_allclose(found, turned, atol=1e-4)
    alone = mp.fit(mp.Readings(values), unknown_orientation=True, reading_sd=1e-5)
    assert (cal.u < alone.u).all()


@pytest.mark.parametrize("sign", [(-1, 1, 1), (1, -1, -1), (-1, -1, -1)])
def test_outputs_that_are_said_to_face_down_do_in_groups(sign):
    """A group determines the handedness, so that an odd number of outputs reverses it."""
    matrix = np.tril(MATRIX) * sign
    values = BIAS + UP @ TURN.T @ matrix.T
    axes = [f"{'-' * (s < 0)}{axis}" for s, axis in zip(sign, "xyz", strict=True)]
    cal = mp.fit(mp.Readings(values, up=UP, group=("cube",) * 24), axes=axes)
    assert_allclose(cal.sensitivity, matrix, atol=1e-8)
    found = rotation_matrix(np.radians(cal.orientations.group_rotation_deg["cube"]))
    assert_allclose(found, TURN, atol=1e-8)
    assert_allclose(cal.reference, UP @ TURN.T, atol=1e-8)


def test_two_groups_and_listed_positions():
    other = rotation_matrix(np.array([-0.2, 0.3, 2.5]))
    force = np.vstack([UP @ TURN.T, UP @ other.T, np.eye(3)])
    values = SENSOR.read(force) + 1e-5 * rng().standard_normal(force.shape)
    readings = mp.Readings(
        values, up=np.vstack([UP, UP, np.eye(3)]), group=["a"] * 24 + ["b"] * 24 + [""] * 3
    )
    cal = mp.fit(readings, reading_sd=1e-5)
    assert close(cal, SENSOR.truth(cal.model))
    for name, turn in (("a", TURN), ("b", other)):
        found = rotation_matrix(np.radians(cal.orientations.group_rotation_deg[name]))
        assert_allclose(found, turn, atol=1e-4)
    assert list(cal.to_dict()["group_rotation_deg"]) == ["a", "b"]


@pytest.mark.parametrize("outputs", [1, 2])
def test_a_group_of_fewer_outputs_beside_listed_positions(outputs):
    """What no output senses is taken from the listed directions, where the search starts."""
    force = np.vstack([UP @ TURN.T, UP])
    values = SENSOR.read(force)[:, :outputs] + 1e-5 * rng().standard_normal((48, outputs))
    readings = mp.Readings(values, up=np.vstack([UP, UP]), group=["a"] * 24 + [""] * 24)
    cal = mp.fit(readings, reading_sd=1e-5)
    assert close(cal, SENSOR.truth(cal.model))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_group_turned_over_tells_no_less_than_its_listed_rows_alone(axis):
    """Half a turn reverses what two outputs do not sense of every listed direction."""
    turn = 2.0 * np.diag(np.eye(3)[axis]) - np.eye(3)
    values = SENSOR.read(np.vstack([UP[:6] @ turn.T, UP]))[:, :2]
    values += 1e-5 * rng().standard_normal((30, 2))
    readings = mp.Readings(values, up=np.vstack([UP[:6], UP]), group=["a"] * 6 + [""] * 24)
    cal = mp.fit(readings, reading_sd=1e-5)
    alone = mp.fit(mp.Readings(values[6:], up=UP), reading_sd=1e-5)
    assert close(cal, SENSOR.truth(cal.model))
    # the excess noise of either is another estimate, less than 1.5 times the stated
    assert (cal.u < 1.5 * alone.u).all()


def test_groups_with_a_roll_about_an_unknown_direction():
    """INTERFACE's example: rolls about a pointing direction which is not known."""
    rolls = [read_scheme(f"roll-{axis}-12").up for axis in "xyz"]
    turns = [rotation_matrix(v) for v in rng().standard_normal((3, 3))]
    force = np.vstack([up @ turn.T for up, turn in zip(rolls, turns, strict=True)])
    values = SENSOR.read(force) + 1e-5 * rng().standard_normal(force.shape)
    readings = mp.Readings(values, up=np.vstack(rolls), group=["x"] * 12 + ["y"] * 12 + ["z"] * 12)
    cal = mp.fit(readings, reading_sd=1e-5)
    assert close(cal, Sensor(matrix=lower(MATRIX)).truth(cal.model))


def test_a_group_tells_the_convention():
    values = SENSOR.read(UP @ TURN.T) + 1e-5 * rng().standard_normal(UP.shape)
    cal = mp.fit(mp.Readings(values, up=UP, group=("g",) * 24), convention="gravity")
    assert any("Fit with --convention specific-force" in w for w in texts(cal))


def test_level_sd_without_headings_is_that_of_the_worst():
    readings = readings_of(SENSOR, UP, rng())
    found = mp.fit(readings, level_sd=0.1)
    level = mp.fit(readings, budget={"level": {"u_deg": 0.1}})
    np.testing.assert_array_equal(found.covariance, level.covariance)
    assert "open-headings" in [each.code for each in found.findings]


def test_level_sd_needs_all_headings_or_none():
    readings = readings_of(SENSOR, UP, rng())
    rotation = np.full((len(UP), 3, 3), np.nan)
    rotation[1] = mp.read_scheme("dual-axis-48").rotation[0]
    with pytest.raises(mp.MultiposError, match="--level-sd needs the heading, and position '1'"):
        mp.fit(replace(readings, rotation=rotation), level_sd=0.1)


def test_level_sd_is_inside_every_u():
    scheme = read_scheme("dual-axis-48")
    readings = mp.Readings(SENSOR.read(scheme.up) + 1e-6 * rng().standard_normal((48, 3)))
    plain = exactly(readings, scheme=scheme, reading_sd=1e-6)
    level = exactly(readings, scheme=scheme, reading_sd=1e-6, level_sd=0.05)
    assert (level.u >= plain.u * (1.0 - 1e-9)).all()
    assert level.u.max() > 1.4 * plain.u.max()
    assert level.orientations.level_sd_deg == pytest.approx(0.05)


# --- robust losses

LOSSES = ["huber", "soft-l1", "cauchy"]
MODES = {
    "listed": {},
    "uncertain": {"orientation_sd": 0.005},
    "unknown": {"unknown_orientation": True},
}


@pytest.mark.parametrize("off", rest_slow([0.01, -0.1, 1.0]))
@pytest.mark.parametrize("stated", [False, True], ids=["estimated", "stated"])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loss", LOSSES)
def test_one_bad_reading_of_24_moves_nothing_and_is_named(loss, mode, stated, off):
    sensor = Sensor(matrix=lower(MATRIX))
    readings = readings_of(sensor, UP, rng(), sd=1e-4, off_deg=0.005 * (mode == "uncertain"))
    clean = mp.Readings(readings.values, up=None if mode == "unknown" else UP)
    how = MODES[mode] | ({"reading_sd": 1e-4} if stated else {})
    # along the direction: across it an unknown orientation takes any error for a turn
    worst = int(np.argmax(UP[:, 1]))
    values = readings.values.copy()
    values[worst, 1] += off
    bad = mp.Readings(values, up=clean.up)
    good = mp.fit(clean, robust=loss, **how)
    found = mp.fit(bad, robust=loss, **how)
    assert (np.abs(found.parameters - good.parameters) < found.u).all()
    assert close(found, sensor.truth(found.model))
    named = [w for w in texts(found) if "was set aside" in w]
    assert any(f"position {worst + 1} was set aside" in w for w in named)
    assert any(f"position {worst + 1}" in w for w in found.diagnostics.outliers)
    weight = np.asarray(found.robust_weight)
    assert (weight.reshape(24, -1)[worst].min()) == 0.0
    assert loss in found.criterion


@pytest.mark.parametrize(("off", "aside"), [(5.01, False), (5.04, True)])
def test_a_position_is_set_aside_at_one_in_a_million(off, aside):
    """The normal law has 1e-6 beyond 4.8916 standard deviations, both sides together.

    One of eleven readings with x up is `off` standard deviations away. Huber's loss lets it pull
    like one of 1.345, which moves the ten others by a tenth of that: 5.0261 is the limit.
    """
    up = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 11, axis=0)
    values = up[:, :1].copy()
    values[4] += 1e-3 * off
    readings = mp.Readings(values, outputs=("ax",), up=up)
    cal = mp.fit(readings, model="1 + x", robust="huber", reading_sd=1e-3)
    named = [text for text in texts(cal) if "position 5 was set aside" in text]
    assert bool(named) == aside


def test_robust_noise_makes_the_median_misfit_normal():
    """By hand, of 11 readings with x up and 11 with x down: most are ±1e-3 off, one is 20e-3 off.

    The median misfit is (1e-3/σ)², that of χ² on one degree of freedom 0.45494, and 22 readings
    leave 20 degrees: σ = 1e-3 √(22/20/0.45494) = 1.5550e-3. The bad one pulls the ten beside it by
    a tenth of 1.345 σ, so its misfit is 20/1.5550 − 0.1345 = 12.73.
    """
    up = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 11, axis=0)
    even = np.resize([1.0, -1.0], 10).tolist()
    off = 1e-3 * np.array([*even, 20.0, *even[:8], 1.0, 1.0, -2.0])  # either side without mean
    readings = mp.Readings(up[:, :1] + off[:, None], outputs=("ax",), up=up)
    cal = mp.fit(readings, model="1 + x", robust="huber")
    said = [text for text in texts(cal) if "position 11 was set aside" in text]
    assert "12.7 times the noise" in said[0]


def test_a_stated_noise_beside_a_robust_loss_is_judged_by_hand():
    """Huber's q w² is q up to c² = 3 · 1.345², and c² beyond; the reading set aside is left out."""
    up = mp.read_scheme("fibonacci-20").up
    values = 1.02 * up + 0.02 * np.random.default_rng(4).normal(size=up.shape)
    values[3] += 0.1
    options = {"orientation_sd": 1e-6, "reading_sd": 0.01, "robust": "huber"}
    cal = mp.fit(mp.Readings(values, up=up), **options)
    q = np.delete(np.sum(cal.residuals**2, axis=1) / 1e-4, 3)
    by_hand = np.sum(np.minimum(q, 3 * 1.345**2))
    assert cal.diagnostics.claim.chi2 == pytest.approx(by_hand, rel=1e-6)
    assert cal.diagnostics.claim.dof == 3 * 19 - 12


@pytest.mark.parametrize("loss", ["huber", "soft-l1", "cauchy"])
def test_a_robust_fit_at_known_orientations_is_that_of_scipy(loss):
    """Output by output, beside a stated noise that residuals do not deny; nothing is set aside."""
    up = mp.read_scheme("fibonacci-20").up
    values = 1.02 * up + 0.01 + 0.01 * np.random.default_rng(4).normal(size=up.shape)
    values[3] += 0.03
    cal = mp.fit(mp.Readings(values, up=up), reading_sd=0.012, robust=loss)
    X, c = np.column_stack([np.ones(20), up]), 2.385 if loss == "cauchy" else 1.345
    name = loss.replace("-", "_")
    for i in range(3):
        found = least_squares(
            lambda b, i=i: (values[:, i] - X @ b) / 0.012,
            np.linalg.lstsq(X, values[:, i], rcond=None)[0],
            loss=name,
            f_scale=c,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-12,
        )
        assert_allclose(cal.parameters[4 * i : 4 * i + 4], found.x, rtol=0, atol=1e-7)


def test_huber_factor_by_hand():
    """Eq. (1): q = 1, 1, 1, 4 count as 1, 1, 1 and 1.345²; ψ' is 1, 1, 1, 0 with variance 3/16."""
    # eq. (1) of estimation.robustness
    problem = SimpleNamespace(weight=np.ones(4), degrees=np.ones(4), robust="huber")
    optimum = SimpleNamespace(point=SimpleNamespace(q=np.array([1.0, 1.0, 1.0, 4.0])))
    K = 1 + 2 / 4 * (3 / 16) / (3 / 4) ** 2  # four positions, of which two parameters use up two
    wanted = K**2 * ((3 + 1.345**2) / 2) / (3 / 4) ** 2
    assert _huber_factor(problem, optimum, 2.0) == pytest.approx(wanted, rel=1e-12)


def test_without_a_loss_the_same_reading_moves_a_lot():
    readings = readings_of(SENSOR, UP, rng(), sd=1e-4)
    values = readings.values.copy()
    values[3, 1] += 0.1
    clean, bad = exactly(readings), exactly(mp.Readings(values, up=UP))
    assert (np.abs(bad.parameters - clean.parameters) / clean.u).max() > 10.0
    assert any("position 4" in text for text in bad.diagnostics.outliers)


def test_robust_outputs_are_fitted_alone_unless_pooled_or_correlated():
    generator = rng()
    values = SENSOR.read(UP) + np.array([1e-5, 1e-3, 1e-4]) * generator.standard_normal(UP.shape)
    alone = mp.fit(mp.Readings(values, up=UP), robust="huber")
    pooled = mp.fit(mp.Readings(values, up=UP), robust="huber", pool=True)
    assert alone["ay", "1"].u > 20.0 * alone["ax", "1"].u
    assert 14 < alone["ay", "1"].dof <= 20
    assert pooled["ay", "1"].u == pytest.approx(pooled["ax", "1"].u, rel=1e-6)
    assert 42 < pooled["ay", "1"].dof <= 60
    mix = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-8
    joint = mp.fit(mp.Readings(values, up=UP, covariance=np.kron(np.eye(24), mix)), robust="huber")
    at = [joint.names.index(name) for name in ("bias_ax", "bias_ay")]
    assert joint.correlation[at[0], at[1]] == pytest.approx(0.9, abs=1e-6)


# --- user-defined models

AS_LINEAR = "each = bias + cx*x + cy*y + cz*z"
SATURATING = "each = (bias + scale*own)/(1 + limit*(bias + scale*own)^2)"
TWO_SLOPES = "each = bias + scale*own*(1 + asymmetry*sign(own))"
DRIFTING = "each = bias + scale*own + drift*temperature"


@pytest.mark.parametrize("how", [{}, {"orientation_sd": 0.02}, {"orientation_sd": "auto"}])
def test_an_expression_is_the_polynomial_that_it_writes(how):
    readings = readings_of(SENSOR, UP, rng(), sd=1e-4, off_deg=0.02 * bool(how))
    known = mp.fit(readings, model="linear", **how)
    found = mp.fit(readings, model=AS_LINEAR, **how)
    assert_allclose(found.parameters, known.parameters, rtol=0, atol=1e-9)
    assert_allclose(found.u, known.u, rtol=1e-5)
    assert found.names[:4] == ("bias_ax", "cx_ax", "cy_ax", "cz_ax")


def saturating(own, bias, scale, limit):
    linear = bias + scale * own
    return linear / (1 + limit * linear**2)


@pytest.mark.parametrize(
    ("model", "truth", "columns"),
    [
        (SATURATING, (0.02, 1.01, 0.03), ()),
        (TWO_SLOPES, (0.02, 1.01, 0.004), ()),
        (DRIFTING, (0.02, 1.01, 5e-4), ("temperature",)),
    ],
)
@pytest.mark.parametrize("how", [{}, {"orientation_sd": 0.01, "reading_sd": 1e-5}])
def test_expressions_find_their_truth_and_survive_the_file(model, truth, columns, how, tmp_path):
    generator = rng()
    force = scatter(UP, 0.01 * bool(how), generator)
    t = generator.uniform(10.0, 40.0, 24)

    def output(own):
        if model == TWO_SLOPES:
            slope = np.where(own > 0, 1 + truth[2], 1 - truth[2])
            return truth[0] + truth[1] * slope * own
        if model == DRIFTING:
            return truth[0] + truth[1] * own + truth[2] * t
        return saturating(own, *truth)

    values = np.column_stack([output(force[:, i]) for i in range(3)])
    readings = mp.Readings(
        values + 1e-5 * generator.standard_normal(values.shape),
        up=UP,
        environment=dict.fromkeys(columns, t),
    )
    cal = mp.fit(readings, model=model, **how)
    assert close(cal, np.tile(truth, 3))
    cal.save(tmp_path / "cal.json")
    loaded = mp.load(tmp_path / "cal.json")
    assert_allclose(
        loaded.predict(force, readings.environment),
        cal.predict(force, readings.environment),
        rtol=0,
        atol=1e-15,
    )
    assert loaded.names == cal.names
    assert_allclose(loaded.compensate(readings.values, readings.environment), force, atol=2e-4)


def test_an_expression_survives_bad_readings():
    values = saturating(UP, 0.02, 1.01, 0.03)
    values = values + 1e-5 * rng().standard_normal(values.shape)
    values[5, 0] += 0.3
    cal = mp.fit(mp.Readings(values, up=UP), model=SATURATING, robust="soft-l1")
    assert close(cal, np.tile((0.02, 1.01, 0.03), 3))


def test_an_expression_with_a_few_unknown_positions():
    sd = np.full(24, np.radians(0.01))
    sd[4:7] = np.nan
    generator = rng()
    values = saturating(scatter(UP, 0.01, generator), 0.02, 1.01, 0.03)
    values = values + 1e-5 * generator.standard_normal(values.shape)
    cal = mp.fit(mp.Readings(values, up=UP, orientation_sd=sd), model=SATURATING, reading_sd=1e-5)
    assert close(cal, np.tile((0.02, 1.01, 0.03), 3))


def test_a_file_with_a_python_function_is_refused_in_one_line(tmp_path):
    content = mp.fit(readings_of(SENSOR, UP, rng())).to_dict()
    steps = [["input", 0, 2, 0], ["output", 0]]  # as version 0.2 wrote them
    content["expression"] = {"functions": [steps] * 3, "columns": [], "parameters": ["bias"]}
    path = tmp_path / "cal.json"
    path.write_text(json.dumps(content))
    with pytest.raises(mp.MultiposError) as caught:
        mp.load(path)
    assert str(caught.value) == (
        f"{path}: its model is a Python function, which is no longer read; fit again with the "
        "model as a formula, such as --model 'each = b + s*own'."
    )


def test_a_python_function_is_no_model():
    with pytest.raises(mp.UsageError, match="a formula or a TOML file, got function; write what"):
        mp.fit(readings_of(SENSOR, UP, rng()), model=saturating)


def test_an_expression_without_cross_terms_says_itself_where_its_axes_lie():
    values = saturating(UP, 0.02, 1.01, 0.03)
    cal = mp.fit(mp.Readings(values), model=SATURATING, unknown_orientation=True)
    assert_allclose(cal.parameters, np.tile((0.02, 1.01, 0.03), 3), rtol=0, atol=1e-7)
    assert any("no rotation of the case is free" in said for said in texts(cal))


# --- what positions cannot tell


def test_six_positions_leave_the_three_cross_terms_and_say_which_positions_reach_them():
    faces = read_scheme("faces-6").up
    values = SENSOR.read(faces) + 1e-4 * rng().standard_normal(faces.shape)
    with pytest.raises(mp.RankError) as caught:
        mp.fit(mp.Readings(values), unknown_orientation=True)
    said = str(caught.value)
    assert said.startswith("6 positions give 6 equations for 9 parameters: ")
    assert "`cross_ay_x`, `cross_az_x`, `cross_az_y` out of reach" in said
    named = [np.array(part.split(")")[0].split(","), float) for part in said.split("up (")[1:]]
    assert len(named) == 3
    added = np.vstack([faces, [CANDIDATES[np.argmax(CANDIDATES @ up)] for up in named]])
    more = SENSOR.read(added) + 1e-4 * rng().standard_normal(added.shape)
    cal = mp.fit(mp.Readings(more), unknown_orientation=True, reading_sd=1e-4)
    assert not cal.diagnostics.unidentifiable
    assert max(cal[f"a{i}", j].u for i, j in ("yx", "zx", "zy")) < 1e-3
    # without cross terms six positions are enough
    own = mp.fit(mp.Readings(values), unknown_orientation=True, model="1 + own", reading_sd=1e-4)
    assert len(own.parameters) == 6


def repeated(scheme, times=4, sd=1e-5, off_deg=0.0):
    up = np.tile(read_scheme(scheme).up, (times, 1))
    return mp.Readings(readings_of(SENSOR, up, rng(), sd=sd, off_deg=off_deg).values, up=up)


@pytest.mark.parametrize(
    ("readings", "message"),
    [
        (repeated("roll-x-24", 1), "all positions lie on one circle"),
        (repeated("faces-6"), "6 of 9 parameters can be separated from the noise: `cross_ay_x`, "),
        (repeated("dual-axis-48", 1), "`cross_ay_x` out of reach; add positions such as up "),
        (repeated("tumble-1", 24), "Turn the sensor to different positions"),
        (mp.Readings(np.zeros((24, 3))), "the readings of ax never change; turn the sensor"),
        (mp.Readings(SENSOR.read(UP[:5])), "5 positions give 5 equations for 9 parameters"),
        (mp.Readings(SENSOR.read(UP)[:, :2]), "need three outputs, one along each axis"),
    ],
    ids=["circle", "faces", "two circles", "identical", "zero", "few", "two outputs"],
)
def test_unknown_orientation_names_the_need(readings, message):
    with pytest.raises(mp.MultiposError, match=message):
        mp.fit(mp.Readings(readings.values), unknown_orientation=True)
    with pytest.raises(mp.MultiposError, match=message):
        mp.fit(mp.Readings(readings.values), unknown_orientation=True, exclude="auto")


@pytest.mark.parametrize(
    ("readings", "message"),
    [
        (repeated("roll-x-24", 1), "`scale_ax` has no effect at these positions"),
        (repeated("tumble-1", 24), "1 of 4 parameters can be separated"),
        (mp.Readings(np.zeros((24, 3)), up=UP), "the readings of ax never change"),
        (mp.Readings(SENSOR.read(UP[:3]), up=UP[:3]), "3 positions give 9 equations for 12"),
    ],
    ids=["circle", "identical", "zero", "few"],
)
def test_uncertain_orientation_names_the_need(readings, message):
    with pytest.raises(mp.MultiposError, match=message):
        mp.fit(readings, orientation_sd=0.1, reading_sd=1e-5)


def test_plausible_uncertainties_by_hand():
    """Half a scale factor at one g: of k = 4 and g = 2 that is 4, 2 and 1 by degree."""
    model = build_model("own-quadratic", ("ax", "ay", "az"), ("x", "y", "z"))
    theta = np.zeros(15)
    theta[list(model.own_scales)] = 4.0, -3.0, 5.0  # of any sign, in the mean 4
    limit = plausible_range(model, theta, 2.0)
    for term, wanted in (("1", 4.0), ("x", 2.0), ("x^2", 1.0)):
        assert limit[model.index("ax", term)] == pytest.approx(wanted, rel=1e-15)


def test_condition_by_hand():
    """Two parameters correlated by r: eigenvalues 1 ± r, whatever their units; 1e-12 is nothing."""
    units = np.outer([1.0, 1e5], [1.0, 1e5])
    assert condition(units * [[1.0, 0.6], [0.6, 1.0]]) == pytest.approx(2.0, rel=1e-9)
    for left, told in ((4e-12, True), (1e-12, False)):  # of which 1 + r makes half
        assert np.isfinite(condition(np.array([[1.0, 1.0 - left], [1.0 - left, 1.0]]))) == told


@pytest.mark.parametrize(("size", "refused"), [(0.97, False), (1.03, True)])
def test_scatter_about_the_ellipsoid_by_hand(size, refused):
    """Twelve misfits of one size r on 12 − 9: r/0.6745 √(12/3), at k = 5 and g = 2 to 20 %."""
    far = size * 0.2 * 10.0 * 0.6745 / 2.0
    problem = SimpleNamespace(
        orientation_sd=np.full(12, np.inf),
        degrees=np.ones(12),
        unknowns=9,
        values=np.zeros((12, 3)),
        reference=np.array([[0.0, 2.0, 0.0]]),
        model=SimpleNamespace(own_slopes=lambda theta, *_: dict(zip("xyz", theta, strict=True))),
        environment={},
    )
    optimum = SimpleNamespace(
        state=SimpleNamespace(theta=np.array([4.0, -5.0, 6.0])),
        point=SimpleNamespace(force=None, residuals=far * np.array([[0.6, 0.0, -0.8]] * 12)),
    )
    if refused:
        with pytest.raises(mp.MultiposError, match="deviate by 21 % from the best ellipsoid"):
            _require_sphere(problem, optimum)
    else:
        _require_sphere(problem, optimum)


def test_estimated_standard_deviations_are_said_in_words():
    readings = readings_of(SENSOR, UP, rng(), sd=1e-4, off_deg=0.01)
    cal = mp.fit(readings, orientation_sd=0.01)
    found = cal.variance_components.reading_sd
    (said,) = (w for w in texts(cal) if w.startswith("estimated"))
    assert said.startswith(
        f"estimated reading noise of {found.value:.2g} "
        f"(uncertain by {100 * found.u / found.value:.0f} %) and orientation errors of "
    )
    assert found.value == pytest.approx(1e-4, rel=0.4)
    # of a variance on ν degrees of freedom the root is known to 1/√(2ν); some 15 to 60 tell it
    assert math.sqrt(0.5 / 60) < found.u / found.value < math.sqrt(0.5 / 12)


def test_convergence_is_reported():
    cal = mp.fit(
        mp.Readings(SENSOR.read(UP) + 1e-4 * rng().standard_normal(UP.shape)),
        unknown_orientation=True,
    )
    status = cal.to_dict()["status"]
    assert status["converged"]
    assert 1 <= status["iterations"] < 20
    assert status["last_step"] < 1e-6
    assert status["gradient"] < 1e-4  # of the last step; the next would be a thousandth of it
    assert status["message"] == f"converged in {status['iterations']} iterations"


def test_noise_only_readings_are_refused():
    for seed in range(5):
        values = np.random.default_rng(seed).standard_normal((24, 3))
        with pytest.raises(mp.MultiposError):
            mp.fit(mp.Readings(values), unknown_orientation=True)


# --- how parameters follow readings


@pytest.mark.parametrize(
    "mode", ["unknown", "uncertain", "mixed", "group", "level", "level-group", "auto"]
)
def test_gain_by_finite_differences(mode, tmp_path):
    generator = rng()
    scheme = read_scheme("roll-x-8+roll-y-8+roll-z-8")
    up = scheme.up
    sd = np.full(24, np.radians(0.02))
    if mode == "mixed":
        sd[:5], sd[5:9] = 0.0, np.nan
    force = up @ TURN.T if mode == "group" else scatter(up, 0.02, generator)
    if mode == "level-group":
        force[12:] = up[12:] @ TURN.T
    values = SENSOR.read(force) + 1e-5 * generator.standard_normal(up.shape)
    known = {"up": up, "rotation": scheme.rotation}
    known |= {"group": ["g"] * 24} if mode == "group" else {}
    known |= {"group": [""] * 12 + ["g"] * 12} if mode == "level-group" else {}
    known |= {"orientation_sd": sd} if mode in ("uncertain", "mixed") else {}
    how = {
        "unknown": {"unknown_orientation": True},
        "level": {"level_sd": 0.1, "reading_sd": 1e-5},
        "level-group": {"level_sd": 0.1, "reading_sd": 1e-5},
        "auto": {"orientation_sd": "auto"},
    }.get(mode, {"reading_sd": 1e-5})
    known = {} if mode == "unknown" else known
    cal = mp.fit(mp.Readings(values, **known), convention="specific-force", **how)
    problem = restate(cal)

    def solve(at):  # variances are held where they are
        return return_to_optimum(cal, replace(problem, values=at)).state.theta

    cal.save(tmp_path / "cal.json")
    gain = uncertain_gain(mp.load(tmp_path / "cal.json"))
    h = 1e-6
    scale = np.abs(gain).max()
    for column in generator.choice(gain.shape[1], 12, replace=False).tolist():
        step = h * (np.arange(values.size) == column).reshape(values.shape)
        wanted = (solve(values + step) - solve(values - step)) / (2.0 * h)
        # second order is left out: residuals of 1e-5 and steps of 3e-4 against one
        assert_allclose(gain[:, column], wanted, rtol=0, atol=2e-3 * scale)


def test_gain_of_a_position_set_aside_is_nothing():
    readings = readings_of(SENSOR, UP, rng(), sd=1e-4, off_deg=0.005)
    values = readings.values.copy()
    values[7] += 0.2
    cal = mp.fit(mp.Readings(values, up=UP), orientation_sd=0.005, robust="huber")
    gain = uncertain_gain(cal).reshape(12, 24, 3)
    assert np.abs(gain[:, 7]).max() < 1e-9 * np.abs(gain).max()


def test_reference_chi2_is_where_denial_begins():
    """The 99.9 % point itself, so that the rule is INTERFACE's."""
    assert chi2_quantile(0.999, 15) == pytest.approx(37.697, abs=1e-3)


def test_information_that_rounding_made_negative_determines_nothing():
    """As the fuzzer found it, at a minimum of outputs that share a parameter."""
    assert condition(np.diag([1.0, -1e-3])) == np.inf
    assert condition(np.diag([4.0, 1.0])) == 1.0


def test_positions_where_the_model_has_no_slopes_are_not_proposed():
    gains = np.array([np.diag([np.nan, np.nan]), np.diag([1.0, 0.0]), np.diag([0.0, 2.0])])
    # |diag(9, 1) + gain| by hand: 10 * 1 for the second position, 9 * 3 for the third, and then
    # 10 * 3 against 9 * 5.
    assert helpful_positions(np.diag([9.0, 1.0]), gains, 2) == [2, 2]
    assert helpful_positions(np.diag([1.0, 9.0]), gains, 2) == [
        1,
        1,
    ]  # 2 * 9, 1 * 11; 3 * 9, 2 * 11
    # of sums that are below zero by rounding there is no root
    rounded = np.array([[[4e24, 1e9], [1e9, -2.7e8]]])
    assert helpful_positions(np.diag([-3.7e9, -4.1e8]), rounded, 1) == [0]

"""`fit`: weights, covariances, pooling, stated noise, gravity, options, and coverage."""

import inspect
import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import few_and_many, rest_slow
from findings_bench import texts
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import multipos as mp
from multipos.errors import MultiposError, RankError, UsageError
from multipos.fitting.completion import _require_in_files
from multipos.reports.certificate import build_content
from multipos.reports.documents import markdown_report

UP14 = mp.read_scheme("faces-corners-14").up
LINEAR = np.column_stack([np.ones(14), UP14])

exactly = partial(mp.fit, orientation_sd=0, exclude="none")


def sensor(rng, up=UP14, noise=1e-3):
    matrix = np.eye(3) + rng.uniform(-0.02, 0.02, (3, 3))
    return 0.1 + up @ matrix.T + noise * rng.standard_normal((len(up), 3))


def by_hand(X, y, V=None):
    """Estimate and (X'V⁻¹X)⁻¹ by the normal equations, which is another route."""
    W = np.eye(len(y)) if V is None else np.linalg.inv(V)
    C = np.linalg.inv(X.T @ W @ X)
    return C @ X.T @ W @ y, C


# --- the estimate and its covariance


def test_unweighted_fit_by_hand():
    # eq. (1) of estimation.known
    values = sensor(np.random.default_rng(0))
    cal = exactly(mp.Readings(values, up=UP14))
    for i in range(3):
        b, C = by_hand(LINEAR, values[:, i])
        r = values[:, i] - LINEAR @ b
        mine = slice(4 * i, 4 * i + 4)
        assert_allclose(cal.parameters[mine], b, rtol=1e-12, atol=1e-15)
        assert_allclose(cal.covariance[mine, mine], C * (r @ r) / 10, rtol=1e-10, atol=1e-20)
        assert cal.residual_sd[i] == pytest.approx(math.sqrt(r @ r / 10))
        assert_allclose(cal.diagnostics.leverage[:, i], np.diag(LINEAR @ C @ LINEAR.T))
    assert_array_equal(cal.dof, [10, 10, 10])
    assert_array_equal(cal.covariance[:4, 4:], 0)
    # quantiles of SciPy before 1.17 have some ten digits
    assert cal.k[0] == pytest.approx(stats.t.ppf(0.975, 10), rel=1e-9)
    assert (cal.diagnostics.rank, cal.diagnostics.parameters) == (12, 12)


def test_weighted_fit_by_hand():
    # eq. (3) of estimation.known
    # eq. (1) of estimation.noise
    rng = np.random.default_rng(1)
    u = rng.uniform(0.5e-3, 2e-3, (14, 3))
    values = sensor(rng, noise=0) + u * rng.standard_normal((14, 3))
    cal = exactly(mp.Readings(values, up=UP14, u=u))
    scatter = cal.variance_components.rest_to_rest["ay"].value
    for i in range(3):
        b, C = by_hand(LINEAR, values[:, i], np.diag(u[:, i] ** 2 + scatter**2))
        assert_allclose(cal.parameters[4 * i : 4 * i + 4], b, rtol=1e-12)
        mine = slice(4 * i, 4 * i + 4)
        u_by_hand = np.sqrt(np.diag(C))
        assert_allclose(cal.correlation[mine, mine], C / np.outer(u_by_hand, u_by_hand), atol=1e-9)
        assert_allclose(cal.U[mine] / u_by_hand, 1.96, rtol=0.15)  # the claim is right
    assert scatter < 0.3e-3
    assert cal.k[0] == pytest.approx(stats.t.ppf(0.975, cal.dof[0]), rel=1e-9)


def test_full_covariance_by_hand():
    """Outputs that move together: one problem of all readings."""
    rng = np.random.default_rng(2)
    root = np.kron(np.eye(14), np.array([[1, 0, 0], [0.8, 0.6, 0], [0.5, 0.5, 0.7]]))
    V = 1e-6 * (root @ root.T + 0.3)  # and a part that all readings share
    values = sensor(rng, noise=0) + (np.linalg.cholesky(V) @ rng.standard_normal(42)).reshape(14, 3)
    cal = exactly(mp.Readings(values, up=UP14, covariance=V))
    X = np.kron(LINEAR, np.eye(3))[:, np.arange(12).reshape(4, 3).T.ravel()]
    scatter = cal.variance_components.rest_to_rest["ax"].value
    b, C = by_hand(X, values.ravel(), V + scatter**2 * np.eye(42))
    assert_allclose(cal.parameters, b, rtol=1e-9, atol=1e-12)
    u_by_hand = np.sqrt(np.diag(C))
    assert_allclose(cal.correlation, C / np.outer(u_by_hand, u_by_hand), atol=1e-9)
    assert_allclose(cal.U / u_by_hand, 1.96, rtol=0.15)  # the claim is right
    assert cal.covariance[0, 4] != 0  # biases of two outputs


def test_a_diagonal_covariance_is_u():
    rng = np.random.default_rng(3)
    values, u = sensor(rng), np.full((14, 3), 1e-3)
    one = exactly(mp.Readings(values, up=UP14, u=u))
    other = exactly(mp.Readings(values, up=UP14, covariance=np.diag(u.ravel() ** 2)))
    assert_array_equal(one.parameters, other.parameters)
    assert_array_equal(one.covariance, other.covariance)
    again = exactly(mp.Readings(values, up=UP14), reading_sd=1e-3)
    assert_array_equal(one.covariance, again.covariance)


def test_reading_sd_overrules_the_readings_and_says_so():
    values = sensor(np.random.default_rng(4))
    readings = mp.Readings(values, up=UP14, u=np.full((14, 3), 1e-6))
    cal = exactly(readings, reading_sd=[1e-3, 2e-3, 3e-3])
    assert_array_equal(cal.readings.u[5], [1e-3, 2e-3, 3e-3])
    assert any("--reading-sd is used" in text for text in texts(cal))


# --- a stated noise that the residuals deny


def stated(factor, seed=5):
    """A fit of readings whose noise is `factor` times what they claim."""
    values = sensor(np.random.default_rng(seed), noise=factor * 1e-3)
    return exactly(mp.Readings(values, up=UP14), reading_sd=1e-3)


def test_a_denied_noise_is_added_to_and_said():
    cal, with_prior = stated(5), stated(1)
    chi2 = float(np.sum(cal.residuals**2)) / 1e-6
    assert chi2 > stats.chi2.ppf(0.999, 30)
    (said,) = texts(cal)
    assert "exceed the stated noise (p < 1e-6)" in said
    found = [part.value for part in cal.variance_components.rest_to_rest.values()]
    assert f"U includes up to {max(found):.2g} reading of it" in said
    assert "likely variation between rests" in said
    assert cal.findings[0].p == pytest.approx(stats.chi2.sf(chi2, 30), rel=1e-6)
    # five times the claim: of each output between what its residuals say and what all do, to an
    # eighth of what ten degrees of freedom know
    squares = np.sum(cal.residuals**2, axis=0)
    each, pooled = np.sqrt(squares / 10 - 1e-6), math.sqrt(squares.sum() / 30 - 1e-6)
    assert (0.97 * np.minimum(each, pooled) < found).all()
    assert (found < 1.03 * np.maximum(each, pooled)).all()
    assert (cal.dof < 30.0 * 1.001).all()
    assert (cal.dof > 10.0 * 0.999).all()
    total = np.sqrt(np.square(found) + 1e-6)
    assert_allclose(cal.u / with_prior.u, np.repeat(total / 1e-3, 4), rtol=0.15)
    assert not texts(with_prior)


def test_the_limit_is_the_99_9_percent_point():
    values = sensor(np.random.default_rng(6))[:, :1]
    readings = mp.Readings(values, up=UP14)
    r = exactly(readings).residuals[:, 0]
    limit = math.sqrt(float(r @ r) / stats.chi2.ppf(0.999, 10))
    assert not texts(exactly(readings, reading_sd=limit * 1.0001))
    (said,) = texts(exactly(readings, reading_sd=limit * 0.9999))
    assert "exceed the stated noise" in said


def test_an_overstated_noise_is_taken_and_said():
    cal = stated(0.05)
    X = np.column_stack([np.ones(14), UP14])
    u = 1e-3 * np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
    assert_allclose(cal.U[:4], stats.norm.ppf(0.975) * u, rtol=0.02)
    assert any("U is probably too large" in text for text in texts(cal))


# --- pooling


def test_pooling_by_hand():
    values = sensor(np.random.default_rng(7))
    readings = mp.Readings(values, up=UP14)
    apart, pooled = exactly(readings), exactly(readings, pool=True)
    s2 = (apart.residuals**2).sum() / 30
    assert_array_equal(pooled.parameters, apart.parameters)
    assert_array_equal(pooled.dof, [30, 30, 30])
    _, C = by_hand(LINEAR, values[:, 0])
    assert_allclose(pooled.covariance[4:8, 4:8], C * s2, rtol=1e-10, atol=1e-20)
    assert not texts(pooled)


def test_pooling_of_unequal_degrees_of_freedom_by_hand():
    """Eight readings: 1e-3 off on 8 − 2 degrees and 3e-3 on 8 − 3: s² = (8e-6 + 72e-6)/11."""
    up = np.tile([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]], (2, 1))
    wave = np.repeat([1e-3, -1e-3], 4)[:, None]  # orthogonal to 1, x and y
    readings = mp.Readings(up[:, :2] + wave * [1.0, 3.0], up=up)
    cal = exactly(readings, model="1 + x + own", pool=True)
    assert_array_equal(cal.dof, [11, 11])
    assert cal["ax", "1"].u == pytest.approx(math.sqrt(80e-6 / 11 / 8), rel=1e-9)
    assert cal["ay", "y"].u == pytest.approx(math.sqrt(80e-6 / 11 / 4), rel=1e-9)


@pytest.mark.parametrize(("ratio", "said"), [(41.0, False), (43.0, True)])
def test_pooling_is_warned_of_at_five_percent_by_hand(ratio, said):
    """Two variances on two degrees each, r times apart: 2 ln((r + 1)²/4r)/(5/4) is 3.8415."""
    side, wave = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1e-3, -1e-3, 1e-3, -1e-3])
    values = side[:, None] + wave[:, None] * [1.0, math.sqrt(ratio)]  # the limit is r = 42.1
    readings = mp.Readings(values, outputs=("a", "b"), up=np.outer(side, [1.0, 0.0, 0.0]))
    cal = exactly(readings, model="1 + x", axes="x,x", pool=True)
    assert any("residual variances of the outputs differ" in text for text in texts(cal)) == said


def test_pooling_warns_where_equality_is_rejected():
    values = sensor(np.random.default_rng(8))
    values[:, 1] += 0.05 * np.random.default_rng(9).standard_normal(14)
    cal = exactly(mp.Readings(values, up=UP14), pool=True)
    assert any("residual variances of the outputs differ" in text for text in texts(cal))


def test_a_column_that_vanishes_is_refused_and_what_no_file_could_hold():
    """By hand: a tilt of 1e-3 over the cube of 1e-38 would be a parameter of 1e111."""
    rng = np.random.default_rng(3)
    readings = mp.Readings(
        sensor(rng), up=UP14, environment={"temperature": 1e-38 * rng.uniform(1, 9, 14)}
    )
    with pytest.raises(MultiposError, match=r"`temperature\^3_a[xyz]` has no effect at these"):
        exactly(
            readings, model="1 + x + y + z + temperature^3", orientation_sd=0.1, reading_sd=1e-3
        )
    solution = SimpleNamespace(
        parameters=np.array([1.0, -1e111]), model=SimpleNamespace(names="sk")
    )
    with pytest.raises(MultiposError, match=r"the parameter 'k' is -1e\+111, which no file takes"):
        _require_in_files(solution)


# --- gravity


@pytest.mark.parametrize("u", [1e-3, 1e38])
def test_scatter_that_does_not_count_beside_gravity_leaves_no_degrees_of_freedom(u, tmp_path):
    scatter = 1e-22 * np.random.default_rng(1).standard_normal(14)  # all that is not exact
    readings = mp.Readings((0.5 * UP14[:, 0] + scatter)[:, None], up=UP14, unit="V")
    cal = exactly(readings, model="x", axes="x", gravity=9.80665, gravity_u=u)
    assert np.isinf(cal.parameter_dof).all()
    cal.save(tmp_path / "cal.json")
    assert np.isinf(mp.load(tmp_path / "cal.json").parameter_dof).all()


def test_gravity_scales_and_carries_its_uncertainty():
    # eq. (1) of sensor.gravity
    values = sensor(np.random.default_rng(10))
    readings = mp.Readings(values, up=UP14, unit="V")
    g, u_g = 9.7803, 0.002
    plain, local = (
        exactly(readings, model="own-cubic"),
        exactly(readings, model="own-cubic", gravity=g),
    )
    common = exactly(readings, model="own-cubic", gravity=g, gravity_u=u_g)
    degree = np.array([term.force_degree for _, term in plain.model.keys])
    ratio = g / 9.80665
    assert_allclose(local.parameters, plain.parameters / ratio**degree, rtol=1e-9)
    assert_allclose(np.linalg.norm(local.reference, axis=1), ratio)
    c = degree * common.parameters * u_g / g  # one-for-one, twice, three times
    assert_allclose(common.covariance, local.covariance + np.outer(c, c), rtol=1e-12)
    bias = common["ax", "1"]
    assert (bias.u, bias.dof) == (local["ax", "1"].u, local["ax", "1"].dof)


def test_welch_satterthwaite_by_hand():
    # eq. (2) of sensor.gravity
    values = sensor(np.random.default_rng(11))
    readings = mp.Readings(values, up=UP14)
    g, u_g = 9.81, 0.002
    local, common = (exactly(readings, gravity=g, gravity_u=u) for u in (None, u_g))
    a, c = local["ax", "x"], common["ax", "x"]
    b = c.value * u_g / g
    # JCGM 100, G.2b: u_c⁴/(u_A⁴/10 + u_B⁴/∞)
    assert c.u == pytest.approx(math.hypot(a.u, b))
    assert c.dof == pytest.approx(c.u**4 / (a.u**4 / 10))
    assert c.dof > 10
    assert c.k == pytest.approx(stats.t.ppf(0.975, c.dof), rel=1e-9)


def test_gravity_from_a_place():
    readings = mp.Readings(sensor(np.random.default_rng(12)), up=UP14)
    cal = exactly(readings, latitude=45, height=100)
    assert (cal.gravity.value, cal.gravity.u) == (mp.normal_gravity(45, 100), 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gravity": 9.81, "latitude": 45}, "--gravity and --latitude both state the gravity"),
        ({"height": 100}, "--height needs --latitude"),
        ({"gravity_u": 0.1}, "--gravity-u needs --gravity"),
        ({"latitude": 45, "gravity_u": 0.1}, "--gravity-u needs --gravity"),
        ({"gravity": 9.81, "gravity_u": -1}, "--gravity-u must be 0 or more"),
        ({"gravity": 9.81, "gravity_u": 1e200}, "no more than 1e\\+40, got 1e\\+200"),
        ({"gravity": 0.98}, "--gravity must be in m/s²"),
        ({"gravity": math.nan}, "--gravity must be in m/s²"),
        ({"latitude": 100}, "`latitude` must lie between -90 and 90"),
        ({"convention": "down"}, "unknown convention 'down'"),
        ({"confidence": 95}, "--confidence must lie between 0 and 1"),
        ({"confidence": 0}, "--confidence must lie between 0 and 1"),
        ({"confidence": 5e-324}, "--confidence must lie between 0 and 1"),
        ({"reading_sd": 0}, "--reading-sd must be above 0"),
        ({"reading_sd": 1e-300}, "--reading-sd must be above 0, from 1e-40 to 1e"),
        ({"reading_sd": [1, 1, 1e308]}, "to 1e\\+40, got 1, 1, 1e\\+308"),
        ({"reading_sd": [1, 2]}, "--reading-sd takes 1 or 3 values, got 2"),
        ({"reading_sd": math.inf}, "--reading-sd must be above 0"),
        ({"model": "quintic"}, "unknown model 'quintic'"),
        ({"axes": "x,y"}, "--axes names 2 axes for 3 outputs"),
        ({"inputs": "x,y"}, "not among --inputs x,y"),
    ],
)
def test_faulty_options_are_refused(options, message):
    readings = mp.Readings(sensor(np.random.default_rng(13)), up=UP14)
    with pytest.raises(UsageError, match=message):
        exactly(readings, **options)


@pytest.mark.parametrize("value", [1e31, -1e308])
def test_a_column_of_the_model_has_powers(value):
    temperature = np.linspace(10.0, 30.0, 14)
    temperature[4] = value
    rng = np.random.default_rng(13)
    readings = mp.Readings(sensor(rng), up=UP14, environment={"temperature": temperature})
    exactly(readings)  # which does not use it
    with pytest.raises(MultiposError, match=r"row 5, column 'temperature': .* is beyond 5e.16"):
        exactly(readings, model="1 + x + y + z + temperature^6")


# --- conventions, outputs, inputs, other columns


def test_conventions_differ_in_the_odd_terms():
    readings = mp.Readings(sensor(np.random.default_rng(14)), up=UP14)
    force, gravity = (
        exactly(readings, model="own-cubic", convention=c) for c in ("specific-force", "gravity")
    )
    degree = np.array([term.force_degree for _, term in force.model.keys])
    assert_allclose(gravity.parameters, force.parameters * (-1.0) ** degree, rtol=1e-12, atol=1e-15)
    assert_array_equal(gravity.reference, -UP14)
    assert not texts(force)
    (said,) = texts(gravity)
    assert "every scale factor is negative under the convention gravity" in said
    assert "--convention specific-force" in said


@pytest.mark.parametrize(
    ("axes", "names"),
    [("z", ("q",)), ("y,x", ("q", "r")), ("x,y,z,x", ("a", "b", "c", "d"))],
)
def test_one_two_and_four_outputs(axes, names):
    own = ["xyz".index(axis) for axis in axes.split(",")]
    values = 0.2 + 3.0 * UP14[:, own] + 0.1 * UP14[:, [0]]
    cal = exactly(mp.Readings(values, outputs=names, up=UP14), axes=axes)
    for name, axis in zip(names, own, strict=True):
        b = np.array([0.2, 0.1, 0, 0])
        b[1 + axis] += 3.0
        assert_allclose([cal[name, t].value for t in "1xyz"], b, atol=1e-14)
    if len(set(own)) == 3:
        assert_allclose(cal.compensate(values), UP14, atol=1e-14)


def test_inputs_restrict_the_model():
    up = mp.read_scheme("roll-z-12").up
    values = np.column_stack([0.1 + up[:, 0], -0.1 + 2 * up[:, 1]])
    readings = mp.Readings(values, up=up)
    with pytest.raises(RankError, match=r"`cross_ax_z` has no effect at these positions"):
        exactly(readings)
    cal = exactly(readings, inputs="x,y")
    assert cal.names == ("bias_ax", "scale_ax", "cross_ax_y", "bias_ay", "cross_ay_x", "scale_ay")
    assert_allclose(cal.parameters, [0.1, 1, 0, -0.1, 0, 2], atol=1e-15)


def test_a_formula_with_temperature():
    rng = np.random.default_rng(15)
    t = rng.uniform(-40, 60, 28)
    up = np.vstack([UP14, UP14])
    values = 0.1 + 2e-4 * t + (1 + 3e-5 * t) * up[:, 0] + 0.01 * up[:, 0] ** 2
    formula = "1 + x + y + z + own^2 + temperature + temperature*own"
    columns = {"ax": values, "temperature": t, "up_x": up[:, 0], "up_y": up[:, 1], "up_z": up[:, 2]}
    cal = exactly(columns, model=formula)
    assert cal.names[-2:] == ("temperature_ax", "temperature*x_ax")
    assert_allclose(cal.parameters, [0.1, 1, 0, 0, 0.01, 2e-4, 3e-5], atol=1e-13)
    columns["humidity"] = rng.uniform(30, 60, 28)
    assert exactly(columns, model=f"{formula} + humidity").outputs == ("ax",)
    columns["temperature"][5] = math.nan
    with pytest.raises(MultiposError, match="row 6, column 'temperature'"):
        exactly(columns, model=formula)
    readings = mp.Readings(values, up=up, environment={"temperature": columns["temperature"]})
    with pytest.raises(MultiposError, match="row 6, column 'temperature' is empty or not finite"):
        exactly(readings, model=formula)


# --- what cannot be separated


def refused(model, scheme, outputs=1):
    n = len(mp.read_scheme(scheme))
    with pytest.raises(RankError) as error:
        mp.fit(mp.Readings(np.ones((n, outputs))), scheme=scheme, model=model)
    formula = str(error.value).rpartition("'")[0].rpartition("'")[2]
    return error.value, formula


@pytest.mark.parametrize("scheme", ["faces-6", "icosahedron-12", "all-26", "fibonacci-200"])
def test_full_quadratic_always_answers_with_the_formula_to_use(scheme):
    error, formula = refused("full-quadratic", scheme, 3)
    assert "x^2 + y^2 + z^2 = 1 at rest, so no static positions can" in str(error)
    up = mp.read_scheme(scheme).up
    cal = mp.fit(mp.Readings(0.1 + up), scheme=scheme, model=formula)
    assert cal.diagnostics.rank == cal.diagnostics.parameters == 3 * len(formula.split(" + "))
    if scheme == "fibonacci-200":
        assert formula == "1 + x + y + z + x^2 + y^2 + x*y + x*z + y*z"
        (named,) = error.combinations
        assert named == "`bias_ax` cannot be separated from `quad_ax + square_ax_y + square_ax_z`"


def test_full_quadratic_of_two_inputs_can_be_separated():
    up = mp.read_scheme("fibonacci-24").up
    cal = mp.fit(
        mp.Readings(0.1 + up[:, :2]), scheme="fibonacci-24", model="full-quadratic", inputs="x,y"
    )
    assert cal.diagnostics.rank == 12


@pytest.mark.parametrize(
    ("model", "scheme", "words"),
    [
        ("own-cubic", "faces-6", "`scale_ax` cannot be separated from `cubic_ax`"),
        ("linear", "roll-x-24", "`scale_ax` has no effect at these positions"),
        ("ieee", "faces-6", "6 readings cannot determine the 8 terms of ax"),
        ("linear", "roll-x-3", "3 readings cannot determine the 4 terms of ax"),
    ],
)
def test_what_cannot_be_separated_is_named_with_a_way_out(model, scheme, words):
    error, formula = refused(model, scheme)
    assert words in str(error)
    up = mp.read_scheme(scheme).up
    if "x" in formula.split(" + "):
        mp.fit(mp.Readings(up[:, :1]), scheme=scheme, model=formula)


# --- the claims, by simulation


@pytest.mark.parametrize(
    ("scheme", "model"),
    rest_slow([("faces-6", "linear"), ("faces-6", "own-quadratic"), ("faces-corners-14", "ieee")]),
)
@pytest.mark.usefixtures("without_findings")
def test_t_intervals_cover(scheme, model):
    rng = np.random.default_rng(16)
    up = mp.read_scheme(scheme).up
    outputs = 300  # each an independent repetition of one calibration, own axis x
    names = tuple(f"v{i}" for i in range(outputs))
    axes = ("x",) * outputs
    truth = mp.Readings(up[:, :1], up=up)
    terms = exactly(truth, model=model).model.terms[0]
    hits, runs = np.zeros(len(terms)), 0
    for _ in range(3):
        values = up[:, :1] + 0.01 * rng.standard_normal((len(up), outputs))
        cal = exactly(
            mp.Readings(values, outputs=names, up=up), model=model, axes=axes, confidence=0.9
        )
        error = cal.parameters.reshape(outputs, -1)
        error = error - [1.0 if str(t) == "x" else 0.0 for t in terms]
        hits += (np.abs(error) <= cal.U.reshape(outputs, -1)).sum(axis=0)
        runs += outputs
    # binomial at 0.9; 4.4 standard deviations leave 1e-5 to chance for each of the parameters
    assert_allclose(hits / runs, 0.9, atol=4.4 * math.sqrt(0.09 / runs))


@pytest.mark.parametrize("runs", few_and_many(60, 400))
@pytest.mark.usefixtures("without_findings")
def test_intervals_of_believed_noise_cover(runs):
    rng = np.random.default_rng(17)
    u = np.where(np.arange(14) < 7, 1e-3, 5e-3)[:, None] * np.ones(3)
    hits = np.zeros(12)
    truth = np.concatenate([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for _ in range(runs):
        cal = exactly(mp.Readings(UP14 + u * rng.standard_normal((14, 3)), up=UP14, u=u))
        hits += np.abs(cal.parameters - truth) <= cal.U
    assert_allclose(hits / runs, 0.95, atol=4.4 * math.sqrt(0.0475 / runs))


# --- complete at birth


def test_diagnostics_are_there():
    rng = np.random.default_rng(18)
    up = np.vstack([UP14, UP14])
    values = sensor(rng, up)
    values[3, 0] += 0.05
    cal = exactly(mp.Readings(values, up=up, positions=[f"p{i}" for i in range(28)]))
    assert [t.partition(":")[0] for t in cal.diagnostics.outliers] == ["position p3"]
    assert set(cal.diagnostics.lack_of_fit) == {"ax", "ay", "az"}
    assert cal.diagnostics.lack_of_fit["ay"]["dof"] == [10, 14]
    assert cal.diagnostics.lack_of_fit["ay"]["p"] > 0.001
    squared = values + np.column_stack([0 * up[:, 0], 0.05 * up[:, 1] ** 2, 0 * up[:, 0]])
    missing = exactly(mp.Readings(squared, up=up))
    assert missing.diagnostics.lack_of_fit["ay"]["p"] < 1e-6
    assert cal.diagnostics.condition >= 1
    assert cal.status.converged
    assert cal.version == mp.__version__


def test_badly_separated_parameters_warn():
    rng = np.random.default_rng(19)
    up = np.array([0, 0, 1]) + 1e-5 * rng.standard_normal((20, 3))
    cal = mp.fit(mp.Readings(up[:, :1], up=up))
    assert any("parameters are nearly inseparable" in text for text in texts(cal))


def test_the_time_is_that_of_the_source_date_epoch(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    assert mp.fit(mp.Readings(UP14, up=UP14)).created == "1970-01-01T00:00:00+00:00"


def test_a_covariance_without_digits_and_a_number_of_samples_beyond_measure_are_refused(tmp_path):
    covariance = np.array([[4.0, 6.1], [6.1, 9.0]])
    solution = SimpleNamespace(parameters=np.array([1.0, 2.0]), covariance=covariance)
    with pytest.raises(mp.MultiposError, match="covariances have no digits"):
        _require_in_files(solution)
    solution.covariance[[0, 1], [1, 0]] = 5.9  # a correlation of 59/60
    _require_in_files(solution)
    path = tmp_path / "six.csv"
    path.write_text("position,ax,ay,az,n\n1,1,0,0,1e102\n", encoding="utf-8")
    with pytest.raises(
        mp.MultiposError, match="column 'n': 1e\\+102 is no number that is measured"
    ):
        mp.fit(path, scheme="faces-6")


# --- what nothing is said of


def rotated(rng, up, degrees):
    """Directions that are off by a small rotation, each by its own."""
    off = up + np.cross(np.radians(degrees) * rng.standard_normal(up.shape), up)
    return off / np.linalg.norm(off, axis=1)[:, None]


def test_orientation_errors_are_estimated_where_nothing_is_said_of_them():
    """By simulation: the sd of .2 degrees is found, and U of biases is that of the noise."""
    rng = np.random.default_rng(20)
    up = mp.read_scheme("fibonacci-24").up
    values = sensor(rng, rotated(rng, up, 0.2), noise=1e-4)
    default = mp.fit(mp.Readings(values, up=up))
    spread = default.variance_components.orientation_sd_deg
    assert (spread.source, spread.determined) == ("estimated", True)
    assert spread.low < spread.value < spread.high
    assert spread.value == pytest.approx(0.2, rel=0.35)  # 24 positions of two angles each
    same = mp.fit(mp.Readings(values, up=up), orientation_sd="auto")
    assert_array_equal(default.parameters, same.parameters)
    exact = exactly(mp.Readings(values, up=up))
    assert exact["ax", "1"].U > 5.0 * default["ax", "1"].U
    assert abs(default["ax", "1"].value - 0.1) < default["ax", "1"].U
    assert exact.estimator == "linear"
    assert default.estimator == "uncertain-orientation"


def test_a_row_that_does_not_fit_is_set_aside_where_nothing_is_said_of_it():
    values = sensor(np.random.default_rng(21), mp.read_scheme("fibonacci-24").up)
    values[7, 1] += 0.02
    readings = mp.Readings(values, up=mp.read_scheme("fibonacci-24").up)
    assert [each.label for each in mp.fit(readings).excluded] == ["8"]
    assert not mp.fit(readings, exclude="none").excluded


TOGETHER = np.full((42, 42), 1e-7) + np.diag(np.full(42, 1e-6))


@pytest.mark.parametrize(
    ("readings", "options", "why"),
    [
        ({}, {"robust": "huber"}, "their errors are not estimated with --robust"),
        ({}, {"pool": True}, "their errors are not estimated with --pool"),
        ({"outputs": 2}, {}, "2 of three outputs"),
        ({"force": UP14}, {}, "known forces"),
        ({"n": 6}, {"model": "1 + x + y + z + own^2"}, "the model leaves 1 contrasts"),
        (
            {"environment": {"run": np.arange(14.0) % 2}},
            {},
            "not estimated with a zero for each run",
        ),
        ({"still": True}, {"model": "1 + x"}, "an output never changes"),
        ({"covariance": TOGETHER}, {}, "readings are correlated between"),
    ],
    ids=lambda given: given if isinstance(given, str) else "",
)
def test_what_orientation_errors_cannot_stand_beside_leaves_them_exact(readings, options, why):
    """The numbers are those of exact orientations, and a note says so once."""
    given = dict(readings)
    values = sensor(np.random.default_rng(22))
    n, outputs = given.pop("n", 14), given.pop("outputs", 3)
    if given.pop("still", False):
        values[:, 2] = 0.25
    up = None if "force" in given else UP14[:n]
    measured = mp.Readings(values[:n, :outputs], up=up, **given)
    default = mp.fit(measured, exclude="none", **options)
    exact = exactly(measured, **options)
    assert_array_equal(default.parameters, exact.parameters)
    assert_array_equal(default.U, exact.U)
    (note,) = (each for each in default.findings if each.code == "inseparable")
    assert note.level == "note"
    assert "orientations are taken as exact: " in note.text
    assert why in note.text
    assert "inseparable" not in {each.code for each in exact.findings}


EDGES = mp.read_scheme("edges-12").up
NOISY = EDGES + 1e-3 * np.cos(np.arange(36.0)).reshape(12, 3)
DEAD = np.tile([0.3, 0.0, 1.0], (12, 1))


@pytest.mark.parametrize(
    ("values", "up", "options"),
    [
        (UP14[6:], UP14[6:], {"orientation_sd": "auto"}),
        (  # az follows -y and nothing of z
            EDGES[:, [0, 1, 1]] * [1, 1, -1],
            EDGES,
            {"orientation_sd": 0.2, "model": "1 + own", "robust": "soft-l1"},
        ),
        (  # ax is always 0, and one row of ay is an outlier
            NOISY * [0, 1, 1] + 0.5 * np.eye(12, 3, -1),
            EDGES,
            {"exclude": "auto"},
        ),
        (DEAD, EDGES, {"model": "1 + x + y + z + own^2", "reading_sd": 1e-12}),
        (0.0 * DEAD, EDGES, {"model": "own-quadratic", "pool": True}),
        (np.sign(UP14[:6]), UP14[:6], {"model": "1 + own", "reading_sd": 1e-3}),
        (NOISY, EDGES, {"model": "1 + own", "orientation_sd": "auto", "reading_sd": 1e-12}),
    ],
    ids=["exact", "other axis", "zeros, outlier", "constants", "zeros", "signs", "no noise"],
)
@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore::multipos.errors.CalibrationWarning")
def test_outputs_that_leave_or_follow_nothing_are_met(values, up, options):
    readings = mp.Readings(values, up=up)
    cal = mp.fit(readings, **options)
    assert np.isfinite(cal.parameters).all()
    assert markdown_report(build_content(cal))
    if values is DEAD:
        with pytest.raises(MultiposError, match="the output does not respond to force"):
            mp.check(cal, readings, limit_g=0.01)


@pytest.mark.parametrize(
    ("front", "own"),
    [
        (mp.calibrate, {"exclude": "auto", "model": None, "label_column": None}),
        (mp.capture, {"order": None, "target": ()}),
        (mp.fit_many, {"unit_column": None}),
        (mp.fleet, {"limits": None}),
    ],
    ids=lambda front: getattr(front, "__name__", ""),
)
def test_what_calibrates_takes_the_options_of_the_fit(front, own):
    taken = inspect.signature(front).parameters
    for name, option in inspect.signature(mp.fit).parameters.items():
        of_fit_alone = name in own or name == "angle_zero"  # where angles of its table begin
        if option.kind is inspect.Parameter.KEYWORD_ONLY and not of_fit_alone:
            assert taken[name] == option
    assert {name: taken[name].default for name in own} == own
    assert not any(each.kind is inspect.Parameter.VAR_KEYWORD for each in taken.values())


@pytest.mark.parametrize("front", [mp.calibrate, mp.capture, mp.fit_many, mp.fleet, mp.tumble])
def test_an_option_that_is_none_is_refused_with_the_nearest(front):
    with pytest.raises(TypeError, match=r"takes no option 'gravty'; did you mean 'gravity'\?"):
        front("readings.csv", gravty=9.81)


def test_stepwise_leaves_out_what_positions_cannot_separate_where_errors_are_estimated():
    """At rest x² + y² + z² = 1: the whole quadratic cannot be fitted, a choice of it can."""
    up = mp.read_scheme("fibonacci-24").up
    rng = np.random.default_rng(23)
    values = sensor(rng, up, noise=1e-4)
    values[:, 0] += 0.02 * up[:, 0] * up[:, 1]
    readings = mp.Readings(values, up=up)
    cal = mp.fit(readings, model="full-quadratic", stepwise=True)
    assert cal.estimator == "uncertain-orientation"
    kept = {str(term) for output, term in cal.model.keys if output == "ax"}
    assert {"1", "x", "x*y"} <= kept
    assert cal["ax", "x*y"].value == pytest.approx(0.02, abs=cal["ax", "x*y"].U)

"""Models of one's own: fitted as written, held to SciPy, to polynomials and to numbers by hand."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import exactly
from findings_bench import texts
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.stats import t as student

import multipos as mp
from multipos.errors import CalibrationWarning
from multipos.estimation.gains import estimator_gain
from multipos.estimation.starts import _is_better
from multipos.estimation.user_models import first_guesses
from multipos.positions.scheme import read_scheme
from multipos.regression.rates import default_window, smoothed_rate

UP = read_scheme("all-26").up
SATURATING = "each = b + s*own/(1 + k*own^2)"
TRUTH = np.array([[0.02, 1.01, 0.03], [0.01, 0.99, 0.02], [-0.03, 1.02, 0.05]])


def saturating(theta, force):
    b, s, k = theta.T
    return b + s * force / (1.0 + k * force**2)


def readings(sd=1e-4, seed=1, force=UP, **columns):
    noise = sd * np.random.default_rng(seed).standard_normal(force.shape)
    return mp.Readings(saturating(TRUTH, force) + noise, up=UP, **columns)


def test_the_fit_is_that_of_scipy():
    # eq. (2) of estimation.user_models
    data = readings()
    cal = exactly(data, model=SATURATING)
    for i, output in enumerate(cal.outputs):
        own = UP[:, i]

        def left(p, own=own, i=i):
            return p[0] + p[1] * own / (1 + p[2] * own**2) - data.values[:, i]

        found = least_squares(left, [0.0, 1.0, 0.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        covariance = np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / 23.0
        mine = [cal[output, name] for name in "bsk"]
        assert_allclose([p.value for p in mine], found.x, rtol=0, atol=1e-6 * mine[2].u)
        # SciPy's slopes are differences, good to half of the digits
        assert_allclose([p.u for p in mine], np.sqrt(np.diag(covariance)), rtol=1e-5)
        assert mine[0].dof == 23.0


@pytest.mark.parametrize(
    ("formula", "model"),
    [
        ("each = a + p*x + q*y + r*z", "linear"),
        ("each = a + p*x + q*y + r*z + k*own^2", "own-quadratic"),
    ],
)
@pytest.mark.parametrize("how", [{}, {"reading_sd": 1e-4}, {"robust": "huber"}])
def test_a_polynomial_written_both_ways_is_one(formula, model, how):
    generator = np.random.default_rng(3)
    values = UP @ (np.eye(3) + 0.01) + 0.02 + 1e-4 * generator.standard_normal(UP.shape)
    if "robust" in how:
        values[3, 0] += 0.05
    data = mp.Readings(values, up=UP)
    plain, own = mp.fit(data, model=model, **how), mp.fit(data, model=formula, **how)
    assert_allclose(own.parameters, plain.parameters, rtol=0, atol=1e-10)
    assert_allclose(own.compensate(values), plain.compensate(values), rtol=0, atol=1e-10)
    if how != {"reading_sd": 1e-4}:  # one scatter for all outputs against one for each
        assert_allclose(own.u, plain.u, rtol=1e-7)


def test_a_cross_model_of_unknown_orientation_holds_what_a_rotation_leaves_free():
    """With all linear terms the three rotations are free, as in the lower gauge of `linear`."""
    # eq. (4) of estimation.user_models
    generator = np.random.default_rng(5)
    matrix = np.eye(3) + 0.02 * generator.standard_normal((3, 3))
    values = UP @ matrix.T + 0.02 + 1e-5 * generator.standard_normal(UP.shape)
    plain = mp.fit(mp.Readings(values), unknown_orientation=True)
    own = mp.fit(mp.Readings(values), model="each = a + p*x + q*y + r*z", unknown_orientation=True)
    assert own.model.fixed == (("ax", "q", 0.0), ("ax", "r", 0.0), ("ay", "r", 0.0))
    assert own.model.gauge == "lower"
    assert_allclose(own.parameters, plain.parameters, rtol=0, atol=1e-3 * plain.u.min())
    assert_allclose(own.u, plain.u, rtol=1e-4)
    (said,) = (s for s in texts(own) if "rotation" in s)
    assert "holding `q` of ax at 0" in said


@pytest.mark.parametrize("how", [{"orientation_sd": 0.02}, {"unknown_orientation": True}])
def test_uncertain_and_unknown_orientations_find_the_truth(how):
    turned = UP + 3e-4 * np.random.default_rng(8).standard_normal(UP.shape)
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    cal = mp.fit(readings(1e-5, 2, turned), model=SATURATING, **how)
    assert (np.abs(cal.parameters - TRUTH.ravel()) < 4.0 * cal.u).all()


def test_the_file_holds_the_formula_and_nothing_that_runs(tmp_path):
    cal = mp.fit(readings(), model=SATURATING)
    path = tmp_path / "cal.json"
    cal.save(path)
    content = json.loads(path.read_text())
    assert content["own_model"]["outputs"] == {"each": "b + s*own/(1 + k*own^2)"}
    assert content["model"] == SATURATING
    again = mp.load(path)
    assert again.model == cal.model
    raw = saturating(TRUTH, UP)
    assert_allclose(again.compensate(raw), cal.compensate(raw), rtol=0, atol=0)
    content["own_model"]["outputs"]["each"] = "__import__('os').system('true')"
    path.write_text(json.dumps(content))
    with pytest.raises(mp.MultiposError, match="unknown function '__import__'"):
        mp.load(path)


def test_compensation_is_the_inverse_and_flags_what_has_none():
    cal = mp.fit(readings(0.0), model=SATURATING)
    assert_allclose(cal.compensate(saturating(TRUTH, UP)), UP, rtol=0, atol=1e-10)
    # b + s f/(1 + k f²) has its top at f = k^-1/2: 0.02 + 1.01/(2*0.03^0.5) = 2.94
    assert np.isnan(cal.compensate([[3.0, 0.0, 0.0]])).any()


def test_a_prior_pulls_by_its_weight(tmp_path):
    """One linear parameter by hand: the mean of prior and readings, weighted by information."""
    force = np.column_stack([np.ones(4), np.zeros((4, 2))])
    force[2:, 0] = -1.0
    values = np.array([[1.00], [1.02], [-0.99], [-1.01]])
    path = written(tmp_path, "s = {start = 0.9, sd = 0.01}", 'each = "s*own"')
    cal = mp.fit(mp.Readings(values, up=force), model=path, axes="x", reading_sd=0.02)
    tau = next(iter(cal.variance_components.rest_to_rest.values())).value
    w, prior = 4.0 / (0.02**2 + tau**2), 1.0 / 0.01**2
    assert_allclose(cal.parameters[0], (w * 1.005 + prior * 0.9) / (w + prior), rtol=1e-9)


def written(folder, parameters, outputs):
    path = folder / "own.toml"
    path.write_text(f"[parameters]\n{parameters}\n\n[outputs]\n{outputs}\n")
    return str(path)


@pytest.mark.parametrize("bounds", ["low = 0.5, high = 2", "high = 2", "low = -1e30, high = 2"])
def test_bounds_that_do_not_bind_change_nothing_beside_one_that_does(tmp_path, bounds):
    """Readings of a straight line: k ends at its bound 0, where eq. (2) has no slope."""
    # eq. (1) of sensor.stated_parameters
    up = mp.read_scheme("all-26").up
    values = 1.001 * up + 0.005 * np.random.default_rng(7).standard_normal(up.shape)

    def fitted(more):
        parameters = "k = {start = 0.01, low = 0}\ns = {start = 1" + more + "}"
        path = written(tmp_path, parameters, SATURATING_FILE)
        return mp.fit(mp.Readings(values, up=up), model=path, orientation_sd=0.5, reading_sd=1e-3)

    cal, plain = fitted(f", {bounds}"), fitted("")
    assert any("k_a" in text and "at its bound" in text for text in texts(cal))
    assert not any("`s_a" in text for text in texts(cal))
    assert_allclose(cal.parameters, plain.parameters, atol=1e-4 * plain.u.max())
    assert_allclose(cal.u, plain.u, rtol=1e-4)


@pytest.mark.usefixtures("without_findings")
def test_a_prior_beside_noise_that_only_residuals_tell(tmp_path):
    """By hand: s² from the residuals on n - (share of the readings) degrees of freedom."""
    generator = np.random.default_rng(4)
    up = np.tile([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], (6, 1))
    values = 1.02 * up[:, :1] + 0.02 * generator.standard_normal((12, 1))
    path = written(tmp_path, "s = {start = 1.0, sd = 0.01}", 'each = "s*own"')
    cal = mp.fit(mp.Readings(values, up=up), model=path, axes="x")
    plain, s2 = float(np.mean(values * up[:, :1])), 1e-4
    for _ in range(100):
        w = 12.0 / s2 / (12.0 / s2 + 1e4)
        estimate = w * plain + (1.0 - w)
        s2 = float(np.sum((values - estimate * up[:, :1]) ** 2)) / (12.0 - w)
    assert_allclose(cal.parameters[0], estimate, rtol=1e-6)
    assert_allclose(cal.u[0], (12.0 / s2 + 1e4) ** -0.5, rtol=1e-4)


def test_a_prior_that_readings_add_nothing_to_is_certain_of_its_u(tmp_path):
    """A share of (1e-30/0.01)² of twelve readings has 1e112 times their dof, which files lack."""
    up = np.tile([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], (6, 1))
    values = 1.02 * up[:, :1] + 0.02 * np.random.default_rng(4).standard_normal((12, 1))
    path = written(tmp_path, "s = {start = 1.0, sd = 1e-30}", 'each = "s*own"')
    cal = mp.fit(mp.Readings(values, up=up), model=path, axes="x")
    assert_allclose(cal.u, 1e-30, rtol=1e-9)
    assert cal.parameter_dof.tolist() == [np.inf]


def test_a_prior_of_unknown_orientations_leaves_their_degrees_of_freedom(tmp_path):
    """One number a position: 20 − 6, and of each prior what readings tell, C/sd² (eq. (1))."""
    # eq. (1) of estimation.noise
    up = mp.read_scheme("fibonacci-20").up
    values = 1.02 * up + 0.02 * np.random.default_rng(4).standard_normal(up.shape)
    path = written(tmp_path, "s = {start = 1.0, sd = 0.01}", 'each = "b + s*own"')
    cal = mp.fit(mp.Readings(values), model=path, unknown_orientation=True)
    fractions = np.sum(np.diag(cal.covariance)[1::2]) / 0.01**2
    assert 1.0 < fractions < 3.0
    assert_allclose(cal.dof, 20 - 6 + fractions, rtol=1e-3)
    assert_allclose(cal.k, student.ppf(0.975, cal.dof[0]), rtol=1e-6)
    # a stated noise is judged by 20 readings and 3 priors less 6 parameters
    stated = mp.fit(mp.Readings(values), model=path, unknown_orientation=True, reading_sd=0.005)
    assert stated.diagnostics.claim.dof == 17.0


def test_priors_at_as_many_positions_as_parameters_have_no_unequal_axes(tmp_path):
    """Six positions, six parameters: what the three priors leave says nothing about the axes."""
    up = mp.read_scheme("fibonacci-6").up
    values = 1.02 * up + 0.02 * np.random.default_rng(4).standard_normal(up.shape)
    path = written(tmp_path, "s = {start = 1.0, sd = 0.01}", 'each = "b + s*own"')
    cal = exactly(mp.Readings(values), model=path, unknown_orientation=True, reading_sd=1e-4)
    # readings of 0.02 say little beside a prior of 0.01
    assert_allclose(cal.u[1::2], 0.01, rtol=0.2)


@pytest.mark.parametrize("sd", [0.003, 0.01, 0.03])
def test_a_prior_beside_a_rejected_noise_keeps_its_own_dof(tmp_path, sd):
    """By quadrature over V = σ² + τ²: the sd of the posterior is that of the t of u and dof."""
    up = np.tile([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], (5, 1))
    values = 0.1 + 1.005 * up[:, :1] + 0.05 * np.random.default_rng(4).standard_normal((10, 1))
    path = written(tmp_path, f"s = {{start = 1.0, sd = {sd}}}", 'each = "b + s*own"')
    cal = exactly(mp.Readings(values, up=up), model=path, axes="x", reading_sd=0.01)
    b, s = values.mean(), float(np.mean(values * up[:, :1]))
    squares = float(np.sum((values - b - s * up[:, :1]) ** 2))
    V = np.exp(np.linspace(np.log(0.01**2), 0.0, 20_000))
    variance = V / 10.0 + sd**2
    weight = np.exp(-4.0 * np.log(V) - squares / 2.0 / V - (s - 1.0) ** 2 / 2.0 / variance)
    weight /= np.sqrt(variance)
    weight /= weight.sum()
    each = 1.0 / (10.0 / V + 1.0 / sd**2)
    mean = each * (10.0 / V * s + 1.0 / sd**2)
    middle = weight @ mean
    expected = np.sqrt(weight @ (each + (mean - middle) ** 2))
    bias, scale = cal["b_ax"], cal["s_ax"]
    # with the dof of the noise for both, u of the scale was up to 13 % small
    longer = 1.0 if np.isinf(scale.dof) else np.sqrt(scale.dof / (scale.dof - 2.0))
    assert_allclose(scale.u * longer, expected, rtol=1e-2)
    assert 8.0 < bias.dof < 9.0 < 13.0 < scale.dof


def test_bounds_hold_and_are_said(tmp_path):
    data = readings()
    path = written(tmp_path, "k = {start = 0.01, low = 0, high = 0.04}", SATURATING_FILE)
    cal = exactly(data, model=path)
    free = exactly(data, model=SATURATING)
    # where the bound is not in the way, nothing changes
    assert_allclose(cal.parameters[:6], free.parameters[:6], rtol=0, atol=1e-4 * free.u.min())
    assert_allclose(cal.u[:6], free.u[:6], rtol=1e-4)
    assert_allclose(cal["k_az"].value, 0.04, rtol=1e-6)
    (said,) = (s for s in texts(cal) if "bound" in s)
    assert "`k_az` is at its bound, high = 0.04" in said


def test_what_bounds_are_searched_as_by_hand(tmp_path):
    """k in −.01 … .03 as .01 + .02 sin t, s from .5 on as .5 − 1 + √(t² + 1)."""
    # eq. (1) of sensor.stated_parameters
    stated = "k = {start = 0.01, low = -0.01, high = 0.03}\ns = {start = 1, low = 0.5}"
    model = mp.fit(readings(), model=written(tmp_path, stated, SATURATING_FILE)).model
    names = [name.partition("_")[0] for name in model.names]
    t = np.array([{"k": np.pi / 6, "s": np.sqrt(3.0), "b": 7.0}[name] for name in names])
    outer, slope, second = model.outward(t)
    k, s = (0.02, 0.02 * np.sqrt(0.75), -0.01), (1.5, np.sqrt(0.75), 0.125)
    wanted = {"k": k, "s": s, "b": (7.0, 1.0, 0.0)}
    found = np.column_stack([outer, slope, second])
    assert_allclose(found, [wanted[name] for name in names], rtol=1e-12)
    assert_allclose(model.inward(outer), t, rtol=1e-9)


SATURATING_FILE = 'each = "b + s*own/(1 + k*own^2)"'


def test_outputs_that_share_a_parameter_are_fitted_together():
    """Two chips on one axis, one drift over temperature; the second route is SciPy's."""
    generator = np.random.default_rng(6)
    t = np.linspace(10.0, 40.0, len(UP))
    sd = np.array([1e-4, 3e-4])
    values = np.column_stack([0.1 + UP[:, 0], 0.2 + 1.1 * UP[:, 0]]) + 2e-3 * t[:, None]
    values += sd * generator.standard_normal(values.shape)
    data = mp.Readings(values, up=UP, outputs=("a", "b"), environment={"temperature": t})
    model = "each = o + s*own + common_d*temperature"
    cal = mp.fit(data, model=model, axes="x,x")
    assert cal.names == ("o_a", "s_a", "o_b", "s_b", "common_d")
    assert cal["common", "common_d"].value == cal["common_d"].value
    found = cal.residual_sd
    design = np.zeros((2, len(UP), 5))
    for i in range(2):
        design[i, :, 2 * i], design[i, :, 2 * i + 1], design[i, :, 4] = 1.0, UP[:, 0], t
    A = (design / found[:, None, None]).reshape(-1, 5)
    y = (values / found).T.ravel()
    assert_allclose(cal.parameters, np.linalg.lstsq(A, y, rcond=None)[0], rtol=1e-7)
    assert_allclose(cal.u, np.sqrt(np.diag(np.linalg.inv(A.T @ A))), rtol=1e-6)
    # the degrees of freedom of both outputs together are 52 - 5; the drift is told by the better
    assert_allclose(cal.dof.sum(), 47.0, rtol=1e-9)
    assert 20.0 < cal["common_d"].dof < 47.0


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("each = b + s*onw", "character 14: 'onw' is no column; did you mean 'own'"),
        ("each = b + s*own*temprature", "did you mean 'temperature'"),
        ("each = b + s*own*voltge", "did you mean 'voltage'"),
        ("each = b + s*own*Voltage", "did you mean 'voltage'"),
    ],
)
def test_a_misspelt_column_does_not_become_a_parameter(model, said):
    columns = {f"up_{axis}": UP[:, i] for i, axis in enumerate("xyz")}
    table = {**columns, "voltage": 5.0 + UP[:, 1], "ax": 0.1 + UP[:, 0]}
    with pytest.raises(mp.UsageError) as caught:
        mp.fit(table, model=model, axes="x,y")
    assert said in str(caught.value)


def test_a_temperature_that_was_not_measured_is_asked_for():
    with pytest.raises(mp.MultiposError, match="the model uses 'temperature', but there is no"):
        mp.fit(readings(), model="each = b + s*own + c*temperature")


def test_a_start_is_found_where_none_is_stated():
    """A sine has no slope at zero amplitude: other starts are tried."""
    own = UP[:, [0]]
    values = 0.3 + 2.0 * np.sin(0.7 * own) + 1e-5 * np.random.default_rng(2).normal(size=own.shape)
    cal = mp.fit(mp.Readings(values, up=UP), model="each = b + a*sin(c*own)", axes="x")
    assert_allclose(cal.parameters, [0.3, 2.0, 0.7], rtol=0, atol=1e-3)


def test_what_positions_cannot_tell_is_named():
    with pytest.raises(mp.RankError, match=r"`p_ax`.*`q_ax`|`q_ax`.*`p_ax`"):
        mp.fit(readings(), model="each = b + (p + q)*own")


def test_gravity_reaches_parameters_as_it_does_in_a_polynomial():
    data = readings()
    how = {"gravity": 9.81, "gravity_u": 0.01}
    plain, own = mp.fit(data, **how), mp.fit(data, model="each = a + p*x + q*y + r*z", **how)
    assert_allclose(own.covariance, plain.covariance, rtol=0, atol=1e-7 * plain.covariance.max())
    saturated = mp.fit(data, model=SATURATING, **how)
    # b + s f/(1 + k f²): s goes with 1/g, k with 1/g²
    g = 0.01 / 9.81
    assert_allclose(saturated["s_ax"].u, g * saturated["s_ax"].value, rtol=1e-2)


@pytest.mark.parametrize(
    ("formula", "places", "first"),
    [("b + s*own + b/(s - s)", 26, "1"), ("b + s*own + s*log(own + 0.5)", 9, "6")],
)
def test_a_formula_without_a_value_is_named_with_its_positions(tmp_path, formula, places, first):
    """Of 26 directions one points down along an axis and eight lie .577 or .707 below level."""
    model = written(tmp_path, "", f'ax = "b + s*own"\nay = "b + s*own"\naz = "{formula}"')
    said = f"formula of az has no value at {places} of 26 positions, first at {first};"
    with pytest.raises(mp.MultiposError, match=said):
        mp.fit(readings(), model=model)
    if places < 26:  # as the message says
        valued = UP[:, 2] > -0.5
        kept = mp.Readings(readings().values[valued], up=UP[valued])
        assert mp.fit(kept, model=model).outputs == ("ax", "ay", "az")


def test_an_empty_line_and_a_missing_output_are_errors():
    with pytest.raises(mp.UsageError, match="output 'ay' has no line"):
        mp.fit(readings(), model="ax = b + own")
    with pytest.raises(mp.UsageError, match="expected a number"):
        mp.fit(readings(), model="each =")


def test_an_output_is_no_parameter():
    with pytest.raises(mp.UsageError, match="character 12: 'b' is an output of the readings"):
        mp.fit(
            mp.Readings(UP + 0.1, up=UP, outputs=("a", "b", "c")),
            model="each = s + b*own",
            outputs="a,b,c",
        )


def test_a_bias_is_half_the_curvature_of_the_estimate_times_the_variance():
    """Box's bias by a second route: each reading is moved, and the model fitted again."""
    # eq. (3) of estimation.user_models
    up = np.tile([[1.0, 0, 0], [0.6, 0.8, 0], [-0.6, 0.8, 0], [-1.0, 0, 0], [0, 0, 1.0]], (2, 1))
    clean = up[:, 0] / (1 + 1.5 * up[:, 0] ** 2)
    sd, step = 0.03, 2e-3

    def fit(noise):
        readings = mp.Readings((clean + noise)[:, None], up=up)
        return mp.fit(readings, model="each = b + s*own/(1 + k*own^2)", axes="x")

    each = [fit(step * way).parameters[2] - 1.5 for way in (*np.eye(10), *-np.eye(10))]
    by_moving = sd**2 / 2.0 * np.sum(each) / step**2
    # every position twice, off by as much either way: the estimate is exact, and s is sd
    (said,) = (w for w in texts(fit(sd * 0.7**0.5 * np.repeat([1.0, -1.0], 5))) if w[:3] == "`k_")
    assert float(re.search(r"about ([\d.]+)", said)[1]) == pytest.approx(by_moving, rel=0.05)


@pytest.mark.slow
def test_a_bend_within_the_uncertainty_is_said(request):
    """By simulation: the mean of many estimates is off by what one of them states."""
    # eq. (3) of estimation.user_models
    up = np.tile([[1.0, 0, 0], [0.6, 0.8, 0], [-0.6, 0.8, 0], [-1.0, 0, 0], [0, 0, 1.0]], (2, 1))
    own = up[:, 0]
    b, s, k = 0.0, 1.0, 1.5
    clean = b + s * own / (1 + k * own**2)
    generator = np.random.default_rng(9)
    model = "each = b + s*own/(1 + k*own^2)"

    def fit(noise):
        return mp.fit(mp.Readings((clean + noise)[:, None], up=up), model=model, axes="x")

    sd = 0.03
    # every position twice, off by as much either way: the estimate is exact, and s is sd
    exact = fit(sd * 0.7**0.5 * np.repeat([1.0, -1.0], 5))
    request.getfixturevalue("without_findings")
    found = np.array([fit(sd * generator.standard_normal(10)).parameters[2] for _ in range(400)])
    assert_allclose(exact.parameters[2], k, rtol=1e-6)
    (said,) = (w for w in texts(exact) if w.startswith("`k_"))
    stated = float(said.partition("about ")[2].split()[0].rstrip(",.;"))
    off, se = float(found.mean()) - k, float(found.std()) / 20.0
    assert "too large" in said
    # of second order: what is of fourth is a third of it here
    assert abs(off - stated) < 0.35 * stated + 3.0 * se


def test_a_second_force_that_explains_a_reading_is_flagged():
    """f − 0.6 f³ turns back at 0.745 g: 0.45 is read at 0.550 and at 0.918 g, by hand."""
    from multipos.compensation.applying import apply

    own = UP[:, [0]]
    noise = 1e-6 * np.random.default_rng(1).standard_normal(own.shape)
    data = mp.Readings(own - 0.6 * own**3 + noise, up=UP, outputs=("ax",))
    cal = mp.fit(data, model="each = b + s*own + k*own^3", axes="x")
    found = apply(cal, {"ax": np.array([0.1, 0.35, 0.45, 0.9])})
    assert_allclose(found["f_x"][2], 0.5496, rtol=0, atol=1e-3)
    assert found["outside"].tolist() == [0, 0, 1, 1]
    assert np.isnan(found["f_x"][3])


def test_a_rotation_that_squares_hardly_tell_is_fixed_like_a_free_one():
    """As in the polynomial's lower gauge, whose upper terms are left out whatever the squares."""
    generator = np.random.default_rng(5)
    matrix = np.eye(3) + 0.02 * generator.standard_normal((3, 3))
    values = UP @ matrix.T + 0.02 + 1e-5 * generator.standard_normal(UP.shape)
    model = "each = a + p*x + q*y + r*z + k*own^2"
    plain = mp.fit(mp.Readings(values), model="own-quadratic", unknown_orientation=True)
    own = mp.fit(mp.Readings(values), model=model, unknown_orientation=True)
    assert own.model.fixed == (("ax", "q", 0.0), ("ax", "r", 0.0), ("ay", "r", 0.0))
    assert_allclose(own.parameters, plain.parameters, rtol=0, atol=1e-2 * plain.u.min())


def test_a_convention_that_is_not_the_readings_own_is_said():
    cal = mp.fit(readings(), model=SATURATING, convention="gravity")
    assert any("Fit with --convention specific-force" in w for w in texts(cal))


def test_stated_noise_of_outputs_fitted_apart_reaches_the_file(tmp_path):
    """u of each output is stated; what readings scatter beside it is found for each."""
    data = readings(1e-4)
    cal = mp.fit(data, model=SATURATING, reading_sd=[1e-4, 2e-4, 5e-5])
    assert set(cal.variance_components.rest_to_rest) == {"ax", "ay", "az"}
    robust = mp.fit(data, model=SATURATING, reading_sd=1e-4, robust="huber")
    for one in (cal, robust):
        one.save(tmp_path / "cal.json")
        assert_allclose(mp.load(tmp_path / "cal.json").u, one.u, rtol=1e-12)


def test_a_rate_of_temperature_is_a_column_like_any_other():
    """As `regress` has it, which forms the rate by itself."""
    time = np.linspace(0.0, 500.0, len(UP))
    temperature = 20.0 + 15.0 * np.sin(time / 120.0)
    rate = smoothed_rate(time, temperature, window=default_window(time))
    noise = 1e-5 * np.random.default_rng(6).standard_normal(len(UP))
    volts = 0.02 + UP[:, 0] + 0.03 * rate + noise
    data = mp.Readings(volts, up=UP, outputs=("ax",), environment={"temperature_rate": rate})
    cal = mp.fit(data, model="each = b + s*own + d*temperature_rate")
    table = {"time": time, "temperature": temperature, "x": UP[:, 0], "ax": volts}
    found = mp.regress(table, response="ax", terms="1 + x + temperature_rate").segments[0]
    assert_allclose(cal.parameters, [one.value for one in found.coefficients], rtol=0, atol=1e-10)
    assert_allclose(cal.u, [one.u for one in found.coefficients], rtol=1e-9)
    corrected = mp.apply(cal, {"ax": volts, "temperature_rate": rate})
    assert_allclose(corrected["f_x"], UP[:, 0], rtol=0, atol=6e-5)  # six sd of a reading


def test_a_search_that_ends_beyond_all_numbers_is_refused_in_words(tmp_path):
    """A start that is nothing sends the parameters so far that no slope is a number."""
    path = tmp_path / "own.toml"
    path.write_text(
        '[parameters]\ns = 1e-155\n[outputs]\neach = "b + s*own/(1 + common_k*own^2)"\n'
    )
    with pytest.raises(mp.MultiposError, match="no slopes that are numbers"):
        mp.fit(readings(1e-3), model=path, orientation_sd=0.5, reading_sd=1e-3)


def test_a_search_starts_at_least_squares_given_what_is_stated(tmp_path):
    """k at .2 as stated, b and s those of NumPy for the curve that this makes."""
    # eq. (1) of estimation.user_models
    path = written(tmp_path, "k = 0.2", 'each = "b + s*own/(1 + k*own^2)"')
    up = mp.read_scheme("fibonacci-24").up[:, :1]
    values = 0.1 + 0.9 * up / (1.0 + 0.3 * up**2)
    cal = mp.fit(mp.Readings(values, up=mp.read_scheme("fibonacci-24").up), model=path)
    (first, *_) = first_guesses(cal.model, values, cal.reference, {})
    A = np.column_stack([np.ones(24), up / (1.0 + 0.2 * up**2)])
    best = np.linalg.lstsq(A, values[:, 0], rcond=None)[0]
    by_name = dict(zip(cal.names, first.tolist(), strict=True))
    assert_allclose([by_name["b_ax"], by_name["s_ax"], by_name["k_ax"]], [*best, 0.2], rtol=1e-9)


def test_a_shared_parameter_follows_the_output_that_tells_it():
    """Noise of 1e-7 and 1e-3: the quadratic term of both is known as the first alone tells it."""
    up = read_scheme("fibonacci-24").up
    noise = np.random.default_rng(4).standard_normal((24, 2)) * [1e-7, 1e-3]
    values = 0.02 + 1.1 * up[:, :2] + 0.03 * up[:, :2] ** 2 + noise
    given = mp.Readings(values, outputs=("ax", "ay"), up=up, unit="g")
    cal = mp.fit(given, model="each = b + s*own + common_k*own^2", axes="x,y")
    assert cal["common_k"].value == pytest.approx(0.03, abs=5e-7)
    assert cal["common_k"].u < 3e-7
    assert_allclose(cal.residual_sd, [1e-7, 1e-3], rtol=0.5)
    # apart, residuals that differ by ten millions leave the first all of its digits
    values = 0.02 + 1.1 * up[:, :2] / (1.0 + 0.03 * up[:, :2] ** 2) + noise * [0.01, 10.0]
    given = mp.Readings(values, outputs=("ax", "ay"), up=up, unit="g")
    apart = mp.fit(given, model="each = b + s*own/(1 + k*own^2)", axes="x,y")
    assert apart["k_ax"].value == pytest.approx(0.03, abs=1e-8)


def test_the_better_of_two_ends_has_converged_or_fits_better():
    near, far, open_end = (
        SimpleNamespace(converged=converged, point=SimpleNamespace(objective=objective))
        for converged, objective in ((True, 1.0), (True, 2.0), (False, 0.5))
    )
    assert _is_better(near, far)
    assert not _is_better(far, near)
    assert _is_better(far, open_end)


@pytest.mark.filterwarnings("error:overflow:RuntimeWarning")
def test_an_output_of_zeros_leaves_the_others_their_fit(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(
        '[parameters]\nk = 0.1\n[outputs]\nax = "b + s*x"\nay = "b + s*own/(1 + k*own^2)"\n'
        'az = "b + s*own/(1 + k*own^2)"\n'
    )
    up = read_scheme("all-26").up
    values = up / (1 + 0.2 * up**2) + 1e-3 * np.random.default_rng(1).standard_normal(up.shape)
    whole = exactly(mp.Readings(values, up=up), model=path)
    with pytest.warns(CalibrationWarning, match="has the same reading at all 26 positions"):
        found = exactly(mp.Readings(values * [0.0, 1.0, 1.0], up=up), model=path)
    assert found.parameters[:2].tolist() == [0.0, 0.0]
    # the outputs share nothing; a search ends within 1e-8 u
    np.testing.assert_allclose(found.parameters[2:], whole.parameters[2:], atol=1e-6 * 1e-3)


def test_an_output_without_residuals_follows_its_readings_as_the_others(tmp_path):
    """Beside a prior: the gain of outputs that share nothing, whatever the noise of one is."""
    path = tmp_path / "own.toml"
    path.write_text(
        '[parameters]\nk = { start = 0.1, sd = 0.2 }\n[outputs]\neach = "b + s*own/(1 + k*own^2)"\n'
    )
    up = read_scheme("all-26").up
    values = up / (1 + 0.2 * up**2) + 1e-3 * np.random.default_rng(1).standard_normal(up.shape)
    found = exactly(mp.Readings(values, up=up), model=path)
    none = replace(found, residual_sd=found.residual_sd * [1.0, 0.0, 1.0])
    gain, wanted = estimator_gain(none), estimator_gain(found)
    others = found.model.slices[0], found.model.slices[2]
    for part in others:
        np.testing.assert_allclose(gain[part], wanted[part], rtol=1e-9, atol=1e-12)
    assert np.isfinite(gain).all()

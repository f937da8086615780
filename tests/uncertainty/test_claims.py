"""Checks of the claim: Monte Carlo, profiles, influence, and every estimator's own gain."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import exactly, few_and_many
from known_noise import with_known_noise
from numpy.testing import assert_allclose
from profile_oracle import profile_interval, search_interval

import multipos as mp
from multipos.diagnostics.criticism import aicc, find_influence, fourier_residuals, judge_terms
from multipos.errors import ConvergenceError, MultiposError, UsageError
from multipos.estimation.gains import estimator_gain, restate, return_to_optimum
from multipos.positions.scheme import read_scheme
from multipos.uncertainty import monte_carlo
from multipos.uncertainty.budgets import Quantity
from multipos.uncertainty.draws import Draws
from multipos.uncertainty.monte_carlo import numerical_tolerance, simulate_budget
from multipos.uncertainty.propagation import evaluate_budget
from multipos.uncertainty.sphere import evaluate_sphere

M = np.array([[1.02, 0.03, -0.02], [0.01, 0.97, 0.04], [-0.03, 0.02, 1.01]])
BIAS = np.array([0.01, -0.02, 0.015])


def readings(scheme="icosahedron-12", sd=1e-3, seed=1, quad=0.0, **more):
    up = read_scheme(scheme).up
    values = up @ M.T + BIAS + quad * up**2
    values = values + sd * np.random.default_rng(seed).standard_normal(values.shape)
    return mp.Readings(values, unit="g", **more)


# --- gains of the likelihood


@pytest.mark.parametrize(
    ("options", "tolerance"),
    [
        ({"unknown_orientation": True}, 2e-3),
        ({"orientation_sd": 0.2}, 2e-3),
        ({"unknown_orientation": True, "gauge": "symmetric"}, 2e-3),
    ],
    ids=["unknown", "uncertain", "symmetric gauge"],
)
def test_gain_of_the_likelihood_against_the_whole_estimator(options, tolerance):
    # eq. (2) of estimation.gains
    scheme = None if "unknown_orientation" in options else "fibonacci-24"
    data = readings("fibonacci-24", sd=2e-4)
    options = {"scheme": scheme, "reading_sd": 2e-4, **options}
    c = mp.fit(data, **options)
    gain, problem = estimator_gain(c), restate(c)
    rng = np.random.default_rng(4)
    for _ in range(3):
        step = 1e-4 * rng.standard_normal(data.values.shape)
        moved = [  # the noise held where it was found
            return_to_optimum(c, replace(problem, values=data.values + side * step)).state.theta
            for side in (1.0, -1.0)
        ]
        found = (moved[0] - moved[1]) / 2.0
        assert_allclose(gain @ step.ravel(), found, atol=tolerance * np.abs(found).max())


@pytest.mark.parametrize("options", [{"unknown_orientation": True}, {"orientation_sd": 0.2}])
def test_budget_of_uncertain_and_unknown_orientations(options):
    scheme = None if "unknown_orientation" in options else "fibonacci-24"
    budget = {
        "gravity": {"value": 9.81, "u": 1e-4},
        "gain": {"u": 1e-4},
        "orientation": {"u_deg": 0.01},
    }
    c = mp.fit(readings("fibonacci-24"), scheme=scheme, budget=budget, **options)
    rows = {row.quantity: row for row in evaluate_budget(c).rows}
    # a gain common to all readings is a gain of every parameter, whatever the estimator: but for
    # the prior of an uncertain orientation, which is in radians and does not know it
    assert_allclose(rows["gain"].contribution, np.abs(c.parameters) * 1e-4, atol=2e-7)
    assert rows["orientation"].contained.all()
    plain = mp.fit(readings("fibonacci-24"), scheme=scheme, gravity=9.81, **options)
    assert_allclose(rows["readings"].covariance, plain.covariance, rtol=1e-6, atol=1e-18)
    assert (c.u >= plain.u * (1 - 1e-9)).all()
    assert evaluate_sphere(c)["force"]["x"]["worst"] > 0.0


# --- Monte Carlo


def test_monte_carlo_validates_a_linear_budget():
    budget = {
        "gravity": {"value": 9.81, "u": 3e-4},
        "gain": {"half_width": 2e-4},
        "resolution": {"step": 1e-3},
        "offset": {"u": 1e-4, "each_output": True},
    }
    c = exactly(readings(), scheme="icosahedron-12", reading_sd=1e-3, gravity=9.81, gravity_u=3e-4)
    c = mp.state_budget(with_known_noise(c), budget)
    found = simulate_budget(c, rng=3)
    assert found.stable
    assert found.valid.all()
    # of a standard deviation of so many trials, four standard deviations
    assert_allclose(found.u, c.u, rtol=4 / math.sqrt(2 * found.trials) + 1e-3)
    assert_allclose(np.diff(found.symmetric)[:, 0] / 2, c.U, rtol=0.02)
    assert (np.diff(found.shortest) <= np.diff(found.symmetric) + 1e-15).all()
    assert found.to_dict()["trials"] == found.trials


def test_monte_carlo_draws_students_t():
    c = exactly(readings("faces-6"), scheme="faces-6", pool=True)  # six degrees of freedom
    found = simulate_budget(c, trials=60_000, rng=5)
    assert_allclose(found.u, c.u * math.sqrt(6 / 4), rtol=0.03)  # sd of t on 6
    assert_allclose(np.diff(found.symmetric)[:, 0] / 2, c.U, rtol=0.02)


def test_monte_carlo_with_two_degrees_of_freedom_has_intervals_only():
    c = exactly(readings("faces-6"), scheme="faces-6")
    found = simulate_budget(c, trials=60_000, rng=5)
    assert np.isnan(found.u).all()
    assert_allclose(np.diff(found.symmetric)[:, 0] / 2, c.U, rtol=0.05)


def test_monte_carlo_finds_what_first_order_misses():
    """Placement of ten degrees: the cosine shortens the scale factor, and U does not know it."""
    exact = replace(readings(sd=0.0))
    for half_width, valid in ((0.02, True), (10.0, False)):
        budget = {"level": {"half_width_deg": half_width}}
        c = mp.fit(exact, scheme=attitudes(), reading_sd=1e-5, budget=budget)
        found = simulate_budget(c, trials=40_000, rng=6)
        scales = [c.names.index(f"scale_a{axis}") for axis in "xyz"]
        assert bool(found.valid[scales].all()) is valid
        if not valid:
            assert (found.mean[scales] < c.parameters[scales] - 1e-3).all()


def attitudes():
    """The twelve directions of the icosahedron with a heading each."""
    up = read_scheme("icosahedron-12").up
    columns = {name: [] for name in ("roll_deg", "pitch_deg", "yaw_deg")}
    for x, y, z in up:
        columns["pitch_deg"].append(math.degrees(math.asin(x)))
        columns["roll_deg"].append(math.degrees(math.atan2(-y, -z)))
        columns["yaw_deg"].append(30.0)
    return columns


def test_numerical_tolerance_by_hand():
    # JCGM 101, 7.9.2, examples: u = 0.35 to two digits is 35 × 10⁻², δ = 0.005; 2e-5 to one digit
    assert_allclose(numerical_tolerance(np.array([0.35]), 2), [0.005])
    assert_allclose(numerical_tolerance(np.array([2e-5]), 1), [0.5e-5])


@pytest.mark.parametrize(("swing", "trials"), [(0.35, 2800), (1e-3, 2000)])
def test_trials_of_the_monte_carlo_by_hand(swing, trials, monkeypatch):
    """Blocks that differ by ±a in turn: of h of them 2 s/√h is 2 a/√(h − 1), h even.

    That is below δ/5 at a = 0.35 δ from h > 1 + 3.5² on: 14 blocks. Not before 100/(1 − 0.95)
    trials, however (JCGM 101, 7.9.4 with a fifth of δ).
    """
    monkeypatch.setattr(monte_carlo, "_BLOCK", 200)
    c = mp.fit(readings(), scheme="icosahedron-12", reading_sd=1e-3)
    delta, signs = numerical_tolerance(c.u, 1), itertools.cycle([1.0, -1.0])

    def estimator(drawn):
        spread = np.linspace(-1.0, 1.0, len(drawn))[:, None] * c.u
        return c.parameters + next(signs) * swing * delta + spread

    assert simulate_budget(c, estimator=estimator).trials == trials


@pytest.mark.parametrize(
    ("law", "ratio"), [("rectangular", 3**0.5), ("triangular", 6**0.5), ("arcsine", 2**0.5)]
)
def test_laws_of_the_monte_carlo_have_their_half_width(law, ratio):
    quantity = Quantity("gain", 0.5, "", law, math.inf, {})
    draws = Draws._law(SimpleNamespace(rng=np.random.default_rng(1)), quantity, (40_000,))
    # of 40000, the largest of a triangle is some 1/√20000 short of it
    assert np.abs(draws).max() == pytest.approx(0.5 * ratio, rel=0.02)
    # a variance of 40000 to 4 √(2/40000)
    assert draws.std() == pytest.approx(0.5, rel=0.03)


@pytest.mark.parametrize(
    ("scheme", "times", "options"),
    [
        ("fibonacci-24", 1, {}),
        ("edges-12", 1, {}),
        ("edges-12", 1, {"orientation_sd": 0.2}),
        ("faces-6", 4, {}),
        ("fibonacci-24", 1, {"unknown_orientation": True}),
    ],
    ids=["24", "12", "12 stated", "each face four times", "unknown"],
)
def test_monte_carlo_has_the_interval_of_estimated_orientations(scheme, times, options):
    """Errors of .1°, one a label; half an interval of 2000 trials is known to 3 %."""
    rng = np.random.default_rng(2)
    up = read_scheme(scheme).up
    off = np.cross(np.radians(0.1) * rng.standard_normal(up.shape), up)
    values = np.tile((up + off) @ M.T + BIAS, (times, 1))
    values += 1e-3 * rng.standard_normal(values.shape)
    c = mp.fit(mp.Readings(values, up=np.tile(up, (times, 1)), unit="g"), **options)
    found = simulate_budget(c, trials=2000, rng=1)
    # eq. (1) of uncertainty.draws
    assert_allclose(np.diff(found.symmetric)[:, 0] / 2, c.U, rtol=0.13)


def test_fourier_view_by_hand():
    """Eight angles and a cos 3t: rss 4 a² on 8 − 3, half of it explained by each: F = 2 a²/0.8 a².

    The tail of F = 2.5 on 2 and 5 is (1 + 2 · 2.5/5)^(−5/2).
    """
    angle = np.arange(8) * math.tau / 8
    up = read_scheme("roll-z-8").up
    values = up[:, :1] + 1e-3 * np.cos(3 * angle)[:, None]
    c = mp.fit(mp.Readings(values), scheme="roll-z-8", inputs="x,y")
    third = fourier_residuals(c)[0]["harmonics"][2]
    assert (third["order"], third["amplitude"]) == (3, pytest.approx(1e-3, rel=1e-9))
    assert third["p"] == pytest.approx(2**-2.5, rel=1e-9)


def test_monte_carlo_of_an_unknown_orientation():
    c = mp.fit(
        readings("fibonacci-24", sd=1e-4),
        reading_sd=1e-4,
        unknown_orientation=True,
        budget={"level": {"u_deg": 1.0}, "gain": {"u": 1e-6}},
    )
    trials = 300
    found = simulate_budget(c, trials=trials, rng=2)
    assert found.trials == trials
    # nine standard deviations, each of 300 trials
    assert_allclose(found.u, c.u, rtol=4 / math.sqrt(2 * trials))


def test_another_estimator_can_be_simulated():
    robust = mp.fit(
        readings("fibonacci-24"),
        scheme="fibonacci-24",
        orientation_sd=0.1,
        reading_sd=1e-3,
        robust="huber",
    )
    with pytest.raises(UsageError, match="give `estimator`"):
        simulate_budget(robust, trials=100)
    c = mp.fit(readings("fibonacci-24", sd=1e-4), reading_sd=1e-4, unknown_orientation=True)
    gain = estimator_gain(c)
    found = simulate_budget(
        c, trials=40_000, rng=2, estimator=lambda y: y.reshape(len(y), -1) @ gain.T
    )
    nu = c.dof[0]  # of a Student's t, whose standard deviation is larger
    assert_allclose(found.u, c.u * math.sqrt(nu / (nu - 2.0)), rtol=0.03)


def test_progress_and_limits():
    c = exactly(readings(), scheme="icosahedron-12")
    seen = []
    simulate_budget(c, trials=25_000, progress=seen.append)
    assert seen == [10_000, 20_000, 25_000]
    for options, said in (
        ({"trials": 3}, "between 100 and 1000000, got 3"),
        ({"trials": 2**63}, "between 100 and 1000000, got 9223372036854775808"),
        ({"digits": 5}, "must be 1 or 2, got 5"),
    ):
        with pytest.raises(UsageError, match=said):
            simulate_budget(c, **options)
    assert_allclose(
        simulate_budget(c, trials=1000, rng=1).mean, simulate_budget(c, trials=1000, rng=1).mean
    )


# --- profiles


def random_linear_fit(kind, rng):
    """A calibration at known orientations, its sensor and noise drawn at random."""
    up = read_scheme("faces-6" if kind == "closed form" else "icosahedron-12").up
    size = up.size
    sd = rng.uniform(0.5e-3, 2e-3, up.shape)
    covariance = np.diag(sd.ravel() ** 2)
    if kind == "correlated":
        mixed = np.eye(size) + 0.1 * rng.standard_normal((size, size)) / np.sqrt(size)
        covariance = mixed @ covariance @ mixed.T
    noise = np.linalg.cholesky(covariance) @ rng.standard_normal(size)
    sensor = np.diag(rng.uniform(0.5, 2.0, 3)) + 0.05 * rng.standard_normal((3, 3))
    values = rng.standard_normal(3) + up @ sensor.T + noise.reshape(up.shape)
    stated = {
        "stated": {"u": sd},
        "denied": {"u": sd / 3.0},
        "one denied": {"u": sd / [3.0, 1.0, 1.0]},
        "correlated": {"covariance": covariance},
    }.get(kind, {})
    options = {"pooled": {"pool": True}, "closed form": {"closed_form": True}}.get(kind, {})
    return exactly(mp.Readings(values, up=up, unit="g", **stated), **options)


@pytest.mark.parametrize(
    "kind",
    ["unstated", "pooled", "stated", "denied", "one denied", "correlated", "closed form"],
)
@pytest.mark.parametrize("fits", few_and_many(1, 4))
@pytest.mark.usefixtures("without_findings")
def test_profile_of_a_linear_fit_is_its_interval(kind, fits):
    rng = np.random.default_rng(1515)
    for _ in range(fits):
        c = random_linear_fit(kind, rng)
        for output, term in c.model.keys:
            p = c[output, str(term)]
            ends = profile_interval(c, output, str(term))
            # the search for an end stops at 1e-10 U; residuals of 1e-3 are known to 1e-13
            assert_allclose(ends, [p.value - p.U, p.value + p.U], rtol=0, atol=1e-9 * p.U)


def test_profile_needs_the_least_sum_of_squares():
    with pytest.raises(ConvergenceError, match="fit again"):
        search_interval(lambda p: np.array([p[0], 0.5]), [10.0], 0, u=1.0)


def test_profile_may_be_open():
    # a response that flattens: beyond some size no larger one is worse
    low, high = search_interval(
        lambda p: np.array([math.tanh(p[0]) - 0.9]) / 0.2, [math.atanh(0.9)], 0, u=0.3
    )
    assert low < math.atanh(0.9)
    assert math.isinf(high)


# --- criticism


def test_terms_are_judged_by_the_nested_f():
    data = readings("faces-corners-14", quad=5e-3)
    c = exactly(data, scheme="faces-corners-14", model="own-quadratic")
    linear = exactly(data, scheme="faces-corners-14")
    found = {(t.output, t.term): t for t in judge_terms(c)}
    test = found["ax", "x^2"]
    rss = [np.sum(f.residuals[:, 0] ** 2) for f in (linear, c)]
    assert test.inside
    assert test.f == pytest.approx((rss[0] - rss[1]) / (rss[1] / 9), rel=1e-9)
    # one term: F is t²
    p = c["ax", "x^2"]
    assert test.f == pytest.approx((p.value / p.u) ** 2, rel=1e-9)
    assert test.p < 0.01
    assert test.aicc == pytest.approx(aicc(rss[0], 14, 4))
    cubic = found["ax", "x^3"]
    assert not cubic.inside
    wider = exactly(data, scheme="faces-corners-14", model="own-cubic")
    p = wider["ax", "x^3"]
    assert cubic.f == pytest.approx((p.value / p.u) ** 2, rel=1e-6)


def test_aicc_by_hand():
    # n = 10, rss = 10, p = 2, k = 3: 0 + 6 + 24/6
    assert aicc(10.0, 10, 2) == pytest.approx(10.0)
    assert math.isnan(aicc(1.0, 6, 5))
    assert math.isnan(aicc(1.0, 7, 5))  # n − k − 1 is zero


def test_influence_against_leaving_positions_out():
    # eqs. (1), (2) of diagnostics.criticism
    scheme = read_scheme("faces-corners-14")
    data = readings("faces-corners-14")
    c = exactly(data, scheme="faces-corners-14")
    found = find_influence(c)
    for row in (0, 9):
        keep = np.arange(14) != row
        other = exactly(
            mp.Readings(data.values[keep], unit="g"),
            scheme={f"up_{axis}": scheme.up[keep, i] for i, axis in enumerate("xyz")},
        )
        predicted = other.predict(scheme.up[[row]])[0]
        assert_allclose(found.left_out[row], data.values[row] - predicted, atol=1e-14)
        # Cook: the shift of all fitted values over p s²
        change = other.predict(c.reference) - c.predict(c.reference)
        assert_allclose(found.cook[row], np.sum(change**2, axis=0) / 4 / c.residual_sd**2)
        # with s of the others it is t, and r = t sqrt(ν/(ν − 1 + t²))
        left = np.sqrt(1 - c.diagnostics.leverage[row])
        t = (data.values[row] - predicted) / other.residual_sd * left
        assert_allclose(found.studentised[row], t * np.sqrt(10 / (9 + t**2)), rtol=1e-9)


def test_influence_where_a_position_decides_alone():
    c = mp.demo().calibration
    found = find_influence(c)
    decided = c.diagnostics.leverage > 1 - 1e-9
    assert decided.any()
    assert np.isnan(found.left_out[decided]).all()


def test_fourier_view_finds_an_index_error():
    angle = np.arange(24) * math.tau / 24
    up = read_scheme("roll-z-24").up
    rng = np.random.default_rng(1)
    values = up[:, :2] + 1e-3 * np.column_stack([np.cos(3 * angle), 0 * angle])
    values = values + 1e-4 * rng.standard_normal(values.shape)
    c = exactly(mp.Readings(values, unit="g"), scheme="roll-z-24", inputs="x,y", axes="x,y")
    views = fourier_residuals(c)
    assert [(v["roll"], v["output"]) for v in views] == [("z", "ax"), ("z", "ay")]
    third = views[0]["harmonics"][2]
    assert (third["order"], third["cos"]) == (3, pytest.approx(1e-3, abs=1e-4))
    assert third["p"] < 0.01  # the harmonic is in the residuals it is judged by
    assert views[1]["harmonics"][2]["p"] > 0.01


def test_fourier_view_of_rolls_that_share_faces():
    """Ten positions stand in a plane, at eight angles: three orders can be told, no fourth."""
    scheme = "roll-x-8+roll-y-8+roll-z-8"
    up = read_scheme(scheme).up
    values = up + 1e-4 * np.random.default_rng(1).standard_normal(up.shape)
    views = fourier_residuals(exactly(mp.Readings(values, unit="g"), scheme=scheme))
    assert {tuple(h["order"] for h in view["harmonics"]) for view in views} == {(1, 2, 3)}
    assert max(h["amplitude"] for view in views for h in view["harmonics"]) < 1e-3


def test_criticism_needs_known_orientations():
    c = mp.fit(readings("fibonacci-24"), unknown_orientation=True)
    for question in (judge_terms, find_influence, fourier_residuals):
        with pytest.raises(MultiposError, match="needs known orientations"):
            question(c)


@pytest.mark.parametrize("known", [True, False])
def test_trials_need_a_noise_that_is_known(known):
    """Four known positions for four terms, six norms for six parameters: no residuals are left."""
    up = read_scheme("faces-6").up
    if known:
        up = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3.0)
    values = up + np.random.default_rng(4).normal(0.0, 1e-3, up.shape)
    data = mp.Readings(values, up=up if known else None)
    how = {} if known else {"model": "1 + own", "unknown_orientation": True}
    with pytest.raises(MultiposError, match="the noise that trials draw is unknown"):
        simulate_budget(mp.fit(data, **how), trials=100)
    assert simulate_budget(mp.fit(data, reading_sd=1e-3, **how), trials=100).trials == 100

"""What a denied claim is put down to: placement, a term, scatter, unequal outputs; advice fits."""

from dataclasses import replace

import numpy as np
import pytest
from findings_bench import EXACT, texts, warned
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize
from scipy.stats import chi2
from scipy.stats import f as fisher

import multipos as mp
from multipos.diagnostics import residuals, variances
from multipos.diagnostics.residuals import judge_equality, score_equality
from multipos.diagnostics.variances import Residuals, explain_equal, explain_orientations
from multipos.positions.scheme import read_scheme
from tests.diagnostics.test_model_error import BIAS, MATRIX


def readings(scheme, seed, *, off_deg=0.0, sd=1e-4, cubic=0.0):
    rng = np.random.default_rng(seed)
    up = read_scheme(scheme).up
    stood = up + np.cross(np.radians(off_deg) * rng.standard_normal(up.shape), up)
    stood /= np.linalg.norm(stood, axis=1)[:, None]
    values = BIAS + stood @ MATRIX.T + cubic * stood**3
    values = values + np.asarray(sd) * rng.standard_normal(up.shape)
    return mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g")


def told(c, code):
    return [str(finding) for finding in c.findings if finding.code == code]


@pytest.mark.parametrize("stated", [0.0, 3e-5])
@pytest.mark.parametrize("off_deg", [0.0, 0.02, 0.5])
def test_causes_stand_at_the_minimum_of_the_restricted_likelihood(off_deg, stated):
    """Against eq. (2) in one dense matrix, by a search without slopes."""
    # eqs. (1), (2), (3) of diagnostics.variances
    c = mp.fit(readings("fibonacci-24", 3, off_deg=off_deg), model="own-quadratic")
    e = c.residuals.ravel()
    f, H = c.reference, c.model.force_jacobian(c.parameters, c.reference, {})
    X = np.zeros((e.size, len(c.parameters)))
    for i, (own, part) in enumerate(zip(c.model.columns, c.model.slices, strict=True)):
        X[i::3, part] = c.model.basis(f, {})[:, own]
    turned = np.zeros((e.size, e.size))
    for k in range(len(f)):
        J = H[k] @ np.cross(np.eye(3), f[k])
        turned[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = J @ J.T

    def deviance(log):
        V = (stated**2 + np.exp(log[0])) * np.eye(e.size) + np.exp(log[1]) * turned
        W = np.linalg.inv(V)
        S = X.T @ W @ X
        r = e - X @ np.linalg.solve(S, X.T @ W @ e)
        return np.linalg.slogdet(V)[1] + np.linalg.slogdet(S)[1] + r @ W @ r

    found = Residuals(
        c.residuals[None],
        c.model.basis(f, {}),
        c.model.columns,
        H[None],
        f,
        np.full((1, 24, 3), stated**2),
    )
    moved, equal = explain_orientations(found), explain_equal(found)
    starts = [(-18.0, -12.0), (-18.0, -18.0), (-18.0, -30.0)]
    least = min(minimize(deviance, s, method="Nelder-Mead").fun for s in starts)
    assert moved.deviance[0] == pytest.approx(least, abs=0.05)
    alone = minimize(lambda x: deviance([x[0], -60.0]), [-18.0], method="Nelder-Mead").fun
    assert equal.deviance[0] == pytest.approx(alone, abs=0.05)


def across_only(columns):
    """Residuals of 24 turned positions, nothing along the force, beside columns of zeros."""
    rng = np.random.default_rng(4)
    angle = 2.0 * np.pi * np.arange(24.0) / 24.0
    f = np.column_stack([np.sin(angle), np.zeros(24), np.cos(angle)])
    basis = np.column_stack([np.ones(24), *(np.zeros(24) for _ in range(columns))])
    e = np.cross(1e-3 * rng.standard_normal((24, 3)), f)
    own, H = np.arange(1 + columns), np.broadcast_to(np.eye(3), (1, 1, 3, 3))
    return Residuals(e[None], basis, [own] * 3, H, f, np.zeros((1, 24, 3)))


def test_a_column_of_zeros_and_no_scatter_at_all_leave_the_orientation_error():
    alone, beside = (explain_orientations(across_only(columns)) for columns in (0, 1))
    assert_allclose(beside.variances, alone.variances, rtol=1e-6, atol=1e-12)
    assert np.sqrt(alone.variances[0, 1]) == pytest.approx(1e-3, rel=0.3)  # 48 numbers


def test_a_variance_that_runs_away_is_a_thousand_times_the_mean_square_at_most():
    of = across_only(0)
    found = variances._fit(of, [of.across], np.array([[1e30]]))
    assert found.variances[0, 0] <= 1.5e3 * of.scale[0]  # J J' has 2/3 on its diagonal


def test_no_row_that_is_left_has_no_residuals():
    c = mp.fit(readings("faces-6", 1))
    assert residuals._at_listed(c, np.zeros(6, dtype=bool), c.readings.up, np.ones(6)) is None


def test_slow_noise_that_a_log_has_shown_is_not_told_again():
    rng = np.random.default_rng(3)
    up = read_scheme("fibonacci-48").up
    slow = np.cumsum(rng.standard_normal((48, 3)), axis=0)
    values = up + 2e-3 * (slow - slow.mean(axis=0)) / slow.std()
    shown = mp.Finding("time-correlated", "warning", "noise is correlated over 75 rows")
    for findings in ((), (shown,)):
        c = mp.fit(replace(mp.Readings(values, up=up, unit="g"), findings=findings))
        texts = [each.text for each in c.findings if each.code == shown.code]
        assert [text == shown.text for text in texts] == [bool(findings)]


@pytest.mark.parametrize("off_deg", [0.0, 0.3])
def test_where_nothing_hints_at_orientations_the_whole_search_prefers_none(off_deg):
    """The score at zero says what the search would: in half of sets that are not off at all."""
    hints = []
    for seed in range(20):
        c = mp.fit(readings("icosahedron-12", seed, off_deg=off_deg), reading_sd=3e-5, **EXACT)
        found = residuals.residuals_of(c)
        equal, moved = explain_equal(found), explain_orientations(found)
        hints.append(bool(variances.hints_at_orientations(found, equal)[0]))
        assert hints[-1] or not variances.prefers_orientations(equal, moved)[0]
    assert np.mean(hints) >= (0.7 if off_deg else 0.2)
    assert off_deg or np.mean(hints) <= 0.8


@pytest.mark.parametrize(
    ("scheme", "made", "cause"),
    [
        ("fibonacci-24", {"off_deg": 0.3}, "orientation errors of 0."),
        ("fibonacci-24", {"sd": 1e-3}, "variation between rests"),
        ("fibonacci-24", {"sd": [1e-4, 1e-4, 1e-3]}, "unequal (ax "),
        ("faces-6", {"off_deg": 0.3}, "orientation errors and variation"),
    ],
    ids=["placement", "scatter", "unequal", "six faces"],
)
def test_a_denied_claim_names_its_cause(scheme, made, cause):
    c = mp.fit(readings(scheme, 1, **made), reading_sd=1e-4, **EXACT)
    (said,) = told(c, "denied-noise")
    assert "exceed the stated noise (p < 1e-6)" in said
    assert cause in said
    assert ("--orientation-sd" in said) == ("orientation errors" in cause)


@pytest.mark.parametrize(
    ("made", "cause"),
    [
        ({"sd": 1e-3}, "variation between rests"),
        ({"sd": [1e-4, 1e-4, 1e-3]}, "State the noise of each output"),
    ],
    ids=["scatter", "unequal"],
)
def test_a_claim_is_denied_beside_estimated_orientation_errors(made, cause):
    (said,) = told(mp.fit(readings("fibonacci-24", 1, **made), reading_sd=1e-4), "denied-noise")
    assert cause in said
    assert "--orientation-sd" not in said


@pytest.mark.parametrize("scheme", ["faces-6", "icosahedron-12", "fibonacci-24"])
def test_orientation_errors_that_are_estimated_deny_no_claim(scheme):
    """A right claim is denied in one of a thousand sets, less than one of 30 here."""
    found = [
        told(mp.fit(readings(scheme, seed, off_deg=0.3), reading_sd=1e-4), "denied-noise")
        for seed in range(30)
    ]
    assert sum(map(bool, found)) <= 1


def test_a_missing_term_explains_noise_beyond_the_stated_one():
    cal = mp.fit(readings("fibonacci-24", 1, cubic=2e-3), reading_sd=1e-4)
    (said,) = told(cal, "missing-term")
    assert "own^3" in said
    assert told(cal, "denied-noise") == []


def test_the_placement_that_is_named_is_the_one_that_was_made():
    """s of the likelihood against the steps that were made: 48 angles, so to a fifth at 95 %."""
    (said,) = told(mp.fit(readings("fibonacci-24", 2, off_deg=0.3), **EXACT), "placement")
    assert "--orientation-sd auto" in said
    size = float(said.split("orientation errors of ")[1].split(" degrees")[0])
    assert size == pytest.approx(0.3, rel=0.3)
    auto = mp.fit(readings("fibonacci-24", 2, off_deg=0.3), orientation_sd="auto")
    assert size == pytest.approx(auto.variance_components.orientation_sd_deg.value, rel=0.15)


def test_where_auto_could_not_tell_nobody_is_sent_to_it():
    for scheme in ("faces-6", "icosahedron-12"):
        assert told(mp.fit(readings(scheme, 3, off_deg=0.3)), "placement") == []


def test_under_unknown_orientation_nobody_is_sent_to_orientation_sd():
    data = readings("fibonacci-24", 4, sd=1e-3)
    c = mp.fit(data, reading_sd=1e-4, unknown_orientation=True)
    (said,) = told(c, "denied-noise")
    assert "--orientation-sd" not in " ".join(texts(c))
    assert "variation between rests" in said
    assert c.diagnostics.claim.dof == 24 - 9


def test_outputs_of_unequal_noise_are_fitted_as_such():
    data = readings("fibonacci-24", 5, sd=[1e-4, 1e-4, 1e-3], off_deg=0.02)
    for options in ({}, EXACT, {"orientation_sd": 0.02}):
        c = mp.fit(data, **options)
        assert told(c, "unequal-noise") == []
        assert 1.5 * max(c["bias_ax"].U, c["bias_ay"].U) < c["bias_az"].U


def test_outputs_of_unequal_noise_are_named_where_it_is_stated_otherwise():
    data = readings("fibonacci-24", 5, sd=[1e-4, 2e-4, 1e-4])
    (said,) = told(mp.fit(data, orientation_sd=1e-4, reading_sd=1e-4), "unequal-noise")
    assert "--reading-sd" in said
    p, sizes = judge_equality(mp.fit(data, orientation_sd=1e-4, reading_sd=1e-4))
    assert p < 0.01
    assert sizes[1] > 1.4 * max(sizes[0], sizes[2])


def test_good_claims_are_not_doubted():
    for how in ({"reading_sd": 1e-4}, {}, {"unknown_orientation": True}):
        c = mp.fit(readings("fibonacci-24", 6), **how)
        assert {*warned(c)} <= {"orientation-ignored"}


@pytest.mark.parametrize("seed", range(4))
def test_groups_that_leave_directions_free_end_no_fit(seed):
    # one group has a single position, whose turn about the vertical nothing tells
    up = read_scheme("all-26").up
    group = "03303433340330100000111121"
    values = up + 5e-3 * np.random.default_rng(seed).standard_normal(up.shape)
    columns = dict(zip(("up_x", "up_y", "up_z", "ax", "ay", "az"), (*up.T, *values.T), strict=True))
    columns["group"] = list(map(int, group))
    fitted = mp.fit(columns, orientation_sd=0.1, reading_sd=0.001)
    assert 0.0 <= judge_equality(fitted)[0] <= 1.0


def test_outputs_whose_parameters_take_all_are_not_told_apart():
    """Two outputs, one row and a parameter for each: W - W A S^-1 A'W is zero, by hand."""
    one = np.eye(2)[:, :, None, None]
    statistic, sizes = score_equality(one, one, one, np.ones((2, 1, 1)), np.ones((2, 1, 1)))
    assert statistic[0] == 0.0
    assert not sizes.any()


def test_steps_follow_the_slopes_of_the_deviance():
    """Slopes by differences of D, the step by hand; what is held at zero does not move."""
    rng = np.random.default_rng(1)
    force = read_scheme("fibonacci-24").up
    found = Residuals(
        1e-4 * rng.standard_normal((2, 24, 3)),
        np.column_stack([np.ones(24), force]),
        [np.arange(4)] * 3,
        np.tile(MATRIX, (2, 1, 1, 1)),
        force,
        np.full((2, 24, 3), 4e-9),
    )
    parts = [np.eye(3)[..., None, None], found.across]
    theta, by = np.array([[9e-9, 2e-9], [4e-9, 1e-9]]), np.diag([1e-12, 1e-12])
    here = variances._evaluate(found, parts, theta)
    slopes = np.empty((2, 2))
    for j in range(2):
        up, down = (variances._evaluate(found, parts, theta + s * by[j]) for s in (1, -1))
        slopes[:, j] = (up.deviance - down.deviance) / 2e-12
    assert_allclose(here.expected - here.observed, slopes, rtol=1e-3)
    step, gain = variances._step(theta, here)
    for b in range(2):
        newton = -np.linalg.solve(here.curvature[b], slopes[b])
        assert_allclose(step[b], newton, rtol=3e-3)
        assert gain[b] == pytest.approx(-0.5 * newton @ slopes[b], rel=3e-3)
    held = here._replace(observed=np.where([[True, False]], 0.5 * here.expected, here.observed))
    still = variances._step(theta * [0.0, 1.0], held)[0]
    assert_array_equal(still[:, 0], 0.0)
    assert_allclose(still[:, 1], -slopes[:, 1] / here.curvature[:, 1, 1], rtol=3e-3)


def test_what_lies_across_the_force_by_an_f_test_of_four_hundred_units():
    """R with projections of its own and SciPy's F, half of the units with rows turned."""
    # eq. (4) of diagnostics.variances
    rng = np.random.default_rng(2)
    force = read_scheme("fibonacci-24").up
    design = np.column_stack([np.ones(24), force])
    left = np.eye(24) - design @ np.linalg.pinv(design)
    noise = rng.standard_normal((400, 24, 3))
    noise[200:] += 2.0 * np.cross(rng.standard_normal((200, 24, 3)), force)
    e = np.einsum("kl,blm->bkm", left, noise)
    found = Residuals(
        e, design, [np.arange(4)] * 3, np.eye(3)[None, None], force, np.zeros(e.shape)
    )
    every = np.hstack([force[:, [i]] * design for i in range(3)])  # of what is along the force
    along_nu = 24 - np.linalg.matrix_rank(every)
    across_nu = 3 * 20 - along_nu
    sd = np.sqrt(np.sum(e**2, axis=1) / 20.0)[:, None]
    normal = force * sd
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    along = np.sum(np.sum(normal * (e / sd), axis=2) ** 2, axis=1)
    ratio = (60.0 - along) / across_nu / (along / along_nu)
    said = (ratio > fisher.ppf(0.98, across_nu, along_nu)) & (3.0 * along <= 60.0)
    assert_array_equal(variances.across_the_force(found), said)
    assert said[:200].mean() < 0.06
    assert said[200:].mean() > 0.3


def test_equal_noise_is_judged_by_its_score():
    """In one dense matrix, of positions so nearly known that their angles change nothing."""
    # eq. (1) of diagnostics.residuals
    data = readings("fibonacci-24", 5, sd=[1e-4, 1.3e-4, 0.8e-4])
    c = mp.fit(data, orientation_sd=1e-5, reading_sd=1e-4, exclude="none")
    X = np.kron(np.column_stack([np.ones(24), data.up]), np.eye(3))
    v = np.tile(np.mean(c.sd_of_readings**2, axis=0), 24)
    P = (np.eye(72) - X @ np.linalg.pinv(X)) / v  # of outputs that share no parameter
    push = P @ data.values.ravel()
    C = [np.diag(np.where(np.arange(72) % 3 == i, v, 0.0)) for i in range(3)]
    traces = np.array([np.trace(P @ each) for each in C])
    squares = np.array([push @ each @ push for each in C])
    U = 0.5 * (squares / (squares.sum() / traces.sum()) - traces)
    information = [[0.5 * np.trace(P @ a @ P @ b) for b in C] for a in C]
    p, sizes = judge_equality(c)
    assert p == pytest.approx(chi2.sf(U @ np.linalg.solve(information, U), 2), rel=0.02)
    assert_allclose(sizes[1] / sizes[0], 1.3, rtol=0.3)
    assert p < 0.2


def test_equal_noise_is_judged_alike_by_variances_and_by_their_matrix():
    data = readings("fibonacci-24", 5, sd=[1e-4, 2e-4, 1e-4])
    tied = np.kron(np.eye(24), np.eye(3) + 0.05 * (1.0 - np.eye(3)))
    full = mp.Readings(data.values, up=data.up, unit="g", covariance=1e-8 * tied)
    plain = mp.Readings(data.values, up=data.up, unit="g", u=np.full((24, 3), 1e-4))
    found = [judge_equality(mp.fit(each, orientation_sd=1e-4))[0] for each in (full, plain)]
    assert found[0] == pytest.approx(found[1], rel=0.5)  # excess is of all outputs, or of each
    assert found[0] < 0.01

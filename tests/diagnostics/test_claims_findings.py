"""What a denied claim is put down to: placement, a term, scatter, unequal outputs; advice fits."""

from dataclasses import replace

import numpy as np
import pytest
from findings_bench import EXACT, texts, warned
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2
from scipy.stats import f as fisher

import multipos as mp
from multipos.diagnostics import variances
from multipos.diagnostics.residuals import judge_equality, score_equality
from multipos.diagnostics.variances import Residuals
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
    """s of mean squares against the steps that were made: 48 angles, so to a fifth at 95 %."""
    (said,) = told(mp.fit(readings("fibonacci-24", 2, off_deg=0.3), **EXACT), "placement")
    assert "--orientation-sd auto" in said
    size = float(said.split("orientation errors of ")[1].split(" degrees")[0])
    assert size == pytest.approx(0.3, rel=0.3)
    auto = mp.fit(readings("fibonacci-24", 2, off_deg=0.3), orientation_sd="auto")
    assert size == pytest.approx(auto.variance_components.orientation_sd_deg.value, rel=0.3)


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


def test_what_lies_across_the_force_by_an_f_test_of_four_hundred_units():
    """R with projections of its own and SciPy's F, half of the units with rows turned."""
    # eqs. (1), (2) of diagnostics.variances
    rng = np.random.default_rng(2)
    force = read_scheme("fibonacci-24").up
    design = np.column_stack([np.ones(24), force])
    left = np.eye(24) - design @ np.linalg.pinv(design)
    noise = rng.standard_normal((400, 24, 3))
    noise[200:] += 2.0 * np.cross(rng.standard_normal((200, 24, 3)), force)
    e = np.einsum("kl,blm->bkm", left, noise)
    found = Residuals(e, design, [np.arange(4)] * 3, np.eye(3)[None, None], force)
    every = np.hstack([force[:, [i]] * design for i in range(3)])  # of what is along the force
    along_nu = 24 - np.linalg.matrix_rank(every)
    across_nu = 3 * 20 - along_nu
    sd = np.sqrt(np.sum(e**2, axis=1) / 20.0)[:, None]
    normal = force * sd
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    along = np.sum(np.sum(normal * (e / sd), axis=2) ** 2, axis=1)
    ratio = (60.0 - along) / across_nu / (along / along_nu)
    said = (ratio > fisher.ppf(0.99, across_nu, along_nu)) & (3.0 * along <= 60.0)
    assert_array_equal(variances.across_the_force(found), said)
    assert said[:200].mean() < 0.03
    assert said[200:].mean() > 0.2
    q = np.sum(np.einsum("bkm,km->bk", e, force) ** 2, axis=1), np.sum(e**2, axis=(1, 2))
    equal, unequal, oriented = variances.deviances_of(found)
    assert_allclose(equal, 60.0 * np.log(q[1] / 60.0))
    assert_allclose(unequal, 20.0 * np.log(np.sum(e**2, axis=1) / 20.0).sum(axis=1))
    squares = q[0] / along_nu, (q[1] - q[0]) / across_nu
    more = squares[1] > squares[0]
    wanted = along_nu * np.log(squares[0]) + across_nu * np.log(squares[1])
    assert_allclose(oriented, np.where(more, wanted, np.inf))
    s = variances.orientation_sd(found)
    assert ((s > 0.0) == more).all()
    assert np.median(s[200:]) == pytest.approx(2.0, rel=0.1)


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

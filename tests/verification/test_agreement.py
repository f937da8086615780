"""Does a run agree with the calibration: by a dense covariance, by hand, and by simulation."""

import json
import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from amounts import few_and_many
from findings_bench import texts
from numpy.testing import assert_allclose

import multipos as mp
from multipos import cli
from multipos.positions.scheme import read_scheme
from multipos.verification.agreement import _dof_of_steps, _Weights
from multipos.verification.verdicts import family_confidence

UP = read_scheme("faces-edges-18").up
MATRIX = np.array([[1.01, 0.002, -0.001], [0.003, 0.99, 0.001], [0.003, -0.002, 1.004]])
SD = 1e-3


def run(seed, bias=0.0, sd=SD, up=UP, **more):
    rng = np.random.default_rng(seed)
    values = [0.012, -0.02, 0.005] + up @ MATRIX.T + sd * rng.standard_normal(up.shape)
    values[:, 0] += bias
    return mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g", **more)


def known_noise():
    """Return a calibration whose noise is known for certain."""
    cal = mp.fit(run(0), reading_sd=SD)
    return replace(cal, dof=np.full(3, np.inf), parameter_dof=np.full(12, np.inf))


def test_statistic_of_known_noise_by_the_dense_covariance_of_compensated_force():
    """A second route: errors e of force, their whole covariance built and inverted."""
    # eqs. (1), (2) of verification.agreement
    cal = known_noise()
    found = mp.check(cal, run(1), reading_sd=SD)
    inverse = np.linalg.inv(cal.sensitivity)
    X = np.zeros((54, 12))
    for row, up in enumerate(UP):
        for output in range(3):
            X[3 * row + output, 4 * output : 4 * output + 4] = [1.0, *up]
    wide = np.kron(np.eye(18), inverse)
    V = wide @ (X @ cal.covariance @ X.T + SD**2 * np.eye(54)) @ wide.T
    e = found.after.ravel()
    assert_allclose(found.consistency.statistic, e @ np.linalg.solve(V, e), rtol=1e-7)
    assert found.consistency.dof == 54
    assert "chi-square" in found.consistency.test


def test_statistic_of_pooled_outputs_is_f_on_all_errors_and_the_pooled_degrees():
    cal = mp.fit(run(0), pool=True)
    found = mp.check(cal, run(1)).consistency
    assert_allclose(found.dof, [54, 42])  # 18·3 errors; 18·3 readings less 12 parameters
    left = run(1).values - cal.predict(UP)
    X = np.column_stack([np.ones(18), UP])
    K = np.eye(18) + X @ np.linalg.inv(X.T @ X) @ X.T
    s2 = float(np.sum(cal.residuals**2)) / 42
    q = sum(column @ np.linalg.solve(K, column) for column in left.T) / s2
    assert_allclose(found.statistic, q / 54, rtol=1e-9)


def test_a_zero_that_moved_is_told_where_every_position_passes():
    cal = mp.fit(run(0))
    moved = 7.0 * cal["bias_ax"].U
    found = mp.check(cal, run(1, moved), limit_g=0.02)
    assert found.verdict == found.run_verdict == "pass"
    (finding,) = found.findings
    assert (finding.code, finding.level) == ("run-disagrees", "warning")
    assert "a change of bias_ax by +0.0" in finding.text
    assert texts(found)[0].startswith(finding.text)
    assert found.consistency.p < 0.05
    assert mp.check(cal, run(1), limit_g=0.02).findings == ()


def test_en_and_the_verdict_of_the_run_by_hand():
    cal = known_noise()
    found = mp.check(cal, run(1), reading_sd=SD, limit_g=0.01)
    assert_allclose(found.En, np.abs(found.after) / found.U)
    # 0.05/54 two-sided of the normal law: 3.3124 from any table, beside 1.95996
    assert_allclose(found.U_family / found.U, 3.3124 / 1.95996, rtol=1e-4)
    assert_allclose(family_confidence(0.95, 54), 1 - 0.05 / 54)
    largest = float(np.abs(found.after).max())
    row, column = np.argwhere(np.abs(found.after) == largest)[0]
    U, U_family = found.U[row, column], found.U_family[row, column]
    off = run(1).values.copy()
    off[row, column] += math.copysign(0.01, found.after[row, column])
    again = mp.Readings(off, outputs=cal.outputs, up=UP, unit="g")
    size = largest + 0.01
    for limit, verdicts in (
        (size - 0.9 * U, ("indeterminate", "indeterminate")),
        (size - 1.2 * U, ("fail", "indeterminate")),
        (size - 1.1 * U_family, ("fail", "fail")),
    ):
        got = mp.check(cal, again, reading_sd=SD, limit_g=limit)
        assert (got.verdict, got.run_verdict) == verdicts


def test_a_run_taken_wrongly_is_named():
    cal = mp.fit(run(0))
    values = run(1).values.copy()
    values[[2, 9]] = values[[9, 2]]
    found = mp.check(cal, mp.Readings(values, outputs=cal.outputs, up=UP, unit="g"))
    assert found.findings[0].code == "interchanged-rows"
    assert found.findings[0].text.startswith("the run: ")
    assert found.findings[-1].code == "run-disagrees"


def test_the_mounting_that_unknown_orientations_leave_free_is_no_disagreement():
    cal = mp.fit(run(0), unknown_orientation=True)
    angle = np.radians(20.0)
    turn = np.array(
        [
            [np.cos(angle), -np.sin(angle), 0.0],
            [np.sin(angle), np.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    straight = mp.check(cal, run(1)).consistency
    mounted = mp.check(cal, mp.Readings(run(1).values, outputs=cal.outputs, up=UP @ turn, unit="g"))
    assert_allclose(mounted.consistency.statistic, straight.statistic, rtol=1e-6)
    assert straight.p > 0.01


def test_scatter_from_rest_to_rest_is_part_of_a_run_that_states_its_u():
    stated = np.full((18, 3), 0.1 * SD)
    cal = mp.fit(run(0, u=stated))
    assert cal.variance_components.rest_to_rest["ax"].value > 0.5 * SD
    found = mp.check(cal, run(1, u=stated))
    assert np.all(found.u > 0.5 * SD)
    assert found.consistency.p > 0.01


def test_json_holds_and_gives_back_all_of_it(tmp_path, capsys):
    cal = mp.fit(run(0))
    cal.save(tmp_path / "cal.json")
    found = mp.check(cal, run(1, 7.0 * cal["bias_ax"].U), limit_g=0.005)
    found.save(tmp_path / "check.json")
    content = json.loads((tmp_path / "check.json").read_text())
    assert set(content["consistency"]) == {"statistic", "dof", "p", "test"}
    assert content["findings"][0]["code"] == "run-disagrees"
    assert content["run_verdict"] == found.run_verdict
    assert_allclose(content["positions"][3]["En"]["y"], found.En[3, 1])
    again = mp.load_check(tmp_path / "check.json")
    assert again == found
    for key in ("consistency", "findings"):
        del content[key]
    for row in content["positions"]:
        del row["En"], row["U_family"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    old = mp.load_check(tmp_path / "old.json")
    assert (old.consistency, old.findings, old.run_verdict) == (None, (), old.verdict)
    columns = dict(zip(cal.outputs, run(1).values.T, strict=True))
    mp.write_table(tmp_path / "run.csv", columns)
    given = ["check", str(tmp_path / "cal.json"), str(tmp_path / "run.csv")]
    assert cli.main([*given, "--scheme", "faces-edges-18", "-v"]) == 0
    assert "\nconsistent with the calibration: F of the run" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("without_findings")
def test_a_run_in_control_is_inconsistent_in_one_of_twenty_and_fails_as_seldom():
    """300 days: 15 ± 3.8 inconsistent by chance; more than 29 come once in 5000 such studies."""
    inconsistent = failed = 0
    for seed in range(300):
        cal = mp.fit(run(2 * seed + 1000), pool=True)
        found = mp.check(cal, run(2 * seed + 1001, 2.5e-3 * 1.011), limit_g=3e-3)
        failed += found.run_verdict == "fail"
        inconsistent += mp.check(cal, run(2 * seed + 1001)).consistency.p < 0.05
    assert 3 <= inconsistent <= 29
    assert failed <= 29


def over_soaks(temperatures, rng, zeros, shift=0.0):
    """Return six faces at every temperature: bias and scale by hand, a zero of its own each."""
    faces = mp.read_scheme("faces-6").up
    T = np.repeat(np.array(temperatures), 6)
    up = np.tile(faces, (len(temperatures), 1))
    own = np.repeat(rng.normal(0.0, zeros, (len(temperatures), 3)), 6, axis=0)
    values = up * (1.0 + 1e-5 * (T - 20.0))[:, None] + 2e-5 * (T - 20.0)[:, None]
    values += 1e-3 + shift + own + rng.normal(0.0, 1e-4, values.shape)
    names = ("up_x", "up_y", "up_z", "ax", "ay", "az")
    return dict(zip(names, (*up.T, *values.T), strict=True)) | {"temperature": T}


@pytest.mark.parametrize("run", [(20.0,), (-30.0, 0.0, 50.0)])
@pytest.mark.parametrize("zeros", [0.0, 5e-4])
@pytest.mark.parametrize(("sensors", "most"), few_and_many((12, 1), (40, 3)))
@pytest.mark.usefixtures("without_findings")
def test_zeros_of_soaks_make_no_run_disagree(run, zeros, sensors, most):
    """Sensors of five soaks: at 1 % more of 12 or 40 runs disagree with a chance of .6 and .1 %."""
    found = 0
    for seed in range(sensors):
        rng = np.random.default_rng(seed)
        table = over_soaks((-40.0, -15.0, 10.0, 35.0, 60.0), rng, zeros)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cal = mp.fit(table, model="1 + own + temperature + temperature*own", unit="g")
            checked = mp.check(cal, over_soaks(run, rng, zeros))
        found += "run-disagrees" in [one.code for one in checked.findings]
    assert found <= most
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        far = mp.check(cal, over_soaks(run, rng, zeros, shift=2e-2))
    assert "run-disagrees" in [one.code for one in far.findings]


@pytest.mark.parametrize("tilt", [False, True])
@pytest.mark.parametrize("sensors", [16, pytest.param(80, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("without_findings")
def test_zeros_of_soaks_are_in_the_uncertainty_of_every_error(tilt, sensors):
    """Five soaks, zeros of five times the noise: U of rows held 80 % (tilt 74) without them.

    Errors of a soak share one zero, so that the share of a sensor has a standard deviation of .1:
    three of the mean's standard deviations beside .95 are allowed.
    """
    held = []
    for seed in range(sensors):
        rng = np.random.default_rng([seed, 7])
        table = over_soaks((-40.0, -15.0, 10.0, 35.0, 60.0), rng, 5e-4)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cal = mp.fit(table, model="1 + own + temperature + temperature*own", unit="g")
            found = mp.check(cal, over_soaks((-30.0, 0.0, 50.0), rng, 5e-4), tilt=tilt)
        held.append(np.mean(np.abs(found.after) <= found.U))
    assert np.mean(held) == pytest.approx(0.95, abs=3.0 * 0.1 / np.sqrt(sensors))


def test_the_step_that_is_named_is_that_of_generalised_least_squares():
    """One column against the dense covariance of readings, the parameter that takes most of Q."""
    # eq. (3) of verification.agreement
    cal = known_noise()
    given = run(1, bias=0.004)
    X = np.zeros((54, 12))
    for row, up in enumerate(UP):
        for output in range(3):
            X[3 * row + output, 4 * output : 4 * output + 4] = [1.0, *up]
    V = X @ cal.covariance @ X.T + SD**2 * np.eye(54)
    r = (given.values - cal.predict(UP)).ravel()
    weighed = np.linalg.solve(V, X)
    own = np.einsum("ij,ij->j", X, weighed)
    steps = weighed.T @ r / own
    best = int(np.argmax(steps**2 * own))
    assert cal.names[best] == "bias_ax"
    (finding,) = mp.check(cal, given, reading_sd=SD).findings
    assert (
        f"bias_ax by {steps[best]:+.3g} g ({abs(steps[best]) / cal.U[best]:.2g} U)" in finding.text
    )


def test_rows_that_are_interchanged_explain_why_a_run_disagrees():
    up = mp.read_scheme("all-26").up
    values = up + 1e-4 * np.random.default_rng(5).standard_normal(up.shape)
    cal = mp.fit(mp.Readings(values, up=up, unit="g"))
    values[[3, 11]] = values[[11, 3]]
    found = mp.check(cal, mp.Readings(values, up=up, unit="g"))
    assert found.findings[0].code == "interchanged-rows"
    (disagrees,) = (each for each in found.findings if each.code == "run-disagrees")
    assert "probable cause" not in disagrees.text
    assert disagrees.action == ""


def test_weights_beside_free_columns_by_matrices():
    """V⁻¹ − V⁻¹F(F'V⁻¹F)⁻¹F'V⁻¹ of V = I + LL', written out."""
    rng = np.random.default_rng(5)
    L, F, a, b = (rng.normal(size=(9, k)) for k in (3, 2, 1, 2))
    W = np.linalg.inv(np.eye(9) + L @ L.T)
    W -= W @ F @ np.linalg.inv(F.T @ W @ F) @ F.T @ W
    assert_allclose(_Weights(L, F).product(a, b), a.T @ W @ b, atol=1e-12)


@pytest.mark.parametrize("nu", [10.0, math.inf])
def test_degrees_of_freedom_of_a_step_by_its_share_from_soaks(nu):
    """1/(s²/q + (1 − s)²/ν), s by how much the last column of L takes from X'V⁻¹X."""
    rng = np.random.default_rng(6)
    X, L = rng.normal(size=(7, 2)), rng.normal(size=(7, 3))
    known, whole = (
        np.diag(X.T @ np.linalg.solve(np.eye(7) + own @ own.T, X)) for own in (L[:, :2], L)
    )
    s = 1.0 - whole / known
    free = np.zeros((7, 0))
    model = SimpleNamespace(output_of=(0, 1))
    c = SimpleNamespace(
        parameters=np.zeros(2), dof=np.array([nu, 40.0]), model=model,
        parameter_dof=np.full(2, math.inf),
    )  # fmt: skip
    run = SimpleNamespace(soaks=1, q=np.array([3.0, 5.0]))
    found = _dof_of_steps(c, run, _Weights(L, free), [L, free, X, None])
    expected = 1.0 / (s**2 / [3.0, 5.0] + (1.0 - s) ** 2 / min(nu, 40.0))
    assert_allclose(found, expected, rtol=1e-9)
    run.soaks = 0
    assert_allclose(_dof_of_steps(c, run, _Weights(L, free), [L, free, X, None]), min(nu, 40.0))


@pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
def test_noise_far_below_the_errors_of_orientation_is_met():
    """1e-12 beside .1 degrees: their variances of a row have no digit in common."""
    up = read_scheme("edges-12").up
    off = up + 1e-3 * np.cos(np.arange(36.0)).reshape(12, 3)
    run = mp.Readings(off, up=up, orientation_sd=np.full(12, np.radians(0.1)))
    cal = mp.fit(mp.Readings(off, up=up), reading_sd=1e-12)
    assert mp.check(cal, run, limit_g=0.01, reading_sd=1e-12).findings

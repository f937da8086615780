"""Terms that a model lacks: score tests against nested fits, what positions hide, what is said."""

import json
from dataclasses import replace

import numpy as np
import pytest
from findings_bench import EXACT, texts, warned
from numpy.testing import assert_allclose

import multipos as mp
from multipos.diagnostics.model_error import _way_out
from multipos.diagnostics.projections import hides, lacking, sphere
from multipos.diagnostics.score_tests import judge_included, judge_model, significant
from multipos.positions.scheme import read_scheme
from multipos.sensor.calibration_file import from_dict

BIAS = np.array([0.012, -0.021, 0.034])
MATRIX = np.array([[1.012, 0.007, -0.003], [0.005, 0.99, 0.007], [-0.007, 0.004, 1.003]])
BEYOND = {
    "nothing": lambda f: 0.0 * f,
    "own^2": lambda f: f**2,
    "own^3": lambda f: f**3,
    "own*|own|": lambda f: f * np.abs(f),
    "own*other": lambda f: f * np.roll(f, 1, axis=1),
}


def readings(scheme, truth, seed, size=2e-3, sd=1e-4, **columns):
    up = read_scheme(scheme).up
    noise = sd * np.random.default_rng(seed).standard_normal(up.shape)
    values = BIAS + up @ MATRIX.T + size * BEYOND[truth](up) + noise
    return mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g", **columns)


def codes(c):
    return [finding.code for finding in c.diagnostics.findings]


def test_at_known_positions_it_is_the_f_test_of_nested_models():
    """Δ and R of the score test are those of two fits, one with the term."""
    # eq. (1) of diagnostics.score_tests
    data = readings("fibonacci-24", "own^3", 1, size=1e-4)
    c = mp.fit(data, **EXACT)
    tests = {test.term: test for test in c.diagnostics.model_tests}
    for term, formula, q in (("own^2", "own^2", 1), ("own*other", "own*other", 2)):
        larger = mp.fit(data, model=f"1 + x + y + z + {formula}", **EXACT)
        few, many = (np.sum(fit.residuals**2, axis=0) for fit in (c, larger))
        ratios = (few - many) / q / (many / (24 - 4 - q))
        # the same sums of squares on two ways: ten digits
        assert_allclose(tests[term].ratios, ratios, rtol=1e-8)


def test_a_stated_noise_makes_one_test_of_all_outputs():
    c = mp.fit(readings("fibonacci-24", "own^2", 2), reading_sd=1e-4, **EXACT)
    test = next(t for t in c.diagnostics.model_tests if t.term == "own^2")
    assert test.outputs == ()
    assert test.dof == (3.0, 3 * 24 - 12 - 3)
    # R of pooled sums over what was found of each output's noise, by hand
    larger = mp.fit(readings("fibonacci-24", "own^2", 2), model="own-quadratic", **EXACT)
    chi2 = [float(np.sum((fit.residuals / c.sd_of_readings) ** 2)) for fit in (c, larger)]
    assert_allclose(test.statistic, (chi2[0] - chi2[1]) / 3 / (chi2[1] / 57), rtol=1e-8)


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"reading_sd": 1e-4},
        {"orientation_sd": "auto"},
        {"unknown_orientation": True},
        {"robust": "huber"},
        {"pool": True},
    ],
    ids=["plain", "stated", "auto", "unknown", "robust", "pooled"],
)
@pytest.mark.parametrize("truth", ["own^2", "own^3", "own*other"])
def test_a_missing_term_is_named_in_every_estimator(how, truth):
    c = mp.fit(readings("fibonacci-24", truth, 3), **how)
    finding = next(d for d in c.diagnostics.findings if d.code == "missing-term")
    assert finding.level == "warning"
    assert truth in finding.text  # turned by hand, own*|own| explains nearly as much as own^3
    assert finding.action.startswith("Fit with --model '1 + x + y + z + own")
    assert any(said.startswith(finding.text) for said in texts(c))


def test_the_formula_that_is_printed_mends_the_fit():
    data = readings("fibonacci-24", "own*other", 4)
    told = next(d.action for d in mp.fit(data).diagnostics.findings if d.code == "missing-term")
    formula = told.split("--model '")[1].split("'")[0]
    mended = mp.fit(data, model=formula)
    assert warned(mended) == []
    assert abs(mended["ax", "x*z"].value - 2e-3) < mended["ax", "x*z"].U


def test_two_missing_terms_are_named_together():
    data = readings("fibonacci-24", "own^3", 5)
    data = mp.Readings(data.values + 1e-3 * data.up**2, outputs=data.outputs, up=data.up, unit="g")
    told = next(d.text for d in mp.fit(data).diagnostics.findings if d.code == "missing-term")
    assert "own^3 and own^2" in told


@pytest.mark.parametrize(
    ("scheme", "model", "hidden"),
    [
        ("faces-6", "linear", ("own*|own|", "own^3", "own*other")),
        ("faces-6", "own-quadratic", ("own*|own|", "own^3", "own*other")),
        ("edges-12", "linear", ("own*|own|", "own^3")),  # an edge is at ±1/√2 or 0
        ("corners-8", "linear", ("own^2", "own*|own|", "own^3")),
        ("icosahedron-12", "linear", ()),
        ("faces-corners-14", "linear", ()),
        ("dual-axis-48", "linear", ("own*other",)),  # x and y never together
        ("roll-z-24", "1 + x + y", ()),  # within the plane that was applied
    ],
)
def test_what_positions_hide_by_hand(scheme, model, hidden):
    data = readings(scheme, "nothing", 6)
    c = mp.fit(data, model=model)
    assert c.diagnostics.hidden == hidden
    assert ("hidden-terms" in codes(c)) == bool(hidden)


def test_faces_that_are_nearly_level_hide_as_faces_do():
    rng = np.random.default_rng(7)
    up = np.vstack([read_scheme("faces-6").up] * 2)
    up = up + np.radians(1.0) * rng.standard_normal(up.shape)
    up /= np.linalg.norm(up, axis=1)[:, None]
    values = BIAS + up @ MATRIX.T + 1e-4 * rng.standard_normal(up.shape)
    assert mp.fit(mp.Readings(values, up=up)).diagnostics.hidden == (
        "own*|own|",
        "own^3",
        "own*other",
    )


def test_what_a_budget_states_is_not_hidden():
    data = readings("faces-6", "nothing", 8)
    unseen = {"own^3": 2e-3, "own*|own|": 1e-3, "own*other": 2e-3}
    assert "hidden-terms" not in codes(mp.fit(data, budget={"unseen": unseen}))
    only = mp.fit(data, budget={"unseen": {"own^3": 2e-3, "own*|own|": 0.0}})
    assert only.diagnostics.hidden == ("own*|own|", "own^3", "own*other")
    assert "own*other cannot be determined" in next(d.text for d in only.diagnostics.findings)


def test_tests_and_hidden_terms_go_through_files():
    c = mp.fit(readings("dual-axis-48", "nothing", 9), **EXACT)
    content = json.loads(json.dumps(c.to_dict()))["diagnostics"]
    assert content["hidden"] == ["own*other"]
    first = content["model_tests"][0]
    assert set(first) == {"term", "statistic", "dof", "p", "outputs"}
    back = from_dict(json.loads(json.dumps(c.to_dict()))).diagnostics
    assert back.model_tests == c.diagnostics.model_tests
    assert [t.p for t in back.model_tests] == [t.p for t in c.diagnostics.model_tests]


def test_a_temperature_that_the_model_leaves_out_is_asked_of():
    rng = np.random.default_rng(10)
    data = readings("fibonacci-24", "nothing", 10)
    warm = rng.uniform(15.0, 35.0, 24)
    columns = {"outputs": data.outputs, "up": data.up, "environment": {"temperature": warm}}
    plain = mp.fit(mp.Readings(data.values, **columns))
    assert {"temperature", "temperature*own"} <= {t.term for t in plain.diagnostics.model_tests}
    assert "missing-term" not in codes(plain)
    drifting = mp.fit(mp.Readings(data.values + 1e-4 * (warm[:, None] - 25.0), **columns))
    told = next(d.text for d in drifting.diagnostics.findings if d.code == "missing-term")
    assert "the model lacks temperature" in told


def test_false_alarms_of_the_whole_set():
    """Good sets of 12 positions: 1 % of 400 is 4; more than 12 has a chance of one in 2,700."""
    up = read_scheme("icosahedron-12").up
    rng = np.random.default_rng(11)
    first = mp.fit(readings("icosahedron-12", "nothing", 11))
    X = np.column_stack([np.ones(12), up])
    left = np.eye(12) - X @ np.linalg.pinv(X)
    alarms = 0
    for _ in range(400):
        c = replace(first, residuals=left @ rng.standard_normal((12, 3)) * 1e-4)
        alarms += bool(significant(judge_model(c).tests))
    assert alarms <= 12


def test_a_term_that_shows_only_beside_another_is_asked_for_where_all_of_it_shows():
    c = mp.fit(readings("faces-6", "nothing", 8))
    assert "own*|own|" not in {test.term for test in c.diagnostics.model_tests}
    assert _way_out(c, ("own*|own|",)).endswith("at positions that show all of it.")


def test_noise_that_differs_between_outputs_weighs_their_sums():
    """R of one test of all outputs by two fits, every sum over the variance of its output."""
    sd = np.array([2e-4, 4e-4, 8e-4])  # twice what they have, so that nothing is beyond it
    data = readings("fibonacci-24", "nothing", 2, sd=sd / 2.0)
    c, larger = (mp.fit(data, model=m, reading_sd=sd, **EXACT) for m in ("linear", "own-quadratic"))
    test = next(t for t in c.diagnostics.model_tests if t.term == "own^2")
    few, many = (float(np.sum((fit.residuals / sd) ** 2)) for fit in (c, larger))
    assert_allclose(
        test.statistic, (few - many) / 3 / (many / 57), rtol=3e-3
    )  # a part of excess, by its prior


def test_terms_that_a_model_has_by_the_fit_without_them():
    """Wald's statistic of a linear model is what leaving the terms out adds to χ²."""
    data = readings("fibonacci-24", "own^2", 4, size=1e-4)
    few, many = (
        mp.fit(data, model=m, reading_sd=2e-4, **EXACT) for m in ("linear", "own-quadratic")
    )
    added = float(np.sum(few.residuals**2) - np.sum(many.residuals**2))
    (test,) = judge_included(many)
    assert (test.term, test.outputs) == ("own^2", ())
    assert_allclose(test.statistic, added / 4e-8 / 3, rtol=3e-3)


def test_a_term_is_hidden_by_hand():
    """√(r/l) beside its limit of two: one term, and the worse combination of two."""
    # eq. (1) of diagnostics.projections
    ones, small = np.ones((4, 1)), np.full((4, 1), 0.3)
    assert hides(np.array([[0.0224]]), small, ones, 1.0)  # r = .09/.0224 above 4
    assert not hides(np.array([[0.0226]]), small, ones, 1.0)
    assert hides(np.array([[0.0112]]), small, ones, 2.0)
    assert not hides(np.array([[0.0112]]), small, ones, 0.0)  # of a model without force
    assert not hides(np.array([[0.0113]]), small, ones, 2.0)
    assert not hides(np.array([[1e-9]]), np.full((4, 1), 0.09), ones, 1.0)  # the model does it
    # E'E = diag(1, .25)/2 and V'V = [[a, b], [b, a]]: r is the larger root of
    # (a² − b²) r² − (1/2 + 1/8) a r + 1/16 = 0, with a = .2 and b = .1: 3.80
    error = np.array([[1.0, 0.0], [0.0, 0.5]])
    gram = np.array([[0.2, 0.1], [0.1, 0.2]])
    r = (0.125 + np.sqrt(0.125**2 - 4.0 * 0.03 / 16.0)) / 0.06
    assert hides(gram, error, np.eye(2), 0.99 * r / 4.0)
    assert not hides(gram, error, np.eye(2), 1.01 * r / 4.0)
    for k in (1e-15, 1e15):  # the same in any unit of the readings
        assert hides(k * gram, error, np.eye(2), 0.99 * r / 4.0 / k)
        assert not hides(k * gram, error, np.eye(2), 1.01 * r / 4.0 / k)


def test_the_terms_that_a_model_may_lack_by_name():
    """IEEE Std 1293: K2, Koq, K3, Kip and Kio of an output along x; powers of a column."""
    # eq. (2) of diagnostics.projections
    column = {"environment": {"temperature": np.linspace(20.0, 30.0, 24)}}
    c = mp.fit(readings("fibonacci-24", "nothing", 1, **column))
    found = {kind.name: [str(term) for term in kind.terms[0]] for kind in lacking(c)}
    assert found == {
        "own^2": ["x^2"],
        "own*|own|": ["x*|x|"],
        "own^3": ["x^3"],
        "own*other": ["x*y", "x*z"],
        "temperature": ["temperature"],
        "temperature*own": ["temperature*x"],
    }


def test_directions_lie_where_force_was_applied_and_is_sensed():
    """A sphere, of two inputs a circle, of one a line; as large as the forces."""
    up = read_scheme("fibonacci-24").up
    for inputs, rank in (("x,y,z", 3), ("x,y", 2), ("y", 1)):
        data = mp.Readings(up[:, [1]] + 0.01, outputs=("ay",), up=up, unit="g")
        force, _ = sphere(mp.fit(data, axes="y", inputs=inputs, gravity=9.8))
        size = np.linalg.norm(mp.fit(data, axes="y", inputs=inputs, gravity=9.8).reference, axis=1)
        assert_allclose(np.linalg.norm(force, axis=1).max(), size.mean(), rtol=1e-12)
        unseen = [i for i, axis in enumerate("xyz") if axis not in inputs]
        assert_allclose(force[:, unseen], 0.0, atol=1e-15)
        square = np.linalg.eigvalsh(force.T @ force / len(force))
        assert np.count_nonzero(square > 0.2 * square[-1]) == rank
        assert_allclose(force.mean(axis=0), 0.0, atol=0.02)

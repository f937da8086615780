"""Numbers of fleets by hand or by a second route, at points without symmetry."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, f

import multipos as mp
from multipos.diagnostics.model_error import columns_of
from multipos.estimation.known import share_design
from multipos.fleets import (
    fleet_text,
    unit_findings,
)
from multipos.fleets.grouping import Conditions, group_rows
from multipos.fleets.labels import Labels
from multipos.fleets.solving import _with_gravity, find_pattern
from multipos.fleets.suspects import _ends_repeat, find_suspects
from multipos.fleets.unit_findings import (
    _explained_by_temperature,
    _missing_terms,
    unit_tests,
)
from multipos.numerics.rotations import directions
from multipos.sensor.model import build_model

LINEAR = build_model("linear", ("a", "b", "c"), ("x", "y", "z"), unit="g")


def a_batch(count=14, n=17, seed=2):
    """Units of a linear triad near 1 g/g, read at one set of positions, and what a batch finds."""
    rng = np.random.default_rng(seed)
    up = directions(rng.normal(size=(n, 3)))
    matrix = np.tile(np.diag([1.05, 0.95, 1.01]), (count, 1, 1))
    values = tuple(up @ matrix[0].T[:, [i]] @ np.ones((1, count)) for i in range(3))
    values = tuple((each + 1e-4 * rng.normal(size=each.shape)).T for each in values)
    residuals = np.stack([1e-4 * rng.normal(size=(count, n)) for _ in range(3)])
    found = SimpleNamespace(sensitivity=matrix, rms=np.full(count, 1e-4), residuals=residuals)
    return up, values, found


def test_which_units_are_looked_at_in_full_by_their_limits():
    """Half a percent of a g, .8 % of one reading, cosine .97, a fifth of the sensitivity."""
    _, values, found = a_batch()
    found.rms[:3] = 0.00499, 0.00501, np.nan
    for unit, cosine in ((3, 0.9705), (4, 0.9695)):
        found.sensitivity[unit, 1] = [0.0, 0.95 * cosine, 0.95 * math.sqrt(1.0 - cosine**2)]
    for unit, ratio in ((5, 1.199), (6, 1.201), (7, 1.0 / 1.199), (8, 1.0 / 1.201)):
        found.sensitivity[unit, 2] *= ratio
    found.residuals[0, 9, 4], found.residuals[0, 10, 4] = -0.00799 * 1.05, -0.00801 * 1.05
    found.sensitivity[11, 0] *= -1.0
    for column in values:
        column[12, 7] = column[12, 2]
    top = values[1][13].argsort()[-2:]
    values[1][13, top] = values[1][13].max()
    suspect = find_suspects(LINEAR, values, found)
    assert np.flatnonzero(suspect).tolist() == [1, 2, 4, 6, 8, 10, 11, 12]
    suspect = find_suspects(LINEAR, values, found, uncertain_orientation=True)
    assert np.flatnonzero(suspect).tolist() == [1, 2, 4, 6, 8, 10, 11, 12, 13]
    for size, every in ((0.405, False), (0.395, True), (2.49, False), (2.51, True)):
        _, own, alike = a_batch()  # 1 g/g, a fifth and a factor of three from it
        alike.sensitivity[:, 1, 1] = size
        assert find_suspects(LINEAR, own, alike).all() == every
    values[0][2], values[2][2, 3] = values[0][2] - 4.0, values[0][2].min()
    assert _ends_repeat(values)[[2, 3]].tolist() == [False, False]
    values[2][2, 3] = values[0][2].min() - 4.0
    values[0][2, 1] = values[2][2].min()
    assert _ends_repeat(values)[2]


def fitted(up, values):
    c = mp.fit(mp.Readings(values, up=up, outputs=("a", "b", "c"), unit="g"), orientation_sd=0)
    return c, share_design(c.model, c.reference, c.readings.environment)


def left_by(X, y):
    return y - X @ np.linalg.lstsq(X, y, rcond=None)[0]


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
def test_terms_that_units_lack_by_regression(stated, monkeypatch):
    """F of each output with the columns added; ln p of all, and S of the best."""
    up, values, _ = a_batch(6, 23, 5)
    for unit in range(6):
        values[1][unit] += unit * 4e-5 * up[:, 1] ** 2
    c, shared = fitted(up, np.column_stack([each[0] for each in values]))
    X = np.column_stack([np.ones(23), up])
    error = np.stack([left_by(X, each.T).T for each in values])
    if stated:
        error = error / 1.1e-4
    tests = replace(unit_tests(c, shared), stated=stated)
    of = SimpleNamespace(error=error, explained=None)
    significant, score = _missing_terms(tests, shared, values, of)
    names = tests.projection.names
    explained, q = np.zeros((6, len(names), 3)), np.zeros((len(names), 3))
    for place, name in enumerate(names):
        kinds = [kind for kind in tests.kinds if kind.name == name]
        for i in range(3):
            added = columns_of(kinds, i, c.reference, {})
            both = np.column_stack([X, added])
            q[place, i] = np.linalg.matrix_rank(both) - 4
            whole = (error[i] ** 2).sum(axis=1)
            explained[:, place, i] = whole - (left_by(both, error[i].T) ** 2).sum(axis=0)
    whole = (error**2).sum(axis=2).T[:, None]
    left = np.full(3, 19.0)
    if stated:
        explained, whole = explained.sum(axis=2, keepdims=True), whole.sum(axis=2, keepdims=True)
        q, left = q.sum(axis=1, keepdims=True), left.sum(keepdims=True)
    F = explained / np.where(q > 0, q, 1.0) / ((whole - explained) / (left - q))
    logs = np.where(q > 0, f.logsf(F, np.where(q > 0, q, 1.0), left - q), 0.0)
    level = 1.0 - 0.99 ** (1.0 / len(names))
    used = (q > 0).sum(axis=1)
    limit = np.where(used > 1, -0.5 * chi2.isf(level, 2.0 * np.maximum(used, 1)), math.log(level))
    wanted = logs.sum(axis=2) < limit
    assert significant.tolist() == wanted.tolist()
    assert 0 < wanted.any(axis=1).sum() < 6
    total = logs.sum(axis=2)

    def score_of(unit, limits):
        best = int(np.argmin(np.where(total[unit] < limits, total[unit] - limits, np.inf)))
        gain = left * np.log(whole / (whole - explained))[unit, best]
        S = np.where(q[best] > 0, gain, 0.0).sum() - q[best].sum() * math.log(3 * 19.0)
        return S - 2.0 * math.log(len(names))

    for unit in np.flatnonzero(wanted.any(axis=1)):
        assert score[unit] == pytest.approx(score_of(unit, limit), rel=1e-6)
    # near a limit quick tails, here of too large a p, are as good as exact ones
    near = total + np.random.default_rng(3).uniform(0.002, 0.019, total.shape)
    quick, share = unit_findings.f_log_tails, 0.02 / logs.shape[2]
    monkeypatch.setattr(unit_findings, "_limits", lambda used: near)
    monkeypatch.setattr(unit_findings, "f_log_tails", lambda *given: quick(*given) + share)
    significant, score = _missing_terms(tests, shared, values, of)
    assert significant.all()
    np.testing.assert_allclose(score, [score_of(unit, near[unit]) for unit in range(6)], rtol=1e-6)
    nothing, none = _missing_terms(replace(tests, projection=None), shared, values, of)
    assert (nothing.shape, none.tolist()) == ((6, 0), [-math.inf] * 6)


@pytest.mark.parametrize("weighted", [False, True])
def test_what_temperatures_of_units_explain_by_regression(weighted):
    """The first order, alone and times the axis, of each output under the weights of each unit."""
    rng = np.random.default_rng(8)
    up, values, _ = a_batch(8, 13, 7)
    _, shared = fitted(up, np.column_stack([each[0] for each in values]))
    X = np.column_stack([np.ones(13), up])
    warmth = 20.0 + rng.normal(size=(8, 13))
    warmth[5] = 21.0
    weights = rng.uniform(0.2, 3.0, (3, 8, 13)) if weighted else np.ones((3, 8, 13))
    errors, wanted = np.empty((3, 8, 13)), np.full((8, 2, 3), np.nan)
    for unit, i in np.ndindex(8, 3):
        root = np.sqrt(weights[i, unit])
        y = rng.normal(size=13) + 0.2 * unit * warmth[unit]
        left = left_by(root[:, None] * X, root * y)
        errors[i, unit] = left / root
        for own in range(2 if unit != 5 else 0):
            added = np.column_stack([X, warmth[unit] * up[:, i] ** own])
            rest = left_by(root[:, None] * added, root * y)
            wanted[unit, own, i] = left @ left - rest @ rest
    found = _explained_by_temperature(shared, warmth, weights if weighted else None, errors)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_the_part_of_gravity_and_what_comes_of_single_fits():
    # u = √(u² + (k u_g/g θ)²) of a parameter of degree k in the force, ν by the fourth power
    degrees = LINEAR.force_degrees
    parameters = np.random.default_rng(1).uniform(0.5, 2.0, (3, 12))
    u, dof = 1e-3 * parameters[::-1], np.full((3, 1), 11.0)
    pattern = SimpleNamespace(
        gravity=SimpleNamespace(u=0.02, value=9.7),
        shared=SimpleNamespace(model=SimpleNamespace(force_degrees=degrees)),
    )
    found = SimpleNamespace(u=u, dof=dof, parameters=parameters)
    whole, freedom = _with_gravity(pattern, found)
    wanted = np.sqrt(u**2 + (degrees * 0.02 / 9.7 * parameters) ** 2)
    np.testing.assert_allclose(whole, wanted)
    np.testing.assert_allclose(freedom, 11.0 * (wanted / u) ** 4)
    pattern.gravity.u = 0.0
    assert _with_gravity(pattern, found)[0] is u


def test_units_whose_numbers_no_fit_takes_come_alone():
    """Of eight alike u3 and u4 are of n = 0, u6 and u7 of an sd below 0; none and 0 are taken."""
    n, sd = np.full(16, 50.0), np.full(16, 0.0)
    n[[4, 5, 6, 7]], sd[[10, 12]] = 0.0, -1e-3
    columns = {"ax": np.tile([0.1, -0.2], 8), "n": n, "sd_ax": sd}
    table = SimpleNamespace(
        unit=labels_from(np.repeat([f"u{k}" for k in range(1, 9)], 2).tolist()),
        station=labels_from([""] * 16),
        columns=tuple(columns),
        numbers=columns.__getitem__,
        written=str,
    )
    groups = Conditions(table, group_rows(table), ["ax"], ()).groups()
    assert [units.tolist() for units in groups] == [[2], [3], [5], [6], [0, 1, 4, 7]]


def labels_from(column):
    names = tuple(dict.fromkeys(column))
    return Labels(np.array([names.index(each) for each in column], dtype=np.int32), names)


@pytest.mark.parametrize(
    ("fitted_with", "asked_for", "shared"),
    [
        ({}, {}, "SharedDesign"),
        ({}, {"range": (1, 2)}, None),
        ({}, {"exclude": "auto"}, "SharedDesign"),
        ({}, {"exclude": "1"}, None),
        ({"gravity": 9.81, "gravity_u": 0.01}, {}, "SharedDesign"),
        ({"robust": "huber"}, {}, None),
        ({"unknown_orientation": True}, {}, "SharedSphere"),
        ({"budget": {"gain": {"u": 0.01}}}, {}, None),
        ({"samples": 100}, {}, "SharedDesign"),
        ({"samples": 100, "u": 1e-4, "dof": 9.0}, {}, None),
        ({"time": 1.0}, {}, "SharedDesign"),
    ],
)
@pytest.mark.usefixtures("without_findings")
def test_what_units_share_with_one_that_was_fitted(fitted_with, asked_for, shared):
    """At known orientations the design (1, f), its residuals' tests and a fixture."""
    up = mp.read_scheme("fibonacci-20").up
    values = up + 1e-4 * np.random.default_rng(1).normal(size=up.shape)
    given, options = {}, {"exclude": "none"} | fitted_with
    if "unknown_orientation" not in options:
        options = {"orientation_sd": 0} | options
    for name in ("u", "dof"):
        if name in options:
            given[name] = np.full(up.shape, options.pop(name))
    if "samples" in options:
        given["samples"] = np.full(20, options.pop("samples"))
    timed = options.pop("time", None) is not None
    if timed:
        given["environment"] = {"time": np.arange(20.0)}
    c = mp.fit(mp.Readings(values, up=up, unit="g", **given), **options)
    found = find_pattern(c, None, options | asked_for)
    assert (found and type(found.shared).__name__) == shared
    if found is None:
        return
    known = shared == "SharedDesign"
    if known:
        force = up * options.get("gravity", 9.80665) / 9.80665
        for design in found.shared.designs:
            np.testing.assert_allclose(design, np.column_stack([np.ones(20), force]))
    else:
        assert found.findings == "orientation-ignored"
    assert (found.tests is None, found.like is None) == (not known, known)
    assert (found.fixture is not None) == known
    assert (found.timed, found.quick) == (timed, known)
    assert (found.gravity is not None) == ("gravity" in options)


@dataclass
class Like:
    readings: object


@dataclass
class Read:
    values: np.ndarray


@pytest.mark.parametrize(("sd", "mean"), [(2.34e-5, "1.2346"), (None, "1.23")])
def test_a_mean_of_a_fleet_is_said_to_a_third_digit_of_its_sd(sd, mean):
    """In mg: an sd of .0234 has two digits in three decimals, and one decimal more is shown."""
    each = {"unit": "g", "mean": 1.2345678e-3, "sd": sd, "sd_true": None, "lsl": -2e-3, "usl": None}
    unit, shown, plain, *limits = fleet_text._spread(each)
    assert (unit, shown, limits) == ("mg", mean, ["-", "-2", "-"])
    assert plain == ("-" if sd is None else "0.0234")

"""Numbers of uncertainty by hand or by a second route, at points without symmetry."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import f as fisher
from scipy.stats import t

import multipos as mp
from multipos.sensor.model import build_model
from multipos.uncertainty import (
    common_causes,
    dividing_head,
    propagation,
    sensitivities,
    sphere,
    turntable,
    validity,
)
from multipos.uncertainty.budgets import _quantity, _size, resolve
from multipos.uncertainty.monte_carlo import _shortest, _symmetric
from multipos.uncertainty.propagation import _blocks, row_dof
from multipos.uncertainty.turntable import _largest_loss, _solve_beside
from multipos.uncertainty.validity import ForcesSeen

# --- what residuals show


@pytest.mark.parametrize(("dof", "pooled"), [((7.4, 5.4), False), ((12.0, 12.0), True)])
def test_variances_of_residuals_that_hold_nothing_common_are_kept(dof, pooled):
    """Two patterns of nothing; of one scatter for both, where there are more than its own."""
    e, nu = np.array([[1.0, 2.0], [3.0, -1.0], [-2.0, 0.5]]), np.array([7.0, 5.0])
    c = SimpleNamespace(dof=np.array(dof))
    shown = common_causes._Shown(np.arange(2), e, np.full((3, 2, 1), 1e-9), nu)
    found = common_causes._from_residuals(c, shown)
    assert_allclose(found.ratio, 1.0, rtol=1e-6)
    assert_allclose(found.left, nu, rtol=1e-6)
    assert_allclose(found.dof, dof, rtol=1e-6)


def test_a_common_cause_takes_its_part_of_a_pooled_scatter():
    """Far above the noise it takes the first row whole: one degree of freedom of twelve."""
    e = np.array([[50.0, 70.0], [3.0, -1.0], [-2.0, 0.5]])
    pattern = np.zeros((3, 2, 1))
    pattern[0, :, 0] = [5e5, 7e5]
    nu = np.array([7.0, 5.0])
    c = SimpleNamespace(dof=np.array([12.0, 12.0]))
    found = common_causes._from_residuals(c, common_causes._Shown(np.arange(2), e, pattern, nu))
    assert_allclose(found.left.sum(), 11.0, rtol=1e-6)
    assert_allclose(found.left[0] / found.left[1], 7.0 / 5.0, rtol=1e-6)
    assert_allclose(found.dof, 11.0, rtol=1e-6)
    assert_allclose(found.ratio, (14.25 / 11.0) / (np.sum(e**2) / 12.0), rtol=1e-6)


# --- a table beside the sensor


def test_errors_of_a_table_are_fitted_beside_the_sensor():
    """Weighted least squares of both, the F of what the errors add, and Student's t."""
    rng = np.random.default_rng(4)
    sensor, errors, w = rng.normal(size=(14, 3)), rng.normal(size=(14, 2)), rng.uniform(0.5, 2, 14)
    y = sensor @ [1.0, 2.0, 3.0] + errors @ [0.4, -0.6] + 0.5 * rng.normal(size=14)
    bench = SimpleNamespace(
        keys="abc", values=y.reshape(7, 2), weight=w, sensor=sensor,
        first=SimpleNamespace(confidence=0.9),
    )  # fmt: skip
    X = np.column_stack([sensor, errors])
    found, sizes = _solve_beside(bench, X, np.array([True, False, True]))
    weighted, right = X * w[:, None], y * w
    b = np.linalg.lstsq(weighted, right, rcond=None)[0]
    square = np.sum((right - weighted @ b) ** 2)
    C = np.linalg.inv(weighted.T @ weighted) * square / 9
    alone = weighted[:, :3] @ np.linalg.lstsq(weighted[:, :3], right, rcond=None)[0]
    F = (np.sum((right - alone) ** 2) - square) / 2 / (square / 9)
    assert_allclose(found.parameters, b[:3])
    assert_allclose(found.covariance, C[:3, :3], rtol=1e-9)
    assert (found.dof, found.identifiable) == (9.0, (True, False, True))
    assert found.p == pytest.approx(fisher.sf(F, 2, 9), rel=1e-9)
    for j, (value, u, U) in enumerate(sizes, 3):
        assert (value, u) == (pytest.approx(b[j]), pytest.approx(math.sqrt(C[j, j])))
        assert pytest.approx(t.ppf(0.95, 9) * u, rel=1e-6) == U


# --- Monte Carlo


def test_the_ends_of_intervals_of_trials():
    """Of 11 trials 90 % are 10 in width: from the first to the last; 50 % six, shortest or even."""
    values = np.array([[0.5, 4.0, 5.0, 6.0, 6.5, 7.0, 9.0, 12.0, 13.0, 17.0, 30.0]])
    low, high = _symmetric(values, 0.5)
    assert (low[0], high[0]) == (5.0, 13.0)
    assert _shortest(values, 0.5).tolist() == [[4.0, 12.0]]
    thirteen = np.arange(13.0)[None] ** 2  # a third of 13 is 4.29, and 4
    low, high = _symmetric(thirteen, 0.33)
    assert (low[0], high[0]) == (16.0, 64.0)
    assert _shortest(thirteen, 0.33).tolist() == [[0.0, 16.0]]
    low, high = _symmetric(values, 0.9)
    assert (low[0], high[0]) == (0.5, 30.0)
    assert _shortest(values, 0.9999).tolist() == [[0.5, 30.0]]


# --- budgets


def test_degrees_of_freedom_of_a_row_are_the_fewest_of_what_is_used():
    row = SimpleNamespace(added=np.diag([1.0, 2.0, 0.0]), dof=np.array([9.0, 5.0, 2.0]))
    gradient = np.array([[1.0, 0.0, 1.0], [0.3, -0.2, 0.0], [0.0, 0.0, 4.0]])
    assert row_dof(row, gradient).tolist() == [9.0, 5.0, math.inf]
    row.dof = 7.0
    assert row_dof(row, gradient).tolist() == [7.0, 7.0, math.inf]


def test_parameters_of_outputs_that_covary_are_in_one_row():
    c = SimpleNamespace(model=SimpleNamespace(output_of=np.array([0, 0, 1])), outputs=("a", "b"))
    for share, rows in ((0.9e-9, 2), (1.1e-9, 1)):
        C = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 6.0 * share], [0.0, 6.0 * share, 4.0]])
        found = _blocks(c, C)
        assert len(found) == rows
        assert found[0].tolist() == [True, True, rows == 1]


@pytest.mark.parametrize(
    ("spread", "u", "law"),
    [
        ({"u": 0.3}, 0.3, "normal"),
        ({"U": 0.3, "k": 2.5}, 0.12, "normal"),
        ({"half_width": 0.3, "distribution": "rectangular"}, 0.3 / math.sqrt(3), "rectangular"),
        ({"half_width": 0.3, "distribution": "triangular"}, 0.3 / math.sqrt(6), "triangular"),
    ],
)
def test_a_size_of_a_budget(spread, u, law):
    assert _size("b", spread, "") == (pytest.approx(u), law)


@pytest.mark.parametrize("table", [{"u": 1.0, "U": 2.0}, {"u": 0.3, "k": 2.0}, {}])
def test_a_size_that_is_none_or_two(table):
    with pytest.raises(mp.MultiposError, match="b: "):
        _size("b", table, "")


def test_numbers_of_a_budget_have_their_least():
    resolve("b", {"u_ax": 0.0, "dof": 1.0}, "")
    with pytest.raises(mp.MultiposError, match="at least 1"):
        resolve("b", {"u_ax": 0.1, "dof": 0.99}, "")
    assert _quantity("b", "level", {"u_deg": 0.2, "dof": 3.5}).dof == 3.5
    with pytest.raises(mp.MultiposError):
        _quantity("b", "level", {"u_deg": 0.2, "dof": 0.0})


# --- where it holds


def test_forces_that_were_seen_with_their_margins():
    """Up to 1 g in any direction, and up to 4 g within a box; a hundredth more, and .05 g."""
    low, high = np.array([-1.0, -0.5, -2.0]), np.array([3.8, 1.0, 2.0])
    seen = ForcesSeen(1.0, 4.0, low, high, 0.05)
    assert seen.limit(2.0) == pytest.approx(2.0 * 1.01 + 0.05)
    bottom, top = seen.box([0, 2])
    assert_allclose(bottom, [-1.0 - 0.09, -2.0 - 0.09])
    assert_allclose(top, [3.8 + 0.09, 2.0 + 0.09])
    forces = {
        (1.05, 0.0, 0.0): True,
        (0.0, -1.05, 0.0): True,
        (0.0, -1.07, 0.0): False,
        (3.88, 0.0, 0.0): True,
        (3.9, 0.0, 0.0): False,
        (0.0, 0.0, -2.08): True,
        (0.0, 0.0, -2.1): False,
        (3.8, 1.0, 2.0): False,
        (3.6, 1.0, 1.6): True,
        (math.nan, 0.0, 0.0): False,
    }
    assert seen.holds(np.array(list(forces)), [0, 1, 2]).tolist() == list(forces.values())
    plain = ForcesSeen(2.0, 2.0, low, high, 0.05)
    assert plain.holds(np.array([[2.06, 0.0], [0.0, 2.08]]), [0, 2]).tolist() == [True, False]
    assert seen.in_words([0, 2]) == "x -1 to 3.8, z -2 to 2 g"
    assert plain.in_words([0]) == "up to 2 g"


@pytest.mark.parametrize(("unit", "said"), [("g", "g"), (None, "times the local field")])
def test_forces_that_were_seen_are_in_the_unit_of_the_field(unit, said):
    c = SimpleNamespace(
        readings=SimpleNamespace(forced=np.array([False, False, True])),
        reference=np.array([[0.0, 0.6, 0.8], [-1.0, 0.0, 0.0], [0.0, 3.0, -4.0]]),
        rms=0.0,
        field=SimpleNamespace(same_everywhere=True, unit=unit),
    )
    seen = validity.applied(c)
    assert (seen.sphere, seen.largest, seen.unit) == (1.0, 5.0, said)
    assert (seen.low.tolist(), seen.high.tolist()) == ([-1.0, -1.0, -4.0], [1.0, 3.0, 1.0])


def test_how_much_a_parameter_loses_by_the_others():
    """1/√(1 − R²) of each column on the rest, the largest of all outputs."""
    rng = np.random.default_rng(6)
    blocks = [(0, rng.normal(size=(9, 3)) + 2.0), (1, rng.normal(size=(9, 2)))]
    model = SimpleNamespace(respond=lambda *_: (None, blocks))
    c = SimpleNamespace(
        model=model, parameters=None, reference=None, readings=SimpleNamespace(environment={})
    )
    losses = []
    for _, X in blocks:
        for j in range(X.shape[1]):
            rest = np.delete(X, j, axis=1)
            left = X[:, j] - rest @ np.linalg.lstsq(rest, X[:, j], rcond=None)[0]
            losses.append(np.linalg.norm(X[:, j]) / np.linalg.norm(left))
    assert _largest_loss(c) == pytest.approx(max(losses))


def test_how_force_follows_parameters_at_the_mean_temperature():
    """df/dp = −K⁻¹ X of y = b + K f + c T, at T of 20 on average; what is unseen beside it."""
    rng = np.random.default_rng(3)
    formula = "1 + x + z + temperature"
    model = build_model(formula, ("a", "b"), ("x", "z"), ("x", "z"), known=("temperature",))
    theta = rng.normal(size=8) + np.array([0, 3, 0, 0, 0, 0, 3, 0])
    c = SimpleNamespace(
        model=model, parameters=theta,
        mean_environment={"temperature": 20.0},
    )  # fmt: skip
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sphere, "unseen_covariance", lambda *given: asked.append(given) or "unseen")
        slopes, unseen = sphere._sensitivity(c, np.array([[0.6, -0.8], [0.1, 0.2]]))
    assert unseen == "unseen"
    assert asked[0][2]["temperature"].tolist() == [20.0, 20.0]
    K = theta.reshape(2, 4)[:, 1:3]
    for f, found in zip(((0.6, -0.8), (0.1, 0.2)), slopes, strict=True):
        X = np.kron(np.eye(2), [1.0, *f, 20.0])
        assert_allclose(found, -np.linalg.inv(K) @ X, rtol=1e-9)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("stated", [True, False])
def test_an_index_error_turns_the_case_by_its_waves(axis, stated):
    """The angle runs from the first to the second of the other axes; three orders share u."""
    along = "xyz".index(axis)
    first, second = (i for i in range(3) if i != along)
    angle = np.array([0.3, 1.1, 2.6, 4.0, 5.9])
    up = np.zeros((5, 3))
    up[:, first], up[:, second] = np.cos(angle), np.sin(angle)
    settings = {"harmonics": (0, 1, 3)} | ({"axis": axis} if stated else {})
    rotation = np.random.default_rng(1).normal(size=(5, 3, 3))
    rotation[:, :, 0] = np.eye(3)[along] * np.array([1.0, -1.0, 1.0, 1.0, -1.0])[:, None]
    readings = type("Rows", (), {"rotation": rotation, "__len__": lambda self: 5})()
    c = SimpleNamespace(readings=readings, reference=-1.2 * up, sign=-1.0)
    turns = sensitivities._index_turns(c, SimpleNamespace(name="index", settings=settings))
    waves = [np.cos(0 * angle), np.cos(angle), np.sin(angle), np.cos(3 * angle), np.sin(3 * angle)]
    assert turns.shape == (5, 5, 3)
    for q, wave in enumerate(waves):
        turned = up + 1e-6 * np.cross(turns[:, q], up)
        moved = np.arctan2(turned[:, second], turned[:, first]) - angle
        moved = np.remainder(moved + np.pi, 2 * np.pi) - np.pi
        assert_allclose(moved, 1e-6 * wave / math.sqrt(3.0), atol=1e-10)
        assert_allclose(np.linalg.norm(turns[:, q], axis=1), np.abs(wave) / math.sqrt(3.0))
    if not stated:
        rotation[2, :, 0] = math.cos(1e-2) * np.eye(3)[along] + math.sin(1e-2) * np.eye(3)[first]
        with pytest.raises(mp.MultiposError, match="do not turn about one case axis"):
            sensitivities._index_turns(c, SimpleNamespace(name="index", settings=settings))


def test_what_a_degree_does_to_readings():
    """By the model's terms of the second degree, or by stated coefficients of zero and scale."""
    force, T = np.array([[0.2, 0.5, -0.7], [0.9, -0.1, 0.3]]), np.array([21.0, 34.0])
    K = np.array([[2.0, 0.3, 0.1], [0.2, 3.0, -0.4]])

    def predict(parameters, reference, environment):
        t = environment["temperature"][:, None]
        return 0.4 + reference @ K.T * (1.0 + 0.01 * t) + 0.002 * t**2

    model = SimpleNamespace(predict=predict, environment=("temperature",))
    c = SimpleNamespace(
        model=model, parameters=None, reference=force,
        readings=SimpleNamespace(environment={"temperature": T}),
    )  # fmt: skip
    found = sensitivities._temperature_moves(c, SimpleNamespace(settings={}))
    assert_allclose(found, 0.01 * force @ K.T + 0.004 * T[:, None], rtol=1e-6)
    model.environment = ()
    signal = force @ K.T * (1.0 + 0.01 * T[:, None])
    for settings, wanted in (
        ({"bias_per_degC": 0.03, "scale_per_degC": -2e-4}, 0.03 - 2e-4 * signal),
        ({"scale_per_degC": 5e-4}, 5e-4 * signal),
        ({"bias_per_degC": 0.02}, 0.02 + 0.0 * signal),
    ):
        found = sensitivities._temperature_moves(c, SimpleNamespace(settings=settings))
        assert_allclose(found, wanted, atol=1e-12)
    with pytest.raises(mp.MultiposError, match="no temperature terms"):
        sensitivities._temperature_moves(c, SimpleNamespace(settings={}))


def test_errors_of_a_table_move_force_by_the_gravity_that_is_there():
    """About z from x to y with 1.25 of gravity as stated, which pulls: at 30° and at 90°."""
    c = SimpleNamespace(sign=-1.0, field=SimpleNamespace(magnitude=1.25))
    roll = SimpleNamespace(axis="z", plane=("x", "y"), rows=(3, 5), angle=np.radians([30.0, 90.0]))
    assert_allclose(turntable._along(c, roll), [[0.0, 0.0, -1.25]] * 2)
    turn = [[0.625, -1.25 * 0.75**0.5, 0.0], [1.25, 0.0, 0.0]]
    assert_allclose(turntable._turn(c, roll), turn, atol=1e-15)


@pytest.mark.parametrize(("off", "count"), [(0.9e-3, 2), (1.1e-3, 3)])
def test_rows_of_a_roll_belong_to_mountings_by_their_sense(off, count):
    """Two meet where .3 + h is 1.2 − h: such rows go with their neighbours, the following first."""
    head = np.array([0.05, 1.0, 0.45, 2.0, 2.9, 0.45, 0.1, 0.45, 0.9, 2.2, 5.0])
    sense = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0])
    angle = np.remainder(np.where(sense > 0, 0.3, 1.2) + sense * head, 2 * np.pi)
    angle[4] += off
    found = dividing_head._mountings(SimpleNamespace(angle=angle), head)
    rows = [each.tolist() for _, each in found]
    if count == 2:
        assert [each for each, _ in found] == [1.0, -1.0]
        assert rows == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9, 10]]
    else:
        assert len(rows) == 3
        assert [4] in rows
    many = np.random.default_rng(2).uniform(0.0, 6.0, (2, 30))
    roll = SimpleNamespace(angle=many[0])
    ((single, one),) = dividing_head._mountings(roll, many[1])
    assert (single, one.shape) == (1.0, (1,))
    roll.angle = many[0, :24]
    assert len(dividing_head._mountings(roll, many[1, :24])) == 24


@pytest.mark.parametrize(
    ("used", "law"), [(2e-4, ("rectangular", 7.0)), (3e-4, ("normal", math.inf)), (0.0, None)]
)
def test_gravity_of_a_budget_is_as_it_was_used(used, law):
    """With the law that is stated where it is the one that was stated; none is none."""
    stated = {
        "gravity": SimpleNamespace(name="gravity", u=2e-4, distribution="rectangular", dof=7.0),
        "gain": SimpleNamespace(name="gain"),
        "third_order": SimpleNamespace(name="third_order"),
    }
    c = SimpleNamespace(gravity=SimpleNamespace(u=used, size_unit="m/s^2"))
    found = propagation.find_quantities(c, SimpleNamespace(quantities=stated))
    assert [each.name for each in found] == (["gravity", "gain"] if law else ["gain"])
    if law:
        own = found[0]
        assert (own.u, own.unit, own.distribution, own.dof) == (used, "m/s^2", *law)

"""Numbers of uncertainty by hand or by a second route, at points without symmetry."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.uncertainty import (
    common_causes,
    sensitivities,
)
from multipos.uncertainty.budgets import _quantity, resolve
from multipos.uncertainty.monte_carlo import _shortest, _symmetric
from multipos.uncertainty.propagation import row_dof
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

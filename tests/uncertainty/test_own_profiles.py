"""Budget, Monte Carlo and profiles of a user-defined model."""

import numpy as np
import profile_oracle as profiles
import pytest
from amounts import exactly
from numpy.testing import assert_allclose

import multipos as mp
from multipos.positions.scheme import read_scheme
from multipos.uncertainty.monte_carlo import simulate_budget

UP = read_scheme("fibonacci-12").up
MODEL = "each = b + s*own/(1 + k*own^2)"


def calibration(sd=1e-2, **how):
    values = 0.02 + UP / (1 + 0.4 * UP**2)
    values = values + sd * np.random.default_rng(1).standard_normal(UP.shape)
    return exactly(mp.Readings(values, up=UP), model=MODEL, **how)


@pytest.mark.parametrize("how", [{}, {"reading_sd": 1e-2}])
def test_exact_second_derivatives_meet_a_search_without_any(how):
    """Newton's profile and SciPy's with finite differences end at the same points."""
    cal = calibration(**how)
    mine = profiles.profile_interval(cal, "ax", "k")
    residuals, best = profiles._known_problem(cal, 2)
    u, dof = float(cal.u[2]), float(cal.dof[0])
    other = profiles.search_interval(residuals, best, 2, u=u, dof=dof)
    assert_allclose(mine, other, rtol=0, atol=1e-5 * u)
    value = float(cal.parameters[2])
    assert mine.high - value > value - mine.low  # it bends to the right


def test_monte_carlo_runs_the_search_itself():
    cal = calibration(1e-4)
    found = simulate_budget(cal, trials=200, rng=1)
    assert_allclose(found.u, cal.u, rtol=0.35)  # 200 trials, t at 9 degrees of freedom
    assert_allclose(found.mean, cal.parameters, rtol=0, atol=5.0 * cal.u.max() / 14.0)

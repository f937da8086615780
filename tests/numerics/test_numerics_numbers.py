"""Numbers of numerics by hand or by a second route, at points without symmetry."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm

from multipos.errors import UsageError
from multipos.numerics import levenberg_marquardt
from multipos.numerics.arrays import require_rate, resolution
from multipos.numerics.levenberg_marquardt import Rules, _Going, _rise, _step, descend
from multipos.numerics.quantiles import chi2_quantile, chi2_tail


@pytest.mark.parametrize("held", [(), (1,)])
def test_a_damped_step_solves_equations_with_a_raised_diagonal(held):
    """(S + λ diag S) d = g of the parameters that are not held; size against that of θ."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 4, 7))
    S, g, theta = root @ root.transpose(0, 2, 1), rng.normal(size=(3, 4)), rng.normal(size=(3, 3))
    damping = np.array([0.3, 1e-4, 20.0])
    found = _step(theta, SimpleNamespace(information=S, gradient=g), damping, held)
    free = [i for i in range(4) if i not in held]
    for k in range(3):
        A = S[k][np.ix_(free, free)]
        d = np.linalg.solve(A + damping[k] * np.diag(np.diag(A)), g[k, free])
        assert_allclose(found[0][k, free], d)
        assert found[1][k] == pytest.approx(g[k, free] @ d)
        scale = np.sqrt(np.diag(S[k]))
        if held:
            scale[1] = 1.0
        size = np.abs(theta[k] * scale[:3]).max()
        assert found[2][k] == pytest.approx(np.abs(d * scale[free]).max() / size)
    assert not held or not found[0][:, 1].any()


def test_damping_after_steps_that_are_taken_refused_and_stuck():
    going = _Going(np.array([0.4, 0.4, 3e11, 1e-12]), np.array([5.0, 6.0, 7.0, 8.0]), np.arange(4))
    taken, flat = np.array([True, False, False, False]), np.array([False, True, False, False])
    after, stuck = going.refused(taken, np.array([1.5, 2.5, 3.5, 4.5]), flat)
    assert_allclose(after.damping, [0.04, 4.0, 3e12, 1e-10])
    assert stuck.tolist() == [False, True, True, False]
    assert after.before.tolist() == [1.5, 6.0, 7.0, 8.0]
    assert after.iterations.tolist() == [1, 2, 3, 3]


@dataclass
class Endless:
    """A search whose every third step is taken, and none the last."""

    theta: np.ndarray
    objective: np.ndarray
    moves: int = 0

    def of(self, units):
        return self

    def put(self, units, other):
        self.theta, self.objective = other.theta, other.objective

    def linearise(self, place):
        return SimpleNamespace(information=np.eye(1)[None], gradient=np.ones((1, 1)))

    def move(self, place, equations, step, damping):
        self.moves += 1
        factor = 2.0 if self.moves % 3 else 0.99
        return Endless(place.theta + step, factor * place.objective)


@dataclass
class Roots:
    """(θ² − a)² + 1 of several units, from where they begin."""

    theta: np.ndarray
    a: np.ndarray

    @property
    def objective(self):
        return (self.theta[:, 0] ** 2 - self.a) ** 2 + 1.0

    def of(self, units):
        return Roots(self.theta[units], self.a[units])

    def put(self, units, other):
        self.theta[units] = other.theta

    def linearise(self, place):
        slope = 2.0 * place.theta
        left = self.a - place.theta[:, 0] ** 2
        return SimpleNamespace(information=(slope**2)[:, :, None], gradient=slope * left[:, None])

    def move(self, place, equations, step, damping):
        return Roots(place.theta + step, place.a)


def test_units_end_each_in_its_turn():
    """Roots of 4, 9, 25 and 2 from near and far: the last ends alone, or two at once."""
    a = np.array([4.0, 9.0, 25.0, 2.0])
    for start in ([2.0, 3.01, 40.0, 1.5], [2.0, 300.0, 5.0, 1.41], [1.0, 9.0, 9.0, 9.0]):
        steps = Roots(np.array(start)[:, None], a)
        with np.errstate(divide="ignore", invalid="ignore"):  # as searches have it
            found, ended = descend(steps, steps.of(np.arange(4)), Rules(weighted=True), np.ones(4))
        assert found.theta[:, 0] == pytest.approx(np.sqrt(a), rel=1e-6)
        assert ended.converged.all()
    assert len(set(ended.iterations.tolist())) > 1


def test_a_search_ends_after_so_many_steps_taken_or_refused(monkeypatch):
    monkeypatch.setattr(levenberg_marquardt, "_TRIES", 30)
    steps = Endless(np.ones((1, 1)), np.ones(1))
    place = Endless(np.ones((1, 1)), np.ones(1))
    with np.errstate(divide="ignore"):  # as searches have it
        found, ended = descend(steps, place, Rules(weighted=True), np.ones(1))
    assert (steps.moves, ended.iterations.tolist(), ended.converged.tolist()) == (30, [10], [False])
    assert_allclose(found.objective, 0.99**10)


def test_how_far_rounding_lets_an_objective_rise():
    """8 ε of the largest reading times the root, a part in 10¹² at least."""
    eps = np.finfo(float).eps
    found = _rise(np.array([7.0, 900.0]), np.array([400.0, 0.25]))
    assert_allclose(found, [400.0e-12, 8.0 * eps * 900.0 * 0.5])


@pytest.mark.parametrize("z", [-2.3, 0.7, 3.1])
def test_chi_square_of_billions_of_degrees_of_freedom(z):
    dof = 3e9
    x = dof + z * np.sqrt(2.0 * dof)
    assert chi2_tail(x, dof) == pytest.approx(norm.sf(z), rel=1e-3)
    assert chi2_quantile(norm.cdf(z), dof) - dof == pytest.approx(x - dof, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "step"),
    [([0.25, 1.0, -0.5, 0.0], 0.25), ([3.0, 12.0, 21.0], 9.0), ([0.1, 0.1 + np.pi, 2.0], 0.0)],
)
def test_the_step_of_a_converter(values, step):
    assert resolution(np.array(values)) == pytest.approx(step, abs=1e-12)


@pytest.mark.parametrize("rate", [1e-12, 1e7])
def test_rates_are_from_a_sample_in_thirty_thousand_years_to_ten_megahertz(rate):
    require_rate(rate)
    for beyond in (rate * (0.9 if rate < 1.0 else 1.1), 0.0, np.nan):
        with pytest.raises(UsageError, match=r"^--rate must be above 0, from 1e-12 to 1e\+07 Hz"):
            require_rate(beyond)

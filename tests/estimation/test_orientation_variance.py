"""Scatter beside placement against its definition with full matrices, and what it covers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from multipos.estimation.orientation_variance import (
    Block,
    Linear,
    _axes,
    _axes_of_errors,
    _Evaluator,
    _prior_of_both,
    find_both,
)
from numpy.testing import assert_allclose
from scipy import optimize, stats
from test_likelihood import KINDS, a_problem

import multipos as mp
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.noise import linear_model
from multipos.estimation.posteriors import (
    _COVERAGE,
    _INNER,
    Found,
    Posterior,
    _search_half,
    dof_of_tails,
    integrate,
)
from numpy.testing import assert_allclose
from scipy import optimize, stats
from test_likelihood import KINDS, a_problem

import multipos as mp
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.noise import linear_model
from multipos.estimation.problem import start_state
from multipos.positions.open_rolls import OpenRolls

NODES = np.array([0.0, 1e-4, 4e-4, 3e-3])  # the noise is of 1e-2
FACTORS = np.array([1.0, 0.1, 3.0, 20.0])


def a_solution(kind="uncertain", *, unequal=True):
    """Return a problem of every kind of position with residuals of both causes, as an optimum."""
    problem, state = a_problem(kind.split(", ")[-1])
    n = len(problem.values)
    if kind.startswith("rolls"):
        rows = np.arange(n) % 3 == 0
        rolls = OpenRolls(np.where(rows, 2, -1), np.full(n, -1))
        problem = replace(problem, rolls=rolls)
    few = kind.startswith("few")  # angles than parameters
    if few:
        few_sds = np.where(np.arange(n) < 4, problem.orientation_sd, 0.0)
        problem = replace(problem, orientation_sd=few_sds)
        state = replace(state, step=state.step * (few_sds > 0.0)[:, None])
    if not unequal:
        mean = problem.precision.mean(axis=None if few else 1, keepdims=True)
        problem = replace(problem, precision=np.broadcast_to(mean, (n, 3)).copy())
    normal = linearise(problem, state, evaluate(problem, state))
    rng = np.random.default_rng(8)
    spread = np.where(np.isfinite(problem.orientation_sd), problem.orientation_sd, 0.5)
    off = np.einsum("nmi,ni->nm", normal.jacobian, spread[:, None] * rng.standard_normal((n, 2)))
    noise = rng.standard_normal((n, 3)) / np.sqrt(problem.precision)
    # residuals at the listed positions, less what the steps of the state explain of them
    error = 2.0 * noise + 3.0 * off - np.einsum("nmi,ni->nm", normal.jacobian, state.step)
    values = problem.values + error - evaluate(problem, state).residuals
    problem = replace(problem, values=values)
    return problem, SimpleNamespace(state=state, point=evaluate(problem, state))


class Dense:
    """Residuals at the listed positions, slopes and covariances of a solution as they are."""

    def __init__(self, problem, optimum):
        state, point = optimum.state, optimum.point
        normal = linearise(problem, state, point)
        slopes = np.zeros((*point.residuals.shape, len(state.theta)))
        for i, (places, block) in enumerate(point.blocks):
            slopes[:, i, places] = block
        self.error = point.residuals + np.einsum("nmi,ni->nm", normal.jacobian, state.step)
        self.design = np.concatenate([slopes, normal.shared], axis=2)
        self.jacobian, self.orientation_sd = normal.jacobian, problem.orientation_sd
        self.precision = problem.precision[:, :, None] * np.eye(3)
        self.rolled, self.p = problem.rolled, len(state.theta)
        self.prior = np.zeros(self.design.shape[2])
        if problem.level_sd:
            self.prior[-2:] = problem.level_sd**-2


def widths(linear, factor):
    """Return the variance of each angle of each position (n, 2); 1e4 for one that is free."""
    variance = np.tile(factor * linear.orientation_sd[:, None] ** 2, 2)
    variance[linear.rolled, 0] = np.inf
    return np.where(np.isinf(variance), 1e4, variance), float(
        np.isinf(variance).sum() * np.log(1e4)
    )


def by_definition(linear, tau2, factor):
    """Return -2 l, parameters and their variances with n M by n M matrices.

    A large sd stands for an unknown orientation, less its constant.
    """
    n, m = linear.error.shape
    V = np.zeros((n * m, n * m))
    variance, constant = widths(linear, factor)
    for k in range(n):
        block = np.linalg.inv(linear.precision[k]) + tau2 * np.eye(m)
        block = block + linear.jacobian[k] @ np.diag(variance[k]) @ linear.jacobian[k].T
        V[k * m : (k + 1) * m, k * m : (k + 1) * m] = block
    A, e = linear.design.reshape(n * m, -1), linear.error.ravel()
    random = np.flatnonzero(linear.prior)  # a tilt is an error of known variance
    Z = A[:, random]
    V = V + Z @ np.diag(1.0 / linear.prior[random]) @ Z.T
    constant += float(np.sum(np.log(1.0 / linear.prior[random])))
    X = np.delete(A, random, axis=1)
    W = np.linalg.inv(V)
    XWX = X.T @ W @ X
    C = np.linalg.inv(XWX)
    b = C @ X.T @ W @ e
    left = e - X @ b
    value = np.linalg.slogdet(V)[1] + np.linalg.slogdet(XWX)[1] + left @ W @ left - constant
    return value, b[: linear.p], np.diag(C)[: linear.p]


@pytest.mark.parametrize("unequal", [True, False], ids=["unequal", "equal"])
@pytest.mark.parametrize("both", [False, True], ids=["placement stated", "both"])
@pytest.mark.parametrize("kind", [*KINDS, "rolls, uncertain", "few, uncertain"])
def test_posterior_is_its_definition(kind, both, unequal):
    """Up to a constant; the prior is taken out again, as Jeffreys' by its own formula."""
    # eqs. (1), (3), (4) of estimation.orientation_variance
    problem, optimum = a_solution(kind, unequal=unequal)
    linear = Dense(problem, optimum)
    n, m = linear.error.shape
    floor = np.linalg.inv(linear.precision)
    size = 1e-4
    evaluator = _Evaluator(linear_model(problem, optimum), np.array([size]))
    if both:
        found = evaluator.at_both(FACTORS[None], NODES[None], whole=True)
        pairs = [(tau2, factor) for tau2 in NODES for factor in FACTORS]
    else:
        found, pairs = evaluator.at_excess(NODES[None], whole=True), [(tau2, 1.0) for tau2 in NODES]
    wanted = [by_definition(linear, *pair) for pair in pairs]
    # s = 100 rad in the place of an unknown direction leaves 1e-4 of its curvature
    free = linear.rolled.any() or np.isinf(linear.orientation_sd).any()
    tolerance = 3e-4 if free else 1e-9
    assert_allclose(found.moves[0], [b for _, b, _ in wanted], rtol=10 * tolerance, atol=tolerance)
    assert_allclose(found.variances[0], [c for _, _, c in wanted], rtol=10 * tolerance)
    log = found.log[0].copy()
    tied = np.where(np.isfinite(linear.orientation_sd), linear.orientation_sd, 0.0)
    tied = tied[:, None] * np.where(linear.rolled[:, None], [0.0, 1.0], 1.0)
    for g, (tau2, factor) in enumerate(pairs):
        J, variance = linear.jacobian, widths(linear, factor)[0]
        W = floor + tau2 * np.eye(m) + (J * variance[:, None, :]) @ J.transpose(0, 2, 1)
        W = np.linalg.inv(W)
        by_scatter = np.sum(W**2)  # tr W W, symmetric
        log[g] -= np.log(tau2 + size)
        if not both:
            log[g] -= 0.5 * np.log(by_scatter)
            continue
        D = (J * tied[:, None, :] ** 2) @ J.transpose(0, 2, 1)
        by_both = np.einsum("nij,nji->", W, W @ D)
        by_placement = np.einsum("nij,nji->", W @ D, W @ D)
        left = by_scatter * by_placement - by_both**2
        log[g] -= 0.5 * np.log(left) + np.log(factor) if left > 0.0 else 0.0
    value = np.array([each[0] for each in wanted])
    if both and not np.isfinite(found.log).all():
        assert not tied.any()  # no orientation has an sd, and F no meaning
        return
    assert_allclose(np.diff(-2.0 * log), np.diff(value), rtol=100 * tolerance, atol=n * tolerance)


def test_a_tilt_of_the_table_has_the_information_that_is_stated():
    problem, optimum = a_solution("everything")
    assert problem.level_sd > 0.0
    linear = linear_model(problem, optimum)
    # in the unknowns that are left, as combinations of parameters, rotations and tilt
    assert np.linalg.matrix_rank(linear.information) == 2
    assert_allclose(np.trace(np.linalg.pinv(linear.information) @ linear.information), 2.0)


def test_a_noise_of_which_next_to_nothing_is_told_counts_as_one_degree():
    """Six positions with placement of 1 degree: what is left for the noise is next to nothing."""
    up = mp.read_scheme("faces-6").up
    rng = np.random.default_rng(4)
    readings = mp.Readings(up + 1e-3 * rng.standard_normal(up.shape), up=up)
    cal = mp.fit(readings, orientation_sd=1.0)
    assert cal.parameter_dof.min() >= 1.0
    assert cal.k.max() <= 12.7063  # t of one degree of freedom at 0.975


def test_what_nothing_determines_is_left_out():
    """Two rows of one group on one direction, whose rotation about it no reading shows."""
    problem, optimum = a_solution("groups")
    rows = np.flatnonzero(problem.group == 0)
    direction = problem.reference.copy()
    direction[rows] = direction[rows[0]]
    up = optimum.state.centre.copy()
    up[rows] = up[rows[0]]
    problem = replace(problem, reference=direction)
    state = start_state(problem, optimum.state.theta, up, optimum.state.turns)
    linear = linear_model(problem, SimpleNamespace(state=state, point=evaluate(problem, state)))
    p, unknowns = len(state.theta), len(state.theta) + problem.shared
    assert linear.outer.shape == (p, unknowns - 1)
    found = _Evaluator(linear, np.array([1e-4])).at_excess(NODES[None], whole=True)
    assert np.isfinite(found.variances).all()


@pytest.mark.parametrize("unequal", [False, True])
def test_axes_of_errors_give_their_covariance_back(unequal):
    # eq. (2) of estimation.orientation_variance
    rng = np.random.default_rng(3)
    spread = rng.standard_normal((2, 5, 3, 2))
    variance = np.full((2, 5, 3), 0.3) * (rng.uniform(1.0, 2.0, (2, 5, 3)) if unequal else 1.0)
    block = Block(np.zeros((2, 5, 3)), np.zeros((2, 5, 3, 4)), spread, variance)
    U, a, c = _axes(block)
    for factor in (1.0,) if unequal else (1.0, 0.2, 5.0):
        turned = np.swapaxes(U, 2, 3) @ ((a + factor * c + 0.1)[..., None] * U)
        whole = (variance + 0.1)[..., None] * np.eye(3)
        whole = whole + factor * spread @ np.swapaxes(spread, 2, 3)
        assert_allclose(turned, whole, rtol=0, atol=1e-12)


def test_half_the_shortest_symmetric_interval_of_a_mixture_of_normals():
    """Σ w P(|x| ≤ U) = .95 by SciPy, of normals off zero."""
    means, sds = np.array([0.0, 1.5, -4.0]), np.array([1.0, 0.3, 0.5])
    weights = np.array([0.6, 0.3, 0.1])

    def lacking(U):
        inside = stats.norm.cdf((U - means) / sds) - stats.norm.cdf((-U - means) / sds)
        return float(weights @ inside) - 0.95

    found = _search_half(means[None, :, None], sds[None, :, None], weights[None], 0.95)
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(optimize.brentq(lacking, 0.1, 30.0, xtol=1e-12), rel=1e-9)


@pytest.mark.parametrize("dof", [1.5, 7.0, 40.0])
def test_degrees_of_freedom_by_how_much_wider_the_outer_interval_is(dof):
    outer, inner = (stats.t.isf((1.0 - p) / 2.0, dof) for p in (_COVERAGE, _INNER))
    assert dof_of_tails(np.array([outer / inner]))[0] == pytest.approx(dof, rel=0.02)


@pytest.mark.parametrize("r", [2, 3, 4])
def test_axes_of_orientation_errors_are_eigenvectors(r):
    spread = np.random.default_rng(r).normal(size=(2, 5, r, 2))
    spread[0, 0] = 0.0  # a position that is known exactly
    spread[0, 1, :, 1] = 0.0  # and three where errors act along one line
    spread[0, 2, 1:] = 0.0
    spread[0, 3, :, 1] = 0.3 * spread[0, 3, :, 0]
    axes, values = _axes_of_errors(spread)
    square = spread @ np.swapaxes(spread, 2, 3)
    turned = axes @ square @ np.swapaxes(axes, 2, 3)
    np.testing.assert_allclose(turned, values[..., None] * np.eye(r), atol=1e-12)
    np.testing.assert_allclose(
        axes @ np.swapaxes(axes, 2, 3), np.tile(np.eye(r), (2, 5, 1, 1)), atol=1e-12
    )


def test_the_interval_of_a_law_beside_a_value():
    """Half of all lies at zero: 90 % of the other half make 95 %, 1.6449 of its sd."""
    sds, weights = np.array([[[1e-30], [2.0]]]), np.array([[0.5, 0.5]])
    found = _search_half(np.zeros((1, 2, 1)), sds, weights, 0.95)
    assert found == pytest.approx(2.0 * 1.6449, rel=1e-4)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_stated_noise_may_be_all_but_certain():
    """Of 37 decades between readings and what is stated: its density is e^800 of any other's."""

    def density(nodes, *, whole):
        log, none = -800.0 - nodes, np.zeros((*nodes.shape, 0))
        if whole:
            log[:, 0] = 0.0
        return Found(log, none, none)

    found = integrate(density, 20.0, np.ones(1), (np.full(1, 1.0), np.full(1, 30.0)))
    assert found.weights[0, 0] == 1.0
    assert not found.weights[0, 1:].any()
    nodes, weights = np.array([[0.0, 1.0]]), np.array([[1.0, 1e-310]])
    _, _, dof = Posterior(nodes, weights, nodes, nodes, np.ones(1)).summary
    assert np.isfinite(dof).all()  # 2/.25e-310 is none


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_the_prior_of_two_variances_that_do_the_same_is_next_to_nothing():
    """Traces 1, 1, 1 have no determinant; 5, 1, 2 have 9, and its root."""
    found = _prior_of_both(*np.array([[1.0, 5.0], [1.0, 1.0], [1.0, 2.0]]))
    assert -np.inf < found[0] < -300.0
    assert found[1] == pytest.approx(np.log(3.0))


class Counted:
    """A solution that no noise moves, and how often it was searched for."""

    size = np.ones(1)

    def __init__(self, model, rounds):
        self.model, self.rounds = model, rounds

    def of(self, units):
        return self

    def put(self, units, other):
        pass

    def linear(self):
        return self.model

    def searched(self, excess, factor, end):
        self.rounds.append((float(excess[0]), float(factor[0])))
        return self, np.ones(1, dtype=np.bool_)


def test_noise_is_found_again_before_it_counts_as_converged():
    """Variance and factor of one are the logarithms zero, which once stood for no round at all."""
    rng = np.random.default_rng(4)
    n, p = 60, 4
    design = rng.standard_normal((1, n, 3, p))
    spread = 10.0 * np.broadcast_to(np.eye(3)[:, :2], (1, n, 3, 2))
    moved = np.einsum("bnmi,bni->bnm", spread, rng.standard_normal((1, n, 2)))
    error = 0.7 * rng.standard_normal((1, n, 3)) + moved
    prior = np.zeros((p, p)), np.zeros(p), 0.0

    def rounds_of(spread):
        rounds = []
        linear = Linear((Block(error, design, spread, np.ones((1, n, 3))),), *prior)
        find_both(Counted(linear, rounds), np.ones(1, dtype=np.bool_), p, 3.0 * n - p)
        return rounds

    factor = rounds_of(spread)[0][1]
    rounds = rounds_of(spread * np.sqrt(factor))  # whose factor is one
    assert_allclose(np.log([1.0 + rounds[0][0], rounds[0][1]]), 0.0, atol=0.02)
    assert len(rounds) == 2

"""Scatter beside placement against its definition with full matrices, and what it covers."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_likelihood import KINDS, a_problem

import multipos as mp
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.orientation_variance import Linearised, _evaluate, _invert, linearised

NODES = np.array([0.0, 1e-4, 4e-4, 3e-3])  # the noise is of 1e-2
FACTORS = np.array([1.0, 0.1, 3.0, 20.0])


def a_linear(kind="uncertain"):
    """Return a linearisation of every kind of position, with residuals of both causes."""
    problem, state = a_problem(kind.removeprefix("rolls, "))
    some = np.arange(len(problem.values)) % 3 == 0
    rolled = some if kind.startswith("rolls") else problem.rolled
    normal = linearise(problem, state, evaluate(problem, state))
    rng = np.random.default_rng(8)
    n = len(problem.values)
    spread = np.where(np.isfinite(problem.orientation_sd), problem.orientation_sd, 0.5)
    off = np.einsum("nmi,ni->nm", normal.jacobian, spread[:, None] * rng.standard_normal((n, 2)))
    noise = rng.standard_normal((n, 3)) / np.sqrt(problem.precision)
    p = len(state.theta)
    design = np.zeros((n, 3, p))
    for i, (places, slopes) in enumerate(evaluate(problem, state).blocks):
        design[:, i, places] = slopes
    prior = np.zeros(p + problem.shared)
    if problem.level_sd:
        prior[-2:] = problem.level_sd**-2
    return Linearised(
        error=2.0 * noise + 3.0 * off,
        design=np.concatenate([design, normal.shared], axis=2),
        jacobian=normal.jacobian,
        precision=problem.precision[:, :, None] * np.eye(3),
        orientation_sd=problem.orientation_sd,
        prior=prior,
        p=p,
        rolled=rolled,
    )


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


@pytest.mark.parametrize("factors", [None, FACTORS], ids=["placement stated", "both"])
@pytest.mark.parametrize("kind", [*KINDS, "rolls, uncertain"])
def test_posterior_is_its_definition(kind, factors):
    """Up to a constant; the prior is taken out again, as Jeffreys' by its own formula."""
    linear = a_linear(kind)
    n, m = linear.error.shape
    floor = np.linalg.inv(linear.precision)
    size = 1e-4
    found = _evaluate(linear, floor, size, factors, NODES)
    both = np.ones(len(NODES)) if factors is None else factors
    wanted = [by_definition(linear, *pair) for pair in zip(NODES, both, strict=True)]
    # s = 100 rad in the place of an unknown direction leaves 1e-4 of its curvature
    free = linear.rolled.any() or np.isinf(linear.orientation_sd).any()
    tolerance = 3e-4 if free else 1e-9
    assert_allclose(found.moves, [b for _, b, _ in wanted], rtol=10 * tolerance, atol=tolerance)
    assert_allclose(found.variances, [c for _, _, c in wanted], rtol=10 * tolerance)
    log = found.log - np.log(NODES + size)
    tied = np.where(np.isfinite(linear.orientation_sd), linear.orientation_sd, 0.0)
    tied = tied[:, None] * np.where(linear.rolled[:, None], [0.0, 1.0], 1.0)
    for g, (tau2, factor) in enumerate(zip(NODES, both, strict=True)):
        J, variance = linear.jacobian, widths(linear, factor)[0]
        W = floor + tau2 * np.eye(m) + (J * variance[:, None, :]) @ J.transpose(0, 2, 1)
        W = np.linalg.inv(W)
        by_scatter = np.sum(W**2)  # tr W W, symmetric
        if factors is None:
            log[g] -= 0.5 * np.log(by_scatter)
            continue
        D = (J * tied[:, None, :] ** 2) @ J.transpose(0, 2, 1)
        by_both = np.einsum("nij,nji->", W, W @ D)
        by_placement = np.einsum("nij,nji->", W @ D, W @ D)
        log[g] -= 0.5 * np.log(by_scatter * by_placement - by_both**2) + np.log(factor)
    value = np.array([each[0] for each in wanted])
    assert_allclose(np.diff(-2.0 * log), np.diff(value), rtol=100 * tolerance, atol=n * tolerance)


def test_a_tilt_of_the_table_has_the_information_that_is_stated():
    problem, state = a_problem("everything")
    assert problem.level_sd > 0.0
    optimum = SimpleNamespace(state=state, point=evaluate(problem, state))
    prior = linearised(problem, optimum).prior
    assert_allclose(prior[-2:], 1.0 / problem.level_sd**2, rtol=1e-15)
    assert not prior[:-2].any()
    assert len(prior) == len(state.theta) + problem.shared


def test_a_noise_of_which_next_to_nothing_is_told_counts_as_one_degree():
    """Six positions with placement of 1 degree: what is left for the noise is next to nothing."""
    up = mp.read_scheme("faces-6").up
    rng = np.random.default_rng(4)
    readings = mp.Readings(up + 1e-3 * rng.standard_normal(up.shape), up=up)
    cal = mp.fit(readings, orientation_sd=1.0)
    assert cal.parameter_dof.min() >= 1.0
    assert cal.k.max() <= 12.7063  # t of one degree of freedom at 0.975


def test_what_nothing_tells_is_left_out_of_the_inverse():
    """diag(4, 0, 9): 1/4 and 1/9, ln 36; as with a rotation about the only direction of a group."""
    inverse, log = _invert(np.array([np.diag([4.0, 0.0, 9.0])]))
    assert_allclose(inverse[0], np.diag([0.25, 0.0, 1.0 / 9.0]), rtol=1e-14)
    assert_allclose(log, np.log(36.0), rtol=1e-14)
    tied = np.array([[1.0, 1.0], [1.0, 1.0]])  # only the sum is told
    assert_allclose(_invert(tied[None])[0][0], tied / 4.0, rtol=1e-12)

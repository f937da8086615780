"""Scatter beside placement against its definition with full matrices, and what it covers."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_likelihood import KINDS, a_problem

import multipos as mp
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.linearisation import Linearised, linearised
from multipos.estimation.placed_scatter import _evaluate, _invert

NODES = np.array([0.0, 1e-4, 4e-4, 3e-3])  # the noise is of 1e-2
FACTORS = np.array([1.0, 0.1, 3.0, 20.0])


def a_linear(kind="uncertain"):
    """Return a linearisation of every kind of position, with residuals of both causes."""
    problem, state = a_problem(kind)
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
    )


def by_definition(linear, tau2, factor):
    """Return -2 l, parameters and their variances with n M by n M matrices.

    A large sd stands for an unknown orientation, less its constant.
    """
    n, m = linear.error.shape
    V = np.zeros((n * m, n * m))
    constant = 0.0
    for k in range(n):
        s2 = factor * linear.orientation_sd[k] ** 2
        if np.isinf(s2):
            s2 = 1e4
            constant += 2.0 * np.log(s2)
        block = np.linalg.inv(linear.precision[k]) + tau2 * np.eye(m)
        block = block + s2 * linear.jacobian[k] @ linear.jacobian[k].T
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
@pytest.mark.parametrize("kind", KINDS)
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
    tolerance = 1e-9 if np.isfinite(linear.orientation_sd).all() else 3e-4
    assert_allclose(found.moves, [b for _, b, _ in wanted], rtol=10 * tolerance, atol=tolerance)
    assert_allclose(found.variances, [c for _, _, c in wanted], rtol=10 * tolerance)
    log = found.log - np.log(NODES + size)
    tied = np.isfinite(linear.orientation_sd)
    for g, (tau2, factor) in enumerate(zip(NODES, both, strict=True)):
        s2 = np.where(tied, linear.orientation_sd, 100.0) ** 2 * np.where(tied, factor, 1.0)
        JJ = linear.jacobian @ linear.jacobian.transpose(0, 2, 1)
        W = np.linalg.inv(floor + tau2 * np.eye(m) + s2[:, None, None] * JJ)
        by_scatter = np.sum(W**2)  # tr W W, symmetric
        if factors is None:
            log[g] -= 0.5 * np.log(by_scatter)
            continue
        D = np.where(tied, linear.orientation_sd, 0.0)[:, None, None] ** 2 * JJ
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

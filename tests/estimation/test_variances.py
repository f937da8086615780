"""Restricted maximum likelihood against its definition with full matrices, and textbook cases."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_likelihood import KINDS, a_problem

import multipos as mp
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.variances import (
    Linearised,
    _restricted,
    components,
    linearised,
    maximise_restricted,
)

BOTH = np.array([True, True])
NOISE = np.array([True, False])


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


def by_definition(linear, v):
    """Return -2 l with n M by n M matrices; a large sd stands for unknown, less its constant."""
    n, m = linear.error.shape
    V = np.zeros((n * m, n * m))
    constant = -float(np.sum(np.linalg.slogdet(linear.precision)[1]))  # of the stated noise
    for k in range(n):
        s2 = np.exp(v[1]) * linear.orientation_sd[k] ** 2
        if np.isinf(s2):
            s2 = 1e4
            constant += 2.0 * np.log(s2)
        block = np.exp(v[0]) * np.linalg.inv(linear.precision[k])
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
    P = W - W @ X @ np.linalg.solve(XWX, X.T @ W)
    return np.linalg.slogdet(V)[1] + np.linalg.slogdet(XWX)[1] + e @ P @ e - constant


@pytest.mark.parametrize("v", [(0.0, 0.0), (1.0, -2.0), (-3.0, 2.5)])
@pytest.mark.parametrize("kind", KINDS)
def test_likelihood_is_its_definition(kind, v):
    linear = a_linear(kind)
    found = _restricted(linear, np.array(v))[0]
    # s = 100 rad in the place of an unknown direction leaves 1e-4 of its curvature
    tolerance = 1e-9 if np.isfinite(linear.orientation_sd).all() else 3e-4
    assert found == pytest.approx(by_definition(linear, np.array(v)), rel=tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_by_finite_differences(kind):
    linear, v, h = a_linear(kind), np.array([0.3, -0.4]), 1e-5
    found = _restricted(linear, v)[1]
    for i in range(2):
        step = h * np.eye(2)[i]
        up, down = _restricted(linear, v + step)[0], _restricted(linear, v - step)[0]
        assert found[i] == pytest.approx((up - down) / (2.0 * h), rel=1e-6, abs=1e-6)


def test_derivative_of_the_covariance_by_finite_differences():
    linear, v, h = a_linear("everything"), np.array([0.3, -0.4]), 1e-5
    C, change = _restricted(linear, v)[2]
    for i in range(2):
        step = h * np.eye(2)[i]
        up, down = _restricted(linear, v + step)[2][0], _restricted(linear, v - step)[2][0]
        wanted = (up - down) / (2.0 * h)
        assert_allclose(C @ change[i] @ C, wanted, atol=1e-7 * np.abs(wanted).max())


def test_exact_positions_give_the_residual_variance_and_its_degrees_of_freedom():
    """The textbook: sigma² = rss/nu, var ln sigma² = 2/nu, nu degrees for every parameter."""
    linear = a_linear()
    linear = replace(linear, orientation_sd=np.zeros(len(linear.orientation_sd)))
    n, m = linear.error.shape
    A = linear.design.reshape(n * m, -1)
    W = linear.precision.reshape(n, m, m)
    weighted = (W @ linear.design).reshape(n * m, -1)
    b = np.linalg.solve(weighted.T @ A, weighted.T @ linear.error.ravel())
    left = linear.error - (A @ b).reshape(n, m)
    rss, nu = float(np.einsum("ni,nij,nj->", left, W, left)), n * m - A.shape[1]
    v = maximise_restricted(linear, np.zeros(2), NOISE)
    assert np.exp(v[0]) == pytest.approx(rss / nu, rel=1e-5)
    told = components(linear, v, NOISE)
    # the curvature is a difference over ±0.05 in ln variance: h²/6 of it
    assert told.log_covariance[0, 0] == pytest.approx(2.0 / nu, rel=1e-3)
    assert_allclose(told.dof, nu, rtol=1e-3)


@pytest.mark.parametrize("start", [(0.0, 0.0), (6.0, -6.0), (-5.0, 8.0)])
def test_the_maximum_is_found_from_afar(start):
    linear = a_linear()
    v = maximise_restricted(linear, np.array(start), BOTH)
    assert_allclose(_restricted(linear, v)[1], 0.0, atol=1e-3)
    near = maximise_restricted(linear, np.zeros(2), BOTH)
    assert_allclose(v, near, atol=1e-4)


def test_a_variance_of_which_nothing_is_left_is_known_to_be_hardly_known():
    linear = a_linear()
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(linear.error.shape)
    linear = replace(
        linear, error=1e-2 * noise, orientation_sd=np.full(len(linear.orientation_sd), 1e-9)
    )
    v = maximise_restricted(linear, np.zeros(2), BOTH)
    told = components(linear, v, BOTH)
    # as flat as the likelihood is at its boundary, the variance is known to a factor of e^5
    assert told.log_covariance[1, 1] == pytest.approx(25.0, rel=1e-3)


def test_a_tilt_of_the_table_has_the_information_that_is_stated():
    problem, state = a_problem("everything")
    assert problem.level_sd > 0.0
    optimum = SimpleNamespace(state=state, point=evaluate(problem, state))
    prior = linearised(problem, optimum).prior
    assert_allclose(prior[-2:], 1.0 / problem.level_sd**2, rtol=1e-15)
    assert not prior[:-2].any()
    assert len(prior) == len(state.theta) + problem.shared


def test_a_variance_on_less_than_one_contrast_counts_as_one():
    """Six positions with placement of 1 degree: what is left for the noise is next to nothing."""
    up = mp.read_scheme("faces-6").up
    rng = np.random.default_rng(4)
    readings = mp.Readings(up + 1e-3 * rng.standard_normal(up.shape), up=up)
    cal = mp.fit(readings, orientation_sd=1.0)
    assert cal.parameter_dof.min() >= 1.0
    assert cal.dof.min() >= 1.0
    assert cal.k.max() <= 12.7063  # t of one degree of freedom at 0.975
    assert any("hardly determined" in said for said in cal.diagnostics.warnings)

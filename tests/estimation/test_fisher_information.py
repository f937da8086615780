"""What is told at a point against sums over dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from multipos.estimation.descent import maximise
from multipos.estimation.information import FisherInformation
from multipos.estimation.likelihood import linearise
from multipos.estimation.problem import Problem, start_state
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.cofactors import cofactors_of
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import build_model

N = 40
ROUNDING = 1e-10  # W of three outputs is the difference of numbers some thousand times as large


def a_solution(gauge="lower", *, robust=None, groups=0, sd=np.inf):
    """Return a problem of a triad, and its optimum from the truth."""
    rng = np.random.default_rng(7)
    model = build_model("own-quadratic", ("ax", "ay", "az"), COMPONENTS)
    if np.isinf(sd):
        model = model.with_gauge(gauge)
    up = rng.standard_normal((N, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    theta = 0.01 * rng.standard_normal(len(model.keys))
    theta[list(model.own_scales)] += 1.0
    values = model.predict(theta, up, {}) + 1e-3 * rng.standard_normal((N, 3))
    problem = Problem(
        model=model,
        values=values,
        environment={},
        precision=rng.uniform(0.5, 2.0, (N, 3)) * 1e6,
        reference=up,
        orientation_sd=np.full(N, sd),
        group=np.where(np.arange(N) < 2 * groups, np.arange(N) // 2, -1),
        weight=np.ones(N),
        groups=groups,
        robust=robust,
    )
    found = maximise(problem, start_state(problem, theta, up))
    assert found.converged
    return problem, found


def dense(problem, found):
    """Return A (3n, p + shared) and W (3n, 3n) of a problem, as the likelihood has them."""
    normal = linearise(problem, found.state, found.point)
    slopes = parameter_jacobian(problem.model, found.state.theta, found.point.force, {})
    A = np.concatenate([slopes, normal.shared], axis=2).reshape(3 * N, -1)
    W = np.zeros((N, 3, N, 3))
    W[np.arange(N), :, np.arange(N)] = normal.marginal
    return A, W.reshape(3 * N, 3 * N)


CASES = {
    "unknown": {},
    "symmetric": {"gauge": "symmetric"},
    "robust": {"robust": "huber"},
    "uncertain": {"sd": 0.01},
    "groups": {"sd": 0.01, "groups": 3},
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_told_is_what_dense_matrices_tell(case):
    # eq. (1) of estimation.information
    problem, found = a_solution(**CASES[case])
    told = FisherInformation(problem, found.state, found.point)
    A, W = dense(problem, found)
    S = A.T @ W @ A
    scale = np.sqrt(np.diag(S))
    assert_allclose(
        told.information / np.outer(scale, scale), S / np.outer(scale, scale), atol=ROUNDING
    )

    rng = np.random.default_rng(1)
    columns, output_of = rng.standard_normal((5, N)), np.array([0, 2, 1, 0, 2])
    Z = np.zeros((N, 3, 5))
    Z[:, output_of, np.arange(5)] = columns.T
    Z = Z.reshape(3 * N, 5)
    beside = told.with_slopes(columns, output_of)
    size = np.sqrt(np.diag(Z.T @ W @ Z))
    assert_allclose(
        beside.gram / np.outer(size, size), Z.T @ W @ Z / np.outer(size, size), atol=ROUNDING
    )
    assert_allclose(
        beside.cross / np.outer(scale, size), A.T @ W @ Z / np.outer(scale, size), atol=ROUNDING
    )
    if problem.robust is None:  # of one that is, others ask the problem without its loss
        push = (problem.precision * found.point.residuals).ravel()
        # the search ends within 1e-8 u, so far from J'Σ⁻¹r = 0 is each position
        assert_allclose(beside.own / scale, A.T @ push / scale, atol=1e-6)
        assert_allclose(beside.score / size, Z.T @ push / size, atol=1e-6)

    p = len(problem.model.keys)
    C = np.linalg.inv(S)
    whole = np.diag(W @ A[:, :p] @ C[:p, :p] @ A[:, :p].T).reshape(N, 3)
    assert_allclose(told.leverage(C[:p, :p]), whole, atol=1e-8)
    weights, slopes = told.weighted()
    own = W.reshape(N, 3, N, 3)[np.arange(N), :, np.arange(N)]
    assert_allclose(weights.transpose(2, 0, 1), own, atol=1e-8 * np.abs(W).max())
    WA = slopes.transpose(2, 0, 1).reshape(3 * N, -1)
    assert_allclose(WA / scale, W @ A / scale, atol=1e-8 * np.abs(W @ A / scale).max())


def test_variances_of_outputs_are_a_covariance_without_correlation():
    problem, found = a_solution()
    full = replace(problem, precision=problem.precision[:, :, None] * np.eye(3))
    some, whole = (FisherInformation(each, found.state) for each in (problem, full))
    assert_allclose(some.point.q, whole.point.q, rtol=1e-9)
    C = np.linalg.inv(whole.information)
    assert_allclose(some.leverage(C), whole.leverage(C), atol=1e-8)
    assert_allclose(some.leverage(C).sum(), len(C), rtol=1e-8)  # as many as there are parameters


def test_cofactors_of_a_matrix_without_inverse_by_hand():
    assert cofactors_of(np.arange(1.0, 10.0).reshape(3, 3)).tolist() == [
        [-3.0, 6.0, -3.0],
        [6.0, -12.0, 6.0],
        [-3.0, 6.0, -3.0],
    ]

"""Steps on the sphere and rotations, against finite differences and the matrix exponential."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from multipos.numerics.rotations import (
    align,
    cross_matrix,
    left_jacobian,
    rotation_matrix,
    rotation_vector,
    step_derivative,
    step_on_sphere,
    tangent_basis,
)

H = 1e-6  # step of central differences: truncation 1e-12, rounding 1e-10


def directions(count=50):
    rng = np.random.default_rng(7)
    random = rng.standard_normal((count, 3))
    special = np.array([*np.eye(3), *-np.eye(3), [0.6, 0.8, 0.0], [0.6, 0.8, -0.0]])
    every = np.vstack([random, special])
    return every / np.linalg.norm(every, axis=1)[:, None]


def test_basis_is_orthonormal_and_right_handed():
    u = directions()
    basis = tangent_basis(u)
    frame = np.concatenate([basis, u[:, :, None]], axis=2)
    assert_allclose(
        frame.transpose(0, 2, 1) @ frame, np.tile(np.eye(3), (len(u), 1, 1)), atol=4e-16
    )
    assert_allclose(np.linalg.det(frame), 1.0, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1.1e-4, 0.3, 2.0, 3.1])
def test_step_goes_along_a_great_circle(size):
    # eq. (1) of numerics.rotations
    u = directions()
    step = np.random.default_rng(1).standard_normal((len(u), 2))
    step *= size / np.linalg.norm(step, axis=1)[:, None]
    end = step_on_sphere(u, tangent_basis(u), step)
    assert_allclose(np.linalg.norm(end, axis=1), 1.0, atol=4e-16)
    angle = np.arctan2(np.linalg.norm(np.cross(u, end), axis=1), np.einsum("ni,ni->n", u, end))
    assert_allclose(angle, size, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-5, 0.99e-4, 1.01e-4, 0.3, 2.0, 3.1])
def test_step_derivative_by_finite_differences(size):
    # eq. (2) of numerics.rotations
    u = directions()
    basis = tangent_basis(u)
    step = np.random.default_rng(2).standard_normal((len(u), 2))
    step *= size / np.linalg.norm(step, axis=1)[:, None]
    found = step_derivative(u, basis, step)
    for i in range(2):
        nudge = H * np.eye(2)[i]
        wanted = step_on_sphere(u, basis, step + nudge) - step_on_sphere(u, basis, step - nudge)
        assert_allclose(found[:, :, i], wanted / (2.0 * H), atol=1e-9)


VECTORS = [
    np.zeros(3),
    np.array([1e-9, 0.0, -2e-9]),
    np.array([0.02, -0.01, 0.03]),
    np.array([0.9, -1.2, 0.4]),
    np.array([0.0, np.pi - 1e-7, 0.0]),
    np.array([1.0, 2.0, -2.0]) / 3.0 * 3.1415,
]


@pytest.mark.parametrize("vector", VECTORS, ids=str)
def test_rotation_is_the_matrix_exponential(vector):
    skew = cross_matrix(vector[None])[0]
    assert_allclose(skew @ [1.0, 2.0, 3.0], np.cross(vector, [1.0, 2.0, 3.0]), atol=1e-14)
    turned = rotation_matrix(vector)
    assert_allclose(turned, expm(skew), atol=2e-15)
    # near half a turn the sine loses half the digits of the axis
    back = rotation_vector(turned)
    assert_allclose(rotation_matrix(back), turned, atol=3e-8)
    assert_allclose(back, vector, atol=1e-7)


def test_half_a_turn_keeps_its_axis():
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    found = rotation_vector(rotation_matrix(np.pi * axis))
    assert_allclose(np.abs(found @ axis), np.pi, atol=1e-8)


@pytest.mark.parametrize("vector", VECTORS[:4], ids=str)
def test_left_jacobian_by_finite_differences(vector):
    # eq. (3) of numerics.rotations
    found = left_jacobian(vector)
    turned = rotation_matrix(vector)
    for i in range(3):
        nudge = H * np.eye(3)[i]
        difference = rotation_matrix(vector + nudge) - rotation_matrix(vector - nudge)
        skew = difference @ turned.T / (2.0 * H)
        wanted = [skew[2, 1], skew[0, 2], skew[1, 0]]
        assert_allclose(found[:, i], wanted, atol=1e-9)


def test_align_finds_the_rotation_and_never_a_reflection():
    rng = np.random.default_rng(3)
    source = directions()
    turn = rotation_matrix(rng.standard_normal(3))
    assert_allclose(align(source, source @ turn.T), turn, atol=1e-14)
    mirrored = align(source, -source)
    assert_allclose(np.linalg.det(mirrored), 1.0, atol=1e-14)

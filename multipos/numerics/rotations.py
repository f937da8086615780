"""Directions on the sphere and rotations, many at a time.

`directions` makes unit vectors, `tangent_basis` the two directions across each. `step_on_sphere` is
E of eq. (1), `step_derivative` its derivative. `rotation_matrix` is Exp of a rotation vector,
`rotation_vector` its inverse, `cross_matrix` [v]x and `left_jacobian` J_l; `align` is the rotation
that brings vectors nearest to others.

A direction d is a unit vector; a step t (two angles) in the tangent plane at u, with the
orthonormal basis B (3, 2), leads along a great circle:

    E(u, t) = cos|t| u + sinc|t| B t,          sinc a = sin(a)/a,                           (1)
    dE/dt   = sinc|t| (B - u t') + c2 B t t',  c2 = (cos|t| - sinc|t|)/|t|².               (2)

A rotation vector rho turns v to Exp([rho]x) v, and Exp([rho + d]x) = Exp([J_l(rho) d]x) Exp([rho]x)
to first order, with the left Jacobian

    J_l(rho) = I + (1 - cos a)/a² [rho]x + (a - sin a)/a³ [rho]x²,      a = |rho|.           (3)
"""

import numpy as np

from multipos.numerics.arrays import Array

_SMALL = 1e-4  # [rad], below it the series is exact to rounding


def directions(vectors: Array) -> Array:
    """Return unit vectors (n, 3) along vectors, the first axis for one of no length."""
    length = np.linalg.norm(vectors, axis=1)[:, None]
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), [1.0, 0.0, 0.0])


def tangent_basis(direction: Array) -> Array:
    """Return an orthonormal basis (n, 3, 2) of the plane across each direction (n, 3)."""
    x, y, z = direction.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    basis = np.empty((3, 2, len(direction)))
    basis[0, 0], basis[1, 0], basis[2, 0] = 1.0 + sign * x * x * a, sign * b, -sign * x
    basis[0, 1], basis[1, 1], basis[2, 1] = b, sign + y * y * a, -y
    return basis.transpose(2, 0, 1)


def step_on_sphere(direction: Array, basis: Array, step: Array) -> Array:
    """Return E(u, t) of eq. (1): (n, 3) from directions (n, 3), bases (n, 3, 2), steps (n, 2)."""
    angle = np.sqrt(np.einsum("ni,ni->n", step, step))
    along = np.einsum("nij,nj->ni", basis, step)
    # sin(a)/a, which is 1 to rounding below 1e-8
    sinc = np.sin(angle) / np.maximum(angle, 1e-300) + (angle == 0.0)
    result = np.cos(angle)[:, None] * direction + sinc[:, None] * along
    return np.asarray(result / np.sqrt(np.einsum("ni,ni->n", result, result))[:, None])


def step_derivative(direction: Array, basis: Array, step: Array) -> Array:
    """Return dE/dt of eq. (2), (n, 3, 2)."""
    angle2 = np.einsum("ni,ni->n", step, step)
    angle = np.sqrt(angle2)
    sinc = np.sinc(angle / np.pi)
    small = angle < _SMALL
    c2 = np.where(small, -1.0 / 3.0, (np.cos(angle) - sinc) / np.where(small, 1.0, angle2))
    along = np.einsum("nij,nj->ni", basis, step)
    inner = c2[:, None] * along - sinc[:, None] * direction
    return np.asarray(sinc[:, None, None] * basis + inner[:, :, None] * step[:, None, :])


def cross_matrix(vector: Array) -> Array:
    """Return [v]x (n, 3, 3) of vectors (n, 3): [v]x w = v x w."""
    x, y, z = vector.T
    crossed = np.zeros((3, 3, len(vector)))
    crossed[0, 1], crossed[1, 2], crossed[2, 0] = -z, -x, -y
    crossed[0, 2], crossed[1, 0], crossed[2, 1] = y, z, x
    return crossed.transpose(2, 0, 1)


def rotation_matrix(vector: Array) -> Array:
    """Return Exp([rho]x) (3, 3) of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    skew = cross_matrix(vector[None])[0]
    half = np.sinc(angle / (2.0 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * half**2 * skew @ skew)


def rotation_vector(matrix: Array) -> Array:
    """Return the rotation vector rho (3,) [rad] of Exp([rho]x), up to half a turn."""
    doubled = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    sine = float(np.linalg.norm(doubled)) / 2.0
    angle = float(np.arctan2(sine, (np.trace(matrix) - 1.0) / 2.0))
    if sine > _SMALL:
        return np.asarray(doubled / 2.0 * (angle / sine))
    if angle < 1.0:  # angle/sin(angle) is 1 to rounding
        return np.asarray(doubled / 2.0)
    # half a turn: the axis is the eigenvector of eigenvalue 1
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    axis = vectors[:, int(np.argmax(values))]
    return np.asarray(angle * axis * (np.sign(axis @ doubled) or 1.0))


def left_jacobian(vector: Array) -> Array:
    """Return J_l of eq. (3), (3, 3)."""
    angle = float(np.linalg.norm(vector))
    skew = cross_matrix(vector[None])[0]
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    second = 1.0 / 6.0 if angle < _SMALL else (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * skew + second * skew @ skew)


def align(source: Array, target: Array) -> Array:
    """Return the rotation R (3, 3) that brings source (n, 3) nearest to target: R source ~ target.

    Kabsch's solution by singular values; a proper rotation always.
    """
    left, _, right = np.linalg.svd(target.T @ source)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    return np.asarray((left * flip) @ right)

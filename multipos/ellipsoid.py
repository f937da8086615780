"""The closed-form start for unknown orientations: readings at rest lie on an ellipsoid.

With ``y = b + M d`` and |d| = g, the readings satisfy

    (y - b)' (M M')^-1 (y - b) = g²,                                                        (1)

a quadric that is linear in nine coefficients (six where M is diagonal). It is fitted
algebraically to centred, scaled readings, so that neither a unit nor a guess is needed. From
the matrix A and centre b, M M' = g² A^-1, and M is its lower-triangular (Cholesky) or symmetric
square root: any other differs by a rotation, which no reading at rest can tell.

Noise, or too few readings, can make the quadric something else than an ellipsoid. Then one
without cross terms is tried, and last the nearest sphere about the readings, which any solver
that descends can leave for the ellipsoid.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError

Array = NDArray[np.float64]

_FLAT = 0.005  # thickness of the cloud of readings below which it is a disc
_FLATTEST = 0.02  # ratio of semi-axes below which the ellipsoid is not believed


def ellipsoid_start(values: Array, magnitude: float, *, crossed: bool) -> tuple[Array, Array]:
    """Return bias (3,) and the lower-triangular matrix M (3, 3), in reading units.

    Parameters
    ----------
    values : (n, 3) array
        Readings, in any unit.
    magnitude : float [g]
    crossed : bool
        Whether M has cross terms; without them six coefficients are fitted instead of nine.

    Raises
    ------
    MultiposError
        The readings do not spread over three dimensions.
    """
    centre = values.mean(axis=0)
    size = np.sqrt(np.mean((values - centre) ** 2, axis=0))
    if not size.min() > 1e-9 * np.abs(values).max():
        raise MultiposError(
            "the readings of one output never change; turn the sensor so that every axis points "
            "up, down and level."
        )
    scaled = (values - centre) / size
    extent = np.linalg.svd(values - centre, compute_uv=False)
    if extent[-1] < _FLAT * extent[0]:
        raise MultiposError(
            "all positions lie on one circle, so the readings are flat; add positions off it."
        )
    found = _quadric(scaled, crossed)
    if found is None and crossed:
        found = _quadric(scaled, crossed=False)
    bias, square = _sphere(scaled) if found is None else found
    lower = np.linalg.cholesky(square) / magnitude
    return centre + size * bias, size[:, None] * lower


def symmetric_root(lower: Array) -> Array:
    """Return the symmetric square root of L L'."""
    left, singular, _ = np.linalg.svd(lower)
    return np.asarray((left * singular) @ left.T)


def _quadric(points: Array, crossed: bool) -> tuple[Array, Array] | None:
    """Return centre and M M' g² of the algebraic fit, None where it is no ellipsoid."""
    x, y, z = points.T
    columns = [x * x, y * y, z * z, 2 * x, 2 * y, 2 * z]
    if crossed:
        columns += [2 * x * y, 2 * x * z, 2 * y * z]
    if len(points) < len(columns):
        return None
    design = np.column_stack(columns)
    c = np.linalg.lstsq(design, np.ones(len(points)), rcond=1e-10)[0]
    form = np.diag(c[:3])
    if crossed:
        form += np.array([[0, c[6], c[7]], [c[6], 0, c[8]], [c[7], c[8], 0]])
    eigenvalues = np.linalg.eigvalsh(form)
    if not eigenvalues[0] > _FLATTEST**2 * eigenvalues[-1]:
        return None
    centre = -np.linalg.solve(form, c[3:6])
    # x'Ax + 2 b'x = 1 about its centre: (x-c)'A(x-c) = 1 + c'Ac
    radius2 = 1.0 + float(centre @ form @ centre)
    return (centre, radius2 * np.linalg.inv(form)) if radius2 > 0.0 else None


def _sphere(points: Array) -> tuple[Array, Array]:
    design = np.column_stack([2.0 * points, np.ones(len(points))])
    c = np.linalg.lstsq(design, np.einsum("ni,ni->n", points, points), rcond=1e-10)[0]
    radius2 = max(float(c[3] + c[:3] @ c[:3]), 1.0)
    return c[:3], radius2 * np.eye(3)

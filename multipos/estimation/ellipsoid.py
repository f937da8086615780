"""The closed-form start for unknown orientations: readings at rest lie on an ellipsoid.

With ``y = b + M d`` and |d| = g, the readings satisfy

    (y - b)' (M M')^-1 (y - b) = g²,                                                        (1)

a quadric. With S a symmetric matrix of trace zero, it is one that is linear in its unknowns,

    |y|² = y' S y + 2 v'y + w,      A = I − S,    b = A^-1 v,    r² = w + v' A^-1 v,        (2)

and (y − b)' A (y − b) = r². It is fitted to centred, scaled readings by least squares, so that
neither a unit nor a guess is needed. M M' = (r²/g²) A^-1 then, and M is its lower-triangular
(Cholesky) or symmetric square root: any other differs by a rotation, which no reading at rest
can tell.

What the positions do not show stays zero in S, as on a sphere. Noise can make the quadric
something else than an ellipsoid; then cross terms are left out of S, and last all of it.
"""

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array

_FLAT = 0.005  # thickness of the cloud of readings below which it is a disc
_SHOWN = 1e-3  # relative singular value below which a coefficient is not seen in the positions
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
    found = _quadric(scaled, crossed) if crossed else None
    found = found or _quadric(scaled, crossed=False) or _sphere(scaled)
    bias, square = found
    lower = np.linalg.cholesky(square) / magnitude
    return centre + size * bias, size[:, None] * lower


def symmetric_root(lower: Array) -> Array:
    """Return the symmetric square root of L L'."""
    left, singular, _ = np.linalg.svd(lower)
    return np.asarray((left * singular) @ left.T)


def _quadric(points: Array, crossed: bool) -> tuple[Array, Array] | None:
    """Return centre and r² A^-1 of eq. (2), None where it is no ellipsoid."""
    x, y, z = points.T
    columns = [x * x - z * z, y * y - z * z, 2 * x, 2 * y, 2 * z, np.ones_like(x)]
    if crossed:
        columns += [2 * x * y, 2 * x * z, 2 * y * z]
    c = _least_squares(columns, points)
    form = np.diag([1.0 - c[0], 1.0 - c[1], 1.0 + c[0] + c[1]])
    if crossed:
        form -= np.array([[0, c[6], c[7]], [c[6], 0, c[8]], [c[7], c[8], 0]])
    eigenvalues = np.linalg.eigvalsh(form)
    if not eigenvalues[0] > _FLATTEST**2 * eigenvalues[-1]:
        return None
    inverse = np.linalg.inv(form)
    radius2 = float(c[5] + c[2:5] @ inverse @ c[2:5])
    return (inverse @ c[2:5], radius2 * inverse) if radius2 > 0.0 else None


def _sphere(points: Array) -> tuple[Array, Array]:
    x, y, z = points.T
    c = _least_squares([2 * x, 2 * y, 2 * z, np.ones_like(x)], points)
    radius2 = max(float(c[3] + c[:3] @ c[:3]), 1.0)
    return c[:3], radius2 * np.eye(3)


def _least_squares(columns: list[Array], points: Array) -> Array:
    """Return the coefficients of |y|², zero where the positions do not show them."""
    square = np.einsum("ni,ni->n", points, points)
    return np.asarray(np.linalg.lstsq(np.column_stack(columns), square, rcond=_SHOWN)[0])

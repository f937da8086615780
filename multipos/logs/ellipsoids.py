"""The ellipsoid that readings of a triad lie on when it is turned through all directions.

- `fit_ellipsoid` finds it, and with it what of the readings grows with the square of the turn rate.
- `off_the_ellipsoid` gives the misfit of readings to it, and their directions.
- `covers` tells whether readings are those of a triad that was turned through all directions.
- `usual_turn` is how far it turns from one reading to the next, `angles` those of directions.

A field of size one reads y = b + M f, |f| = 1, and a lever arm adds a ω², so that

    (y − b)'A (y − b) − 2 ω² a'A (y − b) = 1,     A = (M M')⁻¹,                             (1)

to first order in a. About a point near b this is linear in A, A b and A a. Its residual is twice
the misfit |f| − 1, so that weights of the misfit are weights of eq. (1).

References
----------
Q. Li, J. G. Griffiths, Geometric Modeling and Processing 2004: quadrics by linear least squares.
"""

from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array, median

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_FEWEST = 12  # rows
_NEAR = 0.1  # of the radius, that half of the rows are within
_LEAST = 0.1  # mean square of the component of directions that varies least; 1/3 where it is even


class Ellipsoid(NamedTuple):
    """Eq. (1): the centre b (3,), a root (3, 3) of A, and a (3,) where it was sought."""

    centre: Array
    root: Array
    arm: Array

    def field(self, values: Array) -> Array:
        """Return the field (n, 3) at readings, in axes of its own."""
        return np.asarray((values - self.centre) @ self.root)


def fit_ellipsoid(
    values: Array,
    *,
    weight: Array | None = None,
    square: Array | None = None,
    about: Array | None = None,
) -> Ellipsoid | None:
    """Return the ellipsoid of readings (n, 3) by eq. (1); None where they lie on none.

    Parameters
    ----------
    values : (n, 3) array
    weight : (n,) array, optional
        Inverse standard deviations of the misfits.
    square : (n,) array, optional
        ω², in any unit.
    about : (3,) array, optional
        A point near the centre; the mean if not given.
    """
    about = values.mean(axis=0) if about is None else about
    scale = float(values.std()) or 1.0
    y = (values - about) / scale
    columns = [*(y[:, i] * y[:, j] for i, j in _PAIRS), *y.T]
    if square is not None:
        columns += list((y * square[:, None]).T)
    weight = np.ones(len(y)) if weight is None else weight
    p = np.linalg.lstsq(np.column_stack(columns) * weight[:, None], weight, rcond=None)[0]
    A = np.zeros((3, 3))
    for (i, j), value in zip(_PAIRS, p.tolist(), strict=False):
        A[i, j] += 0.5 * value
        A[j, i] += 0.5 * value
    size, vectors = np.linalg.eigh(A)
    if not (size > 0.0).all():
        return None
    centre = -0.5 * np.linalg.solve(A, p[6:9])
    root = vectors * np.sqrt(size / (1.0 + centre @ A @ centre)) @ vectors.T
    arm = np.zeros(3) if square is None else -0.5 * np.linalg.solve(A, p[9:])
    return Ellipsoid(about + scale * centre, root / scale, scale * arm)


def off_the_ellipsoid(values: Array) -> tuple[Array, Array]:
    """Return the misfit (n,) of readings to their ellipsoid, and their directions (n, 3).

    Where the readings have none, the misfit is 0 and directions are those about their mean.
    """
    found = fit_ellipsoid(values)
    if found is None:
        return np.zeros(len(values)), values - values.mean(axis=0)
    field = found.field(values)
    length = np.linalg.norm(field, axis=1)
    return length - 1.0, field / np.where(length > 0.0, length, 1.0)[:, None]


def covers(values: Array) -> bool:
    """Tell whether readings (n, M) lie on an ellipsoid, and all around it."""
    if values.shape[1] != 3 or len(values) < _FEWEST:
        return False
    misfit, along = off_the_ellipsoid(values)
    near = misfit.any() and float(median(np.abs(misfit))) < _NEAR
    return bool(near and np.linalg.eigvalsh(along.T @ along / len(along))[0] > _LEAST)


def usual_turn(values: Array) -> float:
    """Return the median angle [degrees] from one reading (n, 3) to the next."""
    along = off_the_ellipsoid(values)[1]
    return float(median(np.degrees(angles(along[1:], along[:-1]))))


def angles(one: Array, other: Array) -> Array:
    """Return the angles (n,) [rad] between directions (n, 3)."""
    chord = np.linalg.norm(one - other, axis=1)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))

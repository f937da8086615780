"""Cofactors of 3 × 3 matrices, many at a time.

`cofactors_of` returns C of each matrix G,

    C_ij = G_i+1,j+1 G_i+2,j+2 − G_i+1,j+2 G_i+2,j+1,    indices modulo 3,

so that G' C = det(G) I. They exist where G has no inverse.
"""

from __future__ import annotations

import numpy as np

from multipos.numerics.arrays import Array, Places

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # the other two axes, in cyclic order


def _places(row: Places, column: Places) -> Places:
    """Return where G_row,column stands among nine numbers, (9,)."""
    return (3 * row[:, None] + column).ravel()


_FIRST = _places(_NEXT, _NEXT), _places(_LAST, _LAST)
_SECOND = _places(_NEXT, _LAST), _places(_LAST, _NEXT)


def cofactors_of(matrices: Array) -> Array:
    """Return the cofactors (3, 3, ...) of matrices (3, 3, ...).

    Examples
    --------
    >>> cofactors_of(np.diag([2.0, 3.0, 5.0])).tolist()
    [[15.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 6.0]]
    """
    nine = matrices.reshape(9, *matrices.shape[2:])
    a, b, c, d = (nine.take(place, axis=0) for place in (*_FIRST, *_SECOND))
    return np.asarray(a * b - c * d).reshape(matrices.shape)

"""The six-position inversion of Song and Qin, equation by equation.

With each axis of the case once up and once down, and the model of their eq. (1) for the output
that senses axis x (the others by exchange of axes),

    A = a_0 + S a_x + K_1 a_y + K_2 a_z + K_3 a_x²,

the six readings of eqs. (2)–(4) are A = a_0 ± K_1, a_0 ± K_2 and a_0 + K_3 ± S. Write A_+x for
the reading where a_x = +1, and so on. Then, as printed below eqs. (2), (3) and (4),

    a_0 = (A_+y + A_-y + A_+z + A_-z)/4,     S   = (A_+x - A_-x)/2,
    K_1 = (A_+y - A_-y)/2,                   K_2 = (A_+z - A_-z)/2,
    K_3 = (2 A_+x + 2 A_-x - A_+y - A_-y - A_+z - A_-z)/4.

Six readings less five coefficients leave one contrast, the two cross-axis pairs against each
other: A_+y + A_-y - A_+z - A_-z. It is all that six positions can say against the model.
For the linear model the bias is the mean of all six readings and K_3 is left out.

With a reference of magnitude g instead of 1, S and the K_1, K_2 are divided by g, K_3 by g².

References
----------
Song Lijun, Qin Yongyuan, *Six-position testing of MEMS accelerometer*, 2009, eqs. (1)–(4).
"""

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array

_TOLERANCE = 1e-9  # [g], the floor below which a component of the reference is zero


def six_positions(reference: Array) -> NDArray[np.intp] | None:
    """Return which row is +x, −x, +y, −y, +z, −z up, or None if these are not the six positions.

    Parameters
    ----------
    reference : (n, 3) array [g]

    Returns
    -------
    (3, 2) array of row numbers, or None
    """
    if reference.shape != (6, 3):
        return None
    magnitude = np.abs(reference).max()
    rows = np.empty((3, 2), dtype=np.intp)
    for axis in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            wanted = np.zeros(3)
            wanted[axis] = sign * magnitude
            hits = np.flatnonzero(np.abs(reference - wanted).max(axis=1) < _TOLERANCE)
            if len(hits) != 1:
                return None
            rows[axis, side] = hits[0]
    return rows


def closed_form_weights(
    reference: Array, rows: NDArray[np.intp], own: int, *, quadratic: bool = True
) -> Array:
    """Return how each coefficient of one output is made of the six readings.

    Parameters
    ----------
    reference : (6, 3) array [g]
    rows : (3, 2) array
        From `six_positions`.
    own : int
        The axis that the output senses: 0, 1 or 2.
    quadratic : bool
        With the second-order coefficient, as in the paper; otherwise the linear model.

    Returns
    -------
    (5, 6) or (4, 6) array
        Rows: the coefficients of 1, x, y, z and, with `quadratic`, of own². The coefficients
        are this matrix times the readings of the output.
    """
    g = float(np.abs(reference).max())
    pair = np.zeros((3, 2, 6))  # pair[axis, side] picks A_{±axis} out of the six readings
    for axis in range(3):
        for side in range(2):
            pair[axis, side, rows[axis, side]] = 1.0
    total, difference = pair[:, 0] + pair[:, 1], pair[:, 0] - pair[:, 1]
    first_order = difference / (2.0 * g)  # S_a and K_a1, K_a2, below eqs. (2)–(4)
    cross = total.sum(axis=0) - total[own]
    if not quadratic:
        return np.vstack([total.sum(axis=0) / 6.0, first_order])
    bias = cross / 4.0  # a_0, below eqs. (2)–(4)
    second_order = (2.0 * total[own] - cross) / (4.0 * g * g)  # K_a3, below eqs. (2)–(4)
    return np.vstack([bias, first_order, second_order])

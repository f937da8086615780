"""The six-position inversion of Song and Qin, equation by equation.

`six_positions` says which row is which face, `closed_form_weights` how each coefficient is made of
the readings, and `solve_closed_form` fits every output so. `closed_form_gain` is how parameters
follow the readings, and `closed_form_difference` how far they are from least squares.

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

from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.estimation.known import ZERO_NORM, solve_known
from multipos.estimation.problem import Solution
from multipos.numerics.arrays import COMPONENTS, Array, Places
from multipos.numerics.least_squares import solve
from multipos.positions.readings import Readings
from multipos.sensor.found import add_scatter
from multipos.sensor.model import Model, build_model

_TOLERANCE = 1e-9  # [g], the lower bound below which a component of the reference is zero


def six_positions(reference: Array) -> Places | None:
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
    reference: Array, rows: Places, own: int, *, quadratic: bool = True
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


def solve_closed_form(
    model: Model, reference: Array, readings: Readings, *, pool: bool = False
) -> Solution:
    """Fit every output by the six-position inversion.

    The noise is estimated as in `solve_known`; unequal stated noise leaves the inversion unbiased
    but not best, so its covariance is its own: W V W', with W its weights.
    """
    if model.text not in ("own-quadratic", "linear") or set(model.inputs) != set(COMPONENTS):
        raise UsageError(
            f"--closed-form solves the models own-quadratic and linear, got '{model.text}'; "
            "leave out --closed-form."
        )
    n, m = readings.values.shape
    weights = closed_form_gain(model, reference)
    solution = solve_known(model, reference, readings, pool=pool)
    parameters = weights @ readings.values.ravel()
    noise = add_scatter(readings.noise, solution.variance_components, model.outputs)
    noise = np.ones(n * m) if noise is None else noise
    full = np.diag(noise) if noise.ndim == 1 else noise
    return replace(
        solution,
        parameters=parameters,
        covariance=weights @ full @ weights.T * np.outer(solution.inflation, solution.inflation),
        residuals=readings.values - model.predict(parameters, reference, readings.environment),
    )


def closed_form_gain(model: Model, reference: Array) -> Array:
    """Return how the six-position inversion makes the parameters of the readings.

    Parameters
    ----------
    model : Model
        Own-quadratic or linear.
    reference : (6, 3) array [g]
        The six positions in any order.

    Returns
    -------
    (p, 6 M) array
        Parameters = this matrix times the readings, output running fastest.
    """
    rows = _require_six(reference)
    m = len(model.outputs)
    weights = np.zeros((len(model.keys), len(reference) * m))
    for output, (axis, part) in enumerate(zip(model.axes, model.slices, strict=True)):
        weights[part, output::m] = closed_form_weights(
            reference, rows, COMPONENTS.index(axis), quadratic=model.text == "own-quadratic"
        )
    return weights


def _require_six(reference: Array) -> Places:
    rows = six_positions(reference)
    if rows is None:
        raise MultiposError(
            "--closed-form needs six readings, each axis once up and once down; "
            "leave it out and least squares takes any positions."
        )
    return rows


def closed_form_difference(model: Model, reference: Array, readings: Readings) -> float | None:
    """Return how far the closed form is from own-quadratic least squares, at six positions.

    The fifteen coefficients of the six-position paper, whatever the model; the largest
    difference, as a reading, relative to the largest reading. None at other positions.
    """
    rows = six_positions(reference)
    largest = float(np.abs(readings.values).max())
    if rows is None or largest == 0.0:
        return None
    g = float(np.abs(reference).max())
    full = build_model("own-quadratic", readings.outputs, model.axes)
    phi = full.basis(reference, {})
    difference = 0.0
    for output, axis in enumerate(model.axes):
        values = readings.values[:, output]
        fitted = solve(phi[:, full.columns[output]], values, least_norm=ZERO_NORM).coefficients
        direct = closed_form_weights(reference, rows, COMPONENTS.index(axis)) @ values
        difference = max(difference, *np.abs((direct - fitted) * [1.0, g, g, g, g * g]))
    return difference / largest

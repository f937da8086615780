"""The six-position inversion as an estimator, and how far it is from least squares.

References
----------
Song and Qin 2009.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.estimation.closed_form import closed_form_weights, six_positions
from multipos.estimation.known import FLOOR, solve_known
from multipos.estimation.solution import Solution
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import solve
from multipos.numerics.terms import COMPONENTS
from multipos.positions.readings import Readings
from multipos.sensor.found import add_scatter
from multipos.sensor.model import Model
from multipos.sensor.stating import build_model


def solve_closed_form(
    model: Model, reference: Array, readings: Readings, *, pool: bool = False
) -> Solution:
    """Fit every output by the six-position inversion (`multipos.estimation.closed_form`).

    The noise is judged as in `solve_known`; unequal stated noise leaves the inversion unbiased
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


def _require_six(reference: Array) -> NDArray[np.intp]:
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
        fitted = solve(phi[:, full.columns[output]], values, floor=FLOOR).coefficients
        direct = closed_form_weights(reference, rows, COMPONENTS.index(axis)) @ values
        difference = max(difference, *np.abs((direct - fitted) * [1.0, g, g, g, g * g]))
    return difference / largest

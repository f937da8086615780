"""How the parameters of a calibration depend on its readings, and the problem that it solved.

Where orientations are known, with the design X and the covariance V of the readings,

    G = d(parameters)/d(readings) = (X'V⁻¹X)⁻¹ X'V⁻¹.                                       (1)

Near its solution the estimate of `multipos.estimation.likelihood` is linear in the readings. With A
and W as there, and S the reduced information,

    G = the rows of S⁻¹ A'W that belong to parameters,                                      (2)

orientations and shared unknowns following. Budgets of uncertainty are made of it. The local gravity
g is the first of them: it scales the reference f of every row that is at rest in it, and readings
y = h(f; p) then follow with J = dh/df, so that

    dp/dg = G J f/g  over those rows,                                                       (3)

which is d p/g, d the degree of the term in force, where all rows are such.

Tests of terms, gains and Monte Carlo need the likelihood after the fit. A calibration carries all
of its problem: readings, what was known of the positions, and a noise that is either stated with
the readings or the residual standard deviation. Where the residuals of a robust fit reject a stated
noise, everything is in units of F/ν instead of one.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.estimation.closed_form import closed_form_gain
from multipos.estimation.descent import maximise
from multipos.estimation.fisher_information import FisherInformation, information_at
from multipos.estimation.likelihood import evaluate, linearise, respond
from multipos.estimation.problem import (
    Optimum,
    Problem,
    State,
    pose,
    precision_of,
    standing,
    start_state,
)
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions, rotation_matrix
from multipos.positions.orientations import place
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.found import Estimator, VarianceComponents
from multipos.sensor.gravity import signed_size
from multipos.sensor.inverse import parameter_jacobian


def restate(calibration: Calibration) -> Problem:
    """Return the problem of a calibration; a robust loss only as the positions it set aside."""
    c = calibration
    size = signed_size(c.gravity, c.convention)
    level_sd_deg = (c.orientations and c.orientations.level_sd_deg) or 0.0
    stated_up = place(c.readings, size, level_sd=float(np.radians(level_sd_deg)))
    shape = c.readings.values.shape
    if c.noise is None:
        precision = np.broadcast_to(1.0 / c.residual_sd**2, shape)
    else:
        precision = precision_of(c.noise, *shape)
    problem = pose(c.model, c.readings, stated_up, precision)
    if c.robust_weight is not None:
        from multipos.estimation.robustness import set_aside

        problem = set_aside(problem, c.robust_weight == 0.0)
    return problem


def return_to_optimum(calibration: Calibration, problem: Problem) -> Optimum:
    """Return the optimum of a restated problem, searched from where the calibration ended."""
    c = calibration
    direction = directions(c.reference)
    found = (c.orientations and c.orientations.group_rotation_deg) or {}
    turns = [rotation_matrix(np.radians(vector)) for vector in found.values()]
    state = start_state(problem, c.parameters.copy(), direction, np.array(turns).reshape(-1, 3, 3))
    return maximise(problem, state)


def noise_factor(calibration: Calibration, problem: Problem, optimum: Optimum) -> float:
    """Return what F is to be divided by: F/nu where a stated noise was rejected, else one."""
    if np.isinf(calibration.dof[0]) or calibration.variance_components:
        return 1.0
    nu = float(problem.degrees.sum()) - problem.unknowns
    return optimum.point.objective / nu


def estimated_variances(calibration: Calibration) -> NDArray[np.bool_]:
    """Return whether reading noise and orientation sd were estimated by restricted likelihood."""
    found = calibration.variance_components or VarianceComponents()
    return np.array([found.reading_sd is not None, found.orientation_sd_deg is not None])


def estimator_gain(calibration: Calibration) -> Array:
    """Return how the parameters follow the readings, G of eq. (1).

    Returns
    -------
    (p, n M) array
        Output running fastest.
    """
    c = calibration
    if c.estimator is Estimator.CLOSED_FORM:
        return closed_form_gain(c.model, c.reference)
    if not c.estimator.exact:
        return uncertain_gain(c)
    n, m = c.readings.values.shape
    design = parameter_jacobian(c.model, c.parameters, c.reference, c.readings.environment).reshape(
        n * m, -1
    )
    noise = c.noise
    if noise is not None and noise.ndim == 2:
        whitener = np.linalg.inv(np.linalg.cholesky(noise))
        Q, R = np.linalg.qr(whitener @ design)
        return _solved(R, Q.T @ whitener)
    sd = np.ones(n * m) if noise is None else np.sqrt(noise)
    if isinstance(c.model, ExpressionModel) and (c.model.shared or c.model.beliefs.any()):
        return _tied_gain(c, design, np.tile(c.residual_sd, n) if noise is None else sd)
    result = np.zeros((design.shape[1], n * m))
    for output, part in enumerate(c.model.slices):  # block by block: the outputs are independent
        Q, R = np.linalg.qr(design[output::m, part] / sd[output::m, None])
        result[part, output::m] = _solved(R, Q.T) / sd[output::m]
    return result


def _solved(matrix: Array, right: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:  # a file may say what no fit has found
        raise MultiposError(
            "the positions of this calibration do not determine its parameters, so that nothing "
            "follows from its readings; fit again."
        ) from None


def _tied_gain(c: Calibration, design: Array, sd: Array) -> Array:
    """Return G of eq. (1) where priors or shared parameters tie the outputs."""
    weighted = design / sd[:, None] ** 2
    information = weighted.T @ design + np.diag(c.model.beliefs)
    return _solved(information, weighted.T)


def gravity_effect(calibration: Calibration) -> Array:
    """Return dp/dg (p,) per m/s² of the local gravity, eq. (3); not at all of known forces."""
    c = calibration
    assert c.gravity is not None
    forced = c.readings.forced
    if not forced.any() and not isinstance(c.model, ExpressionModel):  # whatever the residuals
        return np.asarray(c.model.force_degrees * c.parameters / c.gravity.value)
    at_rest = np.where(forced[:, None], 0.0, c.reference)
    slopes = c.model.force_jacobian(c.parameters, c.reference, c.readings.environment)
    moved = np.einsum("nmi,ni->nm", slopes, at_rest) / c.gravity.value
    return np.asarray(estimator_gain(c) @ moved.ravel())


def uncertain_gain(calibration: Calibration) -> Array:
    """Return how parameters follow readings, d(parameters)/d(readings), (p, n M).

    Of an uncertain or unknown orientation, near its solution: with A and W of
    `multipos.estimation.likelihood`, S^-1 A'W, orientations and shared unknowns moving along.
    Outputs run fastest. Of a robust loss only the positions that it set aside are kept: their
    weight is nothing.
    """
    readings, reference = calibration.readings, calibration.reference
    n, m = readings.values.shape
    problem, state = about_solution(calibration)
    normal = linearise(problem, state, evaluate(problem, state))
    p = len(calibration.parameters)
    slopes = parameter_jacobian(calibration.model, state.theta, reference, readings.environment)
    everything = np.concatenate([slopes, normal.shared], axis=2)
    weighted = normal.marginal @ everything  # (n, M, p + shared)
    return respond(normal.information, weighted.reshape(n * m, -1).T)[:p]


def about_solution(calibration: Calibration) -> tuple[Problem, State]:
    """Return the problem of a calibration about its solution, and the state there.

    Its reference is the listed one, already turned and stepped.
    """
    reference = calibration.reference
    problem = replace(restate(calibration), reference=reference)
    state = start_state(problem, calibration.parameters)
    return problem, standing(problem, state, state.centre)


def information_at_solution(calibration: Calibration) -> tuple[Problem, FisherInformation]:
    """Return the problem of a calibration about its solution, and the Fisher information there."""
    problem, state = about_solution(calibration)
    return problem, information_at(problem, state)

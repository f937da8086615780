"""How the parameters of a calibration depend on its readings, and the problem that it solved.

`estimator_gain` is G of eqs. (1) and (2), `uncertain_gain` that of uncertain orientations and
`gravity_effect` eq. (3). `restate` returns the problem of a calibration, `return_to_optimum` its
optimum, and `about_solution` both; `information_at_solution` returns the Fisher information there.

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

**The problem.** Tests of terms, gains and Monte Carlo need the likelihood after the fit. A
calibration carries all of its problem: readings, what was known of the positions, and a noise that
is either stated with the readings or the residual standard deviation. Where the residuals of a
robust fit reject a stated noise, everything is in units of F/ν instead of one.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.closed_form import closed_form_gain
from multipos.estimation.descent import maximise
from multipos.estimation.information import FisherInformation
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
from multipos.estimation.robustness import set_aside
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import directions, rotation_matrix
from multipos.positions.orientations import place
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import signed_size
from multipos.sensor.inverse import parameter_jacobian

# `information_at_solution` of a calibration, where several ask for it
AtSolution = Callable[[], tuple[Problem, FisherInformation]]


def _usable_sd(calibration: Calibration) -> Array:
    """Return residual sd (M,), 1 where no residual is left: the optimum is the same anyhow."""
    sd = calibration.residual_sd
    return np.where(sd > 0.0, sd, 1.0)


def restate(calibration: Calibration) -> Problem:
    """Return the problem of a calibration; a robust loss only as the positions it set aside."""
    c = calibration
    size = signed_size(c.gravity, c.convention)
    level_sd_deg = (c.orientations and c.orientations.level_sd_deg) or 0.0
    stated_up = place(c.readings, size, level_sd=float(np.radians(level_sd_deg)))
    shape = c.readings.values.shape
    if c.noise is None:
        precision = np.broadcast_to(1.0 / _usable_sd(c) ** 2, shape)
    else:
        precision = precision_of(c.noise, *shape)
    problem = pose(c.model, c.readings, stated_up, precision)
    if c.robust_weight is not None:
        problem = set_aside(problem, c.robust_weight == 0.0)
    return problem


def return_to_optimum(calibration: Calibration, problem: Problem) -> Optimum:
    """Return the optimum of a restated problem, searched from where the calibration ended."""
    c = calibration
    state = start_state(problem, c.parameters.copy(), directions(c.reference), _turns(c))
    return maximise(problem, state)


def _turns(calibration: Calibration) -> Array:
    """Return the rotations (G, 3, 3) of groups as found."""
    orientations = calibration.orientations
    found = (orientations and orientations.group_rotation_deg) or {}
    turns = [rotation_matrix(np.radians(vector)) for vector in found.values()]
    return np.array(turns).reshape(-1, 3, 3)


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
    if c.model.ties_outputs:
        # priors or shared parameters tie the outputs
        if noise is None:
            sd = np.tile(_usable_sd(c), n)
        weighted = design / sd[:, None] ** 2
        return _solved(weighted.T @ design + np.diag(c.model.beliefs), weighted.T)
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


def gravity_effect(calibration: Calibration) -> Array:
    """Return dp/dg (p,) per m/s² of the local gravity, eq. (3); not at all of known forces."""
    c = calibration
    assert c.gravity is not None
    forced = c.readings.forced
    if not forced.any() and c.model.has_terms:  # whatever the residuals
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
    if problem.groups and problem.attitude is not None:
        member, attitude = problem.group >= 0, problem.attitude.copy()
        attitude[member] = _turns(calibration)[problem.group[member]] @ attitude[member]
        problem = replace(problem, attitude=attitude)
    state = start_state(problem, calibration.parameters)
    return problem, standing(problem, state, directions(reference))


def information_at_solution(calibration: Calibration) -> tuple[Problem, FisherInformation]:
    """Return the problem of a calibration about its solution, and the Fisher information there."""
    problem, state = about_solution(calibration)
    return problem, FisherInformation(problem, state)

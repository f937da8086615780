"""The problem that a finished calibration solved, stated again with the noise that it found.

Profiles, tests of terms, gains and Monte Carlo ask of the likelihood of
`multipos.estimation.likelihood` what the fit did not. A calibration carries all of it: readings,
what was known of the positions, and a noise that is either stated with the readings or the residual
standard deviation. Where the residuals of a robust fit deny a stated noise, everything counts in
units of F/nu instead of one.
"""

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.descent import maximise
from multipos.estimation.problem import Optimum, Problem, pose, precision_of, start_state
from multipos.estimation.robustness import set_aside
from multipos.numerics.rotations import directions, rotation_matrix
from multipos.positions.placement import place
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import VarianceComponents
from multipos.sensor.gravity import signed_size


def restate(calibration: Calibration) -> Problem:
    """Return the problem of a calibration; a robust loss only as the positions it set aside."""
    c = calibration
    size = signed_size(c.gravity, c.convention)
    level_sd_deg = (c.orientations and c.orientations.level_sd_deg) or 0.0
    placement = place(c.readings, size, level_sd=float(np.radians(level_sd_deg)))
    shape = c.readings.values.shape
    if c.noise is None:
        precision = np.broadcast_to(1.0 / c.residual_sd**2, shape)
    else:
        precision = precision_of(c.noise, *shape)
    problem = pose(c.model, c.readings, placement, precision)
    if c.robust_weight is not None:
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
    """Return what F is to be divided by: F/nu where a stated noise was denied, else one."""
    if np.isinf(calibration.dof[0]) or calibration.variance_components:
        return 1.0
    nu = float(problem.degrees.sum()) - problem.unknowns
    return optimum.point.objective / nu


def estimated_variances(calibration: Calibration) -> NDArray[np.bool_]:
    """Tell whether reading noise and orientation sd were estimated by restricted likelihood."""
    found = calibration.variance_components or VarianceComponents()
    return np.array([found.reading_sd is not None, found.orientation_sd_deg is not None])

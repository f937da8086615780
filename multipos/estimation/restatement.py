"""The problem that a finished calibration solved, stated again with the noise that it found.

Profiles, tests of terms, gains and Monte Carlo ask of the likelihood of
`multipos.estimation.likelihood` what the fit did not. A calibration carries all of it: readings,
what was known of the positions, and a noise that is either stated with the readings or the residual
standard deviation. Where a stated noise was denied by the residuals, everything counts in units of
F/nu instead of one.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.descent import maximise
from multipos.estimation.placement import place, state_problem
from multipos.estimation.problem import Optimum, Problem, start_state
from multipos.estimation.robustness import set_aside
from multipos.numerics.rotations import rotation_matrix
from multipos.sensor.calibration import Calibration


def restate(calibration: Calibration) -> Problem:
    """Return the problem of a calibration; a robust loss only as the positions it set aside."""
    c = calibration
    sign = c.sign
    size = sign * float(np.linalg.norm(c.reference, axis=1).mean())
    placement = place(c.readings, size, None, float(c.extra.get("level_sd_deg", 0.0)))
    problem = state_problem(c.model, c.readings, placement, None)
    if c.readings.noise is None:
        sd = np.tile(c.residual_sd, (len(c.readings), 1))
        problem = replace(problem, precision=1.0 / sd**2)
    if "robust_weight" in c.extra:
        problem = set_aside(problem, np.asarray(c.extra["robust_weight"]) == 0.0)
    return problem


def return_to_optimum(calibration: Calibration, problem: Problem) -> Optimum:
    """Return the optimum of a restated problem, searched from where the calibration ended."""
    c = calibration
    direction = c.reference / np.linalg.norm(c.reference, axis=1)[:, None]
    found = dict(c.extra.get("group_rotation_deg", {}))
    turns = [rotation_matrix(np.radians(vector)) for vector in found.values()]
    state = start_state(problem, c.parameters.copy(), direction, np.array(turns).reshape(-1, 3, 3))
    return maximise(problem, state)


def noise_factor(calibration: Calibration, problem: Problem, optimum: Optimum) -> float:
    """Return what F is to be divided by: F/nu where a stated noise was denied, else one."""
    if np.isinf(calibration.dof[0]) or "variance_components" in calibration.extra:
        return 1.0
    nu = float(problem.degrees.sum()) - problem.unknowns
    return optimum.point.objective / nu


def estimated_variances(calibration: Calibration) -> NDArray[np.bool_]:
    """Tell whether reading noise and orientation sd were estimated by restricted likelihood."""
    found = calibration.extra.get("variance_components", {})
    return np.array(["reading_sd" in found, "orientation_sd_deg" in found])

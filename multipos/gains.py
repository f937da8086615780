"""How the parameters of an uncertain or unknown orientation follow the readings.

Near its solution the estimate of `multipos.likelihood` is linear in the readings. With A and W
as there, and S the reduced information,

    d(parameters)/d(readings) = the rows of S^-1 A'W that belong to parameters,             (1)

orientations and shared unknowns moving along. Budgets of uncertainty are made of it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from multipos.calibration import Calibration
from multipos.inverse import parameter_jacobian
from multipos.known import reading_noise
from multipos.likelihood import evaluate, linearise
from multipos.placement import place, state_problem
from multipos.problem import start_state
from multipos.robustness import set_aside

Array = NDArray[np.float64]


def uncertain_gain(calibration: Calibration) -> Array:
    """Return how parameters follow readings, d(parameters)/d(readings), (p, n M).

    Of an uncertain or unknown orientation, near its solution: with A and W of
    `multipos.likelihood`, S^-1 A'W, orientations and shared unknowns moving along. Outputs run
    fastest. Of a robust loss only the positions that it set aside are kept: they tell nothing.
    """
    readings, reference = calibration.readings, calibration.reference
    n, m = readings.values.shape
    size = np.linalg.norm(reference, axis=1)
    sign = -1.0 if calibration.convention == "gravity" else 1.0
    level = float(calibration.extra.get("level_sd_deg", 0.0))
    placement = place(readings, sign * float(size.mean()), None, level)
    problem = state_problem(calibration.model, readings, placement, None)
    if reading_noise(readings) is None:
        problem = replace(problem, precision=np.tile(1.0 / calibration.residual_sd**2, (n, 1)))
    if "robust_weight" in calibration.extra:
        problem = set_aside(problem, np.asarray(calibration.extra["robust_weight"]) == 0.0)
    turns = np.tile(np.eye(3), (problem.groups, 1, 1))
    # About the solution itself: its reference is the listed one, already turned and stepped.
    problem = replace(problem, reference=reference)
    state = start_state(problem, calibration.parameters, reference / size[:, None], turns)
    normal = linearise(problem, state, evaluate(problem, state))
    p = len(calibration.parameters)
    slopes = parameter_jacobian(calibration.model, state.theta, reference, readings.environment)
    everything = np.concatenate([slopes, normal.shared], axis=2)
    weighted = normal.marginal @ everything  # (n, M, p + shared)
    solved = np.linalg.solve(normal.information, weighted.reshape(n * m, -1).T)
    return np.asarray(solved[:p])

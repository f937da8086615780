"""How the parameters of an uncertain or unknown orientation follow the readings.

Near its solution the estimate of `multipos.estimation.likelihood` is linear in the readings. With A
and W as there, and S the reduced information,

    d(parameters)/d(readings) = the rows of S^-1 A'W that belong to parameters,             (1)

orientations and shared unknowns moving along. Budgets of uncertainty are made of it.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.problem import start_state
from multipos.estimation.restatement import restate
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian


def uncertain_gain(calibration: Calibration) -> Array:
    """Return how parameters follow readings, d(parameters)/d(readings), (p, n M).

    Of an uncertain or unknown orientation, near its solution: with A and W of
    `multipos.estimation.likelihood`, S^-1 A'W, orientations and shared unknowns moving along.
    Outputs run fastest. Of a robust loss only the positions that it set aside are kept: they tell
    nothing.
    """
    readings, reference = calibration.readings, calibration.reference
    n, m = readings.values.shape
    # About the solution itself: its reference is the listed one, already turned and stepped.
    problem = replace(restate(calibration), reference=reference)
    direction = reference / np.linalg.norm(reference, axis=1)[:, None]
    state = start_state(problem, calibration.parameters, direction)
    normal = linearise(problem, state, evaluate(problem, state))
    p = len(calibration.parameters)
    slopes = parameter_jacobian(calibration.model, state.theta, reference, readings.environment)
    everything = np.concatenate([slopes, normal.shared], axis=2)
    weighted = normal.marginal @ everything  # (n, M, p + shared)
    solved = np.linalg.solve(normal.information, weighted.reshape(n * m, -1).T)
    return np.asarray(solved[:p])

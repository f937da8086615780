"""Known orientations and a model of one's own: searched for, then worth what its tangent is.

Where nothing ties the outputs and no noise is stated, all are searched for together; weights of the
outputs change none of them. About the end p, A = dh/dp, the readings are those of a linear model,

    y − h(p) + A p = A p' + e,                                                              (1)

whose least squares are at p' = p: covariance, degrees of freedom, leverage and what cannot be
separated are those of `multipos.estimation.known`. A model that is linear in its parameters
is (1) everywhere, and needs no search.
"""

from dataclasses import replace

import numpy as np

from multipos.errors import ConvergenceError
from multipos.estimation.descent import maximise, resume
from multipos.estimation.guesses import first_guesses
from multipos.estimation.known import solve_known
from multipos.estimation.problem import Optimum, Problem, start_state
from multipos.estimation.solution import Solution
from multipos.numerics.arrays import Array
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Status
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Model

_ALIKE = 5.0  # of ln: residuals so much apart leave each output its digits in one search
_LEAST = 1e-14  # of an output's spread, below which no residual is known


def is_apart(model: Model, readings: Readings) -> bool:
    """Tell whether the outputs of a model of one's own can be fitted as `solve_own_known` does."""
    if not isinstance(model, ExpressionModel):
        return False
    return model.all_linear or (model.apart and readings.noise is None)


def solve_own_known(
    model: ExpressionModel,
    reference: Array,
    readings: Readings,
    *,
    pool: bool = False,
    claimed: bool = True,
) -> Solution:
    """Fit a model of one's own at known orientations, by (1); options as in `solve_known`.

    Raises
    ------
    RankError
        The positions cannot separate the parameters, which are named.
    ConvergenceError
        No start led to a minimum.
    """
    theta, status = np.zeros(len(model.keys)), None
    if not model.all_linear:
        best = _searched(model, reference, readings)
        theta = best.state.theta
        status = Status(
            best.converged,
            best.iterations,
            f"converged in {best.iterations} iterations",
            best.last_step,
            best.gradient,
        )
    outputs, blocks = model.respond(theta, reference, readings.environment)
    values = readings.values - outputs
    for output, (places, slopes) in enumerate(blocks):
        values[:, output] += slopes @ theta[places]
    design = np.concatenate([slopes.T for _, slopes in blocks]).T
    linear = replace(readings, values=values)
    solution = solve_known(model, reference, linear, pool=pool, claimed=claimed, phi=design)
    return solution if status is None else replace(solution, status=status)


def _searched(model: ExpressionModel, reference: Array, readings: Readings) -> Optimum:
    """Return the best optimum over the starts, each output weighed by its own residuals."""
    values, n = readings.values, len(readings)
    spread = np.maximum(np.ptp(values, axis=0), np.abs(values).max(axis=0) * _LEAST + 1e-300)
    problem = Problem(
        model=model,
        values=values,
        environment=readings.environment,
        precision=np.tile(spread**-2.0, (n, 1)),
        reference=reference,
        orientation_sd=np.zeros(n),
        group=np.full(n, -1),
        weight=np.ones(n),
    )
    guesses = first_guesses(model, values, reference, readings.environment)
    found = [maximise(problem, start_state(problem, theta)) for theta in guesses]
    best = min(found, key=lambda one: (not one.converged, one.point.objective))
    if not best.converged:
        raise ConvergenceError(
            f"no convergence after {best.iterations} iterations; the last step moved the "
            f"parameters by {best.last_step:.1e} of their size. State a start for them in "
            "[parameters] of a TOML file, check the readings for blunders (--robust huber names "
            "them), or choose a model with fewer parameters."
        )
    left = np.sqrt(np.mean(best.point.residuals**2, axis=0))
    if np.ptp(np.log(np.maximum(left / spread, _LEAST))) < _ALIKE:
        return best
    weighed = replace(problem, precision=np.tile(np.maximum(left, _LEAST * spread) ** -2.0, (n, 1)))
    return resume(weighed, best)

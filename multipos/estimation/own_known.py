"""Known orientations and a model of one's own: searched for, then worth what its tangent is.

Where nothing ties the outputs all are searched for together; weights of whole outputs change none
of them. About the end p, A = dh/dp, the readings are those of a linear model,

    y − h(p) + A p = A p' + e,                                                              (1)

whose least squares are at p' = p: covariance, degrees of freedom, leverage and what cannot be
separated are those of `multipos.estimation.known`. A model that is linear in its parameters
is (1) everywhere, and needs no search. To second order the estimate is off by

    E p − p = −½ C Σ_k a_k tr(C ∂²h_k/∂p²)/s²,    C its covariance, a_k = ∂h_k/∂p,            (2)

the mean of what noise adds to h by its bend, as least squares take it for parameters; that is
stated where it is more than a tenth of u.
"""

from collections.abc import Mapping
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
from multipos.sensor.model import Block, Model

_ROUNDS = 8  # of scatter and solution in turn
_SETTLED = 1e-4  # of u
_MANY = 200  # readings from which on (2) is not looked at
_STATED = 0.1  # of u
_ALIKE = 5.0  # of ln: residuals so much apart leave each output its digits in one search
_LEAST = 1e-14  # of an output's spread, below which no residual is known


def is_apart(model: Model, readings: Readings) -> bool:
    """Tell whether the outputs of a model of one's own can be fitted as `solve_own_known` does."""
    if not isinstance(model, ExpressionModel):
        return False
    noise = readings.noise
    return model.all_linear or (model.apart and (noise is None or noise.ndim == 1))


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
    how = {"pool": pool, "claimed": claimed}
    if model.all_linear:
        start = np.zeros(len(model.keys))
        outputs, blocks = model.respond(start, reference, readings.environment)
        return _tangent(model, start, readings.values - outputs, blocks, reference, readings, how)
    problem, best = _searched(model, reference, readings)
    solution = _about(model, best, reference, readings, how)
    noise = readings.noise
    if noise is not None and np.ptp(noise.reshape(readings.values.shape), axis=0).any():
        for _ in range(_ROUNDS):  # what readings scatter beside the stated noise changes weights
            before = best.state.theta
            variance = noise.reshape(readings.values.shape) + _scatter(solution)
            best = resume(replace(problem, precision=1.0 / variance), best)
            solution = _about(model, best, reference, readings, how)
            moved = np.abs(best.state.theta - before)
            if (moved <= _SETTLED * np.sqrt(np.diag(solution.covariance))).all():
                break
    status = Status(
        best.converged,
        best.iterations,
        f"converged in {best.iterations} iterations",
        best.last_step,
        best.gradient,
    )
    said = _bends(model, best, reference, readings, solution)
    return replace(solution, status=status, warnings=(*solution.warnings, *said))


def _scatter(solution: Solution) -> Array:
    """Return the variance (M,) that was found beside the stated noise."""
    found = solution.variance_components
    if found is None or found.rest_to_rest is None:
        return np.zeros(len(solution.model.outputs))
    return np.array([found.rest_to_rest[o].value ** 2 for o in solution.model.outputs])


def _about(
    model: ExpressionModel,
    best: Optimum,
    reference: Array,
    readings: Readings,
    how: Mapping[str, bool],
) -> Solution:
    """Return the least squares of the model (1) about where the search ended."""
    theta, point = best.state.theta, best.point
    return _tangent(model, theta, point.residuals, point.blocks, reference, readings, how)


def _tangent(
    model: ExpressionModel,
    theta: Array,
    residuals: Array,
    blocks: tuple[Block, ...],
    reference: Array,
    readings: Readings,
    how: Mapping[str, bool],
) -> Solution:
    """Return the least squares of the model (1) about parameters."""
    reached = [slopes @ theta[places] for places, slopes in blocks]
    design = np.concatenate([slopes.T for _, slopes in blocks]).T
    tangent = design, residuals + np.array(reached).T
    return solve_known(model, reference, readings, tangent=tangent, **how)


def _bends(
    model: ExpressionModel, best: Optimum, reference: Array, readings: Readings, solution: Solution
) -> tuple[str, ...]:
    """State the bias (2) of parameters where it matters; of many readings it is nothing beside u.

    It falls with their number, and u with the root of it.
    """
    sd = solution.residual_sd
    if len(readings) > _MANY or not (np.isfinite(sd) & (sd > 0.0)).all():
        return ()
    bend = model.second_derivatives(best.state.theta, reference, readings.environment)
    moved = np.tensordot(bend, solution.covariance) / sd**2
    right = np.zeros(len(solution.parameters))
    for output, (places, slopes) in enumerate(best.point.blocks):
        right[places] += moved[:, output] @ slopes
    bias = -0.5 * solution.covariance @ right
    u = np.sqrt(np.diag(solution.covariance))
    far = np.abs(bias) > _STATED * u
    return tuple(
        f"`{name}` is {'larger' if off > 0.0 else 'smaller'} by about {abs(off):.2g} than it "
        "should be, because the model bends within its uncertainty; average longer, or add "
        "positions"
        for name, off, stated in zip(model.names, bias.tolist(), far.tolist(), strict=True)
        if stated
    )


def _searched(
    model: ExpressionModel, reference: Array, readings: Readings
) -> tuple[Problem, Optimum]:
    """Return the problem and its best optimum over the starts."""
    values, n = readings.values, len(readings)
    noise = None if readings.noise is None else readings.noise.reshape(values.shape)
    spread = np.maximum(np.ptp(values, axis=0), np.abs(values).max(axis=0) * _LEAST + 1e-300)
    problem = Problem(
        model=model,
        values=values,
        environment=readings.environment,
        precision=np.tile(spread**-2.0, (n, 1)) if noise is None else 1.0 / noise,
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
    if noise is not None or np.ptp(np.log(np.maximum(left / spread, _LEAST))) < _ALIKE:
        return problem, best
    weighed = replace(problem, precision=np.tile(np.maximum(left, _LEAST * spread) ** -2.0, (n, 1)))
    return weighed, resume(weighed, best)

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

Where the search for the parameters of a model of one's own starts: no guess but what is stated.

Parameters enter linearly where no second derivative joins two of them. Given the others, q, they
are those of least squares,

    l(q) = argmin |y - h(q, 0) - A l|,    A = dh/dl at q,                                    (3)

and where q has no stated start it is tried at a few values, all together and one by one; what
leaves the least misfit after steps of Gauss and Newton on all that is not stated is where the
search starts. The first that explains the readings ends the trials. Priors are starts.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.errors import ConvergenceError, MultiposError
from multipos.estimation.descent import maximise, resume
from multipos.estimation.known import solve_known
from multipos.estimation.problem import Optimum, Problem, start_state
from multipos.estimation.solution import Solution
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.positions.readings import Readings
from multipos.positions.scheme import read_scheme
from multipos.sensor.calibration import Status
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.model import Block, Model

_TRIED = (0.0, 1.0, 0.1, 10.0)  # values of what has no start
_ALONE = 3  # parameters of an output up to which all their combinations are tried
_STEPS = 2  # on each, where one does not explain the readings
_KEPT = 3  # guesses that are worth a search
_EXPLAINED = 1e-3  # of the readings' variance: what is left of it where no other is needed
_RANK = 1e-9  # of the largest, a direction that least squares of a guess leaves alone


class _Weighed(NamedTuple):
    """Readings (n, M), their force and surroundings, and the weight (M,) of each output.

    Each output counts by its spread: what they share must not be that of the largest alone.
    """

    values: Array
    force: Array
    environment: Mapping[str, Array]
    weight: Array


def first_guesses(
    model: ExpressionModel,
    values: Array,
    force: Array,
    environment: Mapping[str, Array],
    *,
    keep: bool = False,
) -> list[Array]:
    """Return where searches start, the best first, (p,) each.

    Parameters
    ----------
    model : ExpressionModel
    values : (n, M) array
        Readings.
    force : (n, 3) array [g]
    environment : mapping of str to (n,) array
    keep : bool
        Leave every parameter that has a start there.

    Raises
    ------
    MultiposError
        The model has no value at any of them.
    """
    linear = model.compiled.linear
    stated = np.isfinite(model.starts)
    free = ~stated & ~linear
    sought = (linear & (model.beliefs == 0.0) & ~(stated & keep)) | free
    readings = _Weighed(
        values, force, environment, 1.0 / np.maximum(np.std(values, axis=0), 1e-300)
    )
    found: list[tuple[float, Array]] = []
    enough = _EXPLAINED * values.size
    with np.errstate(all="ignore"):
        for start in _trials(model, np.where(stated, model.starts, 0.0), free):
            theta, misfit = model.within(start), np.inf
            for _ in range(_STEPS):
                theta = _improved(model, theta, sought, readings)
                misfit = _misfit(model, theta, readings)
                if misfit <= enough:
                    break
            if not np.isfinite(misfit):  # the steps left where the model has values
                theta = model.within(start)
                misfit = _misfit(model, theta, readings)
            if np.isfinite(misfit):
                found.append((misfit, theta))
            if misfit <= enough:
                break
    if not found:
        names = [name for name, one in zip(model.names, free.tolist(), strict=True) if one]
        which = ", ".join(f"`{name}`" for name in names) or "its parameters"
        raise MultiposError(
            f"the model has no value at the start of the search; state a start for {which} in "
            "[parameters] of a TOML file."
        )
    found.sort(key=lambda each: each[0])
    sure = not free.any() or found[0][0] <= enough
    return [theta for _, theta in found[: 1 if sure else _KEPT]]


def nominal_parameters(model: ExpressionModel) -> Array:
    """Return the parameters at which positions are judged (p,), before any reading.

    Those that are stated, and with them what comes nearest to an output of one per g along its own
    axis, and nothing at zero.

    Raises
    ------
    MultiposError
        As `first_guesses`.
    """
    force = read_scheme("fibonacci-100").up
    own = force[:, [COMPONENTS.index(axis) for axis in model.axes]]
    return first_guesses(model, own, force, {}, keep=True)[0]


def _trials(model: ExpressionModel, start: Array, free: NDArray[np.bool_]) -> Iterator[Array]:
    """Yield starts whose free parameters have values to be tried, alike for all outputs."""
    names = list(dict.fromkeys(str(model.keys[i][1]) for i in np.flatnonzero(free)))
    if len(names) <= _ALONE:
        values = list(product(_TRIED, repeat=len(names)))
    else:
        values = [(value,) * len(names) for value in _TRIED]
    for tried in values:
        theta = start.copy()
        for name, value in zip(names, tried, strict=True):
            for i in np.flatnonzero(free).tolist():
                if str(model.keys[i][1]) == name:
                    theta[i] = value
        yield theta


def _improved(
    model: ExpressionModel,
    theta: Array,
    sought: NDArray[np.bool_],
    readings: _Weighed,
) -> Array:
    """Return parameters after a step of Gauss and Newton on those that are sought, eq. (3)."""
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    left = readings.values - outputs
    rows = []
    for output, (places, slopes) in enumerate(blocks):
        whole = np.concatenate([slopes.T, left[None, :, output]]).T
        if not np.isfinite(whole).all():
            return theta
        R = np.linalg.qr(whole, mode="r") * readings.weight[output]  # tells what all rows do
        rows.append(np.zeros((len(R), len(theta) + 1)))
        rows[-1][:, places], rows[-1][:, -1] = R[:, :-1], R[:, -1]
    reduced = np.concatenate(rows)
    A = reduced[:, :-1][:, sought]
    size = np.sqrt(np.einsum("np,np->p", A, A))
    scale = np.where(size > 0.0, size, 1.0)
    moved = theta.copy()
    moved[sought] += np.linalg.lstsq(A / scale, reduced[:, -1], rcond=_RANK)[0] / scale
    return model.within(moved)


def _misfit(model: ExpressionModel, theta: Array, readings: _Weighed) -> float:
    outputs, blocks = model.respond(theta, readings.force, readings.environment)
    if not all(np.isfinite(slopes).all() for _, slopes in blocks):
        return np.inf
    return float(np.sum(((readings.values - outputs) * readings.weight) ** 2))


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
    tested: bool = True,
) -> Solution:
    """Fit a model of one's own at known orientations, by (1); options as in `solve_known`.

    Raises
    ------
    RankError
        The positions cannot separate the parameters, which are named.
    ConvergenceError
        No start led to a minimum.
    """
    how = {"pool": pool, "tested": tested}
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

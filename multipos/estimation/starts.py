"""The start of a search where orientations are uncertain or unknown, and whether its end is valid.

`search` returns the best optimum over the starts that `ways` makes, of which `ellipsoid_start` and
`own_starts` are two. `require_information` and `reduced_information` return the information at the
end, and `too_few` is the error of too few positions.

No guess is asked for. Least squares at the listed directions, where they are enough, is one start;
the ellipsoid on which readings at rest lie (`multipos.estimation.unknown_orientations`), turned to
the listed directions where some are, is the other. It is tried where the first fails, or where
positions may be off by more than five degrees; the lower minimum of the two is taken. The
parameters of a user-defined model at either of these directions are those of
`multipos.estimation.user_models`.

The end of a search is refused, with positions that would help,

- where the information of the parameters has no inverse (`multipos.estimation.identifiability`);
- with all orientations unknown, where readings vary about their ellipsoid by a fifth of its size,
  or where noise alone could explain the information about a parameter: n readings of nothing but
  noise of variance σ² seem to have an information of up to 2 n/σ², from lever arms of length σ.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from multipos.errors import ConvergenceError, MultiposError, RankError
from multipos.estimation import descent, unknown_orientations
from multipos.estimation.identifiability import (
    CANDIDATES,
    UNSEEN,
    condition,
    helpful_positions,
    least_determined,
    plausible_range,
    position_words,
    require_separable,
)
from multipos.estimation.information import FisherInformation
from multipos.estimation.known import ZERO_NORM
from multipos.estimation.likelihood import evaluate, linearise
from multipos.estimation.problem import (
    Optimum,
    Problem,
    State,
    start_state,
    turn_about,
    turn_to_axes,
)
from multipos.numerics.arrays import COMPONENTS, Array, median
from multipos.numerics.least_squares import solve
from multipos.numerics.rotations import align, directions
from multipos.sensor.inverse import invert, parameter_jacobian

_FLAT = 2.5e-5  # squared thickness of the cloud of readings below which it is a disc


def ellipsoid_start(values: Array, magnitude: float, *, crossed: bool) -> tuple[Array, Array]:
    """Return bias (3,) and the lower-triangular matrix M (3, 3), in reading units.

    Parameters
    ----------
    values : (n, 3) array
        Readings, in any unit.
    magnitude : float [g]
    crossed : bool
        Whether M has cross terms; without them six coefficients are fitted instead of nine.

    Raises
    ------
    MultiposError
        The readings do not spread over three dimensions.
    """
    found = unknown_orientations.fit_ellipsoids(values.T[None], crossed=crossed)
    if (np.ptp(values, axis=0) == 0.0).any():
        raise MultiposError(
            "the readings of one output never change; turn the sensor so that every axis points "
            "up, down and level."
        )
    if not found.change[0] > 1e-9:
        raise MultiposError(
            "the readings of one output change by less than a part in 1e9 of what they are; turn "
            "the sensor so that every axis points up, down and level, or take a large offset off."
        )
    if found.thickness[0] < _FLAT:
        raise MultiposError(
            "all positions lie on one circle, so the readings are flat; add positions off it."
        )
    return found.bias[0], found.lower[0] / magnitude


_PARTS = 50  # that a robust start omits one by one


def ways(problem: Problem) -> list[Callable[[Problem], State | None]]:
    """Return the functions that make a start, the most reliable first."""
    if problem.model.has_terms:
        return [_listed_start, _ellipsoid_start]
    return [partial(_given, state) for state in own_starts(problem)]


def _given(state: State, problem: Problem) -> State:
    return state


def own_starts(problem: Problem) -> list[State]:
    """Return where the search for a user-defined model starts (`multipos.estimation.user_models`).

    At the listed directions, or at those that the ellipsoid of the readings gives.
    """
    from multipos.estimation.user_models import first_guesses

    model, rows = problem.model, problem.listed
    if rows.any():
        here = {name: column[rows] for name, column in problem.environment.items()}
        guesses = first_guesses(model, problem.values[rows], problem.reference[rows], here)
        return [_listed_state(problem, theta) for theta in guesses]
    seen = _on_ellipsoid(problem)
    force = seen.direction * problem.magnitude[:, None]
    guesses = first_guesses(model, problem.values, force, problem.environment)
    turns = _turns(problem, seen.direction)
    return [start_state(problem, theta, seen.direction, turns) for theta in guesses]


def _listed_start(problem: Problem) -> State | None:
    """Least squares at the listed directions, where there are enough of them."""
    model, rows = problem.model, problem.listed
    if not rows.any():
        return None
    values, reference = problem.values[rows], problem.reference[rows]
    environment = {name: column[rows] for name, column in problem.environment.items()}
    theta = np.zeros(len(model.keys))
    _, blocks = model.respond(theta, reference, environment)
    for output, (places, design) in enumerate(blocks):
        if not output or not np.array_equal(design, blocks[output - 1][1]):
            names = [model.names[i] for i in places]
            coefficients = solve(design, values, least_norm=ZERO_NORM, names=names).coefficients
        theta[places] = coefficients[:, output]
    return _listed_state(problem, theta)


def _listed_state(problem: Problem, theta: Array) -> State:
    """Return the state at given parameters, with unknown directions and rotations from readings."""
    if problem.listed.all():
        return start_state(problem, theta)
    direction = _directions_by_readings(problem, theta)
    return start_state(problem, theta, direction, _turns(problem, direction))


def _directions_by_readings(problem: Problem, theta: Array) -> Array:
    """Return the directions (n, 3) that readings show; along those listed where none senses."""
    model, force = problem.model, np.array(problem.reference)
    unseen = force if model.unseen_axes else None
    found = invert(model, theta, problem.values, problem.environment, unseen=unseen)
    force[:, model.sensed_axes] = found
    if model.unseen_axes:
        others = force[:, model.unseen_axes]
        length = np.linalg.norm(others, axis=1)[:, None]
        left = np.maximum(problem.magnitude[:, None] ** 2 - np.sum(found**2, axis=1)[:, None], 0.0)
        force[:, model.unseen_axes] = others * np.sqrt(left) / np.where(length > 0.0, length, 1.0)
    return directions(force)


def _turns(problem: Problem, direction: Array) -> Array:
    """Return the rotation of each group that brings its listed directions nearest to others.

    Of fewer outputs than axes the others are partly a guess: what is sensed determines it alone,
    where the listed directions of a group span space.
    """
    sensed, turns = list(problem.model.sensed_axes), []
    for g in range(problem.groups):
        rows = problem.group == g
        listed, wanted = directions(problem.reference[rows]), direction[rows]
        if problem.model.unseen_axes and np.linalg.matrix_rank(listed) == len(COMPONENTS):
            wanted, by_row = np.zeros((3, 3)), wanted[:, sensed]
            wanted[:, sensed] = np.linalg.lstsq(listed, by_row, rcond=None)[0]
            listed = np.eye(3)
        turns.append(align(listed, wanted))
    return np.array(turns).reshape(-1, 3, 3)


def _ellipsoid_start(problem: Problem) -> State | None:
    """The ellipsoid of the readings, turned to the listed directions where some are."""
    model = problem.model
    if sorted(model.axes) != ["x", "y", "z"]:
        return None
    seen = _on_ellipsoid(problem)
    theta = unknown_orientations.linear_parameters(model, seen.linear[None])[0]
    return start_state(problem, theta, seen.direction, _turns(problem, seen.direction))


class _Ellipsoid(NamedTuple):
    """The model on an ellipsoid: constant and linear terms (3, 4), and directions (n, 3)."""

    linear: Array
    direction: Array


def _on_ellipsoid(problem: Problem) -> _Ellipsoid:
    """Return the ellipsoid of a triad's readings, turned to the listed directions if any."""
    model = problem.model
    order = [model.axes.index(axis) for axis in ("x", "y", "z")]
    magnitude = float(problem.magnitude.mean())
    named = any(name.startswith("cross_") for name in model.names)
    crossed = named or not model.has_terms
    find = ellipsoid_start if problem.robust is None else _median_ellipsoid
    bias, matrix = find(problem.values[:, order], magnitude, crossed=crossed)
    if model.gauge == "symmetric":
        matrix = unknown_orientations.symmetric_root(matrix)
    force = np.linalg.solve(matrix, (problem.values[:, order] - bias).T).T
    direction = force / np.linalg.norm(force, axis=1)[:, None]
    turn = _hand(problem, direction)
    matrix, direction = matrix @ turn.T, direction @ turn.T
    free = problem.free_axis
    if free is not None:
        turn = turn_about(free, matrix)
        matrix, direction = matrix @ turn.T, direction @ turn.T
    linear = np.empty((3, 4))
    linear[order] = np.column_stack([bias, matrix])
    return _Ellipsoid(linear, direction)


def _hand(problem: Problem, direction: Array) -> Array:
    """Return the rotation or reflection that brings directions nearest to those listed.

    The ellipsoid leaves both open. A reflection is that of a left-handed triad, or of a
    convention which is not the readings' own; rows of a group determine it as well.
    """
    known = [problem.listed, *(problem.group == g for g in range(problem.groups))]

    def misfit(mirror: float) -> float:
        turned = (
            mirror * direction[rows] @ align(mirror * direction[rows], problem.reference[rows]).T
            - problem.reference[rows]
            for rows in known
            if rows.any()
        )
        return float(sum(np.sum(left**2) for left in turned))

    if problem.rolls is not None and not problem.groups:
        return turn_to_axes(problem.rolls, direction, problem.listed, problem.reference)
    mirror = -1.0 if misfit(-1.0) < misfit(1.0) else 1.0
    if problem.adrift:
        return mirror * np.eye(3)
    rows = problem.listed
    return mirror * align(mirror * direction[rows], problem.reference[rows])


def _median_ellipsoid(values: Array, magnitude: float, *, crossed: bool) -> tuple[Array, Array]:
    """Return the ellipsoid start, without one part of the readings, that most readings are near.

    Each part is omitted once, so that gross errors in one of them do not bend the start.
    """
    parts = min(len(values), _PARTS)
    best, least = ellipsoid_start(values, magnitude, crossed=crossed), np.inf
    for part in range(parts):
        rest = np.delete(values, np.s_[part::parts], axis=0)
        bias, matrix = ellipsoid_start(rest, magnitude, crossed=crossed)
        force = np.linalg.solve(matrix, (values - bias).T)
        misfit = float(median(np.abs(np.linalg.norm(force, axis=0) - magnitude)))
        if misfit < least:
            best, least = (bias, matrix), misfit
    return best


_LEVER = 2.0  # information per reading, in units of the noise, that noise alone can explain
_FEWEST = 4  # parameters that any rotation determines: a bias for each output, one scale
_MEDIAN = 0.6745  # of the modulus of a standard normal
_SPREAD = 0.2  # of one g: a cloud of noise, not a sphere of positions


def search(problem: Problem) -> tuple[Optimum, FisherInformation]:
    """Return the best optimum over the starts, and the Fisher information there.

    The second start is tried where the first may be poor.
    """
    best: tuple[State, Optimum] | None = None
    fault: MultiposError | None = None
    wide = bool((problem.orientation_sd[problem.listed] > descent.WIDE).any())
    for start in ways(problem):
        try:
            state = start(problem)
        except MultiposError as error:
            if problem.listed.all() and not wide:
                raise  # the listed directions are near enough to show what they cannot determine
            fault = fault or error
            continue
        if state is None:
            continue
        found = descent.maximise(problem, state)
        if problem.adrift:
            found = _positive(problem, found)
        if best is None or _is_better(found, best[1]):
            best = state, found
        # starts of a user-defined model may have several ends
        if best[1].converged and not wide and problem.model.has_terms:
            break
    if best is None:
        raise fault or MultiposError("no start could be found; give the orientations.")
    if not best[1].converged:
        raise fault or _why_not(problem, *best)
    _require_sphere(problem, best[1])
    fisher = require_information(problem, best[1])
    if np.isinf(problem.orientation_sd).all():  # where lever arms come from the readings themselves
        _require_above_noise(problem, *best)
    return best[1], fisher


def _is_better(found: Optimum, best: Optimum) -> bool:
    """Return whether an optimum has converged where the best has not, or fits better."""
    return (found.converged, -found.point.objective) > (best.converged, -best.point.objective)


def _why_not(problem: Problem, start: State, optimum: Optimum) -> MultiposError:
    """Return the error of a search that did not converge, with what positions do not determine."""
    try:
        _require_sphere(problem, optimum)
        require_information(problem, optimum)
        _require_above_noise(problem, start, optimum)
    except MultiposError as error:
        return error
    blunders = "Check the readings for blunders (--robust huber names them), or choose"
    way_out = blunders if problem.robust is None else "Fit without --robust, or choose"
    return ConvergenceError(
        f"no convergence after {optimum.iterations} iterations; the last step moved the "
        f"parameters by {optimum.last_step:.1e} of their size. {way_out} a model with fewer terms."
    )


def _require_above_noise(problem: Problem, start: State, optimum: Optimum) -> None:
    """Refuse combinations of parameters that noise alone could explain, by their plausible range.

    A search drifts along what the data do not determine, so its start is tested.
    """
    model, size = problem.model, float(problem.magnitude.mean())
    limit = plausible_range(model, start.theta, size)
    if limit is None or not optimum.point.objective > 0.0:  # as many parameters as positions
        return
    fisher = FisherInformation(problem.plain, start)
    information = reduced_information(fisher.information, len(limit))
    nu = max(float(problem.degrees.sum()) - problem.unknowns, 1.0)
    relative = information * np.outer(limit, limit) * nu / optimum.point.objective
    # Noise moves n positions by its own size, which seems an information of n and little more.
    rank = int((np.linalg.eigvalsh(relative) > _LEVER * len(problem.values)).sum())
    if rank == len(limit):
        return
    if rank < _FEWEST:
        raise MultiposError(
            "the readings differ by little more than their noise. Turn the sensor to different "
            "positions and hold it still."
        )
    missing = [model.names[i] for i in sorted(least_determined(relative, rank))]
    best = CANDIDATES[
        helpful_positions(information, _candidate_gains(problem, start.theta), len(missing))
    ]
    raise RankError(
        f"{rank} of {len(limit)} parameters can be separated from the noise: "
        f"{', '.join(f'`{name}`' for name in missing)} out of reach; add positions such as "
        f"{position_words(best)}, or drop those terms.",
        rank=rank,
        parameters=len(limit),
    )


def _require_sphere(problem: Problem, optimum: Optimum) -> None:
    """Refuse readings that vary about their ellipsoid by a good part of its size."""
    if not np.isinf(problem.orientation_sd).all():
        return
    scale = _own_scale(problem, optimum)
    # by the median, so that a few bad positions of a robust fit do not reject the others
    size = float(median(np.linalg.norm(optimum.point.residuals, axis=1)))
    nu = max(float(problem.degrees.sum()) - problem.unknowns, 1.0)
    spread = size / _MEDIAN * np.sqrt(len(problem.values) / nu)
    relative = spread / max(scale * float(np.linalg.norm(problem.reference[0])), 1e-300)
    if relative > _SPREAD:
        raise MultiposError(
            f"the readings deviate by {100.0 * relative:.0f} % from the best ellipsoid; they do "
            "not come from positions at rest in one gravity. Turn the sensor to "
            "different positions and hold it still."
        )


def _own_scale(problem: Problem, optimum: Optimum) -> float:
    """Return the mean size of the scale factors along the own axes."""
    model, theta = problem.model, optimum.state.theta
    slopes = model.own_slopes(theta, optimum.point.force, problem.environment)
    return float(np.mean(np.abs(list(slopes.values()))))


def _positive(problem: Problem, optimum: Optimum) -> Optimum:
    """Return the mirrored optimum whose own-axis scale factors are positive.

    Rows of a group determine the handedness. Where an odd number of axes is reversed by them,
    all three are made negative: then the readings follow the other convention.
    """
    model, state = problem.model, optimum.state
    axes = {model.keys[i][1].factors[0].variable: state.theta[i] for i in model.own_scales}
    mirrored = {axis for axis, scale in axes.items() if scale < 0.0}
    if problem.groups and len(mirrored) % 2 == 1:
        mirrored = axes.keys() - mirrored
    if not mirrored:
        return optimum
    bent = [sum(f.is_odd for f in t.factors if f.variable in mirrored) for _, t in model.keys]
    odd = np.array(bent) % 2 == 1
    mirror = np.array([-1.0 if axis in mirrored else 1.0 for axis in COMPONENTS])
    # Exact under the lower gauge; under the symmetric one only near, hence the search again.
    theta = np.where(odd, -state.theta, state.theta)
    size = np.linalg.norm(optimum.point.force, axis=1)[:, None]
    return descent.maximise(
        problem,
        start_state(
            problem,
            theta,
            optimum.point.force * mirror / size,
            state.turns * mirror[:, None] if problem.groups else state.turns,
        ),
    )


def require_information(problem: Problem, optimum: Optimum) -> FisherInformation:
    """Return the information at an optimum, where it determines every parameter."""
    fisher = FisherInformation(problem, optimum.state, optimum.point)
    information = reduced_information(fisher.information, len(problem.model.keys))
    if not np.isfinite(information).all():
        raise ConvergenceError(
            "the search ended where the model has no slopes that are numbers; start its "
            "parameters nearer to what they are, or choose a model with fewer terms."
        )
    if not np.isfinite(condition(information)):
        gains = _candidate_gains(problem, optimum.state.theta)
        best = CANDIDATES[helpful_positions(information, gains, 2)]
        require_separable(
            information,
            problem.model.names,
            f"add positions such as {position_words(best)}, or drop a term",
        )
    return fisher


def reduced_information(full: Array, p: int) -> Array:
    """Return the information of the parameters with the shared unknowns eliminated."""
    if len(full) == p:
        return full
    scale = np.sqrt(np.where(np.diag(full)[p:] > 0.0, np.diag(full)[p:], 1.0))
    cross, shared = full[:p, p:] / scale, full[p:, p:] / np.outer(scale, scale)
    inverse = np.linalg.pinv(shared, rcond=UNSEEN, hermitian=True)
    return np.asarray(full[:p, :p] - cross @ inverse @ cross.T)


def _candidate_gains(problem: Problem, theta: Array) -> Array:
    """Return the information (c, p, p) of each candidate position, as uncertain as the others."""
    count = len(CANDIDATES)
    size = float(np.linalg.norm(problem.reference, axis=1).mean())
    spread = problem.orientation_sd[problem.group < 0]
    environment = {
        name: np.full(count, float(np.mean(column)))
        for name, column in problem.environment.items()
        if name in problem.model.fitted_columns
    }
    mean = problem.precision.mean(axis=0)
    candidates = replace(
        problem,
        values=np.zeros((count, problem.values.shape[1])),
        environment=environment,
        precision=np.broadcast_to(mean, (count, *mean.shape)),
        reference=size * CANDIDATES,
        orientation_sd=np.full(count, spread.max() if len(spread) else 0.0),
        group=np.full(count, -1),
        weight=np.ones(count),
        groups=0,
        attitude=None,
        level_sd=0.0,
        robust=None,
        rolls=None,
    )
    state = start_state(candidates, theta, CANDIDATES)
    jacobian = parameter_jacobian(problem.model, state.theta, size * CANDIDATES, environment)
    with np.errstate(over="ignore", invalid="ignore"):  # where a model has no slopes
        marginal = linearise(candidates, state, evaluate(candidates, state)).marginal
        return np.asarray(jacobian.transpose(0, 2, 1) @ marginal @ jacobian)


def too_few(problem: Problem) -> RankError:
    """Return the error of fewer positions than the parameters need, with what is out of reach."""
    model = problem.model
    n, p = len(problem.values), len(model.keys)
    equations = int(problem.degrees.sum()) - (problem.unknowns - p)
    said = f"{n} positions give {max(equations, 0)} equations for {p} parameters"
    own = not model.has_terms
    if own or not np.isinf(problem.orientation_sd).all() or sorted(model.axes) != ["x", "y", "z"]:
        return RankError(
            f"{said}; add positions or choose a model with fewer terms.",
            rank=min(equations, p),
            parameters=p,
        )
    # The readings themselves show roughly where the positions are: enough to see what is missing.
    values = problem.values
    centre = (values.max(axis=0) + values.min(axis=0)) / 2.0
    half = np.maximum((values.max(axis=0) - values.min(axis=0)) / 2.0, 1e-300)
    order = [model.axes.index(axis) for axis in ("x", "y", "z")]
    direction = directions(((values - centre) / half)[:, order])
    theta = np.zeros(p)
    theta[list(model.own_scales)] = 1.0
    unit = replace(problem, precision=np.ones_like(values), reference=direction, robust=None)
    state = start_state(unit, theta, direction)
    marginal = linearise(unit, state, evaluate(unit, state)).marginal
    jacobian = parameter_jacobian(model, theta, direction, problem.environment)
    information = np.einsum("nmp,nmk,nkq->pq", jacobian, marginal, jacobian)
    missing = [model.names[i] for i in sorted(least_determined(information, equations))]
    gains = _candidate_gains(unit, theta)
    best = CANDIDATES[helpful_positions(information, gains, p - equations)]
    return RankError(
        f"{said}: {', '.join(f'`{name}`' for name in missing)} out of reach; add positions "
        f"such as {position_words(best)}, or drop those terms.",
        rank=equations,
        parameters=p,
    )

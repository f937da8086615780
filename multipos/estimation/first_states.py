"""Where the search for an uncertain or unknown orientation starts.

No guess is asked for. Least squares at the listed directions, where they are enough, is one start;
the ellipsoid on which readings at rest lie (`multipos.estimation.ellipsoid`), turned to the listed
directions where some are, is the other. Of a model of one's own the parameters at either of these
directions are those of `multipos.estimation.guesses`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from multipos.estimation.circles import turn_about, turn_to_axes
from multipos.estimation.ellipsoid import ellipsoid_start, symmetric_root
from multipos.estimation.guesses import first_guesses
from multipos.estimation.problem import Problem, State, start_state
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import solve
from multipos.numerics.medians import median
from multipos.numerics.rotations import align
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import invert

_PARTS = 50  # that a robust start leaves out in turn


def ways(problem: Problem) -> list[Callable[[Problem], State | None]]:
    """Return what makes a start, the most trusted first."""
    if not isinstance(problem.model, ExpressionModel):
        return [_listed_start, _ellipsoid_start]
    return [partial(_given, state) for state in own_starts(problem)]


def _given(state: State, problem: Problem) -> State:
    return state


def own_starts(problem: Problem) -> list[State]:
    """Return where the search for a model of one's own starts: `multipos.estimation.guesses`.

    At the listed directions, or at those that the ellipsoid of the readings gives.
    """
    model, rows = problem.model, problem.listed
    assert isinstance(model, ExpressionModel)
    if rows.any():
        here = {name: column[rows] for name, column in problem.environment.items()}
        guesses = first_guesses(model, problem.values[rows], problem.reference[rows], here)
        return [_placed(problem, theta) for theta in guesses]
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
        names = [model.names[i] for i in places]
        theta[places] = solve(design, values[:, output], names=names).coefficients
    return _placed(problem, theta)


def _placed(problem: Problem, theta: Array) -> State:
    """Return the state at given parameters: unknown directions as the readings say, groups too."""
    if problem.listed.all():
        return start_state(problem, theta)
    force = invert(problem.model, theta, problem.values, problem.environment)
    length = np.linalg.norm(force, axis=1)
    seen = length > 0.0  # not NaN: a force explains the reading
    direction = np.where(seen[:, None], force / np.where(seen, length, 1.0)[:, None], [1.0, 0, 0])
    return start_state(problem, theta, direction, _turns(problem, direction))


def _turns(problem: Problem, direction: Array) -> Array:
    """Return the rotation of each group that brings its listed directions nearest to others."""
    groups = (problem.group == g for g in range(problem.groups))
    turns = [align(problem.reference[rows], direction[rows]) for rows in groups]
    return np.array(turns).reshape(-1, 3, 3)


def _ellipsoid_start(problem: Problem) -> State | None:
    """The ellipsoid of the readings, turned to the listed directions where some are."""
    model = problem.model
    if sorted(model.axes) != ["x", "y", "z"]:
        return None
    seen = _on_ellipsoid(problem)
    theta = np.zeros(len(model.keys))
    for i, (output, term) in enumerate(model.keys):
        column = {"1": 0, "x": 1, "y": 2, "z": 3}.get(str(term))
        if column is not None:
            theta[i] = seen.linear[model.outputs.index(output), column]
    return start_state(problem, theta, seen.direction, _turns(problem, seen.direction))


class _Seen(NamedTuple):
    """What an ellipsoid says: constant and linear terms (3, 4), and directions (n, 3)."""

    linear: Array
    direction: Array


def _on_ellipsoid(problem: Problem) -> _Seen:
    """Return the ellipsoid of a triad's readings, turned to the listed directions if any."""
    model = problem.model
    order = [model.axes.index(axis) for axis in ("x", "y", "z")]
    magnitude = float(problem.magnitude.mean())
    named = any(name.startswith("cross_") for name in model.names)
    crossed = named or isinstance(model, ExpressionModel)
    find = ellipsoid_start if problem.robust is None else _median_ellipsoid
    bias, matrix = find(problem.values[:, order], magnitude, crossed=crossed)
    if model.gauge == "symmetric":
        matrix = symmetric_root(matrix)
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
    return _Seen(linear, direction)


def _hand(problem: Problem, direction: Array) -> Array:
    """Return the rotation or reflection that brings directions nearest to those listed.

    The ellipsoid leaves both open. A reflection is that of a left-handed triad, or of a
    convention which is not the readings' own; rows of a group can tell it as well.
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

    Each part is left out in turn, so that blunders in one of them do not bend the start.
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

"""Which rotations of the case a model of one's own leaves free, and what is held to fix them.

Where no position is listed, a common turn w of all directions, df = w x f, can be undone by the
parameters if some change d of them moves every reading as it does,

    A d = J (w x f)   at all positions,    A = dh/dp, J = dh/df:                             (1)

the null space of [A, -J (e_a x f)], and what is as good as that: a small square of the own axis
tells where the axis lies a thousand times worse than linear terms tell the rest, so that a turn
counts as free there as it does in a polynomial model. Its dimension along w is how many rotations
are free; as many parameters are held, by choice those that a lower triangular matrix of
sensitivities has as zeros, slopes along a later axis. A model that no turn leaves as it is says
itself where its axes lie, and nothing is held.
"""

import numpy as np

from multipos.errors import UsageError
from multipos.estimation.problem import Problem, State
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import cross_matrix
from multipos.numerics.terms import COMPONENTS
from multipos.positions.scheme import read_scheme
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Gauge
from multipos.sensor.own_models import Fixed, hold

_NULL = 1e-3  # of the largest singular value, scaled: what moves no reading, or as good as none
_TOLD = 1e-6  # share of a null direction below which it has no turn, or no such parameter
_FIXING = 0.1  # share of the most that a rotation moves, from which a parameter fixes it
_ALONG = 0.99  # cosine from which a slope is along a component


def rotations_to_hold(problem: Problem, state: State, gauge: Gauge) -> Fixed:
    """Return what is to be held of the parameters, (output, name, value) each; empty if nothing.

    Raises
    ------
    UsageError
        The symmetric gauge, which is not one of single parameters.
    """
    model = problem.model
    assert isinstance(model, ExpressionModel)
    force = problem.magnitude[:, None] * state.centre
    slopes = parameter_jacobian(model, state.theta, force, problem.environment)
    by_force = model.force_jacobian(state.theta, force, problem.environment)
    # of one axis alone, what the rotation about it hardly moves would fix it badly
    least = _TOLD if problem.rolls is None else _FIXING
    moved = _moved_by_turns(slopes, (by_force @ cross_matrix(force))[..., _turns_left(problem)])
    held = _held(model, _chosen(moved, _upper_first(model, slopes, force), least))
    if held and gauge != "lower":
        raise UsageError(
            "--gauge symmetric is one of polynomial models; a model of one's own is fixed by "
            "parameters that are held, --gauge lower."
        )
    return held


def hold_free_rotations(model: ExpressionModel, parameters: Array) -> ExpressionModel:
    """Return a model whose gauge is fixed where all orientations are unknown, before any reading.

    Parameters
    ----------
    model : ExpressionModel
        Of specific force alone.
    parameters : (p,) array
        Of the sensor; which rotations are free is judged there, all over the sphere.
    """
    force = read_scheme("fibonacci-100").up
    slopes = parameter_jacobian(model, parameters, force, {})
    moved = _moved_by_turns(
        slopes, model.force_jacobian(parameters, force, {}) @ cross_matrix(force)
    )
    held = _held(model, _chosen(moved, _upper_first(model, slopes, force), _TOLD))
    return hold(model, held) if held else model


def _moved_by_turns(slopes: Array, turned: Array) -> Array:
    """Return what parameters do (p, r), scaled, that undoes r turns of all directions, eq. (1).

    Parameters
    ----------
    slopes : (n, M, p) array
    turned : (n, M, t) array
        J (f x w) of each turn w that the positions leave open.
    """
    n, m, p = slopes.shape
    design = np.concatenate([slopes, turned], axis=2).reshape(n * m, -1)
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, sizes, rows = np.linalg.svd(design / scale, full_matrices=True)
    sizes = np.append(sizes, np.zeros(len(rows) - len(sizes)))
    null = (rows[sizes <= _NULL * sizes[0]] / scale).T  # (p + t, d)
    if not null.size:
        return np.zeros((p, 0))
    # directions with a turn in them: the others are parameters that nothing separates
    _, turns, inner = np.linalg.svd(null[p:])
    free = int((turns > _TOLD * max(float(np.abs(null).max()), 1e-300)).sum())
    return np.asarray((null @ inner[:free].T)[:p] * scale[:p, None])


def _held(model: ExpressionModel, chosen: list[int]) -> Fixed:
    """Return parameters with the values that they are held at: those stated, else 0."""
    held = []
    for i in chosen:
        output, name = model.keys[i]
        start = model.quantities[i].start
        held.append((output, str(name), 0.0 if start is None else start))
    return held


def _turns_left(problem: Problem) -> list[int]:
    """Return the axes that the positions may turn about: of rolls about one axis that axis."""
    if problem.rolls is None:
        return [0, 1, 2]
    return [i for i, axis in enumerate(COMPONENTS) if axis == problem.free_axis]


def _upper_first(model: ExpressionModel, slopes: Array, force: Array) -> list[int]:
    """Return the parameters in the order in which they are held: upper triangle first."""
    order = {axis: i for i, axis in enumerate(COMPONENTS)}
    length = np.linalg.norm(force, axis=0)
    upper = []
    for output, (axis, places) in enumerate(zip(model.axes, model.places, strict=True)):
        for i in places.tolist():
            column = slopes[:, output, i]
            size = max(float(np.linalg.norm(column)), 1e-300)
            along = np.abs(column @ force) / (size * np.where(length > 0.0, length, 1.0))
            if along.max() > _ALONG and int(along.argmax()) > order[axis]:
                upper.append(i)
    rest = [i for i in range(len(model.keys)) if i not in upper]
    return [*upper, *rest]


def _chosen(moved: Array, order: list[int], share: float) -> list[int]:
    """Return as many parameters as there are directions (p, r), which fix all of them."""
    chosen: list[int] = []
    if not moved.shape[1]:
        return chosen
    for i in order:
        trial = moved[[*chosen, i]]
        least = np.linalg.svd(trial, compute_uv=False)[-1]
        if len(chosen) < moved.shape[1] and least > share * np.abs(moved).max():
            chosen.append(i)
    return chosen

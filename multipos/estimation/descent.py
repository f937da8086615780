"""The minimum of F, eq. (4) of `multipos.estimation.likelihood`, of one unit or of many.

`maximise` searches from a state and `resume` from an optimum whose noise has changed. Both take
the steps of `multipos.numerics.levenberg_marquardt` by eqs. (5), (6) of `likelihood`, of all units
at once; where orientations are off by a few degrees at most, hardly damped at first: such angles
bend F by little, and each step leaves a small part of the one before.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.likelihood import evaluate, linearise, moved, recentred
from multipos.estimation.problem import (
    Normal,
    Optimum,
    Problem,
    Standing,
    State,
    some_units,
    with_units,
)
from multipos.numerics.arrays import Array, Places
from multipos.numerics.levenberg_marquardt import ROBUST, STRICT, Rules, descend

WIDE = np.radians(5.0)  # up to which orientation errors bend F by little
_HARDLY = 1e-6  # damping of the first step there


def maximise(problem: Problem, state: State, decrement: float = STRICT) -> Optimum:
    """Maximise the likelihood from a state; parameters with bounds by what has none."""
    model = problem.model
    if model.bounded:
        inner = replace(problem, model=model.unbounded())
        found = _maximise(inner, replace(state, theta=model.inward(state.theta)), decrement)
        back = replace(found.state, theta=model.outward(found.state.theta)[0])
        return replace(found, state=back, point=evaluate(problem, back))
    return _maximise(problem, state, decrement)


def resume(problem: Problem, optimum: Optimum, decrement: float = STRICT) -> Optimum:
    """Search on from an optimum, after the noise of the problem was changed."""
    found = maximise(problem, optimum.state, decrement)
    return replace(found, iterations=optimum.iterations + found.iterations)


def _maximise(problem: Problem, state: State, decrement: float) -> Optimum:
    rules = Rules(decrement=decrement) if problem.robust is None else ROBUST
    if problem.tied.any() and (problem.orientation_sd <= WIDE).all():
        rules = rules._replace(damping=_HARDLY)
    start = replace(state, theta=np.atleast_2d(state.theta))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a trial may run away
        steps = _Search(problem)
        at, ended = descend(steps, steps.at(start), rules, _largest(problem), problem.held)
    found, point = at.standing
    if state.theta.ndim > 1:
        return Optimum(found, point, *ended)
    point = replace(point, objective=float(at.objective[0]))
    return Optimum(replace(found, theta=at.theta[0]), point, *(each[0] for each in ended))


def _largest(problem: Problem) -> Array:
    """Return the largest reading of each unit in units of its noise (B,)."""
    precision = problem.precision
    if precision.ndim == 3:
        precision = np.einsum("nii->ni", precision)
    squares = problem.values**2 * precision
    return np.asarray(np.sqrt(squares.reshape(problem.units, -1).max(axis=1)))


class _At:
    """B units at a state, with the model there."""

    def __init__(self, standing: Standing) -> None:
        self.standing = standing

    @property
    def theta(self) -> Array:
        return self.standing[0].theta

    @property
    def objective(self) -> Array:
        return np.asarray(self.standing[1].objective)

    def of(self, units: NDArray[Any]) -> "_At":
        """Return some of the units."""
        return _At(some_units(self.standing, np.arange(len(self.theta))[units]))

    def put(self, units: Places, other: "_At") -> None:
        """Put other units in places of these."""
        if len(units):
            self.standing = with_units(self.standing, units, other.standing)


class _Equations(NamedTuple):
    """The normal equations of B units."""

    information: Array  # (B, P, P)
    gradient: Array  # (B, P)
    normal: Normal


class _Search:
    """What a step needs of the problem of B units."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def of(self, units: Places) -> "_Search":
        return _Search(self.problem.of(units))

    def at(self, state: State) -> _At:
        return _At((state, evaluate(self.problem, state)))

    def linearise(self, at: _At) -> _Equations:
        normal = linearise(self.problem, *at.standing)
        information, p = normal.information, at.theta.shape[1]
        bent = self.problem.model.bend(at.theta, normal.gradient[:, :p])
        if bent.any():  # the curvature of bounds that parameters are searched within
            information = information.copy()
            information[:, range(p), range(p)] += bent
        return _Equations(information, normal.gradient, normal)

    def move(self, at: _At, equations: _Equations, step: Array, damping: Array) -> _At:
        state = moved(self.problem, *at.standing, equations.normal, step, damping)
        return self.at(recentred(self.problem, state))

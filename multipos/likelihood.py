"""One likelihood for orientations known, uncertain and unknown.

A reading at position k, and how the position may differ from where it should be:

    y_k = h(theta, f_k) + e_k,                        e_k ~ N(0, Sigma_k)                   (1)
    f_k = ±g R_k E(u_k, t_k),                         t_k ~ N(0, s_k² I_2)                  (2)

E(u, t) is a step t (two angles) on the sphere from the listed direction u (`multipos.rotations`);
s_k = 0 is a position known exactly, s_k = inf one of which nothing is known. R_k is what
positions share: the unknown rotation of the group they belong to, and the tilt
tau ~ N(0, s_level² I_2) of a table that is not level, turned into case axes by the attitude C_k,

    R_k = Exp([rho_g]x) · C_k Exp([tau]x) C_k'.                                             (3)

The maximum a posteriori estimate minimises, with rho(q) = q or a robust loss,

    F = sum_k rho(q_k) + |tau|²/s_level²,   q_k = r_k' Sigma_k^-1 r_k + |t_k|²/s_k²,        (4)

r_k = y_k − h. It is found by Levenberg and Marquardt's method. Each t_k touches position k only,
so it is eliminated there: with J_k = dh/df df/dt and H_k = J_k' Sigma_k^-1 J_k + I/s_k²,

    W_k = Sigma_k^-1 − Sigma_k^-1 J_k H_k^-1 J_k' Sigma_k^-1,                               (5)
    S = sum_k A_k' W_k A_k,      S d = sum_k A_k' (Sigma_k^-1 r_k − Sigma_k^-1 J_k H_k^-1 m_k),
    m_k = J_k' Sigma_k^-1 r_k − t_k/s_k²,                                                   (6)

A_k = dh/d(theta, rho, tau), and t_k follows by back substitution: the cost is linear in the number
of positions. W_k is the inverse of the marginal covariance Sigma_k + s_k² J_k J_k', and S^-1 is the
covariance of the estimate, orientation errors inside.

References
----------
K. Levenberg 1944, D. Marquardt 1963; B. Triggs and others, *Bundle adjustment: a modern
synthesis*, 2000, section 6 (elimination); JCGM 102.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from multipos.losses import loss, loss_weight
from multipos.model import Block, Model
from multipos.rotations import (
    cross_matrix,
    left_jacobian,
    rotation_matrix,
    step_derivative,
    step_on_sphere,
    tangent_basis,
)

Array = NDArray[np.float64]

_ITERATIONS = 200
_DECREMENT = 1e-20  # of F: a step of 1e-10 of an uncertainty
_DECREMENT_ROBUST = 1e-14  # weights that change with the step make convergence linear
_XTOL = 1e-13  # relative step that is only rounding
_DAMPING = 1e-4
_STUCK = 1e12  # damping beyond which nothing moves
_ROUNDING = 1e-8  # of F, or of theta: what the last digits of the readings can do


@dataclass(frozen=True)
class Problem:
    """Readings and what is known of their positions, eqs. (1)–(3).

    Attributes
    ----------
    model : Model
    values : (n, M) array
    environment : mapping of str to (n,) array
    precision : (n, M) or (n, M, M) array
        Inverse variances, or inverse covariances, of each reading.
    reference : (n, 3) array [g]
        Listed reference ±g u, of any direction where `spread` is infinite.
    spread : (n,) array [rad]
        s_k.
    group : (n,) array of int
        Number of the group, −1 for none.
    weight : (n,) array
        What the precision of each position has been multiplied by, 1 but for those set aside.
    groups : int
    attitude : (n, 3, 3) array or None
        Level to case, where a tilt of the table is estimated.
    level_spread : float [rad]
        s_level; 0 for a level table.
    robust : str or None
        Name of the loss; the thresholds of q count in `degrees` of freedom a position.
    """

    model: Model
    values: Array
    environment: Mapping[str, Array]
    precision: Array
    reference: Array
    spread: Array
    group: NDArray[np.intp]
    weight: Array
    groups: int = 0
    attitude: Array | None = None
    level_spread: float = 0.0
    robust: str | None = None

    @property
    def degrees(self) -> Array:
        """Degrees of freedom that each position leaves, (n,): M, less two where s is infinite."""
        return np.asarray(self.values.shape[1] - 2.0 * np.isinf(self.spread))

    @property
    def listed(self) -> NDArray[np.bool_]:
        """Rows whose direction is listed in the world's axes."""
        return np.isfinite(self.spread) & (self.group < 0)

    @property
    def adrift(self) -> bool:
        """Whether nothing ties the readings to the directions of the world."""
        return not self.listed.any()

    @property
    def shared(self) -> int:
        """Number of unknowns that positions share beside the parameters."""
        return 3 * self.groups + (2 if self.level_spread > 0.0 else 0)

    @property
    def unknowns(self) -> int:
        """Number of parameters and shared unknowns; a tilt, tied to zero, costs none."""
        return len(self.model.keys) + 3 * self.groups

    @property
    def has_prior(self) -> bool:
        """Whether orientations are tied to where they should be by a standard deviation."""
        uncertain = np.isfinite(self.spread) & (self.spread > 0.0)
        return bool(uncertain.any()) or self.level_spread > 0.0


@dataclass(frozen=True)
class State:
    """A point of the search: parameters, steps on the sphere and shared rotations."""

    theta: Array  # (p,)
    centre: Array  # (n, 3) unit, from which `step` starts
    basis: Array  # (n, 3, 2)
    step: Array  # (n, 2) [rad]
    turns: Array  # (G, 3, 3), Exp([rho_g]x)
    tilt: Array  # (2,) [rad]


@dataclass(frozen=True)
class Point:
    """The model and objective at a state."""

    force: Array  # (n, 3) [g]
    blocks: tuple[Block, ...]  # dh/dtheta, by output
    residuals: Array  # (n, M)
    q: Array  # (n,)
    objective: float


@dataclass(frozen=True)
class Normal:
    """The reduced normal equations at a point, eqs. (5), (6)."""

    information: Array  # S, (p + shared, p + shared)
    gradient: Array  # (p + shared,)
    shared: Array  # (n, M, shared): dh/d(rho, tau)
    jacobian: Array  # J_k, (n, M, 2)
    weighted: Array  # Sigma^-1 J, (n, M, 2)
    inverse: Array  # H^-1, (n, 2, 2)
    curved: Array  # H^-1 with the curvature of the sphere in H, (n, 2, 2)
    pull: Array  # m_k, (n, 2)
    marginal: Array  # W_k, (n, M, M)


@dataclass(frozen=True)
class Optimum:
    """Where the search ended."""

    state: State
    point: Point
    normal: Normal
    converged: bool
    iterations: int
    last_step: float
    gradient: float


def start_state(
    problem: Problem, theta: Array, direction: Array | None = None, turns: Array | None = None
) -> State:
    """Return a state: at the listed directions, or at others where nothing is known of them."""
    listed = problem.reference / np.linalg.norm(problem.reference, axis=1)[:, None]
    centre = listed if direction is None else np.where(
        np.isinf(problem.spread)[:, None], direction, listed
    )  # fmt: skip
    return State(
        theta=theta,
        centre=centre,
        basis=tangent_basis(centre),
        step=np.zeros((len(centre), 2)),
        turns=np.tile(np.eye(3), (problem.groups, 1, 1)) if turns is None else turns,
        tilt=np.zeros(2),
    )


def maximise(problem: Problem, state: State) -> Optimum:
    """Minimise F of eq. (4) from a state."""
    point = evaluate(problem, state)
    damping = _DAMPING
    enough = _DECREMENT if problem.robust is None else _DECREMENT_ROBUST
    last_step, decrement = np.inf, np.inf
    converged = False
    iterations = 0
    normal = linearise(problem, state, point)
    while iterations < _ITERATIONS and not converged:
        iterations += 1
        while True:
            step, decrement, last_step = _step(state, normal, damping)
            trial = _moved(problem, state, point, normal, step, damping)
            trial_point = evaluate(problem, trial)
            if trial_point.objective <= point.objective or damping > _STUCK:
                break
            damping = max(damping * 10.0, 1e-10)
        if damping > _STUCK:  # no descent is left: rounding, or a point that is no minimum
            _, decrement, last_step = _step(state, normal, 0.0)
            converged = decrement <= _ROUNDING * point.objective or last_step <= _ROUNDING
            break
        state, point = _recentred(problem, trial), trial_point
        damping *= 0.1
        converged = decrement <= enough * point.objective or last_step <= _XTOL
        normal = linearise(problem, state, point)
    return Optimum(
        state, point, normal, converged, iterations, last_step, float(np.sqrt(max(decrement, 0.0)))
    )


def resume(problem: Problem, optimum: Optimum) -> Optimum:
    """Search on from an optimum, after the noise of the problem was changed."""
    found = maximise(problem, optimum.state)
    return replace(found, iterations=optimum.iterations + found.iterations)


def _step(state: State, normal: Normal, damping: float) -> tuple[Array, float, float]:
    """Return the damped step, what it should take off F, and its size relative to theta."""
    scale = np.sqrt(np.diag(normal.information))
    scale = np.where(scale > 0.0, scale, 1.0)
    damped = normal.information / np.outer(scale, scale)
    # A ridge of rounding size, so that what the positions cannot tell is left where it is.
    damped[np.diag_indices(len(scale))] += max(damping, 1e-15)
    step = np.linalg.solve(damped, normal.gradient / scale) / scale
    size = np.abs(state.theta * scale[: len(state.theta)]).max()
    relative = float(np.abs(step * scale).max() / max(float(size), 1e-300))
    return step, float(step @ normal.gradient), relative


def evaluate(problem: Problem, state: State) -> Point:
    """Return the force, residuals and objective at a state."""
    size = np.linalg.norm(problem.reference, axis=1)
    direction = step_on_sphere(state.centre, state.basis, state.step)
    turn = _shared_rotation(problem, state)
    if turn is not None:
        direction = np.einsum("nij,nj->ni", turn, direction)
    force = size[:, None] * direction
    outputs, blocks = problem.model.respond(state.theta, force, problem.environment)
    residuals = problem.values - outputs
    q = np.einsum("nm,nm->n", residuals, _weigh(problem.precision, residuals))
    uncertain = np.isfinite(problem.spread) & (problem.spread > 0.0)
    if uncertain.any():
        q = q + np.where(
            uncertain,
            np.einsum("ni,ni->n", state.step, state.step)
            / np.where(uncertain, problem.spread, 1.0) ** 2,
            0.0,
        )
    objective = float(np.sum(loss(problem.robust, q, problem.degrees)))
    if problem.level_spread > 0.0:
        objective += float(state.tilt @ state.tilt) / problem.level_spread**2
    return Point(force, blocks, residuals, q, objective)


def linearise(problem: Problem, state: State, point: Point) -> Normal:
    """Return the normal equations of eqs. (5), (6), weighted by the loss."""
    by_force = problem.model.force_jacobian(state.theta, point.force, problem.environment)
    jacobian = by_force @ _force_by_step(problem, state)
    weighted = _weigh(problem.precision, jacobian)
    prior = _prior(problem.spread)
    gram = jacobian.transpose(0, 2, 1) @ weighted
    inverse = _inverse_2x2(gram, prior)
    weighted_residuals = _weigh(problem.precision, point.residuals)
    # A reading far outside the sphere is pulled to it harder than its tangent plane says, and
    # would be thrown from side to side: d²f/dt² = -f.
    outside = np.einsum("nm,nmi,ni->n", weighted_residuals, by_force, point.force)
    curved = _inverse_2x2(gram, prior + np.maximum(outside, 0.0))
    inverse[problem.spread == 0.0] = curved[problem.spread == 0.0] = 0.0
    pull = np.einsum("nmi,nm->ni", weighted, point.residuals) - prior[:, None] * state.step
    marginal = _full(problem.precision) - weighted @ inverse @ weighted.transpose(0, 2, 1)
    push = weighted_residuals - np.einsum("nmi,nij,nj->nm", weighted, inverse, pull)
    if problem.robust is not None:
        weight = loss_weight(problem.robust, point.q, problem.degrees)
        marginal = weight[:, None, None] * marginal
        push = weight[:, None] * push
    shared = _by_shared(problem, state, point, by_force)
    information, right = assemble(len(state.theta), point.blocks, marginal, push, shared)
    if problem.level_spread > 0.0:
        information[-2:, -2:] += np.eye(2) / problem.level_spread**2
        right[-2:] -= state.tilt / problem.level_spread**2
    return Normal(information, right, shared, jacobian, weighted, inverse, curved, pull, marginal)


def assemble(
    p: int, blocks: Sequence[Block], marginal: Array, push: Array, shared: Array
) -> tuple[Array, Array]:
    """Return sum A'WA and sum A'push, A = (dh/dtheta, shared), without forming A."""
    extra = shared.shape[2]
    information = np.zeros((p + extra, p + extra))
    right = np.zeros(p + extra)
    for i, (places, mine) in enumerate(blocks):
        right[places] += mine.T @ push[:, i]
        for j, (targets, other) in enumerate(blocks[i:], start=i):
            block = (mine * marginal[:, i, j, None]).T @ other
            information[np.ix_(places, targets)] += block
            if j > i:
                information[np.ix_(targets, places)] += block.T
        if extra:
            cross = mine.T @ np.einsum("nm,nms->ns", marginal[:, i], shared)
            information[places, p:] += cross
            information[p:, places] += cross.T
    if extra:
        information[p:, p:] += np.einsum("nms,nmr->sr", shared, marginal @ shared)
        right[p:] += np.einsum("nms,nm->s", shared, push)
    return information, right


def _moved(
    problem: Problem, state: State, point: Point, normal: Normal, step: Array, damping: float
) -> State:
    """Return the state after a step of the shared unknowns, each t_k following it."""
    p = len(state.theta)
    theta = state.theta + step[:p]
    outputs = np.column_stack([slopes @ step[places] for places, slopes in point.blocks])
    turns, tilt = state.turns, state.tilt
    if problem.shared:
        outputs = outputs + normal.shared @ step[p:]
        turns = np.array(
            [rotation_matrix(step[p + 3 * g : p + 3 * g + 3]) @ turn
             for g, turn in enumerate(state.turns)]
        ).reshape(-1, 3, 3)  # fmt: skip
        if problem.level_spread > 0.0:
            tilt = state.tilt + step[-2:]
    back = normal.pull - np.einsum("nmi,nm->ni", normal.weighted, outputs)
    own = np.einsum("nij,nj->ni", normal.curved, back)
    # Damped like the rest, so that a rejected step shrinks as a whole; half a turn at most.
    own = own / (1.0 + damping)
    length = np.hypot(own[:, 0], own[:, 1])
    own = own * np.minimum(1.0, 1.5 / np.maximum(length, 1e-300))[:, None]
    return replace(state, theta=theta, step=state.step + own, turns=turns, tilt=tilt)


def _recentred(problem: Problem, state: State) -> State:
    """Return the state with unknown directions as their own centres, which have no prior."""
    unknown = np.isinf(problem.spread)
    if not unknown.any():
        return state
    moved = step_on_sphere(state.centre, state.basis, state.step)
    centre = np.where(unknown[:, None], moved, state.centre)
    basis = tangent_basis(centre)
    return replace(
        state, centre=centre, basis=basis, step=np.where(unknown[:, None], 0.0, state.step)
    )


def _shared_rotation(problem: Problem, state: State) -> Array | None:
    """Return R_k of eq. (3), (n, 3, 3), or None where all are the identity."""
    if not problem.shared:
        return None
    turn = np.tile(np.eye(3), (len(problem.values), 1, 1))
    if problem.attitude is not None:
        tilt = rotation_matrix(np.array([*state.tilt, 0.0]))
        turn = problem.attitude @ tilt @ problem.attitude.transpose(0, 2, 1)
    member = problem.group >= 0
    if member.any():
        turn[member] = state.turns[problem.group[member]] @ turn[member]
    return turn


def _force_by_step(problem: Problem, state: State) -> Array:
    """Return df/dt (n, 3, 2)."""
    size = np.linalg.norm(problem.reference, axis=1)
    moves = step_derivative(state.centre, state.basis, state.step)
    turn = _shared_rotation(problem, state)
    if turn is not None:
        moves = turn @ moves
    return np.asarray(size[:, None, None] * moves)


def _by_shared(problem: Problem, state: State, point: Point, by_force: Array) -> Array:
    """Return dh/d(rho, tau) (n, M, shared): a turn moves f by df = rho x f."""
    n, m = problem.values.shape
    result = np.zeros((n, m, problem.shared))
    if not problem.shared:
        return result
    by_turn = -by_force @ cross_matrix(point.force)
    for g in range(problem.groups):
        member = problem.group == g
        result[member, :, 3 * g : 3 * g + 3] = by_turn[member]
    if problem.attitude is not None:
        turned = problem.attitude.copy()
        member = problem.group >= 0
        turned[member] = state.turns[problem.group[member]] @ turned[member]
        level = left_jacobian(np.array([*state.tilt, 0.0]))[:, :2]
        result[:, :, -2:] = by_turn @ turned @ level
    return result


def _weigh(precision: Array, array: Array) -> Array:
    """Return Sigma^-1 times (n, M) or (n, M, c)."""
    if precision.ndim == 2:
        return precision * array if array.ndim == 2 else precision[:, :, None] * array
    if array.ndim == 2:
        return np.asarray(np.einsum("nij,nj->ni", precision, array))
    return np.asarray(precision @ array)


def _full(precision: Array) -> Array:
    if precision.ndim == 3:
        return precision
    return np.asarray(precision[:, :, None] * np.eye(precision.shape[1]))


def _prior(spread: Array) -> Array:
    """Return 1/s²; exact positions get 0 here, their steps are held at zero instead."""
    with np.errstate(divide="ignore"):
        return np.where(spread > 0.0, 1.0 / spread**2, 0.0)


def _inverse_2x2(matrix: Array, prior: Array) -> Array:
    """Return (matrix + prior I)^-1; zero where it is singular, so that nothing is claimed."""
    a, d = matrix[:, 0, 0] + prior, matrix[:, 1, 1] + prior
    b = matrix[:, 0, 1]
    determinant = a * d - b * b
    sound = determinant > 1e-28 * (a * d)
    factor = np.where(sound, 1.0 / np.where(sound, determinant, 1.0), 0.0)
    return np.array([[d, -b], [-b, a]]).transpose(2, 0, 1) * factor[:, None, None]

"""The likelihood of readings whose orientations are known, uncertain or unknown.

`evaluate` returns force, residuals and F at a state, `linearise` the normal equations and
`eliminate` the angles of each position; `assemble` sums over positions, which `weigh` weighs and
`full` makes matrices of. `respond` solves, `moved` takes the step, and `recentred` begins again
from there. Rows are positions of one unit, or of several, one after the other, of which
`parameters_of` a state has one set each.

A reading at position k, and how the position may differ from where it should be:

    y_k = h(theta, f_k) + e_k,                        e_k ~ N(0, Sigma_k)                   (1)
    f_k = ±g R_k E(u_k, t_k),                         t_k ~ N(0, s_k² I_2)                  (2)

E(u, t) is a step t (two angles) on the sphere from the listed direction u
(`multipos.numerics.rotations`); s_k = 0 is a position known exactly, s_k = inf one of which nothing
is known. R_k is common to several positions: the unknown rotation of their group, and the tilt
tau ~ N(0, s_level² I_2) of a table that is not level, rotated into case axes by the attitude C_k,

    R_k = Exp([rho_g]x) · C_k Exp([tau]x) C_k'.                                             (3)

The maximum a posteriori estimate minimises, with rho(q) = q or a robust loss,

    F = sum_k rho(q_k) + |tau|²/s_level²,   q_k = r_k' Sigma_k^-1 r_k + |t_k|²/s_k²,        (4)

and, where parameters have a prior N(m_j, s_j²) of their own, + sum_j (theta_j − m_j)²/s_j²;
r_k = y_k − h; `multipos.estimation.descent` searches for it. Each t_k touches position k only,
so it is eliminated there: with J_k = dh/df df/dt and H_k = J_k' Sigma_k^-1 J_k + I/s_k²,

    W_k = Sigma_k^-1 − Sigma_k^-1 J_k H_k^-1 J_k' Sigma_k^-1,                               (5)
    S = sum_k A_k' W_k A_k,      S d = sum_k A_k' (Sigma_k^-1 r_k − Sigma_k^-1 J_k H_k^-1 m_k),
    m_k = J_k' Sigma_k^-1 r_k − t_k/s_k²,                                                   (6)

A_k = dh/d(theta, rho, tau), and t_k follows by back substitution: the cost is linear in the number
of positions. W_k is the inverse of the marginal covariance Sigma_k + s_k² J_k J_k', and S^-1 is the
covariance of the estimate, orientation errors inside.

References
----------
B. Triggs and others, *Bundle adjustment: a modern
synthesis*, 2000, section 6 (elimination); JCGM 102.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.estimation.problem import (
    Normal,
    Point,
    Problem,
    State,
    eliminate_free,
    put_on_circles,
    spread_inclinations,
)
from multipos.numerics import losses, rotations
from multipos.numerics.arrays import Array, Mask
from multipos.sensor.model import Block


def evaluate(problem: Problem, state: State) -> Point:
    """Return the force, residuals and objective at a state."""
    direction = rotations.step_on_sphere(state.centre, state.basis, _steps(problem, state))
    turn = _shared_rotation(problem, state)
    if turn is not None:
        direction = np.einsum("nij,nj->ni", turn, direction)
    force = problem.magnitude[:, None] * direction
    outputs, blocks = problem.model.respond(
        parameters_of(problem, state), force, problem.environment
    )
    residuals = problem.values - outputs
    q = np.einsum("nm,nm->n", residuals, weigh(problem.precision, residuals))
    if problem.prior.any():
        q += problem.prior * np.einsum("ni,ni->n", state.step, state.step)
    total = q if problem.robust is None else losses.loss(problem.robust, q, problem.degrees)
    objective = np.sum(total.reshape(problem.units, -1), axis=1)
    if problem.has_parameter_prior:
        objective += np.sum(problem.model.belief(state.theta)[0] ** 2, axis=-1)
    if problem.level_sd > 0.0:
        objective += state.tilt @ state.tilt / problem.level_sd**2
    one = state.theta.ndim == 1
    return Point(force, blocks, residuals, q, float(objective[0]) if one else objective)


def parameters_of(problem: Problem, state: State) -> Array:
    """Return the parameters (p,) of one unit, (B, p) of several."""
    return state.theta if problem.units > 1 else state.theta.reshape(-1)


def linearise(problem: Problem, state: State, point: Point) -> Normal:
    """Return the normal equations, eqs. (5) and (6), weighted by the loss."""
    theta = parameters_of(problem, state)
    by_force = problem.model.force_jacobian(theta, point.force, problem.environment)
    moves = np.einsum("nmi,nij->nmj", by_force, _force_by_step(problem, state))
    jacobian = moves
    if problem.rolls is not None:  # towards the axis nothing moves that has no sd
        held = problem.rolled & (problem.orientation_sd == 0.0)
        jacobian = np.where(held[:, None, None], moves * [1.0, 0.0], moves)
    weighted = weigh(problem.precision, jacobian)
    own = eliminate(
        full(problem.precision), jacobian, weighted, problem.prior, problem.exact, problem.rolled
    )
    gain, inverse, marginal = own.gain, own.inverse, own.marginal
    weighted_residuals = weigh(problem.precision, point.residuals)
    angle_gradient = np.einsum("nmi,nm->ni", weighted, point.residuals)
    angle_gradient -= problem.prior[:, None] * state.step
    reduced = weighted_residuals - np.einsum("nmi,ni->nm", gain, angle_gradient)
    # For a reading far outside the sphere the tangent plane underestimates the curvature, and steps
    # would oscillate: d²f/dt² = -f.
    outside = np.einsum("nm,nmi,ni->n", weighted_residuals, by_force, point.force)
    mean = np.einsum("nmi,nmi->n", jacobian, weighted) / 2.0 + problem.prior
    ease = mean / (mean + np.maximum(outside, 0.0) + 1e-300)
    if problem.robust is not None:
        weight = losses.loss_weight(problem.robust, point.q, problem.degrees)
        marginal = weight[:, None, None] * marginal
        reduced = weight[:, None] * reduced
    shared = _by_shared(problem, state, point, by_force, moves)
    p = theta.shape[-1]
    information, right = assemble(p, point.blocks, marginal, reduced, shared, problem.units)
    if problem.has_parameter_prior:
        excess, slope = problem.model.belief(state.theta)
        places = np.arange(p)
        information[:, places, places] += slope**2
        right[:, places] -= slope * excess
    if problem.level_sd > 0.0:
        information[:, -2:, -2:] += np.eye(2) / problem.level_sd**2
        right[:, -2:] -= state.tilt / problem.level_sd**2
    if state.theta.ndim == 1:
        information, right = information[0], right[0]
    return Normal(
        information, right, shared, jacobian, weighted, inverse, ease, angle_gradient, marginal
    )


def assemble(
    p: int, blocks: Sequence[Block], marginal: Array, reduced: Array, shared: Array, units: int = 1
) -> tuple[Array, Array]:
    """Return sum A'WA and A' times reduced residuals, without forming A = (dh/dtheta, shared).

    Of `units`, each a block of rows, along a leading axis.
    """
    extra = shared.shape[2]
    information = np.zeros((units, p + extra, p + extra))
    right = np.zeros((units, p + extra))

    def of_units(columns: Array) -> Array:
        """Return columns (n, k) of all rows by unit (B, k, n)."""
        return columns.T.reshape(columns.shape[1], units, -1).transpose(1, 0, 2)

    each = [(places, of_units(slopes)) for places, slopes in blocks]
    for i, (places, mine) in enumerate(each):
        right[:, places] += (mine @ reduced[:, i].reshape(units, -1, 1))[:, :, 0]
        for j, (targets, other) in enumerate(each[i:], start=i):
            weight = marginal[:, i, j]
            if not weight.any():  # as between outputs of an exact position
                continue
            weighted = mine * weight.reshape(units, 1, -1)
            block = weighted @ other.transpose(0, 2, 1)
            information[:, places[:, None], targets] += block
            if j > i:
                information[:, targets[:, None], places] += block.transpose(0, 2, 1)
        if extra:
            cross = mine @ np.einsum("nm,nms->ns", marginal[:, i], shared)
            information[:, places, p:] += cross
            information[:, p:, places] += cross.transpose(0, 2, 1)
    if extra:
        weighted = np.einsum("nmk,nks->nms", marginal, shared)
        information[:, p:, p:] += np.einsum("nms,nmr->sr", shared, weighted)
        right[:, p:] += np.einsum("nms,nm->s", shared, reduced)
    return information, right


def respond(information: Array, right: Array) -> Array:
    """Return the changes of all unknowns with right sides (p + shared, k), the least if singular.

    Many groups of few positions leave directions of the information that are only rounding.
    NaN where the information is no number, as of a file that was damaged.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))  # below is rounding of far-off forces
    scale = np.where(scale > 0.0, scale, 1.0)[:, None]
    relative = information / (scale * scale.T)
    if not (np.isfinite(relative).all() and np.isfinite(right).all()):
        return np.full(right.shape, np.nan)
    return np.asarray(np.linalg.lstsq(relative, right / scale, rcond=None)[0] / scale)


def moved(
    problem: Problem,
    state: State,
    point: Point,
    normal: Normal,
    step: Array,
    damping: Array | float,
) -> State:
    """Return the state after a step of the shared unknowns, each t_k by back substitution."""
    p, n = state.theta.shape[-1], len(problem.values)
    each = step.reshape(problem.units, -1)
    outputs = np.empty((n, len(point.blocks)))
    for i, (places, slopes) in enumerate(point.blocks):
        by_unit = slopes.T.reshape(len(places), problem.units, -1)
        outputs[:, i] = np.einsum("kbn,bk->bn", by_unit, each[:, places]).ravel()
    turns, tilt, inclination = state.turns, state.tilt, state.inclination
    if problem.shared:
        own = each[0, p:]
        outputs += np.einsum("nms,s->nm", normal.shared, own)
        turns = np.array(
            [
                rotations.rotation_matrix(own[3 * g : 3 * g + 3]) @ turn
                for g, turn in enumerate(state.turns)
            ]
        ).reshape(-1, 3, 3)
        if problem.level_sd > 0.0:
            tilt = state.tilt + own[-2:]
        after = 3 * problem.groups
        inclination = inclination + own[after : after + problem.cones]
    back = normal.angle_gradient - np.einsum("nmi,nm->ni", normal.weighted, outputs)
    own = np.einsum("nij,nj->ni", normal.inverse, back)
    # Damped like the rest, so that a rejected step shrinks as a whole; a quarter turn at most.
    length = np.sqrt(np.einsum("ni,ni->n", own, own))
    ease = normal.ease / np.repeat(1.0 + np.atleast_1d(damping), n // problem.units)
    own *= np.minimum(ease, 1.5 / (length + 1e-300))[:, None]
    step_of_each = state.step + own
    return replace(
        state,
        theta=state.theta + step[..., :p],
        step=step_of_each,
        turns=turns,
        tilt=tilt,
        inclination=inclination,
    )


def recentred(problem: Problem, state: State) -> State:
    """Return the state with free directions as their own centres, which have no prior."""
    if not problem.unknown.any() and problem.rolls is None:
        return state
    keep = ~problem.unknown[:, None]
    moved = rotations.step_on_sphere(state.centre, state.basis, _steps(problem, state))
    centre = np.where(keep, state.centre, moved) if keep.any() else moved
    found = replace(
        state, centre=centre, basis=rotations.tangent_basis(centre), step=keep * state.step
    )
    return found if problem.rolls is None else put_on_circles(problem, problem.rolls, found, moved)


def _steps(problem: Problem, state: State) -> Array:
    """Return the steps (n, 2) [rad] that lead from the centres to where positions are."""
    if not problem.cones or problem.rolls is None:
        return state.step
    inclined = spread_inclinations(problem.rolls, state.inclination)
    return state.step + inclined[:, None] * [0.0, 1.0]


def _shared_rotation(problem: Problem, state: State) -> Array | None:
    """Return R_k of eq. (3), (n, 3, 3), or None where all are the identity."""
    if not problem.groups and problem.attitude is None:
        return None
    turn = np.tile(np.eye(3), (len(problem.values), 1, 1))
    if problem.attitude is not None:
        tilt = rotations.rotation_matrix(np.array([*state.tilt, 0.0]))
        turn = problem.attitude @ tilt @ problem.attitude.transpose(0, 2, 1)
    member = problem.group >= 0
    if member.any():
        turn[member] = state.turns[problem.group[member]] @ turn[member]
    return turn


def _force_by_step(problem: Problem, state: State) -> Array:
    """Return df/dt (n, 3, 2)."""
    moves = state.basis  # dE/dt where no step was made yet
    steps = _steps(problem, state)
    if steps.any():
        moves = rotations.step_derivative(state.centre, state.basis, steps)
    turn = _shared_rotation(problem, state)
    if turn is not None:
        moves = np.einsum("nij,njk->nik", turn, moves)
    return np.asarray(problem.magnitude[:, None, None] * moves)


def _by_shared(
    problem: Problem, state: State, point: Point, by_force: Array, moves: Array
) -> Array:
    """Return dh/d(rho, beta, tau) (n, M, shared), df = rho x f.

    The slope by the inclination of an axis is that by the second angle of a roll, in `moves`.
    """
    n, m = problem.values.shape
    result = np.zeros((n, m, problem.shared))
    if not problem.shared:
        return result
    by_turn = -by_force @ rotations.cross_matrix(point.force)
    for g in range(problem.groups):
        member = problem.group == g
        result[member, :, 3 * g : 3 * g + 3] = by_turn[member]
    for cone in range(problem.cones):
        assert problem.rolls is not None
        member = problem.rolls.cone == cone
        result[member, :, 3 * problem.groups + cone] = moves[member, :, 1]
    if problem.attitude is not None:
        turned = problem.attitude.copy()
        member = problem.group >= 0
        turned[member] = state.turns[problem.group[member]] @ turned[member]
        level = rotations.left_jacobian(np.array([*state.tilt, 0.0]))[:, :2]
        result[:, :, -2:] = by_turn @ turned @ level
    return result


def weigh(precision: Array, array: Array) -> Array:
    """Return Sigma^-1 times (n, M) or (n, M, c)."""
    if precision.ndim == 2:
        return precision * array if array.ndim == 2 else precision[:, :, None] * array
    if array.ndim == 2:
        return np.asarray(np.einsum("nij,nj->ni", precision, array))
    return np.asarray(np.einsum("nij,njk->nik", precision, array))


def full(precision: Array) -> Array:
    """Return precisions (n, M, M) of variances that are given as (n, M)."""
    if precision.ndim == 3:
        return precision
    n, m = precision.shape
    full = np.zeros((m, m, n))
    full[np.arange(m), np.arange(m)] = precision.T
    return full.transpose(2, 0, 1)


class Eliminated(NamedTuple):
    """Weights of a position with its own angles t_k eliminated, eq. (5)."""

    gain: Array  # Sigma^-1 J H^-1, (n, M, 2)
    inverse: Array  # H^-1, (n, 2, 2)
    marginal: Array  # W, (n, M, M)


def eliminate(
    precision: Array, jacobian: Array, weighted: Array, prior: Array, exact: Mask, rolled: Mask
) -> Eliminated:
    """Eliminate the angles t_k, in the axes that diagonalise J' Sigma^-1 J.

    There H is diagonal. In other axes W would be a difference of numbers that are (s/sigma)² larger
    where noise is small against orientation errors. Nothing is eliminated where a position is
    exact, nor where H is singular.

    Parameters
    ----------
    precision : (n, M, M) array
    jacobian, weighted : (n, M, 2) arrays
        J and Sigma^-1 J.
    prior : (n,) array
        1/s².
    exact : (n,) array of bool
    rolled : (n,) array of bool
        Rolls of open angle, eliminated by `multipos.estimation.problem`.
    """
    if exact.all():
        return Eliminated(np.zeros(jacobian.shape), np.zeros((len(exact), 2, 2)), precision)
    first, second = jacobian[:, :, 0], jacobian[:, :, 1]
    one, two = weighted[:, :, 0], weighted[:, :, 1]
    a, d = _dot(first, one), _dot(second, two)
    angle = np.arctan2(2.0 * _dot(first, two), a - d) / 2.0
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along, across = c * one + s * two, c * two - s * one
    large = _dot(c * first + s * second, along) + prior
    small = np.maximum(_dot(c * second - s * first, across), 0.0) + prior
    with np.errstate(over="ignore"):  # where slopes are beyond any sensor's, H is not taken
        sound = (large * small > 1e-28 * (a + prior) * (d + prior)) & ~exact & ~rolled
    by_large = (sound / np.where(sound, large, 1.0))[:, None]
    by_small = (sound / np.where(sound, small, 1.0))[:, None]
    n, m = one.shape
    marginal = np.asarray(
        precision
        - (by_large * along)[:, :, None] * along[:, None, :]
        - (by_small * across)[:, :, None] * across[:, None, :],
        dtype=np.float64,
    )
    gain = np.empty((m, 2, n)).transpose(2, 0, 1)
    gain[:, :, 0] = by_large * c * along - by_small * s * across
    gain[:, :, 1] = by_large * s * along + by_small * c * across
    inverse = np.empty((2, 2, n)).transpose(2, 0, 1)
    inverse[:, 0, 0] = (by_large * c * c + by_small * s * s)[:, 0]
    inverse[:, 1, 1] = (by_large * s * s + by_small * c * c)[:, 0]
    inverse[:, 0, 1] = inverse[:, 1, 0] = ((by_large - by_small) * c * s)[:, 0]
    if rolled.any():
        tied = np.where(prior[rolled] > 0.0, prior[rolled], 1.0)
        free = eliminate_free(precision[rolled], jacobian[rolled], weighted[rolled], tied)
        gain[rolled], inverse[rolled], marginal[rolled] = free
    return Eliminated(gain, inverse, marginal)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("nm,nm->n", a, b))

"""Directions on a circle about a case axis: what rolls of open angle need of the likelihood.

With a the axis, a direction of latitude lambda = asin(u·a) stands over the point c of the circle,
u = cos(lambda) c + sin(lambda) a. Of the two angles t of `multipos.estimation.likelihood` the first
then runs along the circle and is free, the second leads towards a: it is tied to the inclination
beta of the axis by the sd of the position,

    u = E(c, (t_1, beta + t_2)),        t_1 free,    t_2 ~ N(0, s²),                         (1)

and held at zero where s is. beta is 0, or an unknown that the rolls of a group share, whose slopes
are those of t_2. With J = (J_1, J_2), both eliminated one after the other, c = J_2' Sigma^-1 J_1,

    W_1 = Sigma^-1 − Sigma^-1 J_1 J_1' Sigma^-1 / h_1,          h_1 = J_1' Sigma^-1 J_1,
    W = W_1 − W_1 J_2 J_2' W_1 / h_2,                           h_2 = J_2' W_1 J_2 + 1/s²,     (2)
    H^-1 = ((1/h_1 + c²/(h_1² h_2), −c/(h_1 h_2)), (−c/(h_1 h_2), 1/h_2)).
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.rotations import align, directions
from multipos.numerics.terms import COMPONENTS
from multipos.positions.orientations import OpenRolls, across

_DETERMINED = 0.02  # of the mean square: rolls that spread less about a circle do not tell its axis
_WEAK = 1e-3  # weight of the case as it stands, beside what ties it
_FAINT = 1e-24  # of the largest, below which a turn moves nothing


def over_circle(direction: Array, axis: Array) -> tuple[Array, Array]:
    """Return the points of the circles (n, 3) below directions (n, 3), and latitudes (n,) [rad]."""
    height = np.einsum("ni,ni->n", direction, axis)
    foot = direction - height[:, None] * axis
    along = np.linalg.norm(foot, axis=1)[:, None] > 0.0
    foot = np.where(along, foot, across(axis))  # over the axis itself
    return directions(foot), np.arcsin(np.clip(height, -1.0, 1.0))


def circle_basis(direction: Array, axis: Array) -> Array:
    """Return the basis (n, 3, 2) along the circle through each direction, and towards its axis."""
    along = directions(np.cross(axis, direction))
    return np.stack([along, np.cross(direction, along)], axis=2)


def mean_latitudes(rolls: OpenRolls, latitude: Array) -> Array:
    """Return the inclination (C,) [rad] of each group's axis, from the latitudes (n,) of all."""
    return np.array([latitude[rolls.cone == g].mean() for g in range(rolls.cones)])


def spread_inclinations(rolls: OpenRolls, inclination: Array) -> Array:
    """Return the inclination (n,) [rad] of each position's axis, 0 where it is level."""
    return np.append(inclination, 0.0)[rolls.cone]


def eliminate_free(
    precision: Array, jacobian: Array, weighted: Array, prior: Array
) -> tuple[Array, Array, Array, Array]:
    """Eliminate both angles by eq. (2), of which the first has no prior.

    Parameters
    ----------
    precision : (n, M, M) array
    jacobian, weighted : (n, M, 2) arrays
        J and Sigma^-1 J; the second column of J is zero where that angle is held.
    prior : (n,) array
        1/s² of the second angle, above 0 where it is held.

    Returns
    -------
    (gain, inverse, marginal, determinant)
        As in `multipos.estimation.likelihood.Eliminated`.
    """
    one, two = weighted[:, :, 0], weighted[:, :, 1]
    first = np.einsum("nm,nm->n", jacobian[:, :, 0], one)
    seen = first > _FAINT * np.einsum("nmi,nmi->n", jacobian, weighted)
    by_first = seen / np.where(seen, first, 1.0)
    both = np.einsum("nm,nm->n", jacobian[:, :, 1], one) * by_first
    left = two - both[:, None] * one
    by_second = 1.0 / (np.einsum("nm,nm->n", jacobian[:, :, 1], left) + prior)
    marginal = precision - by_first[:, None, None] * one[:, :, None] * one[:, None, :]
    marginal -= by_second[:, None, None] * left[:, :, None] * left[:, None, :]
    inverse = np.empty((len(first), 2, 2))
    inverse[:, 0, 0] = by_first + both**2 * by_second
    inverse[:, 0, 1] = inverse[:, 1, 0] = -both * by_second
    inverse[:, 1, 1] = by_second
    determinant = np.where(seen, first, 0.0) / by_second
    return weighted @ inverse, inverse, np.asarray(marginal), determinant


def turn_to_axes(
    rolls: OpenRolls, direction: Array, listed: NDArray[np.bool_], reference: Array
) -> Array:
    """Return the rotation or reflection (3, 3) that brings rolls and listed directions home.

    The plane of the rolls about an axis says where that axis is, but for its sense; where nothing
    is listed, that of the axis as it stands is kept.

    Parameters
    ----------
    direction : (n, 3) array
        In a frame that is free to turn.
    listed : (n,) array of bool
        Rows whose direction is known to be along `reference` (n, 3).
    """
    sources, targets = _planes(rolls, direction)
    known = directions(reference[listed])
    adrift = not listed.any()
    mirrors = (1.0,) if adrift else (1.0, -1.0)
    senses = [(1.0,) * len(sources)] if adrift else list(product((1.0, -1.0), repeat=len(sources)))
    goal = np.concatenate([known, targets, _WEAK * np.eye(3)])
    best, least = np.eye(3), np.inf
    for mirror, sense in product(mirrors, senses):
        signed = np.array(sense)[:, None] * sources
        source = np.concatenate([mirror * direction[listed], signed, _WEAK * np.eye(3)])
        turn = align(source, goal)
        misfit = float(np.sum((source @ turn.T - goal) ** 2))
        if misfit < least:
            best, least = mirror * turn, misfit
    return best


def _planes(rolls: OpenRolls, direction: Array) -> tuple[Array, Array]:
    """Return the normals of the rolls about each axis that they determine (k, 3), and the axes."""
    normals, axes = [], []
    for name in rolls.axes:
        axis = np.eye(3)[COMPONENTS.index(name)]
        rows = rolls.rows & (rolls.vectors @ axis > 0.0)
        within = direction[rows]
        for cone in set(rolls.cone[rows].tolist()) - {-1}:
            mine = rolls.cone[rows] == cone
            within[mine] -= within[mine].mean(axis=0)
        sizes, vectors = np.linalg.eigh(within.T @ within / len(within))
        if sizes[1] > _DETERMINED:
            normal = vectors[:, 0]
            normals.append(normal * (np.sign(normal @ axis) or 1.0))
            axes.append(axis)
    return np.array(normals).reshape(-1, 3), np.array(axes).reshape(-1, 3)


def turn_about(axis: str, matrix: Array) -> Array:
    """Return the rotation (3, 3) about an axis that zeroes what a gauge has as zero.

    `matrix` (3, 3) holds the slopes of the outputs on x, y and z; of the two axes beside `axis`
    the output on the first then does not sense the second.
    """
    p, q = (i for i, name in enumerate(COMPONENTS) if name != axis)
    size = float(np.hypot(matrix[p, p], matrix[p, q]))
    turn = np.eye(3)
    if size > 0.0:
        c, s = matrix[p, p] / size, matrix[p, q] / size
        turn[p, p] = turn[q, q] = c
        turn[p, q], turn[q, p] = s, -s
    return turn

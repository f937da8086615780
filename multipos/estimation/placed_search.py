"""The search for parameters and positions of many units at uncertain orientations, all at once.

Every unit has the problem of `multipos.estimation.likelihood` at positions that all of them share,

    F = Σ_k r_k'Σ_k⁻¹r_k + |t_k|²/s_k²,     r_k = y_k − h(theta, ±g E(u_k, t_k)),           (1)

and takes the steps of its eqs. (5) and (6) from the listed directions, undamped: positions that are
off by little bend F by little, and each step leaves a small share of the one before. A unit has
come to its end when a step takes less than 10⁻¹⁶ off F; one that has not in a few steps is left to
the search of `multipos.estimation.descent`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import force_slopes, model_coefficients
from multipos.estimation.likelihood import eliminate
from multipos.numerics.arrays import Array
from multipos.numerics.rotations import (
    directions,
    step_derivative,
    step_on_sphere,
    tangent_basis,
)
from multipos.sensor.model import Model

_ITERATIONS = 15
_DECREMENT = 1e-16  # of F
_OUTPUTS = 3


class Positions(NamedTuple):
    """What is listed of the positions.

    Attributes
    ----------
    reference : (n, 3) array [g]
    environment : mapping of str to (n,) array
    """

    reference: Array
    environment: Mapping[str, Array]


class Place(NamedTuple):
    """Units (B) at a point of their search."""

    theta: Array  # (B, p)
    step: Array  # t, (B, n, 2) [rad]
    force: Array  # (B, n, 3) [g]
    design: Array  # A, (B, n, 3, p)
    residuals: Array  # (B, n, 3)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        return Place(*(each[units] for each in self))

    def put(self, units: NDArray[np.intp], other: "Place") -> None:
        """Put other units in places of these."""
        for mine, new in zip(self, other, strict=True):
            mine[units] = new


class Noise(NamedTuple):
    """What the search takes as known of B units."""

    variance: Array  # of the readings, (B, n, 3)
    orientation_sd: Array  # (B, n) [rad]

    def of(self, units: NDArray[Any]) -> "Noise":
        """Return some of the units."""
        return Noise(*(each[units] for each in self))

    def put(self, units: NDArray[np.intp], other: "Noise") -> None:
        """Put what is known of other units in places of these."""
        for mine, new in zip(self, other, strict=True):
            mine[units] = new


def place_at(model: Model, listed: Positions, values: Array, theta: Array, step: Array) -> Place:
    """Return units at parameters (B, p) and steps (B, n, 2)."""
    count, n, _ = values.shape
    centre, basis, size = _centres(listed, count)
    force = size * step_on_sphere(centre, basis, step.reshape(-1, 2))
    columns = {name: np.tile(column, count) for name, column in listed.environment.items()}
    phi = model.basis(force, columns).reshape(count, n, -1)
    design = np.zeros((count, n, _OUTPUTS, theta.shape[1]))
    for output, (part, own) in enumerate(zip(model.slices, model.columns, strict=True)):
        design[:, :, output, part] = phi[:, :, own]
    residuals = values - phi @ model_coefficients(model, theta).transpose(0, 2, 1)
    return Place(theta, step, force.reshape(count, n, 3), design, residuals)


def turns(model: Model, listed: Positions, place: Place) -> Array:
    """Return what a turn of each position does to its reading, J (B, n, 3, 2)."""
    count, n, _ = place.force.shape
    centre, basis, size = _centres(listed, count)
    moves = size[:, :, None] * step_derivative(centre, basis, place.step.reshape(-1, 2))
    force = np.ascontiguousarray(place.force.transpose(2, 0, 1))
    slopes = force_slopes(model, listed.environment, place.theta, force)
    by_force = slopes.reshape(_OUTPUTS, 3, -1).transpose(2, 0, 1)
    return (by_force @ moves).reshape(count, n, _OUTPUTS, 2)


def objective(place: Place, noise: Noise) -> Array:
    """Return F (B,) of eq. (1)."""
    return np.asarray(misfits(place, noise).sum(axis=1))


def misfits(place: Place, noise: Noise) -> Array:
    """Return what each position adds to F, (B, n)."""
    squares = np.einsum("bni,bni->bn", place.residuals**2, 1.0 / noise.variance)
    off = np.einsum("bni,bni->bn", place.step, place.step)
    return np.asarray(squares + off * _prior(noise))


def search(
    model: Model, listed: Positions, values: Array, place: Place, noise: Noise
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where every unit's search ends, and of which units it does.

    Parameters
    ----------
    model : Model
    listed : Positions
    values : (B, n, 3) array
    place : Place
        Where it begins.
    noise : Noise
    """
    place = Place(*(each.copy() for each in place))
    ended = np.zeros(len(values), dtype=np.bool_)
    units = np.flatnonzero(np.isfinite(objective(place, noise)))
    for _ in range(_ITERATIONS):
        if not len(units):
            break
        here, known = place.of(units), noise.of(units)
        following, decrement = _moved(model, listed, values[units], here, known)
        place.put(units, following)
        enough = decrement <= _DECREMENT * objective(following, known)
        ended[units] = enough
        units = units[~enough & np.isfinite(decrement)]
    return place, ended


def information_of(model: Model, listed: Positions, place: Place, noise: Noise) -> Array:
    """Return the information S (B, p, p) of the parameters, positions eliminated."""
    return _equations(model, listed, place, noise).information


class _Equations(NamedTuple):
    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    pull: Array  # (B n, 2)
    weighted: Array  # Σ⁻¹J, (B n, 3, 2)
    inverse: Array  # H⁻¹, (B n, 2, 2)


def _equations(model: Model, listed: Positions, place: Place, noise: Noise) -> _Equations:
    count, p = place.theta.shape
    J = turns(model, listed, place).reshape(-1, _OUTPUTS, 2)
    precision = (1.0 / noise.variance).reshape(-1, _OUTPUTS)
    weighted = precision[:, :, None] * J
    prior = _prior(noise).ravel()
    sd = noise.orientation_sd.ravel()
    own = eliminate(
        precision[:, :, None] * np.eye(_OUTPUTS),
        J,
        weighted,
        prior,
        sd == 0.0,
        np.zeros(len(sd), dtype=np.bool_),
    )
    r = place.residuals.reshape(-1, _OUTPUTS)
    pull = np.einsum("nmi,nm->ni", weighted, r) - prior[:, None] * place.step.reshape(-1, 2)
    push = precision * r - np.einsum("nmi,ni->nm", own.gain, pull)
    A = place.design.reshape(-1, _OUTPUTS, p)
    WA = (own.marginal @ A).reshape(count, -1, p)
    At = place.design.reshape(count, -1, p).transpose(0, 2, 1)
    gradient = (At @ push.reshape(count, -1, 1))[:, :, 0]
    return _Equations(At @ WA, gradient, pull, weighted, own.inverse)


def _moved(
    model: Model, listed: Positions, values: Array, place: Place, noise: Noise
) -> tuple[Place, Array]:
    """Return places after a step, and what it should take off F (B,)."""
    count, n, _ = values.shape
    found = _equations(model, listed, place, noise)
    scale = np.sqrt(np.einsum("bpp->bp", found.information))
    relative = found.information / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(relative).all(axis=(1, 2))
    relative[~sound] = np.eye(relative.shape[1])  # its step is none
    move = np.linalg.solve(relative, (found.gradient / scale)[:, :, None])[:, :, 0] / scale
    move[~sound] = np.nan
    follows = (place.design.reshape(count, -1, move.shape[1]) @ move[:, :, None]).reshape(-1, 3)
    back = found.pull - np.einsum("nmi,nm->ni", found.weighted, follows)
    own = np.einsum("nij,nj->ni", found.inverse, back).reshape(count, n, 2)
    decrement = np.einsum("bp,bp->b", move, found.gradient)
    theta, step = place.theta + move, place.step + own
    return place_at(model, listed, values, theta, step), decrement


def _prior(noise: Noise) -> Array:
    """Return 1/s² (B, n); exact positions get 0 here, as nothing of theirs is a step."""
    sd = noise.orientation_sd
    return np.where(sd > 0.0, 1.0 / np.where(sd > 0.0, sd, 1.0) ** 2, 0.0)


def _centres(listed: Positions, count: int) -> tuple[Array, Array, Array]:
    """Return the listed directions (B n, 3), bases (B n, 3, 2) and sizes (B n, 1) [g]."""
    centre = directions(listed.reference)
    size = np.linalg.norm(listed.reference, axis=1)[:, None]
    whole = (count, 1)
    return (
        np.tile(centre, whole),
        np.tile(tangent_basis(centre), (*whole, 1)),
        np.tile(size, whole),
    )

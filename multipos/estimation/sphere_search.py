"""The search for unknown orientations of many units: `multipos.estimation.sphere`, all at once.

Every unit has a problem of its own, with its own directions, so that nothing but the form of the
equations is shared. With the residuals r = y − h(f), of variances Σ, G = dh/df and the normal m of
the surface that the readings of all directions form,

    m = n/√(n'Σn),  n = det(G) G⁻ᵀ f,    a = A'm,    S = Σ a a',    S d = Σ a m'r,           (1)
    df = G⁻¹ (x − Σ m m'x),    x = r − A d,    f'df = 0,                                    (2)

of which a unit takes damped steps until the next one would take less than 10⁻¹⁶ off F = Σ r'Σ⁻¹r,
and is then left out of what follows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import force_slopes, model_coefficients
from multipos.numerics.arrays import Array
from multipos.numerics.cofactors import cofactors_of
from multipos.sensor.model import Model

_ITERATIONS = 60
_DAMPING = 1e-4
_DECREMENT = 1e-16  # of F, by the next step
_LAST_STEPS = 2  # whatever F says, whose last digits are the rounding of the readings
_FLAT = 1e-15  # of F, below which a step is lost in the rounding of F
_XTOL = 1e-13  # relative step that is only rounding
_STUCK = 1e12  # damping beyond which nothing moves


@dataclass(frozen=True, eq=False)
class SharedSphere:
    """What units of unknown orientation share.

    Attributes
    ----------
    model : Model
        With its gauge.
    size : float [g]
        Of the reference.
    environment : mapping of str to (n,) array
        Other columns of the model.
    """

    model: Model
    size: float
    environment: Mapping[str, Array]


class Place(NamedTuple):
    """Units (B) at a point of their search; positions run fastest in memory."""

    theta: Array  # (B, p)
    force: Array  # (3, B, n) [g]
    phi: Array  # (T, B, n)
    residuals: Array  # (3, B, n)
    objective: Array  # (B,)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        return Place(
            self.theta[units],
            self.force[:, units],
            self.phi[:, units],
            self.residuals[:, units],
            self.objective[units],
        )

    def put(self, units: NDArray[np.intp], other: "Place") -> None:
        """Put other units in places of these."""
        self.theta[units] = other.theta
        self.force[:, units] = other.force
        self.phi[:, units] = other.phi
        self.residuals[:, units] = other.residuals
        self.objective[units] = other.objective


class Surface(NamedTuple):
    """The normal equations, eq. (1)."""

    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    rows: Array  # a, (B, p, n)
    height: Array  # m'r, (B, n)
    cofactors: Array  # (3, 3, B, n), of G
    determinant: Array  # (B, n)
    normal: Array  # m, (3, B, n)
    across: Array  # Σm, (3, B, n)
    excess: Array  # (B, n), how far outside a reading lies, relative to the force


def place_at(
    shared: SharedSphere, values: Array, variance: Array, theta: Array, force: Array
) -> Place:
    """Return units at parameters (B, p) and forces (3, B, n); variances are (3, B, n)."""
    model = shared.model
    _, count, n = force.shape
    columns = {name: np.tile(column, count) for name, column in shared.environment.items()}
    phi = model.basis(force.reshape(3, -1).T, columns).T.reshape(-1, count, n)
    residuals = values - np.einsum("bmt,tbn->mbn", model_coefficients(model, theta), phi)
    return Place(theta, force, phi, residuals, _objective(residuals, variance))


def _objective(residuals: Array, variance: Array) -> Array:
    return np.asarray(np.einsum("mbn,mbn->b", residuals, residuals / variance))


def linearise(shared: SharedSphere, place: Place, variance: Array) -> Surface:
    """Return the normal equations, eq. (1)."""
    G = force_slopes(shared.model, shared.environment, place.theta, place.force)
    cofactors = cofactors_of(G)
    determinant = np.einsum("ibn,ibn->bn", G[0], cofactors[0])
    normal = np.einsum("mibn,ibn->mbn", cofactors, place.force)
    across = variance * normal
    height = np.einsum("mbn,mbn->bn", normal, place.residuals)
    excess = height / (determinant * shared.size**2)
    root = 1.0 / np.sqrt(np.einsum("mbn,mbn->bn", normal, across))
    normal *= root
    across *= root
    height *= root
    outputs, columns, copies = shared.model.rows
    rows = normal.take(outputs, axis=0) * place.phi.take(columns, axis=0)
    for parameter, output, column in copies:
        rows[parameter] += normal[output] * place.phi[column]
    rows = np.ascontiguousarray(rows.transpose(1, 0, 2))
    return Surface(
        rows @ rows.transpose(0, 2, 1),
        (rows @ height[:, :, None])[:, :, 0],
        rows,
        height,
        cofactors,
        determinant,
        normal,
        across,
        excess,
    )


def search(
    shared: SharedSphere, values: Array, variance: Array, place: Place
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where every unit's search ends, and of which units it does.

    Parameters
    ----------
    shared : SharedSphere
    values, variance : (3, B, n) arrays
    place : Place
        Where it begins, whatever the variances were there.
    """
    place = place._replace(objective=_objective(place.residuals, variance))
    place, ended = _descend(shared, values, variance, place)
    for _ in range(_LAST_STEPS):
        surface = linearise(shared, place, variance)
        none = np.zeros(len(place.theta))
        move = _step(place.theta, surface, none)[0]
        place = _moved(shared, values, variance, place, surface, move, none)
    return place, ended


def _moved(
    shared: SharedSphere,
    values: Array,
    variance: Array,
    place: Place,
    surface: Surface,
    move: Array,
    by: Array,
) -> Place:
    """Return places after steps (B, p) of the parameters, damped by (B,), eq. (2)."""
    change = model_coefficients(shared.model, move)
    left = place.residuals - np.einsum("bmt,tbn->mbn", change, place.phi)
    left -= surface.across * np.einsum("mbn,mbn->bn", surface.normal, left)
    turn = np.einsum("mibn,mbn->ibn", surface.cofactors, left) / surface.determinant
    ease = (1.0 + by[:, None]) * (1.0 + np.maximum(surface.excess, 0.0))
    force = place.force + turn / ease
    force *= shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force))
    return place_at(shared, values, variance, place.theta + move, force)


def _descend(
    shared: SharedSphere, values: Array, variance: Array, place: Place
) -> tuple[Place, NDArray[np.bool_]]:
    """Return where the steps of every unit end, and of which units they do; `place` follows.

    A step that is not taken is tried again with ten times the damping.
    """
    count = len(place.theta)
    ended = np.zeros(count, dtype=np.bool_)
    damping, before = np.full(count, _DAMPING), np.full(count, np.inf)
    units = np.flatnonzero(np.isfinite(place.objective))
    for _ in range(_ITERATIONS):
        if not len(units):
            break
        here, known = place.of(units), variance[:, units]
        surface = linearise(shared, here, known)
        move, decrement, relative = _step(here.theta, surface, damping[units])
        trial = _moved(shared, values[:, units], known, here, surface, move, damping[units])
        taken = trial.objective <= here.objective
        place.put(units[taken], trial.of(taken))
        flat = ~taken & (decrement <= _FLAT * here.objective)
        shrink = np.minimum(np.where(np.isinf(before[units]), 1.0, decrement / before[units]), 1.0)
        enough = (decrement * shrink <= _DECREMENT * trial.objective) | (relative <= _XTOL)
        ended[units] = flat | (taken & enough)
        before[units] = np.where(taken, decrement, before[units])
        damping[units] *= np.where(taken, 0.1, 10.0)
        units = units[~ended[units] & (damping[units] <= _STUCK)]
    return place, ended


def _step(theta: Array, surface: Surface, damping: Array) -> tuple[Array, Array, Array]:
    """Return damped steps (B, p), what each should take off F, and its size relative to theta."""
    information = surface.information
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scale = np.where(scale > 0.0, scale, 1.0)
    damped = information / (scale[:, :, None] * scale[:, None, :])
    places = np.arange(scale.shape[1])
    damped[:, places, places] += np.maximum(damping, 1e-15)[:, None]
    damped[~np.isfinite(damped).all(axis=(1, 2))] = np.eye(len(places))
    scaled = np.linalg.solve(damped, (surface.gradient / scale)[:, :, None])[:, :, 0]
    move = scaled / scale
    size = np.maximum(np.abs(theta * scale).max(axis=1), 1e-300)
    decrement = np.einsum("bp,bp->b", move, surface.gradient)
    return move, decrement, np.abs(scaled).max(axis=1) / size

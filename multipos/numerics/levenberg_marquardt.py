"""Levenberg and Marquardt's search for the least sum of squares, of B problems at once.

From the normal equations S d = g at a point, the step d is solved for with the diagonal of S,
scaled to one, raised by the damping. It is taken if the objective F falls, and tried again with ten
times the damping if not. A step should take g'd off F, its decrement. A search has converged when
the decrement of the *next* step, judged by how the last two shrank, is below 1e-16 F: a step of
1e-8 standard uncertainties or less. A problem that has ended is left out of what follows, so that
it takes the same steps alone and among others; a single problem is a batch of one.

References
----------
K. Levenberg 1944; D. Marquardt 1963.
"""

from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array, Places

_XTOL = 1e-13  # relative step that is only rounding
_STUCK = 1e12  # damping beyond which nothing moves
_FLAT = 1e-15  # of F, below which a step is lost in the rounding of F
_SMALL = 1e-6  # of the parameters: no step into what the data do not determine is as short
_LAST_STEPS = 2
_NO_RISE = 1e-12  # of F: what its rounding may do at least, in which an undamped step is lost
_DIGITS = 8.0 * np.finfo(float).eps  # of a reading, which its residual may be off
_ROUNDING = 1e-8  # of F, or of the parameters: what the last digits of the readings can do


class Place(Protocol):
    """B problems at a point of their search."""

    @property
    def theta(self) -> Array:
        """Parameters (B, p)."""

    @property
    def objective(self) -> Array:
        """F (B,)."""

    def of(self, units: NDArray[Any], /) -> Self:
        """Return some of the problems."""

    def put(self, units: Places, other: Self, /) -> None:
        """Put other problems in places of these."""


class Equations(Protocol):
    """The normal equations at a point."""

    @property
    def information(self) -> Array:
        """S (B, P, P), of the p parameters and other unknowns."""

    @property
    def gradient(self) -> Array:
        """g (B, P)."""


PlaceT = TypeVar("PlaceT", bound=Place)
EquationsT = TypeVar("EquationsT", bound=Equations)


class Steps(Protocol[PlaceT, EquationsT]):
    """What a search needs of B problems."""

    def of(self, units: Places, /) -> Self:
        """Return some of the problems."""

    def linearise(self, place: PlaceT, /) -> EquationsT:
        """Return the normal equations."""

    def move(self, place: PlaceT, equations: EquationsT, step: Array, damping: Array, /) -> PlaceT:
        """Return the points after steps (B, P)."""


class Rules(NamedTuple):
    """When a search ends.

    Attributes
    ----------
    iterations : int
        The most.
    decrement : float
        Of F, by the next step, from which on a search has converged.
    weighted : bool
        Weights change with the step, as under a robust loss: small steps add up.
    damping : float
        Of the first step.
    """

    iterations: int = 200
    decrement: float = 1e-16
    weighted: bool = False
    damping: float = 1e-4


# Weights that change with the step make convergence linear, and slow where few positions are more
# than there are parameters.
ROBUST = Rules(iterations=2000, decrement=1e-14, weighted=True)


class Ended(NamedTuple):
    """How B searches ended."""

    converged: NDArray[np.bool_]
    iterations: Places
    last_step: Array  # relative
    gradient: Array  # root of the last decrement


def descend(
    steps: Steps[PlaceT, EquationsT],
    place: PlaceT,
    rules: Rules,
    largest: Array,
    held: tuple[int, ...] = (),
) -> tuple[PlaceT, Ended]:
    """Return where searches end, and how.

    Parameters
    ----------
    steps : Steps
    place : Place
        Where they begin; it may be written to.
    rules : Rules
    largest : (B,) array
        The largest reading in units of its noise, whose rounding is that of F.
    held : tuple of int
        Parameters that stay where they are.
    """
    count = len(place.theta)
    damping, decrement = np.full(count, rules.damping), np.full(count, np.inf)
    last_step, before = np.full((2, count), np.inf)
    converged, refused, stuck = np.zeros((3, count), dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.intp)
    going = np.flatnonzero(np.isfinite(place.objective))
    equations = None
    while len(going):
        some = len(going) < count
        mine = steps.of(going) if some else steps
        here = place.of(going) if some else place
        if equations is None:
            equations = mine.linearise(here)
        F = here.objective
        step, fall, relative = _step(here.theta, equations, damping[going], held)
        trial = mine.move(here, equations, step, damping[going])
        taken = trial.objective <= F
        flat = np.zeros_like(taken)
        if not taken.all():
            flat = ~taken & (fall <= _FLAT * F)
            if not rules.weighted:
                whole = _step(here.theta, equations, np.zeros(len(going)), held)[1]
                flat |= ~taken & (whole <= _rise(largest[going], F))
        decrement[going], last_step[going] = fall, relative
        shrinks = np.where(np.isinf(before[going]), 1.0, fall / before[going])
        following = fall * np.fmin(shrinks, 1.0)
        enough = (following <= rules.decrement * trial.objective) | (relative <= _XTOL)
        converged[going] = taken & enough
        before[going] = np.where(taken, fall, before[going])
        refused[going] |= ~taken
        damping[going] = np.where(
            taken, 0.1 * damping[going], np.maximum(10.0 * damping[going], 1e-10)
        )
        over = flat | (damping[going] > _STUCK)
        stuck[going] = over
        iterations[going] += taken | over
        if taken.all():
            place = _put(place, going, trial, some=some)
        elif taken.any():
            place.put(going[taken], trial.of(taken))
        on = ~converged[going] & ~over & (iterations[going] < rules.iterations)
        if taken.any() or not on.all():
            equations = None
        going = going[on]
    if stuck.any():
        _test_stuck(steps, place, np.flatnonzero(stuck), held, (converged, decrement, last_step))
    settling = np.flatnonzero(converged & refused & (last_step <= _SMALL))
    if len(settling):
        place = _settled(steps, place, settling, largest, held)
    return place, Ended(converged, iterations, last_step, np.sqrt(np.maximum(decrement, 0.0)))


def _put(place: PlaceT, units: Places, other: PlaceT, *, some: bool) -> PlaceT:
    """Return the points with some of them put in place, or all."""
    if not some:
        return other
    place.put(units, other)
    return place


def _test_stuck(
    steps: Steps[PlaceT, EquationsT],
    place: PlaceT,
    units: Places,
    held: tuple[int, ...],
    found: tuple[NDArray[np.bool_], Array, Array],
) -> None:
    """Tell rounding from a point that is no minimum, where no descent is left."""
    converged, decrement, last_step = found
    here = place.of(units)
    equations = steps.of(units).linearise(here)
    _, fall, relative = _step(here.theta, equations, np.zeros(len(units)), held)
    converged[units] = (fall <= _ROUNDING * here.objective) | (relative <= _ROUNDING)
    decrement[units], last_step[units] = fall, relative


def _settled(
    steps: Steps[PlaceT, EquationsT],
    place: PlaceT,
    units: Places,
    largest: Array,
    held: tuple[int, ...],
) -> PlaceT:
    """Return the points where the slope of F vanishes, of which F itself has half the digits."""
    for _ in range(_LAST_STEPS):
        mine, here = steps.of(units), place.of(units)
        equations, none = mine.linearise(here), np.zeros(len(units))
        trial = mine.move(here, equations, _step(here.theta, equations, none, held)[0], none)
        # elsewhere a step into what nothing determines, as of a parameter at its bound
        taken = trial.objective <= here.objective + _rise(largest[units], here.objective)
        place.put(units[taken], trial.of(taken))
        units = units[taken]
        if not len(units):
            break
    return place


def _rise(largest: Array, objective: Array) -> Array:
    """Return how far F may rise by rounding."""
    return np.asarray(np.maximum(_NO_RISE * objective, _DIGITS * largest * np.sqrt(objective)))


def _step(
    theta: Array, equations: Equations, damping: Array, held: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Return damped steps (B, P), what each should take off F, and its size relative to theta."""
    information, gradient = equations.information, equations.gradient
    if held:  # no step along these, and the others as if these had no columns
        information, gradient = information.copy(), gradient.copy()
        fixed = list(held)
        information[:, fixed, :] = information[:, :, fixed] = 0.0
        information[:, fixed, fixed], gradient[:, fixed] = 1.0, 0.0
    scale = np.sqrt(np.einsum("bpp->bp", information))
    if not scale.all():
        scale = np.where(scale > 0.0, scale, 1.0)
    P = scale.shape[1]
    damped = information / (scale[:, :, None] * scale[:, None, :])
    # A ridge of rounding size, so that what the data do not determine is left where it is.
    damped.reshape(-1, P * P)[:, :: P + 1] += np.maximum(damping, 1e-15)[:, None]
    whole = np.isfinite(damped).all(axis=(1, 2))
    if not whole.all():
        damped[~whole] = np.eye(P)
    scaled = np.linalg.solve(damped, (gradient / scale)[:, :, None])[:, :, 0]
    step = scaled / scale
    size = np.abs(theta * scale[:, : theta.shape[1]]).max(axis=1)
    relative = np.abs(scaled).max(axis=1) / np.maximum(size, 1e-300)
    return step, np.einsum("bp,bp->b", step, gradient), relative

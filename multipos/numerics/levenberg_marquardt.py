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

from multipos.numerics.arrays import Array, Mask, Places

STRICT = 1e-16  # of F, by the next step, below which a search has converged
_XTOL = 1e-13  # relative step that is only rounding
_STUCK = 1e12  # damping beyond which nothing moves
_TRIES = 2000  # steps at most, taken or refused: of 700 beside 1 two of three are refused
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
    decrement: float = STRICT
    weighted: bool = False
    damping: float = 1e-4


# Weights that change with the step make convergence linear, and slow where few positions are more
# than there are parameters.
ROBUST = Rules(iterations=2000, decrement=1e-14, weighted=True)


class Ended(NamedTuple):
    """How B searches ended."""

    converged: Mask
    iterations: Places
    last_step: Array  # relative
    gradient: Array  # root of the last decrement

    def put(
        self,
        units: Places,
        which: Mask,
        converged: Mask,
        iterations: Places,
        last_step: Array,
        decrement: Array,
    ) -> None:
        """Put how `which` of some searches ended in the places of `units`."""
        places = units[which]
        self.converged[places], self.iterations[places] = converged[which], iterations[which]
        self.last_step[places] = last_step[which]
        self.gradient[places] = np.sqrt(np.maximum(decrement[which], 0.0))


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
    found, ended = place, _none_ended(count)
    refused = np.zeros(count, dtype=np.bool_)
    units = np.flatnonzero(np.isfinite(place.objective))
    here = place if len(units) == count else place.of(units)
    mine = steps if len(units) == count else steps.of(units)
    going = _Going.begin(len(units), rules)
    equations, tries = None, 0
    while len(units):
        tries += 1
        if equations is None:
            equations = mine.linearise(here)
        F = here.objective
        step, fall, relative = _step(here.theta, equations, going.damping, held)
        trial = mine.move(here, equations, step, going.damping)
        taken = trial.objective <= F
        shrinks = np.where(going.before > 0.0, fall / going.before, 1.0)
        following = fall * np.fmin(shrinks, 1.0)
        over = (following <= rules.decrement * trial.objective) | (relative <= _XTOL)
        if taken.all():
            here, equations, stuck = trial, None, np.zeros_like(taken)
            going = _Going(0.1 * going.damping, fall, going.iterations + 1)
        else:
            over &= taken
            refused[units] |= ~taken
            # no descent is left: rounding, or a point that is no minimum
            _, whole, short = _step(here.theta, equations, np.zeros(len(units)), held)
            flat = fall <= _FLAT * F
            if not rules.weighted:
                flat |= whole <= _rise(largest[units], F)
            going, stuck = going.refused(taken, fall, flat & ~taken)
            over |= stuck & ((whole <= _ROUNDING * F) | (short <= _ROUNDING))
            fall, relative = np.where(stuck, whole, fall), np.where(stuck, short, relative)
            if taken.any():
                here.put(np.flatnonzero(taken), trial.of(taken))
                equations = None
        done = over | stuck | (going.iterations >= rules.iterations) | (tries >= _TRIES)
        if not done.any():
            continue
        ended.put(units, done, over, going.iterations, relative, fall)
        if len(units) == count and done.all():
            found = here
        else:
            found.put(units[done], here.of(done))
        on = np.flatnonzero(~done)
        units, equations, going = units[on], None, going.of(on)
        if len(on):
            here, mine = here.of(on), mine.of(on)
    settling = np.flatnonzero(ended.converged & refused & (ended.last_step <= _SMALL))
    if len(settling):
        _settle(steps, found, settling, largest, held)
    return found, ended


class _Going(NamedTuple):
    """The searches that have not ended."""

    damping: Array
    before: Array  # decrement of the last step that was taken; 0 at first
    iterations: Places

    @classmethod
    def begin(cls, count: int, rules: Rules) -> "_Going":
        """Return searches before their first step."""
        damping = np.full(count, rules.damping)
        return cls(damping, np.zeros(count), np.zeros(count, dtype=np.intp))

    def of(self, units: Places) -> "_Going":
        """Return some of the searches."""
        return _Going(self.damping[units], self.before[units], self.iterations[units])

    def refused(self, taken: Mask, fall: Array, flat: Mask) -> tuple["_Going", Mask]:
        """Return the searches after steps of which some were refused, and which are stuck."""
        damping = np.where(taken, 0.1 * self.damping, np.maximum(10.0 * self.damping, 1e-10))
        stuck = flat | (damping > _STUCK)
        before = np.where(taken, fall, self.before)
        return _Going(damping, before, self.iterations + (taken | stuck)), stuck


def _none_ended(count: int) -> Ended:
    """Return searches of which none has ended."""
    none = np.zeros(count, dtype=np.bool_)
    return Ended(none, np.zeros(count, dtype=np.intp), *np.full((2, count), np.inf))


def _settle(
    steps: Steps[PlaceT, EquationsT],
    place: PlaceT,
    units: Places,
    largest: Array,
    held: tuple[int, ...],
) -> None:
    """Move to where the slope of F vanishes, of which F itself has half the digits."""
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
    scale = np.sqrt(information.diagonal(axis1=1, axis2=2))
    if not scale.all():
        scale = np.where(scale > 0.0, scale, 1.0)
    P = scale.shape[1]
    damped = information / (scale[:, :, None] * scale[:, None, :])
    # A ridge of rounding size, so that what the data do not determine is left where it is.
    damped.reshape(-1, P * P)[:, :: P + 1] += np.maximum(damping, 1e-15)[:, None]
    scaled = np.linalg.solve(damped, (gradient / scale)[:, :, None])[:, :, 0]
    step = scaled / scale
    size = np.abs(theta * scale[:, : theta.shape[1]]).max(axis=1)
    relative = np.abs(scaled).max(axis=1) / np.maximum(size, 1e-300)
    return step, (step * gradient).sum(axis=1), relative

"""Noise and solutions of many units in turn, each unit until its noise settles.

What residuals say of the noise moves the solution, and that the residuals. A unit that has settled
is left out of the turns that follow, so that a few which take long do not hold up the others.
"""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.placed_scatter import ROUNDS
from multipos.estimation.posteriors import Posterior
from multipos.numerics.arrays import Array, Places


class _Units(Protocol):
    """Something of many units (B)."""

    def of(self, units: NDArray[Any], /) -> Self:
        """Return some of the units."""

    def put(self, units: Places, other: Self, /) -> None:
        """Put other units in places of these."""


Place = TypeVar("Place", bound=_Units)
Noise = TypeVar("Noise", bound=_Units)


class Judged(NamedTuple, Generic[Noise]):
    """What a turn finds of the noise of some units, and of which it has settled."""

    posterior: Posterior
    noise: Noise
    settled: NDArray[np.bool_]


class Found(NamedTuple, Generic[Place, Noise]):
    """What was found of B units."""

    place: Place
    noise: Noise
    U: Array  # at 95 %, (B, p)
    dof: Array  # (B,)
    sound: NDArray[np.bool_]


def judge_in_turn(
    place: Place,
    noise: Noise,
    sound: NDArray[np.bool_],
    parameters: int,
    judge: Callable[[Places, Place, Noise], Judged[Noise]],
    search: Callable[[Places, Place, Noise], tuple[Place, NDArray[np.bool_]]],
) -> Found[Place, Noise]:
    """Judge the noise and search on from there, in turn; `place` and `noise` follow.

    Parameters
    ----------
    place : Place
        Where the searches ended under `noise`.
    noise : Noise
    sound : (B,) array of bool
        The units that are asked.
    parameters : int
        p
    judge, search : callables
        Take units, their places and their noise; the one returns what it finds of the noise, the
        other where searches end under it, and of which units they do.
    """
    U, tail = np.full((len(sound), parameters), np.nan), np.full(len(sound), np.nan)
    sound = sound.copy()
    units = np.flatnonzero(sound)
    for turn in range(ROUNDS):
        if not len(units):
            break
        here = place.of(units)
        posterior, known, settled = judge(units, here, noise.of(units))
        noise.put(units, known)
        following, ended = search(units, here, known)
        place.put(units, following)
        sound[units] &= ended
        going = ~settled & ended & (turn < ROUNDS - 1)
        if not going.all():
            U[units], tail[units] = posterior.centred, posterior.shape
        units = units[going]
    return Found(place, noise, U, tail, sound)

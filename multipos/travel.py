"""Travel: an order of positions in which the sensor turns little from one to the next.

A move from u to v turns it by the angle between them at least. The shortest open path through all
positions is a travelling salesman's problem; here a path grows by its nearest neighbour from every
possible beginning, and the best is shortened by reversing stretches (2-opt) and moving positions
until neither helps, which for the few dozen positions of a scheme leaves little to gain.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_BETTER = 1e-9  # [rad]


def travel_deg(up: ArrayLike) -> float:
    """Return the sum of the turns [degrees] between up vectors (n, 3), in their order."""
    vectors = np.asarray(up, dtype=np.float64)
    return float(np.degrees(_angles(vectors[:-1], vectors[1:]).sum()))


def order_positions(up: ArrayLike, start: ArrayLike | None = None) -> Array:
    """Return up vectors (n, 3) in an order that is short to travel.

    Parameters
    ----------
    up : (n, 3) array
    start : (1, 3) or (0, 3) array, optional
        Where the sensor is; otherwise the order begins with the position given first.
    """
    vectors = np.asarray(up, dtype=np.float64)
    here = np.empty((0, 3)) if start is None else np.asarray(start, dtype=np.float64)
    everything = np.concatenate([here, vectors])
    if len(everything) < 3:
        return vectors
    cost = _angles(everything[:, np.newaxis], everything[np.newaxis])
    path = _shorten(cost, _nearest(cost))
    return np.asarray(everything[path][len(here) :])


def _angles(a: Array, b: Array) -> Array:
    # the angle from chord and sum: exact near 0 and near 180 degrees alike
    return np.asarray(
        2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    )


def _nearest(cost: Array) -> list[int]:
    path, left = [0], set(range(1, len(cost)))
    while left:
        last = path[-1]
        # ties go to the position given first
        nearest = min(left, key=lambda i: (round(float(cost[last, i]), 9), i))
        path.append(nearest)
        left.remove(nearest)
    return path


def _shorten(cost: Array, path: list[int]) -> list[int]:
    """Reverse stretches and move single positions while the open path gets shorter."""
    n = len(path)
    improved = True
    while improved:
        improved = False
        for i in range(1, n):
            for j in range(i, n):
                before, within, after = path[:i], path[i : j + 1], path[j + 1 :]
                trials = (within[::-1], [*within[1:], within[0]], [within[-1], *within[:-1]])
                for trial in ([*before, *turned, *after] for turned in trials):
                    if _length(cost, trial) < _length(cost, path) - _BETTER:
                        path, improved = trial, True
    return path


def _length(cost: Array, path: list[int]) -> float:
    return float(cost[path[:-1], path[1:]].sum())

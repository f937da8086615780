"""Travel: an order of positions in which the sensor turns little from one to the next.

A move from u to v turns it by the angle between them at least. The shortest open path through all
positions is a travelling salesman's problem; here paths grow by the nearest neighbour from several
beginnings and are shortened by reversing stretches (2-opt) and moving short ones (Or-opt) until
neither helps, which for the few dozen positions of a scheme leaves little to gain.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from multipos.numerics.arrays import Array

_BETTER = 1e-9  # [rad]
_MOVED = 3  # positions moved together at most
_LONGEST = 50  # positions of a stretch that is looked at as a whole
_STARTS = 10  # paths that are shortened
_FEW = 20  # positions up to which more than one is


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
    cost = _angles(everything[:, np.newaxis], everything[np.newaxis]).tolist()
    paths = (_shorten(cost, path) for path in _beginnings(cost))
    path = min(paths, key=lambda path: round(_length(cost, path), 9))
    return np.asarray(everything[path][len(here) :])


def _angles(a: Array, b: Array) -> Array:
    # the angle from chord and sum: exact near 0 and near 180 degrees alike
    return np.asarray(
        2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    )


def _beginnings(cost: list[list[float]]) -> list[list[int]]:
    """Return paths from position 0 to one of the nearest, then always to the nearest left."""
    n = len(cost)
    second = sorted(range(1, n), key=lambda i: (round(cost[0][i], 9), i))
    paths = []
    for step in second[: _STARTS if n <= _FEW else 1]:
        path, left = [0, step], set(range(1, n)) - {step}
        while left:
            # ties go to the position given first
            _, nearest = min((round(cost[path[-1]][i], 9), i) for i in left)
            path.append(nearest)
            left.remove(nearest)
        paths.append(path)
    return paths


def _shorten(cost: list[list[float]], path: list[int]) -> list[int]:
    """Reverse stretches and move short ones while the open path gets shorter."""
    n = len(path)
    improved = True
    while improved:
        improved = False
        for i in range(1, n):
            for j in range(i + 1, min(i + _LONGEST, n) + 1):
                before, best = path, 0.0
                for parts in _rearranged(i, j):
                    if (gain := _gain(cost, before, i, j, parts)) > best + _BETTER:
                        turned = [before[k] for a, b in parts for k in _between(a, b)]
                        path, best, improved = before[:i] + turned + before[j:], gain, True
    return path


def _rearranged(i: int, j: int) -> list[list[tuple[int, int]]]:
    """Return other orders of the places i to j − 1, as parts from one place to another."""
    first, last = i, j - 1
    orders = [[(last, first)]]
    for k in range(1, min(_MOVED, last - first) + 1):
        head, behind = (first, first + k - 1), (first + k, last)
        ahead, tail = (first, last - k), (last - k + 1, last)
        orders += [[behind, head], [behind, head[::-1]], [tail, ahead], [tail[::-1], ahead]]
    return orders


def _gain(
    cost: list[list[float]], path: list[int], i: int, j: int, parts: list[tuple[int, int]]
) -> float:
    """Return what another order of the places i to j − 1 saves: turns within parts stay."""
    ends = [i - 1, *(place for part in parts for place in part), *([j] if j < len(path) else [])]
    after = sum(cost[path[a]][path[b]] for a, b in zip(ends[::2], ends[1::2], strict=False))
    cuts = [i, j] if j < len(path) else [i]
    if len(parts) == 2:
        cuts.append(max(min(part) for part in parts))
    return sum(cost[path[cut - 1]][path[cut]] for cut in cuts) - after


def _between(a: int, b: int) -> range:
    return range(a, b + 1) if a <= b else range(a, b - 1, -1)


def _length(cost: list[list[float]], path: list[int]) -> float:
    return sum(cost[a][b] for a, b in pairwise(path))

"""The order in which positions are laid out: against drift, short to travel, or as published.

`lay_out` returns the rows of up vectors in an order, `share_absorbed` what a model absorbs of a
course in time in theirs, `travel_order` a short way through them, `travel_deg` how far one turns;
`check_order` refuses an order that is none.

Whatever drifts while positions are measured is read as something about the sensor, as far as the
order lets it. With Q an orthonormal basis of the model's columns less their mean, and c a course in
time of length one and mean zero, the share of the variance of c that the model absorbs is

    a(c) = ‖Q'c‖²,                                                                          (1)

and what is left, 1 − a, shows in the residuals. In order `spread` the largest share of three
courses is as small as exchanges make it: the row number, its square and one period of a sine. It
begins with the rows k·i mod n of every stride k that is coprime to n, and exchanges pairs of rows
while that helps. Below twelve positions the row number counts first. The columns of a named scheme
are those of the linear model, so that it has one order whatever is fitted; a design has its model.

In order `travel` the sensor turns little from one position to the next. A move from u to v turns it
by the angle between them at least. The shortest open path through all positions is a travelling
salesman's problem; here paths grow by the nearest neighbour from several beginnings and are
shortened by reversing stretches (2-opt) and moving short ones (Or-opt) until neither helps, which
for the few dozen positions of a scheme leaves little to gain.

Source: D. R. Cox, Some systematic experimental designs, Biometrika 38, 1951 (orders free of trend).
"""

import math
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import Array, Places

Order = Literal["spread", "travel", "paper"]
ORDERS: tuple[Order, ...] = ("spread", "travel", "paper")
_FLAT = 1e-9  # part of the largest singular value below which columns have no direction more
_LEAST = 1e-7  # share that an exchange must gain: what it does not is left to rounding
_BEGINNINGS = 8  # strides whose order is improved
_EXCHANGED = 200  # positions up to which rows are exchanged; of more, strides alone absorb little
_FIRST = 12  # positions below which the row number counts first
_REST = 0.01  # weight of the other courses there
_BETTER = 1e-9  # [rad]
_MOVED = 3  # positions moved together at most
_LONGEST = 50  # positions of a stretch that is looked at as a whole
_STARTS = 10  # paths that are shortened
_FEW = 20  # positions up to which more than one is


def check_order(order: str) -> None:
    """Refuse what is no order.

    Raises
    ------
    UsageError
    """
    if order not in ORDERS:
        raise UsageError(
            f"--order must be {', '.join(ORDERS[:-1])} or {ORDERS[-1]}, got '{order}'."
        )


def lay_out(up: ArrayLike, order: Order, columns: Array | None = None) -> Places:
    """Return which position is laid out first, second, …, as rows.

    Parameters
    ----------
    up : (n, 3) array
    order : str
    columns : (n, p) array, optional
        Of the model, for 'spread'; those of the linear one where not given.
    """
    vectors = np.nan_to_num(np.asarray(up, dtype=np.float64))
    if order == "spread":
        return _spread(vectors if columns is None else columns)
    if order == "travel":
        return travel_order(vectors)
    return np.arange(len(vectors))


def share_absorbed(columns: Array, c: Array) -> float:
    """Return the share, eq. (1), of the variance of a course c (n,) that columns (n, p) absorb."""
    size = float(c @ c)
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    inside = U[:, s > _FLAT * s.max(initial=0.0)].T @ c
    return min(float(inside @ inside) / size, 1.0) if size > 0.0 else 0.0


def _spread(columns: Array) -> Places:
    """Return the order of rows (n,) in which columns (n, p) absorb the least of the courses."""
    n = len(columns)
    if n < 3:
        return np.arange(n)
    U, s, _ = np.linalg.svd(columns - columns.mean(axis=0), full_matrices=False)
    Q = U[:, s > _FLAT * max(float(s[0]), 1.0)]
    C = _courses(n)
    strides = [k for k in range(1, n) if math.gcd(k, n) == 1]
    if n > _EXCHANGED:  # those that step by some part of the whole
        strides = strides[:: max(1, len(strides) // _EXCHANGED)]
    rows = [np.arange(n) * k % n for k in strides]
    first = [_worst(Q[each].T @ C, n) for each in rows]
    best = sorted(range(len(rows)), key=lambda i: (round(float(first[i]), 9), i))
    if n > _EXCHANGED:
        return rows[best[0]]
    found = [_exchange(Q, C, rows[i]) for i in best[:_BEGINNINGS]]
    return min(found, key=lambda each: round(each[0] / _LEAST))[1]


def _courses(n: int) -> Array:
    """Return the courses (n, 3) of length one and mean zero: row number, its square, a sine."""
    t = (np.arange(n) - 0.5 * (n - 1)) / n
    courses = np.column_stack([t, t**2, np.sin(2.0 * np.pi * t)])
    courses -= courses.mean(axis=0)
    return np.asarray(courses / np.sqrt((courses**2).sum(axis=0)))


def _worst(inside: Array, n: int) -> Array:
    """Return what is to be small for n rows, of what columns hold of the courses (…, r, 3)."""
    shares = (inside**2).sum(axis=-2)
    largest = shares.max(axis=-1)
    return np.asarray(largest if n >= _FIRST else shares[..., 0] + _REST * largest)


def _exchange(Q: Array, C: Array, rows: Places) -> tuple[float, Places]:
    """Return rows after the exchanges that help, each time the best one, and what they reach."""
    i, j = np.triu_indices(len(rows), 1)
    steps = C[j] - C[i]
    rows = rows.copy()
    reached = math.inf
    while True:
        held = Q[rows].T @ C
        now = float(_worst(held, len(rows)))
        if now >= reached - _LEAST:
            return now, rows
        reached = now
        moved = Q[rows[i]] - Q[rows[j]]
        after = _worst(held + moved[:, :, None] * steps[:, None, :], len(rows))
        best = int(np.argmin(np.round(after / _LEAST)))
        if after[best] < now - _LEAST:
            rows[[i[best], j[best]]] = rows[[j[best], i[best]]]


def travel_deg(up: ArrayLike) -> float:
    """Return the sum of the turns [degrees] between up vectors (n, 3), in their order."""
    vectors = np.asarray(up, dtype=np.float64)
    return float(np.degrees(_angles(vectors[:-1], vectors[1:]).sum()))


def travel_order(up: Array, start: Array | None = None) -> Places:
    """Return the rows of up vectors (n, 3) in an order that is short to travel.

    Parameters
    ----------
    up : (n, 3) array
    start : (1, 3) or (0, 3) array, optional
        Where the sensor is; otherwise the order begins with the position given first.
    """
    here = np.empty((0, 3)) if start is None else start
    everything = np.concatenate([here, up])
    if len(everything) < 3:
        return np.arange(len(up))
    cost = _angles(everything[:, np.newaxis], everything[np.newaxis]).tolist()
    paths = (_shorten(cost, path) for path in _beginnings(cost))
    path = min(paths, key=lambda path: round(_length(cost, path), 9))
    return np.array(path[len(here) :]) - len(here)


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

"""The best N positions: exchange of candidates, restarts, polish, or every choice there is.

N positions with rows Z_k have the information M = Z'Z/N. Replacing position i by candidate j
changes the criteria of `multipos.information` by a matrix of 2K rows only: with W = [Z_j; Z_i],
C = diag(1, −1) and S = C + W (N M)⁻¹ W',

    ln det M' − ln det M = ln |det S|,
    tr(M'⁻¹ B) − tr(M⁻¹ B) = −tr(S⁻¹ W (N M)⁻¹ B M⁻¹ W'),                                    (1)

so that all candidates are tried for a position at once. Each position in turn takes its best
replacement until none improves (Fedorov's exchange, in the manner of Cook and Nachtsheim);
random starts guard against local optima. Where there are few choices all are tried. On the sphere
the positions of the best starts then move freely (L-BFGS along the gradient (3) of
`multipos.information`), because a list of directions hardly holds the best ones.

Sources: V. V. Fedorov, Theory of Optimal Experiments, 1972; R. D. Cook, C. J. Nachtsheim,
Technometrics 22, 1980.
"""

import math
from itertools import combinations_with_replacement, islice

import numpy as np
from numpy.typing import NDArray

from multipos.information import (
    Blocks,
    Criterion,
    Setting,
    inform,
    kernels,
    objective,
    sensitivity,
)

Array = NDArray[np.float64]
Choice = NDArray[np.intp]

_ALL = 20_000  # choices that are tried one and all
_BETTER = 1e-10  # gain below which an exchange is rounding
_SWEEPS = 100
_RIDGE = 1e-3  # part of the candidates' mean information that makes a random start regular


def choose(
    rows: Blocks,
    count: int,
    criterion: Criterion,
    *,
    included: Blocks | None = None,
    starts: int = 20,
    rng: np.random.Generator,
) -> list[tuple[float, Choice]]:
    """Return choices of `count` candidates, best first, with their criteria.

    A candidate may be taken more than once: the position is placed again.

    Parameters
    ----------
    rows : tuple of (n, K, p_b) arrays
        The candidates.
    count : int
        Positions to choose.
    criterion : Criterion
        D, or one with a weight B.
    included : tuple of (m, K, p_b) arrays, optional
        Positions that stay.
    starts : int
        Random starts of the exchange.
    rng : Generator

    Returns
    -------
    list of (criterion, (count,) array of int)
        −inf where the chosen positions cannot separate the parameters.
    """
    n = len(rows[0])
    fixed = tuple(Z[:0] for Z in rows) if included is None else included
    if math.comb(n + count - 1, count) <= _ALL:
        return _try_all(rows, count, criterion, fixed)
    found: dict[tuple[int, ...], float] = {}
    for _ in range(starts):
        choice = rng.integers(n, size=count)
        for ridge in (_RIDGE, 0.0):
            choice = exchange(rows, choice, criterion, fixed, ridge)
        choice.sort()
        found[tuple(choice.tolist())] = objective(_information(rows, choice, fixed), criterion)
    ranked = sorted(found.items(), key=lambda item: -item[1])
    return [(value, np.array(choice, dtype=np.intp)) for choice, value in ranked]


def exchange(
    rows: Blocks, choice: Choice, criterion: Criterion, fixed: Blocks, ridge: float = 0.0
) -> Choice:
    """Return a choice that no replacement of one position improves, eq. (1).

    `ridge` adds this part of the mean information of all candidates, for singular starts.
    """
    choice = choice.copy()
    total = len(choice) + len(fixed[0])
    added = tuple(ridge * M for M in inform(rows))

    def state() -> "_State | None":
        information = tuple(
            total * (M + R) for M, R in zip(_information(rows, choice, fixed), added, strict=True)
        )
        sound = objective(information, criterion) > -math.inf
        return _State(rows, information, criterion) if sound else None

    current = state()
    for _ in range(_SWEEPS):
        moved = False
        for i in range(len(choice)):
            if current is None:
                return choice
            gains = current.gains(int(choice[i]))
            best = int(gains.argmax())
            if gains[best] > _BETTER:
                choice[i] = best
                current = state()
                moved = True
        if not moved:
            break
    return choice


class _State:
    """What the gains of eq. (1) need of the present choice."""

    def __init__(self, rows: Blocks, information: Blocks, criterion: Criterion) -> None:
        self.rows = rows
        self.inverse = [np.linalg.inv(M) for M in information]
        self.left = [Z @ C for Z, C in zip(rows, self.inverse, strict=True)]
        self.own = [_own(A, Z) for A, Z in zip(self.left, rows, strict=True)]
        self.trace: float | None = None
        if criterion.weight is not None:
            products = [C @ B for C, B in zip(self.inverse, criterion.weight, strict=True)]
            self.trace = float(sum(np.trace(product) for product in products))
            middle = [P @ C for P, C in zip(products, self.inverse, strict=True)]
            self.left_b = [Z @ Q for Z, Q in zip(rows, middle, strict=True)]
            self.own_b = [_own(A, Z) for A, Z in zip(self.left_b, rows, strict=True)]

    def gains(self, leaving: int) -> Array:
        """Return the gain of the criterion, up to a constant factor, for every candidate (n,)."""
        change = np.zeros(len(self.rows[0]))
        for b, Z in enumerate(self.rows):
            S = _bordered(self.own[b], self.left[b] @ Z[leaving].T, leaving)
            k = Z.shape[1]
            S[:, :k, :k] += np.eye(k)
            S[:, k:, k:] -= np.eye(k)
            determinant = _det(S)
            with np.errstate(divide="ignore"):
                if self.trace is None:
                    change += np.log(np.abs(determinant))
                    continue
            T = _bordered(self.own_b[b], self.left_b[b] @ Z[leaving].T, leaving)
            change += _trace_solved(S, determinant, T)
        if self.trace is None:
            return change
        with np.errstate(divide="ignore", invalid="ignore"):
            # what the trace becomes is never 0 or less but by rounding of a singular choice
            left = np.where(self.trace - change > 0.0, self.trace - change, np.inf)
            return np.asarray(np.log(self.trace) - np.log(left))


def _own(left: Array, Z: Array) -> Array:
    return np.asarray(left @ Z.transpose(0, 2, 1))


def _bordered(own: Array, cross: Array, leaving: int) -> Array:
    """Return [[own_j, cross_j], [cross_j', own_leaving]] for each candidate j, (n, 2K, 2K)."""
    n, k, _ = own.shape
    S = np.empty((n, 2 * k, 2 * k))
    S[:, :k, :k], S[:, :k, k:] = own, cross
    S[:, k:, :k], S[:, k:, k:] = cross.transpose(0, 2, 1), own[leaving]
    return S


def _det(S: Array) -> Array:
    if S.shape[1] == 2:
        return np.asarray(S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0])
    return np.asarray(np.linalg.det(S))


def _trace_solved(S: Array, determinant: Array, T: Array) -> Array:
    """Return tr(S⁻¹ T), −inf where S is singular: that replacement would lose a parameter."""
    sound = np.abs(determinant) > 1e-12
    if S.shape[1] == 2:
        top = S[:, 1, 1] * T[:, 0, 0] + S[:, 0, 0] * T[:, 1, 1] - 2.0 * S[:, 0, 1] * T[:, 0, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(sound, top / determinant, -np.inf)
    result = np.full(len(S), -np.inf)
    result[sound] = np.trace(np.linalg.solve(S[sound], T[sound]), axis1=1, axis2=2)
    return result


def _try_all(
    rows: Blocks, count: int, criterion: Criterion, fixed: Blocks
) -> list[tuple[float, Choice]]:
    n = len(rows[0])
    total = count + len(fixed[0])
    single = [Z.transpose(0, 2, 1) @ Z / total for Z in rows]
    base = [np.einsum("nkp,nkq->pq", Z, Z) / total for Z in fixed]
    best: tuple[float, Choice] = (-math.inf, np.zeros(count, dtype=np.intp))
    every = combinations_with_replacement(range(n), count)
    while part := list(islice(every, 2000)):
        choices = np.array(part, dtype=np.intp)
        matrices = [S[choices].sum(axis=1) + M for S, M in zip(single, base, strict=True)]
        for row in np.argsort(-_roughly(matrices, criterion))[:3]:
            value = objective(tuple(M[row] for M in matrices), criterion)
            if value > best[0] + 1e-12:
                best = value, choices[row]
    return [best]


def _roughly(matrices: list[Array], criterion: Criterion) -> Array:
    """Return the criterion of many informations at once; singular ones come last."""
    value = np.zeros(len(matrices[0]))
    for b, M in enumerate(matrices):
        sign, size = np.linalg.slogdet(M)
        sound = (sign > 0.0) & (size > -60.0 * M.shape[1])
        if criterion.weight is None:
            value += np.where(sound, size, -np.inf)
        else:
            safe = np.where(sound[:, None, None], M, np.eye(M.shape[1]))
            trace = np.trace(np.linalg.solve(safe, criterion.weight[b]), axis1=1, axis2=2)
            value -= np.where(sound & (trace > 0.0), trace, np.inf)  # rounding may make it negative
    return value


def polish(
    setting: Setting, up: Array, criterion: Criterion, included: Array
) -> tuple[float, Array]:
    """Return the criterion and positions (n, 3) after they have moved freely on the sphere."""
    from scipy.optimize import minimize

    fixed = setting.rows(included)
    frame = _frames(up)
    h = 1e-5

    def moved(x: Array) -> Array:
        step = np.einsum("nij,nj->ni", frame, x.reshape(-1, 2))
        return _unit(up + step)

    def descend(x: Array) -> tuple[float, Array]:
        information = _joined(setting.rows(moved(x)), fixed)
        value = objective(information, criterion)
        if value == -math.inf:
            return 1e6, np.zeros_like(x)
        kernel = kernels(information, criterion)
        steps = x.reshape(-1, 2)[:, np.newaxis, :] + h * np.array(
            [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
        )
        around = up[:, np.newaxis, :] + np.einsum("nij,nkj->nki", frame, steps)
        s = sensitivity(setting.rows(_unit(around.reshape(-1, 3))), kernel).reshape(-1, 4)
        slope = np.stack([s[:, 0] - s[:, 1], s[:, 2] - s[:, 3]], axis=1) / (2.0 * h)
        return -value, -slope.ravel() / (len(up) + len(included))

    start = np.zeros(2 * len(up))
    before = -descend(start)[0]
    found = minimize(
        descend, start, jac=True, method="L-BFGS-B", options={"maxiter": 300, "ftol": 1e-14}
    )
    # an equal choice from the list has rounder numbers
    return (-found.fun, _tidy(moved(found.x))) if -found.fun > before + 1e-9 else (before, up)


def polish_largest(
    setting: Setting, up: Array, included: Array, directions: Array
) -> tuple[float, Array]:
    """Return −ln of the largest p s(u) and positions, moved to make it small: criterion G.

    The maximum is smoothed, (mean of s^q)^(1/q) over the directions, and sharpened by steps.
    """
    from scipy.optimize import minimize

    fixed, frame = setting.rows(included), _frames(up)
    seen = setting.rows(directions)
    criterion = Criterion("G")

    def moved(x: Array) -> Array:
        return _unit(up + np.einsum("nij,nj->ni", frame, x.reshape(-1, 2)))

    def smooth(x: Array, power: float) -> float:
        information = _joined(setting.rows(moved(x)), fixed)
        if objective(information, criterion) == -math.inf:
            return 1e6
        s = sensitivity(seen, kernels(information, criterion))
        return float(np.log(s.max()) + np.log(np.mean((s / s.max()) ** power)) / power)

    x = np.zeros(2 * len(up))
    for power in (20.0, 100.0):
        x = minimize(smooth, x, args=(power,), method="L-BFGS-B", options={"maxiter": 40}).x
    return -smooth(x, 1e4), _tidy(moved(x))


def _joined(rows: Blocks, fixed: Blocks) -> Blocks:
    return inform(tuple(np.concatenate(pair) for pair in zip(rows, fixed, strict=True)))


def _information(rows: Blocks, choice: Choice, fixed: Blocks) -> Blocks:
    return _joined(tuple(Z[choice] for Z in rows), fixed)


def _frames(up: Array) -> Array:
    other = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    first = _unit(np.cross(up, other))
    return np.stack([first, np.cross(up, first)], axis=2)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _tidy(up: Array) -> Array:
    return _unit(np.where(np.abs(up) < 1e-6, 0.0, up)) + 0.0

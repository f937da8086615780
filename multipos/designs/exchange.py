"""The best N positions: exchange of candidates, restarts, polish.

`choose` returns choices of candidates, best first, and `exchange` one that no replacement of a
position improves. `polish` moves positions freely on the sphere.

N positions with rows Z_k have the information M = Z'Z/N. Replacing position i by candidate j
changes the criteria of `multipos.designs.information` by a matrix of 2K rows only: with W = [Z_j;
Z_i], C = diag(1, −1) and S = C + W (N M)⁻¹ W',

    ln det M' − ln det M = ln |det S|,
    tr(M'⁻¹ B) − tr(M⁻¹ B) = −tr(S⁻¹ W (N M)⁻¹ B M⁻¹ W'),                                    (1)

so that all candidates are tried for a position at once. One position after another takes its best
replacement until none improves (Fedorov's exchange, in the manner of Cook and Nachtsheim);
random starts guard against local optima. On the sphere the positions of the best starts then move
freely (BFGS along the gradient (3) of `multipos.designs.information`), because a list of directions
hardly holds the best ones.

Sources: V. V. Fedorov, Theory of Optimal Experiments, 1972; R. D. Cook, C. J. Nachtsheim,
Technometrics 22, 1980.
"""

import math
from collections.abc import Callable

import numpy as np

from multipos.designs.criteria import Criterion, kernels, objective, sensitivity, smooth_least
from multipos.designs.information import Blocks, Setting, inform, multiply, tangents, unit
from multipos.numerics.arrays import Array, Places

_TRIED = 40  # candidates whose eigenvalues are taken, of criterion E
_BETTER = 1e-10  # gain below which an exchange is rounding
_SWEEPS = 100
_H = 1e-5  # [rad], of central differences
_STEPS = 300  # of the polish
_REACH = 0.3  # [rad], of a step at most
_STILL = 1e-9  # [rad], of a step that is none
_RIDGE = 1e-3  # part of the candidates' mean information that makes a random start regular


def choose(
    rows: Blocks,
    count: int,
    criterion: Criterion,
    *,
    included: Blocks | None = None,
    starts: int = 20,
    rng: np.random.Generator,
) -> list[tuple[float, Places]]:
    """Return choices of `count` candidates, best first, with their criteria.

    A candidate may be taken more than once: the position is taken up again.

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
    found: dict[tuple[int, ...], float] = {}
    for _ in range(starts):
        regular = exchange(rows, rng.integers(n, size=count), criterion, fixed, _RIDGE)
        best = exchange(rows, regular.choice, criterion, fixed)
        found[tuple(sorted(best.choice.tolist()))] = best.value - math.log(count + len(fixed[0]))
    ranked = sorted(found.items(), key=lambda item: -item[1])
    return [(value, np.array(choice, dtype=np.intp)) for choice, value in ranked]


def exchange(
    rows: Blocks, choice: Places, criterion: Criterion, fixed: Blocks, ridge: float = 0.0
) -> "_State":
    """Return the state of a choice that no replacement of one position improves, eq. (1).

    `ridge` adds this part of the mean information of all candidates, for singular starts.
    """
    total = len(choice) + len(fixed[0])
    staying = tuple(
        total * ridge * M + np.einsum("nkp,nkq->pq", Z, Z)
        for M, Z in zip(inform(rows), fixed, strict=True)
    )
    state = _State(rows, criterion, staying, choice)
    if state.value == -math.inf:
        return state
    for _ in range(_SWEEPS):
        before = state
        for place in range(len(choice)):
            state = _replace_at(state, place)
        if state is before:
            break
    return state


def _replace_at(state: "_State", place: int) -> "_State":
    """Return a state with the best candidate at a place, the same where none is better."""
    gains = state.gains(int(state.choice[place]))
    best = int(gains.argmax())
    if not gains[best] > _BETTER:
        return state
    choice = state.choice.copy()
    choice[place] = best
    other = _State(state.rows, state.criterion, state.staying, choice)
    # a gain of few digits may be none
    return other if other.value > state.value else state


class _State:
    """A choice, its criterion, and what the gains of eq. (1) need of it."""

    def __init__(self, rows: Blocks, criterion: Criterion, staying: Blocks, choice: Places) -> None:
        self.rows, self.criterion, self.staying, self.choice = rows, criterion, staying, choice
        taken = [Z[choice].reshape(-1, Z.shape[2]) for Z in rows]
        self.information = tuple(M + T.T @ T for M, T in zip(staying, taken, strict=True))
        self.value = objective(self.information, criterion)
        if self.value == -math.inf:
            return
        if criterion.power:
            s = sensitivity(rows, kernels(self.information, criterion))
            self.nearest = np.argsort(-s)[:_TRIED]
            return
        inverse = [np.asarray(np.linalg.inv(M), dtype=np.float64) for M in self.information]
        self.own, self.left = _forms(rows, inverse)
        if criterion.weight is not None:
            products = [C @ B for C, B in zip(inverse, criterion.weight, strict=True)]
            self.trace = float(sum(np.trace(product) for product in products))
            middle = [P @ C for P, C in zip(products, inverse, strict=True)]
            self.own_b, self.left_b = _forms(rows, middle)

    def gains(self, leaving: int) -> Array:
        """Return the gain of the criterion, up to a constant factor, for every candidate (n,)."""
        if self.criterion.power:
            return self._gains_of_least(leaving, self.criterion.power)
        determinants = np.ones(len(self.rows[0]))
        falls = np.zeros(len(self.rows[0]))
        for b, Z in enumerate(self.rows):
            S = _bordered(self.own[b], self.left[b], Z[leaving], leaving)
            S += np.diag(np.repeat([1.0, -1.0], Z.shape[1]))
            determinant = _determinant(S)
            determinants *= determinant
            if self.criterion.weight is not None:
                T = _bordered(self.own_b[b], self.left_b[b], Z[leaving], leaving)
                sound = np.abs(determinant) > 1e-12  # else that replacement loses a parameter
                S[~sound] = np.eye(S.shape[1])
                falls += np.where(sound, _trace_solved(S, T), -np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.criterion.weight is None:
                return np.asarray(np.log(np.abs(determinants)))
            # what the trace becomes is 0 or less only by rounding of a singular choice
            left = np.where(self.trace - falls > 0.0, self.trace - falls, np.inf)
            now = max(self.trace, np.finfo(float).tiny)
            return np.asarray(math.log(now) - np.log(left))

    def _gains_of_least(self, leaving: int, power: float) -> Array:
        """Return the gain of criterion E, from the eigenvalues with candidates of the largest s."""
        found = [
            np.linalg.eigvalsh(M - Z[leaving].T @ Z[leaving] + near.transpose(0, 2, 1) @ near)
            for M, Z in zip(self.information, self.rows, strict=True)
            for near in [Z[self.nearest]]
        ]
        eigen = np.concatenate(found, axis=1)
        # what rounding leaves of a parameter that is lost
        eigen = np.maximum(eigen, 1e-12 * eigen.max(axis=1, keepdims=True))
        gains = np.full(len(self.rows[0]), -np.inf)
        gains[self.nearest] = smooth_least(eigen, power) - self.value
        return gains


def _forms(rows: Blocks, middle: list[Array]) -> tuple[list[Array], list[Array]]:
    """Return Z_j C Z_j' (n, K, K) and Z_j C (n, K, p) of each block."""
    left = [
        multiply(Z.reshape(-1, Z.shape[2]), C).reshape(Z.shape)
        for Z, C in zip(rows, middle, strict=True)
    ]
    own = [np.einsum("nkp,nlp->nkl", A, Z) for A, Z in zip(left, rows, strict=True)]
    return own, left


def _bordered(own: Array, left: Array, leaving_rows: Array, leaving: int) -> Array:
    """Return W C W' (n, 2K, 2K) of eq. (1) for each candidate in place of the one that leaves."""
    n, k, p = left.shape
    cross = (left.reshape(n * k, p) @ leaving_rows.T).reshape(n, k, k)
    S = np.empty((n, 2 * k, 2 * k))
    S[:, :k, :k], S[:, :k, k:] = own, cross
    S[:, k:, :k], S[:, k:, k:] = cross.transpose(0, 2, 1), own[leaving]
    return S


def _determinant(S: Array) -> Array:
    if S.shape[1] > 2:
        return np.asarray(np.linalg.det(S))
    # of outputs by themselves, thousands a search: in numbers at once it takes a tenth
    return np.asarray(S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0])


def _trace_solved(S: Array, T: Array) -> Array:
    """Return tr(S⁻¹ T) of symmetric matrices (n, 2K, 2K)."""
    if S.shape[1] > 2:
        return np.asarray(np.einsum("nij,nji->n", np.linalg.inv(S), T))
    straight = S[:, 0, 0] * T[:, 1, 1] + S[:, 1, 1] * T[:, 0, 0]
    return np.asarray((straight - 2.0 * S[:, 0, 1] * T[:, 0, 1]) / _determinant(S))


def polish(
    setting: Setting, up: Array, criterion: Criterion, included: Array
) -> tuple[float, Array]:
    """Return the criterion and positions (n, 3) after they have moved freely on the sphere."""
    fixed, frame = setting.rows(included), tangents(up)
    corners = _H * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])

    def fall(x: Array) -> tuple[float, Array]:
        information = _joined(setting.rows(_moved(up, frame, x)), fixed)
        value = objective(information, criterion)
        if value == -math.inf:
            return math.inf, np.zeros_like(x)
        around = x.reshape(-1, 1, 2) + corners
        near = unit((up[:, np.newaxis] + np.einsum("nij,nkj->nki", frame, around)).reshape(-1, 3))
        s = sensitivity(setting.rows(near), kernels(information, criterion)).reshape(-1, 4)
        slope = np.stack([s[:, 0] - s[:, 1], s[:, 2] - s[:, 3]], axis=1) / (2.0 * _H)
        return -value, -slope.ravel() / (len(up) + len(included))

    start = np.zeros(2 * len(up))
    before = -fall(start)[0]
    x, value = _descend(fall, start)
    # an equal choice from the list has rounder numbers
    return (-value, _tidy(_moved(up, frame, x))) if -value > before + 1e-9 else (before, up)


def _descend(function: Callable[[Array], tuple[float, Array]], x: Array) -> tuple[Array, float]:
    """Return where a function of value and gradient is least nearby, and its value: BFGS."""
    value, gradient = function(x)
    H = np.eye(len(x))
    for _ in range(_STEPS):
        step = -H @ gradient
        step *= min(1.0, _REACH / max(float(np.abs(step).max()), 1e-300))
        lower, slope = function(x + step)
        while lower > value + 1e-4 * float(gradient @ step):
            step *= 0.3
            if np.abs(step).max() < _STILL:
                return x, value
            lower, slope = function(x + step)
        y, gained = slope - gradient, value - lower
        x, value, gradient = x + step, lower, slope
        if gained <= 1e-13:
            break
        if (curvature := float(y @ step)) > 1e-14:
            V = np.eye(len(x)) - np.outer(step, y) / curvature
            H = V @ H @ V.T + np.outer(step, step) / curvature
    return x, value


def _moved(up: Array, frame: Array, x: Array) -> Array:
    return unit(up + np.einsum("nij,nj->ni", frame, x.reshape(-1, 2)))


def _joined(rows: Blocks, fixed: Blocks) -> Blocks:
    return inform(tuple(np.concatenate(pair) for pair in zip(rows, fixed, strict=True)))


def _tidy(up: Array) -> Array:
    return unit(np.where(np.abs(up) < 1e-6, 0.0, up)) + 0.0

"""Rows that are correlated in time made independent, so that tests of terms keep their level.

`find_noise` returns what rows tell of the law of their noise, `whitening_of` the filter by the
likeliest law (`Whitening` is that by any), `ages` how far each row is from the start of its run.

Neighbouring rows of a slow run carry nearly the same error, and whatever term varies as slowly
looks as if it explained it. The errors are taken as slow noise and white noise together, which is

    e_k − ρ e_{k−1} = w_k − θ w_{k−1},      0 ≤ θ ≤ ρ,                                      (1)

within a run, w independent; θ = 0 is slow noise alone. Columns and response are filtered alike,

    z̃_k = z_k − ρ z_{k−1} + θ z̃_{k−1},     z̃_1 = z_1/√r in the first row of a run,          (2)

r = (1 − 2ρθ + θ²)/(1 − ρ²), and F and t of least squares on z̃ are those of independent rows. ρ and
θ are estimated by restricted likelihood, which a fit of many columns does not draw towards zero as
it does the correlation of its residuals:

    l(ρ, θ) = −R/2 ln r − 1/2 ln |X̃'X̃| − (n − p)/2 ln rss,                                (3)

R runs, p columns. **The likeliest** law chooses terms and edges, where 2 (l(ρ, θ) − l(0, 0)) is
beyond what independent rows give once in a hundred. A test of the whole model cannot take it at
its word: a hundred rows hardly tell slow noise under white noise from white noise alone, and a
variable as slow as that noise would pass. So F_robust is the one with the largest p of all
**plausible** laws, those with

    2 (max l − l(ρ, θ)) ≤ 2.7,                                                              (4)

The law is one of the sensor, not of a segment, and is found from all rows at once, with the columns
of every segment apart. What is still left is fitted by an autoregression of up to six orders, as
many as the Bayesian criterion grants, and taken off likewise. What tests of terms then do where
nothing is there stands in `docs/theory/regression.md`.

Sources: D. Cochrane, G. H. Orcutt, J. Am. Stat. Assoc. 44, 1949; S. J. Prais, C. B. Winsten, Cowles
Commission 383, 1954 (the first row); D. M. Cooper, R. Thompson, Biometrika 64, 1977 (3);
G. Schwarz, Ann. Stat. 6, 1978; R. L. Berger, D. D. Boos, J. Am. Stat. Assoc. 89, 1994 (the largest
p over a confidence set of what else is unknown).
"""

from math import log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.factoring import gram
from multipos.numerics.recursions import recur
from multipos.regression.correlation import TimeOrder
from multipos.results import frozen

_FAST = np.arange(0.0, 0.8, 0.15)  # ρ of the grid, and the shares of θ in it
_FAST_SHARES = (0.0, 0.3, 0.6, 0.8, 0.93)
_SLOW = 1.0 - np.geomspace(0.15, 0.003, 7)
_SLOW_SHARES = (0.0, 0.3, 0.6, 0.8, 0.9, 0.96, 0.99)
_BEYOND_CHANCE = 7.4  # of twice the likelihood's logarithm
_PLAUSIBLE = 2.7  # of the same: what one quantity is beyond once in ten times
_ROWS = 3000  # of which the correlation is estimated: the first in time
_ORDERS = 6
_RANK = 1e-10
_FEWEST = 6  # rows beyond the columns, for a correlation to be identified
_NOTHING = 1e-12  # of the response, below which what is left is rounding


class Law(NamedTuple):
    """The law of the noise: ρ and θ of eq. (1), and the autoregression of what eq. (2) leaves."""

    rho: float
    theta: float
    further: Array


class Noise(NamedTuple):
    """What rows tell of their noise.

    Attributes
    ----------
    law : Law or None
        The likeliest; None where independent rows are as likely but for chance.
    plausible : tuple of Law
        All of eq. (4), the likeliest first; of more rows than its likelihood is taken of, `law`
        alone.
    """

    law: Law | None
    plausible: tuple[Law, ...]


@frozen(eq=True)
class Whitening:
    """A filter that makes rows independent, by the law of their noise."""

    order: TimeOrder
    law: Law

    def __call__(self, columns: Array) -> Array:
        """Return columns (n, p) or (n,) with independent errors, row by row as they stand."""
        order = self.order.order
        age = ages(self.order.run)
        white = _filtered(columns[order], age, self.law.rho, self.law.theta)
        full = white
        for lag, a in enumerate(self.law.further.tolist(), start=1):
            full = full - (white - _less(white, a, age, lag))
        back = np.empty_like(full)
        back[order] = full
        return back


def whitening_of(order: TimeOrder, noise: Noise | None) -> Whitening | None:
    """Return the filter of rows by the likeliest law; None where they are independent."""
    if noise is None or noise.law is None:
        return None
    return Whitening(order, noise.law)


def find_noise(design: Array, response: Array, order: TimeOrder) -> Noise | None:
    """Return what the rows tell of the noise that a fit to all columns leaves.

    Parameters
    ----------
    design : (n, p) array
        Columns of which some may say the same.
    response : (n,) array
    order : TimeOrder

    Returns
    -------
    Noise or None
        None where rows are too few, or leave nothing.
    """
    rows = order.order[:_ROWS]
    age = ages(order.run)[:_ROWS]
    X, y = design[rows], response[rows]
    basis = _basis(X)
    left = y - basis @ (basis.T @ y)
    size = float(np.linalg.norm(left))
    if len(y) - basis.shape[1] < _FEWEST or size <= _NOTHING * float(np.linalg.norm(y)):
        return None
    both = np.column_stack([basis, left / size])
    likely = _likelihoods(both, age)
    ranked = sorted(likely, key=lambda point: -likely[point])
    top = likely[ranked[0]]
    correlated = 2.0 * (top - likely[0.0, 0.0]) >= _BEYOND_CHANCE
    if len(order.order) > _ROWS:
        ranked = ranked[:1] if correlated else []
    laws = [_law(both, age, point) for point in ranked if 2.0 * (top - likely[point]) <= _PLAUSIBLE]
    return Noise(laws[0] if correlated else None, tuple(laws))


def _law(both: Array, age: NDArray[np.intp], point: tuple[float, float]) -> Law:
    """Return the law at ρ and θ/ρ, with the autoregression of what it leaves of (n, p + 1)."""
    rho, theta = point[0], point[0] * point[1]
    white = _filtered(both, age, rho, theta)
    R = np.linalg.cholesky(gram(white)).T
    b = R[:-1, -1].copy()
    for j in range(len(b) - 1, -1, -1):  # R is a triangle: a solver of squares starts threads
        b[j] /= R[j, j]
        b[:j] -= R[:j, j] * b[j]
    rest = white[:, -1] - np.einsum("nj,j->n", white[:, :-1], b)
    return Law(rho, theta, _autoregression(rest, age) if rho else np.zeros(0))


def _basis(design: Array) -> Array:
    """Return orthonormal columns that span the design, by Gram and Schmidt, each taken twice.

    On one thread: of some hundred columns a factoring of BLAS's starts threads that wait for each
    other ten times as long as they work.
    """
    scale = np.linalg.norm(design, axis=0)
    basis = np.empty((design.shape[1], len(design)))
    rank = 0
    for column in (design / np.where(scale > 0.0, scale, 1.0)).T:
        left = column
        for _ in range(2):
            known = basis[:rank]
            left = left - np.einsum("jn,j->n", known, np.einsum("jn,n->j", known, left))
        length = float(np.linalg.norm(left))
        if length > _RANK:
            basis[rank] = left / length
            rank += 1
    return basis[:rank].T


def _likelihoods(z: Array, age: NDArray[np.intp]) -> dict[tuple[float, float], float]:
    """Return eq. (3) by ρ and θ/ρ, of basis and residuals (n, p + 1): a grid, finer at its top."""
    n, p = len(z), z.shape[1] - 1
    runs = int((age == 0).sum())

    def likelihood(rho: float, share: float) -> float:
        white = _filtered(z, age, rho, share * rho)
        # One product and a small factor: filters of a basis are conditioned by some 1/(1 - ρ), so
        # that squares keep ten digits, where QR of all rows is a hundred steps.
        d = np.diag(np.linalg.cholesky(gram(white)))
        logs = float(np.log(d[:p]).sum()) + (n - p) * log(d[p])
        return float(-0.5 * runs * log(_first_variance(rho, share * rho)) - logs)

    grid = [(0.0, 0.0)]
    grid += [(rho, share) for rho in _FAST[1:].tolist() for share in _FAST_SHARES]
    grid += [(rho, share) for rho in _SLOW.tolist() for share in _SLOW_SHARES]
    found = {point: likelihood(*point) for point in grid}
    best = max(grid, key=found.__getitem__)
    step = 0.5
    for _ in range(4):  # each finer by half, ρ by what it lacks to 1
        rho, share = best
        around = [(1.0 - (1.0 - rho) * by, share) for by in (1.0 - step / 2, 1.0 + step / 2)]
        around += [(rho, share + step * by) for by in (-0.2, 0.2)]
        inside = [one for one in around if 0.0 < one[0] < 0.9995 and 0.0 <= one[1] < 1.0]
        found |= {one: likelihood(*one) for one in inside}
        best = max(found, key=found.__getitem__)
        step /= 2.0
    return found


def _first_variance(rho: float, theta: float) -> float:
    """Return r of eq. (2)."""
    return (1.0 - 2.0 * rho * theta + theta**2) / (1.0 - rho**2)


def _filtered(z: Array, age: NDArray[np.intp], rho: float, theta: float) -> Array:
    """Return rows in the order of time by eq. (2), run by run."""
    r = _first_variance(rho, theta)
    first = age == 0
    white = z.copy()
    white[1:] -= rho * z[:-1]
    white[first] = z[first] / r  # what the second row of a run remembers
    white = recur(white, theta, first)
    white[first] = z[first] / np.sqrt(r)
    return white


def _autoregression(e: Array, age: NDArray[np.intp]) -> Array:
    """Return the coefficients of what is left, none where the criterion grants none."""
    n = len(e)
    best = n * log(float(e @ e) / n)
    chosen: Array = np.zeros(0)
    for q in range(1, min(_ORDERS, n // 20) + 1):
        lagged = np.column_stack([e - _less(e, 1.0, age, lag) for lag in range(1, q + 1)])
        a = np.linalg.lstsq(lagged, e, rcond=None)[0]
        left = e - lagged @ a
        score = n * log(float(left @ left) / n) + q * log(n)
        if score < best:
            best, chosen = score, np.asarray(a)
    return chosen


def ages(run: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return how many rows of its run stand before each row, in the order of time."""
    begins = np.concatenate(([True], np.diff(run) != 0))
    place = np.arange(len(run))
    return place - np.maximum.accumulate(np.where(begins, place, 0))


def _less(z: Array, a: float, age: NDArray[np.intp], lag: int) -> Array:
    """Return rows less a times those `lag` before, where their run has such."""
    result = z.copy()
    has = np.flatnonzero(age >= lag)
    result[has] -= a * z[has - lag]
    return result

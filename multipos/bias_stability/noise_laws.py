"""White noise, bias instability and random walk from an Allan curve, by generalised least squares.

- `fit_laws` returns the `Laws` of a curve.
- `degrees_of_freedom` returns those of every point of the curve under given laws.

The curve (T,) is a linear function of N², B², K² (`multipos.bias_stability.allan`, eq. (2)), none
of them negative; its covariance follows from them (eq. (4) there), so both are found by
alternation. Flicker noise that is sampled at instants has more than its law at the shortest times,
how much depends on what filtered it: that excess is taken as uncertain, by all of itself.
Quantisation comes in where it explains more. Where χ² is more than chance allows, the shortest
averaging times, at which filters stand in the way of the laws, are left out as long as each takes
some χ² with it; where it is still too much, the covariance grows by χ²/dof.

The square of a coefficient is normal, with the standard uncertainty s; the coefficient itself is
not where it is small. Its U is the wider side of the interval

    sqrt(max(c² − k s, 0))  to  sqrt(c² + k s),     u the same with k = 1.                    (1)
"""

import math
from collections.abc import Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from multipos.bias_stability.allan import flicker_excess, law_variances, starts, variance_covariance
from multipos.numerics.arrays import Array, Mask
from multipos.numerics.quantiles import chi2_tail

_TOGETHER = 30  # times the curve and its covariance are found by alternation at most
_SAME = 1e-6  # relative change of the curve at which they have settled
_CHANCE = 1e-3  # of a larger χ² by chance: below it the shortest times are left out
_LEAST_GAIN = 4.0  # of χ², which quantisation must explain more
_COST = 4.0  # of χ², which a length that is left out must take with it
_FEWEST = 4  # lengths to fit: three laws, and one to spare
_NEXT_TO_NOTHING = 1e-12  # of the squares that the curve allows: keeps logarithms and roots finite


class Laws(NamedTuple):
    """Noise laws of a curve, in units of the samples and one sample time.

    Attributes
    ----------
    squares : (3,) or (4,) array
        N², B², K², and Q² where it is needed.
    covariance : square array
    first : int
        Index of the shortest length that was used.
    chi2, dof : float, int
        Of the curve about the laws.
    """

    squares: Array
    covariance: Array
    first: int
    chi2: float
    dof: int

    def deviation(self, lengths: Array) -> Array:
        """Return the Allan deviation (T,) of the laws."""
        return np.asarray(np.sqrt(law_variances(lengths)[:, : len(self.squares)] @ self.squares))

    def root(self, law: int, factor: float) -> tuple[float, float]:
        """Return the coefficient, and its uncertainty by eq. (1) with k the factor."""
        square = float(self.squares[law])
        spread = factor * float(np.sqrt(self.covariance[law, law]))
        value = float(np.sqrt(square))
        above = float(np.sqrt(square + spread)) - value
        return value, max(above, value - float(np.sqrt(max(square - spread, 0.0))))


def fit_laws(lengths: Sequence[int], variances: Array, records: Sequence[int]) -> Laws:
    """Fit the laws to a curve.

    Parameters
    ----------
    lengths : (T,) of int
        Averaging times in samples, rising.
    variances : (T,) array
        Allan variances, at least one above zero.
    records : of int
        Samples of the records, which were pooled.
    """
    found = _best(lengths, variances, records, 0)
    if not _is_rejected(found):
        return found
    tried = [found]
    for first in range(1, len(lengths) - _FEWEST + 1):
        if not variances[first:].any():
            break
        tried.append(_best(lengths, variances, records, first))
    found = min(tried, key=lambda each: each.chi2 + _COST * each.first)
    if not _is_rejected(found):
        return found
    return found._replace(covariance=found.covariance * found.chi2 / found.dof)


def _is_rejected(found: Laws) -> bool:
    return found.dof > 0 and chi2_tail(found.chi2, found.dof) < _CHANCE


def degrees_of_freedom(laws: Laws, lengths: Sequence[int], records: Sequence[int]) -> Array:
    """Return the equivalent degrees of freedom (T,) of Allan variances under the laws."""
    design = law_variances(np.array(lengths, dtype=np.float64))[:, : len(laws.squares)]
    curve = design @ laws.squares
    squares = laws.squares + _lower_bound(curve, design)
    return np.asarray(2.0 * curve**2 / np.diag(variance_covariance(squares, lengths, records)))


def _lower_bound(curve: Array, design: Array) -> Array:
    return np.asarray(_NEXT_TO_NOTHING * curve.max() / design.max(axis=0))


def _best(lengths: Sequence[int], variances: Array, records: Sequence[int], first: int) -> Laws:
    """Return the fit without quantisation, unless with it there is less to explain."""
    three = _fit(lengths, variances, records, first, 3)
    if len(lengths) - first <= _FEWEST:
        return three
    four = _fit(lengths, variances, records, first, 4)
    return four if four.chi2 < three.chi2 - _LEAST_GAIN else three


def _not_negative(A: Array, y: Array) -> Array:
    """Return the least-squares solution of A x = y with x ≥ 0, over all sets of a few columns."""
    information, moment = A.T @ A, A.T @ y
    np.fill_diagonal(information, (1.0 + 1e-13) * np.diag(information))  # columns may be equal
    chosen = _sets(A.shape[1])
    # In rows and columns outside a set stands the identity, so that all are solved in one call.
    normal = np.where(chosen[:, :, None] & chosen[:, None, :], information, np.eye(A.shape[1]))
    found = np.linalg.solve(normal, (chosen * moment)[:, :, None])[:, :, 0]
    gain = np.where((found >= 0.0).all(axis=1), found @ moment, -math.inf)  # of |y|²
    best, used = np.zeros(A.shape[1]), chosen[int(np.argmax(gain))]
    if gain.max() > 0.0:
        best[used] = np.linalg.lstsq(A[:, used], y, rcond=None)[0].clip(0.0)
    return best


@cache
def _sets(count: int) -> Mask:
    """Return all sets (2^n − 1, n) of some columns but the empty one, the smallest first."""
    sets = [set(s) for k in range(1, count + 1) for s in combinations(range(count), k)]
    return np.array([[i in each for i in range(count)] for each in sets])


def _fit(
    lengths: Sequence[int], variances: Array, records: Sequence[int], first: int, laws: int
) -> Laws:
    used, curve = list(lengths[first:]), variances[first:]
    design = law_variances(np.array(used, dtype=np.float64))[:, :laws]
    number = np.array([sum(starts(n, m) for n in records) / m for m in used])
    least = _NEXT_TO_NOTHING * curve.max()  # samples without noise have no variance at some length
    factor = np.diag(np.maximum(curve, least) / np.sqrt(number))  # to begin with
    model = squares = np.zeros(0)
    for _ in range(_TOGETHER):
        rows = np.linalg.solve(factor, np.column_stack([design, curve]))
        scale = np.linalg.norm(rows[:, :-1], axis=0)
        found = _not_negative(rows[:, :-1] / scale, rows[:, -1]) / scale
        if not found.any():  # a curve that no law is like; what was found before is nearer
            break
        squares, before, model = found, model, design @ found
        if len(before) and (np.abs(model - before) <= _SAME * model).all():
            break
        noise = squares + _lower_bound(curve, design)
        aliased = squares[1] * flicker_excess(np.array(used, dtype=np.float64))
        covariance = variance_covariance(noise, used, records) + np.outer(aliased, aliased)
        factor = np.linalg.cholesky(covariance)
    left = rows[:, -1] - rows[:, :-1] @ squares
    information = rows[:, :-1].T @ rows[:, :-1]
    outer = np.outer(scale, scale)
    return Laws(
        squares=squares,
        covariance=np.linalg.inv(information / outer) / outer,
        first=first,
        chi2=float(left @ left),
        dof=len(used) - int(np.count_nonzero(squares)),
    )

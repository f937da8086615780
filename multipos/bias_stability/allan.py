"""The overlapping Allan deviation of samples in any number, and its covariance under noise laws.

Of n samples y_1 … y_n with the phases x_0 = 0, x_i = y_1 + … + y_i (the sample time is the unit of
time), the overlapping Allan variance over m samples is

    σ²(m) = sum_i z_i² / (2 m² M),   z_i = x_{i+2m} − 2 x_{i+m} + x_i,   M = n − 2m + 1.    (1)

The laws that it tells apart are white noise N, flicker noise B (bias instability), the random walk
K and, at the shortest times, quantisation Q,

    σ²(τ) = N²/τ + (2 ln 2/π) B² + K² τ/3 + 3 Q²/τ²,                                        (2)

the minimum of a curve of flicker noise alone being .664 B. (A walk that is sampled at instants and
not averaged adds K²/6τ.) Phases of such noise have the generalised covariance (what no second
difference sees is left out; δ is 1 at 0, else 0)

    R(t) = −N² |t|/2 + B² t² ln|t| / 2π + K² |t|³/12 + Q² δ(t),                             (3)

from which that of the second differences follows, s(i − j) = E z_i z_j' over m and l samples, and
as noise is normal, for estimates over m and l samples

    cov(σ²_m, σ²_l) = 2 sum_ij s(i − j)² / (2 m² M_m 2 l² M_l).                             (4)

On its diagonal that is the equivalent number of degrees of freedom of Greenhall and Riley,
2 σ⁴/var σ², for the mixture of laws that is there.

White noise, bias instability and random walk from an Allan curve, by generalised least squares.

The curve (T,) is a linear function of N², B², K² (`multipos.bias_stability.allan`, eq. (6)), none
of them negative; its covariance follows from them (eq. (8) there), so both are found by
alternation. Flicker noise that is sampled at instants has more than its law at the shortest times,
how much depends on what filtered it: that excess is taken as uncertain, by all of itself.
Quantisation comes in where it explains more. Where χ² is more than chance allows, the shortest
averaging times, at which filters stand in the way of the laws, are left out as long as each takes
some χ² with it; where it is still too much, the covariance grows by χ²/dof.

The square of a coefficient is normal, with the standard uncertainty s; the coefficient itself is
not where it is small. Its U is the wider side of the interval

    sqrt(max(c² − k s, 0))  to  sqrt(c² + k s),     u the same with k = 1.                    (5)

References
----------
C. A. Greenhall, W. J. Riley, "Uncertainty of stability variances based on finite differences",
35th PTTI Meeting, 2003: (3) and (4) are its functions s_w and BasicSum for unmodified Allan
variances (d = 2) with the filter factor F = ∞.

W. J. Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065, 2008: (1).
IEEE Std 952 and 1293: the laws.
"""

import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import combinations
from typing import IO, NamedTuple, Self

import numpy as np

from multipos.numerics.arrays import Array, Mask
from multipos.numerics.quantiles import chi2_tail

FLICKER = 2.0 * np.log(2.0) / np.pi  # of B² in eq. (2); its root is .664

_PIECE = 1 << 16  # phases at a time, which stay in the processor's cache
_STRIDES = 16  # lags per m of eq. (4)
_CLOSE = 4  # lengths up to this ratio, and lags up to this many of the shorter, take all strides
_AWAY = 100  # lags from there to the end of the longer
_SECOND = ((0.0, 1.0), (1.0, -2.0), (2.0, 1.0))  # places and weights of a second difference


def octaves(n: int) -> list[int]:
    """Return the lengths 1, 2, 4, … [samples] up to a third of n samples."""
    return [1 << i for i in range(max(n // 3, 1).bit_length())]


class Phases:
    """The phases of one record, on the disk, so that it may be longer than memory."""

    def __init__(self) -> None:
        self._file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self._last = 0.0
        self._origin: float | None = None
        self.samples: int = 0

    def __enter__(self) -> Self:
        self._file.write(np.zeros(1).tobytes())
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def feed(self, samples: Array) -> None:
        """Add samples (k,)."""
        if not len(samples):
            return
        if self._origin is None:  # near the samples, so that their sum does not run away
            self._origin = float(samples.mean())
        phases = samples - self._origin
        phases[0] += self._last
        np.cumsum(phases, out=phases)
        self._last = float(phases[-1])
        self.samples += len(samples)
        self._file.write(phases.tobytes())

    def sums(self, lengths: Sequence[int]) -> Array:
        """Return the sum of z² of eq. (1) for every length (T,); 0 where the record is shorter."""
        found = np.zeros(len(lengths))
        short = [m for m in lengths if m <= _PIECE]
        for start in range(0, self.samples, _PIECE):
            phases = self._read(start, _PIECE + 2 * max(short, default=0))
            for i, m in enumerate(short):
                z = phases[2 * m : 2 * m + _PIECE].copy()
                z -= 2.0 * phases[m : m + len(z)]
                z += phases[: len(z)]
                found[i] += z @ z
        for i, m in enumerate(lengths):
            for start in range(0, starts(self.samples, m) if m > _PIECE else 0, _PIECE):
                z = self._read(start + 2 * m, _PIECE).copy()
                z -= 2.0 * self._read(start + m, len(z))
                z += self._read(start, len(z))
                found[i] += z @ z
        return found

    def _read(self, first: int, count: int) -> Array:
        self._file.seek(8 * first)
        return np.frombuffer(self._file.read(8 * count))


def starts(n: int, length: int) -> int:
    """Return M of eq. (1); a record takes no part in averages over more than a third of it."""
    return n - 2 * length + 1 if 3 * length <= n else 0


def law_variances(lengths: Array) -> Array:
    """Return σ² (T, 4) of eq. (2) for N², B², K², Q² of one each, of samples taken at instants."""
    walk = lengths / 3.0 + 1.0 / (6.0 * lengths)
    flat = np.full(len(lengths), FLICKER)
    return np.column_stack([1.0 / lengths, flat, walk, 3.0 / lengths**2])


def flicker_excess(lengths: Array) -> Array:
    """Return what σ² (T,) has above its law for B² = 1 if flicker noise is sampled unfiltered.

    The integral of 1/sin πf in the place of 1/πf, up to half the sample rate; a filter leaves less.
    """
    return np.asarray(FLICKER * (0.42 + 0.27 * np.log(lengths)) / lengths**2)


def variance_covariance(theta: Array, lengths: Sequence[int], records: Sequence[int]) -> Array:
    """Return the covariance (T, T) of estimates of eq. (1) by eq. (4).

    Parameters
    ----------
    theta : (3,) or (4,) array
        N², B², K² of the noise, and Q².
    lengths : (T,) of int
        Rising, up to a third of the longest record.
    records : of int
        Samples of the records, whose sums are pooled.
    """
    size = len(theta)
    products = _products(tuple(lengths), tuple(sorted(Counter(records).items())))[:size, :size]
    return np.asarray(np.einsum("a,b,abij->ij", theta, theta, products))


@lru_cache(maxsize=32)
def _products(lengths: tuple[int, ...], records: tuple[tuple[int, int], ...]) -> Array:
    """Return eq. (4) for each pair of laws, (4, 4, T, T).

    `records` are numbers of samples, with how many records have them.
    """
    count = len(lengths)
    total = [sum(times * starts(n, m) for n, times in records) for m in lengths]
    found = np.zeros((4, 4, count, count))
    for i, m in enumerate(lengths):
        strides = min(m, _STRIDES)
        powers = np.array([m, m**2, m**3, np.sqrt(strides / m)])  # δ is as wide as a sample
        for j in range(i, count):
            longer = lengths[j]
            lags, weights, kernels = _kernels(longer / m, strides)
            pairs = np.zeros(len(lags))
            for n, times in records:
                pairs += times * _pairs(lags * m, starts(n, m), starts(n, longer))
            both = 2.0 * m * (kernels * (weights * pairs)) @ kernels.T * np.outer(powers, powers)
            both /= 2.0 * m**2 * total[i] * 2.0 * longer**2 * total[j]
            found[:, :, i, j] = found[:, :, j, i] = both
    return found


def phase_covariance(lags: Array) -> Array:
    """Return R of eq. (3) for N², B², K² of one each, (3, …)."""
    size = np.abs(lags)
    square = size**2
    flicker = square * np.log(np.where(size > 0.0, size, 1.0)) / (2.0 * np.pi)
    return np.array([-size / 2.0, flicker, square * size / 12.0])


def _pairs(lags: Array, first: int, second: int) -> Array:
    """Return how many i < first, j < second have these differences i − j."""
    common = np.minimum(first, second + lags) - np.maximum(lags, 0.0)
    return np.asarray(np.maximum(common, 0.0))


@cache
def _kernels(ratio: float, strides: int) -> tuple[Array, Array, Array]:
    """Return lags, their weights, and s (4, lags) of second differences over 1 and over `ratio`.

    The shorter length is the unit of time, and `strides` lags make one where they stand close.
    """
    reach = 2.0 * ratio + 1.0  # beyond it next to nothing is left
    middle = ratio - 1.0  # where one window lies in the middle of the other
    if ratio <= _CLOSE:
        lags = np.arange(-reach * strides, reach * strides + 0.5) / strides + middle
    else:  # s has its features where an edge of one window passes an edge of the other
        close = np.arange(_CLOSE * strides) / strides
        away = np.concatenate([close, np.geomspace(_CLOSE, 1.5 * ratio, _AWAY)])
        edges = np.array([0.0, ratio, 2.0 * ratio])[:, None] - 1.0
        lags = np.unique(np.concatenate([edges - away, edges + away]))
        lags = lags[np.abs(lags - middle) <= reach]
    steps = np.diff(lags)
    weights = (np.append(steps, 0.0) + np.insert(steps, 0, 0.0)) / 2.0
    s = np.zeros((4, len(lags)))
    for place, weight in _SECOND:
        for other, by in _SECOND:
            apart = lags + place - other * ratio
            s[:3] += weight * by * phase_covariance(apart)
            s[3] += weight * by * (np.abs(apart) < 0.5 / strides)
    return lags, weights, s


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
        """Return the coefficient, and its uncertainty by eq. (5) with k the factor."""
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

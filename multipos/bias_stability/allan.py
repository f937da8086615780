"""The overlapping Allan deviation of samples in any number, and its covariance under noise laws.

- `Phases` takes samples up and returns the sums of eq. (1), over the lengths of `octaves`; `starts`
  is M, and `pooled_variances` makes eq. (1) of the sums of several records.
- `law_variances` is eq. (2) of one of each law, `flicker_excess` what flicker noise sampled at
  instants has beyond it.
- `variance_covariance` is eq. (4), `phase_covariance` eq. (3).

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

References
----------
C. A. Greenhall, W. J. Riley, "Uncertainty of stability variances based on finite differences",
35th PTTI Meeting, 2003: (3) and (4) are its functions s_w and BasicSum for unmodified Allan
variances (d = 2) with the filter factor F = ∞.

W. J. Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065, 2008: (1).
IEEE Std 952 and 1293: the laws.
"""

import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import IO, Self

import numpy as np

from multipos.numerics.arrays import Array

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
        for i, m in enumerate(lengths):
            count = starts(self.samples, m)
            for first in range(0, count, _PIECE):
                piece = min(_PIECE, count - first)
                z = self._read(first + 2 * m, piece) - 2.0 * self._read(first + m, piece)
                z += self._read(first, piece)
                found[i] += z @ z
        return found

    def _read(self, first: int, count: int) -> Array:
        self._file.seek(8 * first)
        return np.frombuffer(self._file.read(8 * count))


def starts(n: int, length: int) -> int:
    """Return M of eq. (1); a record takes no part in averages over more than a third of it."""
    return n - 2 * length + 1 if 3 * length <= n else 0


def pooled_variances(
    sums: Sequence[Array], lengths: Sequence[int], records: Sequence[int]
) -> Array:
    """Return eq. (1) (T,) of records of so many samples, whose sums are added up.

    The sums of each record are those of the first of the lengths, as many as it has.
    """
    total = np.zeros(len(lengths))
    for each in sums:
        total[: len(each)] += each[: len(lengths)]
    scale = [2.0 * m**2 * sum(starts(n, m) for n in records) for m in lengths]
    return np.asarray(total / scale)


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

"""The mean of one rest and how well it is known, although its samples are not independent.

A rest of n samples is cut into batches of equal length, their means z_1 … z_b (512 to 1023 of
them, or the samples themselves) are kept. An autoregression of order p, chosen by the corrected
information criterion of Akaike, gives the spectral density of z at frequency zero and with it

    u² = σ_p² / (b (1 - φ_1 - … - φ_p)²) / (1 - m/n_eff),     n_eff = sd² / u²,             (1)

where σ_p² and φ are those of Yule and Walker, and the last factor, with m = 1, repays what the
mean took out of the residuals. White noise gives u = sd/√n, noise that remembers more. A drift is
tested against the same estimate after the least-squares line (m = 2), whose rise over the rest
has the standard uncertainty √12 u.

ln u² has by the delta method, with γ the matrix of the autocovariances up to p − 1, the variance

    2/ν = 2/b + 4 σ_p² 1'γ⁻¹1 / (b (1 - φ_1 - … - φ_p)²),                                   (2)

of which ν − 1 are the degrees of freedom of u: n − 1 of white noise, half of n_eff where samples
remember much.

No autoregression is flicker noise or a random walk, whose means do not settle. They are known by
the Allan variances (`multipos.bias_stability.allan`) over m = b/64 … b/4 batches, a weighted line
in ln σ²(m) of slope −1 for white noise, 0 for flicker, 1 for a walk (each known to about 0.2). A
rest wanders where that slope is above −.45 although σ² does not rise up to b/64 either, as it does
where the noise has only a short memory, or where it rises by more than .6 to the end. Neighbouring
means then differ by √2 σ(b) of that line, and those of a session sixteen rests long by

    u² = 2 σ²(b),                                                                           (3)

half of σ² for each doubling [3]_, with the degrees of freedom of the line.

References
----------
.. [1] M. B. Priestley, *Spectral Analysis and Time Series*, 1981, section 7.8 (autoregressive
   spectral estimates).
.. [2] C. M. Hurvich, C.-L. Tsai, Biometrika 76 (1989), 297–307 (corrected criterion).
.. [3] D. W. Allan, Proc. IEEE 54 (1966), 221–230: the variance of a mean over τ about that over
   2τ is half of σ²(τ).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.results import Result

Counts = NDArray[np.signedinteger[Any]]

_BATCHES = 512
_LAGS = 30  # 10 log10(1023), the highest order of an autoregression
_SMALLEST = np.finfo(np.float64).tiny
_EDGE = 10  # an edge is a tenth of a rest
# Parts of a rest that eq. (3) averages over, and the degrees of freedom of their Allan variances
# for white noise, which are about as many as they overlap.
_PARTS = ((64, 80.0), (32, 40.0), (16, 20.0), (8, 11.6), (4, 4.2))
_SETTLES = -0.45  # slope of ln σ² below which the mean settles; white noise has −1(.17)
_RISES = 0.1  # slope over short times, above which noise has a memory; flicker has 0
_WALKS = 0.6  # slope over long times, above which it is more than a memory


@dataclass(frozen=True, eq=False)
class RestMean(Result):
    """What the samples (n, M) of one rest say; arrays are (M,) in the unit of the samples.

    Attributes
    ----------
    n : int
    mean, sd, u : arrays
        Mean, standard deviation of one sample, standard uncertainty of the mean, eq. (1).
    drift, drift_u : arrays
        Rise of the least-squares line from the begin to the end, and its standard uncertainty.
    edge : array
        How far the first and the last tenth lie from the mean, the larger, in units of what
        noise explains.
    low, high : arrays
        Extremes of the samples.
    at_low, at_high : arrays
        How many samples are at them.
    longest : array
        Longest run of equal samples.
    dof : array
        Degrees of freedom of u.
    wander : array
        How many times the u of eq. (1) that of eq. (3) is, where the rest wanders, else 1.
    """

    n: int
    mean: Array
    sd: Array
    u: Array
    drift: Array
    drift_u: Array
    edge: Array
    low: Array
    high: Array
    at_low: Counts
    at_high: Counts
    longest: Counts
    dof: Array
    wander: Array

    @property
    def effective(self) -> Array:
        """Number of independent samples with the same uncertainty of the mean."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (self.sd / self.u) ** 2
        return np.asarray(np.where(self.u > 0.0, ratio, self.n))


class RestSum:
    """Take up the samples of one rest piece by piece."""

    def __init__(self, n: int, outputs: int) -> None:
        self.n = n
        self._length = max(1, n // _BATCHES)
        self._left = np.empty((outputs, 0))
        self.batches: list[Array] = []
        self.origin: Array | None = None  # near the samples, so that squares do not cancel
        self.sum = np.zeros(outputs)
        self.square = np.zeros(outputs)
        self.ends = [_End(outputs, -1.0), _End(outputs, 1.0)]
        self._last = np.full(outputs, np.nan)
        self._run = np.zeros(outputs, dtype=np.int64)
        self.longest = np.zeros(outputs, dtype=np.int64)

    def feed(self, samples: Array) -> None:
        """Add samples (M, k)."""
        if not samples.shape[1]:
            return
        if self.origin is None:
            self.origin = samples.mean(axis=1)
        centred = samples - self.origin[:, None]
        self.sum += centred.sum(axis=1)
        self.square += np.einsum("ji,ji->j", centred, centred)
        for end in self.ends:
            end.feed(samples)
        self._feed_runs(samples)
        together = np.concatenate([self._left, centred], axis=1)
        count = together.shape[1] // self._length
        whole = together[:, : count * self._length].reshape(len(samples), count, self._length)
        self.batches.append(whole.mean(axis=2))
        self._left = together[:, count * self._length :]

    def _feed_runs(self, samples: Array) -> None:
        for j, row in enumerate(samples):
            changes = np.flatnonzero(np.diff(row, prepend=self._last[j]) != 0.0)
            if not len(changes):
                self._run[j] += len(row)
                self.longest[j] = max(self.longest[j], self._run[j])
                continue
            inner = int(np.diff(changes).max()) if len(changes) > 1 else 0
            first = int(self._run[j] + changes[0])
            self._run[j] = len(row) - changes[-1]
            self.longest[j] = max(self.longest[j], first, inner, self._run[j])
        self._last = samples[:, -1]


class _End:
    """The lowest (sign −1) or highest (sign 1) sample of each output, and how many are there."""

    def __init__(self, outputs: int, sign: float) -> None:
        self._sign = sign
        self.value = np.full(outputs, -sign * np.inf)
        self.count = np.zeros(outputs, dtype=np.int64)

    def feed(self, samples: Array) -> None:
        here = samples.max(axis=1) if self._sign > 0.0 else samples.min(axis=1)
        count = (samples == here[:, None]).sum(axis=1)
        beyond = self._sign * (here - self.value)
        self.count = np.where(beyond > 0.0, count, self.count + np.where(beyond == 0.0, count, 0))
        self.value = np.where(beyond > 0.0, here, self.value)


def rest_means(sums: Sequence[RestSum]) -> list[RestMean]:
    """Return what the samples of rests say; all of them must have been fed."""
    whole = [np.concatenate(each.batches, axis=1) for each in sums]
    rises = [_rise(batches) for batches in whole]
    lagged = [_about_both(*each) for each in zip(whole, rises, strict=True)]
    count = [np.full(len(both), z.shape[1]) for both, z in zip(lagged, whole, strict=True)]
    removed = [np.repeat([1, 2], len(rise)) for rise in rises]
    found = density_with_dof(*map(np.concatenate, (lagged, count, removed)))
    parts = zip(*(np.split(each, len(sums)) for each in found), strict=True)
    return [
        _rest_mean(each, batches, rise, *part)
        for each, batches, rise, part in zip(sums, whole, rises, parts, strict=True)
    ]


def _rest_mean(
    taken: RestSum, batches: Array, rise: Array, densities: Array, freedom: Array
) -> RestMean:
    """Return the mean of a rest, from the densities about its mean and about its line."""
    assert taken.origin is not None
    n, count = taken.n, batches.shape[1]
    mean = taken.sum / n
    variance = np.maximum(taken.square - n * mean**2, 0.0) / max(n - 1, 1)
    variance[taken.longest == n] = 0.0  # what rounding leaves of equal samples
    (density, around), (dof, _) = np.split(densities, 2), np.split(freedom, 2)
    # Less than white noise would say is luck, or a hum that fits into the rest.
    plain = np.maximum(np.where(variance > 0.0, density / count, 0.0), variance / n)
    centred = batches - batches.mean(axis=1, keepdims=True)
    square, dof, wander = _wandering(centred, plain, np.where(variance > 0.0, dof, n - 1.0))
    low, high = taken.ends
    return RestMean(
        n=n,
        mean=taken.origin + mean,
        sd=np.sqrt(variance),
        u=np.sqrt(square),
        drift=rise,
        drift_u=np.sqrt(12.0 * around / count),
        edge=_edge(batches, around),
        low=low.value,
        high=high.value,
        at_low=low.count,
        at_high=high.count,
        longest=taken.longest,
        dof=np.maximum(np.minimum(dof, n - 1.0), 1.0),
        wander=wander,
    )


def _wandering(z: Array, square: Array, dof: Array) -> tuple[Array, Array, Array]:
    """Return u² (M,) by eq. (3) where it is larger, its degrees of freedom, and by how much.

    Parameters
    ----------
    z : (M, b) array
        Batch means less their mean.
    square, dof : (M,) arrays
        Of eqs. (1) and (2).
    """
    count = z.shape[1]
    wander = np.ones(len(z))
    if count < 2 * _PARTS[0][0] or not (square > 0.0).any():
        return square, dof, wander
    phases = np.concatenate([np.zeros((len(z), 1)), np.cumsum(z, axis=1)], axis=1)
    parts = np.array([count // part for part, _ in _PARTS])
    weights = np.array([nu for _, nu in _PARTS])
    slope, end, spread = _allan_line(phases, parts, weights, count)
    if not (slope > _SETTLES).any():
        return square, dof, wander
    short = np.array([1 << i for i in range(int(parts[0]).bit_length())])
    rise, _, _ = _allan_line(phases, short, 1.0 / short, count)
    wanders = np.where(rise < _RISES, slope > _SETTLES, slope > _WALKS)
    raised = 2.0 * np.exp(end)
    more = wanders & (raised > square) & (square > 0.0)
    wander[more] = np.sqrt(raised[more] / square[more])
    return np.where(more, raised, square), np.where(more, 1.0 / spread, dof), wander


def _allan_line(
    phases: Array, lengths: Array, weights: Array, end: int
) -> tuple[Array, Array, float]:
    """Return slope and end (M,) of the line in ln σ²(m), and the variance of its end by weights."""
    curves = []
    for m in lengths.tolist():
        second = phases[:, 2 * m :] - 2.0 * phases[:, m:-m] + phases[:, : -2 * m]
        curves.append(np.einsum("ji,ji->j", second, second) / (2.0 * m * m * second.shape[1]))
    curve = np.log(np.maximum(np.array(curves), _SMALLEST))  # (T, M)
    x = np.log(lengths / end)
    middle = weights @ x / weights.sum()
    pulls = weights * (x - middle) / (weights @ (x - middle) ** 2)
    slope = pulls @ curve
    at_end = weights @ curve / weights.sum() - slope * middle
    return slope, at_end, float(1.0 / weights.sum() + middle**2 / (weights @ (x - middle) ** 2))


def density_with_dof(lagged: Array, count: Counts, removed: Counts) -> tuple[Array, Array]:
    """Return b u² (J,) of eq. (1), and the degrees of freedom (J,) of u by eq. (2).

    Levinson's recursion for the Yule–Walker equations goes through the orders of all rows at once.
    Eq. (2) comes along: the residuals of orders 0, 1, … are uncorrelated, with variances σ_k², so
    1'γ⁻¹1 is the sum of (1 − φ_1 − … − φ_k)²/σ_k² over the orders k < p.

    Parameters
    ----------
    lagged : (J, k) array
        Autocovariances of batch means less their mean or their line.
    count : (J,) array
        How many batch means, b.
    removed : (J,) array
        How many parameters the mean or the line has, m of eq. (1).
    """
    highest = np.minimum(count // 10, (10.0 * np.log10(np.maximum(count, 1))).astype(np.int64))
    orders = int(highest.max())
    lagged = lagged.copy()
    there = lagged[:, 0] > 0.0
    lagged[~there, 0] = 1.0  # equal samples have no density, and are put back to zero below
    variance, phi = lagged[:, 0].copy(), np.zeros((len(lagged), orders))
    memory, inverse = np.zeros(len(lagged)), np.zeros(len(lagged))
    best = _criterion(variance, 0, count)
    chosen = np.array([variance, memory, inverse])
    for order in range(1, orders + 1):
        inverse = inverse + (1.0 - memory) ** 2 / variance
        before = phi[:, : order - 1]
        ahead = (before * lagged[:, order - 1 : 0 : -1]).sum(axis=1)
        partial = np.where(order <= highest, (lagged[:, order] - ahead) / variance, 0.0)
        phi[:, : order - 1] = before - partial[:, None] * before[:, ::-1]
        phi[:, order - 1] = partial
        memory = phi[:, :order].sum(axis=1)
        variance = np.maximum(variance * (1.0 - partial**2), _SMALLEST)
        criterion = _criterion(variance, order, count)
        better = (criterion < best) & (order <= highest)
        best = np.where(better, criterion, best)
        chosen = np.where(better, [variance, memory, inverse], chosen)
    innovation, memory, inverse = chosen
    density = innovation / (1.0 - memory) ** 2
    spread = 2.0 / count + 4.0 * density * inverse / count  # of ln u², eq. (2)
    lost = removed * density / lagged[:, 0] / count  # m / n_eff
    found = np.where(there, density / (1.0 - np.minimum(lost, 0.5)), 0.0)
    return found, np.where(there, np.maximum(2.0 / spread - 1.0, 1.0), np.inf)


def autocovariances(z: Array) -> Array:
    """Return Σ z_i z_(i+k) / b (M, 31), k = 0 … 30, of rows (M, b), by way of their spectrum."""
    count = z.shape[1]
    length = 1 << (count + _LAGS).bit_length()  # so that no lag meets the other end
    spectrum = np.fft.rfft(z, length)
    power = spectrum.real**2 + spectrum.imag**2
    return np.asarray(np.fft.irfft(power, length)[:, : _LAGS + 1] / count)


def _criterion(variance: Array, order: int, count: Counts) -> Array:
    """Return Akaike's corrected criterion of an autoregression."""
    free = np.maximum(count - order - 2, 1)
    return np.asarray(count * np.log(variance) + 2.0 * (order + 1) * count / free)


def _rise(z: Array) -> Array:
    """Return the rise of each least-squares line from begin to end."""
    time = _times(z)
    square = float(time @ time)
    return np.asarray(z @ time / square * z.shape[1]) if square else np.zeros(len(z))


def _about_both(z: Array, rise: Array) -> Array:
    """Return the autocovariances (2 M, k) of rows about their mean, then about their line."""
    centred = z - z.mean(axis=1, keepdims=True)
    left = centred - (rise / z.shape[1])[:, None] * _times(z)
    return np.concatenate([autocovariances(centred), autocovariances(left)])


def _times(z: Array) -> Array:
    return np.asarray(np.arange(z.shape[1]) - (z.shape[1] - 1) / 2.0)


def _edge(batches: Array, density: Array) -> Array:
    count = max(batches.shape[1] // _EDGE, 1)
    middle = batches.mean(axis=1)
    off = np.maximum(
        np.abs(batches[:, :count].mean(axis=1) - middle),
        np.abs(batches[:, -count:].mean(axis=1) - middle),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(density > 0.0, off / np.sqrt(density / count), 0.0))

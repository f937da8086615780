"""The mean of one rest and how well it is known, although its samples are not independent.

`rest_means` returns them of the samples that were fed, `density_with_dof` the density of eq. (1)
with its degrees of freedom, by way of `autocovariances`; `with_rounding` adds what a coarse
converter hides, `is_one_code` tells rests of one value.

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
rest drifts where that slope is above −.45 although σ² does not rise up to b/64 either, as it does
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
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array, Mask, median
from multipos.results import Result, frozen

Counts = NDArray[np.signedinteger[Any]]

_BATCHES = 512


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
        self._left = together[:, count * self._length :].copy()  # a view would keep all of them

    def _feed_runs(self, samples: Array) -> None:
        outputs, count = samples.shape
        begins = np.ones(samples.shape, dtype=np.bool_)
        np.not_equal(samples[:, 1:], samples[:, :-1], out=begins[:, 1:])
        places = np.append(np.flatnonzero(begins), begins.size)  # of one output after the other
        lengths = np.diff(places)
        first = np.searchsorted(places, count * np.arange(outputs))
        lengths[first] += np.where(samples[:, 0] == self._last, self._run, 0)
        self.longest = np.maximum(self.longest, np.maximum.reduceat(lengths, first))
        self._run = lengths[np.append(first[1:], len(lengths)) - 1]
        self._last = samples[:, -1].copy()


class _End:
    """The lowest (sign −1) or highest (sign 1) sample of each output, and how many are there."""

    def __init__(self, outputs: int, sign: float) -> None:
        self._sign = sign
        self.value = np.full(outputs, -sign * np.inf)
        self.count = np.zeros(outputs, dtype=np.int64)

    def feed(self, samples: Array) -> None:
        here = samples.max(axis=1) if self._sign > 0.0 else samples.min(axis=1)
        count = np.count_nonzero(samples == here[:, None], axis=1)
        beyond = self._sign * (here - self.value)
        self.count = np.where(beyond > 0.0, count, self.count + np.where(beyond == 0.0, count, 0))
        self.value = np.where(beyond > 0.0, here, self.value)


_LAGS = 30  # 10 log10(1023), the highest order of an autoregression
_SMALLEST = np.finfo(np.float64).tiny
_TOGETHER = 64  # rests whose means are worked out at once
_ROWS = 32  # rows whose spectra stay in the processor's cache
_EDGE = 10  # an edge is a tenth of a rest
COSINES = 8  # that are kept of a rest
_BLOCKS = 64  # whose sums are as good as batches to them
_COSINES = np.cos(np.pi * np.outer(np.arange(_BLOCKS) + 0.5, np.arange(1, COSINES + 1)) / _BLOCKS)
# Parts of a rest that eq. (3) averages over, and the degrees of freedom of their Allan variances
# for white noise, which are about as many as they overlap.
_PARTS = ((64, 80.0), (32, 40.0), (16, 20.0), (8, 11.6), (4, 4.2))
_SETTLES = -0.45  # slope of ln σ² below which the mean settles; white noise has −1(.17)
_RISES = 0.1  # slope over short times, above which noise has a memory; flicker has 0
_COUNTS = 0.1  # of u, from which rounding counts
_APART = 2.5  # standard deviations of a mean, at which outputs differ
_FINE = 1e3  # steps in a standard deviation, far more than averaging asks for
_BY_PLACE = 0.25  # q², the most that rounding to steps q adds to a variance
_NOISE = np.linspace(0.0, 1.0, 401)  # v of eq. (4), its B, and what samples vary by
_HARMONICS = np.arange(1, 100)[:, None] ** 2 * np.pi**2
_ROUNDED = (np.exp(-4.0 * _HARMONICS * _NOISE) / (2.0 * _HARMONICS)).sum(axis=0)
_VARIES = _NOISE + 1.0 / 12.0 - _ROUNDED
_WALKS = 0.6  # slope over long times, above which it is more than a memory


@frozen
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
    drift_factor : array
        How many times the u of eq. (1) that of eq. (3) is, where the rest drifts, else 1.
    cosines : (M, 8) array
        Squares of its slowest cosines, over their mean if its samples were independent.
    common : array
        How many times the u of eq. (1) the u is by what all rests of a log have in common, else 1
        (`multipos.logs.common_noise`).
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
    drift_factor: Array
    cosines: Array
    common: Array

    @property
    def effective(self) -> Array:
        """Number of independent samples with the same uncertainty of the mean."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (self.sd / self.u) ** 2
        return np.asarray(np.where((self.u > 0.0) & (self.sd > 0.0), ratio, self.n))


def with_rounding(found: Sequence[RestMean], resolution: Array) -> list[RestMean]:
    """Return rests of one sensor with what rounding to steps q adds to u of their means.

    Noise of variance v q² averages rounding out, to the variance B q² over where a mean stands in
    its step, and the samples of a rest then vary by (v + 1/12 − B) q²:

        B = Σ_k exp(−4π²k²v) / (2π²k²).                                                     (4)

    So v is that of the mean over rests, as one rest varies by where it stands, by up to q²/4, and
    the more of a rest that varies by more than that; of outputs together unless they differ.
    """
    q = np.where(resolution > 0.0, resolution, np.inf)
    with np.errstate(over="ignore"):  # steps of one log may be nothing beside another's readings
        share = np.minimum(np.array([each.sd for each in found]) / q, _FINE) ** 2
    kept = np.minimum(share, median(share, axis=0) + _BY_PLACE)
    usual, off = kept.mean(axis=0), _APART * kept.std(axis=0) / np.sqrt(len(kept))
    usual = np.where(np.abs(usual - usual.mean()) <= off, usual.mean(), usual)
    v = np.maximum(np.interp(usual, _VARIES, _NOISE), share - _BY_PLACE)
    rounding = np.where(resolution > 0.0, resolution, 0.0) * np.sqrt(np.interp(v, _NOISE, _ROUNDED))
    u = np.array([each.u for each in found])
    raised = rounding > _COUNTS * u
    u = np.where(raised, np.hypot(u, rounding), u)
    return [replace(each, u=u[i]) if raised[i].any() else each for i, each in enumerate(found)]


def is_one_code(found: RestMean) -> Mask:
    """Tell of which outputs (M,) all samples of a rest are equal."""
    return np.asarray((found.longest >= found.n) & (found.n > 1))


def rest_means(sums: Sequence[RestSum]) -> list[RestMean]:
    """Return what the samples of rests say; all of them must have been fed."""
    found: list[RestMean] = []
    for first in range(0, len(sums), _TOGETHER):
        found += _means_of_some(sums[first : first + _TOGETHER])
    return found


def _means_of_some(sums: Sequence[RestSum]) -> list[RestMean]:
    n = np.array([[each.n] for each in sums])
    longest = np.array([each.longest for each in sums])
    total = np.array([each.sum for each in sums])
    mean = total / n
    square = np.array([each.square for each in sums])
    variance = np.maximum(square - n * mean**2, 0.0) / np.maximum(n - 1, 1)
    variance[longest == n] = 0.0  # what rounding leaves of equal samples

    batches, count = _centred_batches(sums)
    rise, left = _lines(batches, count)
    (density, around), (dof, _) = _densities(batches, left, count)
    # Less than white noise would say is luck, or a hum that fits into the rest.
    plain = np.maximum(np.where(variance > 0.0, density / count, 0.0), variance / n)
    phases = np.concatenate([np.zeros((*plain.shape, 1)), np.cumsum(batches, axis=2)], axis=2)
    dof = np.where(variance > 0.0, dof, n - 1.0)
    u2, dof, drift_factor = _drifting(phases, count[:, 0], plain, dof)
    dof = np.maximum(np.minimum(dof, n - 1.0), 1.0)

    sd, u, drift_u = np.sqrt(variance), np.sqrt(u2), np.sqrt(12.0 * around / count)
    edge = _edge(phases, count, around)
    cosines = _cosines(phases, count, variance / n)
    return [
        RestMean(
            n=each.n,
            mean=each.origin + mean[i],
            sd=sd[i],
            u=u[i],
            drift=rise[i],
            drift_u=drift_u[i],
            edge=edge[i],
            low=each.ends[0].value,
            high=each.ends[1].value,
            at_low=each.ends[0].count,
            at_high=each.ends[1].count,
            longest=each.longest,
            dof=dof[i],
            drift_factor=drift_factor[i],
            cosines=cosines[i],
            common=np.ones_like(sd[i]),
        )
        for i, each in enumerate(sums)
    ]


def _centred_batches(sums: Sequence[RestSum]) -> tuple[Array, Counts]:
    """Return the batch means (R, M, b) of rests less their mean, zeros behind them, and counts."""
    count = np.array([[sum(part.shape[1] for part in each.batches)] for each in sums])
    batches = np.zeros((len(sums), len(sums[0].sum), count.max()))
    for row, each in zip(batches, sums, strict=True):
        end = 0
        for part in each.batches:
            begin, end = end, end + part.shape[1]
            row[:, begin:end] = part
    batches -= batches.sum(axis=2, keepdims=True) / count[:, :, None]
    batches[np.broadcast_to(np.arange(count.max()) >= count[:, :, None], batches.shape)] = 0.0
    return batches, count


def _lines(batches: Array, count: Counts) -> tuple[Array, Array]:
    """Return the rise (R, M) of each least-squares line from begin to end, and what it leaves."""
    place = np.arange(batches.shape[2])
    time = np.where(place < count, place - (count - 1) / 2.0, 0.0)  # (R, b)
    square = np.einsum("rb,rb->r", time, time)
    slope = np.einsum("rmb,rb->rm", batches, time) / np.where(square > 0.0, square, 1.0)[:, None]
    return slope * count, batches - slope[:, :, None] * time[:, None]


def _densities(batches: Array, left: Array, count: Counts) -> tuple[Array, Array]:
    """Return b u² and its degrees of freedom (2, R, M): about the mean, and about the line."""
    outputs, length = batches.shape[1:]
    counts = np.repeat(count, outputs)
    lagged = [autocovariances(each.reshape(-1, length), counts) for each in (batches, left)]
    removed = np.repeat([1, 2], len(counts))
    found = density_with_dof(np.concatenate(lagged), np.tile(counts, 2), removed)
    density, dof = (each.reshape(2, -1, outputs) for each in found)
    return density, dof


def _drifting(
    phases: Array, count: Counts, square: Array, dof: Array
) -> tuple[Array, Array, Array]:
    """Return u² (R, M) by eq. (3) where it is larger, its degrees of freedom, and by how much.

    Parameters
    ----------
    phases : (R, M, b + 1) array
        Sums of the batch means less their mean, from the begin.
    count : (R,) array
        How many batch means each rest has.
    square, dof : (R, M) arrays
        Of eqs. (1) and (2).
    """
    drift_factor = np.ones_like(square)
    long = np.flatnonzero((count >= 2 * _PARTS[0][0]) & (square > 0.0).any(axis=1))
    if not len(long):
        return square, dof, drift_factor
    lengths = count[long, None] // np.array([part for part, _ in _PARTS])
    weights = np.array([nu for _, nu in _PARTS])
    slope, end, spread = _allan_line(phases[long], lengths, weights, count[long])
    drifts = np.zeros(square.shape, dtype=np.bool_)
    for i in np.flatnonzero((slope > _SETTLES).any(axis=1)).tolist():
        short = np.array([[1 << k for k in range(int(lengths[i, 0]).bit_length())]])
        rest = long[i : i + 1]
        rise, _, _ = _allan_line(phases[rest], short, 1.0 / short[0], count[rest])
        drifts[rest] = np.where(rise < _RISES, slope[i] > _SETTLES, slope[i] > _WALKS)
    raised, dof_left = np.zeros_like(square), np.ones_like(square)
    raised[long], dof_left[long] = 2.0 * np.exp(end), 1.0 / spread[:, None]
    more = drifts & (raised > square) & (square > 0.0)
    drift_factor[more] = np.sqrt(raised[more] / square[more])
    return np.where(more, raised, square), np.where(more, dof_left, dof), drift_factor


def _allan_line(
    phases: Array, lengths: Counts, weights: Array, end: Counts
) -> tuple[Array, Array, Array]:
    """Return slope and end (R, M) of the line in ln σ²(m), and the variance (R,) of its end.

    Parameters
    ----------
    phases : (R, M, b + 1) array
    lengths : (R, T) array
        m, for each rest its own.
    weights : (T,) array
        Degrees of freedom of σ²(m).
    end : (R,) array
        Batch means of each rest: where the line ends.
    """
    variances = [
        [_allan_variance(rest[:, : b + 1], m) for m in row]
        for rest, row, b in zip(phases, lengths.tolist(), end.tolist(), strict=True)
    ]
    curve = np.log(np.maximum(np.array(variances), _SMALLEST))  # (R, T, M)
    x = np.log(lengths / end[:, None])
    middle = x @ weights / weights.sum()
    off = x - middle[:, None]
    square = off**2 @ weights
    slope = np.einsum("rt,rtm->rm", weights * off / square[:, None], curve)
    height = np.einsum("t,rtm->rm", weights, curve) / weights.sum()
    return slope, height - slope * middle[:, None], 1.0 / weights.sum() + middle**2 / square


def _allan_variance(phases: Array, m: int) -> Array:
    """Return σ²(m) (M,) from the sums of batch means."""
    first = phases[:, m:] - phases[:, :-m]
    second = first[:, m:] - first[:, :-m]
    return np.asarray(np.einsum("ji,ji->j", second, second) / (2.0 * m * m * second.shape[1]))


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
    there = lagged[:, 0] > _SMALLEST**0.5
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
        variance = np.maximum(variance * (1.0 - partial**2), _SMALLEST**0.5)
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


def autocovariances(z: Array, count: Counts) -> Array:
    """Return Σ z_i z_(i+k) / b (J, 31), k = 0 … 30, of rows (J, n), by way of their spectrum.

    Of each row `count` (J,) numbers count, b, and zeros stand behind them.
    """
    length = (z.shape[1] + _LAGS) // 128 * 128 + 128  # so that no lag meets the other end
    products = []
    for first in range(0, len(z), _ROWS):
        spectrum = np.fft.rfft(z[first : first + _ROWS], length)
        power = spectrum.real**2 + spectrum.imag**2
        products.append(np.fft.irfft(power, length)[:, : _LAGS + 1])
    return np.asarray(np.concatenate(products) / count[:, None])


def _criterion(variance: Array, order: int, count: Counts) -> Array:
    """Return Akaike's corrected criterion of an autoregression."""
    free = np.maximum(count - order - 2, 1)
    return np.asarray(count * np.log(variance) + 2.0 * (order + 1) * count / free)


def _edge(phases: Array, count: Counts, density: Array) -> Array:
    """Return how far the first and the last tenth of each rest (R, M) are off, the larger."""
    tenth = np.maximum(count // _EDGE, 1)  # (R, 1)
    rest = np.arange(len(phases))[:, None]
    output = np.arange(phases.shape[1])
    first = phases[rest, output, tenth]
    last = phases[rest, output, count] - phases[rest, output, count - tenth]
    off = np.maximum(np.abs(first), np.abs(last)) / tenth
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(density > 0.0, off / np.sqrt(density / tenth), 0.0))


def _cosines(phases: Array, count: Counts, square: Array) -> Array:
    """Return the squared cosines (R, M, 8) of rests over their mean if u² is `square` (R, M)."""
    ends = np.rint(count * (np.arange(_BLOCKS + 1) / _BLOCKS)).astype(np.intp)  # (R, 65)
    sums = np.diff(np.take_along_axis(phases, ends[:, None, :], axis=2), axis=2)
    scale = count[:, :, None] ** 2 * np.where(square > 0.0, square, 1.0)[:, :, None]
    return np.asarray(2.0 * (sums @ _COSINES) ** 2 / scale)

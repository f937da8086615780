"""The samples of one rest, taken up piece by piece: sums, extremes, and the means of batches.

A rest of n samples is cut into batches of equal length, 512 to 1023 of them, or the samples
themselves; what they say is for `multipos.logs.rest_means`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array

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

"""Noise of known laws, for the tests of static records."""

import numpy as np


def white(rng, n, density=1.0):
    """N = density, in units of the samples and one sample time."""
    return density * rng.standard_normal(n)


def flicker(rng, n, instability=1.0):
    """B = instability: white noise through the filter (1 − 1/z)^(−1/2) [1].

    Its spectrum is B²/(π 2 sin πf) from both sides together, at low frequencies B²/(2π f) on each.

    [1] N. J. Kasdin, Proc. IEEE 83 (1995), 802–827.
    """
    k = np.arange(1, n)
    h = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
    size = 1 << (2 * n - 1).bit_length()
    noise = np.fft.rfft(rng.standard_normal(n), size)
    return instability * np.fft.irfft(np.fft.rfft(h, size) * noise, size)[:n]


def walk(rng, n, step=1.0):
    """K = step."""
    return np.cumsum(step * rng.standard_normal(n))

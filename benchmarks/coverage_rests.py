"""How often the u of a mean holds the truth, by each rest alone and by all of a log together.

Noise of a generator of its own: white noise of three outputs, alone or with flicker noise or a
random walk as large as white noise after a given share of a rest, on through rests and moves of
half their length. The truth of a mean is the mean of the slow noise over sixteen rest lengths with
the rest in their middle. Printed are how many means t u holds by each rest alone, and by all
together; how many are said not to settle; how many are held or said; and the mean of u over that
of each rest alone.
"""

import argparse
import math
from typing import Any

import numpy as np
from scipy.special import stdtrit

from multipos.logs.common_noise import settle_together
from multipos.logs.rest_means import RestMean, RestSum, rest_means

Array = np.ndarray[Any, Any]
COUNTS = (1, 6, 12, 24, 38)
CORNERS = (0.3, 1.0, 3.0)  # rest lengths at which both Allan variances are the same
LONGEST = 2000  # samples: ten seconds at 200 Hz
SHORTEST = 100  # two seconds at 50 Hz


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_rests")
    parser.add_argument("--rests", type=int, default=1000, help="that are simulated for a line")
    parser.add_argument("--samples", type=int, help="of a rest; lengths of all kinds otherwise")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    for count in COUNTS:
        for law, corner in (("white", 1.0), *((k, c) for k in LAWS for c in CORNERS)):
            rng = np.random.default_rng(chosen.seed)
            runs = range(math.ceil(chosen.rests / count))
            told = [one(rng, law, corner, drawn(rng, count, chosen.samples)) for _ in runs]
            alone, together, said, either, ratio = np.mean(np.concatenate(told), axis=0)
            name = law if law == "white" else f"{law}, {corner:g}"
            print(
                f"| {count} | {name} | {100 * alone:.1f} | {100 * together:.1f} | "
                f"{100 * said:.1f} | {100 * either:.1f} | {ratio:.2f} |",
                flush=True,
            )


def drawn(rng: np.random.Generator, count: int, samples: int | None) -> Array:
    """Return the samples of rests: of one length, or of lengths even in their logarithm."""
    if samples is not None:
        return np.full(count, samples)
    return np.exp(rng.uniform(math.log(SHORTEST), math.log(LONGEST), count)).astype(np.intp)


def one(rng: np.random.Generator, law: str, corner: float, lengths: Array) -> Array:
    """Return what becomes of the means of a session: rows of held, held, said, either, ratio."""
    middles = np.cumsum(lengths + lengths[::-1] // 2) - lengths // 2 + 8 * lengths.max()
    total = int(middles[-1] + 9 * lengths.max())
    slow = np.zeros((3, total))
    if law != "white":
        slow = np.array([LAWS[law](rng, total, corner * np.median(lengths)) for _ in range(3)])
    sums = np.cumsum(np.pad(slow, ((0, 0), (1, 0))), axis=1)
    rests, truth = [], []
    for n, middle in zip(lengths.tolist(), middles.tolist(), strict=True):
        first = middle - n // 2
        rests.append(RestSum(n, 3))
        rests[-1].feed(slow[:, first : first + n] + rng.standard_normal((3, n)))
        truth.append((sums[:, middle + 8 * n] - sums[:, middle - 8 * n]) / (16 * n))
    found = rest_means(rests)
    settled = settle_together(found, lengths)
    error = np.abs(stacked(found, "mean") - truth)
    alone, together = (
        error <= stdtrit(stacked(each, "dof"), 0.975) * stacked(each, "u")
        for each in (found, settled)
    )
    said = np.maximum(stacked(settled, "common"), stacked(settled, "wander")) > 1.0
    ratio = stacked(settled, "u") / stacked(found, "u")
    columns = (alone, together, said, together | said, ratio)
    return np.column_stack([np.ravel(each) for each in columns])


def stacked(rests: list[RestMean], name: str) -> Array:
    return np.array([getattr(each, name) for each in rests])


def flicker(rng: np.random.Generator, total: int, corner: float) -> Array:
    """White noise through (1 − 1/z)^(−1/2), by N. J. Kasdin, Proc. IEEE 83 (1995), 802–827."""
    steps = np.arange(1, total)
    weights = np.concatenate([[1.0], np.cumprod((steps - 0.5) / steps)])
    size = 1 << (2 * total - 1).bit_length()
    noise = np.fft.rfft(rng.standard_normal(total), size) * np.fft.rfft(weights, size)
    instability = math.sqrt(math.pi / (2.0 * math.log(2.0) * corner))  # .664² B² = 1/corner
    return np.asarray(instability * np.fft.irfft(noise, size)[:total])


def walk(rng: np.random.Generator, total: int, corner: float) -> Array:
    """Steps of K with K² corner/3 = 1/corner."""
    return np.asarray(math.sqrt(3.0) / corner * np.cumsum(rng.standard_normal(total)))


LAWS = {"flicker": flicker, "walk": walk}


if __name__ == "__main__":
    main()

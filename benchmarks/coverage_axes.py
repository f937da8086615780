"""How often U holds the truth of a sensor turned by hand whose axes differ in noise.

Readings come from a generator of their own: a sensor with bias, scale factors and cross terms, held
anyhow, with normal noise of another size along each axis. Nothing is stated of it, or one size for
all axes (that of the quietest), or the truth. Printed are the mean coverage of all parameters, that
of the worst, and the mean of U over that of least squares if the noise were known.
"""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

import multipos as mp

from .coverage import BIAS, MATRIX, NORMAL, of_truth

QUIET = 1e-4  # [g]
POSITIONS = (12, 18, 24, 48)
NOISE = ((1, 1, 1), (1, 1, 2), (1, 3, 1), (1, 1, 10), (10, 10, 1))
CLAIMS = ("nothing", "equal", "right")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_axes", description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    print("| positions | noise of x, y, z | stated | mean % | worst % | U |")
    print("|---|---|---|---|---|---|")
    for count, noise, claim in cases():
        found = [one(rng, count, np.array(noise), claim) for _ in range(chosen.runs)]
        held, ratio = zip(*[each for each in found if each is not None], strict=True)
        share = 100.0 * np.mean(held, axis=0)
        print(
            f"| {count} | {' : '.join(map(str, noise))} | {claim} | {share.mean():.1f} | "
            f"{share.min():.1f} | {np.mean(ratio):.2f} |",
            flush=True,
        )


def cases() -> Iterator[tuple[int, tuple[int, ...], str]]:
    for count in POSITIONS:
        for noise in NOISE:
            for claim in CLAIMS if noise == (1, 1, 10) else CLAIMS[:1]:
                yield count, noise, claim


def one(
    rng: np.random.Generator, count: int, noise: np.ndarray, claim: str
) -> tuple[np.ndarray, float] | None:
    """Return which parameters U holds, and its mean length; None where a set is refused."""
    up = rng.standard_normal((count, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    sd = QUIET * noise
    values = BIAS + up @ MATRIX.T + sd * rng.standard_normal(up.shape)
    stated: dict[str, Any] = {"equal": {"reading_sd": QUIET}, "right": {"reading_sd": sd}}
    try:
        cal = mp.fit(mp.Readings(values), unknown_orientation=True, **stated.get(claim, {}))
    except mp.MultiposError:
        return None
    truth = np.array([of_truth(output, term) for output, term in cal.model.keys])
    held = np.abs(cal.parameters - truth) <= cal.U
    return held, float(np.mean(cal.U / (NORMAL * scatter(cal.model.keys, up, sd))))


def scatter(keys: tuple[tuple[str, Any], ...], up: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return the standard deviations of parameters by least squares along the normals."""
    normal = up @ np.linalg.inv(MATRIX)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    columns = {"1": np.ones(len(up)), "x": up[:, 0], "y": up[:, 1], "z": up[:, 2]}
    a = np.column_stack(
        [normal[:, "xyz".index(output[1])] * columns[str(term)] for output, term in keys]
    )
    gain = np.linalg.pinv(a)
    return np.asarray(np.sqrt(gain**2 @ (normal**2 @ sd**2)))


if __name__ == "__main__":
    main()

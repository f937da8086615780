"""Does U of sessions that were combined cover a session never seen?

Six faces, each session with a noise of .3 mg, stated or not, or of .3, .6 and .9 mg in turn, as
stated. From session to session biases, scale factors and the mounting move by so many of the u
that one session has of them. Covered are the parameters of a session that took no part, by kind;
beside them the mean U of a bias against 1.96 standard deviations of what it is about, known with
the variance between sessions and with the best weights. `--law` works the same out for the law of
U alone, of sessions that differ by a kind of three parameters or of one, without a fit.
"""

import argparse
import math
import warnings
from typing import Any

import numpy as np

import multipos as mp
from multipos.verification.combining import predict_next

FACES = mp.read_scheme("faces-6").up
SD = 3e-4  # [g]
COUNTS, BETWEEN = (2, 3, 4, 6, 8), (0.0, 0.5, 1.0, 2.0, 5.0)
NOISES = {"equal": (SD,), "unequal": (SD, 2.0 * SD, 3.0 * SD), "not stated": (SD,)}
KINDS = {"bias": (0, 4, 8), "scale": (1, 6, 11), "cross": (2, 3, 5, 7, 9, 10)}
Array = np.ndarray[Any, Any]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_sessions")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--law", action="store_true", help="the law of U alone")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    head = " | ".join(f"{size:g} u" for size in BETWEEN)
    print(f"| noise | sessions | {head} | U of agreeing |\n|---{'|---' * (len(BETWEEN) + 2)}|")
    for name in ("three", "one") if chosen.law else NOISES:
        for count in COUNTS:
            cells: list[Array] = []
            for size in BETWEEN:
                rng = np.random.default_rng([chosen.seed, count, round(10.0 * size)])
                draw = law if chosen.law else run
                cells.append(np.mean([draw(rng, name, count, size) for _ in range(chosen.runs)], 0))
            said = " | ".join(" ".join(f"{100.0 * share:.1f}" for share in c[:-1]) for c in cells)
            print(f"| {name} | {count} | {said} | {cells[0][-1]:.2f} |", flush=True)


def run(rng: np.random.Generator, name: str, count: int, size: float) -> Array:
    """Return the shares of parameters covered, by kind, and how long U of a bias is."""
    noises = [NOISES[name][i % len(NOISES[name])] for i in range(count)]
    mean = math.sqrt(float(np.mean(np.square(noises))))
    fits = []
    for noise in noises:
        b, K = drawn(rng, size * mean)
        values = b + FACES @ K.T + noise * rng.standard_normal(FACES.shape)
        stated = {} if name == "not stated" else {"reading_sd": noise}
        fits.append(mp.fit(mp.Readings(values, up=FACES, unit="g"), **stated))
    one = mp.compare(*fits, combine=True).combined
    b, K = drawn(rng, size * mean)
    truth = np.column_stack([b, K]).ravel()
    held = np.abs(one.parameters - truth) <= one.U
    between = (size * mean) ** 2 / 6.0
    own = np.square(noises) / 6.0
    sd = math.sqrt(between + 1.0 / np.sum(1.0 / (between + own)))
    shares = [float(held[list(places)].mean()) for places in KINDS.values()]
    return np.array([*shares, float(one.U[list(KINDS["bias"])].mean()) / (1.96 * sd)])


def law(rng: np.random.Generator, name: str, count: int, size: float) -> Array:
    """Return the same of parameters alone, whose u in a session is 1."""
    q = {"three": 3, "one": 1}[name]
    p = size * rng.standard_normal((count + 1, q))
    seen = p[:count] + rng.standard_normal((count, q))
    one, share = np.ones((count, q)), np.full((count, q), 1.0 / count)
    U, _ = predict_next(seen, one, share, 1e6)
    sd = math.sqrt(size**2 + (size**2 + 1.0) / count)
    held = np.abs(seen.mean(axis=0) - p[count]) <= U
    return np.array([held.mean(), U.mean() / (1.96 * sd)])


def drawn(rng: np.random.Generator, noise: float) -> tuple[Array, Array]:
    """Return biases (3,) and the matrix (3, 3) of a session, whose u six faces of a noise have."""
    b = noise / math.sqrt(6.0) * rng.standard_normal(3)
    x, y, z = noise / math.sqrt(2.0) * rng.standard_normal(3)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return b, np.eye(3) + K + np.diag(noise / math.sqrt(2.0) * rng.standard_normal(3))


if __name__ == "__main__":
    main()

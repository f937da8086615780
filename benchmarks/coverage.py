"""How often U holds the truth where a claimed noise is right, too small, or nearly nothing.

Readings come from a generator of their own: a sensor with bias, scale factors and cross terms,
normal noise, and positions turned off by a normal angle where they are uncertain. Printed are the
mean coverage of all parameters, that of the worst, and, at known positions, the mean of U over what
it would be if the noise were known.
"""

import argparse
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import multipos as mp

BIAS = np.array([0.02, -0.03, 0.01])
MATRIX = np.array([[1.01, 0.0, 0.0], [-0.012, 0.99, 0.0], [0.004, 0.011, 1.005]])
NORMAL = 1.959964  # 95 % of a noise that is known
CLAIMS = (1.0, 0.7, 0.5, 0.3, 0.1)  # of the noise


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    print("| readings | claim | mean % | worst % | U |\n|---|---|---|---|---|")
    for name, outputs, draw in settings(rng):
        for claim in CLAIMS:
            held, ratio = zip(*(one(draw, claim, outputs) for _ in range(chosen.runs)), strict=True)
            share = 100.0 * np.mean(held, axis=0)
            print(
                f"| {name} | × {claim:g} | {share.mean():.1f} | {share.min():.1f} | "
                f"{'–' if math.isnan(ratio[0]) else f'{np.mean(ratio):.2f}'} |",
                flush=True,
            )


Draw = Callable[[], tuple[dict[str, Any], Any, dict[str, Any]]]


def settings(rng: np.random.Generator) -> Iterator[tuple[str, int, Draw]]:
    """Yield name, number of outputs, and what draws readings, their noise and the options."""

    def known(count: int) -> Draw:
        def draw() -> tuple[dict[str, Any], float, dict[str, Any]]:
            up, sd = spread_out(count), 1e-3
            return {"values": sense(up, sd, rng), "up": up}, sd, {}

        return draw

    def uncertain(count: int, degrees: float) -> Draw:
        def draw() -> tuple[dict[str, Any], float, dict[str, Any]]:
            up, sd = spread_out(count), 30e-6
            turned = up + np.cross(np.radians(degrees) * rng.standard_normal(up.shape), up)
            turned /= np.linalg.norm(turned, axis=1)[:, None]
            return {"values": sense(turned, sd, rng), "up": up}, sd, {"orientation_sd": degrees}

        return draw

    def unknown(count: int, *axes: float) -> Draw:
        def draw() -> tuple[dict[str, Any], Any, dict[str, Any]]:
            turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            up, sd = spread_out(count) @ turn, 1e-3 * np.array(axes or 1.0)
            return {"values": sense(up, sd, rng)}, sd, {"unknown_orientation": True}

        return draw

    yield "6 positions", 3, known(6)
    yield "6 positions, one output", 1, known(6)
    yield "12 positions", 3, known(12)
    yield "24 positions", 3, known(24)
    yield "12, placed to 0.05°", 3, uncertain(12, 0.05)
    yield "24, placed to 0.05°", 3, uncertain(24, 0.05)
    yield "18, turned by hand", 3, unknown(18)
    yield "24, turned by hand", 3, unknown(24)
    yield "18, by hand, axes 1 : 1 : 3", 3, unknown(18, 1.0, 1.0, 3.0)
    yield "48, by hand, axes 1 : 1 : 3", 3, unknown(48, 1.0, 1.0, 3.0)


def one(draw: Draw, claim: float, outputs: int) -> tuple[np.ndarray, float]:
    """Return which parameters U holds, and its mean length against a noise that is known."""
    columns, sd, options = draw()
    columns["values"] = columns["values"][:, :outputs]
    listed = {} if options else {"orientation_sd": 0}
    given = {"reading_sd": claim * sd, "exclude": "none", **listed, **options}
    cal = mp.fit(mp.Readings(**columns), **given)
    truth = np.array([of_truth(output, term) for output, term in cal.model.keys])
    held = np.abs(cal.parameters - truth) <= cal.U
    if options:
        return held, math.nan
    design = np.column_stack([np.ones(len(columns["up"])), columns["up"]])
    u = sd * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return held, float(np.mean(cal.U[:4] / (NORMAL * u)))


def of_truth(output: str, term: object) -> float:
    i = "xyz".index(output[1])
    return float(BIAS[i] if str(term) == "1" else MATRIX[i, "xyz".index(str(term))])


def spread_out(count: int) -> np.ndarray:
    """Return six faces, or a spiral of directions."""
    if count == 6:
        return np.vstack([np.eye(3), -np.eye(3)])
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])


def sense(up: np.ndarray, sd: Any, rng: np.random.Generator) -> np.ndarray:
    return BIAS + up @ MATRIX.T + sd * rng.standard_normal(up.shape)


if __name__ == "__main__":
    main()

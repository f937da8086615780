"""How often U holds the truth of a record given row by row, whose noise is correlated in time.

Noise of a generator of its own: independent rows, rows whose neighbours have a correlation, and a
random walk; positions spread over the sphere, so many rows each, one position after the other or
in passes over all of them. Printed are the coverage of the biases, of all other parameters, and of
the biases by rows taken as independent, and the medians of the effective number of rows and of U
of a bias over that of independent rows.
"""

import argparse
import warnings
from typing import Any

import numpy as np

import multipos as mp
from benchmarks.coverage import spread_out

Array = np.ndarray[Any, Any]
SD = 1e-3  # [g]
NOISES: dict[str, float | None] = {"white": 0.0, ".5": 0.5, ".9": 0.9, ".97": 0.97, "walk": None}
RECORDS = (
    ("12 × 20 rows", 12, 20, 1, tuple(NOISES)),
    ("24 × 50 rows", 24, 50, 1, tuple(NOISES)),
    ("24, 50 passes", 24, 1, 50, ("white", ".97")),
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_records")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    for name, count, rows, passes, noises in RECORDS:
        up = np.tile(np.repeat(spread_out(count), rows, axis=0), (passes, 1))
        for noise in noises:
            rng = np.random.default_rng(chosen.seed)
            found = [one(rng, up, NOISES[noise]) for _ in range(chosen.runs)]
            biases, others, before = 100.0 * np.mean(found, axis=0)[:3]
            worth, ratio = np.median(found, axis=0)[3:]
            print(
                f"| {name} | {noise} | {biases:.1f} | {others:.1f} | {before:.1f} | "
                f"{worth:.0f} of {len(up)} | {ratio:.1f} |",
                flush=True,
            )


def one(rng: np.random.Generator, up: Array, correlation: float | None) -> tuple[float, ...]:
    noise = np.column_stack([drawn(rng, len(up), correlation) for _ in range(3)])
    cal = mp.fit(mp.Readings(up + SD * noise, up=up), orientation_sd=0, exclude="none")
    held = np.abs(cal.parameters - np.eye(3, 4, 1).ravel()) <= cal.U
    H = np.column_stack([np.ones(len(up)), up])
    plain = 1.96 * cal.residual_sd[:, None] * np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
    bias = np.arange(12) % 4 == 0
    before = np.abs(cal.parameters[bias]) <= plain[:, 0]
    rows = cal.effective_rows or {"ax": float(len(up))}
    ratio = cal.U[bias] / plain[:, 0]
    return (
        float(held[bias].mean()),
        float(held[~bias].mean()),
        float(before.mean()),
        rows["ax"],
        float(ratio.mean()),
    )


def drawn(rng: np.random.Generator, n: int, correlation: float | None) -> Array:
    """Return noise of variance one, a random walk of unit steps for no correlation."""
    steps = rng.standard_normal(n)
    if correlation is None:
        return np.cumsum(steps)
    for k in range(1, n):
        steps[k] = correlation * steps[k - 1] + np.sqrt(1.0 - correlation**2) * steps[k]
    return steps


if __name__ == "__main__":
    main()

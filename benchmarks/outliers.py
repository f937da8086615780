"""How often a fit names an outlier: in good sets, alike or not from row to row, and where one is.

Noise of a generator of its own, of one sd or with rows of three groups whose sd differ, which
nobody states: in turns, in blocks, drawn. An error of so many rms of the noise is added to one
reading, or of that size to all outputs of one row; it is found where its row is named. Beside it
what a test can do that knows more than any fit: that rows are of 4:2:1 in equal parts, or all alike
with one error among them. It looks at the reading that takes most of its output's sum of squares,
names 1 % where good rows are alike by that share, and of these 1.5 % where they are of 4:2:1, by
the ratio of likelihoods: scales of outputs from the other readings, the common factor and the size
of the error integrated over. Both rates are its `good`.
"""

import argparse
import warnings
from typing import Any

import numpy as np
from scipy.special import logsumexp

import multipos as mp
from benchmarks.coverage import spread_out

Array = np.ndarray[Any, Any]
SD = 1e-4  # [g]
ERRORS = (6.0, 8.0, 11.0)  # rms of the noise
KNOWN = np.array([4.0, 2.0, 1.0])
NOMINAL, ALLOWED = 0.01, 0.015  # of good sets whose rows are alike, and of 4:2:1
ROWS: dict[str, tuple[tuple[float, float, float], str]] = {
    "alike": ((1.0, 1.0, 1.0), "in turns"),
    "4:2:1 in turns": ((4.0, 2.0, 1.0), "in turns"),
    "4:2:1 in blocks": ((4.0, 2.0, 1.0), "in blocks"),
    "4:2:1 drawn": ((4.0, 2.0, 1.0), "drawn"),
    "10:1:1 in turns": ((10.0, 1.0, 1.0), "in turns"),
    "10:1:1 in blocks": ((10.0, 1.0, 1.0), "in blocks"),
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.outliers", description=__doc__)
    parser.add_argument("--runs", type=int, default=1000, help="good sets of each kind")
    parser.add_argument("--errors", type=int, default=300, help="sets with an error, of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--positions", type=int, nargs="+", default=[12, 24, 48])
    parser.add_argument("--outputs", type=int, nargs="+", default=[3, 2])
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    sizes = " | ".join(f"{size:g} rms" for size in ERRORS)
    print(f"| positions, outputs | rows | good | {sizes} | a row, {ERRORS[-1]:g} rms |")
    print("|---" * (4 + len(ERRORS)) + "|")
    for outputs in chosen.outputs:
        for count in chosen.positions:
            up = spread_out(count)
            for rows in ROWS:
                rng = np.random.default_rng(chosen.seed)
                good = named(rng, up, outputs, rows, chosen.runs, 0.0, False)
                found = [
                    named(rng, up, outputs, rows, chosen.errors, size, False) for size in ERRORS
                ]
                whole = named(rng, up, outputs, rows, chosen.errors, ERRORS[-1], True)
                line = " | ".join(f"{share:.0f}" for share in (*found, whole))
                print(f"| {count}, {outputs} | {rows} | {good:.1f} | {line} |", flush=True)
            rng = np.random.default_rng(chosen.seed)
            good, unlike, *found = informed(rng, up, outputs, chosen.runs)
            line = " | ".join(f"{share:.0f}" for share in found)
            rates = f"{good:.1f}, {unlike:.1f}"
            print(f"| {count}, {outputs} | a test that knows | {rates} | {line} | – |", flush=True)


def named(
    rng: np.random.Generator,
    up: Array,
    outputs: int,
    rows: str,
    runs: int,
    size: float,
    whole: bool,
) -> float:
    """Return in how many percent a position is named, of sets with an error that one."""
    count = 0
    for _ in range(runs):
        noise, row, _ = drawn(rng, len(up), outputs, rows, size, whole)
        names = ("ax", "ay", "az")[:outputs]
        values = up[:, :outputs] + SD * noise
        readings = mp.Readings(values, up=up, outputs=names)
        cal = mp.fit(readings, orientation_sd=0, exclude="none")
        said = [finding for finding in cal.diagnostics.findings if finding.code == "outlier"]
        if size == 0.0:
            count += bool(said)
        else:
            count += any(str(row + 1) in finding.rows for finding in said)
    return 100.0 * count / runs


def drawn(
    rng: np.random.Generator, n: int, outputs: int, rows: str, size: float, whole: bool
) -> tuple[Array, int, int]:
    """Return noise (n, outputs) with an error in it, and the row and output of that."""
    groups, layout = ROWS[rows]
    sd = np.repeat(groups, -(-n // 3))[:n] if layout == "in blocks" else np.resize(groups, n)
    if layout == "drawn":
        sd = rng.choice(groups, n)
    noise = sd[:, None] * rng.standard_normal((n, outputs))
    row, output = int(rng.integers(n)), int(rng.integers(outputs))
    error = size * np.sqrt(np.mean(sd**2)) * rng.choice([-1.0, 1.0], outputs)
    if whole:
        noise[row] += error
    else:
        noise[row, output] += error[output]
    return noise, row, output


def informed(rng: np.random.Generator, up: Array, outputs: int, runs: int) -> list[float]:
    """Return what the test that knows names, in percent: of good sets alike, 4:2:1, of errors."""
    X = np.column_stack([np.ones(len(up)), up])
    left = np.eye(len(up)) - X @ np.linalg.pinv(X)
    n, found = len(up), {}
    for rows, size in (("alike", 0.0), ("4:2:1 in turns", 0.0), *(("alike", x) for x in ERRORS)):
        found[rows, size] = []
        for _ in range(runs):
            noise, *place = drawn(rng, n, outputs, rows, size, False)
            share, ratio, *where = odds(left, noise)
            found[rows, size].append((share, ratio, size == 0.0 or place == where))
    limit = np.quantile([share for share, *_ in found["alike", 0.0]], 1.0 - NOMINAL)
    ratios = [r if share > limit else -np.inf for share, r, _ in found["4:2:1 in turns", 0.0]]
    level = np.quantile(ratios, 1.0 - ALLOWED, method="higher")
    return [
        100.0 * np.mean([share > limit and r > level and there for share, r, there in sets])
        for sets in found.values()
    ]


def odds(left: Array, noise: Array) -> tuple[float, float, int, int]:
    """Return the largest share of a reading in its sum of squares, the odds, and where it is.

    The odds are the logarithm of those of an error there, in rows alike, over rows of 4:2:1.
    """
    n, outputs = noise.shape
    e = left @ noise
    d2 = e**2 / np.diag(left)[:, None]  # what a reading takes from the sum of squares
    share = d2 / np.sum(e**2, axis=0)
    row, output = np.unravel_index(int(np.argmax(share)), share.shape)
    error = e[row, output] / left[row, row]
    weight = np.tile(np.diag(left)[:, None], outputs)
    e[:, output] -= left[:, row] * error
    weight[:, output] -= left[:, row] ** 2 / left[row, row]
    weight[row, output] = 0.0
    scale = np.sum(e**2, axis=0) / weight.sum(axis=0)
    r2 = e**2 / np.maximum(weight, 1e-9) / scale
    own = error**2 * left[row, row] / scale[output]
    q, dims = r2.sum(axis=1), np.full(n, float(outputs))
    dims[row] -= 1.0
    each = weight.sum(axis=1) / dims
    sd = np.geomspace(0.1, 2.5, 50)[:, None]
    alike = logsumexp(-0.5 * (each * q).sum() / sd**2 - (each * dims).sum() * np.log(sd))
    mixed = (each * of_rows(q, dims, sd)).sum(axis=1)
    q[row], dims[row] = q[row] + own, float(outputs)
    mixed += of_rows(q, dims, sd)[:, row]
    q[row], dims[row] = q[row] - own, outputs - 1.0
    mixed -= of_rows(q, dims, sd)[:, row]
    ratio = float(alike - 0.5 * np.log(own) - logsumexp(mixed))
    return float(share.max()), ratio, int(row), int(output)


def of_rows(q: Array, dims: Array, sd: Array) -> Array:
    """Return ln of the density of every row (sd, n), but for factors of 2 pi."""
    each = sd[..., None] * KNOWN
    return np.asarray(logsumexp(-0.5 * q[:, None] / each**2 - dims[:, None] * np.log(each), axis=2))


if __name__ == "__main__":
    main()

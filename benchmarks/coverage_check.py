"""How often a run in control is called inconsistent, and how often a run within its limit fails.

A triad is calibrated at the positions of a scheme and checked by another run at the same ones, both
written out here: y = b + M u + noise, u from the angles of the faces and edges of a cube. Printed,
by what is known of the noise: the share of runs called inconsistent, of runs with a finding, of
runs in which a zero moved by 7 U between the days is told, and the median En. Then the same run
with a true error of 2.5 mg in every output at every position against a limit of 3 mg: the share
that fails
by the worst of its errors, and by the verdict of the run.
"""

import argparse
import itertools
import warnings

import numpy as np

import multipos as mp

NOISE, TRUE_ERROR, LIMIT = 1e-3, 2.5e-3, 3e-3  # [g]
EXACT = 1e-5  # [g], noise of the calibration against which a true error stands
BIAS = np.array([0.012, -0.02, 0.005])
MATRIX = np.array([[1.01, 0.002, -0.001], [0.003, 0.99, 0.001], [0.003, -0.002, 1.004]])


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.coverage_check", description=__doc__
    )
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    known = {"reading_sd": NOISE}
    print("| noise | inconsistent | finding | zero moved by 7 U told | median En |")
    print("|---|---|---|---|---|")
    for name, fit, check in (
        ("by residuals", {}, {}),
        ("by residuals, pooled", {"pool": True}, {}),
        ("stated", known, known),
    ):
        found = [control(rng, fit, check) for _ in range(chosen.runs)]
        moved = [control(rng, fit, check, moved=7.0) for _ in range(chosen.runs // 10)]
        p, findings, ratios = zip(*found, strict=True)
        told = np.mean([finding for _, finding, _ in moved])
        print(
            f"| {name} | {100 * np.mean(np.array(p) < 0.05):.1f} % "
            f"| {100 * np.mean(findings):.1f} % "
            f"| {100 * told:.0f} % | {np.median(np.concatenate(ratios)):.2f} |"
        )
    verdicts = np.array([off_by_a_known_error(rng) for _ in range(chosen.runs)])
    worst, run = 100 * np.mean(verdicts == "fail", axis=0)
    said = f"{worst:.1f} % fail by the worst, {run:.1f} % by the run"
    print(f"\n2.5 mg against 3 mg at 36 errors: {said}")


def control(rng, fit, check, moved=0.0):
    """Return p of one run, whether there is a finding, and its En."""
    calibration = mp.fit(readings(rng, NOISE), orientation_sd=0, exclude="none", **fit)
    off = moved * np.array([calibration["bias_ax"].U, 0.0, 0.0])
    found = mp.check(calibration, readings(rng, NOISE, off), **check)
    return found.consistency.p, bool(found.findings), found.En.ravel()


def off_by_a_known_error(rng):
    """Return the worst verdict and that of the run, of 12 positions that are all off by 2.5 mg."""
    calibration = mp.fit(readings(rng, EXACT, number=12), orientation_sd=0, exclude="none")
    off = TRUE_ERROR * MATRIX.sum(axis=1)  # of the readings, so that force is off so much
    run = readings(rng, NOISE, off, number=12)
    found = mp.check(calibration, run, limit_g=LIMIT, reading_sd=NOISE)
    return found.verdict, found.run_verdict


def readings(rng, noise, off=0.0, number=18):
    """Return readings at the six faces and the first of the twelve edges."""
    steps = np.array(list(itertools.product((-1, 0, 1), repeat=3)), dtype=float)
    size = np.linalg.norm(steps, axis=1)
    up = np.vstack([steps[np.isclose(size, length)] for length in (1.0, np.sqrt(2.0))])[:number]
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    values = BIAS + off + up @ MATRIX.T + noise * rng.standard_normal(up.shape)
    return mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g")


if __name__ == "__main__":
    main()

"""Does U of sessions that were combined cover a session never seen?

Six faces, readings to .3 mg, the sensor mounted anew to 1 mrad every session, and a zero that moves
from session to session by so many mg. One session's U is about that session; the combined one is
about the next. Covered is the true bias of a session that took no part. `--law` draws the biases of
sessions alone, 20,000 times, and shows what the law of the combined U covers by itself.
"""

import argparse
import warnings
from typing import Any

import numpy as np

import multipos as mp

FACES = mp.read_scheme("faces-6").up
SD, TURN = 3e-4, 1e-3  # [g], [rad]
Array = np.ndarray[Any, Any]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_sessions")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--law", action="store_true", help="draw biases, and fit nothing")
    chosen = parser.parse_args()
    if chosen.law:
        _law(np.random.default_rng(chosen.seed))
        return
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    for count in (2, 4, 10):
        for zero in (0.0, 3e-4, 2e-3):
            rng = np.random.default_rng(chosen.seed)
            rows = np.array([_run(rng, count, zero) for _ in range(chosen.runs)])
            alone, pooled = 100.0 * np.mean(rows[:, 0]), 100.0 * np.mean(rows[:, 1])
            least = 1.96 * np.hypot(zero * np.sqrt(1.0 + 1.0 / count), SD / np.sqrt(6.0 * count))
            length = float(np.median(rows[:, 2])) / least
            print(
                f"| {count} | {1e3 * zero:g} mg | {alone:.1f} % | {pooled:.1f} % | {length:.1f} |",
                flush=True,
            )


def _law(rng: np.random.Generator) -> None:
    """Print how often (1 + 1/R) S with Student's t covers the next of 2 to 10 sessions."""
    for count, k in ((2, 12.706205), (3, 4.302653), (4, 3.182446), (6, 2.570582), (10, 2.262157)):
        for zero in (0.0, 3e-4, 2e-3):
            truth = zero * rng.standard_normal((20_000, count + 1))
            # the noise of the mean of six faces, as in a session
            found = truth[:, :count] + SD / np.sqrt(6.0) * rng.standard_normal((20_000, count))
            U = k * np.sqrt((1.0 + 1.0 / count) * found.var(axis=1, ddof=1))
            held = np.abs(found.mean(axis=1) - truth[:, count]) <= U
            print(f"| {count} | {1e3 * zero:g} mg | {100.0 * np.mean(held):.1f} % |")


def _run(rng: np.random.Generator, count: int, zero: float) -> tuple[float, float, float]:
    """Return what of the next session's biases one session and all cover, and U of the latter."""
    fits = [_session(rng, zero)[0] for _ in range(count)]
    one = mp.compare(*fits, combine=True).combined
    _, truth = _session(rng, zero)
    biases = [f"bias_{output}" for output in one.outputs]
    shares = []
    for c in (fits[-1], one):
        pairs = zip((c[name] for name in biases), truth, strict=True)
        shares.append(float(np.mean([abs(p.value - true) <= p.U for p, true in pairs])))
    return shares[0], shares[1], one["bias_ax"].U


def _session(rng: np.random.Generator, zero: float) -> tuple[mp.Calibration, Array]:
    b = zero * rng.standard_normal(3)
    x, y, z = TURN * rng.standard_normal(3)
    K = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    values = b + FACES @ K.T + SD * rng.standard_normal(FACES.shape)
    return mp.fit(mp.Readings(values, up=FACES, unit="g")), b


if __name__ == "__main__":
    main()

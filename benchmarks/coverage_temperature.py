"""Coverage of U of the bias over temperature where the zero differs from soak to soak.

Six faces at each soak, bias and scale factors linear in temperature, noise of 1 mg, a zero of each
soak of 0, 1 and 3 mg. Printed: how often U holds the true bias at a temperature of the range, all
three outputs, and what is named. Run by `python -m benchmarks.coverage_temperature`; a minute.
"""

import warnings
from collections import Counter

import numpy as np

import multipos as mp

MODEL = "1 + x + y + z + temperature + temperature*own"
BIAS, SLOPE = np.array([0.012, -0.021, 0.034]), np.array([1e-4, -2e-4, 5e-5])
SETS = 60


def world(soaks: int, zero: float, noise: float = 1e-3) -> None:
    rng = np.random.default_rng(35)
    faces = np.vstack([np.eye(3), -np.eye(3)])
    levels = np.linspace(-20.0, 50.0, soaks)
    soak, up = np.repeat(np.arange(soaks), 6), np.tile(faces, (soaks, 1))
    at = np.linspace(-20.0, 50.0, 15)
    inside, named = [], Counter[str]()
    for _ in range(SETS):
        warm = levels[soak] + rng.normal(0.0, 0.2, len(soak))
        values = BIAS + np.outer(warm, SLOPE) + up * (1.0 + 3e-5 * warm[:, None])
        values += zero * rng.standard_normal((soaks, 3))[soak]
        values += noise * rng.standard_normal(up.shape)
        environment = {"temperature": warm}
        readings = mp.Readings(values, up=up, unit="g", environment=environment)
        c = mp.fit(readings, model=MODEL, orientation_sd=0, exclude="none")
        named.update({one.code for one in c.findings if one.code != "hidden-terms"})
        for i, curve in enumerate(mp.over_temperature(c, at)[::4]):
            inside.append(np.abs(curve.value - BIAS[i] - SLOPE[i] * at) <= curve.U)
    said = ", ".join(f"{code} {100 * count / SETS:.0f} %" for code, count in named.most_common(3))
    print(f"{soaks} soaks, zero {1e3 * zero:.0f} mg: {100 * np.mean(inside):.1f} %; {said}")


def main() -> None:
    warnings.simplefilter("ignore")
    for soaks in (3, 4, 5, 7):
        for zero in (0.0, 1e-3, 3e-3):
            world(soaks, zero)


if __name__ == "__main__":
    main()

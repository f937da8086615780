"""Means of rests on a random walk, in a picture; the table is of `benchmarks.coverage_rests`.

`python -m benchmarks.studies.slow_noise` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    rng = np.random.default_rng(3)
    up = mp.read_scheme("icosahedron-12").up
    n, pitch = 400, 600
    starts = 8 * n + pitch * np.arange(12)
    total = int(starts[-1]) + 9 * n
    walk = np.cumsum(4e-5 * rng.standard_normal((total, 3)), axis=0)
    truth = np.array([walk[s - 7 * n - n // 2 : s + 8 * n + n // 2].mean(axis=0) for s in starts])
    samples = walk + 1e-3 * rng.standard_normal((total, 3))
    for start, force in zip(starts, up, strict=True):
        samples[start : start + n] += force
    log = {"time": np.arange(total) / 100.0} | dict(zip(("ax", "ay", "az"), samples.T, strict=True))
    sections = {str(i): {"start": int(s), "end": int(s) + n} for i, s in enumerate(starts, 1)}
    found = mp.average(log, sections=sections)

    error = 1e3 * (found.readings.values - up - truth)[:, 0]
    figure = Figure(figsize=(6, 2.8), layout="constrained")
    axes = figure.subplots()
    number = np.arange(1, 13)
    axes.errorbar(number, error, 2e3 * found.readings.u[:, 0], fmt="o", label="2 u by all rests")
    axes.errorbar(
        number + 0.2, error, np.full(12, 2.0 / np.sqrt(n)), fmt=".", label="2 u by samples"
    )
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="rest", ylabel="error of the mean of ax [mg]")
    axes.legend(fontsize="small")
    Path("slow-noise.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()

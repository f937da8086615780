"""A saturating sensor as a polynomial and as itself, and a bridge whose supply drifts.

`python -m benchmarks.studies.own_models` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    def sensor(force):
        return 0.02 + force / (1 + 0.1 * force**2)

    rng = np.random.default_rng(3)
    up = mp.read_scheme("fibonacci-24").up
    readings = mp.Readings(sensor(up) + 1e-4 * rng.standard_normal((24, 3)), up=up, unit="g")
    new = mp.read_scheme("fibonacci-500").up
    for model in ("linear", "own-quadratic", "own-cubic", "each = b + s*own/(1 + k*own^2)"):
        cal = mp.fit(readings, orientation_sd=0, model=model)
        errors = [
            np.sqrt(np.mean((cal.compensate(sensor(size * new)) - size * new) ** 2))
            for size in (1.0, 1.5)
        ]
        print(f"{model:32} {len(cal.names):3}  {1e3 * errors[0]:6.2f} mg {1e3 * errors[1]:6.2f} mg")

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    along = np.outer(np.linspace(-1.5, 1.5, 121), [1.0, 0.0, 0.0])
    for model, line in (
        ("linear", ":"),
        ("own-cubic", "--"),
        ("each = b + s*own/(1 + k*own^2)", "-"),
    ):
        error = mp.fit(readings, orientation_sd=0, model=model).compensate(sensor(along)) - along
        axes.plot(along[:, 0], 1e3 * error[:, 0], line, label=model)
    axes.axvspan(-1, 1, color="0.92")
    axes.set(xlabel="force along x [g]", ylabel="error [mg]", ylim=(-60, 60))
    axes.legend()
    Path("own-models-error.svg").write_text(to_svg(figure), encoding="utf-8")
    fit = mp.fit(readings, orientation_sd=0, model="own-cubic", reading_sd=1e-4)
    print(fit.findings[0].text)
    print(
        mp.fit(
            readings, orientation_sd=0, model="each = b + s*own/(1 + k*own^2)", reading_sd=1e-4
        ).findings
    )
    supply = 5.0 * rng.uniform(0.98, 1.02, 24)
    bridge = supply[:, None] * (0.01 + 0.2 * up) + 1e-4 * rng.standard_normal((24, 3))
    bridge = mp.Readings(bridge, up=up, environment={"supply": supply}, unit="V")
    for model in ("linear", "each = supply*(b + s*own)"):
        print(f"{model:26} rms {1e3 * mp.fit(bridge, orientation_sd=0, model=model).rms:.2f} mg")


if __name__ == "__main__":
    main()

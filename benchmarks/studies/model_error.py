"""What U covers where the model lacks a cubic term; the table is of `benchmarks.model_error`.

`python -m benchmarks.studies.model_error` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    rng = np.random.default_rng(1)
    new = mp.read_scheme("fibonacci-200").up
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for cubic, label in ((0.0, "nothing missing"), (2e-3, "2 mg of own^3 missing")):
        held = {}
        for n in (12, 24, 50, 100, 200, 400):
            up = mp.read_scheme(f"fibonacci-{n}").up
            found = []
            for _ in range(5):
                values = 0.01 + up + cubic * up**3 + 1e-4 * rng.standard_normal(up.shape)
                readings = mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g")
                cal = mp.fit(readings, orientation_sd=0, exclude="none")
                raw = 0.01 + new + cubic * new**3
                columns = dict(zip(cal.outputs, raw.T, strict=True))
                told = mp.apply(cal, columns, uncertainty=True, parameters_only=True)
                found += [
                    abs(told[f"f_{x}"] - new[:, i]) <= told[f"U_f_{x}"] for i, x in enumerate("xyz")
                ]
            held[n] = 100.0 * np.mean(found)
        axes.plot([str(n) for n in held], held.values(), "o-", label=label)
    axes.axhline(95.0, color="0.6", linestyle="--")
    axes.set(xlabel="positions", ylabel="held by U (95 %) [%]", ylim=(0, 105))
    axes.legend()
    Path("covered.svg").write_text(to_svg(figure), encoding="utf-8")
    assert held[400] < 20.0 < 40.0 < held[24]


if __name__ == "__main__":
    main()

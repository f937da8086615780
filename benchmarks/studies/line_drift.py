"""The zero at three stations of a line, of which one drifts; the table is of `benchmarks.line`.

`python -m benchmarks.studies.line_drift` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    rng = np.random.default_rng(1)
    up = mp.read_scheme("faces-corners-14").up
    units = np.arange(9000)
    station = units % 3
    zero = 0.01 * rng.standard_normal((9000, 3))
    zero[:, 1] += np.where(station == 1, 4e-3 * units / 9000, 0.0)
    values = zero[:, None] + up + 3e-4 * rng.standard_normal((9000, 14, 3))
    line = {"unit": np.repeat(units, 14)}
    line |= {name: values[:, :, i].ravel() for i, name in enumerate(("ax", "ay", "az"))}
    listed = {"scheme": "faces-corners-14", "orientation_sd": 0, "exclude": "none"}
    found = mp.fit_many(line, unit_column="unit", **listed)

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for k, (name, mark) in enumerate(zip("ABC", "os^", strict=True)):
        bias = 1e3 * np.asarray(found["bias_ay"])[station == k]
        middle = units[station == k].reshape(10, -1).mean(axis=1)
        axes.plot(middle, bias.reshape(10, -1).mean(axis=1), f"{mark}-", label=name)
    axes.set(xlabel="unit", ylabel="bias_ay [mg]")
    axes.legend(title="station")
    Path("line-drift.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()

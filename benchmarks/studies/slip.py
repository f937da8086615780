"""Residuals of a case that slips by 0.3° after the twelfth of 24 rows.

`python -m benchmarks.studies.slip` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    rng = np.random.default_rng(4)
    up = rng.permutation(mp.read_scheme("fibonacci-24").up)
    stood = up + (np.arange(24) >= 12)[:, None] * np.cross(np.radians([0.2, -0.2, 0.1]), up)
    values = 0.01 + 1.002 * stood + 1e-4 * rng.standard_normal((24, 3))
    found = mp.fit(mp.Readings(values, up=up, unit="g"), orientation_sd=0, exclude="none")
    assert [finding.rows for finding in found.findings if finding.code == "slipped"] == [("13",)]

    figure = Figure(figsize=(6, 2.8), layout="constrained")
    axes = figure.subplots()
    for output, left in zip(found.outputs, found.residuals.T, strict=True):
        axes.plot(np.arange(1, 25), 1e3 * left, "o", markersize=4, label=output)
    axes.axvline(12.5, color="0.6", linewidth=0.8)
    axes.set(xlabel="row", ylabel="residual [mg]")
    axes.legend(fontsize="small")
    Path("slip.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()

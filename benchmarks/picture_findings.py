"""The picture of a finding: two readings in each other's rows in a fit of fourteen positions.

`python -m benchmarks.picture_findings docs/figures/findings.svg` draws it, and prints the findings
before and after the readings are exchanged back.
"""

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import multipos as mp
from benchmarks.picture import on_white
from multipos.plots import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SWAPPED = (3, 9)
NOISE = 1e-3  # [g]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.picture_findings")
    parser.add_argument("picture", type=Path, metavar="PICTURE", help=".svg, .pdf or .png")
    target = parser.parse_args().picture
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    up = mp.read_scheme("faces-corners-14").up
    rng = np.random.default_rng(14)
    right = [0.02, -0.01, 0.005] + up * [1.01, 0.99, 1.0] + NOISE * rng.standard_normal(up.shape)
    wrong = right.copy()
    wrong[list(SWAPPED)] = wrong[list(SWAPPED[::-1])]
    listed = {"unit": "g", "orientation_sd": 0, "exclude": "none"}
    fits = [mp.fit(mp.Readings(values, up=up), **listed) for values in (wrong, right)]
    for cal in fits:
        codes = ", ".join(finding.code for finding in cal.diagnostics.findings) or "none"
        print(f"rms {1e3 * cal.rms:.1f} mg, findings: {codes}")
    drawn = style.render(_draw(fits), target.suffix)
    target.write_bytes(on_white(drawn).encode() if isinstance(drawn, str) else drawn)


def _draw(fits: list[mp.Calibration]) -> "Figure":
    figure, panels = style.new_figure(2, width=6.6, height=1.7)
    titles = (
        "as written: readings 4 and 10 in each other's rows",
        "exchanged back",
    )
    for axes, cal, title in zip(panels, fits, titles, strict=True):
        position = np.arange(1, len(cal.readings) + 1)
        for i, output in enumerate(cal.outputs):
            axes.bar(
                position + 0.25 * (i - 1),
                cal.residuals[:, i],
                0.25,
                color=style.COLOURS[i],
                label=output,
            )
        axes.set_xticks(position)
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_ylabel("residual [g]")
    style.name_series(panels[0], 3)
    panels[1].set_ylim(panels[0].get_ylim())
    panels[1].set_xlabel("position")
    return figure


if __name__ == "__main__":
    main()

"""The picture of the front page: the same sensor calibrated twenty times, by two programs.

In a session the case is put on each of its six faces three times, by hand, within half a degree per
axis. imucal (`pip install imucal`) calibrates every session by the method of Ferraris et al.,
multipos by least squares; on six faces both print the same numbers. The picture shows one of them,
what y does to the output of x, against the truth that was simulated.

`python -m benchmarks.picture docs/front.svg` draws it, and prints what it shows.
"""

import argparse
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import multipos as mp
from multipos.plots import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SESSIONS, PLACED = 20, 3
PLACEMENT, NOISE = np.radians(0.5), 3e-4  # per axis [rad], of a reading [g]
BIAS = np.array([0.012, -0.020, 0.008])  # [g]
MATRIX = np.array([[1.004, 0.006, -0.003], [-0.002, 0.996, 0.004], [0.005, 0.001, 1.002]])
MILLI = 1e3  # mg per g of the other axis
FACES = ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a")  # imucal's names, in the order of `faces-6`


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.picture", description=__doc__)
    parser.add_argument("picture", type=Path, metavar="PICTURE", help=".svg, .pdf or .png")
    target = parser.parse_args().picture
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    rng = np.random.default_rng(2026)
    up = np.tile(mp.read_scheme("faces-6").up, (PLACED, 1))
    readings = [_session(rng, up) for _ in range(SESSIONS)]
    listed = {"unit": "g", "orientation_sd": 0, "exclude": "none"}
    fits = [mp.fit(mp.Readings(values, up=up), **listed)["ax", "y"] for values in readings]
    ours = MILLI * np.array([[found.value, found.U] for found in fits])
    theirs = MILLI * np.array([_cross_of_imucal(values) for values in readings])
    truth = MILLI * MATRIX[0, 1]
    held = int(np.sum(np.abs(ours[:, 0] - truth) <= ours[:, 1]))
    print(f"imucal   {theirs.min():.1f} to {theirs.max():.1f} mg/g, truth {truth:.1f}")
    print(f"multipos {ours[:, 0].min():.1f} to {ours[:, 0].max():.1f} mg/g")
    print(
        f"U {ours[:, 1].min():.1f} to {ours[:, 1].max():.1f} mg/g holds the truth in {held} of 20"
    )
    drawn = style.render(_draw(theirs, ours, truth), target.suffix)
    target.write_bytes(on_white(drawn).encode() if isinstance(drawn, str) else drawn)


def _session(rng: np.random.Generator, up: np.ndarray) -> np.ndarray:
    """Return readings (n, 3) [g]; where the case stood is the list turned by small angles."""
    turned = up + np.cross(PLACEMENT * rng.standard_normal(up.shape), up)
    force = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return BIAS + force @ MATRIX.T + NOISE * rng.standard_normal(up.shape)


def _cross_of_imucal(values: np.ndarray) -> float:
    """Return what imucal finds y to do to the output of x; of a gyroscope it needs any numbers."""
    from imucal import FerrarisCalibration, ferraris_regions_from_df
    from pandas import DataFrame, concat

    columns = ["acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]
    method = FerrarisCalibration()
    parts = {}
    for row, face in enumerate(FACES):
        placed = method.grav * values[row :: len(FACES)]
        parts[face] = DataFrame(np.hstack([placed, np.zeros_like(placed)]), columns=columns)
    for axis in range(3):
        rates = np.zeros((10, 6))
        rates[:, 3 + axis] = 360.0  # a turn in ten samples at 10 Hz
        parts[f"{'xyz'[axis]}_rot"] = DataFrame(rates, columns=columns)
    regions = ferraris_regions_from_df(concat(parts, names=["part"]).droplevel(1))
    found = method.compute(regions, 10.0, from_acc_unit="m/s^2", from_gyr_unit="dps")
    return float((found.K_a @ found.R_a)[0, 1])


def _draw(theirs: np.ndarray, ours: np.ndarray, truth: float) -> "Figure":
    figure, (upper, lower) = style.new_figure(2, width=6.6, height=1.7)
    session = np.arange(1, SESSIONS + 1)
    reach = 1.1 * np.abs(ours[:, 0] - truth).max() + ours[:, 1].max()
    look: dict[str, Any] = {"color": style.COLOURS[0], "fmt": "o", "ms": 4.0}
    upper.errorbar(session, theirs, **look)
    lower.errorbar(session, ours[:, 0], yerr=ours[:, 1], elinewidth=1.5, **look)
    titles = ("imucal prints a number", "multipos prints the same number with its U (95 %)")
    for axes, title in zip((upper, lower), titles, strict=True):
        axes.axhline(truth, color=style.COLOURS[1], linestyle="--", linewidth=1.2, zorder=0)
        axes.set_ylim(truth - reach, truth + reach)
        axes.set_xlim(0.2, SESSIONS + 0.8)
        axes.set_xticks([1, 5, 10, 15, 20])
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_ylabel("y in x [mg/g]")
    style.write(upper, 18.4, truth + 0.5 * reach, "dashed: the truth", ha="center")
    missed = session[np.abs(ours[:, 0] - truth) > ours[:, 1]]
    for one in missed:
        style.write(lower, one, truth - 0.9 * reach, "missed", ha="center", fontsize=8)
    upper.set_xticklabels([])
    lower.set_xlabel("session: the same sensor, put on its six faces three times")
    return figure


def on_white(svg: str) -> str:
    """Return the SVG with paper behind it, for readers with a dark screen."""
    paper = '<rect width="100%" height="100%" fill="#ffffff"/>'
    return re.sub(r"<svg [^>]*>", lambda opening: opening[0] + paper, svg, count=1)


if __name__ == "__main__":
    main()

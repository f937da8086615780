"""The u of the worst parameter by poses in four ways; see `benchmarks.coverage_capture`.

`python -m benchmarks.studies.poses` prints figures, and draws in the folder.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import multipos as mp
from multipos.plots import to_svg


def main() -> None:

    rng = np.random.default_rng(1)
    turn = np.linspace(0.0, 6.0 * np.pi, 40)
    ways = {
        "random": rng.standard_normal((40, 3)),
        "six faces": np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (7, 1))[:40]
        + 0.12 * rng.standard_normal((40, 3)),
        "figure-eight": np.column_stack([np.sin(turn), 0.6 * np.sin(2.0 * turn), np.ones(40)]),
    }

    def worst(up):
        up = up / np.linalg.norm(up, axis=1)[:, None]
        way = {f"up_{axis}": up[:, i] for i, axis in enumerate("xyz")}
        entry = mp.schemes(way, unknown_orientation=True).schemes[0]
        return max(entry.u[f"a{axis}:{term}"] for axis in "xyz" for term in ("1", axis))

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    for (name, up), mark in zip(ways.items(), "s^v", strict=True):
        poses = range(12, 40, 3)
        axes.semilogy(poses, [worst(up[:n]) for n in poses], f"{mark}-", label=name)
    poses = (12, 15, 18, 24)
    best = [np.asarray(mp.design("linear", n, unknown_orientation=True).positions) for n in poses]
    axes.semilogy(poses, [worst(up) for up in best], "o-", label="D-optimal")
    axes.set(xlabel="poses", ylabel="worst u [reading]")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend()
    Path("capture-ways.svg").write_text(to_svg(figure), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Draw what real recordings leave: `python -m benchmarks.recordings FOLDER -o FILE.svg`.

Of three sets of rests at unknown orientations |f| − 1 after a fit without and with second-order
terms; of six faces the residuals of the plain fit, beside which the noise of a mean is nothing.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import multipos as mp
from benchmarks.peer_tasks import ACC, ORDER, Task, recorded
from benchmarks.picture import on_white
from multipos.plots import to_svg


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recordings", description=__doc__)
    parser.add_argument("folder", type=Path, help="of the recordings")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="FILE.svg")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    tasks = {task.name.partition(",")[0]: task for task in recorded(chosen.folder)}
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    for axes, name in zip(
        panels, ("Innalabs triad", "cave pointer ee", "cave pointer ab"), strict=False
    ):
        draw_rests(tasks[name], axes)
    draw_faces(tasks["six-position session (Ferraris)"], panels[3])
    chosen.output.write_text(on_white(to_svg(figure)), encoding="utf-8")


def draw_rests(task: Task, axes: Axes) -> None:
    number = np.arange(1, len(task.rests) + 1)
    for model, mark in (("linear", "o"), ("own-quadratic", ".")):
        cal = mp.fit(mp.Readings(task.rests), model=model, unknown_orientation=True)
        left = np.linalg.norm(cal.compensate(task.rests), axis=1) - 1.0
        fill = "none" if model == "linear" else "full"
        label = f"{model}, rms {1e6 * cal.rms:.0f} µg"
        axes.plot(number, 1e3 * left, mark, fillstyle=fill, label=label)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(title=task.name, xlabel="rest", ylabel="|f| − 1 [mg]", ylim=(-1.9, 2.4))
    axes.legend(fontsize="x-small", loc="upper center", ncols=2)


def draw_faces(task: Task, axes: Axes) -> None:
    log = {name: task.log[name] for name in ACC}
    found = mp.average(log, rate=task.rate, sections=task.sections, only=ORDER, scheme="faces-6")
    cal = mp.fit(found, orientation_sd=0, exclude="none")
    for k, name in enumerate(ACC):
        bars = {"yerr": 1e3 * found.readings.u[:, k] / task.per_g, "fmt": "os^"[k]}
        axes.errorbar(ORDER, 1e3 * cal.residuals[:, k] / task.per_g, label=name, **bars)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(title="six faces, placed by hand", ylabel="residual [mg]", ylim=(-4.5, 6.5))
    axes.legend(fontsize="x-small", loc="upper center", ncols=3)


if __name__ == "__main__":
    main()

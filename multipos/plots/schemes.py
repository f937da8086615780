"""Figures of schemes: where the positions lie and what they tell, and how many are needed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.designs.assessment import Schemes, read_setting
from multipos.designs.criteria import Criterion, kernels, sensitivity
from multipos.designs.designing import Design
from multipos.designs.information import Blocks, Setting, inform, log_det
from multipos.files.lists import Names
from multipos.files.tables import Source
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.plots.style import (
    COLOURS,
    MARKERS,
    dress_axis,
    name_series,
    new_figure,
    write,
    write_title,
)
from multipos.positions.scheme import Scheme, read_scheme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_APART = 2.3  # of the middles of the two hemispheres, whose radius is 1


def draw_scheme(
    scheme: "Source | Scheme",
    axes: "Axes",
    *,
    model: str = "linear",
    sensed: Names = COMPONENTS,
    inputs: Names = COMPONENTS,
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float = 1.0,
) -> None:
    """Draw the up vectors of a scheme on both hemispheres, its variance function behind them.

    The map is Lambert's of equal areas: z up in the middle on the left, z down on the right, both
    seen from above. The colour is p s(u)/p of `multipos.designs.information`: the variance of the
    prediction, of which the best scheme has nowhere more than 1; a scheme that cannot separate the
    parameters has none. A number counts repeats. `sensed` are the axes of `multipos.schemes`.
    """
    up = read_scheme(scheme).up
    setting = read_setting(model, sensed, inputs, unknown_orientation, orientation_sd, reading_sd)
    information = inform(setting.rows(up))
    r, t = np.meshgrid(np.linspace(0.0, 1.0, 60), np.linspace(0.0, 2.0 * np.pi, 181))
    if log_det(information) > -np.inf:
        _draw_variance(setting, kernels(information, Criterion("D")), r, t, axes)
    for side in (0, 1):
        axes.plot(np.cos(t[:, 0]) + side * _APART, np.sin(t[:, 0]), color="#999999", linewidth=0.6)
        write(axes, side * _APART, -1.2, f"z {'down' if side else 'up'}", ha="center")
        for angle, name in ((0.0, "x"), (0.5 * np.pi, "y")):
            place = 1.17 * np.cos(angle) + side * _APART, 1.17 * np.sin(angle)
            write(axes, *place, name, ha="center", va="center")
    _draw_positions(up, axes)
    axes.set_xlim(-1.15, 1.25 + _APART)
    axes.set_ylim(-1.3, 1.25)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_variance(setting: Setting, kernel: Blocks, r: Array, t: Array, axes: "Axes") -> None:
    height, level = 1.0 - r**2, r * np.sqrt(2.0 - r**2)
    maps = []
    for sign in (1.0, -1.0):
        grid = np.stack([level * np.cos(t), level * np.sin(t), sign * height], axis=-1)
        maps.append(sensitivity(setting.rows(grid.reshape(-1, 3)), kernel).reshape(r.shape))
    low, top = min(values.min() for values in maps), max(values.max() for values in maps)
    for side, values in enumerate(maps):
        mesh = axes.pcolormesh(
            r * np.cos(t) + side * _APART,
            r * np.sin(t),
            values,
            vmin=low,
            vmax=top,
            cmap="cividis",
            shading="gouraud",
            rasterized=True,
        )
    bar = axes.figure.colorbar(mesh, ax=axes, shrink=0.8)
    bar.outline.set(edgecolor="#000000", linewidth=0.8)
    bar.ax.set_axisbelow("line")
    dress_axis(bar.ax.yaxis)
    bar.ax.set_ylabel("variance, best scheme ≤ 1")


def _draw_positions(up: Array, axes: "Axes") -> None:
    places, counts = np.unique(np.round(up, 6), axis=0, return_counts=True)
    for (x, y, z), count in zip(places.tolist(), counts.tolist(), strict=True):
        # what lies on the rim lies on both
        for side in [0] * (z > -1e-6) + [1] * (z < 1e-6):
            shrink = 1.0 / np.sqrt(1.0 + abs(z))
            place = x * shrink + side * _APART, y * shrink
            axes.plot(
                *place,
                "o",
                color="white",
                markeredgecolor="black",
                clip_on=False,
                markersize=6.0 if count == 1 else 11.0,
            )
            if count > 1:
                write(axes, *place, str(count), ha="center", va="center_baseline", fontsize=7.0)


def draw_efficiency(designs: Mapping[str, Sequence[Design]], axes: "Axes") -> None:
    """Draw the efficiency of designs (`multipos.design`) against their number of positions."""
    for k, (name, found) in enumerate(designs.items()):
        axes.plot(
            [len(design.positions) for design in found],
            [design.efficiency for design in found],
            color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)],
            label=name,
            linewidth=0.8,
            fillstyle="none",
        )
    axes.axhline(1.0, color="#999999", linewidth=0.8, linestyle="--")
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel("positions")
    axes.set_ylabel("efficiency per position")
    name_series(axes, min(len(designs), 4))


def schemes_figure(found: Schemes, **setting: Any) -> "Figure":
    """Return a map of every scheme; `setting` is what `draw_scheme` takes."""
    figure, axes = new_figure(len(found.schemes), height=2.4)
    for entry, one in zip(found.schemes, axes, strict=True):
        draw_scheme(_table(np.array(list(entry.up.values()))), one, **setting)
        told = "cannot separate the parameters"
        if entry.d_efficiency is not None:
            told = f"D-efficiency {entry.d_efficiency:.3f}"
        write_title(one, f"{entry.name or 'scheme'}: {entry.positions} positions, {told}")
    return figure


def design_figure(designs: Sequence[Design], **setting: Any) -> "Figure":
    """Return the map of the last design, and below it the efficiency of all against their size."""
    best = designs[-1]
    figure, axes = new_figure(2)
    draw_scheme(_table(best.positions), axes[0], **setting)
    write_title(axes[0], f"{len(best.positions)} positions, efficiency {best.efficiency:.3f}")
    draw_efficiency({f"{best.model}, criterion {best.criterion}": designs}, axes[1])
    return figure


def _table(up: Array) -> dict[str, Array]:
    return {f"up_{axis}": up[:, i] for i, axis in enumerate(COMPONENTS)}

"""Figures of schemes: where the positions lie and what they tell, and how many are needed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from multipos.designs.assessment import read_setting
from multipos.designs.designing import Design
from multipos.designs.information import Criterion, inform, kernels, sensitivity
from multipos.files.tables import Source
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.plots.style import COLOURS, MARKERS, dress_axis, name_series, write
from multipos.positions.scheme import Scheme, read_scheme

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_APART = 2.3  # of the middles of the two hemispheres, whose radius is 1


def draw_scheme(
    scheme: "Source | Scheme",
    axes: "Axes",
    *,
    model: str = "linear",
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float = 1.0,
) -> None:
    """Draw the up vectors of a scheme on both hemispheres, its variance function behind them.

    The map is Lambert's of equal areas: z up in the middle on the left, z down on the right, both
    seen from above. The colour is p s(u)/p of `multipos.designs.information`: the variance of the
    prediction, of which the best scheme has nowhere more than 1. A number counts repeats.
    """
    up = read_scheme(scheme).up
    setting = read_setting(
        model, COMPONENTS, COMPONENTS, unknown_orientation, orientation_sd, reading_sd
    )
    kernel = kernels(inform(setting.rows(up)), Criterion("D"))
    r, t = np.meshgrid(np.linspace(0.0, 1.0, 60), np.linspace(0.0, 2.0 * np.pi, 181))
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
        write(axes, side * _APART, -1.2, f"z {'down' if side else 'up'}", ha="center")
        for angle, name in ((0.0, "x"), (0.5 * np.pi, "y")):
            place = 1.12 * np.cos(angle) + side * _APART, 1.12 * np.sin(angle)
            write(axes, *place, name, ha="center", va="center")
    _draw_positions(up, axes)
    axes.set_xlim(-1.15, 1.25 + _APART)
    axes.set_ylim(-1.3, 1.25)
    axes.set_aspect("equal")
    axes.set_axis_off()
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

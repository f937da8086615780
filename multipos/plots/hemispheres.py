"""The sphere of directions drawn flat: its two hemispheres as discs of equal areas.

`draw_frame` draws the rims and the names of the axes, `draw_directions` unit vectors, and
`draw_map` values at the directions that `everywhere` returns. `flat` is the map of one hemisphere.

Lambert's map: z up in the middle on the left, z down on the right, both seen from above, so that x
is to the right and y upward on both. A direction at the angle t from the pole lies √(1 − cos t)
from the middle, and the rim is the xy plane.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.numerics.arrays import Array
from multipos.plots.style import dress_axis, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_APART = 2.6  # of the middles of the two hemispheres, whose radius is 1
_NAMES = 1.25  # where the names of the axes stand, clear of a marker on the rim
_SAME = 1e-6  # of the largest value: what differs by less differs by rounding
_INK, _PAPER = "#111111", "#fefefe"  # of markers: on the map's colours, dark as the page may be
_RINGS, _SPOKES = 60, 181  # of the grid that carries the colours


def everywhere() -> Array:
    """Return the unit vectors (n, 3) at which `draw_map` takes values."""
    r, t = _polar()
    height, level = 1.0 - r**2, r * np.sqrt(2.0 - r**2)
    sides = [
        np.stack([level * np.cos(t), level * np.sin(t), sign * height], axis=-1)
        for sign in (1.0, -1.0)
    ]
    return np.concatenate(sides).reshape(-1, 3)


def draw_map(values: Array, label: str, axes: "Axes") -> None:
    """Draw values (n,) of `everywhere` as colours, with a bar that says what they are."""
    r, t = _polar()
    low, high = float(values.min()), float(values.max())
    if high - low < _SAME * abs(high):
        values = np.full_like(values, high)
        low, high = 0.5 * high, 1.5 * high
    for side, part in enumerate(values.reshape(2, *r.shape)):
        x, y = r * np.cos(t) + side * _APART, r * np.sin(t)
        look: dict[str, Any] = {"cmap": "cividis", "shading": "gouraud", "rasterized": True}
        mesh = axes.pcolormesh(x, y, part, vmin=low, vmax=high, **look)
    bar = axes.figure.colorbar(mesh, ax=axes, shrink=0.8)
    bar.outline.set(edgecolor="#000000", linewidth=0.8)
    bar.ax.set_axisbelow("line")
    dress_axis(bar.ax.yaxis)
    bar.ax.set_ylabel(label)


def draw_frame(axes: "Axes") -> None:
    """Draw the rims of both hemispheres and the names of the axes."""
    t = np.linspace(0.0, 2.0 * np.pi, _SPOKES)
    for middle, pole in ((0.0, "z up"), (_APART, "z down")):
        axes.plot(np.cos(t) + middle, np.sin(t), color="#999999", linewidth=0.6)
        for x, y, name in ((0.0, -_NAMES, pole), (_NAMES, 0.0, "x"), (0.0, _NAMES, "y")):
            write(axes, x + middle, y, name, ha="center", va="center")
    axes.set_xlim(-1.15, 1.35 + _APART)
    axes.set_ylim(-1.35, 1.35)
    axes.set_aspect("equal")
    axes.set_axis_off()


def flat(up: Array, side: float) -> Array:
    """Return the map (n, 2) of unit vectors (n, 3) on one hemisphere, 1 up and −1 down."""
    height = np.clip(side * up[:, 2], -1.0, 1.0)
    # sqrt(1 − h)/sqrt(1 − h²), which is finite at the pole
    return np.asarray(up[:, :2] / np.sqrt(np.maximum(1.0 + height, 1e-12))[:, None])


def draw_directions(up: Array, axes: "Axes") -> None:
    """Draw unit vectors (n, 3); a number counts repeats, and what lies on the rim lies on both."""
    places, counts = np.unique(np.round(up, 6), axis=0, return_counts=True)
    for side, sign in ((0, 1.0), (1, -1.0)):
        on = sign * places[:, 2] > -1e-6
        at = flat(places[on], sign) + np.array([side * _APART, 0.0])
        for place, count in zip(at.tolist(), counts[on].tolist(), strict=True):
            look: dict[str, Any] = {
                "markeredgecolor": _INK,
                "markersize": 6.0 if count == 1 else 11.0,
            }
            axes.plot(*place, "o", color=_PAPER, clip_on=False, **look)
            if count > 1:
                x, y = place
                centred = {"ha": "center", "va": "center_baseline"}
                write(axes, x, y, str(count), fontsize=7.0, color=_INK, **centred)


def _polar() -> tuple[Array, Array]:
    """Return radius and angle of the grid of one hemisphere."""
    r, t = np.meshgrid(np.linspace(0.0, 1.0, _RINGS), np.linspace(0.0, 2.0 * np.pi, _SPOKES))
    return r, t

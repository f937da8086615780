"""Figures of schemes: where the positions lie and what they tell, and how many are needed.

`draw_scheme` draws positions and the variance of the prediction, `draw_efficiency` how good designs
of several sizes are. `schemes_figure` and `design_figure` are the figures of schemes and of a
design.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from multipos.designs.assessment import Schemes, read_setting
from multipos.designs.criteria import Criterion, kernels, sensitivity
from multipos.designs.designing import Design, begin_design
from multipos.designs.information import Setting, inform, log_det
from multipos.files.spelling import Names
from multipos.files.tables import Source
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import ModelText
from multipos.plots.hemispheres import draw_directions, draw_frame, draw_map, everywhere
from multipos.plots.marks import draw_points
from multipos.plots.style import name_series, new_figure, write_title
from multipos.positions.scheme import Scheme, read_scheme
from multipos.sensor.calibration import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_scheme(
    scheme: "Source | Scheme",
    axes: "Axes",
    *,
    model: ModelText = "linear",
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
    setting = read_setting(model, sensed, inputs, unknown_orientation, orientation_sd, reading_sd)
    _draw_positions(read_scheme(scheme).up, setting, axes)


def _draw_positions(up: Array, setting: Setting, axes: "Axes") -> None:
    """Draw up vectors (n, 3), and the variance function of a setting behind them."""
    information = inform(setting.rows(up))
    if log_det(information) > -np.inf:
        kernel = kernels(information, Criterion("D"))
        variance = sensitivity(setting.rows(everywhere()), kernel)
        draw_map(variance, "variance, best scheme ≤ 1", axes)
    draw_frame(axes)
    draw_directions(up, axes)


def draw_efficiency(designs: Mapping[str, Sequence[Design]], axes: "Axes") -> None:
    """Draw the efficiency of designs (`multipos.design`) against their number of positions."""
    for k, (name, found) in enumerate(designs.items()):
        sizes = [len(design.positions) for design in found]
        reached = [design.efficiency for design in found]
        joined = {"linestyle": "-", "linewidth": 0.8, "fillstyle": "none"}
        draw_points(axes, sizes, reached, k, name, **joined)
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
        caption = "cannot separate the parameters"
        if entry.d_efficiency is not None:
            caption = f"D-efficiency {entry.d_efficiency:.3f}"
        write_title(one, f"{entry.name or 'scheme'}: {entry.positions} positions, {caption}")
    return figure


def design_figure(
    designs: Sequence[Design],
    *,
    include: "Source | Scheme | Calibration | None" = None,
    sensed: Names | None = None,
    **setting: Any,
) -> "Figure":
    """Return the map of the last design, and below it the efficiency of all against their size.

    `include` is that of `multipos.design`, `sensed` and `setting` are what `draw_scheme` takes.
    """
    stated, _, _ = begin_design(include, axes=sensed, **setting)
    best = designs[-1]
    figure, axes = new_figure(2)
    _draw_positions(best.positions, stated, axes[0])
    write_title(axes[0], f"{len(best.positions)} positions, efficiency {best.efficiency:.3f}")
    draw_efficiency({f"{best.model}, criterion {best.criterion}": designs}, axes[1])
    return figure


def _table(up: Array) -> dict[str, Array]:
    return {f"up_{axis}": up[:, i] for i, axis in enumerate(COMPONENTS)}

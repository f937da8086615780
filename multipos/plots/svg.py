"""How a figure is written as SVG: its text and its hatches.

Text stays text, so that the reader's own fonts draw it. A character as wide as it is high, as the
Chinese ones are, is measured as one em, whether or not a font here has it. Hatches are lines, cut
where the shape ends: browsers print a pattern of SVG as an image. `svg_renderer` is the class that
Matplotlib draws with, `hatch_lines` the lines of a hatch.
"""

import warnings
from functools import cache
from math import ceil, floor
from typing import TYPE_CHECKING, Any

from multipos.plots.fonts import is_wide

if TYPE_CHECKING:
    from matplotlib.path import Path

_EM = "\N{EM DASH}"
_HATCH_WIDTH = 0.6  # points
_HATCH_STEP = 12.0  # points between upright or level lines of one mark; of two, half as many
_SLANT = 2.0  # times as much between slanting ones, along an axis

# Slopes of the lines that a mark of a hatch stands for; None is upright.
_SLOPES: dict[str, tuple[float | None, ...]] = {
    "/": (1.0,),
    "\\": (-1.0,),
    "x": (1.0, -1.0),
    "-": (0.0,),
    "|": (None,),
    "+": (0.0, None),
}


def hatch_lines(hatch: str, low: tuple[float, float], high: tuple[float, float]) -> "Path":
    """Return the lines of a hatch in the rectangle between two corners, in points.

    They lie on one grid for all shapes, so that those of neighbours meet.
    """
    from matplotlib.path import Path

    step = _HATCH_STEP / len(hatch)
    ends: list[tuple[float, float]] = []
    for slope in _SLOPES[hatch[0]]:
        if slope is None:  # as level ones, x and y interchanged
            ends += [(x, y) for y, x in _sloping(0.0, step, low[::-1], high[::-1])]
        else:
            ends += _sloping(slope, step, low, high)
    return Path(ends or [low], [Path.MOVETO, Path.LINETO] * (len(ends) // 2) or [Path.MOVETO])


def _sloping(
    slope: float, step: float, low: tuple[float, float], high: tuple[float, float]
) -> list[tuple[float, float]]:
    """Return the ends of the lines y = slope x + c, c a multiple of the step, in a rectangle."""
    step *= _SLANT if slope else 1.0
    rises = (slope * low[0], slope * high[0])
    first, last = low[1] - max(rises), high[1] - min(rises)
    ends = []
    for k in range(ceil(first / step), floor(last / step) + 1):
        start, stop = low[0], high[0]
        if slope:
            crossed = sorted((y - k * step) / slope for y in (low[1], high[1]))
            start, stop = max(start, crossed[0]), min(stop, crossed[1])
        ends += [(x, slope * x + k * step) for x in (start, stop)]
    return ends


@cache
def svg_renderer() -> Any:
    """Return the class of Matplotlib's renderer of SVG, all text as text, none as mathematics."""
    from matplotlib.backends.backend_svg import RendererSVG
    from matplotlib.transforms import IdentityTransform

    # Its own methods have no types.
    base: Any = RendererSVG

    class Renderer(base):  # type: ignore[misc]
        def draw_text(
            self,
            gc: Any,
            x: float,
            y: float,
            s: str,
            prop: Any,
            angle: float,
            ismath: bool = False,
            mtext: Any = None,
        ) -> None:
            # `svg.fonttype` would decide between text and outlines.
            self._draw_text_as_text(gc, x, y, s, prop, angle, False, mtext)

        def get_text_width_height_descent(self, s: str, prop: Any, ismath: object) -> Any:
            measured = "".join(_EM if is_wide(mark) else mark for mark in s)
            with warnings.catch_warnings():  # the viewer has fonts of its own
                warnings.filterwarnings("ignore", message="Glyph ")
                return super().get_text_width_height_descent(measured, prop, False)

        def draw_path(self, gc: Any, path: Any, transform: Any, rgbFace: Any = None) -> None:
            gc.set_sketch_params()
            path.simplify_threshold = 1.0 / 9.0
            path.should_simplify = path.codes is None and len(path) >= 128
            hatch = gc.get_hatch()
            gc.set_hatch(None)
            super().draw_path(gc, path, transform, rgbFace)
            if hatch:
                box = path.get_extents(transform)
                gc.set_foreground(gc.get_hatch_color())
                gc.set_linewidth(_HATCH_WIDTH)
                lines = hatch_lines(hatch, tuple(box.min), tuple(box.max))
                super().draw_path(gc, lines, IdentityTransform())

        def option_image_nocomposite(self) -> bool:
            return False

    return Renderer

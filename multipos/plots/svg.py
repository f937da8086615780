"""How a figure is written as SVG: its text, its hatches and its layout.

Text stays text, so that the reader's own fonts draw it, in whatever language it is put on the way;
the layout is measured with the words that stand there in the end. A character as wide as it is
high, as the Chinese ones are, is measured as one em, whether or not a font here has it.

Hatches are lines, cut where the shape ends: browsers print a pattern of SVG as an image.
"""

import unicodedata
from collections.abc import Callable
from functools import cache
from math import ceil, floor
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.path import Path

Words = Callable[[str], str]

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


def svg_renderer(*arguments: Any, words: Words, **options: Any) -> Any:
    """Return Matplotlib's renderer of SVG, all text as text in these words, none as mathematics."""
    renderer = _renderer()(*arguments, **options)
    renderer.words = words
    return renderer


def svg_canvas(figure: "Figure", renderer: Any) -> Any:
    """Return a canvas that lets the layout measure with the renderer that draws."""
    return _canvas()(figure, renderer)


def is_wide(mark: str) -> bool:
    """Return whether a character is as wide as it is high."""
    return unicodedata.east_asian_width(mark) in "WF"


def hatch_lines(hatch: str, low: tuple[float, float], high: tuple[float, float]) -> "Path":
    """Return the lines of a hatch in the rectangle between two corners, in points.

    They lie on one grid for all shapes, so that those of neighbours meet.
    """
    from matplotlib.path import Path

    step = _HATCH_STEP / len(hatch)
    ends: list[tuple[float, float]] = []
    for slope in _SLOPES[hatch[0]]:
        ends += _upright(step, low, high) if slope is None else _sloping(slope, step, low, high)
    return Path(ends or [low], [Path.MOVETO, Path.LINETO] * (len(ends) // 2) or [Path.MOVETO])


def _upright(
    step: float, low: tuple[float, float], high: tuple[float, float]
) -> list[tuple[float, float]]:
    places = range(ceil(low[0] / step), floor(high[0] / step) + 1)
    return [(k * step, y) for k in places for y in (low[1], high[1])]


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
def _renderer() -> Any:
    from matplotlib.backends.backend_svg import RendererSVG
    from matplotlib.transforms import IdentityTransform

    # Its own methods have no types.
    base: Any = RendererSVG

    class Renderer(base):  # type: ignore[misc]
        words: Words

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
            # `svg.fonttype` would decide between text and outlines: reports translate text.
            self._draw_text_as_text(gc, x, y, self.words(s), prop, angle, False, mtext)

        def get_text_width_height_descent(self, s: str, prop: Any, ismath: object) -> Any:
            measured = "".join(_EM if is_wide(mark) else mark for mark in self.words(s))
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


@cache
def _canvas() -> Any:
    from matplotlib.backend_bases import FigureCanvasBase

    class Canvas(FigureCanvasBase):
        def __init__(self, figure: "Figure", renderer: Any) -> None:
            super().__init__(figure)
            self._measures = renderer

        def get_renderer(self) -> Any:
            return self._measures

    return Canvas

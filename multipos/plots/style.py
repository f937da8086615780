"""The look that all figures share.

`new_figure` makes axes and `figure_of` a figure of panels; `to_svg` and `render` give its bytes.
`name_series`, `name_axis`, `scale_by_powers`, `write` and `write_title` put names, scales and words
on axes, and `dress_axis` its ticks and numbers.

Colours are those of Okabe and Ito, which colour-blind people can tell apart, and every series has
a second cue: a marker, a line style, a hatch or a number.

A figure carries its look with it. Matplotlib's own settings (`rcParams`) belong to the whole
process: a program that draws changes them under the hands of all others, and whoever has changed
them changes the figures of all others. So nothing here sets them, and what they would decide is
decided here: sizes and colours when the axes are made, type and ids when the figure is written.
"""

import re
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from multipos.errors import MultiposError
from multipos.files.numbers import SUPERSCRIPT, in_unit, readable_unit
from multipos.plots.fonts import FONT, font_of
from multipos.plots.svg import svg_renderer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#f0e442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
HATCHES = ("", "//", "\\\\", "xx", "--", "||", "++", "////")  # dots would weigh 150 kB each

When = Literal["both", "before", "after"]  # of compensation: what a panel shows

_INK = "#000000"
_SIZE = 9.0  # of type, in points
_FONTS = f"'{FONT}', 'Bitstream Vera Sans', Verdana, Geneva, Arial, Helvetica, sans-serif"
_MOST_DECIMALS = 9  # along an axis
_DPI = 200  # dots per inch of a .png

# Matplotlib is not thread-safe, says its manual, and asks those who use threads to draw one after
# the other. Making a figure needs no lock, as each has its own artists.
_DRAWING = Lock()


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = 5.8, height: float = 2.6
) -> "tuple[Figure, Any]":
    """Return a figure of axes in rows and columns, and the axes, row by row; sizes in inches."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ModuleNotFoundError:
        said = "a figure needs matplotlib, which is not installed; pip install matplotlib."
        raise MultiposError(said) from None

    layout = ConstrainedLayoutEngine(h_pad=0.04167, w_pad=0.04167, hspace=0.02, wspace=0.02)
    figure = Figure(
        figsize=(width, height * rows),
        dpi=100.0,
        facecolor="#ffffff",
        edgecolor="#ffffff",
        linewidth=0.0,
        frameon=True,
        layout=layout,
    )
    edges = {"left": 0.125, "right": 0.9, "bottom": 0.11, "top": 0.88}  # before the layout
    axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw=edges).ravel()
    for one in axes:
        _dress(one)
    return figure, axes


def figure_of(panels: "Sequence[Callable[[Axes], object]]", **size: float) -> "Figure":
    """Return a figure of panels below each other, each drawn by its own function."""
    figure, axes = new_figure(len(panels), 1, **size)
    for draw, one in zip(panels, axes, strict=True):
        draw(one)
    return figure


def to_svg(figure: "Figure") -> str:
    """Return a figure as an SVG element, without date: the same drawing gives the same bytes."""
    from io import StringIO

    from matplotlib.backend_bases import FigureCanvasBase
    from matplotlib.backends import backend_mixed

    stream = StringIO()
    width, height = figure.get_size_inches()
    patches = [figure.patch, *(axes.patch for axes in figure.axes)]
    kept = figure.canvas, figure.dpi, [patch.get_facecolor() for patch in patches]
    for patch in patches:
        patch.set_facecolor("none")  # whatever the page is like
    _settle(figure, measured=True)
    with _DRAWING:
        figure.dpi = 72.0  # that of SVG
        vectors = svg_renderer()(
            72.0 * width,
            72.0 * height,
            stream,
            image_dpi=kept[1],
            metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")),
        )
        canvas: Any = FigureCanvasBase(figure)
        canvas.get_renderer = lambda: vectors  # so that the layout measures with what draws
        mixed: Any = backend_mixed  # without types
        figure.draw(mixed.MixedModeRenderer(figure, width, height, kept[1], vectors))
        vectors.finalize()
    figure.set_canvas(kept[0])
    figure.dpi = kept[1]
    for patch, colour in zip(patches, kept[2], strict=True):
        patch.set_facecolor(colour)
    return _plain(stream.getvalue())


def render(figure: "Figure", ending: str) -> str | bytes:
    """Return a figure as the file of an ending, .svg, .png or .pdf: without date, as `to_svg`."""
    if ending == ".svg":
        return to_svg(figure)
    from io import BytesIO

    stream = BytesIO()
    dates = {"CreationDate": None} if ending == ".pdf" else None
    _settle(figure, measured=False)
    with _DRAWING:
        figure.savefig(
            stream,
            format=ending.removeprefix("."),
            dpi=_DPI,
            facecolor="#ffffff",
            bbox_inches=figure.bbox_inches,
            transparent=False,
            metadata=dates,
        )
    return stream.getvalue()


def name_series(axes: "Axes", columns: int) -> None:
    """Name the series above the axes, where no datum is."""
    axes.legend(
        loc="lower right",
        ncols=columns,
        fontsize=8.5,
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        borderaxespad=0.0,
        borderpad=0.4,
        labelspacing=0.5,
        markerscale=1.0,
        handlelength=2.0,
        handleheight=0.7,
        handletextpad=0.8,
        columnspacing=2.0,
        numpoints=1,
        labelcolor=_INK,
    )


def write(axes: "Axes", x: float, y: float, text: str, **look: Any) -> None:
    """Write a word into the axes, by default in the size and colour of the other type."""
    axes.text(x, y, text, **{"fontsize": _SIZE, "color": _INK, **look})


def write_title(axes: "Axes", text: str) -> None:
    """Write a title above the axes, on the left."""
    axes.set_title(text, loc="left", fontsize=_SIZE, color=_INK, fontweight="normal", pad=6.0)


def scale_by_powers(
    axes: "Axes", which: Literal["x", "y"], unit: str = "", **beyond: float
) -> None:
    """Make an axis logarithmic, or so beyond a threshold `linthresh`, labelled 10⁻³ or 1 mg."""
    kind = "symlog" if beyond else "log"
    if which == "x":
        axes.set_xscale(kind, **beyond)
    else:
        axes.set_yscale(kind, **beyond)
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(_powers()(unit))
    if not beyond:
        axis.set_minor_formatter(_powers()(unit))


def name_axis(axis: "Axis", word: str, unit: str) -> None:
    """Name an axis after all is drawn on it, its numbers in a unit that people read."""
    low, high = axis.get_view_interval()
    factor, shown = readable_unit(max(abs(low), abs(high)), unit)
    axis.set_major_formatter(_scaled()(factor))
    axis.set_label_text(f"{word} [{shown}]" if shown else word)


def dress_axis(axis: "Axis") -> None:
    """Give an axis its ticks, labels and numbers."""
    from matplotlib.ticker import MaxNLocator, NullLocator

    axis.set_tick_params(
        which="both", reset=False, direction="out", color=_INK, labelcolor=_INK, labelsize=_SIZE
    )
    axis.set_tick_params(which="major", size=3.5, width=0.8, pad=3.5)
    axis.set_tick_params(which="minor", size=2.0, width=0.6, pad=3.4)
    axis.set_major_locator(MaxNLocator(nbins="auto", steps=[1, 2, 2.5, 5, 10]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(_numbers()())
    axis.label.set(color=_INK, fontsize=_SIZE, fontweight="normal")
    axis.offsetText.set(color=_INK, fontsize=_SIZE)
    axis.labelpad = 4.0
    axis.grid(False, which="both")


def _dress(axes: "Axes") -> None:
    from cycler import cycler

    for side, spine in axes.spines.items():
        spine.set(visible=side in ("left", "bottom"), edgecolor=_INK, linewidth=0.8)
    axes.tick_params(
        which="both",
        top=False,
        right=False,
        bottom=True,
        left=True,
        labeltop=False,
        labelright=False,
        labelbottom=True,
        labelleft=True,
    )
    for axis in (axes.xaxis, axes.yaxis):
        dress_axis(axis)
    axes.set_facecolor("#ffffff")
    axes.set_axisbelow("line")
    axes.margins(0.05)
    # What a line is like where the call that draws it does not say.
    axes.set_prop_cycle(
        cycler(
            color=[COLOURS[0]],
            linewidth=[1.5],
            linestyle=["-"],
            marker=["None"],
            markersize=[4.0],
            markeredgewidth=[1.0],
            fillstyle=["full"],
        )
    )


def _settle(figure: "Figure", *, measured: bool) -> None:
    """Decide what is still open of the type and the lines of a figure that has been drawn.

    Where text is only measured, as for SVG, it needs no font that has all its characters.
    """
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

    for text in figure.findobj(Text):  # ticks that are made later take after the first
        shown = "" if measured else text.get_text()
        text.set(usetex=False, fontproperties=font_of(shown, float(text.get_fontsize())))
    for line in figure.findobj(Line2D):
        line.set(
            solid_capstyle="projecting",
            dash_capstyle="butt",
            solid_joinstyle="round",
            dash_joinstyle="round",
        )


def _plain(text: str) -> str:
    """Return the SVG element alone, with ids that are numbers and everywhere the same type."""
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg [^>]*?) id="[^"]*"', r"\1", text, count=1)
    # Ids are drawn by lot where `svg.hashsalt` is not set.
    numbers: dict[str, str] = {}
    return re.sub(
        r'(\bid="|url\(#|href="#)([^")]+)',
        lambda match: match[1] + numbers.setdefault(match[2], f"i{len(numbers)}"),
        text.replace(f"'{FONT}'", _FONTS),
    )


@cache
def _numbers() -> Any:
    """Return the class that writes the numbers along an axis."""
    from matplotlib.ticker import ScalarFormatter

    class Numbers(ScalarFormatter):
        def __init__(self) -> None:
            super().__init__(useOffset=True, useMathText=False, useLocale=False)
            self._usetex = False
            self.set_powerlimits((-5, 6))

        def get_offset(self) -> str:
            """Return what all numbers are to be multiplied by: ×10⁻³."""
            text = super().get_offset().replace("−", "-")
            return re.sub(r"e\+?(-?\d+)", lambda m: f"×10{m[1].translate(SUPERSCRIPT)}", text)

        @staticmethod
        def fix_minus(s: str) -> str:
            return s.replace("-", "−")

    return Numbers


@cache
def _scaled() -> Any:
    """Return the class that writes the numbers along an axis times a factor."""
    from matplotlib.ticker import Formatter

    class Scaled(Formatter):
        def __init__(self, factor: float) -> None:
            self._factor, self._form = factor, "g"

        def format_ticks(self, values: Any) -> list[str]:
            shown = sorted(self._factor * float(x) for x in values)
            step = min((b - a for a, b in pairwise(shown) if b > a), default=0.0)
            fits = (d for d in range(_MOST_DECIMALS) if _on_grid(shown, 10.0**-d, step))
            short = step > 0.0 and max(map(abs, shown)) < 10.0**_MOST_DECIMALS
            self._form = f".{next(fits, _MOST_DECIMALS)}f" if short else ".4g"
            return [self(x) for x in values]

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{self._factor * x + 0.0:{self._form}}".replace("-", "−")

    return Scaled


def _on_grid(values: Sequence[float], grid: float, step: float) -> bool:
    return all(abs(value - round(value / grid) * grid) < 1e-3 * step for value in values)


@cache
def _powers() -> Any:
    """Return the class that writes the numbers along a logarithmic axis."""
    from math import floor, log10

    from matplotlib.ticker import LogFormatter

    class Powers(LogFormatter):
        def __init__(self, unit: str) -> None:
            super().__init__()
            self._unit = unit

        def __call__(self, x: float, pos: int | None = None) -> str:
            if x == 0.0 or not super().__call__(x, pos):  # which of them are labelled
                return "0" if x == 0.0 else ""
            sign = "−" if x < 0.0 else ""
            if self._unit:
                return sign + in_unit(abs(x), self._unit)
            exponent = floor(log10(abs(x)) + 1e-9)
            digits = round(abs(x) / 10.0**exponent)
            times = "" if digits == 1 else f"{digits}×"
            return f"{sign}{times}10{str(exponent).translate(SUPERSCRIPT)}"

    return Powers

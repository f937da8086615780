"""The look that all figures share.

Colours are those of Okabe and Ito, which colour-blind people can tell apart, and every series has
a second cue: a marker, a line style, a hatch or a number.
"""

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#f0e442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
HATCHES = ("", "//", "\\\\", "xx", "--", "||", "++", "////")  # dots would weigh 150 kB each

_DPI = 200  # dots per inch of a .png
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "multipos",
    "font.size": 9.0,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.6,
    "lines.markersize": 4.0,
}


def new_figure(rows: int = 1, *, width: float = 5.8, height: float = 2.6) -> "tuple[Figure, Any]":
    """Return a figure of so many axes below each other, and the axes (rows,); sizes in inches."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(width, height * rows), layout="constrained")
        axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    return figure, axes


def to_svg(figure: "Figure") -> str:
    """Return a figure as an SVG element, without date: the same drawing gives the same bytes."""
    from io import StringIO

    from matplotlib import rc_context

    stream = StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with rc_context(_STYLE):
        figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    return re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)


def render(figure: "Figure", ending: str) -> str | bytes:
    """Return a figure as the file of an ending, .svg, .png or .pdf: without date, as `to_svg`."""
    if ending == ".svg":
        return to_svg(figure)
    from io import BytesIO

    from matplotlib import rc_context

    stream = BytesIO()
    dates = {"CreationDate": None} if ending == ".pdf" else None
    with rc_context(_STYLE):
        figure.savefig(stream, format=ending.removeprefix("."), dpi=_DPI, metadata=dates)
    return stream.getvalue()


def name_series(axes: "Axes", columns: int) -> None:
    """Name the series above the axes, where no datum is."""
    axes.legend(loc="lower right", ncols=columns, fontsize=8, bbox_to_anchor=(1.0, 1.0),
                frameon=False, borderaxespad=0.0)  # fmt: skip

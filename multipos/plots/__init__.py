"""Figures, each a function that draws on a matplotlib axes it is given.

`new_figure` makes a figure that knows nothing of the screen.
"""

from multipos.plots.check import draw_check
from multipos.plots.schemes import draw_efficiency, draw_scheme
from multipos.plots.style import new_figure
from multipos.plots.temperature import draw_correction, draw_curve, draw_path
from multipos.plots.tumble import draw_residual_harmonics, draw_signal

__all__ = [
    "draw_check",
    "draw_correction",
    "draw_curve",
    "draw_efficiency",
    "draw_path",
    "draw_residual_harmonics",
    "draw_scheme",
    "draw_signal",
    "new_figure",
]

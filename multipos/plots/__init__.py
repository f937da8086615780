"""Figures, each a function that draws on a matplotlib axes it is given.

`new_figure` makes a figure that knows nothing of the screen, `to_svg` writes it so that the same
drawing gives the same bytes.
"""

from multipos.plots.calibration import (
    compensated_error,
    draw_budget,
    draw_correlation,
    draw_coverage,
    draw_errors,
    draw_leverage,
    draw_residuals,
    nominal_error,
    variance_shares,
)
from multipos.plots.check import check_svg, draw_check
from multipos.plots.runs import draw_runs, runs_svg
from multipos.plots.schemes import draw_efficiency, draw_scheme
from multipos.plots.style import new_figure, to_svg
from multipos.plots.temperature import draw_correction, draw_curve, draw_path, regression_svg
from multipos.plots.tumble import (
    draw_harmonics,
    draw_residual_harmonics,
    draw_rolls,
    draw_signal,
    tumble_svg,
)

__all__ = [
    "check_svg",
    "compensated_error",
    "draw_budget",
    "draw_check",
    "draw_correction",
    "draw_correlation",
    "draw_coverage",
    "draw_curve",
    "draw_efficiency",
    "draw_errors",
    "draw_harmonics",
    "draw_leverage",
    "draw_path",
    "draw_residual_harmonics",
    "draw_residuals",
    "draw_rolls",
    "draw_runs",
    "draw_scheme",
    "draw_signal",
    "new_figure",
    "nominal_error",
    "regression_svg",
    "runs_svg",
    "to_svg",
    "tumble_svg",
    "variance_shares",
]

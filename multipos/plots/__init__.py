"""Figures, each a function that draws on a matplotlib axes it is given.

`new_figure` makes a figure that knows nothing of the screen, `render` gives it as SVG, PNG or PDF,
the same bytes for the same drawing. Open `style` first, where both stand. This room alone is public
as it is: users draw on axes of their own.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multipos.plots.calibration import (
        compensated_error,
        draw_budget,
        draw_errors,
        draw_residuals,
        draw_size_residuals,
        size_residuals,
        variance_shares,
    )
    from multipos.plots.fits import (
        calibration_figure,
        check_figure,
        draw_balance,
        draw_check,
        draw_correction,
        draw_curve,
        draw_path,
        regression_figure,
    )
    from multipos.plots.runs import draw_runs, runs_figure
    from multipos.plots.schemes import design_figure, draw_efficiency, draw_scheme, schemes_figure
    from multipos.plots.stability import draw_allan, draw_zero, stability_figure
    from multipos.plots.style import new_figure, render, to_svg
    from multipos.plots.tumble import (
        draw_harmonics,
        draw_residual_harmonics,
        draw_rolls,
        draw_signal,
        tumble_figure,
    )
    from multipos.sensor.calibration import nominal_error

# Read when first used: what draws one figure need not know the others' results.
_FILES = {
    "calibration": "compensated_error draw_budget draw_errors draw_residuals "
    "draw_size_residuals nominal_error size_residuals variance_shares",
    "fits": "calibration_figure check_figure draw_balance draw_check draw_correction draw_curve "
    "draw_path regression_figure",
    "runs": "draw_runs runs_figure",
    "schemes": "design_figure draw_efficiency draw_scheme schemes_figure",
    "stability": "draw_allan draw_zero stability_figure",
    "style": "new_figure render to_svg",
    "tumble": "draw_harmonics draw_residual_harmonics draw_rolls draw_signal tumble_figure",
}
__all__ = [
    "calibration_figure",
    "check_figure",
    "compensated_error",
    "design_figure",
    "draw_allan",
    "draw_balance",
    "draw_budget",
    "draw_check",
    "draw_correction",
    "draw_curve",
    "draw_efficiency",
    "draw_errors",
    "draw_harmonics",
    "draw_path",
    "draw_residual_harmonics",
    "draw_residuals",
    "draw_rolls",
    "draw_runs",
    "draw_scheme",
    "draw_signal",
    "draw_size_residuals",
    "draw_zero",
    "new_figure",
    "nominal_error",
    "regression_figure",
    "render",
    "runs_figure",
    "schemes_figure",
    "size_residuals",
    "stability_figure",
    "to_svg",
    "tumble_figure",
    "variance_shares",
]


def __getattr__(name: str) -> Any:
    for file, names in _FILES.items():
        if name in names.split():
            return getattr(import_module(f"multipos.plots.{file}"), name)
    raise AttributeError(f"module 'multipos.plots' has no attribute '{name}'")

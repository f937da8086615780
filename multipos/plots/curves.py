"""The figure of a fit: what is left of every output, and its parameters over temperature."""

from typing import TYPE_CHECKING

from multipos.plots.calibration import residual_panels
from multipos.plots.style import new_figure
from multipos.plots.temperature import draw_curve
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.temperature import Curve, over_temperature

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TEMPERATURE = "temperature"


def temperature_curves(calibration: Calibration) -> tuple[Curve, ...]:
    """Return the parameters that change over temperature; none without such a term."""
    model = calibration.model
    if isinstance(model, ExpressionModel) or _TEMPERATURE not in model.environment:
        return ()
    curves = over_temperature(calibration, column=_TEMPERATURE)
    return tuple(curve for curve in curves if curve.value.min() < curve.value.max())


def calibration_figure(calibration: Calibration) -> "Figure":
    """Return the residuals of every output, and below them what changes over temperature."""
    c = calibration
    curves = temperature_curves(c)
    panels = residual_panels(c)
    figure, axes = new_figure(len(panels) + len(curves))
    for draw, one in zip(panels, axes, strict=False):
        draw(one)
    for curve, one in zip(curves, axes[len(panels) :], strict=True):
        draw_curve(curve, one)
    return figure

"""The figure of a fit: what is left of every output, and its parameters over temperature."""

from functools import partial
from typing import TYPE_CHECKING

from multipos.plots.calibration import residual_panels
from multipos.plots.style import figure_of
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
    curves = [partial(draw_curve, curve) for curve in temperature_curves(calibration)]
    return figure_of([*residual_panels(calibration), *curves])

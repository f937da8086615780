"""Figures of parameters over temperature, and the figure of a fit.

`draw_curve` draws one parameter with its bands, `temperature_curves` returns those that change, and
`calibration_figure` is the figure of the residuals and of these.
"""

from functools import partial
from typing import TYPE_CHECKING

from multipos.plots import style
from multipos.plots.calibration import residual_panels
from multipos.plots.marks import draw_band, draw_line
from multipos.sensor.calibration import Calibration
from multipos.sensor.temperature import Curve, over_temperature

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_curve(curve: Curve, axes: "Axes") -> None:
    """Draw a parameter against temperature with its bands: U at one, and at all temperatures."""
    t = curve.temperature
    draw_band(axes, t, curve.value, curve.band, 5, "band, all temperatures")
    draw_line(axes, t, curve.value - curve.U, 0, linestyle="--")
    draw_line(axes, t, curve.value + curve.U, 0, "U, one temperature", linestyle="--")
    draw_line(axes, t, curve.value, 0, curve.name, linewidth=1.2)
    axes.set_xlabel("temperature")
    style.name_axis(axes.yaxis, curve.name, curve.unit)
    style.name_series(axes, 3)


_TEMPERATURE = "temperature"


def temperature_curves(calibration: Calibration) -> tuple[Curve, ...]:
    """Return the parameters that change over temperature; none without such a term."""
    model = calibration.model
    if not model.has_terms or _TEMPERATURE not in model.environment:
        return ()
    curves = over_temperature(calibration, column=_TEMPERATURE)
    return tuple(curve for curve in curves if curve.value.min() < curve.value.max())


def calibration_figure(calibration: Calibration) -> "Figure":
    """Return the residuals of every output, and below them what changes over temperature."""
    curves = [partial(draw_curve, curve) for curve in temperature_curves(calibration)]
    return style.figure_of([*residual_panels(calibration), *curves])

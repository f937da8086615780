"""The section of a report on temperature: what changes with it, with its bands."""

from typing import Any

from multipos.plots.curves import temperature_curves
from multipos.plots.temperature import draw_curve
from multipos.reports.page import Figure, Section, draw_svg
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration


def temperature_sections(c: Calibration, tr: Translator) -> tuple[Section, ...]:
    """Return the section, or none where nothing changes with temperature."""
    curves = temperature_curves(c)
    if not curves:
        return ()

    def draw(axes: Any) -> None:
        for curve, one in zip(curves, axes, strict=True):
            draw_curve(curve, one)

    return (
        Section(
            tr("Over temperature"),
            (
                tr(
                    "What changes with temperature, over the range of the readings: U holds at one "
                    "temperature, the band at all of them together (Scheffé)."
                ),
            ),
            (
                Figure(
                    tr("Parameters over temperature"),
                    tr("One panel for each parameter that changes."),
                    lambda: draw_svg(tr, len(curves), 1.9, draw),
                ),
            ),
        ),
    )

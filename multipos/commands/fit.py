"""``multipos fit``."""

import argparse
from functools import partial
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.fitting.fit_readings import fit
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text
from multipos.sensor.calibration import Calibration

INPUTS = ("readings", "scheme", "budget")
OUTPUT = Output("CAL.json", "write the calibration to CAL.json", "json", ("text", "figure"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    calibration = fit(arguments.readings, **options_of(arguments, "fit"))
    forms = {"figure": lambda: _figure(calibration)}
    detail = partial(detail_text, calibration)
    return answer_of(calibration, calibration_sentence, parameter_text, detail=detail, forms=forms)


def _figure(calibration: Calibration) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.curves import calibration_figure

    return calibration_figure(calibration)

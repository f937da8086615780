"""``multipos fit``."""

import argparse
from typing import Any

from multipos.commands.answers import Answer, Output
from multipos.commands.options import options_of
from multipos.files.trees import to_json
from multipos.fitting.fit_readings import fit
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text
from multipos.sensor.calibration import Calibration

INPUTS = ("readings", "scheme", "budget")
OUTPUT = Output("CAL.json", "write the calibration to CAL.json", "json", ("text", "figure"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    calibration = fit(arguments.readings, **options_of(arguments, "fit"))
    return Answer(
        sentence=lambda: calibration_sentence(calibration),
        text=lambda: parameter_text(calibration),
        detail=lambda: detail_text(calibration),
        json=lambda: to_json(calibration.to_dict()),
        forms={"figure": lambda: _figure(calibration)},
        findings=lambda: calibration.findings,
    )


def _figure(calibration: Calibration) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.fits import calibration_figure

    return calibration_figure(calibration)

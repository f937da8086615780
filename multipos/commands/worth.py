"""``multipos worth``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import options_of
from multipos.designs.prospects import worth, worth_sentence, worth_text
from multipos.files.trees import to_json
from multipos.sensor.calibration_file import load

INPUTS = ("calibration", "candidates")
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json",))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    calibration = load(arguments.calibration)
    towards = calibration.field.towards
    found = worth(calibration, **options_of(arguments, "worth"))
    return Answer(
        sentence=lambda: worth_sentence(found, towards),
        text=lambda: worth_text(found, towards),
        json=lambda: to_json(found),
    )

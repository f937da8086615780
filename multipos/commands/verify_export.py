"""``multipos verify-export``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.compensation.reading_back import verify_export
from multipos.files.trees import to_json
from multipos.sensor.calibration_file import load

INPUTS = ("file", "calibration")
OUTPUT = Output("OUT", "write the result to OUT as well", "text", ("json",))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("file", metavar="FILE", help="file that export wrote")
    parser.add_argument("calibration", metavar="CAL.json", help="calibration it came from")
    parser.add_argument(
        "--run-foreign-code",
        action="store_true",
        help="compile and run C that is not what export writes of CAL.json: it does what it says",
    )


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = verify_export(
        arguments.file,
        load(arguments.calibration),
        run_foreign_code=arguments.run_foreign_code,
    )
    return Answer(text=lambda: str(found), json=lambda: to_json(found.to_dict()))

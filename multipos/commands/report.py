"""``multipos report``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output
from multipos.errors import UsageError
from multipos.files import to_json
from multipos.reports import write_report


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("calibration", metavar="CAL.json", help="calibration to report")
    add_output(parser, "REPORT", "file to write, .md or .txt")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    if not arguments.output:
        raise UsageError("report needs -o REPORT.md or REPORT.txt.")
    calibration = load(arguments.calibration)
    write_report(calibration, arguments.output)
    if arguments.json:
        return to_json({"report": arguments.output, "created": calibration.created})
    return f"Written to {arguments.output}\n"

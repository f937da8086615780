"""``multipos verify-export``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output
from multipos.exporters import verify_export
from multipos.files import to_json, write_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("file", metavar="FILE", help="file that export wrote")
    parser.add_argument("calibration", metavar="CAL.json", help="calibration it came from")
    parser.add_argument(
        "--run-foreign-code",
        action="store_true",
        help="compile and run C that is not what export writes of CAL.json: it does what it says",
    )
    add_output(parser, "OUT", "write the result to OUT as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    found = verify_export(
        arguments.file,
        load(arguments.calibration),
        run_foreign_code=arguments.run_foreign_code,
    )
    text = to_json(found.to_dict()) if arguments.json else str(found)
    if arguments.output:
        write_text(arguments.output, text)
    return text

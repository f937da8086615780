"""``multipos compare``."""

import argparse

from multipos.commands.options import add_output, warn, write_form
from multipos.comparison import compare, comparison_text
from multipos.files import to_json
from multipos.plots import runs_svg


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibrations", nargs="+", metavar="CAL.json", help="repeats of one unit, in order")
    add(
        "--confidence",
        type=float,
        default=0.95,
        metavar="P",
        help="called inconsistent beyond this probability (default 0.95)",
    )
    add_output(parser, "FILE", "write the result to FILE as well; .svg draws zero against run")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    found = compare(*arguments.calibrations, confidence=arguments.confidence)
    text = to_json(found.to_dict()) if arguments.json else comparison_text(found)
    write_form(arguments.output, text, svg=lambda: runs_svg(found))
    warn(found.warnings)
    return text

"""``multipos worth``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output
from multipos.files import to_json, write_text
from multipos.prospects import worth, worth_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration written by `multipos fit`")
    add(
        "--candidates",
        default="all-26",
        metavar="S",
        help="bench or scheme of positions that could be next (default all-26)",
    )
    add("--parameter", metavar="OUTPUT:TERM", help="the parameter that counts (default all)")
    add("--target", type=float, metavar="U", help="standard uncertainty it shall have")
    add_output(parser, "FILE", "write the result to FILE as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    found = worth(
        load(arguments.calibration),
        candidates=arguments.candidates,
        parameter=arguments.parameter,
        target=arguments.target,
    )
    text = to_json(found) if arguments.json else worth_text(found)
    if arguments.output:
        write_text(arguments.output, text)
    return text

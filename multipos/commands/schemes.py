"""``multipos schemes``."""

import argparse

from multipos.assessment import schemes, schemes_text
from multipos.commands.options import add_model, add_orientation, add_output, warn
from multipos.files import to_json, write_text
from multipos.information import nothing_to_weigh


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("schemes", nargs="*", metavar="SCHEME", help="names or files; all if none")
    add_model(parser)
    add_orientation(parser)
    parser.add_argument(
        "--reading-sd",
        type=float,
        default=1.0,
        metavar="SD",
        help="standard uncertainty of a reading (default 1); in g beside --orientation-sd",
    )
    add_output(parser, "FILE", "write the result to FILE as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    found = schemes(
        *arguments.schemes,
        model=arguments.model,
        axes=arguments.axes or ("x", "y", "z"),
        inputs=arguments.inputs,
        unknown_orientation=arguments.unknown_orientation,
        orientation_sd=arguments.orientation_sd,
        reading_sd=arguments.reading_sd,
    )
    text = to_json(found) if arguments.json else schemes_text(found)
    if arguments.output:
        write_text(arguments.output, text)
    warn(nothing_to_weigh(arguments.orientation_sd, arguments.reading_sd))
    return text

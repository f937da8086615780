"""``multipos schemes``."""

import argparse

from multipos.commands.options import add_model, add_output
from multipos.designs import schemes, schemes_text
from multipos.files import to_json, write_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("schemes", nargs="*", metavar="SCHEME", help="names or files; all if none")
    add_model(parser)
    parser.add_argument(
        "--reading-sd",
        type=float,
        default=1.0,
        metavar="SD",
        help="standard uncertainty of a reading (default 1)",
    )
    add_output(parser, "FILE", "write the result to FILE as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    found = schemes(
        *arguments.schemes,
        model=arguments.model,
        axes=arguments.axes or ("x", "y", "z"),
        inputs=arguments.inputs,
        reading_sd=arguments.reading_sd,
    )
    text = to_json(found) if arguments.json else schemes_text(found)
    if arguments.output:
        write_text(arguments.output, text)
    return text

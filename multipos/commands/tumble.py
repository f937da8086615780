"""``multipos tumble``."""

import argparse

from multipos.commands.options import add_conditions, add_output, names, numbers, warn, write_form
from multipos.files import to_json
from multipos.plots import tumble_svg
from multipos.sections import tumble_text
from multipos.single_axis import tumble


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("readings", metavar="READINGS", help="CSV file of averaged readings of a tumble")
    add("--outputs", type=names, metavar="A", help="the output, where there are several columns")
    add("--axes", type=names, default=("x",), metavar="x", help="input axis (default x)")
    add("--scheme", metavar="S", help="scheme name, names joined by +, or CSV file")
    add("--model", metavar="M", help="model or formula (default: ieee-odd, less what is hidden)")
    add_conditions(parser)
    add("--reading-sd", type=numbers, metavar="SD", help="standard uncertainty of a reading")
    add_output(parser, "FILE", "write the result as JSON to FILE; .svg draws signal and harmonics")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    options = {k: v for k, v in vars(arguments).items() if k not in ("readings", "json", "output")}
    found = tumble(arguments.readings, **options)
    text = to_json(found.to_dict())
    write_form(arguments.output, text, svg=lambda: tumble_svg(found))
    warn(found.warnings)
    return text if arguments.json else tumble_text(found)

"""``multipos tumble``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import add_conditions, names, numbers
from multipos.files.trees import to_json
from multipos.plots.tumble import tumble_figure
from multipos.reports.sheets import tumble_text
from multipos.verification.single_axis import tumble

INPUTS = ("readings", "scheme")
OUTPUT = Output("FILE", "write the result to FILE as well", "json", ("figure", "text"))


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


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    options = {k: v for k, v in vars(arguments).items() if k not in ("readings", "json", "output")}
    found = tumble(arguments.readings, **options)
    return Answer(
        text=lambda: tumble_text(found),
        json=lambda: to_json(found.to_dict()),
        forms={"figure": lambda: tumble_figure(found)},
        warnings=lambda: found.warnings,
    )

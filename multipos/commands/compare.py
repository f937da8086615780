"""``multipos compare``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.files.trees import to_json
from multipos.plots.runs import runs_figure
from multipos.verification.comparison import compare, comparison_text

INPUTS = ("calibrations",)
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "figure"))


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


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = compare(*arguments.calibrations, confidence=arguments.confidence)
    return Answer(
        text=lambda: comparison_text(found),
        json=lambda: to_json(found.to_dict()),
        forms={"figure": lambda: runs_figure(found)},
        warnings=lambda: found.warnings,
    )

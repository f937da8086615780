"""``multipos compare``."""

import argparse
from typing import Any

from multipos.commands.answers import Answer, Output
from multipos.files.trees import to_json
from multipos.plots.runs import runs_figure, terms_figure
from multipos.verification.comparison import Comparison, compare, comparison_text
from multipos.verification.regression_comparison import RegressionComparison

INPUTS = ("calibrations",)
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "figure"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add(
        "calibrations", nargs="+", metavar="CAL.json|REG.json", help="repeats of one unit, in order"
    )
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
        text=lambda: _text(found),
        json=lambda: to_json(found.to_dict()),
        forms={"figure": lambda: _figure(found)},
        warnings=lambda: found.warnings,
    )


def _text(found: Comparison | RegressionComparison) -> str:
    return str(found) if isinstance(found, RegressionComparison) else comparison_text(found)


def _figure(found: Comparison | RegressionComparison) -> Any:
    """Return the figure of what was compared."""
    if isinstance(found, RegressionComparison):
        return terms_figure(found)
    return runs_figure(found)

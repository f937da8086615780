"""``multipos compare``."""

import argparse
from functools import partial

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.plots.runs import runs_figure, terms_figure
from multipos.verification.comparison import compare
from multipos.verification.comparison_text import changes_text, comparison_sentence, runs_text
from multipos.verification.regression_repeats import RegressionComparison

INPUTS = ("calibrations", "limits")
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "figure"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = compare(*arguments.calibrations, **options_of(arguments, "compare"))
    if isinstance(found, RegressionComparison):
        figure = {"figure": partial(terms_figure, found)}
        return answer_of(found, comparison_sentence, str, forms=figure, negative=lambda _: False)
    return answer_of(
        found,
        comparison_sentence,
        lambda found: changes_text(found) or runs_text(found),
        detail=lambda: runs_text(found) if changes_text(found) else "",
        forms={"figure": partial(runs_figure, found)},
        # errors are of calibrations made before
        negative=lambda _: any(each.within is False for each in found.changes),
    )

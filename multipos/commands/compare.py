"""``multipos compare``."""

import argparse
from collections.abc import Callable
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.plots.runs import runs_figure, terms_figure
from multipos.results import plain
from multipos.verification import comparison
from multipos.verification.regressions import RegressionComparison

INPUTS = ("calibrations", "limits")
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "figure"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = comparison.compare(*arguments.calibrations, **options_of(arguments, "compare"))
    forms: dict[str, Callable[[], Any]] = {}
    if isinstance(found, RegressionComparison):
        forms["figure"] = lambda: terms_figure(found)
        return answer_of(found, _sentence, str, forms=forms, negative=lambda _: False)
    forms["figure"] = lambda: runs_figure(found)
    return answer_of(
        found,
        _sentence,
        lambda found: comparison.changes_text(found) or comparison.runs_text(found),
        detail=lambda: comparison.runs_text(found) if comparison.changes_text(found) else "",
        forms=forms,
        # errors are of calibrations made before
        negative=lambda _: any(each.within is False for each in found.changes),
    )


def _sentence(found: comparison.Comparison | RegressionComparison) -> str:
    return comparison.comparison_sentence(plain(found.to_dict()))

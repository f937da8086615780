"""``multipos compare``."""

import argparse
from collections.abc import Callable

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.files.trees import to_json
from multipos.plots.runs import runs_figure, terms_figure
from multipos.reports.documents import html_report
from multipos.reports.several import comparison_content
from multipos.results import plain
from multipos.verification import comparison
from multipos.verification.regressions import RegressionComparison

INPUTS = ("calibrations", "limits")
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "figure", "html"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = comparison.compare(*arguments.calibrations, **options_of(arguments, "compare"))
    return answer_of(
        found,
        lambda found: comparison.comparison_sentence(plain(found.to_dict())),
        lambda found: _text(found)[0],
        detail=lambda: _text(found)[1],
        forms={
            "figure": lambda: (
                terms_figure(found)
                if isinstance(found, RegressionComparison)
                else runs_figure(found)
            ),
            "html": lambda: html_report(comparison_content(plain(found.to_dict()))),
            **_combined(found),
        },
        negative=lambda _: _is_beyond(found),  # errors are of calibrations made before
    )


def _is_beyond(found: comparison.Comparison | RegressionComparison) -> bool:
    """Tell whether a parameter is beyond its limit."""
    changes = found.changes if isinstance(found, comparison.Comparison) else ()
    return any(each.within is False for each in changes)


def _combined(found: comparison.Comparison | RegressionComparison) -> dict[str, Callable[[], str]]:
    """Return what `-o CAL.json` writes with --combine, in place of the comparison."""
    combined = found.combined if isinstance(found, comparison.Comparison) else None
    return {} if combined is None else {"json": lambda: to_json(combined.to_dict())}


def _text(found: comparison.Comparison | RegressionComparison) -> tuple[str, str]:
    """Return the table that is asked for, and what explains."""
    if isinstance(found, RegressionComparison):
        return str(found), ""
    changes = comparison.changes_text(found)
    return (changes, comparison.runs_text(found)) if changes else (comparison.runs_text(found), "")

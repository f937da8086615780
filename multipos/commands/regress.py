"""``multipos regress``."""

import argparse

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.files.tables import Source
from multipos.fitting.regress_columns import regress
from multipos.plots.regressions import regression_figure
from multipos.regression.observations import join_runs
from multipos.reports.regression_text import regression_sentence, regression_text

INPUTS = ("data",)
OUTPUT = Output(
    "REGRESSION.json", "write the result to REGRESSION.json", "json", ("figure", "text")
)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    options = options_of(arguments, "regress")
    data: Source
    if len(arguments.data) > 1:
        data, options["run"] = join_runs(arguments.data, options["run"])
    else:
        (data,) = arguments.data
    regression = regress(data, **options)
    forms = {"figure": lambda: regression_figure(regression, data)}
    return answer_of(
        regression, regression_sentence, lambda r: f"{regression_text(r)}\n", forms=forms
    )

"""``multipos check``."""

import argparse
from functools import partial

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.files.tables import format_csv, read_table
from multipos.files.trees import read_schema
from multipos.finding import Findings, errors_of
from multipos.plots.checks import check_figure
from multipos.regression.regression import Regression, Regressions, load_regression
from multipos.reports.check_text import check_sentence, check_text, run_conclusions
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.verification.checks import RUN, average_run, check
from multipos.verification.error_columns import errors_table
from multipos.verification.verdicts import Check

INPUTS = ("calibration", "readings", "scheme")
OUTPUT = Output(
    "FILE",
    "write the result to FILE as well, as JSON for report --check, as a table for regress",
    "text",
    ("json", "figure", "table"),
)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    fitted = read_schema(arguments.calibration) == Regression.schema
    calibration = (load_regression if fitted else load)(arguments.calibration)
    found = check(calibration, arguments.readings, **options_of(arguments, "check"))
    forms = {
        "figure": lambda: check_figure(found),
        "table": lambda: _errors(calibration, arguments, found),
    }
    more = {"detail": lambda: "\n".join(run_conclusions(found)), "forms": forms}
    negative = partial(_failed, found)
    return answer_of(found, check_sentence, check_text, negative=negative, **more)


def _failed(found: Check, findings: Findings) -> bool:
    """Tell whether the check failed, or the run itself is not fit for use."""
    verdicts = (found.verdict, found.run_verdict)
    return "fail" in verdicts or any(each.text.startswith(RUN) for each in errors_of(findings))


def _errors(
    calibration: Calibration | Regression | Regressions, arguments: argparse.Namespace, found: Check
) -> str:
    """Return the run's own columns, or the means of its log, with its errors beside, as CSV."""
    run, means = arguments.readings, None
    if isinstance(calibration, Calibration):
        means = average_run(calibration, run, arguments.scheme, arguments.outputs)
    table = read_table(run if means is None else means.columns(), what="run")
    return format_csv(errors_table(calibration, table, found), table.delimiter)

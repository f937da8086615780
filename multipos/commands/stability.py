"""``multipos stability``."""

import argparse

from multipos.bias_stability.analysis import stability
from multipos.bias_stability.stability_text import stability_sentence, stability_text
from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import declare, file_progress, options_of
from multipos.files.tables import format_csv
from multipos.logs.readers import formats_read
from multipos.plots.stability import stability_figure

INPUTS = ("logs", "calibration")
OUTPUT = Output("FILE", "write the result to FILE as well", "text", ("json", "table", "figure"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "stability", formats=formats_read())


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    with file_progress(arguments.logs, "reading") as progress:
        found = stability(*arguments.logs, progress=progress, **options_of(arguments, "stability"))
    forms = {
        "table": lambda: format_csv(found.columns()),
        "figure": lambda: stability_figure(found),
    }
    return answer_of(found, stability_sentence, stability_text, forms=forms)

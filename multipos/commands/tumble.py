"""``multipos tumble``."""

import argparse

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.plots.tumble import tumble_figure
from multipos.reports.tumble_text import tumble_sentence, tumble_text
from multipos.verification.tumbling import tumble

INPUTS = ("readings", "scheme")
OUTPUT = Output("FILE", "write the result to FILE as well", "json", ("figure", "text"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = tumble(arguments.readings, **options_of(arguments, "tumble"))
    figure = {"figure": lambda: tumble_figure(found)}
    return answer_of(found, tumble_sentence, tumble_text, forms=figure)

"""``multipos tumble``."""

import argparse
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.plots.tumble import tumble_figure
from multipos.reports.tumble_text import tumble_sentence, tumble_text, tumbles_text
from multipos.verification.tumbling import Tumbles, tumble

INPUTS = ("readings", "scheme")
OUTPUT = Output("FILE", "write the result to FILE as well", "json", ("figure", "text"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = tumble(arguments.readings, **options_of(arguments, "tumble"))
    text: Any = tumbles_text if isinstance(found, Tumbles) else tumble_text
    return answer_of(found, tumble_sentence, text, forms={"figure": lambda: tumble_figure(found)})

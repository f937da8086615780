"""``multipos tumble``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import options_of
from multipos.files.trees import to_json
from multipos.plots.tumble import tumble_figure
from multipos.reports.tumble_text import tumble_sentence, tumble_text, tumbles_text
from multipos.verification.tumbling import Tumbles, tumble

INPUTS = ("readings", "scheme")
OUTPUT = Output("FILE", "write the result to FILE as well", "json", ("figure", "text"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    found = tumble(arguments.readings, **options_of(arguments, "tumble"))
    return Answer(
        sentence=lambda: tumble_sentence(found),
        text=lambda: tumbles_text(found) if isinstance(found, Tumbles) else tumble_text(found),
        json=lambda: to_json(found.to_dict()),
        forms={"figure": lambda: tumble_figure(found)},
        findings=lambda: found.findings,
    )

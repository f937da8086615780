"""``multipos design``."""

import argparse
from collections.abc import Sequence
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import declare, options_of, progress_bar, setting_of
from multipos.designs import designing
from multipos.errors import UsageError

INPUTS = ("candidates", "include", "region")
OUTPUT = Output(
    "SCHEME.csv", "write the positions to SCHEME.csv", "table", ("json", "figure", "text")
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "design")
    parser.set_defaults(model=None, inputs=None, reading_sd=None)  # an included calibration has its


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    move_time = arguments.move_time
    if move_time is not None and (len(move_time) != 2 or min(move_time) < 0.0):
        raise UsageError("--move-time takes two times of 0 or more: per position, per degree.")
    if arguments.seed < 0:
        raise UsageError(f"--seed must be 0 or more, got {arguments.seed}.")
    options = options_of(arguments, "design")

    def make(positions: int) -> designing.Design:
        return designing.design(**options | {"positions": positions})

    with progress_bar("searching positions"):
        found = make(arguments.positions)
    forms = {
        "table": lambda: designing.design_csv(found),
        "figure": lambda: _figure(designing.smaller_designs(make, found), arguments),
    }
    return answer_of(found, designing.design_sentence, designing.design_text, forms=forms)


def _figure(designs: Sequence[designing.Design], arguments: argparse.Namespace) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.schemes import design_figure

    stated = {"include": arguments.include, "sensed": arguments.axes}
    return design_figure(designs, **stated, **setting_of(arguments))

"""``multipos design``."""

import argparse
from collections.abc import Sequence
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of, progress_bar, setting_of
from multipos.designs import designing
from multipos.errors import UsageError

INPUTS = ("candidates", "include", "region")
OUTPUT = Output(
    "SCHEME.csv", "write the positions to SCHEME.csv", "table", ("json", "figure", "text")
)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    move_time = arguments.move_time
    if move_time is not None and (len(move_time) != 2 or min(move_time) < 0.0):
        raise UsageError("--move-time takes two times of 0 or more: per position, per degree.")
    if arguments.seed < 0:
        raise UsageError(f"--seed must be 0 or more, got {arguments.seed}.")
    options = options_of(arguments, "design")
    axes = options["axes"] = options["axes"] or ("x", "y", "z")
    setting = setting_of(arguments)

    def make(positions: int) -> designing.Design:
        return designing.design(**options | {"positions": positions})

    with progress_bar("searching positions"):
        found = make(arguments.positions)
    forms = {
        "table": lambda: designing.design_csv(found),
        "figure": lambda: _figure(designing.smaller_designs(make, found), sensed=axes, **setting),
    }
    return answer_of(found, designing.design_sentence, designing.design_text, forms=forms)


def _figure(designs: Sequence[designing.Design], **setting: Any) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.schemes import design_figure

    return design_figure(designs, **setting)

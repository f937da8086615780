"""``multipos verify-export``."""

import argparse

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import options_of
from multipos.exports.parts import load_parts
from multipos.exports.target import Verification
from multipos.exports.targets import verify_export

INPUTS = ("file", "calibration", "data")
OUTPUT = Output("OUT", "write the result to OUT as well", "text", ("json",))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    parts = load_parts(arguments.calibration)
    found = verify_export(arguments.file, parts, **options_of(arguments, "verify-export"))
    text, detail = str(found), ""
    if isinstance(found, Verification):
        text, detail = found.in_short, found.by_position
    return answer_of(found, lambda _: found.sentence, lambda _: text, detail=lambda: detail)

"""``multipos verify-export``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import options_of
from multipos.exports.parts import load_parts
from multipos.exports.target import Verification
from multipos.exports.targets import verify_export
from multipos.files.trees import to_json

INPUTS = ("file", "calibration", "data")
OUTPUT = Output("OUT", "write the result to OUT as well", "text", ("json",))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    parts = load_parts(arguments.calibration)
    found = verify_export(arguments.file, parts, **options_of(arguments, "verify-export"))
    return Answer(
        sentence=lambda: found.sentence,
        text=lambda: found.in_short if isinstance(found, Verification) else str(found),
        detail=lambda: found.by_position if isinstance(found, Verification) else "",
        json=lambda: to_json(found.to_dict()),
        findings=lambda: found.findings,
    )

"""``multipos export``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output, warn
from multipos.errors import UsageError
from multipos.exporters import TARGETS, export
from multipos.files import to_json


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration to export")
    add("--to", required=True, metavar="TARGET", help=f"one of {', '.join(TARGETS)}")
    add("--name", default="multipos", help="the C function is NAME_compensate (default multipos)")
    add("--float", action="store_true", help="single precision, in C")
    add(
        "--allow-lossy",
        action="store_true",
        help="let go of terms that the target cannot express, and say what that costs",
    )
    add_output(parser, "FILE", "file to write; C gets FILE_test.c, its self-test, as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    if not arguments.output:
        raise UsageError("export needs -o FILE.")
    exported = export(
        load(arguments.calibration),
        arguments.to,
        name=arguments.name,
        float=arguments.float,
        allow_lossy=arguments.allow_lossy,
    )
    written = exported.save(arguments.output)
    warn(exported.notes)
    if arguments.json:
        return to_json({"target": exported.target, "files": written, "notes": exported.notes})
    return f"Written to {', '.join(written)}\n"

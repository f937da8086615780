"""``multipos export``."""

import argparse
from pathlib import Path

from multipos.commands.answers import STDOUT, Answer, Output
from multipos.commands.options import add_export_options, export_options
from multipos.exports.parts import load_parts
from multipos.exports.target import self_test
from multipos.exports.targets import TARGETS, export, named_target
from multipos.files.trees import to_json


def _beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    target = named_target(arguments.to)
    if target is None or not target.is_code or Path(arguments.output).suffix.lower() == ".json":
        return ()
    return self_test(arguments.output)


def _is_json(name: str) -> bool:
    target = named_target(name)
    return target is not None and target.suffix == ".json"


INPUTS = ("calibration", "stability")
OUTPUT = Output(
    "FILE",
    "file to write; C gets FILE_test.c, its self-test, as well",
    "export",
    ("json",),
    required=True,
    beside=_beside,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add(
        "calibration",
        nargs="+",
        metavar="CAL.json|REG.json",
        help="calibration to export, or regressions, or both, the calibration first",
    )
    targets = ", ".join(target.name for target in TARGETS)
    add("--to", required=True, metavar="TARGET", help=f"one of {targets}")
    add(
        "--correct",
        metavar="COLUMN,…",
        help="what each regression corrects, in C; without, it gives the predicted responses",
    )
    add_export_options(parser)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    exported = export(
        load_parts(arguments.calibration),
        arguments.to,
        **export_options(arguments),
        correct=arguments.correct,
    )
    names = [arguments.output, *map(str, _beside(arguments))]
    listing = {"target": exported.target, "files": names, "notes": exported.notes}
    content = {
        "target": exported.target,
        "text": exported.text,
        "test": exported.test,
        "notes": exported.notes,
    }
    return Answer(
        text=lambda: f"Written to {', '.join(names)}\n",
        json=lambda: to_json(listing),
        forms={
            "export": lambda: (
                exported.text if arguments.output == STDOUT else exported.files(arguments.output)
            ),
            # a file of the target that is JSON itself stays as it is
            "json": lambda: exported.text if _is_json(arguments.to) else to_json(content),
        },
        warnings=lambda: exported.notes,
    )

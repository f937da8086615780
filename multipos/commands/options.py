"""What several commands share: lists on the command line, the model's options, warnings."""

import argparse
import sys
from collections.abc import Sequence

from multipos.model import NAMED


def names(text: str) -> tuple[str, ...]:
    """Return names separated by commas."""
    found = tuple(name.strip() for name in text.split(","))
    if not all(found):
        raise argparse.ArgumentTypeError(f"'{text}' names nothing beside a comma")
    return found


def numbers(text: str) -> tuple[float, ...]:
    """Return numbers separated by commas."""
    try:
        return tuple(float(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number or numbers") from None


def add_output(parser: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """Add ``-o``."""
    parser.add_argument("-o", dest="output", metavar=metavar, help=text)


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add ``--model``, ``--axes`` and ``--inputs``."""
    add = parser.add_argument
    add(
        "--model",
        default="linear",
        metavar="M",
        help=f"{', '.join(NAMED)}, or a formula (default linear)",
    )
    add("--axes", type=names, metavar="x,y,z", help="case axis that each output senses")
    add(
        "--inputs",
        type=names,
        default=("x", "y", "z"),
        metavar="x,y,z",
        help="reference components the model sees (default x,y,z)",
    )


def warn(warnings: Sequence[str]) -> None:
    """Print warnings to stderr, a line each."""
    for warning in warnings:
        print(f"multipos: warning: {warning}", file=sys.stderr)

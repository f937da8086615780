"""``multipos schemes``."""

import argparse
from typing import Any

from multipos.commands.answers import Answer, Output, answer_of
from multipos.commands.options import declare, setting_of
from multipos.designs.assessment import Schemes, schemes, schemes_sentence, schemes_text
from multipos.errors import UsageError
from multipos.files.tables import format_csv
from multipos.positions.scheme import SCHEMES, lay_scheme

INPUTS = ("schemes",)
OUTPUT = Output(
    "FILE",
    "write the result to FILE as well; one scheme as .csv",
    "text",
    ("json", "figure", "table"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "schemes")
    listing = "\n".join(f"  {name:<18}{scheme.description}" for name, scheme in SCHEMES.items())
    parser.epilog = f"names, which may be joined by +:\n{listing}"
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    axes = arguments.axes or ("x", "y", "z")
    setting = setting_of(arguments)
    found = schemes(*arguments.schemes, axes=axes, order=arguments.order, **setting)
    forms = {
        "figure": lambda: _figure(found, sensed=axes, **setting),
        "table": lambda: _scheme_file(arguments),
    }
    return answer_of(found, schemes_sentence, schemes_text, forms=forms)


def _scheme_file(arguments: argparse.Namespace) -> str:
    """Return the one scheme that was asked for as a scheme file, laid out in the order."""
    if len(arguments.schemes) != 1:
        named = len(arguments.schemes) or "none"
        raise UsageError(f"-o SCHEME.csv writes one scheme, and {named} are named; name one.")
    return format_csv(lay_scheme(arguments.schemes[0], arguments.order).columns())


def _figure(found: Schemes, **setting: Any) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.schemes import schemes_figure

    return schemes_figure(found, **setting)

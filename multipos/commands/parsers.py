"""All commands by name, and the parser of each.

`command` returns the module of a command, `command_parser` its parser, and `add_command_options`
adds what it takes.
"""

import argparse
import sys
from importlib import import_module
from types import ModuleType
from typing import Any, NoReturn

from multipos.commands.answers import print_out
from multipos.commands.options import accept_negative_lists, declare, listed
from multipos.errors import UsageError
from multipos.files.spelling import near

COMMANDS = listed("commands")


def command(name: str) -> ModuleType:
    """Return the module of a command."""
    return import_module(f"multipos.commands.{name.replace('-', '_')}")


def command_parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command, which the documentation prints as well."""
    parser = Parser(prog=f"multipos {name}", description=COMMANDS[name], allow_abbrev=False)
    add_command_options(parser, name)
    return parser


def add_command_options(parser: argparse.ArgumentParser, name: str) -> None:
    """Add what a command takes to its parser."""
    accept_negative_lists(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    add = parser.add_argument
    add("-v", "--verbose", action="store_true", help="print notes and all that explains")
    add("-q", "--quiet", action="store_true", help="print no findings")
    module = command(name)
    if hasattr(module, "add_options"):
        module.add_options(parser)
    else:
        declare(parser, name)
    module.OUTPUT.add_to(parser)


class Parser(argparse.ArgumentParser):
    """A parser that ends in our own words, and offers the option that was meant."""

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse's own says nothing where stdout cannot be written.
        if file is sys.stdout:
            print_out([message])
        else:
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        """Raise the message with what was meant, and a pointer to the help."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message and unknown.startswith("--"):
            given = unknown.split()[0].partition("=")[0]
            meant = "-o" if given in ("--out", "--output") else given
            message += near(meant, self._option_string_actions).rstrip(".?")
        raise UsageError(f"{message}; see '{self.prog} --help'.")

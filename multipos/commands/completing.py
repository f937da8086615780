"""Commands and options completed in a shell, by argcomplete.

`complete_line` answers what a shell asks with the variable ``_ARGCOMPLETE``: one parser of all
commands is made, with the options of the one that the line names; the others are not imported.
"""

import os

from multipos.commands.parsers import COMMANDS, Parser, add_command_options


def complete_line() -> None:
    """Write what completes the line of the shell, and end the process."""
    import argcomplete

    argcomplete.autocomplete(_parser_of_line(os.environ.get("COMP_LINE", "")))


def _parser_of_line(line: str) -> Parser:
    """Return the parser of all commands, with the options of those that the line names."""
    parser = Parser(prog="multipos", allow_abbrev=False)
    parser.add_argument("--version", action="store_true", help="print the version")
    commands = parser.add_subparsers(metavar="COMMAND")
    words = line.split()
    for name, text in COMMANDS.items():
        one = commands.add_parser(name, help=text, allow_abbrev=False)
        if name in words:
            add_command_options(one, name)
    return parser

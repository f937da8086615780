"""The command line: find the command, parse, call, print.

Every command lives in `multipos.commands` as a module with ``add_options(parser)`` and
``run(arguments) -> str``, a thin layer over the function of the same name; only the one that is
asked for is imported. Results go to stdout once everything has succeeded, messages to stderr;
exit status 1 means the data or the fit is at fault, 2 the command line, and then stderr ends in
one line that begins ``multipos: error:``.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

from multipos import __version__
from multipos.errors import MultiposError, UsageError

COMMANDS = {
    "demo": "calibrate the six-position paper's own readings, end to end",
    "fit": "calibrate from readings at static positions",
    "report": "write the report of a calibration",
    "apply": "compensate raw readings with a calibration",
    "compare": "compare repeated calibrations of one unit",
    "schemes": "list schemes and what they can tell about a model",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    try:
        text = _run(list(sys.argv[1:] if argv is None else argv))
    except UsageError as error:
        return _complain(error, 2)
    except MultiposError as error:
        return _complain(error, 1)
    except MemoryError:
        return _complain("the data do not fit into memory; give fewer rows.", 1)
    except KeyboardInterrupt:
        return _complain("interrupted.", 1)
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _run(argv: list[str]) -> str:
    if not argv or argv[0] not in COMMANDS:
        _top_parser().parse_args(argv)
    name, *rest = argv
    command = import_module(f"multipos.commands.{name.replace('-', '_')}")
    parser = _Parser(prog=f"multipos {name}", description=COMMANDS[name], allow_abbrev=False)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    command.add_options(parser)
    text: str = command.run(parser.parse_args(rest))
    return text


def _top_parser() -> argparse.ArgumentParser:
    listing = "\n".join(f"  {name:<15}{text}" for name, text in COMMANDS.items())
    parser = _Parser(
        prog="multipos",
        description="Calibrate accelerometers from static positions in gravity.",
        epilog=f"commands:\n{listing}\n\n'multipos COMMAND --help' lists a command's options.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"multipos {__version__}")
    parser.add_argument("command", metavar="COMMAND", choices=list(COMMANDS), help="see below")
    return parser


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        raise UsageError(f"{message}; see '{self.prog} --help'.")


def _complain(error: object, status: int) -> int:
    print(f"multipos: error: {' '.join(str(error).split())}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

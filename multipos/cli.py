"""The command line: find the command, parse, call, print.

Every command lives in `multipos.commands` as a module with ``add_options(parser)`` and
``run(arguments)``, which returns the text or its pieces, a thin layer over the function of the
same name; only the one that is asked for is imported. Results go to stdout once everything has
succeeded, messages to stderr; exit status 1 means the data or the fit is at fault, 2 the command
line, and then stderr ends in one line that begins ``multipos: error:``.
"""

import argparse
import io
import os
import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from types import ModuleType
from typing import NoReturn

from multipos import __version__
from multipos.errors import MultiposError, UsageError
from multipos.records import visible

COMMANDS = {
    "demo": "calibrate the six-position paper's own readings, end to end",
    "fit": "calibrate from readings at static positions",
    "report": "write the report of a calibration",
    "apply": "compensate raw readings with a calibration",
    "compare": "compare repeated calibrations of one unit",
    "regress": "describe a column by others, in segments, with terms the data support",
    "average": "average the rests of a raw log into readings",
    "export": "write a calibration as a C function or for another program",
    "verify-export": "show what the consumer of an exported file will see",
    "simulate": "make readings or a raw log of a calibrated sensor",
    "check": "errors of an independent run at known positions, before and after",
    "tumble": "single-axis tumble: K0 to Koq, misalignments, harmonics",
    "schemes": "list schemes and what they can tell about a model",
    "design": "find the best positions for a model, with proof",
    "worth": "tell what one more position would bring to a calibration",
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
        _print(text)
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        _close_stdout()
    except OSError as error:
        _close_stdout()
        return _complain(f"cannot write to stdout: {error.strerror}.", 1)
    return 0


def _print(text: str | Iterable[str]) -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):
        # What a terminal's encoding lacks is escaped, which in JSON is the same character.
        sys.stdout.reconfigure(errors="backslashreplace")
    sys.stdout.writelines([text] if isinstance(text, str) else text)
    sys.stdout.flush()


def _close_stdout() -> None:
    # What is still buffered goes nowhere, so that the interpreter does not try again at its end.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(argv: list[str]) -> str | Iterable[str]:
    if not argv or argv[0] not in COMMANDS:
        parser = _top_parser()
        parser.parse_args(argv)
        parser.error("the command must come first")
    name, *rest = argv
    arguments = command_parser(name).parse_args(rest)
    text: str = _command(name).run(arguments)
    return text


def command_parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command, which the documentation prints as well."""
    parser = _Parser(prog=f"multipos {name}", description=COMMANDS[name], allow_abbrev=False)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    _command(name).add_options(parser)
    return parser


def _command(name: str) -> ModuleType:
    return import_module(f"multipos.commands.{name.replace('-', '_')}")


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
    print(f"multipos: error: {visible(' '.join(str(error).split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

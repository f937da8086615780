# PYTHON_ARGCOMPLETE_OK
"""The command line: find the command, parse, settle its files, call, deliver.

Every command lives in `multipos.commands` as a module with ``INPUTS``, ``OUTPUT`` and
``run(arguments)``, which returns an answer, a thin layer over the function of the same name, and
has its options in ``options.csv``; only the one asked for is imported. Results go to stdout once
everything has succeeded, messages to stderr; exit status 1 means the data or the fit is at fault,
2 the command line, and then stderr ends in one line that begins ``multipos: error:``; 3 that all
is written and printed, and the verdict is negative.
"""

import argparse
import gc
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn, TextIO

from multipos import __version__

# Libraries of linear algebra read this once, when NumPy is imported. Our factors are small: between
# their steps threads wait for each other, and a second made commands up to eight times slower.
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
if "numpy" not in sys.modules and not any(name in os.environ for name in _THREADS):
    os.environ.update(dict.fromkeys(_THREADS, "1"))

from multipos.commands.answers import deliver, settle  # noqa: E402
from multipos.commands.options import say, take_full_scale  # noqa: E402
from multipos.commands.parsers import COMMANDS, Parser, command, command_parser  # noqa: E402
from multipos.commands.withdrawn import instead_of_command, refuse_options  # noqa: E402
from multipos.errors import CalibrationWarning, MultiposError, UsageError  # noqa: E402
from multipos.files.spelling import near, one_line  # noqa: E402

_INTERRUPTED = 130  # the status by which shells know Ctrl-C


class _Ended(BaseException):
    """The process was asked to end, and cleans up."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    Where the process is asked to end (SIGTERM, SIGHUP), it ends by that signal when its temporary
    files are gone.
    """
    _fill_closed_streams()
    with _signals_raise() as received, warnings.catch_warnings():
        warnings.showwarning = _show_warning
        warnings.simplefilter("ignore", CalibrationWarning)  # commands say them with the answer
        status = _guarded(list(sys.argv[1:] if argv is None else argv))
    if received:
        os.kill(os.getpid(), received[0])
    if argv is None:
        gc.freeze()  # the process ends, and need not look through all that it has imported
    return status


def _guarded(argv: list[str]) -> int:
    """Run one command; whatever goes wrong becomes one line and a status."""
    try:
        if sys.stdout is None:
            raise MultiposError("stdout is closed; send it to a file, or to /dev/null.")
        return _run(argv)
    except UsageError as error:
        return _complain(error, 2)
    except MultiposError as error:
        return _complain(error, 1)
    except ImportError as error:
        return _complain(_missing(error), 1)
    except MemoryError:
        return _complain("the data do not fit into memory; give fewer rows.", 1)
    except KeyboardInterrupt:
        return _complain("interrupted.", _INTERRUPTED)
    except _Ended:
        return 1
    except Exception as error:
        if os.environ.get("MULTIPOS_DEBUG") and sys.stderr is not None:
            traceback.print_exc()
        return _complain(_unforeseen(error), 1)


def _run(argv: list[str]) -> int:
    """Run one command and return its exit status."""
    if "_ARGCOMPLETE" in os.environ:  # a shell asks, and argcomplete ends the process
        from multipos.commands.completing import complete_line

        complete_line()
    if not argv or argv[0] not in COMMANDS:
        parser = _top_parser()
        if argv and not argv[0].startswith("-"):
            instead = instead_of_command(argv[0])
            if instead is not None:
                raise UsageError(instead)
            way = near(argv[0], COMMANDS).removesuffix(".")
            raise UsageError(f"there is no command '{argv[0]}'{way}; see 'multipos --help'.")
        if _parse(parser, argv or ["--help"]) is None:
            return 0
        parser.error("the command must come first")
    name, *rest = argv
    refuse_options(name, rest)
    arguments = _parse(command_parser(name), rest)
    if arguments is None:
        return 0
    take_full_scale(arguments)
    module = command(name)
    # no options of the function
    quiet, verbose = (arguments.__dict__.pop(name) for name in ("quiet", "verbose"))
    if quiet:
        warnings.simplefilter("ignore")
    order = settle(name, arguments, module.INPUTS, module.OUTPUT)
    with ExitStack() as stack:
        for pipe in order.pipes:
            stack.enter_context(closing(pipe))
        answer = module.run(arguments)
        return deliver(answer, arguments, order, quiet=quiet, verbose=verbose)


def _fill_closed_streams() -> None:
    """Open what the caller has closed: no file of ours shall get the number of stdout, say."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


@contextmanager
def _signals_raise() -> Iterator[list[int]]:
    """Let signals that end the process raise, so that what is open is cleaned up; yield which.

    Signals that somebody handles or ignores (`nohup`) are left alone.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    names = ("SIGTERM", "SIGHUP")
    known = [getattr(signal, name) for name in names if hasattr(signal, name)]
    ours = [number for number in known if signal.getsignal(number) is signal.SIG_DFL]

    def end(number: int, frame: FrameType | None) -> NoReturn:
        received.append(number)
        for each in ours:
            signal.signal(each, signal.SIG_IGN)  # once is enough, also while cleaning up
        raise _Ended

    for number in ours:
        signal.signal(number, end)
    try:
        yield received
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


# What the parts are for that a small installation leaves out.
_PARTS = {
    "argcomplete": "completion",
    "scipy": "this",
    "casadi": "a user-defined model",
    "jinja2": "an HTML report",
    "markupsafe": "an HTML report",
}


def _missing(error: ImportError) -> str:
    """Return one line on a library that is not installed, or cannot be loaded."""
    name = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) and name != "multipos":
        return f"a library cannot be loaded ({one_line(str(error))[:200]}); install it again."
    if name not in _PARTS:
        return _unforeseen(error)
    return f"{_PARTS[name]} needs {name}, which is not installed; pip install {name}."


def _unforeseen(error: Exception) -> str:
    """Return one line on an error that nobody thought of: what, where, and how to report it."""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; check the file, its folder and the disk."
    package = Path(__file__).parent
    frames = traceback.extract_tb(error.__traceback__)
    inside = [frame for frame in frames if package in Path(frame.filename).parents]
    place = inside[-1] if inside else frames[-1]
    return (
        f"{type(error).__name__} at {Path(place.filename).name} line {place.lineno} "
        f"({one_line(str(error))[:200] or 'no message'}): a fault of multipos {__version__}; "
        "report it with this line and the input, MULTIPOS_DEBUG=1 shows the rest."
    )


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show a library's warning, such as NumPy's of an overflow, to who looks for faults alone."""
    if os.environ.get("MULTIPOS_DEBUG"):
        say(f"warning: {message} ({category.__name__} at {Path(filename).name} line {lineno})")


def _parse(parser: argparse.ArgumentParser, argv: list[str]) -> argparse.Namespace | None:
    """Return the arguments; None where argparse has printed what was asked for, such as help."""
    try:
        return parser.parse_args(_signed(argv))
    except SystemExit:
        return None


def _signed(argv: list[str]) -> list[str]:
    """Return arguments in which ``--axes -x,y,z`` is one, for -x looks like an option."""
    joined: list[str] = []
    for word in argv:
        if joined and joined[-1] == "--axes" and re.fullmatch(r"-[xyz](,-?[xyz])*", word):
            joined[-1] = f"--axes={word}"
        else:
            joined.append(word)
    return joined


def _top_parser() -> argparse.ArgumentParser:
    listing = "\n".join(f"  {name:<15}{text}" for name, text in COMMANDS.items())
    parser = Parser(
        prog="multipos",
        description="Calibrate accelerometers from static positions in gravity.",
        epilog=f"commands:\n{listing}\n\n'multipos COMMAND --help' lists a command's options.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"multipos {__version__}")
    parser.add_argument("command", metavar="COMMAND", choices=list(COMMANDS), help="see below")
    return parser


def _complain(error: object, status: int) -> int:
    if sys.stderr is not None:
        print(f"multipos: error: {one_line(str(error))}", file=sys.stderr)
    return status

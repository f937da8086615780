"""What a command reads and writes, checked before it runs, and its answer, delivered after.

`settle` checks the files of a command line, `refuse_inputs` refuses outputs that are among the
inputs, which `same_file` compares; `answer_of` makes the `Answer` of a result and `written_to` that
of a file, `Exports` hold what stands beside a calibration; `deliver` puts an answer where it
belongs, and `print_out` prints it.

A command module says in ``INPUTS`` which of its arguments name files, and in ``OUTPUT`` what
``-o`` writes. `settle` holds them against each other before any work is done; ``run`` then
returns an `Answer`, whose forms are made when they are asked for, and `deliver` puts them where
they belong. stdout carries one thing: what is printed, or with ``-o -`` what ``-o`` asks for.
"""

import argparse
import codecs
import io
import os
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO, TypeVar

from multipos.commands.options import say, tell
from multipos.errors import MultiposError, UsageError
from multipos.files.pipes import STDIN, Pipe, is_pipe
from multipos.files.spelling import StrPath, escaped, visible_lines
from multipos.files.trees import to_json
from multipos.files.whole import Content, check_place, written
from multipos.finding import Finding, Findings, errors_of, in_order, serious
from multipos.results import frozen

if TYPE_CHECKING:
    from tempfile import SpooledTemporaryFile

T = TypeVar("T")
STDOUT = "-"
NEGATIVE = 3  # exit status: written and printed, but the verdict is negative
# Forms of an answer: the endings that ask for them, and what they are in words.
FORMS: dict[str, tuple[tuple[str, ...], str]] = {
    "json": ((".json",), "JSON"),
    "table": ((".csv",), "the table"),
    "parquet": ((".parquet",), "the table in Parquet"),
    "figure": ((".svg", ".png", ".pdf"), "the figure"),
    "html": ((".html",), "a page"),
    "paper": ((".pdf",), "the page on paper"),
    "markdown": ((".md",), "Markdown"),
    "text": ((".txt",), "plain text"),
    "certificate": ((".xml",), "a digital calibration certificate"),
    "export": ((), "what the target reads"),
    "folder": ((), "a folder"),
}
# Endings that say what a file is: a command writes it, or refuses; the last three none does.
KNOWN = frozenset(
    [".json", ".csv", ".svg", ".png", ".pdf", ".html", ".md", ".xml", ".xlsx", ".parquet"]
).union([".docx", ".doc", ".odt"])

_IN_MEMORY = 1 << 24  # bytes of what is printed in pieces; more go to a temporary file
_PIECE = 1 << 20
_LINES = 34  # of a table on the screen, which with the sentence and findings is at most 40
_ESCAPES = "multipos.escapes"  # what an encoding lacks is escaped as JSON does it


def written_to(*names: str) -> str:
    """Return the sentence of a command whose answer is a file."""
    return f"Written to {', '.join('stdout' if name == STDOUT else name for name in names)}."


@frozen(eq=True)
class Output:
    """What ``-o`` of a command writes.

    Attributes
    ----------
    metavar, help : str
    own : str
        The form under an ending that is not known, or none.
    others : tuple of str
        Forms that have endings of their own.
    required : bool
    beside : callable
        From the arguments, the files written beside the one that is named.
    """

    metavar: str
    help: str
    own: str
    others: tuple[str, ...] = ()
    required: bool = False
    beside: Callable[[argparse.Namespace], Sequence[Path]] = lambda _: ()

    @property
    def forms(self) -> tuple[str, ...]:
        """All forms that can be written."""
        return (self.own, *self.others)

    @property
    def endings(self) -> str:
        """The endings that are written, and as what, in words."""
        known = [FORMS[form] for form in self.forms if FORMS[form][0]]
        said = [f"{' '.join(endings)} ({meaning})" for endings, meaning in known]
        return f"{', '.join(said)}, under any other ending {FORMS[self.own][1]}"

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Add ``-o``."""
        endings = "" if self.own == "folder" else f"; it writes {self.endings}; - is stdout"
        text = f"{self.help}{endings}"
        parser.add_argument("-o", dest="output", metavar=self.metavar, help=text)

    def form(self, path: str, *, json: bool) -> str:
        """Return the form that a name asks for; what is printed is JSON under ``--json``.

        Raises
        ------
        UsageError
            The ending is known, but this command does not write it; or it cannot write to stdout.
        """
        ending = Path(path).suffix.lower()
        for form in self.forms:
            if ending in FORMS[form][0]:
                return form
        self._check(path, ending, json)
        return "json" if json and (path == STDOUT or self.own == "text") else self.own

    def _check(self, path: str, ending: str, json: bool) -> None:
        """Refuse a name whose ending says none of the forms, where the command's own is none."""
        if ending in KNOWN:
            way = "give another ending, or none"
            if self.others:
                way = f"it writes {self.endings}"
            raise UsageError(f"-o {path}: this command does not write {ending} files; {way}.")
        if path == STDOUT and self.own == "folder":
            raise UsageError("-o -: a folder cannot go to stdout; name one.")
        if path == STDOUT and json and "json" not in self.forms:
            raise UsageError("-o - and --json would both go to stdout; leave one out.")


@frozen(eq=True)
class Answer:
    """What a command found, in every form it can be asked for.

    Attributes
    ----------
    sentence : callable
        The answer in one sentence, which is printed first; on stderr where stdout is data.
    text, json : callable
        What is printed, without and with ``--json``, and the form of the latter's name.
    detail : callable
        What explains, printed where it is asked for; with all that stands before, the form text.
    forms : mapping of str to callable
        What ``-o`` writes beside these two or in their place: text, bytes, pieces of text, a
        figure, or several files by name.
    findings : callable
        Asked when all else has been made.
    negative : callable
        Whether the verdict is negative, of the findings: where one is an error, if not given.
    failure : str or exception
        What could not be done; the rest is written, nothing is printed, and it is an error.
    verbatim : bool
        What is printed is a table for other programs: only a terminal gets escapes.
    """

    text: Callable[[], Content]
    json: Callable[[], Content]
    sentence: Callable[[], str] = str
    detail: Callable[[], str] = str
    forms: Mapping[str, Callable[[], Any]] = field(default_factory=dict)
    findings: Callable[[], Iterable[Finding]] = tuple
    negative: Callable[[Findings], bool] = lambda found: bool(errors_of(found))
    failure: str | BaseException = ""
    verbatim: bool = False

    def make(self, form: str, ending: str) -> Any:
        """Return the answer in a form that ``-o`` asks for."""
        made: Any = {"text": self.complete, "json": self.json, **self.forms}[form]()
        if form == "figure":
            from multipos.plots.style import render

            made = render(made, ending)
        return made

    def complete(self) -> str:
        """Return the sentence, the table, the findings and what explains."""
        text = self.text()
        assert isinstance(text, str)
        found = "\n".join(map(str, in_order(self.findings())))
        parts = [self.sentence(), text, found, self.detail()]
        return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


class Exports(NamedTuple):
    """What stands beside a calibration.

    Attributes
    ----------
    files : dict of path to text
    listing : list of {target, files}
    findings : list of Finding
    refused : list of str
        Why others are not made.
    """

    files: dict[StrPath, str]
    listing: list[dict[str, Any]]
    findings: list[Finding]
    refused: list[str]


def answer_of(
    found: T, sentence: Callable[[T], str], text: Callable[[T], Content], **more: Any
) -> Answer:
    """Return the answer of a result by what writes it, its JSON and findings its own."""
    result: Any = found
    return Answer(
        sentence=lambda: sentence(found),
        text=lambda: text(found),
        json=lambda: to_json(result.to_dict()),
        findings=lambda: result.findings,
        **more,
    )


@frozen(eq=True)
class Order:
    """What was settled: the form and ending that ``-o`` asks for, and the pipes that are held."""

    form: str | None
    ending: str
    pipes: tuple[Pipe, ...]


def settle(
    command: str, arguments: argparse.Namespace, inputs: Sequence[str], output: Output
) -> Order:
    """Check the files of a command line; each input that is a pipe becomes a `Pipe`.

    Where ``-o`` names the very file or device that stdout goes to, it becomes ``-``.

    Raises
    ------
    UsageError
        ``-o`` is missing, names an input or has an ending that the command does not write; or
        two inputs are the same pipe.
    """
    path: str | None = arguments.output
    if path is None and output.required:
        raise UsageError(f"{command} needs -o {output.metavar}.")
    if path is None:
        return Order(None, "", _hold_pipes(arguments, inputs))
    if not path:
        raise UsageError("-o needs a name; - is stdout.")
    ending = Path(path).suffix.lower()
    if path != STDOUT and output.own != "folder":
        check_place(path)
    refuse_inputs([Path(path), *output.beside(arguments)], _named(arguments, inputs))
    form = output.form(path, json=arguments.json)
    if _same(_status(path, None), _status(STDOUT, sys.stdout)):
        arguments.output = STDOUT
        form = form if ending else output.form(STDOUT, json=arguments.json)
    return Order(form, ending, _hold_pipes(arguments, inputs))


def _named(arguments: argparse.Namespace, inputs: Sequence[str]) -> Iterator[str]:
    """Yield the names of all inputs; of schemes that are joined, each."""
    for name in inputs:
        value = getattr(arguments, name)
        for each in value if isinstance(value, list) else [value]:
            if each is not None:
                yield from dict.fromkeys([each, *map(str.strip, each.split("+"))])
    model = getattr(arguments, "model", None)
    if isinstance(model, str) and model.strip().lower().endswith(".toml"):
        yield model.strip()


def refuse_inputs(outputs: Sequence[Path], inputs: Iterable[str]) -> None:
    """Refuse outputs that are among the inputs.

    Raises
    ------
    UsageError
    """
    for name in inputs:
        source = _status(name, sys.stdin)
        if source is None or not stat.S_ISREG(source.st_mode):
            continue
        for path in outputs:
            if _same(source, _status(path, None)):
                also = "" if str(path) == name else f", the same file as {name}"
                raise UsageError(
                    f"-o would write over {path}{also}, which this command reads; give another "
                    "name."
                )


def _hold_pipes(arguments: argparse.Namespace, inputs: Sequence[str]) -> tuple[Pipe, ...]:
    pipes: dict[str, Pipe] = {}
    for name in inputs:
        value = getattr(arguments, name)
        if isinstance(value, list):
            setattr(arguments, name, [_held(each, pipes) for each in value])
        elif value is not None:
            setattr(arguments, name, _held(value, pipes))
    return tuple(pipes.values())


def _held(name: str, pipes: dict[str, Pipe]) -> str | Pipe:
    if name != STDIN and not is_pipe(name):
        return name
    status = _status(name, sys.stdin)
    for other in pipes:
        if _same(status, _status(other, sys.stdin)):
            raise UsageError(
                f"{name} is given for two inputs, but what comes through it can be read as one; "
                "put the other into a file."
            )
    return pipes.setdefault(name, Pipe(name))


def _status(path: StrPath, standard: TextIO | None) -> os.stat_result | None:
    """Return what is known of a file, ``-`` being a standard stream; None where there is none."""
    with suppress(OSError, ValueError):
        if path != STDIN:
            return Path(path).stat()
        if standard is not None:
            return os.fstat(standard.fileno())
    return None


def same_file(a: StrPath, b: StrPath) -> bool:
    """Tell whether two paths are one file or folder, which is there."""
    return _same(_status(a, None), _status(b, None))


def _same(a: os.stat_result | None, b: os.stat_result | None) -> bool:
    return a is not None and b is not None and os.path.samestat(a, b)


def deliver(
    answer: Answer,
    arguments: argparse.Namespace,
    order: Order,
    *,
    quiet: bool = False,
    verbose: bool = False,
) -> int:
    """Make what was asked for, print what goes to stdout, then put files in their places.

    Findings go to stderr, unless it is to be quiet or they are in the JSON that is printed; notes
    only where it is verbose.

    Returns
    -------
    int
        Exit status: 3 where the verdict is negative.

    Raises
    ------
    MultiposError
        A file or stdout cannot be written, and no file has been touched; or something could not
        be done, and the rest is written.
    """
    path: str | None = arguments.output
    with ExitStack() as stack:
        made: Any = None
        if path is not None and order.form not in (None, "folder"):
            made = answer.make(order.form, order.ending)
        if path != STDOUT:
            if path is not None and made is not None:
                stack.enter_context(written(made if isinstance(made, Mapping) else {path: made}))
            made = answer.json() if arguments.json else answer.text()
        data = path == STDOUT or answer.verbatim or arguments.json
        if not (data or answer.failure):
            made = _first(answer.sentence(), made, verbose)
        pieces = _complete("" if answer.failure and path != STDOUT else made, stack)
        if not data:
            print_out(pieces)
        found = in_order(answer.findings())
        if not arguments.json:
            if data and answer.sentence():
                say(answer.sentence())
            if not quiet:
                tell(found if verbose else serious(found))
        if data:
            print_out(pieces, data=True)
        elif verbose and not answer.failure:
            detail = answer.detail()
            print_out([f"\n{detail}" if detail else ""])
    if isinstance(answer.failure, BaseException):
        raise answer.failure
    if answer.failure:
        raise MultiposError(answer.failure)
    return NEGATIVE if answer.negative(found) else 0


def _first(sentence: str, made: Content, verbose: bool) -> Content:
    """Return what is printed first: the sentence and as many whole parts as a screen takes."""
    if not isinstance(made, str):
        return made
    lines = made.strip("\n").split("\n") if made.strip("\n") else []
    if not verbose and len(lines) > _LINES:
        ends = [i for i in range(1, _LINES) if not lines[i]]  # of a part, before the line that says
        end = ends[-1] if len(ends) > 1 else _LINES - 1  # a title alone is no answer
        lines[end:] = [f"… {len(lines) - end} more lines; -v prints all"]
    head = [sentence, ""] if sentence and lines else [sentence] if sentence else []
    return "".join(f"{line}\n" for line in [*head, *lines])


def _complete(made: Content, stack: ExitStack) -> Iterable[str | bytes]:
    """Return text, bytes, or pieces of text when the last of them is there."""
    if isinstance(made, str | bytes):
        return [made]
    kept = stack.enter_context(_spool())
    kept.writelines(made)
    kept.seek(0)
    return iter(lambda: kept.read(_PIECE), "")


def _spool() -> "SpooledTemporaryFile[str]":
    import tempfile  # slow to import, and of long tables only

    return tempfile.SpooledTemporaryFile(
        _IN_MEMORY, "w+", encoding="utf-8", errors="surrogatepass", newline=""
    )


def print_out(pieces: Iterable[str | bytes] = (), *, data: bool = False) -> None:
    """Print on stdout, whatever its encoding, and see that it arrives.

    A reader that has seen enough, as ``head`` has, is no error.

    Parameters
    ----------
    pieces : of text or bytes
    data : bool
        For other programs: UTF-8 whatever the locale, and control characters are escaped only
        where stdout is a terminal.

    Raises
    ------
    MultiposError
        stdout cannot be written.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=_ESCAPES)
    try:
        sys.stdout.flush()
        for piece in pieces:
            _write(piece, data=data)
        sys.stdout.flush()
    except BrokenPipeError:
        _close_stdout()
    except OSError as error:
        _close_stdout()
        raise MultiposError(f"cannot write to stdout: {error.strerror}.") from None


def _write(piece: str | bytes, *, data: bool) -> None:
    if isinstance(piece, str) and (not data or sys.stdout.isatty()):
        piece = visible_lines(piece)
    if isinstance(piece, str) and data and hasattr(sys.stdout, "buffer"):  # not of a notebook
        piece = piece.encode("utf-8", _ESCAPES)
    if isinstance(piece, str):
        sys.stdout.write(piece)
    else:
        sys.stdout.buffer.write(piece)


def _close_stdout() -> None:
    # What is still buffered goes nowhere, so that the interpreter does not try again at its end.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _escape(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    return escaped(error.object[error.start : error.end]), error.end


codecs.register_error(_ESCAPES, _escape)

"""What several commands share: lists on the command line, the model's options, findings.

`declare` adds the options of a group, `options_of` returns what they hold and `setting_of` those of
a setting, `listed` what is said of names. `accept_negative_lists` lets an option take ``-2,2``,
`take_full_scale` reads the nominal conversion, `asks_export` tells whether a target is asked for.
`tell` prints findings and `say` a line to stderr; `progress_bar` and `file_progress` show how much
is done.
"""

import argparse
import csv
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

from multipos.errors import UsageError
from multipos.files.spelling import StrPath, one_line, split_names, split_numbers
from multipos.finding import Finding
from multipos.numerics.terms import NAMED

T = TypeVar("T")

_PATIENCE = 2.0  # [s] before progress shows
_OFTEN = 0.2  # [s] from one line of it to the next
_BITS = 64  # of a reading, the most
_LARGE = 1 << 24  # bytes; a smaller file is read before a bar could be seen


def _read(split: Callable[[str], T], text: str) -> T:
    try:
        return split(text)
    except UsageError as error:  # of any other kind argparse would not pass on the words
        raise argparse.ArgumentTypeError(str(error).removesuffix(".")) from None


def _whole(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number") from None


def _degrees(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither degrees nor 'auto'") from None


_TYPES: dict[str, Callable[[str], Any]] = {
    "names": partial(_read, split_names),
    "numbers": partial(_read, split_numbers),
    "float": float,
    "int": int,
    "whole": _whole,
    "degrees": _degrees,
}


@cache
def _rows() -> dict[str, list[dict[str, str]]]:
    """Return the rows of `options.csv` by their group, which is a command or a part of several."""
    found: dict[str, list[dict[str, str]]] = {}
    with Path(__file__).with_name("options.csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            found.setdefault(row["group"], []).append(row)
    return found


def declare(parser: argparse.ArgumentParser, group: str, **words: str) -> None:
    """Add the options that `options.csv` has of a group.

    An option ``@other`` stands for all of another group, ``= title`` goes on with a part of the
    help under its own title, and braces hold one of the words. Under `more` stands ``exclusive``
    where neighbours are given one or the other, ``required``, or what argparse itself has.
    """
    _declare(parser, parser, group, {"models": ", ".join(NAMED), **words})


def _declare(parser: Any, part: Any, group: str, words: Mapping[str, str]) -> None:
    """Add the options of a group, to a part of the help where it has no title of its own."""
    either: Any = None
    for row in _rows()[group]:
        option = row["option"]
        if option.startswith("@"):
            _declare(parser, part, option[1:], words)
        elif option.startswith("="):
            titled = (each for each in parser._action_groups if each.title == option[2:])
            part = next(titled, None) or parser.add_argument_group(option[2:])
        elif row["more"] == "exclusive":
            either = either or parser.add_mutually_exclusive_group()
            either.add_argument(option, **_keywords(row, words))
        else:
            either = None
            part.add_argument(option, **_keywords(row, words))


def listed(group: str) -> dict[str, str]:
    """Return what `options.csv` says of each name of a group, which may be none."""
    return {row["option"]: row["help"] for row in _rows().get(group, [])}


def _keywords(row: Mapping[str, str], words: Mapping[str, str]) -> dict[str, Any]:
    """Return what argparse takes of an option."""
    found: dict[str, Any] = {"help": row["help"].format(**words)}
    found |= dict(each.split("=") for each in row["more"].split() if "=" in each)
    if row["more"] == "required":
        found["required"] = True
    if row["metavar"]:
        found["metavar"] = row["metavar"].format(**words)
    if row["type"] == "flag":
        found["action"] = "store_true"
    elif row["type"]:
        found["type"] = _TYPES[row["type"]]
    if row["default"]:
        found["default"] = row["default"]  # argparse reads it as what is typed
    elif found.get("action") == "extend":
        found["default"] = []
    return found


def options_of(
    arguments: argparse.Namespace, group: str, but: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what the options of a group hold, by name, but some."""
    given = vars(arguments)
    return {name: given[name] for name in _names_of(group) if name in given and name not in but}


def _names_of(group: str) -> Iterator[str]:
    for row in _rows()[group]:
        if row["option"].startswith("@"):
            yield from _names_of(row["option"][1:])
        elif row["option"].startswith("--"):
            yield row["option"][2:].replace("-", "_")


def accept_negative_lists(parser: argparse.ArgumentParser) -> None:
    """Let an option take ``-2,2`` as its value: argparse knows negative numbers, not lists."""
    parser._negative_number_matcher = re.compile(r"^-(\d|\.\d)[\d.,eE+-]*$")


def setting_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what the groups model and setting hold, as schemes and their figures take it."""
    return options_of(arguments, "model", ["axes"]) | options_of(arguments, "setting")


_HEADS = {"error": "not fit for use", "warning": "warning", "note": "note"}


def tell(findings: Iterable[Finding]) -> None:
    """Print findings to stderr, a line each."""
    for found in findings:
        say(f"{_HEADS[found.level]}: {found}")


def say(text: str) -> None:
    """Print a line to stderr, where it can be written: what is on stdout stands by then."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(f"multipos: {one_line(text)}", file=sys.stderr, flush=True)


def take_full_scale(arguments: argparse.Namespace) -> None:
    """Put the nominal conversion that --full-scale and --bits state in the place of --nominal."""
    given = vars(arguments)
    full, bits = given.pop("full_scale", None), given.pop("bits", None)
    if full is None and bits is None:
        return
    if full is None or bits is None or given["nominal"] is not None:
        raise UsageError("--full-scale G and --bits N go together, and stand for --nominal.")
    if not (full > 0.0 and 1 <= bits <= _BITS):
        raise UsageError(f"--full-scale takes g above 0, and --bits 1 to {_BITS}.")
    arguments.nominal = [0.0, 2.0 ** (bits - 1) / full]


def asks_export(arguments: argparse.Namespace) -> bool:
    """Tell whether a target is asked for, or an option that some of them have."""
    options = options_of(arguments, "export options", ["name"])  # which has a default
    return bool(arguments.to) or any(value not in (None, False) for value in options.values())


@contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[Callable[[int], object]]:
    """Show how much of a long task is done, on stderr, only on a terminal, and after two seconds.

    Yields the function that is called with how much is done; without a total the seconds are shown.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda done: None
        return
    begun = shown = time.monotonic()
    wide = 0

    def tell(done: int) -> None:
        nonlocal shown, wide
        now = time.monotonic()
        if now - begun < _PATIENCE or now - shown < _OFTEN or sys.stderr is None:
            return
        shown = now
        share = f"{now - begun:.0f} s" if total is None else f"{100.0 * done / max(total, 1):.0f} %"
        text = f"{what} … {share}"
        sys.stderr.write(f"\r{text:<{wide}}")
        sys.stderr.flush()
        wide = max(wide, len(text))

    try:
        yield tell
    finally:
        if wide:
            sys.stderr.write(f"\r{'':<{wide}}\r")
            sys.stderr.flush()


@contextmanager
def file_progress(
    paths: Sequence[StrPath], what: str
) -> Iterator[Callable[[float], object] | None]:
    """Show how much of large files is read, a share from 0 to 1; yield what to call, or None."""
    size = 0
    for path in paths:
        with suppress(OSError):  # what cannot be looked at is refused where it is read
            size += Path(path).stat().st_size
    if size <= _LARGE:
        yield None
        return
    with progress_bar(what, 1000) as advance:
        yield lambda done: advance(round(1000 * done))

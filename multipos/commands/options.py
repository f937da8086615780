"""What several commands share: lists on the command line, the model's options, findings."""

import argparse
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from multipos.errors import UsageError
from multipos.files.spelling import one_line, split_names, split_numbers
from multipos.finding import Finding
from multipos.numerics.terms import NAMED

T = TypeVar("T")

_PATIENCE = 2.0  # [s] before progress shows
_OFTEN = 0.2  # [s] from one line of it to the next
_BITS = 64  # of a reading, the most
_LARGE = 1 << 24  # bytes; a smaller file is read before a bar could be seen


def names(text: str) -> tuple[str, ...]:
    """Return names separated by commas."""
    return _read(split_names, text)


def numbers(text: str) -> tuple[float, ...]:
    """Return numbers separated by commas."""
    return _read(split_numbers, text)


def _read(split: Callable[[str], T], text: str) -> T:
    try:
        return split(text)
    except UsageError as error:  # of any other kind argparse would not pass on the words
        raise argparse.ArgumentTypeError(str(error).removesuffix(".")) from None


def accept_negative_lists(parser: argparse.ArgumentParser) -> None:
    """Let an option take ``-2,2`` as its value: argparse knows negative numbers, not lists."""
    parser._negative_number_matcher = re.compile(r"^-(\d|\.\d)[\d.,eE+-]*$")


def add_range(parser: argparse.ArgumentParser) -> None:
    """Add ``--range``."""
    accept_negative_lists(parser)
    parser.add_argument(
        "--range", type=numbers, metavar="LOW,HIGH", help="refuse readings outside these limits"
    )


def add_conditions(parser: argparse.ArgumentParser) -> None:
    """Add what a fit needs to know of its bench: convention, gravity, unit, range, confidence."""
    add = parser.add_argument
    add(
        "--convention",
        default="specific-force",
        metavar="C",
        help="specific-force (up reads +1, default) or gravity (down reads +1)",
    )
    add("--gravity", type=float, metavar="G", help="local gravity [m/s^2]")
    add("--gravity-u", type=float, metavar="U", help="its standard uncertainty [m/s^2]")
    add("--latitude", type=float, metavar="DEG", help="gravity by WGS 84 at this latitude")
    add("--height", type=float, metavar="M", help="and this height above the ellipsoid")
    add("--field", metavar="gravity|magnetic", help="what is sensed (default: by names and unit)")
    add("--field-size", metavar="B", help="size of the magnetic field, such as 48.6uT")
    add("--field-size-u", metavar="U", help="its standard uncertainty")
    add("--unit", metavar="UNIT", help="unit of the readings")
    add_range(parser)
    add(
        "--confidence",
        type=float,
        default=0.95,
        metavar="P",
        help="coverage probability of U (default 0.95)",
    )


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


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add how a raw log is read."""
    add = parser.add_argument
    add("--columns", type=names, metavar="a,b,c,…", help="names of all columns of the log")
    add("--time-column", metavar="T", help="column with the time (default: by its name)")
    add(
        "--time-unit",
        metavar="s|ms|us|ns",
        help="unit of the time (default: by the column's name or steps)",
    )
    add("--rate", type=float, metavar="HZ", help="sample rate, where no column is a time")
    add(
        "--drop-bad",
        action="store_true",
        help="leave out rows with a cell that is no number, or a million times the median",
    )


def add_setting(parser: argparse.ArgumentParser) -> None:
    """Add how well readings and orientations are known, of these one option or the other."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--unknown-orientation", action="store_true", help="orientations are unknown, |f| = g"
    )
    group.add_argument(
        "--orientation-sd",
        type=float,
        metavar="DEG",
        help="standard deviation of the orientation per axis [degrees]",
    )
    parser.add_argument(
        "--reading-sd",
        type=float,
        default=1.0,
        metavar="SD",
        help="standard uncertainty of a reading (default 1); in g with --orientation-sd",
    )


def setting_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what `add_model` and `add_setting` added, as schemes and their figures take it."""
    names = ("model", "inputs", "unknown_orientation", "orientation_sd", "reading_sd")
    return {name: getattr(arguments, name) for name in names}


def add_order(parser: argparse.ArgumentParser, default: str | None, what: str) -> None:
    """Add ``--order``."""
    said = "" if default is None else f" (default {default})"
    parser.add_argument(
        "--order",
        default=default,
        metavar="spread|travel|paper",
        help=f"{what}{said}: spread absorbs least of a drift, "
        "travel turns least, paper is as published",
    )


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


def add_targets(parser: argparse.ArgumentParser, beside: str) -> None:
    """Add ``--to`` and how exports are written; their targets are imported where one is asked."""
    parser.add_argument(
        "--to",
        nargs="+",
        action="extend",
        default=[],
        metavar="TARGET",
        help=f"export to the folder of {beside}, for the targets that multipos export --help lists",
    )
    add_export_options(parser)


def add_nominal(parser: argparse.ArgumentParser) -> None:
    """Add the conversion before calibration, in either of its forms."""
    add = parser.add_argument
    add("--nominal", type=numbers, metavar="BIAS,SCALE", help="conversion before calibration")
    add("--full-scale", type=float, metavar="G", help="the same: counts of N bits over -G to G g")
    add("--bits", type=int, metavar="N", help="of --full-scale")


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


def add_export_options(parser: argparse.ArgumentParser) -> None:
    """Add how an export is written."""
    add = parser.add_argument
    add("--name", default="multipos", help="the C function is NAME_compensate (default multipos)")
    add("--float", action="store_true", help="single precision, in C")
    add("--fixed", action="store_true", help="32-bit whole numbers, no floating point, in C")
    add(
        "--allow-lossy",
        action="store_true",
        help="drop terms that the target cannot express, and state what that costs",
    )
    add("--tilt", action="store_true", help="write NAME_tilt as well, angles in degrees, in C")
    add(
        "--force",
        action="store_true",
        help="export what is not fit for use all the same; the file states it",
    )
    add("--output-unit", metavar="g|m/s^2", help="unit of the force, in C (default g)")
    add("--instance", type=int, metavar="N", help="which accelerometer of the autopilot it is")
    add(
        "--device-id",
        type=_whole,
        metavar="ID",
        help="its device, without which the autopilot ignores the file",
    )
    add("--stability", metavar="FILE", help="stability.json, whose noise densities go to Kalibr")


def _whole(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number") from None


def export_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options that `add_export_options` added, as `export` takes them."""
    asked = ("name", "float", "fixed", "allow_lossy", "force")
    own = ("output_unit", "instance", "device_id", "stability", "tilt")
    return {name: getattr(arguments, name) for name in (*asked, *own)}


def asks_export(arguments: argparse.Namespace) -> bool:
    """Tell whether a target is asked for, or an option that some of them have."""
    options = export_options(arguments)
    del options["name"]  # has a default
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
    paths: Sequence[str | os.PathLike[str]], what: str
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

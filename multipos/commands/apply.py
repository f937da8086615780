"""``multipos apply``."""

import argparse
import tempfile
from collections.abc import Iterable, Iterator

from multipos.calibration import load
from multipos.commands.options import add_output, names, progress_bar, warn
from multipos.compensation import apply, apply_log
from multipos.files import to_json, write_text
from multipos.logs import open_log, read_log

_IN_MEMORY = 1 << 24  # bytes of the table; more go to a temporary file
_PIECE = 1 << 20


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration to apply")
    add("data", metavar="DATA.csv", help="raw readings; every column is kept")
    add("--columns", type=names, metavar="a,b,c,…", help="names of all columns, where it has none")
    add("--uncertainty", action="store_true", help="add the standard uncertainty u_f_x, …")
    add(
        "--outside",
        default="flag",
        metavar="flag|clamp|refuse",
        help="what to do with rows beyond what was calibrated (default flag)",
    )
    add_output(parser, "OUT.csv", "file to write (default: the table goes to stdout)")


def run(arguments: argparse.Namespace) -> str | Iterator[str]:
    """Return what the command prints: the table in pieces, once all of it is there."""
    calibration = load(arguments.calibration)
    options = {"uncertainty": arguments.uncertainty, "outside": arguments.outside}
    log = open_log(arguments.data, columns=arguments.columns)
    with progress_bar(arguments.data, "applying") as progress:
        applied = apply_log(calibration, log, progress=progress, **options)
        text: str | Iterator[str] = ""
        if arguments.output:
            write_text(arguments.output, applied)
        elif not arguments.json:
            text = _keep(applied)
        if arguments.json:
            columns = apply(calibration, read_log(log), **options)
            text = to_json({"rows": len(columns["outside"]), "columns": columns})
            applied.rows, applied.beyond = len(columns["outside"]), int(sum(columns["outside"]))
    if applied.beyond:
        warn([f"{applied.beyond} of {applied.rows} rows are outside what was calibrated"])
    return text


def _keep(pieces: Iterable[str]) -> Iterator[str]:
    """Keep pieces of text in a temporary file until the last is there, then return them."""
    kept = tempfile.SpooledTemporaryFile(_IN_MEMORY, "w+", encoding="utf-8", newline="")  # noqa: SIM115
    try:
        kept.writelines(pieces)
    except BaseException:
        kept.close()
        raise
    return _read_again(kept)


def _read_again(kept: "tempfile.SpooledTemporaryFile[str]") -> Iterator[str]:
    with kept:
        kept.seek(0)
        while piece := kept.read(_PIECE):
            yield piece

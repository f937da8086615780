"""``multipos apply``."""

import argparse
import tempfile
from collections.abc import Iterable, Iterator

import numpy as np

from multipos.calibration import load
from multipos.commands.options import add_output, file_progress, names, warn
from multipos.compensation import apply_log
from multipos.correction import correct
from multipos.errors import UsageError
from multipos.files import format_csv, json_table, read_schema, read_table, write_text
from multipos.logs import open_log
from multipos.regression import SCHEMA, load_regression

_IN_MEMORY = 1 << 24  # bytes of the table; more go to a temporary file
_PIECE = 1 << 20


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration or regression to apply")
    add("data", metavar="DATA.csv", help="raw readings; every column is kept")
    add("--columns", type=names, metavar="a,b,c,…", help="names of all columns, where it has none")
    add("--tilt", action="store_true", help="add tilt_x_deg, …, the angle above the horizon")
    add("--uncertainty", action="store_true", help="add the standard uncertainty u_f_x, …")
    add("--correct", metavar="COLUMN", help="what a regression corrects (default its response)")
    add(
        "--outside",
        default="flag",
        metavar="flag|clamp|refuse",
        help="what to do with rows beyond what was calibrated (default flag)",
    )
    add_output(parser, "OUT.csv", "file to write (default: the table goes to stdout)")


def run(arguments: argparse.Namespace) -> str | Iterator[str]:
    """Return what the command prints: the table in pieces, once all of it is there."""
    if read_schema(arguments.calibration) == SCHEMA:
        return _correct(arguments)
    if arguments.correct is not None:
        raise UsageError("--correct goes with a regression; a calibration gives forces.")
    calibration = load(arguments.calibration)
    options = {
        "tilt": arguments.tilt,
        "uncertainty": arguments.uncertainty,
        "outside": arguments.outside,
    }
    log = open_log(arguments.data, columns=arguments.columns)
    with file_progress(arguments.data, "applying") as progress:
        applied = apply_log(calibration, log, progress=progress, **options)
        columns = applied.columns() if arguments.json else {}
        if arguments.output:
            write_text(arguments.output, applied)
        text = "" if arguments.output or arguments.json else _keep(applied)
    _warn_outside(applied.beyond, applied.rows)
    return json_table(columns, applied.rows) if arguments.json else text


def _correct(arguments: argparse.Namespace) -> str | Iterator[str]:
    """Apply a regression: whole, because a rate needs the rows before and after."""
    if arguments.tilt:
        raise UsageError("--tilt goes with a calibration; a regression corrects a column.")
    table = read_table(arguments.data, what="data")
    columns = correct(
        load_regression(arguments.calibration),
        table,
        column=arguments.correct,
        uncertainty=arguments.uncertainty,
        outside=arguments.outside,
    )
    text = format_csv(columns, table.delimiter)
    if arguments.output:
        write_text(arguments.output, text)
    _warn_outside(int(np.sum(columns["outside"])), table.rows)
    if arguments.json:
        return json_table(columns, table.rows)
    return "" if arguments.output else text


def _warn_outside(beyond: int, rows: int) -> None:
    if beyond:
        warn([f"{beyond} of {rows} rows are outside what was calibrated"])


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

"""``multipos apply``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output, warn
from multipos.compensation import apply
from multipos.correction import correct
from multipos.errors import UsageError
from multipos.files import format_csv, read_schema, read_table, to_json, write_text
from multipos.regression import SCHEMA, load_regression


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration or regression to apply")
    add("data", metavar="DATA.csv", help="raw readings; every column is kept")
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


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    table = read_table(arguments.data, what="data")
    options = {"uncertainty": arguments.uncertainty, "outside": arguments.outside}
    if read_schema(arguments.calibration) == SCHEMA:
        if arguments.tilt:
            raise UsageError("--tilt goes with a calibration; a regression corrects a column.")
        regression = load_regression(arguments.calibration)
        columns = correct(regression, table, column=arguments.correct, **options)
    elif arguments.correct is not None:
        raise UsageError("--correct goes with a regression; a calibration gives forces.")
    else:
        columns = apply(load(arguments.calibration), table, tilt=arguments.tilt, **options)
    text = format_csv(columns, table.delimiter)
    if arguments.output:
        write_text(arguments.output, text)
    outside = sum(columns["outside"])
    if outside:
        warn([f"{outside} of {table.rows} rows are outside what was calibrated"])
    if arguments.json:
        return to_json({"rows": table.rows, "columns": columns})
    return "" if arguments.output else text

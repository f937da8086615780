"""``multipos apply``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output, warn
from multipos.compensation import apply
from multipos.files import format_csv, read_table, to_json, write_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration to apply")
    add("data", metavar="DATA.csv", help="raw readings; every column is kept")
    add("--tilt", action="store_true", help="add tilt_x_deg, …, the angle above the horizon")
    add("--uncertainty", action="store_true", help="add the standard uncertainty u_f_x, …")
    add(
        "--outside",
        default="flag",
        metavar="flag|clamp|refuse",
        help="what to do with rows beyond what was calibrated (default flag)",
    )
    add_output(parser, "OUT.csv", "file to write (default: the table goes to stdout)")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    calibration = load(arguments.calibration)
    table = read_table(arguments.data, what="data")
    columns = apply(
        calibration,
        table,
        tilt=arguments.tilt,
        uncertainty=arguments.uncertainty,
        outside=arguments.outside,
    )
    text = format_csv(columns, table.delimiter)
    if arguments.output:
        write_text(arguments.output, text)
    outside = sum(columns["outside"])
    if outside:
        warn([f"{outside} of {table.rows} rows are outside what was calibrated"])
    if arguments.json:
        return to_json({"rows": table.rows, "columns": columns})
    return "" if arguments.output else text

"""``multipos average``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import add_order, add_reading, file_progress, names
from multipos.files.tables import format_csv
from multipos.files.trees import to_json
from multipos.logs.averages import averages_sentence, averages_text
from multipos.logs.readers import formats_read

INPUTS = ("logs", "sections", "scheme")
OUTPUT = Output("READINGS.csv", "write the readings to READINGS.csv", "table", ("json", "text"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_logs(parser)
    add_log_options(parser)
    add = parser.add_argument
    add("--outputs", type=names, metavar="a,b,c", help="columns that are outputs")
    add("--scheme", metavar="S", help="match the rests to a scheme, by direction")
    add_order(parser, "paper", "order of rests that have no direction along the scheme")
    add(
        "--convention",
        default="specific-force",
        metavar="C",
        help="for matching: specific-force (up reads +1, default) or gravity (down reads +1)",
    )


def add_logs(parser: argparse.ArgumentParser) -> None:
    """Add the logs, one or more."""
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        help=f"raw log: text, {formats_read()}; of several, each with one rest is a position",
    )


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add how a log is read, and which of its rests are averaged."""
    add = parser.add_argument
    add_reading(parser)
    add("--min-duration", type=float, metavar="S", help="shortest rest [s] (default 2)")
    add(
        "--threshold",
        type=float,
        metavar="V",
        help="standard deviation above which it moves (default: learnt from the log)",
    )
    add("--sections", metavar="FILE", help="JSON or CSV of the rows where rests begin and end")
    add("--label-column", metavar="L", help="column that names the position of each row")
    add(
        "--only",
        type=names,
        metavar="LABEL,…",
        help="rests to average; or COLUMN=VALUE, the rows of a sensor",
    )
    add("--signed", type=int, metavar="BITS", help="read registers without a sign as signed, as 16")
    add(
        "--accept-faults",
        action="store_true",
        help="go on where outputs look saturated, stuck, wrapped around or of two units",
    )


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    options = {k: v for k, v in vars(arguments).items() if k not in ("logs", "json", "output")}
    with file_progress(arguments.logs, "reading") as progress:
        from multipos.logs.averaging import average  # with the search for rests

        found = average(*arguments.logs, progress=progress, **options)
    return Answer(
        sentence=lambda: averages_sentence(found),
        text=lambda: averages_text(found),
        json=lambda: to_json(found.to_dict()),
        forms={"table": lambda: format_csv(found.columns())},
        findings=lambda: found.findings,
    )

"""``multipos check``."""

import argparse

from multipos.calibration import load
from multipos.checks import check
from multipos.commands.options import add_output, add_range, numbers, warn
from multipos.files import to_json, write_text
from multipos.sections import check_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration to check")
    add("readings", metavar="READINGS", help="CSV file of an independent run at known positions")
    add("--scheme", metavar="S", help="scheme name, names joined by +, or CSV file")
    add("--tilt", action="store_true", help="compare tilt in degrees and not force in g")
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--limit-deg", type=float, metavar="D", help="largest error of tilt allowed")
    limit.add_argument("--limit-g", type=float, metavar="G", help="largest error of force allowed")
    add(
        "--within-deg",
        type=float,
        metavar="D",
        help="count only axes within D degrees of the horizon",
    )
    add(
        "--nominal",
        type=numbers,
        default=(0.0, 1.0),
        metavar="BIAS,SCALE",
        help="conversion (raw − BIAS)/SCALE before calibration (default 0,1)",
    )
    add(
        "--reading-sd",
        type=numbers,
        metavar="SD[,SD,SD]",
        help="standard uncertainty of a reading of the run (default: as in the calibration)",
    )
    add_range(parser)
    add_output(parser, "FILE", "write the result to FILE as well")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    calibration = load(arguments.calibration)
    options = {
        name: value
        for name, value in vars(arguments).items()
        if name not in ("calibration", "readings", "json", "output")
    }
    found = check(calibration, arguments.readings, **options)
    text = to_json(found.to_dict()) if arguments.json else check_text(found)
    if arguments.output:
        write_text(arguments.output, text)
    warn(found.warnings)
    return text

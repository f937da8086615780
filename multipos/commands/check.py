"""``multipos check``."""

import argparse

from multipos.calibration import load
from multipos.checks import check
from multipos.commands.options import add_output, add_range, numbers, warn, write_form
from multipos.files import read_schema, to_json
from multipos.plots import check_svg
from multipos.regression import SCHEMA, load_regression
from multipos.sections import check_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration or regression to check")
    add("readings", metavar="READINGS", help="CSV file of an independent run: at known positions, "
        "or with the response of the regression")  # fmt: skip
    add("--scheme", metavar="S", help="scheme name, names joined by +, or CSV file")
    add("--tilt", action="store_true", help="compare tilt in degrees and not force in g")
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--limit-deg", type=float, metavar="D", help="largest error of tilt allowed")
    limit.add_argument("--limit-g", type=float, metavar="G", help="largest error of force or of "
        "a regression's response allowed")  # fmt: skip
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
    add_output(parser, "FILE", "write the result to FILE as well; .svg draws the errors, "
               ".json is for report --check")  # fmt: skip


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    fitted = read_schema(arguments.calibration) == SCHEMA
    calibration = (load_regression if fitted else load)(arguments.calibration)
    options = {
        name: value
        for name, value in vars(arguments).items()
        if name not in ("calibration", "readings", "json", "output")
    }
    found = check(calibration, arguments.readings, **options)
    text = to_json(found.to_dict()) if arguments.json else check_text(found)
    write_form(
        arguments.output, text, json=lambda: to_json(found.to_dict()), svg=lambda: check_svg(found)
    )
    warn(found.warnings)
    return text

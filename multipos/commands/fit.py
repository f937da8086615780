"""``multipos fit``."""

import argparse
from typing import Any

from multipos.commands.answers import Answer, Output
from multipos.commands.options import (
    add_conditions,
    add_model,
    add_nominal,
    add_order,
    names,
    numbers,
)
from multipos.files.trees import to_json
from multipos.fitting.fit_readings import fit
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text
from multipos.sensor.calibration import Calibration

INPUTS = ("readings", "scheme", "budget")
OUTPUT = Output("CAL.json", "write the calibration to CAL.json", "json", ("text", "figure"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("readings", metavar="READINGS", help="CSV file of averaged readings")
    add_fit_options(parser)
    add_order(parser, "paper", "order of rows without labels along the scheme")


def add_fit_options(parser: argparse.ArgumentParser, exclude: str | None = "none") -> None:
    """Add what is fitted, and how; `exclude` is set aside unless something is said, None never."""
    add = parser.add_argument
    add(
        "--scheme",
        metavar="S",
        help="scheme name (see multipos schemes), names joined by +, or CSV file",
    )
    add_model(parser)
    add_conditions(parser)
    add("--outputs", type=names, metavar="a,b,c", help="columns that are outputs")
    add("--closed-form", action="store_true", help="the six-position inversion")
    add(
        "--unknown-orientation",
        action="store_true",
        help="nothing is known of the orientations but |f| = 1 g",
    )
    add(
        "--orientation-sd",
        type=degrees_or_auto,
        metavar="DEG",
        help="standard deviation of every position, per axis; 'auto' estimates it",
    )
    add("--gauge", default="lower", metavar="lower|symmetric", help="where orientation is free")
    add("--robust", metavar="LOSS", help="huber, soft-l1 or cauchy")
    add("--level-sd", type=float, default=0.0, metavar="DEG", help="tilt that positions share")
    add("--pool", action="store_true", help="one residual variance for all outputs")
    add("--stepwise", action="store_true", help="keep the terms that the readings support")
    if exclude is not None:
        add(
            "--exclude",
            default=exclude,
            metavar="LABELS|auto|none",
            help="set positions aside, by label, or outliers (auto), or none; default %(default)s",
        )
    add("--drift", action="store_true", help="fit a drift of the session, left out by apply")
    add(
        "--reading-sd",
        type=numbers,
        metavar="SD[,SD,SD]",
        help="standard uncertainty of an averaged reading",
    )
    add_nominal(parser)
    add("--budget", metavar="FILE", help="TOML file of what else is uncertain: level, voltmeter, …")


def degrees_or_auto(text: str) -> float | str:
    """Return degrees, or 'auto'."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither degrees nor 'auto'") from None


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    options = {k: v for k, v in vars(arguments).items() if k not in ("readings", "json", "output")}
    calibration = fit(arguments.readings, **options)
    return Answer(
        sentence=lambda: calibration_sentence(calibration),
        text=lambda: parameter_text(calibration),
        detail=lambda: detail_text(calibration),
        json=lambda: to_json(calibration.to_dict()),
        forms={"figure": lambda: _figure(calibration)},
        findings=lambda: calibration.findings,
    )


def _figure(calibration: Calibration) -> Any:
    # Imported here, for who asks for no figure shall not wait for all of them to be imported.
    from multipos.plots.fits import calibration_figure

    return calibration_figure(calibration)

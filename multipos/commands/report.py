"""``multipos report``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import progress_bar
from multipos.files.trees import to_json
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report, markdown_report, plain_report
from multipos.sensor.calibration_file import load
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.verification.check_file import load_check

INPUTS = ("calibration", "lab", "check")
OUTPUT = Output("REPORT.html", "file to write", "html", ("markdown", "text"), required=True)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("calibration", metavar="CAL.json", help="calibration to report")
    add("--lab", metavar="FILE", help="TOML file of what only the laboratory knows")
    add(
        "--check", metavar="CHECK.json", help="what check -o CHECK.json wrote of an independent run"
    )
    add("--language", default="en", metavar="en|zh", help="language of the report (default en)")
    add(
        "--monte-carlo",
        type=int,
        metavar="TRIALS",
        help="check the uncertainties by so many trials, 100 to 1000000",
    )


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    calibration = load(arguments.calibration)
    simulated = None
    if arguments.monte_carlo is not None:
        with progress_bar("Monte Carlo", arguments.monte_carlo) as progress:
            simulated = simulate_budget(
                calibration, trials=arguments.monte_carlo, progress=progress
            )
    content = build_content(
        calibration,
        lab=arguments.lab,
        language=arguments.language,
        simulated=simulated,
        check=None if arguments.check is None else load_check(arguments.check),
    )
    listing = {"report": arguments.output, "created": calibration.created}
    return Answer(
        text=lambda: f"Written to {arguments.output}\n",
        json=lambda: to_json(listing),
        forms={
            "html": lambda: html_report(content),
            "markdown": lambda: markdown_report(content),
            "text": lambda: plain_report(content),
        },
    )

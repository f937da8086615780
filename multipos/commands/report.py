"""``multipos report``."""

import argparse

from multipos.calibration import load
from multipos.commands.options import add_output, progress_bar
from multipos.documents import write_report
from multipos.errors import UsageError
from multipos.files import to_json
from multipos.monte_carlo import simulate_budget
from multipos.verdicts import load_check


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
        help="check the uncertainties by so many trials",
    )
    add_output(parser, "REPORT", "file to write, .html, .md or .txt")


def run(arguments: argparse.Namespace) -> str:
    """Return what the command prints."""
    if not arguments.output:
        raise UsageError("report needs -o REPORT.html, REPORT.md or REPORT.txt.")
    calibration = load(arguments.calibration)
    simulated = None
    if arguments.monte_carlo is not None:
        with progress_bar("Monte Carlo", arguments.monte_carlo) as progress:
            simulated = simulate_budget(
                calibration, trials=arguments.monte_carlo, progress=progress
            )
    write_report(
        calibration,
        arguments.output,
        lab=arguments.lab,
        language=arguments.language,
        simulated=simulated,
        check=None if arguments.check is None else load_check(arguments.check),
    )
    if arguments.json:
        return to_json({"report": arguments.output, "created": calibration.created})
    return f"Written to {arguments.output}\n"

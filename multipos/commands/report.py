"""``multipos report``."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from multipos.commands.answers import Answer, Output, written_to
from multipos.commands.options import progress_bar
from multipos.errors import MultiposError, UsageError
from multipos.files.pipes import is_folder
from multipos.files.trees import read_json_value, read_schema, to_json
from multipos.fleets.fleet import SCHEMA as FLEET
from multipos.fleets.folder import read_summary
from multipos.fleets.one_unit import fit_unit
from multipos.regression.regression import Regression, all_of, load_regression
from multipos.reports import documents, regressions
from multipos.reports.certificate import Content, build_content
from multipos.reports.fleet_report import fleet_content
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.sensor.nominal import read_nominal
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.verification.verdicts import load_check

INPUTS = ("calibration", "lab", "check", "data")
OUTPUT = Output(
    "REPORT.html",
    "file to write",
    "html",
    ("paper", "markdown", "text", "certificate"),
    required=True,
)


def _of_fleet(arguments: argparse.Namespace) -> Answer:
    """Return the report of a fleet, from its folder or its fleet.json."""
    if arguments.station is not None:
        raise UsageError("--station needs --unit.")
    if arguments.lab or arguments.nominal or arguments.check or arguments.monte_carlo:
        raise UsageError("--lab, --nominal, --check and --monte-carlo are of one calibration.")
    found = read_summary(arguments.calibration)
    content = fleet_content(found)
    return _answer(arguments, content, found["created"])


def _no_certificate() -> str:
    """Refuse what only a calibration has."""
    raise UsageError(
        "a digital calibration certificate (.xml) is of one calibration; write this report to a "
        ".html, .md or .txt file."
    )


def _of_regression(arguments: argparse.Namespace) -> Answer:
    """Return the report of a regression."""
    if arguments.check or arguments.monte_carlo:
        raise UsageError("--check and --monte-carlo are of one calibration.")
    regression = load_regression(arguments.calibration)
    content = regressions.regression_content(
        regression, lab=arguments.lab, data=arguments.data, beside=arguments.calibration
    )
    return _answer(arguments, content, all_of(regression)[0].created)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    schema = FLEET if is_folder(arguments.calibration) else read_schema(arguments.calibration)
    if schema == FLEET:
        return _of_fleet(arguments) if arguments.unit is None else _of_unit(arguments)
    if arguments.unit is not None or arguments.station is not None:
        raise UsageError("--unit and --station are of a fleet.")
    if schema == Regression.schema:
        return _of_regression(arguments)
    if schema is None and _is_comparison(arguments.calibration):
        raise UsageError(
            f"{arguments.calibration}: a comparison has no report; give the calibrations to "
            "`multipos compare`, with -v for every run or with -o CHART.svg."
        )
    if arguments.data is not None:
        raise UsageError("--data are the rows of a regression; a calibration holds its readings.")
    return _of_calibration(load(arguments.calibration), arguments)


def _is_comparison(path: str) -> bool:
    """Tell whether `compare` wrote a file, which names no schema."""
    try:
        found = read_json_value(path, "file")
    except MultiposError:  # said where it is read
        return False
    return isinstance(found, dict) and "consistent" in found


def _of_unit(arguments: argparse.Namespace) -> Answer:
    """Return the report of one unit of a fleet."""
    place = Path(arguments.calibration)
    calibration = fit_unit(
        read_summary(place),
        arguments.unit,
        station=arguments.station,
        data=() if arguments.data is None else (arguments.data,),
        beside=(place if is_folder(place) else place.parent).resolve().parent,
    )
    return _of_calibration(calibration, arguments)


def _of_calibration(calibration: Calibration, arguments: argparse.Namespace) -> Answer:
    """Return the report of a calibration."""
    if arguments.nominal is not None:
        calibration = replace(calibration, nominal=read_nominal(arguments.nominal))
    simulated = None
    if arguments.monte_carlo is not None:
        with progress_bar("Monte Carlo", arguments.monte_carlo) as progress:
            simulated = simulate_budget(
                calibration, trials=arguments.monte_carlo, progress=progress
            )
    content = build_content(
        calibration,
        lab=arguments.lab,
        simulated=simulated,
        check=None if arguments.check is None else load_check(arguments.check),
    )
    certificate = partial(documents.xml_report, calibration, content)
    return _answer(arguments, content, calibration.created, certificate)


def _answer(
    arguments: argparse.Namespace,
    content: Content,
    created: str | None,
    certificate: Callable[[], str] = _no_certificate,
) -> Answer:
    listing = {"report": arguments.output, "created": created, "findings": ()}
    return Answer(
        sentence=lambda: written_to(arguments.output),
        text=str,
        json=lambda: to_json(listing),
        forms={
            "html": lambda: documents.html_report(content),
            "paper": lambda: _on_paper(content),
            "markdown": lambda: documents.markdown_report(content),
            "text": lambda: documents.plain_report(content),
            "certificate": certificate,
        },
    )


def _on_paper(content: Content) -> bytes:
    with progress_bar("laying out the pages") as progress:
        return documents.pdf_report(content, progress)

"""``multipos calibrate``."""

import argparse
from pathlib import Path
from typing import Any

from multipos.commands.answers import STDOUT, Answer, Exports, Output
from multipos.commands.options import asks_export, declare, file_progress, options_of
from multipos.files.trees import to_json
from multipos.finding import in_order
from multipos.fitting.calibrate_logs import fit_rests, rests_or_rows
from multipos.logs.averages import Averages, averages_text
from multipos.logs.readers import formats_read
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text
from multipos.sensor.calibration import Calibration


def _beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    if not arguments.to:
        return ()
    from multipos.commands.export import files_beside  # with all targets, and what they need

    return files_beside(arguments.to, arguments.output)


INPUTS = ("logs", "sections", "scheme", "budget", "stability")
OUTPUT = Output(
    "CAL.json",
    "write the calibration to CAL.json, and exports to the same folder",
    "json",
    ("text",),
    beside=_beside,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "calibrate", beside="CAL.json", formats=formats_read())
    parser.set_defaults(model=None)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    if asks_export(arguments):
        from multipos.commands.export import check_targets

        check_targets(arguments)
    with file_progress(arguments.logs, "reading") as progress:
        found = rests_or_rows(
            *arguments.logs,
            exclude=arguments.exclude,
            field=arguments.field,
            unit=arguments.unit,
            progress=progress,
            **options_of(arguments, "average"),
        )
    fitting = options_of(arguments, "fit", ["outputs", "scheme", "order", "model"])
    calibration = fit_rests(found, arguments.model, **fitting)
    exports = _exports(calibration, arguments)
    made = exports.files

    def text() -> str:
        last = f"\nWritten to {', '.join(map(str, made))}\n" if made else ""
        return f"{parameter_text(calibration)}{last}"

    def detail() -> str:
        rows = averages_text(found) if isinstance(found, Averages) else str(found)
        return f"{rows}\n{detail_text(calibration)}"

    def with_exports(first: str) -> Any:
        return first if arguments.output == STDOUT else {arguments.output: first, **made}

    findings = in_order((*calibration.findings, *exports.findings))
    listed = [each.to_dict() for each in findings]
    summary = {"average": found.to_dict(), "exports": exports.listing, "findings": listed}
    answer = Answer(
        sentence=lambda: calibration_sentence(calibration),
        text=text,
        detail=detail,
        json=lambda: to_json(calibration.to_dict() | summary),
        forms={
            "json": lambda: with_exports(to_json(calibration.to_dict())),
            "text": lambda: with_exports(answer.complete()),
        },
        findings=lambda: findings,
        failure=" ".join(exports.refused),
    )
    return answer


def _exports(calibration: Calibration, arguments: argparse.Namespace) -> Exports:
    if not arguments.to:
        return Exports({}, [], [], [])
    from multipos.commands.export import make_exports

    made = make_exports(calibration, arguments, arguments.output)
    dropped = made.refused and not arguments.keep_going
    return Exports({}, [], [], made.refused) if dropped else made

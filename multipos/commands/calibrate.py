"""``multipos calibrate``."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multipos.commands.answers import STDOUT, Answer, Output
from multipos.commands.average import add_log_options, add_logs
from multipos.commands.export import add_export_options, export_options
from multipos.commands.fit import add_fit_options
from multipos.commands.options import file_progress
from multipos.errors import MultiposError, UsageError
from multipos.exports.target import Exported, Target, self_test
from multipos.exports.targets import TARGETS, beside, export, named_target
from multipos.files.trees import to_json
from multipos.fitting.logs import fit_rests
from multipos.logs.averages import averages_text
from multipos.logs.averaging import average
from multipos.reports.summary import text_report
from multipos.sensor.calibration import Calibration


def _beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """Return the exports, and the self-tests beside them."""
    paths: list[Path] = []
    for name in arguments.to:
        target = named_target(name)
        if target is not None:
            path = beside(arguments.output, target)
            paths += [path, *(self_test(path) if target.is_code else ())]
    return tuple(paths)


INPUTS = ("logs", "sections", "scheme", "budget", "stability")
OUTPUT = Output(
    "CAL.json",
    "write the calibration to CAL.json, and exports beside it",
    "json",
    ("text",),
    beside=_beside,
)
# Whose option is whose: what is left is of the fit.
_AVERAGE = (
    *("outputs", "columns", "time_column", "time_unit", "rate", "min_duration", "threshold"),
    *("sections", "label_column", "only", "drop_bad", "accept_faults", "scheme", "convention"),
)
_OWN = ("logs", "json", "output")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_logs(parser)
    add_log_options(parser)
    add_fit_options(parser)
    parser.add_argument(
        "--to",
        nargs="+",
        action="extend",
        default=[],
        metavar="TARGET",
        help=f"export beside CAL.json, for {', '.join(target.name for target in TARGETS)}",
    )
    add_export_options(parser)


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    check_targets(arguments)
    options = vars(arguments)
    with file_progress(arguments.logs, "reading") as progress:
        chosen = {name: options[name] for name in _AVERAGE}
        found = average(*arguments.logs, progress=progress, **chosen)
    apart = {*_AVERAGE, "to", *export_options(arguments), *_OWN} - {"convention"}
    calibration = fit_rests(found, **{k: v for k, v in options.items() if k not in apart})
    exports, refused = make_exports(calibration, arguments, arguments.output)
    listing = [
        {"target": each.target, "files": [*map(str, each.files(path))], "notes": each.notes}
        for path, each in exports.items()
    ]
    written = [name for each in listing for name in each["files"]]

    def text() -> str:
        last = f"\nWritten to {', '.join(written)}\n" if written else ""
        return f"{averages_text(found)}\n{text_report(calibration)}{last}"

    def with_exports(made: str) -> Any:
        if arguments.output == STDOUT:
            return made
        files = [each.files(path) for path, each in exports.items()]
        return {arguments.output: made} | {k: v for each in files for k, v in each.items()}

    summary = {"average": found.to_dict(), "exports": listing}
    return Answer(
        text=text,
        json=lambda: to_json(calibration.to_dict() | summary),
        forms={
            "json": lambda: with_exports(to_json(calibration.to_dict())),
            "text": lambda: with_exports(text()),
        },
        warnings=lambda: (
            *calibration.diagnostics.warnings,
            *(note for each in exports.values() for note in each.notes),
        ),
        failure=" ".join(refused),
    )


def check_targets(arguments: argparse.Namespace) -> None:
    """Refuse targets that there are not, or that have no file to be beside."""
    names = ", ".join(target.name for target in TARGETS)
    strange = [name for name in arguments.to if named_target(name) is None]
    if strange:
        raise UsageError(f"--to takes {names}, got '{strange[0]}'.")
    for option, value in export_options(arguments).items():
        if value not in (None, False):
            _require_owner(option, arguments.to)
    if arguments.to and arguments.output in (None, STDOUT):
        raise UsageError("--to writes files beside CAL.json; name it with -o.")


def _require_owner(option: str, asked: Sequence[str]) -> None:
    """Refuse an option that only some targets have, where none of them is asked for."""
    owners = [target.name for target in TARGETS if option in target.takes]
    if owners and not set(owners) & set(asked):
        flag = option.replace("_", "-")
        raise UsageError(f"--{flag} is for --to {', '.join(owners)}.")


def _own(target: Target, options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that one of several targets has, for each has its own."""
    own = {
        "name",
        "allow_lossy",
        "accept_doubts",
        *target.takes,
        *(("float",) if target.is_code else ()),
    }
    return {name: value for name, value in options.items() if name in own}


def make_exports(
    calibration: Calibration, arguments: argparse.Namespace, path: str | os.PathLike[str]
) -> tuple[dict[Path, Exported], list[str]]:
    """Return the exports by the file beside `path` each goes to, and why others are refused."""
    made, refused = {}, []
    for name in dict.fromkeys(arguments.to):
        target = named_target(name)
        assert target is not None
        try:
            made[beside(path, target)] = export(
                calibration, name, **_own(target, export_options(arguments))
            )
        except UsageError:
            raise
        except MultiposError as error:
            refused.append(str(error))
    return made, refused

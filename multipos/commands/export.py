"""``multipos export``, and the exports that other commands write beside a calibration.

`run` writes one calibration or regression for its consumer, and `add_options` adds what targets
have of their own. `check_targets` refuses unknown targets, `files_beside` names the files of an
export beside a calibration, and `make_exports` makes them.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multipos.bias_stability.stability_result import Stability, load_stability
from multipos.commands.answers import STDOUT, Answer, Exports, Output, written_to
from multipos.commands.options import declare, options_of
from multipos.errors import MultiposError, UsageError
from multipos.exports.parts import load_parts
from multipos.exports.target import Target, self_test
from multipos.exports.targets import TARGETS, beside, export, named_target
from multipos.files.spelling import StrPath
from multipos.files.trees import read_schema, to_json
from multipos.sensor.calibration import Calibration


def _beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    target = named_target(arguments.to)
    path = arguments.output
    if target is None or not target.is_code or path == STDOUT or path.lower().endswith(".json"):
        return ()
    return self_test(path)


def _is_json(name: str) -> bool:
    target = named_target(name)
    return target is not None and target.suffix == ".json"


INPUTS = ("calibration", "stability")
OUTPUT = Output(
    "FILE",
    "file to write; C gets FILE_test.c, its self-test, as well",
    "export",
    ("json",),
    required=True,
    beside=_beside,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "export", targets=", ".join(target.name for target in TARGETS))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    exported = export(_loaded(arguments.calibration), **options_of(arguments, "export"))
    names = [arguments.output, *map(str, _beside(arguments))]
    of_export = {key: getattr(exported, key) for key in ("difference", "unit", "findings")}
    listing = {"target": exported.target, "files": names, **of_export}
    return Answer(
        sentence=lambda: " ".join([written_to(*names), *filter(None, [exported.residual])]),
        text=str,
        json=lambda: to_json(listing),
        forms={
            "export": lambda: (
                exported.text if arguments.output == STDOUT else exported.files(arguments.output)
            ),
            # a file of the target that is JSON itself stays as it is
            "json": lambda: exported.text if _is_json(arguments.to) else to_json(vars(exported)),
        },
        findings=lambda: exported.findings,
    )


def _loaded(paths: list[str]) -> Any:
    """Return a stability, or calibrations and regressions, as their files say."""
    if len(paths) == 1 and read_schema(paths[0]) == Stability.schema:
        return load_stability(paths[0])
    return load_parts(paths)


def files_beside(targets: Sequence[str], calibration: StrPath) -> tuple[Path, ...]:
    """Return the exports beside a calibration, and their self-tests."""
    paths: list[Path] = []
    for name in targets:
        target = named_target(name)
        if target is not None:
            path = beside(calibration, target)
            paths += [path, *(self_test(path) if target.is_code else ())]
    return tuple(paths)


def check_targets(arguments: argparse.Namespace) -> None:
    """Refuse targets that there are not, or that have no file to be beside."""
    names = ", ".join(target.name for target in TARGETS)
    strange = [name for name in arguments.to if named_target(name) is None]
    if strange:
        raise UsageError(f"--to takes {names}, got '{strange[0]}'.")
    for option, value in options_of(arguments, "export options").items():
        owners = [target.name for target in TARGETS if option in target.takes]
        if value not in (None, False) and owners and not set(owners) & set(arguments.to):
            flag = option.replace("_", "-")
            raise UsageError(f"--{flag} is for --to {', '.join(owners)}.")
    if arguments.to and arguments.output in (None, STDOUT):
        raise UsageError("--to writes files into the folder of CAL.json; name it with -o.")


def _own(target: Target, options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that one of several targets has, for each has its own."""
    of_code = ("float",) if target.is_code else ()
    own = {"name", "allow_lossy", "force", *target.takes, *of_code}
    return {name: value for name, value in options.items() if name in own}


def make_exports(calibration: Calibration, arguments: argparse.Namespace, path: StrPath) -> Exports:
    """Return the exports that are asked for, beside `path`."""
    made = Exports({}, [], [], [])
    options = options_of(arguments, "export options")
    for name in dict.fromkeys(arguments.to):
        target = named_target(name)
        assert target is not None
        try:
            each = export(calibration, name, **_own(target, options))
        except MultiposError as error:
            made.refused.append(str(error))
            continue
        files = each.files(beside(path, target))
        made.files.update(files)
        made.listing.append({"target": each.target, "files": [*map(str, files)]})
        made.findings.extend(each.findings)
    return made

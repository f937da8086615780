"""Exports beside a calibration, in the same go: what is asked for, and its files."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multipos.commands.answers import STDOUT
from multipos.commands.options import export_options
from multipos.errors import MultiposError, UsageError
from multipos.exports.target import Exported, Target, self_test
from multipos.exports.targets import TARGETS, beside, export, named_target
from multipos.sensor.calibration import Calibration


def files_beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """Return the exports, and the self-tests beside them."""
    paths: list[Path] = []
    for name in arguments.to:
        target = named_target(name)
        if target is not None:
            path = beside(arguments.output, target)
            paths += [path, *(self_test(path) if target.is_code else ())]
    return tuple(paths)


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

"""``multipos simulate``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.errors import UsageError
from multipos.files.tables import format_csv
from multipos.files.trees import to_json
from multipos.sensor.calibration_file import load
from multipos.sensor.simulation import simulate, simulate_log

INPUTS = ("calibration", "scheme")
OUTPUT = Output("READINGS.csv", "file to write instead of stdout", "table", ("json", "text"))

# Options of each form, with what they are when not given.
_BOTH = ("orientation_sd", "temperature", "seed")
_READINGS = {"reading_sd": 0.0}
_LOG = {"rate": 100.0, "rest": 5.0, "turn": 2.0, "sample_sd": 0.0, "correlation_time": 0.0}


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    made, mine = (simulate_log, _LOG) if arguments.log else (simulate, _READINGS)
    _refuse_others(arguments)
    options = {name: getattr(arguments, name) for name in _BOTH}
    if arguments.order is not None:
        options["order"] = arguments.order
    for name, default in mine.items():
        given = getattr(arguments, name)
        options[name] = default if given is None else given
    if options["seed"] is not None and options["seed"] < 0:
        raise UsageError(f"--seed must be 0 or more, got {options['seed']}.")
    columns = made(load(arguments.calibration), arguments.scheme, **options)

    def table() -> str:
        return format_csv(columns)

    rows = len(next(iter(columns.values())))
    what = "rows of a log" if arguments.log else "readings"
    return Answer(
        sentence=lambda: f"{rows} {what} simulated.",
        text=table if arguments.output is None else str,
        json=lambda: to_json({"columns": columns, "findings": ()}),
        forms={"table": table, "text": table},
        verbatim=arguments.output is None,
    )


def _refuse_others(arguments: argparse.Namespace) -> None:
    """Refuse the options of the form that is not made."""
    others, what, way = _LOG, "a log", "add"
    if arguments.log:
        others, what, way = _READINGS, "averaged readings", "leave out"
    for name in others:
        if getattr(arguments, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for {what}; {way} --log.")

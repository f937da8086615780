"""``multipos simulate``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import options_of
from multipos.errors import UsageError
from multipos.files.tables import format_csv
from multipos.files.trees import to_json
from multipos.sensor.calibration_file import load
from multipos.sensor.simulation import simulate, simulate_log

INPUTS = ("calibration", "scheme")
OUTPUT = Output("READINGS.csv", "file to write instead of stdout", "table", ("json", "text"))

# Options of one form alone.
_READINGS = ("reading_sd",)
_LOG = ("rate", "rest", "turn", "sample_sd", "correlation_time")


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    _refuse_others(arguments)
    options = options_of(arguments, "simulate", ["scheme", "log"])
    options = {name: value for name, value in options.items() if value is not None}
    if options.get("seed", 0) < 0:
        raise UsageError(f"--seed must be 0 or more, got {options['seed']}.")
    made = simulate_log if arguments.log else simulate
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
    others: tuple[str, ...] = _LOG
    what, way = "a log", "add"
    if arguments.log:
        others, what, way = _READINGS, "averaged readings", "leave out"
    for name in others:
        if getattr(arguments, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for {what}; {way} --log.")

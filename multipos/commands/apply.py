"""``multipos apply``."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache

from multipos.commands.answers import Answer, Output
from multipos.commands.options import file_progress, options_of
from multipos.compensation.applying_logs import apply_log, digits_written
from multipos.compensation.correction import correct
from multipos.errors import UsageError
from multipos.files.tables import Column, format_csv, read_table, to_parquet
from multipos.files.trees import json_table, read_schema
from multipos.files.whole import Content
from multipos.finding import Findings, in_order
from multipos.logs.opening import open_log
from multipos.regression.regression import Regression, load_regression
from multipos.sensor.calibration_file import load

INPUTS = ("calibration", "data", "beside")
OUTPUT = Output("OUT.csv", "file to write instead of stdout", "table", ("parquet", "json", "text"))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    if read_schema(arguments.calibration) == Regression.schema:
        return _correct(arguments)
    if arguments.correct is not None:
        raise UsageError("--correct goes with a regression; a calibration gives forces.")
    calibration = load(arguments.calibration)
    options = options_of(arguments, "apply", ["columns", "correct"])
    options["beside"] = None if arguments.beside is None else load(arguments.beside)
    log = open_log(arguments.data, columns=arguments.columns)
    applied = apply_log(calibration, log, **options)

    @cache
    def columns() -> Mapping[str, Column]:
        with file_progress([arguments.data], "applying") as applied.progress:
            return applied.columns()

    def table() -> Iterator[str]:
        with file_progress([arguments.data], "applying") as applied.progress:
            yield from applied

    def parts() -> Iterator[Mapping[str, Column]]:
        with file_progress([arguments.data], "applying") as applied.progress:
            yield from applied.parts()

    return _answer(
        arguments,
        table,
        parts,
        columns,
        lambda: in_order((*log.left_out, *applied.findings)),
        lambda: _compensated(applied.rows, applied.beyond, applied.noise),
        applied.noise,
    )


def _correct(arguments: argparse.Namespace) -> Answer:
    """Apply a regression: whole, because a rate needs the rows before and after."""
    if arguments.tilt:
        raise UsageError("--tilt goes with a calibration; a regression corrects a column.")
    if arguments.beside is not None:
        raise UsageError("--with goes with a magnetometer's calibration, not with a regression.")
    table = read_table(arguments.data, what="data")
    columns = correct(
        load_regression(arguments.calibration),
        table,
        column=arguments.correct,
        **options_of(arguments, "apply", ["columns", "correct", "tilt"]),
    )
    digits = digits_written({*columns} - {*table.columns})
    return _answer(
        arguments,
        lambda: format_csv(columns, table.delimiter, digits),
        lambda: [columns],
        lambda: columns,
        lambda: columns.findings,
        lambda: _compensated(table.rows, int(sum(columns["outside"])), columns.noise),
        columns.noise,
    )


def _answer(
    arguments: argparse.Namespace,
    table: Callable[[], Content],
    parts: Callable[[], Iterable[Mapping[str, Column]]],
    columns: Callable[[], Mapping[str, Column]],
    findings: Callable[[], Findings],
    sentence: Callable[[], str],
    noise: str | None,
) -> Answer:
    def json() -> Iterable[str]:
        table, said = columns(), {} if noise is None else {"noise": noise}
        return json_table(table, len(table["outside"]), {**said, "findings": findings()})

    return Answer(
        sentence=sentence,
        text=table if arguments.output is None else str,
        json=json,
        forms={"table": table, "text": table, "parquet": lambda: to_parquet(parts())},
        findings=findings,
        verbatim=arguments.output is None,
    )


def _compensated(rows: int, beyond: int, noise: str | None) -> str:
    """Return how many rows were compensated, and which noise of a reading u holds."""
    held = "" if noise is None else f"; u holds the noise of one reading, {noise}"
    return f"{rows} rows compensated, {beyond} of them outside what was calibrated{held}."

"""When the samples of a log were taken: the column that tells it, its unit, and the sample rate.

A time is in the unit that its header or its name tells, ``Time (s)``, ``timestamp_us``,
``seconds_elapsed``; else a number since 1970 tells by its size, and any other by its steps: below
2 they are seconds, below 125 milliseconds, below 125,000 microseconds, since hardly a sensor is
sampled less than eight times a second. ``--time-unit`` decides otherwise.

Dates in the cells of a log.
"""

import re
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.tables import Table
from multipos.logs.layout import DATE
from multipos.logs.table import Log
from multipos.numerics.arrays import Array, median
from multipos.numerics.series import FASTEST, SLOWEST
from multipos.positions.headers import unit_of

TimeUnit = Literal["s", "ms", "us", "ns"]
TIME_UNITS: tuple[TimeUnit, ...] = get_args(TimeUnit)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "100 us": 1e-4}

# The first that a column answers to tells the time, in this order.
_NAMES = [
    re.compile(pattern)
    for pattern in (
        "time",
        "t",
        r"(time|timestamp|t)[ _](s|sec|ms|us|ns)|time(s|ms|us|ns)|timestamp(ms|us|ns)",
        "seconds[ _]elapsed|elapsed([ _]time)?|time[ _]elapsed",
        "timestamp|time[ _]stamp|__time",
        "sampletimefine",
        "seconds|secs?|millis|millisec(ond)?s|micros|microsec(ond)?s|msec|usec|nanos",
        "(utc[ _]?)?date([ _]?time)?|utc",
        "time[ _].*|.*[ _]time|.*timestamp.*",
    )
]
_SINCE_1970 = 1e8  # seconds, in 1973: no log begins so late by its own clock
_LAST = 1e11  # seconds, in 5138
# The largest steps of each unit: of seconds a log may have one a row, of the others eight a second.
_STEPS = {"s": 2.0, "ms": 125.0, "us": 125e3, "ns": np.inf}


class Clock(NamedTuple):
    """The column that tells the time."""

    column: str
    unit: str  # a key of the units' sizes
    seconds: float  # of one such unit
    by: str  # what told the unit


def time_columns(log: Log) -> list[str]:
    """Return the columns whose names say that they tell the time, the likeliest first."""
    numeric = [name for name in log.numeric if name not in log.nameless]
    found = [
        name
        for pattern in _NAMES
        for name in numeric
        if pattern.fullmatch(name.casefold()) is not None
    ]
    first = numeric[:1] if log.rising else []
    return list(dict.fromkeys([*found, *(name for name in numeric if name in log.dates), *first]))


def check_time_unit(given: str | None) -> None:
    """Refuse a unit of time that is none."""
    if given is not None and given not in TIME_UNITS:
        raise UsageError(f"--time-unit takes {', '.join(TIME_UNITS)}, got '{given}'.")


def read_clock(log: Log, column: str, time: Array, given: TimeUnit | None) -> Clock:
    """Return the clock that a column is.

    Parameters
    ----------
    log : Log
    column : str
    time : (n,) array
        Its first cells.
    given : str, optional
        The unit, from ``--time-unit``.
    """
    if given is not None:
        return Clock(column, given, _SECONDS[given], "--time-unit")
    if column in log.dates:
        return Clock(column, "s", 1.0, "its dates")
    unit = log.units.get(column) or _named_unit(column)
    if unit in _SECONDS:
        return Clock(column, unit, _SECONDS[unit], "its name")
    first = abs(float(time[0])) if len(time) else 0.0
    for unit in TIME_UNITS:
        if _SINCE_1970 <= first * _SECONDS[unit] < _LAST and first >= _SINCE_1970:
            return Clock(column, unit, _SECONDS[unit], "its size, since 1970")
    unit = _unit_of_steps(time)
    return Clock(column, unit, _SECONDS[unit], "its steps")


def _named_unit(column: str) -> str | None:
    name = column.casefold()
    if name == "sampletimefine":
        return "100 us"
    if name in ("millis", "micros", "nanos") or name.startswith("seconds"):
        return unit_of(name.split("_")[0].split(" ")[0])
    found = re.fullmatch(r"(?:.*[ _]|time|timestamp)([a-zµμ]+)", name)
    return unit_of(found[1]) if found else None


def _unit_of_steps(time: Array) -> str:
    step = usual_step(time)
    # a step that is no number, of a corrupt time, is refused where the sample rate is formed
    return next((unit for unit, largest in _STEPS.items() if step < largest), "s")


def usual_step(time: Array) -> float:
    """Return the usual step between times (n,), which may come in bursts; 0 where there is none."""
    steps = np.diff(time)
    usual = float(median(steps)) if len(steps) else 0.0
    if usual <= 0.0:
        usual = float(np.mean(steps)) if len(steps) else 0.0
    return max(usual, 0.0)


def sample_rate(source: str, column: str, time: Array) -> float:
    """Return the sample rate [Hz] that times (n,) in seconds show.

    Raises
    ------
    MultiposError
        The time stands still, or no sensor is sampled so fast or slowly.
    """
    usual = usual_step(time)
    if usual <= 0.0:
        raise MultiposError(
            f"{source}: column '{column}' does not move on; it must hold the time, or give --rate."
        )
    if not SLOWEST <= 1.0 / usual <= FASTEST:
        raise MultiposError(
            f"{source}: column '{column}' steps by {usual:g}, no time between samples in seconds "
            f"({1.0 / FASTEST:g} to {1.0 / SLOWEST:g}); correct it, or give --rate."
        )
    return 1.0 / usual


_ZONE = re.compile(r"[ \t]*(?:Z|UTC|(?<=\d)[+-]\d\d:?\d\d)?$", re.MULTILINE)
_MILLISECONDS = re.compile(r":(\d{3})$", re.MULTILINE)  # behind a colon, as a wearable writes them


def read_dates(dates: Sequence[str]) -> Array:
    """Return dates as seconds since 1970, NaN where a cell is none; zones are not looked at."""
    told = [cell if DATE.fullmatch(cell) else "NaT" for cell in dates]
    plain = _ZONE.sub("", "\n".join(told).replace(",", ".").replace("/", "-"))
    plain = _MILLISECONDS.sub(r".\1", plain)
    try:
        times = np.array(plain.split("\n"), dtype="datetime64[ns]")
    except ValueError:
        times = np.array([_date(each) for each in plain.split("\n")], dtype="datetime64[ns]")
    seconds = times.astype(np.int64) * 1e-9
    return np.where(np.isnat(times), np.nan, seconds)


def _date(cell: str) -> np.datetime64:
    try:
        return np.datetime64(cell, "ns")
    except ValueError:
        return np.datetime64("NaT", "ns")


def require_dates(table: Table, name: str, cells: Sequence[str]) -> Array:
    """Return dates as seconds since 1970, and refuse a cell that is none."""
    seconds = read_dates(cells)
    bad = np.flatnonzero(np.isnan(seconds))
    if len(bad):
        row = int(bad[0])
        raise MultiposError(
            f"{table.where(row, name)}: '{cells[row]}' is no date; correct it, or give --drop-bad "
            "to leave such rows out."
        )
    return seconds

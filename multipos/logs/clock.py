"""When the samples of a log were taken: the column that tells it, its unit, and the sample rate.

`time_columns` names what may be a time, `read_clock` finds its unit and `counts_rows` what is none;
`unwrap` continues counters that wrap as `wraps_of` says, `usual_step` and `sample_rate` give step
and rate, `read_dates` and `require_dates` read dates, `check_time_unit` checks an option.

A time is in the unit that its header or its name tells, ``Time (s)``, ``timestamp_us``,
``seconds_elapsed``; else by its steps: below 2 they are seconds, below 125 milliseconds, below
125,000 microseconds, since hardly a sensor is sampled less than eight times a second. A number that
in one of the units is a day of this century, with steps below two seconds, or a minute
from 2015 to 2060, is since 1970; a counter since power was switched on is not, but for weeks of µs.
Days since 1900, as spreadsheets have them, are those of this century in steps below two seconds.
``--time-unit`` decides otherwise.
A column that goes up by ones is in seconds, unless the readings turn in steps so small that many
rows were taken in a second: then it counts rows and tells no time.

Counters that wrap around, after 16, 24, 31 or 32 bits, and clocks that pass midnight go on.

Dates, and times of a day, in the cells of a log.
"""

import re
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.printed import DATE
from multipos.files.spelling import packaged_pairs
from multipos.files.tables import Table
from multipos.files.written_units import unit_of
from multipos.logs.table import Log
from multipos.numerics.arrays import FASTEST, SLOWEST, Array, median

TimeUnit = Literal["s", "ms", "us", "ns"]
TIME_UNITS: tuple[TimeUnit, ...] = get_args(TimeUnit)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "100 us": 1e-4}

# The first that a column answers to tells the time, in this order.
_NAMES = (*packaged_pairs(__file__, "time_names.csv"),)
# Seconds from 1970 to 2000 and 2100, and to 2015 and 2060, and the largest steps of such times.
_SINCE_1970 = ((946_684_800.0, 4_102_444_800.0, 2.0), (1_420_070_400.0, 2_840_140_800.0, 60.0))
_DAY = 86400.0  # [s]
_EXCEL = (36526.0, 73051.0)  # days since 1900, from 2000 to 2100
# Where counters wrap around; the last two are of a 32-bit counter of µs that is shown in ms and s.
_WRAPS = (2.0**16, 2.0**24, 2.0**31, 2.0**32, 2.0**32 / 1e3, 2.0**32 / 1e6)
_AHEAD = 100.0  # usual steps that a counter may have gone on by when it wraps
# The largest steps of each unit: of seconds a log may have one a row, of the others eight a second.
_TURNING, _JUMP = 0.03, 0.12  # steps of a turn, and of one within few rows, over the whole range
_MOVED, _ABOVE_NOISE = 0.3, 20.0  # the range of a sensor that moved, over its size and its steps
_JUMPS, _MOST_JUMPS = 3, 3  # so many jumps, and one of so many rows of a turn
_FEW = 50  # rows, of which some may go up by ones by chance
_STEPS = {"s": 2.0, "ms": 125.0, "us": 125e3, "ns": np.inf}


class Clock(NamedTuple):
    """The column that tells the time."""

    column: str
    unit: str  # a key of the units' sizes
    seconds: float  # of one such unit
    by: str  # that state the unit


def time_columns(log: Log) -> list[str]:
    """Return the columns whose names say that they tell the time, the likeliest first."""
    numeric = [name for name in log.numeric if name not in log.nameless]
    found = [
        name for pattern in _NAMES for name in numeric if re.fullmatch(pattern, name.casefold())
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
    first, step = abs(float(time[0])) if len(time) else 0.0, usual_step(time)
    for unit in TIME_UNITS:
        seconds = _SECONDS[unit]
        since, usual = first * seconds, step * seconds
        if any(begin <= since < end and usual < most for begin, end, most in _SINCE_1970):
            return Clock(column, unit, seconds, "its size, since 1970")
    if _EXCEL[0] <= first < _EXCEL[1] and step * _DAY < _SINCE_1970[0][2]:
        return Clock(column, "d", _DAY, "its size, days since 1900")
    # a step that is no number, of a corrupt time, is refused where the sample rate is formed
    unit = next((unit for unit, largest in _STEPS.items() if step < largest), "s")
    return Clock(column, unit, _SECONDS[unit], "its steps")


def counts_rows(log: Log, column: str, time: Array, data: Array) -> bool:
    """Tell whether a column (n,) whose unit nothing tells counts rows of outputs (M, n)."""
    stated = column in log.dates or column in log.units or _named_unit(column) is not None
    with np.errstate(invalid="ignore"):  # of an infinite time, which is refused where it matters
        by_ones = not stated and len(time) > _FEW and bool((np.diff(time) == 1.0).all())
    return by_ones and _turns_slowly(data)


def _turns_slowly(data: Array) -> bool:
    """Tell whether outputs (M, n) turn in steps too small for a sample a second.

    At that rate a sensor is turned within a few rows; at ten or more the steps of a turn are
    small, and only knocks and bad cells are large. A sensor at rest tells nothing.
    """
    good = data[:, np.isfinite(data).all(axis=0)]
    if good.shape[1] <= _FEW:
        return False
    low, high = np.quantile(good, [0.02, 0.98], axis=1)
    span = float(np.linalg.norm(high - low))
    steps = np.linalg.norm(np.diff(good, axis=1), axis=0)
    size = float(median(np.linalg.norm(good, axis=0)))
    if span <= _MOVED * size or span <= _ABOVE_NOISE * float(median(steps)):
        return False
    large, turning = (int(np.count_nonzero(steps > part * span)) for part in (_JUMP, _TURNING))
    jumps = large >= _JUMPS and _MOST_JUMPS * large >= turning and turning < len(steps) // 2
    return not jumps


class Unwrapped(NamedTuple):
    """A time that wraps around, made to go on."""

    time: Array
    size: float  # after which it wraps; 0 where it does not
    wraps: int


def unwrap(time: Array, last: float, size: float, step: float, wraps: Sequence[float]) -> Unwrapped:
    """Return times (n,) that go on where they wrap around.

    Parameters
    ----------
    time : (n,) array
    last : float
        The one before; NaN where there is none.
    size : float
        After which it wraps around, if that is known, else 0.
    step : float
        Usual step of the time.
    wraps : sequence of float
        Sizes that there are.
    """
    steps = np.diff(time, prepend=last if np.isfinite(last) else time[:1])
    back = np.flatnonzero(steps < 0.0)
    for each in (size,) if size else wraps:
        on = steps[back] + each
        if len(back) and ((on >= 0.0) & (on <= _AHEAD * max(step, 1e-12 * each))).all():
            laps = np.zeros(len(time))
            laps[back] = each
            return Unwrapped(time + np.cumsum(laps), each, len(back))
    return Unwrapped(time, 0.0, 0)


def wraps_of(clock: Clock) -> tuple[float, ...]:
    """Return after how many seconds a clock may wrap around."""
    return (_DAY,) if clock.by == "its dates" else tuple(clock.seconds * each for each in _WRAPS)


def _named_unit(column: str) -> str | None:
    name = column.casefold()
    if name == "sampletimefine":
        return "100 us"
    if name in ("millis", "micros", "nanos") or name.startswith("seconds"):
        return unit_of(name.split("_")[0].split(" ")[0])
    if name in ("mstime", "ustime", "nstime"):
        return name[:2]
    found = re.fullmatch(r"(?:.*[ _]|time|timestamp)([a-zµμ]+)", name)
    return unit_of(found[1]) if found else None


def usual_step(time: Array) -> float:
    """Return the usual step between times (n,), which may come in bursts; 0 where there is none."""
    if len(time) < 2:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # of corrupt times
        usual, n = float(median(np.diff(time))), len(time) - 1
        return max(usual if usual > 0.0 else float(time[-1] - time[0]) / n, 0.0)


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


_HOURS = 2  # characters in front of the first colon, of a time without a date
_ZONE = re.compile(r"[^\S\n]*(?:Z|UTC|[+-]\d\d:?\d\d)?$", re.MULTILINE)
_MILLISECONDS = re.compile(r"(:\d\d):(\d{3})$", re.MULTILINE)  # as a wearable writes them
_MONTH_FIRST = re.compile(r"^(\d\d?)-(\d\d?)-(\d{4})[T ]", re.MULTILINE)
_DAY_FIRST = re.compile(r"^(\d\d?)\.(\d\d?)\.(\d{4})[T ]", re.MULTILINE)


def read_dates(dates: Sequence[str]) -> Array:
    """Return dates as seconds since 1970, NaN where a cell is none; zones are not looked at.

    Of times without a date the seconds since midnight; of 11/21/2026 the month comes first, of
    21.11.2026 the day.
    """
    dated = [len(cell.partition(":")[0]) > _HOURS for cell in dates]
    stated = [
        cell if DATE.fullmatch(cell) and has_date == any(dated) else "NaT"
        for cell, has_date in zip(dates, dated, strict=True)
    ]
    plain = _ZONE.sub("", "\n".join(stated))
    plain = _DAY_FIRST.sub(_turned(3, 2, 1), plain)
    plain = plain.replace(",", ".").replace("/", "-")
    plain = _MONTH_FIRST.sub(_turned(3, 1, 2), plain)
    plain = _MILLISECONDS.sub(r"\1.\2", plain)
    plain = re.sub(r"(^|[T ])(\d):", r"\g<1>0\2:", plain, flags=re.MULTILINE)
    plain = re.sub(r"^(?=\d\d:)", "1970-01-01 ", plain, flags=re.MULTILINE)
    try:
        times = np.array(plain.split("\n"), dtype="datetime64[ns]")
    except ValueError:
        times = np.array([_date(each) for each in plain.split("\n")], dtype="datetime64[ns]")
    seconds = times.astype(np.int64) * 1e-9
    return np.where(np.isnat(times), np.nan, seconds)


def _turned(*groups: int) -> Callable[[re.Match[str]], str]:
    """Return what writes year, month and day that stand in these groups."""
    year, month, day = groups
    return lambda found: f"{found[year]}-{int(found[month]):02}-{int(found[day]):02} "


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

"""Dates in the cells of a log."""

import re
from collections.abc import Sequence

import numpy as np

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.logs.layout import DATE
from multipos.numerics.arrays import Array

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

"""Limits of numbers, by name: from a CSV or TOML file, or a mapping.

A value on a limit is within it; an empty side has no limit.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError
from multipos.files.records import LARGEST, is_number
from multipos.files.spelling import StrPath
from multipos.files.tables import Table, read_table
from multipos.files.trees import read_toml
from multipos.results import frozen


@frozen(eq=True)
class Limit:
    """What a number may be; infinite where there is no limit on that side."""

    name: str
    lsl: float
    usl: float


LimitsSource = StrPath | Mapping[str, Sequence[float | None]]


def read_limits(source: LimitsSource) -> tuple[Limit, ...]:
    """Return limits from a CSV or TOML file, or a mapping of name to (lsl, usl).

    Raises
    ------
    MultiposError
        The file is missing or at fault, or a lower limit is not below its upper one.
    """
    if isinstance(source, Mapping):
        return tuple(_limit("the limits", name, pair) for name, pair in source.items())
    if Path(source).suffix.lower() == ".toml":
        tables = read_toml(source, "limits")
        return tuple(_limit(str(source), name, pair) for name, pair in tables.items())
    return _of_table(read_table(source, what="limits"))


def _of_table(table: Table) -> tuple[Limit, ...]:
    for name in ("name", "lsl", "usl"):
        if name not in table:
            raise MultiposError(
                f"{table.source}: no column '{name}'; limits have the columns name, lsl, usl."
            )
    lower, upper = (_side(table, name) for name in ("lsl", "usl"))
    return tuple(
        _limit(table.where(row, "name"), name, (lower[row], upper[row]))
        for row, name in enumerate(table.text("name"))
    )


def _side(table: Table, name: str) -> list[float]:
    """Return the limits of one side, NaN where a cell is empty."""
    side = table.numbers(name).tolist()
    for row, text in enumerate(table.text(name)):
        if text and math.isnan(side[row]):
            raise MultiposError(f"{table.where(row, name)}: '{text}' is not a number.")
    return list(side)


def _limit(where: str, name: str, pair: Any) -> Limit:
    known = isinstance(pair, list | tuple) and len(pair) == 2
    if not known or not all(side is None or is_number(side) for side in pair):
        raise MultiposError(f"{where}: '{name}' needs two limits, [lsl, usl], got {pair!r}.")
    lsl = -math.inf if pair[0] is None or math.isnan(pair[0]) else float(pair[0])
    usl = math.inf if pair[1] is None or math.isnan(pair[1]) else float(pair[1])
    for side in (lsl, usl):
        if LARGEST < abs(side) < math.inf:
            raise MultiposError(
                f"{where}: '{name}' has the limit {side:g}, which no parameter could reach; "
                "leave it empty where there is none."
            )
    if not lsl < usl:
        raise MultiposError(f"{where}: '{name}' has lsl {lsl:g}, which is not below usl {usl:g}.")
    return Limit(name, lsl, usl)

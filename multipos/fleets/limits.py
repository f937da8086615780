"""Limits of a fleet's numbers, from a file, and the verdict of every unit.

A limit is on a column of the table of calibrations (a parameter, ``u_…``, ``rms``, …) or, as
``U:name``, on the expanded uncertainty of a parameter. A value on a limit is within it.

- `failed`: there is no calibration, with the reason;
- `doubt`: there is one, but it is not fit for use, so that what it says of the unit is not known;
- `fail`: a value is outside its limits, or is none;
- `pass`: none of these.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.lists import near
from multipos.files.records import LARGEST
from multipos.files.tables import Table, read_table
from multipos.files.trees import read_toml
from multipos.fleets.units import Texts, Units
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factors

PASS, FAIL, DOUBT, FAILED = "pass", "fail", "doubt", "failed"
VERDICTS = (PASS, FAIL, DOUBT, FAILED)


@dataclass(frozen=True)
class Limit:
    """What a number may be; infinite where there is no limit on that side."""

    name: str
    lsl: float
    usl: float


LimitsSource = str | os.PathLike[str] | Mapping[str, Sequence[float | None]]


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


def _is_side(side: Any) -> bool:
    return side is None or (isinstance(side, int | float) and not isinstance(side, bool))


def _limit(where: str, name: str, pair: Any) -> Limit:
    known = isinstance(pair, list | tuple) and len(pair) == 2
    if not known or not all(map(_is_side, pair)):
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


@dataclass(frozen=True, eq=False)
class Verdicts:
    """The verdict of every unit (B,), the reasons, and how often each kind of reason came."""

    verdict: NDArray[np.str_]
    reasons: Texts
    causes: Mapping[str, int]


def judge_units(units: Units, limits: Sequence[Limit], implausible: NDArray[np.bool_]) -> Verdicts:
    """Return the verdicts of units.

    Parameters
    ----------
    units : Units
    limits : sequence of Limit
    implausible : (B,) array of bool
        Whose calibration is not fit for use.

    Raises
    ------
    MultiposError
        A limit is on a name that there is not.
    """
    failed = units.failed
    reasons = units.reasons.copy()
    causes: dict[str, int] = {}
    outside = np.zeros(len(units), dtype=np.bool_)
    for limit in limits:
        value = column(units, limit.name)
        beyond = ~failed & ~((value >= limit.lsl) & (value <= limit.usl))
        outside |= beyond
        if beyond.any():
            causes[f"{limit.name} outside its limits"] = int(beyond.sum())
        for unit in np.flatnonzero(beyond).tolist():
            _add(reasons, unit, _said(limit, float(value[unit])))
    for unit in np.flatnonzero(implausible).tolist():
        _add(reasons, unit, f"doubts: {units.doubts[unit]}")
        for code in units.doubts[unit].split():
            causes[code] = causes.get(code, 0) + 1
    if failed.any():
        causes["no calibration"] = int(failed.sum())
    verdict = np.select([failed, implausible, outside], [FAILED, DOUBT, FAIL], PASS)
    return Verdicts(verdict, reasons, causes)


def _add(reasons: Texts, unit: int, text: str) -> None:
    reasons[unit] = f"{reasons[unit]}; {text}" if reasons[unit] else text


def _said(limit: Limit, value: float) -> str:
    if math.isnan(value):
        return f"{limit.name} has no value"
    side = f"below {limit.lsl:g}" if value < limit.lsl else f"above {limit.usl:g}"
    return f"{limit.name} = {value:.6g} is {side}"


def column(units: Units, name: str) -> Array:
    """Return a number of every unit (B,) by its name, ``U:…`` included.

    Raises
    ------
    MultiposError
        There is none of that name; one that is like it is offered.
    """
    if name == "rms":
        return units.rms
    for prefix, table in (("", units.parameters), ("u_", units.u), ("dof_", units.dof)):
        if name.startswith(prefix) and name.removeprefix(prefix) in units.names:
            return np.asarray(table[:, units.names.index(name.removeprefix(prefix))])
    if name.startswith("U:") and name[2:] in units.names:
        place = units.names.index(name[2:])
        return np.asarray(
            coverage_factors(units.confidence, units.dof[:, place]) * units.u[:, place]
        )
    if not units.names:  # no unit could be fitted, so nothing is known of any name
        return np.full(len(units), np.nan)
    known = [*units.names, *(f"U:{each}" for each in units.names), "rms"]
    raise MultiposError(
        f"the limits name '{name}', which no unit has{near(name, known)} There are "
        f"{', '.join(units.names)}, U:NAME of each, u_NAME and rms."
    )

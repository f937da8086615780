"""The verdict of every unit of a fleet: its numbers against limits from a file.

- `judge_units` returns the `Verdicts` of units.
- `column` returns a number of every unit by the name that a limit has.

A limit is on a column of the table of calibrations (a parameter, ``u_…``, ``rms``, …) or, as
``U:name``, on the expanded uncertainty of a parameter. A value on a limit is within it.

- `failed`: there is no calibration, with the reason;
- `unfit`: there is one, but it is not fit for use, so that what it says of the unit is not known;
- `fail`: a value is outside its limits, or is none;
- `pass`: none of these.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.limits import Limit
from multipos.files.spelling import near
from multipos.fleets.unit_results import Texts, Units
from multipos.numerics.arrays import Array, Mask
from multipos.numerics.quantiles import coverage_factors
from multipos.results import frozen

PASS, FAIL, UNFIT, FAILED = "pass", "fail", "unfit", "failed"
VERDICTS = (PASS, FAIL, UNFIT, FAILED)


@frozen
class Verdicts:
    """The verdict of every unit (B,), the reasons, how often each kind came, and the first."""

    verdict: NDArray[np.str_]
    reasons: Texts
    causes: Mapping[str, int]
    first: Mapping[str, str]


def judge_units(units: Units, limits: Sequence[Limit], unfit: Mask) -> Verdicts:
    """Return the verdicts of units.

    Parameters
    ----------
    units : Units
    limits : sequence of Limit
    unfit : (B,) array of bool
        Whose calibration is not fit for use.

    Raises
    ------
    MultiposError
        A limit is on a name that there is not.
    """
    failed = units.failed
    reasons = units.reasons.copy()
    causes: Counter[str] = Counter()
    first: dict[str, str] = {}

    def count(cause: str, unit: int, text: str) -> None:
        causes[cause] += 1
        first.setdefault(cause, f"{units.unit[unit]}: {text}")

    outside = np.zeros(len(units), dtype=np.bool_)
    for limit in limits:
        value = column(units, limit.name)
        beyond = ~failed & ~((value >= limit.lsl) & (value <= limit.usl))
        outside |= beyond
        for unit in np.flatnonzero(beyond).tolist():
            said = _said(limit, float(value[unit]))
            _add(reasons, unit, said)
            count(f"{limit.name} outside its limits", unit, said)
    for unit in np.flatnonzero(unfit).tolist():
        _add(reasons, unit, units.why_unfit[unit])
        named = {said.partition(" ")[0]: said for said in units.why_unfit[unit].split("; ")}
        for code in units.findings[unit].split(";"):
            count(code, unit, named.get(code, code))
    for unit in np.flatnonzero(failed).tolist():
        count("no calibration", unit, units.reasons[unit])
    verdict = np.select([failed, unfit, outside], [FAILED, UNFIT, FAIL], PASS)
    return Verdicts(verdict, reasons, causes, first)


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

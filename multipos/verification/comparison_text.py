"""Repeated calibrations as people read them.

- `comparison_sentence` returns what agrees, as a sentence.
- `changes_text` returns the changes between the first and the last, of the rows of `change_rows`;
  `runs_text` the parameters run by run, `comparison_text` both.
- `or_nan` returns a number of a file, NaN where it has none.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.files import numbers
from multipos.results import plain
from multipos.verification.comparison import Comparison
from multipos.verification.repeat_drift import ABSOLUTE, GIVEN, ORDERED

_DAY = 86400.0  # s
_TIMES = {
    ABSOLUTE: "against the absolute times of the readings",
    ORDERED: "against the times of the readings, which follow one another",
    GIVEN: "per run, in the order given; the readings have no common clock",
}


def comparison_text(found: Comparison) -> str:
    """Return a comparison as text: what changed, then run by run."""
    return "\n\n".join(filter(None, (changes_text(found), runs_text(found)))) + "\n"


def runs_text(found: Comparison) -> str:
    """Return the parameters run by run, and how stable the biases are."""
    lines = [
        f"{i}  {file}  ({c.created})"
        for i, (file, c) in enumerate(zip(found.files, found.calibrations, strict=True), start=1)
    ]
    model = found.calibrations[0].model
    stability = [[output, numbers.number(sd, 3)] for output, sd in found.bias_stability.items()]
    parts = [
        "\n".join(lines),
        _parameter_table(found),
        *([] if math.isnan(found.p_total) else [f"drift: {_TIMES[found.times]}"]),
        "bias stability\n" + numbers.table(["output", f"sd [{model.unit}]"], stability),
        _verdict(found),
    ]
    return "\n\n".join(parts)


def changes_text(found: Comparison) -> str:
    """Return the table of changes between the first and the last; nothing where there is none."""
    header, rows = change_rows(plain(found.to_dict()))
    if not rows:
        return ""
    return "\n\n".join(filter(None, (numbers.table(header, rows, left=2), found.common)))


def change_rows(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the changes that the JSON of `compare` has; empty without any."""
    header = ["parameter", "unit", "change", "U", "E_n", "per year", "U", "limit", "within", "due"]
    rows, changes = [], found.get("changes") or ()
    units = {each["name"]: each["unit"] for each in found["parameters"]}
    sizes = [numbers.most_of(or_nan(each["change"]), or_nan(each["U"])) for each in changes]
    named = [units.get(each["name"], "") for each in changes]
    shared = numbers.common_units(zip(named, sizes, strict=True))  # rows of one unit keep one
    for each, unit in zip(changes, named, strict=True):
        rate, (factor, shown) = each["per_year"], shared[unit]
        rows.append(
            [
                each["name"],
                shown,
                *_beside(factor, each["change"], each["U"]),
                numbers.plain_number(each["En"] and numbers.beyond_rounding(each["En"]), 2),
                *(("", "") if rate is None else _beside(factor, rate["value"], rate["U"])),
                _limit_in_words(each["limit"], factor),
                {True: "yes", False: "NO", None: ""}[each["within"]],
                each["due"] or "",
            ]
        )
    kept = [i for i in range(len(header)) if i < 5 or any(row[i] for row in rows)]
    return [header[i] for i in kept], [[row[i] for i in kept] for row in rows]


def or_nan(value: float | None) -> float:
    """Return a number of JSON, which has null for NaN."""
    return math.nan if value is None else value


def _beside(factor: float, value: float | None, U: float | None) -> tuple[str, str]:
    """Return a value and its U times a factor, to the two digits of U."""
    size = factor * or_nan(U)
    return numbers.beside(factor * or_nan(value), size, size)


def _limit_in_words(limit: float | Sequence[float | None] | None, factor: float) -> str:
    if isinstance(limit, Sequence):
        low, high = ("" if side is None else numbers.plain_number(factor * side) for side in limit)
        return f"{low} … {high}"
    return "" if limit is None else numbers.plain_number(factor * limit)


def _parameter_table(found: Comparison) -> str:
    """Return every parameter in every run, their mean and drift."""
    model = found.calibrations[0].model
    runs = [str(i) for i in range(1, len(found.files) + 1)]
    per, factor = ("day", _DAY) if found.per == "time" else ("run", 1.0)
    header = ["parameter", "unit", *runs, "mean(sd)", f"drift per {per}", "its p", "p", ""]
    rows = []
    for i, name in enumerate(model.names):
        mean, sd = float(found.mean[i]), float(found.sd[i])
        rounding = 1e-12 * float(np.abs(found.values).max())
        varies = sd > rounding
        rows.append(
            [
                name,
                model.units[i],
                *(f"{value:.7g}" for value in found.values[:, i].tolist()),
                numbers.uncertain(mean, sd if varies else 0.0),
                numbers.number(factor * float(found.drift[i]) if varies else 0.0, 2),
                numbers.chance(float(found.drift_p[i])),
                numbers.chance(float(found.p[i])),
                "moved" if name in found.moved else "",
            ]
        )
    return numbers.table(header, rows, left=2)


def _verdict(found: Comparison) -> str:
    """Return whether the runs are consistent, and the test that says so."""
    verdict = "consistent" if found.consistent else "NOT consistent"
    if math.isnan(found.p_total):
        return f"{verdict}: {found.test}"
    dof = found.dof_total
    shown = ", ".join(map(numbers.number, dof)) if isinstance(dof, list) else numbers.number(dof)
    return (
        f"{verdict}: {found.test}: {numbers.number(found.statistic)} on {shown} degrees of "
        f"freedom, {numbers.p_in_words(found.p_total)}"
    )


def comparison_sentence(found: Mapping[str, Any]) -> str:
    """Return whether runs agree and what has moved, from the JSON of `compare`."""
    said = _agreement(found)
    unfit = any(each["level"] == "error" for each in found.get("findings", ()))
    return f"Not fit for use: {said}" if unfit else said


def _agreement(found: Mapping[str, Any]) -> str:
    """Return whether runs agree."""
    verdict = "agree" if found["consistent"] else "do not agree"
    if "terms" in found:
        least = min((t["p"] for t in found["terms"] if t["p"] is not None), default=None)
        smallest = "" if least is None else f"; smallest p of a term {numbers.chance(least)}"
        return f"{len(found['regressions'])} regressions {verdict}{smallest}."
    given = "" if found["p"] is None else f" ({numbers.p_in_words(found['p'])})"
    together = f"{len(found['calibrations'])} calibrations {verdict}{given}"
    changes, largest = found.get("changes") or (), found.get("largest")
    if largest is None or largest["En"] is None:
        moved = [each["name"] for each in found["parameters"] if each["moved"]]
        return f"{together}; moved: {', '.join(moved)}." if moved else f"{together}."
    agree = sum(each["En"] is not None and each["En"] <= 1.0 for each in changes)
    said = (
        f"{agree} of {len(changes)} parameters agree with the first calibration's within U "
        f"(largest E_n {numbers.plain_number(largest['En'])}, {largest['name']}, "
        f"{numbers.p_in_words(largest['p'])} of any)."
    )
    limited = [each for each in changes if each["within"] is not None]
    if limited:
        beyond = [each["name"] for each in limited if not each["within"]]
        said += f" {len(limited) - len(beyond)} of {len(limited)} are within their limits"
        said += f"; beyond: {', '.join(beyond)}." if beyond else "."
        due = min((each["due"] for each in limited if each["due"]), default=None)
        said += f" Next calibration due {due}." if due else ""
    return said if found["consistent"] else f"{said} Together {together}."

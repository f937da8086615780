"""Repeated calibrations as people read them.

- `comparison_sentence` returns what agrees, as a sentence.
- `changes_text` returns the changes between the first and the last, of the rows of `change_rows`;
  `runs_text` the parameters run by run, `comparison_text` both.
"""

import math

import numpy as np

from multipos.files import numbers
from multipos.finding import errors_of
from multipos.verification.comparison import Comparison
from multipos.verification.consistency import worded_test
from multipos.verification.recalibration import ABSOLUTE, DAY, GIVEN, ORDERED, Stated
from multipos.verification.regression_repeats import RegressionComparison

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
    header, rows = change_rows(found)
    if not rows:
        return ""
    return "\n\n".join(filter(None, (numbers.table(header, rows, left=2), found.common)))


def change_rows(found: Comparison) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the changes; empty without any."""
    header = ["parameter", "unit", "change", "U", "E_n", "per year", "U", "limit", "within", "due"]
    model, rows = found.calibrations[0].model, []
    named = [model.units[model.names.index(each.name)] for each in found.changes]
    sizes = [numbers.most_of(each.change, each.U) for each in found.changes]
    shared = numbers.common_units(zip(named, sizes, strict=True))  # rows of one unit keep one
    for each, unit in zip(found.changes, named, strict=True):
        factor, shown = shared[unit]
        rows.append(
            [
                each.name,
                shown,
                *_beside(factor, each.change, each.U),
                numbers.plain_number(numbers.beyond_rounding(each.En), 2),
                *(("", "") if each.per_year is None else _beside(factor, *each.per_year)),
                _limit_in_words(each.limit, factor),
                {True: "yes", False: "NO", None: ""}[each.within],
                each.due or "",
            ]
        )
    kept = [i for i in range(len(header)) if i < 5 or any(row[i] for row in rows)]
    return [header[i] for i in kept], [[row[i] for i in kept] for row in rows]


def _beside(factor: float, value: float, U: float) -> tuple[str, str]:
    """Return a value and its U times a factor, to the two digits of U."""
    return numbers.beside(factor * value, factor * U, factor * U)


def _limit_in_words(limit: Stated | None, factor: float) -> str:
    if isinstance(limit, tuple):
        low, high = ("" if side is None else numbers.plain_number(factor * side) for side in limit)
        return f"{low} … {high}"
    return "" if limit is None else numbers.plain_number(factor * limit)


def _parameter_table(found: Comparison) -> str:
    """Return every parameter in every run, their mean and drift."""
    model = found.calibrations[0].model
    runs = [str(i) for i in range(1, len(found.files) + 1)]
    per, factor = ("day", DAY) if found.per == "time" else ("run", 1.0)
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
    test = worded_test(found.test, found.statistic, found.dof_total, found.p_total)
    return f"{verdict}: {test}"


def comparison_sentence(found: Comparison | RegressionComparison) -> str:
    """Return whether runs agree and what has moved."""
    said = _of_terms(found) if isinstance(found, RegressionComparison) else _agreement(found)
    return f"Not fit for use: {said}" if errors_of(found.findings) else said


def _of_terms(found: RegressionComparison) -> str:
    """Return whether regressions agree."""
    tested = [term.p for term in found.terms if not math.isnan(term.p)]
    smallest = f"; smallest p of a term {numbers.chance(min(tested))}" if tested else ""
    return f"{len(found.files)} regressions {_verb(found.consistent)}{smallest}."


def _verb(consistent: bool) -> str:
    return "agree" if consistent else "do not agree"


def _agreement(found: Comparison) -> str:
    """Return whether calibrations agree, first with last and all together."""
    given = "" if math.isnan(found.p_total) else f" ({numbers.p_in_words(found.p_total)})"
    together = f"{len(found.calibrations)} calibrations {_verb(found.consistent)}{given}"
    largest = found.largest
    if largest is None:
        return f"{together}; moved: {', '.join(found.moved)}." if found.moved else f"{together}."
    agree = sum(each.En <= 1.0 for each in found.changes)
    said = (
        f"{agree} of {len(found.changes)} parameters agree with the first calibration's within U "
        f"(largest E_n {numbers.plain_number(largest.En)}, {largest.name}, "
        f"{numbers.p_in_words(found.largest_p)} of any)."
    )
    limited = [each for each in found.changes if each.within is not None]
    if limited:
        beyond = [each.name for each in limited if not each.within]
        said += f" {len(limited) - len(beyond)} of {len(limited)} are within their limits"
        said += f"; beyond: {', '.join(beyond)}." if beyond else "."
        due = min((each.due for each in limited if each.due), default=None)
        said += f" Next calibration due {due}." if due else ""
    return said if found.consistent else f"{said} Together {together}."

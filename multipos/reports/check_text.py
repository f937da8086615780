"""What checks say: as tables of text, as plain text, and in a sentence.

`check_tables` gives the tables, of all positions, and `check_text` prints
them with the verdict; `run_conclusions` judges the run as a whole, and `check_sentence` says the
largest error against its limit.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.files import numbers
from multipos.numerics.arrays import Array
from multipos.reports.sections import LONG_TABLE, PageTable, shortened
from multipos.verification.consistency import worded_test
from multipos.verification.verdicts import VERDICTS, Check, worst


def check_tables(found: Check) -> list[PageTable]:
    """Return the summary and the errors of all positions; or by segment."""
    found = _beyond_rounding(found)
    if found.segments:
        return [_by_segment(found)]
    return [_by_axis(found), _by_position(found)]


def _beyond_rounding(found: Check) -> Check:
    """Return the check with 0 for errors and U that are rounding."""
    scale = max(1.0, float(np.nanmax(np.abs(found.reference), initial=0.0)))

    def shown(errors: Array) -> Array:
        cells = [numbers.beyond_rounding(error, scale) for error in errors.ravel().tolist()]
        return np.array(cells).reshape(errors.shape)

    return replace(found, before=shown(found.before), after=shown(found.after), U=shown(found.U))


def _by_axis(found: Check) -> PageTable:
    scales = _scales(found)
    header = (
        "axis",
        *_headers(scales, "max", "rms"),
        "linearity before [%]",
        "after [%]",
        f"largest U [{scales['after'][1]}]",
        "verdict",
    )
    rows = []
    for axis in (*found.axes, None) if len(found.axes) > 1 else found.axes:
        s = found.summary(axis)
        linear = [numbers.plain_number(s[when]["linearity_percent"], 2) for when in scales]
        rows.append(
            (
                axis or "all",
                *_scaled(s, scales),
                *linear,
                _longest(s, scales),
                s["verdict"] or "-",
            )
        )
    return PageTable("Errors before and after compensation", header, tuple(rows))


_Scales = dict[str, tuple[float, str]]


def _scales(found: Check) -> _Scales:
    """Return factor and unit of errors before, and of errors and U after."""
    sizes = {"before": np.abs(found.before), "after": np.maximum(np.abs(found.after), found.U)}
    largest = {
        when: float(np.max(size[found.counted & np.isfinite(size)], initial=0.0))
        for when, size in sizes.items()
    }
    return {when: numbers.readable_unit(size, found.unit) for when, size in largest.items()}


def _headers(scales: _Scales, *words: str) -> list[str]:
    return [_united(f"{word} {when}", scales[when][1]) for word in words for when in scales]


def _united(word: str, unit: str) -> str:
    return f"{word} [{unit}]" if unit else word


def _scaled(summary: dict[str, Any], scales: _Scales) -> list[str]:
    """Return largest and rms error before and after, in their units."""
    return [
        numbers.plain_number(summary[when][key] * factor)
        for key in ("maximum", "rms")
        for when, (factor, _) in scales.items()
    ]


def _longest(summary: dict[str, Any], scales: _Scales) -> str:
    return numbers.plain_number(summary["after"]["largest_U"] * scales["after"][0], 2)


def _by_position(found: Check) -> PageTable:
    scales = _scales(found)
    (before, unit), (after, unit_after) = scales["before"], scales["after"]
    header = ["position"]
    for axis in found.axes:
        header += [_united(axis, numbers.readable_unit(1.0, found.unit)[1]), f"before [{unit}]"]
        header += [f"after [{unit_after}]", "U"]
    rows = []
    for row, position in enumerate(found.positions):
        cells = [position]
        for column in np.arange(len(found.axes)):
            cells += [f"{found.reference[row, column]:.6g}"]
            cells += [_signed(before * found.before[row, column])]
            error, U = after * found.after[row, column], after * found.U[row, column]
            cells += _error_cells(error, U)
        rows.append((*cells, worst(found.verdicts[row]) or "-"))
    sizes = np.abs(found.after).max(axis=1).tolist()
    kept = tuple(numbers.largest_rows(sizes, LONG_TABLE))
    return PageTable("Every position", (*header, "verdict"), tuple(rows), kept=kept)


def _by_segment(found: Check) -> PageTable:
    """Return the summary of a regression's check: one row for each segment that has rows."""
    scales = _scales(found)
    header = (
        "segment",
        "rows",
        *_headers(scales, "max", "rms"),
        _united("largest U", scales["after"][1]),
        "verdict",
    )
    rows = []
    for name in (*(n for n, inside in found.segments.items() if inside.any()), None):
        s = found.summary(segment=name)
        counted = found.counted[:, 0] if name is None else found.counted[found.segments[name], 0]
        known = np.isfinite(s["after"]["largest_U"])
        rows.append(
            (
                name or "all",
                str(int(counted.sum())),
                *_scaled(s, scales),
                _longest(s, scales) if known else "-",
                s["verdict"] or "-",
            )
        )
    return PageTable("Errors before and after correction", header, tuple(rows))


def check_text(found: Check) -> str:
    """Return the check as plain text."""
    tables = (shortened(each, "JSON has all") for each in check_tables(found))
    text = "\n".join(numbers.titled(each.caption, str(each)) for each in tables)
    if found.limit is None:
        return text
    counted = ", ".join(f"{int((found.verdicts == name).sum())} {name}" for name in VERDICTS)
    return (
        f"{text}\n{found.verdict} against {numbers.in_unit(found.limit, found.unit)} with U "
        f"({100 * found.confidence:g} %) as guard band: {counted}\n"
    )


def run_conclusions(found: Check) -> list[str]:
    """Return the verdict of a run as a whole, and whether it agrees with the calibration."""
    said = []
    if found.limit is not None:
        said.append(
            f"the run as a whole: {found.run_verdict}; it fails where an error is beyond the limit "
            f"by more than the U of all {int(found.counted.sum())} together"
        )
    whole = found.consistency
    if whole is not None and np.isfinite(whole.statistic):
        agrees = "consistent" if whole.p >= 1.0 - found.confidence else "NOT consistent"
        largest = found.summary()["after"]["largest_En"]
        test = worded_test(whole.test, whole.statistic, whole.dof, whole.p)
        said.append(f"{agrees} with the calibration: {test}; largest En {largest:.2f}")
    return said


def _signed(value: float) -> str:
    return "-" if np.isnan(value) else ("+" if value > 0.0 else "") + numbers.plain_number(value)


def _error_cells(error: float, U: float) -> tuple[str, str]:
    """Return an error and its U to the same digits: U upright is a hundred times that at level."""
    decimals = numbers.decimals_of(U)
    if decimals is None or not np.isfinite(error):
        return _signed(error), numbers.plain_number(U, 2)
    return numbers.fixed(error, decimals, signed=True), f"{U:.{decimals}f}"


def check_sentence(found: Check) -> str:
    """Return pass, fail or indeterminate, with the largest error, its U and the limit."""
    errors = np.where(found.counted & np.isfinite(found.after), np.abs(found.after), -1.0)
    row, column = np.unravel_index(int(np.argmax(errors)), errors.shape)
    error, U = float(errors[row, column]), float(found.U[row, column])
    if error < 0.0:
        return "Fail: the calibration gives no value at any position."
    largest = f"largest error {numbers.in_unit(error, found.unit)}"
    if math.isfinite(U):
        largest += f" (U {numbers.in_unit(U, found.unit)})"
    where = f" at position {found.positions[row]}"
    if found.limit is None:
        whole = found.consistency
        agrees = ""
        if whole is not None and math.isfinite(whole.p):
            word = "agrees" if whole.p >= 1.0 - found.confidence else "disagrees"
            agrees = f"; the run {word} with the calibration ({numbers.p_in_words(whole.p)})"
        rms = found.summary()["after"]["rms"]
        return f"Errors of {numbers.in_unit(rms, found.unit)} rms, {largest}{where}{agrees}."
    limit = numbers.in_unit(found.limit, found.unit)
    open_ = int(np.sum(found.verdicts == "indeterminate"))
    if found.verdict == "indeterminate":
        many = f"{open_} of {int(found.counted.sum())} errors"
        return f"Indeterminate: {largest}{where}; with U, {many} may exceed the limit of {limit}."
    verdict = "Pass" if found.verdict == "pass" else "Fail"
    return f"{verdict}: {largest}{where} against a limit of {limit}."

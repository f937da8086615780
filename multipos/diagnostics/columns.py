"""Findings that the columns raise by themselves, whatever was fitted.

`dead_output`, `counter_column`, `saturated` and `quantized` find outputs that a sensor does not
give, `repeated_rows` copies of rows, and `temperature_kelvin` a temperature that looks like kelvin.

A dead output stands still, to the last digit, while its own axis turned from one side of the
horizon to the other. A sensor at rest scatters and quantises, but over an own reference that spans
more than half a g it does not repeat one number.

A counter rises by the same step from row to row, again to the last digit.

A saturated output repeats its largest (or smallest) reading at positions where the fit to its
other readings is beyond it. Where too few others are left, outputs that all end at the same number
say the same: it is a limit, and not gravity, that made them.

Repeated rows have all outputs equal to the last digit, and an output has so many digits that
noise would have shown in them: copies, not repeats. At different positions they are stale.

A temperature in kelvin: all of it between 200 and 400, where a temperature in degrees Celsius at
which a sensor is calibrated stays below that.
"""

import math

import numpy as np

from multipos.diagnostics.repairs import listed_reference
from multipos.files.spelling import listed, quoted
from multipos.finding import Finding
from multipos.numerics import arrays
from multipos.sensor.calibration import Calibration

_SPAN = 0.5  # of the own reference [g], below which an output may well stand still
_KELVIN = (200.0, 400.0)
_COUNTED = 5  # rows that make a counter
_SHORT = 0.01  # of the signal, by which a saturated reading falls short at least
_ENDS = 4  # equal ends of outputs that make a limit
_BY_CHANCE = 1e-6
_MEDIAN = 0.6745  # of the size of a normal error with standard deviation one
_BEYOND = 4.0  # standard deviations, and steps, that a saturated reading falls short


def dead_output(c: Calibration) -> Finding | None:
    """Find outputs that gave one number while gravity moved along their axis."""
    still = (np.ptp(c.readings.values, axis=0) == 0.0).tolist()
    if not any(still):
        return None
    dead = [
        output
        for output, axis, stands in zip(c.outputs, c.model.axes, still, strict=True)
        if stands and np.ptp(c.reference[:, arrays.COMPONENTS.index(axis)]) > _SPAN
    ]
    if not dead:
        return None
    return Finding(
        "dead-output",
        "error",
        f"{quoted(dead)} has the same reading at all {len(c.readings)} positions",
        "Check the wiring and the column, or omit the output with --outputs.",
        outputs=tuple(dead),
    )


def temperature_kelvin(c: Calibration) -> Finding | None:
    """Find a temperature that the model uses and that looks like kelvin."""
    column = c.readings.environment.get("temperature")
    if column is None or "temperature" not in c.model.environment:
        return None
    low, high = float(column.min()), float(column.max())
    if not _KELVIN[0] <= low <= high <= _KELVIN[1]:
        return None
    return Finding(
        "temperature-kelvin",
        "warning",
        (
            f"temperatures of {low:g} to {high:g} look like kelvin; "
            "coefficients are per degree Celsius, and the bias is that at 0"
        ),
        "Subtract 273.15 from the column.",
    )


def counter_column(c: Calibration) -> Finding | None:
    """Find outputs that only count the rows."""
    values = c.readings.values
    if len(values) < _COUNTED:
        return None
    first, second, third = values[:3].tolist()
    counters = []
    for i, output in enumerate(c.outputs):
        step = second[i] - first[i]
        least = 1e-9 * abs(step)
        if step == 0.0 or abs(third[i] - second[i] - step) > least:
            continue  # as nearly always: the rest need not be looked at
        if float(np.abs(np.diff(values[:, i]) - step).max()) > least:
            continue
        if float(np.abs(c.residuals[:, i]).max()) > 1e3 * least:  # else the positions are a spiral
            counters.append(output)
    if not counters:
        return None
    return Finding(
        "counter-column",
        "error",
        (
            f"{quoted(counters)} increases by one step from row to row: a counter or a clock, not "
            "an output"
        ),
        "Name the outputs with --outputs.",
        outputs=tuple(counters),
    )


def saturated(c: Calibration) -> Finding | None:
    """Find outputs that ran into the end of their range."""
    values = c.readings.values
    top, bottom = values.max(axis=0), values.min(axis=0)
    again = [
        np.count_nonzero((values == top) | (values == bottom)) - 2 * len(top),
        len(top) - len(set(top.tolist())),
        len(bottom) - len(set(bottom.tolist())),
    ]
    if not any(again):
        return None  # no number ends a range twice
    reference = listed_reference(c)
    rows: dict[str, None] = {}
    outputs: dict[str, None] = {}
    for i, output in enumerate(c.outputs):
        for sign in (1.0, -1.0):
            clipped = None if reference is None else _clipped(reference, sign * values[:, i])
            if clipped is not None:
                outputs[output] = None
                rows.update(dict.fromkeys(c.readings.labels[row] for row in clipped.tolist()))
    if not outputs and _has_common_ends(c):
        outputs = dict.fromkeys(c.outputs)
    if not outputs:
        return None
    named = quoted(list(outputs))
    where = f" at position {', '.join(list(rows)[:12])}" if rows else ""
    return Finding(
        "saturated",
        "error",
        (f"{named} is saturated{where}: readings stop at one value where larger ones are expected"),
        "Measure again in a wider range, or omit these positions.",
        rows=tuple(rows),
        outputs=tuple(outputs),
    )


def _clipped(reference: arrays.Array, values: arrays.Array) -> arrays.Places | None:
    """Return the rows whose reading is the largest of all and should have been larger."""
    top = values == values.max()
    others = ~top
    design = np.column_stack([np.ones(len(values)), reference])
    if top.sum() < 2 or np.linalg.matrix_rank(design[others], tol=1e-6) < design.shape[1]:
        return None
    if len(np.unique(values[others])) <= design.shape[1] + 1:
        return None  # so coarse that ties are ordinary
    found, square, *_ = np.linalg.lstsq(design[others], values[others], rcond=None)
    dof = int(others.sum()) - design.shape[1]
    if dof < 1:
        return None
    s = math.sqrt(max(float(square[0]) if len(square) else 0.0, 0.0) / dof)
    steps = np.diff(np.unique(values))
    short = design[top] @ found - values.max()
    least = _BEYOND * (s + float(steps.min()))
    signal = float(np.linalg.norm(found[1:]))
    if short.max() > max(least, _SHORT * signal) and short.min() > -least:
        return np.flatnonzero(top)
    return None


def _has_common_ends(c: Calibration) -> bool:
    """Tell whether outputs end at the same numbers more often than by chance.

    By chance an end is that of another output, both adjusted alike, about once in 4 s/q times, s
    the scatter of the readings and q their resolution.
    """
    values = c.readings.values
    top, bottom = values.max(axis=0), values.min(axis=0)
    again = int(np.sum(top == top.max()) + np.sum(bottom == bottom.min())) - 2
    scatter = float(np.nanmax(c.residual_sd, initial=0.0))
    if again < _ENDS - 2 or not scatter > 0.0:
        return False
    return (arrays.resolution(values) / (4.0 * scatter)) ** again < _BY_CHANCE


def quantized(c: Calibration) -> Finding | None:
    """Find readings on a grid coarser than what they scatter, a converter's or that of doubles."""
    if c.readings.samples is not None or not np.isfinite(c.residual_sd).all():
        return None
    steps = arrays.coarse_steps(c.readings.values, c.residual_sd)
    coarse = [output for output, step in zip(c.outputs, steps.tolist(), strict=True) if step]
    if not coarse:
        return None
    if (steps <= arrays.computed_steps(c.readings.values)).all():
        text = (
            f"readings lie on the model to {c.residual_sd.max():.1e} {c.model.unit}, the rounding "
        )
        text += "of computed numbers; U is no smaller than that rounding"
        action = "Check that these are readings of a sensor, not values of a model."
        return Finding("computed-readings", "note", text, action, outputs=tuple(coarse))
    return Finding(
        "quantized",
        "note",
        f"readings have a resolution of {steps.max():.3g} {c.model.unit}, coarser than their "
        "noise; u includes resolution/sqrt(12)",
        "Record more digits, or average readings that vary.",
        outputs=tuple(coarse),
    )


def repeated_rows(c: Calibration) -> Finding | None:
    """Find rows that are copies of others."""
    if arrays.count_different(c.readings.values) == len(c.readings):
        return None
    first: dict[bytes, int] = {}
    copies: list[tuple[int, int]] = []
    for row, key in enumerate(arrays.row_keys(c.readings.values)):
        origin = first.setdefault(key, row)
        if origin != row:
            copies.append((origin, row))
    if not _shows_noise(c):
        return None
    labels = c.readings.labels
    reference = listed_reference(c)
    stale = [
        f"{labels[row]} and {labels[origin]}"
        for origin, row in copies
        if reference is not None and float(np.abs(reference[row] - reference[origin]).max()) > 1e-6
    ]
    text = (
        f"positions {listed(stale, 6)} have identical readings although they differ: one was not "
        "measured anew"
        if stale
        else f"{len(copies)} of {len(labels)} rows are exact copies of others; U is too small"
    )
    action = "Measure them again, or omit one." if stale else "Remove the copies."
    rows = dict.fromkeys(labels[row] for pair in copies for row in pair)
    return Finding("repeated-rows", "warning", text, action, rows=tuple(rows))


def _shows_noise(c: Calibration) -> bool:
    """Tell whether readings have digits enough for noise to show in repeats."""
    n, outputs = c.readings.values.shape
    left = max(1.0 - len(c.parameters) / outputs / n, 1e-3)
    scatter = float(arrays.median(np.abs(c.residuals))) / (_MEDIAN * math.sqrt(left))
    return arrays.resolution(c.readings.values) < scatter / 2.0

"""Regressions as a C99 file, and the rows of its self-test.

`correction_of` checks what is exported, `write_correction` writes it (`multipos.exports.
c_correction`); `generated_rows` makes rows, and `expected_rows` says what Python makes of them: the
other side of the C file.

Columns that rates are of swing over their range, once slow and once as fast as their rates were
seen; all others are spread evenly, both a twentieth beyond the range. There is a gap in time, and
the run starts again.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.compensation.added_columns import Application
from multipos.compensation.correction import read_predictors
from multipos.errors import MultiposError, UsageError
from multipos.exports.c_correction import correction_source, declarations, rounding
from multipos.exports.c_text import fill
from multipos.exports.parts import Correction
from multipos.exports.target import Exported
from multipos.exports.target_c import array, require_identifier
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Table
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.regression.prediction import hold_inside, place_rows, predict_clamped
from multipos.regression.rates import filter_time
from multipos.regression.regression import Regression
from multipos.results import frozen
from multipos.sensor.calibration import Calibration

_BEYOND = 0.05  # of a range, on both sides
_CLOSE = {False: 1e-12, True: 1e-5}  # of the largest value, by single precision


@frozen
class Drive:
    """Rows that are replayed.

    Attributes
    ----------
    run : (n,) array of int
        A new number begins a new run.
    time : (n,) array
    values : (n, V) array
        The inputs of the correction.
    """

    run: Places
    time: Array
    values: Array

    @cached_property
    def begins(self) -> Mask:
        """Whether a row is the first of its run."""
        return np.concatenate(([True], np.diff(self.run) != 0))

    def rounded(self) -> "Drive":
        """Return the rows as single precision holds them."""
        return Drive(self.run, self.time, self.values.astype(np.float32).astype(np.float64))


class Expected(NamedTuple):
    """What Python makes of rows.

    `certain` leaves out rows where a column meets an edge, a limit or the turn from heating to
    cooling to its last digits, so that rounding decides what comes next.
    """

    out: Array  # (n, K)
    beyond: Mask
    certain: Mask


def expected_rows(c: Correction, drive: Drive, *, single: bool) -> Expected:
    """Return what Python makes of rows."""
    columns = dict(zip(c.inputs, drive.values.T, strict=True))
    n = len(drive.time)
    beyond = np.zeros(n, dtype=bool)
    if c.calibration is not None:
        table = Table("the rows", columns, rows=n)
        added = Application(c.calibration, False, None, "clamp", None).columns(table)
        beyond |= np.asarray(added["outside"]).astype(bool)
        columns |= {name: added[name] for name in c.forces}
    out = np.empty((n, len(c.regressions)))
    certain = np.ones(n, dtype=bool)
    for k, r in enumerate(c.regressions):
        # A column of the log would stand for a rate; C forms it, so here it is formed as well.
        given = {name: columns[name] for name in columns if name not in r.rates}
        time = {} if r.time is None else {r.time: drive.time}
        table = Table("the rows", {**given, **time}, rows=n)
        predictors = read_predictors(r, table, drive.run)
        predicted, outside = predict_clamped(r, predictors, n, drive.run)
        beyond |= outside
        certain &= _certain(r, predictors, n, drive.run, _CLOSE[single])
        out[:, k] = columns[c.corrected[k]] - predicted if c.corrected else predicted
    return Expected(out, beyond, certain)


def _certain(
    r: Regression, columns: Mapping[str, Array], n: int, run: Places, close: float
) -> Mask:
    """Tell which rows keep segment and limits where columns are off by a share of their size."""
    found = []
    for off in (-close, 0.0, close):
        moved = {name: x + off * np.abs(x).max(initial=0.0) for name, x in columns.items()}
        place = place_rows(r, moved, n, run)
        found.append(np.stack([place, hold_inside(r, moved, place)[0]]))
    return np.asarray(np.ptp(found, axis=0).max(axis=0) == 0)


# --- rows that are made up


def generated_rows(c: Correction, count: int) -> Drive:
    """Return rows over all that was fitted, and a little beyond."""
    rng = np.random.default_rng(0)
    windows = [window for _, window in c.rates]
    step = min(windows) / 20.0 if windows else 1.0
    time = step * np.arange(float(count))
    time[count // 3 :] += 100.0 * step  # a gap
    run = (np.arange(count) >= count // 2).astype(np.intp)
    time[run == 1] -= time[count // 2]  # its clock starts again
    sources = {name for name, _ in c.rates}
    columns = []
    times = {r.time for r in c.regressions}
    for name in c.inputs:
        low, high = _range(c, name)
        if name in times:  # a drift, by the clock itself
            columns.append(time)
            continue
        wide = _BEYOND * (high - low) or 1.0
        if name in sources:
            columns.append(_swing(low - wide, high + wide, _fastest(c, name) * step, count))
        else:
            columns.append(rng.uniform(low - wide, high + wide, count))
    return Drive(run, time, np.column_stack(columns))


def _swing(low: float, high: float, fastest: float, count: int) -> Array:
    """Return a swing from low to high: the first half slow, the second at the fastest step."""
    half = (high - low) / 2.0
    slow = 2.0 * np.pi * 3.0 / count
    fast = fastest / half if fastest > 0.0 else slow
    phase = np.cumsum(np.where(np.arange(count) % (count // 2) < count // 4, slow, fast))
    return np.asarray((low + high) / 2.0 + half * np.sin(phase))


def _fastest(c: Correction, name: str) -> float:
    """Return a rate a little above the largest that the rows of the fit had."""
    rate = f"{name}_rate"
    seen = [s.limits[rate] for r in c.regressions for s in r.segments if rate in s.limits]
    return (1.0 + _BEYOND) * max((max(map(abs, pair)) for pair in seen), default=0.0)


def _range(c: Correction, name: str) -> tuple[float, float]:
    """Return what a column covered, as far as the files tell."""
    pairs: list[tuple[float, float]] = []
    for r in c.regressions:
        pairs += [s.limits[name] for s in r.segments if name in s.limits]
        pairs += [s.range for s in r.segments if name == r.segment_variable]
    if c.calibration is not None:
        readings = c.calibration.readings
        seen = {n: readings.environment[n] for n in c.calibration.model.environment}
        seen |= zip(c.calibration.outputs, readings.values.T, strict=True)
        pairs += [(float(seen[n].min()), float(seen[n].max())) for n in (name,) if n in seen]
    if not pairs:
        return -1.0, 1.0
    return min(low for low, _ in pairs), max(high for _, high in pairs)


_TESTED = 60  # rows of the self-test
_SAME = 1e-12  # of the largest output, beside what rounding may do


def correction_of(
    calibration: Calibration | None, regressions: Sequence[Regression], correct: Names | None
) -> Correction:
    """Return what is exported, checked.

    Raises
    ------
    MultiposError
        A regression needs rows that come later, or none has an input.
    UsageError
        `correct` names more or fewer columns than there are regressions.
    """
    columns = () if correct is None else split_names(correct, "--correct")
    if columns and len(columns) != len(regressions):
        raise UsageError(
            f"--correct names {len(columns)} columns for {len(regressions)} regressions; name the "
            "column that each corrects, in their order."
        )
    for r in regressions:
        later = [name for name in r.needed if name in r.rates]
        if later and not r.causal:
            raise MultiposError(
                f"the regression of '{r.response}' has '{later[0]}' from rows before and after "
                "each, which a device does not have; fit it again with --causal."
            )
    found = Correction(calibration, tuple(regressions), columns)
    if not found.inputs:
        raise MultiposError(
            f"the regression of '{regressions[0].response}' is a constant, a function of no input; "
            "subtract it as it stands, or name the column with --correct."
        )
    return found


def write_correction(c: Correction, name: str, *, single: bool) -> Exported:
    """Return the C file and its self-test.

    Raises
    ------
    MultiposError
        A number is beyond the precision.
    UsageError
        `name` is no C identifier.
    """
    require_identifier(name)
    text = correction_source(c, name, single=single)
    return Exported("c", text, _self_test(c, name, single))


def _self_test(c: Correction, name: str, single: bool) -> str:
    drive = generated_rows(c, _TESTED)
    drive = drive.rounded() if single else drive
    out, beyond, certain = expected_rows(c, drive, single=single)
    codes = np.where(certain, beyond.astype(int), -1)
    state, start, correct = declarations(c, name, single=single)
    allowed = _allowed(c, drive, out, single)
    literals = [f"{value!r}f" if single else repr(value) for value in map(_plain, allowed)]
    return fill(
        "test_correction.c",
        name=name,
        state=state,
        start=start,
        correct=correct,
        count=len(drive.time),
        outputs=out.shape[1],
        begins=", ".join(map(str, drive.begins.astype(int).tolist())),
        codes=", ".join(map(str, codes.tolist())),
        at=", ".join(map(repr, drive.time.tolist())),
        arrays="\n".join(
            array(key, values, single) for key, values in (("in", drive.values), ("expected", out))
        ),
        kind="float" if single else "double",
        tolerance=", ".join(literals),
    )


def _plain(value: float) -> float:
    """Return a tolerance to the digits that matter."""
    return float(f"{value:.3e}")


def _allowed(c: Correction, drive: Drive, out: Array, single: bool) -> Array:
    """Return how far C may be from Python in each output (K,), by rounding."""
    steps = np.diff(drive.time)[~drive.begins[1:]]
    pace = float(median(steps)) if len(steps) else 1.0
    windows = [window for _, window in c.rates]
    longest = filter_time(max(windows)) / pace if windows else 0.0
    found = np.empty(len(c.regressions))
    for k, r in enumerate(c.regressions):
        found[k] = rounding(r, single=single, steps=longest)
        size = float(np.abs(out[:, k]).max())
        if c.corrected:
            # what comes in is as large as what goes out and what is taken from it
            found[k] += (2.0**-23 if single else 2.0**-52) * size
        found[k] += 0.0 if single else _SAME * size
    if c.calibration is not None:
        found += 5e-7 if single else 1e-9
    return found

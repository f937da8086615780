"""Regressions as a C99 file, see `multipos.exports.c_correction`, and its replay.

As with the C of a calibration, the file is written again from what it came from, and it is the text
of this program that is compiled and run, on rows in the order of time, run after run.

Rows for a correction, and what Python makes of them: the other side of the C file.

The rows are those that a regression was fitted to, or made up: the columns that rates are of swing
over their range, once slow and once as fast as their rates were seen; all others are spread evenly,
both a twentieth beyond the range. The segment variable meets every edge, and the number just below
it; there is a gap in time, and the run starts again.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multipos.compensation.applying import add_columns
from multipos.compensation.correction import read_predictors
from multipos.errors import MultiposError, UsageError
from multipos.exports.c_body import environment_range
from multipos.exports.c_correction import correction_source, declarations, output_line, rounding
from multipos.exports.c_running import compile_and_run, fill
from multipos.exports.parts import Correction
from multipos.exports.target import Exported, GivenFile, in_a_sentence
from multipos.exports.target_c import array, comment, is_foreign, require_identifier
from multipos.files.numbers import number, table
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Source, Table, read_table
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import LARGEST, Array, Mask, Places, median
from multipos.regression.observations import number_labels
from multipos.regression.prediction import clear_of_limits, predict_clamped
from multipos.regression.rates import filter_time
from multipos.regression.regression import Regression, require_same_data
from multipos.results import Result, frozen, plain_dict
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

    `certain` leaves out rows where a rate or a force that is computed meets an edge, a limit or the
    turn from heating to cooling to its last digits, so that rounding decides what comes next.
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
        added = add_columns(c.calibration, table, tilt=False, uncertainty=None, outside="clamp")
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
        certain &= _certain(c, r, predictors, _CLOSE[single])
        certain &= clear_of_limits(r, predictors, n, drive.run, _CLOSE[single])
        out[:, k] = columns[c.corrected[k]] - predicted if c.corrected else predicted
    return Expected(out, beyond, certain)


def _certain(c: Correction, r: Regression, columns: Mapping[str, Array], close: float) -> Mask:
    """Tell which rows are clear of every value at which something changes."""
    certain = np.ones(len(next(iter(columns.values()))) if columns else 1, dtype=bool)
    for name in (name for name in columns if name in r.rates or name in c.forces):
        turns = [0.0] if name == r.branch_column else []
        turns += r.edges if name == r.segment_variable else ()
        for s in r.segments:
            turns += s.limits.get(name, ())
        values = columns[name]
        scale = close * float(np.abs(values).max(initial=0.0))
        for turn in turns:
            certain &= np.abs(values - turn) > scale
    return certain


# --- rows of the fit


def fitted_rows(c: Correction, table: Table) -> Drive:
    """Return the rows of a table that are complete, run by run.

    Raises
    ------
    MultiposError
        A column is missing.
    """
    times = _named(r.time for r in c.regressions)
    runs = _named(r.run for r in c.regressions)
    if len(times) > 1 or len(runs) > 1:
        raise MultiposError(
            f"the regressions have different time or run columns ({', '.join(times + runs)}), so "
            "one row is not one step of both; leave out --data."
        )
    for name in (*c.inputs, *times, *runs):
        if name not in table:
            raise MultiposError(
                f"{table.source}: no column '{name}', which the C function needs; leave out "
                "--data to replay rows that are made up."
            )
    values = np.column_stack([table.number(name, empty=True, largest=LARGEST) for name in c.inputs])
    time = table.number(times[0], empty=True) if times else np.arange(float(table.rows))
    run = number_labels(np.array(table.text(runs[0]))) if runs else np.zeros(table.rows, np.intp)
    complete = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(time))
    if not len(complete):
        raise MultiposError(f"{table.source}: every row has an empty cell; nothing is replayed.")
    rows = complete[np.argsort(run[complete], kind="stable")]
    return Drive(run[rows], time[rows], values[rows])


def _named(columns: Iterable[str | None]) -> list[str]:
    """Return the columns that are named, each once."""
    return list(dict.fromkeys(name for name in columns if name is not None))


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
    values = np.column_stack(columns)
    _meet_edges(c, values)
    return Drive(run, time, values)


def _meet_edges(c: Correction, values: Array) -> None:
    """Put every edge of an input, and the number just below, into rows that would be near it."""
    for r in c.regressions:
        if r.segment_variable not in c.inputs:
            continue
        column = values[:, c.inputs.index(r.segment_variable)]
        for edge in r.edges:
            nearest = np.argsort(np.abs(column - edge), kind="stable")[:2]
            column[nearest] = edge, np.nextafter(edge, -np.inf)


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
    pairs = [pair for r in c.regressions for pair in _fitted(r, name)]
    if c.calibration is not None:
        pairs += _calibrated(c.calibration, name)
    if not pairs:
        return -1.0, 1.0
    return min(low for low, _ in pairs), max(high for _, high in pairs)


def _fitted(r: Regression, name: str) -> list[tuple[float, float]]:
    """Return what a column covered in each segment of a regression."""
    limits = [s.limits[name] for s in r.segments if name in s.limits]
    return limits + [s.range for s in r.segments if name == r.segment_variable]


def _calibrated(c: Calibration, name: str) -> list[tuple[float, float]]:
    """Return what a column covered at calibration."""
    if name in c.model.environment:
        return [environment_range(c, name)]
    if name not in c.outputs:
        return []
    seen = c.readings.values[:, c.outputs.index(name)]
    return [(float(seen.min()), float(seen.max()))]


SIGNATURE = re.compile(
    r"^int (?P<name>[A-Za-z_]\w*)_correct\((?P=name)_state \*state, double time, "
    r"const (?P<type>double|float) in\[",
    re.MULTILINE | re.ASCII,
)
_TESTED = 60  # rows of the self-test
_REPLAYED = 20_000  # rows that are made up
_SAME = 1e-12  # of the largest output, beside what rounding may do


@frozen
class Replay(Result):
    """What an exported correction made of rows, against what Python makes of them.

    Attributes
    ----------
    target : str
    outputs : tuple of K str
        What each output is, as the file's header says it.
    rows, outside : int
        Rows that were replayed, and those of them beyond what was fitted.
    data : str or None
        The file they came from; None where they were made up.
    difference, allowed : (K,) arrays
        Largest difference from Python, in the unit of each response, and what rounding allows.
    foreign : bool
        Whether C was run that is not what `export` writes of these regressions.
    findings : tuple of Finding
        An error where C and Python differ.
    """

    target: str
    outputs: tuple[str, ...]
    rows: int
    outside: int
    data: str | None
    difference: Array
    allowed: Array
    foreign: bool = False
    findings: Findings = ()

    @property
    def _by_output(self) -> list[tuple[str, float, float]]:
        """Each output with its largest difference and what rounding allows."""
        sizes = self.difference.tolist(), self.allowed.tolist()
        return list(zip(self.outputs, *sizes, strict=True))

    @property
    def sentence(self) -> str:
        """Whether the file holds, and the largest difference."""
        largest = float(self.difference.max())
        return in_a_sentence(self.target, self.findings, largest, f"over {self.rows} rows")

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry."""
        return plain_dict(
            {
                "target": self.target,
                "rows": self.rows,
                "outside": self.outside,
                "data": self.data,
                "outputs": [
                    {"output": name, "difference": difference, "allowed": allowed}
                    for name, difference, allowed in self._by_output
                ],
                "difference": self.difference.max(),
                "foreign": self.foreign,
                "findings": self.findings,
            }
        )

    def __str__(self) -> str:
        what = "made up over all that was fitted: every segment, edge, and a gap in time"
        header = ["output", "largest difference", "allowed"]
        rows = [[name, *(number(size, 2) for size in sizes)] for name, *sizes in self._by_output]
        lines = [
            f"What the C function ({self.target}) makes of {self.rows} rows, and multipos apply:",
            f"rows {what if self.data is None else 'of ' + self.data}; {self.outside} beyond",
            "",
            table(header, rows),
        ]
        if self.foreign:
            lines.append("the file is not what export writes of these; it was run as is")
        return "\n".join(lines) + "\n"


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


# --- reading back


def replay(
    file: GivenFile,
    calibration: Calibration | None,
    regressions: Sequence[Regression],
    data: Source | None,
) -> Replay:
    """Compile the file and hold it to what Python makes of the same rows.

    Raises
    ------
    MultiposError
        The file is not of these regressions, or makes something else of the rows; or the data are
        not those of the fit.
    """
    found = SIGNATURE.search(file.text)
    if found is None:
        raise MultiposError(
            f"{file.path}: holds no C of a regression; give it with the calibration alone."
        )
    name, single = found["name"], found["type"] == "float"
    c = correction_of(calibration, regressions, _corrected(file.text, regressions))
    foreign = is_foreign(file, correction_source(c, name, single=single))
    source, drive = None, generated_rows(c, _REPLAYED)
    if data is not None:
        given = read_table(data, what="data")
        for each in c.regressions:
            require_same_data(each, given.source, given.sha256)
        source, drive = given.source, fitted_rows(c, given)
    drive = drive.rounded() if single else drive
    out, beyond, certain = expected_rows(c, drive, single=single)
    back = _run(file.path, file.raw, c, name, single, drive)
    allowed = _allowed(c, drive, out, single)
    difference = np.abs(back[:, 1:] - out)[certain].max(axis=0, initial=0.0)
    codes = int((back[:, 0] != beyond)[certain].sum())
    return Replay(
        target="c, single precision" if single else "c",
        outputs=tuple(output_line(c, k).partition(" = ")[2] for k in range(len(c.regressions))),
        rows=len(drive.time),
        outside=int(beyond.sum()),
        data=source,
        difference=difference,
        allowed=allowed,
        foreign=foreign,
        findings=_find_difference(file.path, difference, allowed, codes),
    )


def _corrected(text: str, regressions: Sequence[Regression]) -> tuple[str, ...] | None:
    """Return the columns that a file says it corrects."""
    found = []
    for k, r in enumerate(regressions):
        end = re.escape(comment(f", corrected by {r.response}"))
        line = re.search(rf"^ \* out\[{k}\] = (.*){end}$", text, re.MULTILINE)
        if line is None:
            return None
        found.append(line[1])
    return tuple(found)


def _find_difference(path: str, difference: Array, allowed: Array, codes: int) -> Findings:
    if not codes and (difference <= allowed).all():
        return ()
    k = int(np.argmax(difference / allowed))
    what = (
        f"{codes} rows return another code"
        if codes
        else f"output {k} differs by {difference[k]:.2g} where rounding allows {allowed[k]:.2g}"
    )
    text = f"{Path(path).name}: {what}; it was exported from another regression, or changed since"
    return (Finding("export-differs", "error", text, "Export again."),)


def _run(path: str, text: bytes, c: Correction, name: str, single: bool, drive: Drive) -> Array:
    state, start, correct = declarations(c, name, single=single)
    rows = np.column_stack([drive.begins.astype(float), drive.time, drive.values])
    main = fill(
        "run_correction.c",
        name=name,
        state=state,
        start=start,
        correct=correct,
        kind="float" if single else "double",
        columns=rows.shape[1],
        inputs=len(c.inputs),
        outputs=len(c.regressions),
    )
    return compile_and_run(path, text, main, rows, len(c.regressions) + 1)

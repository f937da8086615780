"""Apply a calibration to a table of raw readings: every column kept, force added.

Beside the columns that came in stand ``f_x``, ``f_y``, ``f_z`` [g] for the axes that the sensor
has, in the calibration's convention, on request their standard uncertainties ``u_f_x`` … from the
covariance of the parameters and, beyond ±1 g, the third-order term that the budget allows, and
``outside``: 1 where a reading lies beyond what was calibrated, that is where |f| exceeds the
largest reference or a column of the model leaves the range of the calibration's readings, 0
elsewhere.

With tilt the sensor is taken to be at rest (`multipos.sensor.tilt`): ``tilt_x_deg`` … are the
angles of its axes above the horizon, and one axis that it does not have follows from |f| = g with
that axis up. More outputs than axes leave a parity: ``parity`` and ``fault``
(`multipos.sensor.parity`).

A table in memory is done at once (`apply`), a file piece by piece (`apply_log`), so that a log may
be of any length.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError, UsageError
from multipos.files.tables import Column, Source, Table, format_csv, read_table
from multipos.logs.opening import read_log
from multipos.logs.table import Log, Piece
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.terms import COMPONENTS, largest_value
from multipos.results import Columns
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensed_axes
from multipos.sensor.parity import FAULT_LEVEL, parity
from multipos.sensor.tilt import at_rest, reading_noise, tilt_at_rest
from multipos.uncertainty.validity import force_covariance

Outside = Literal["flag", "clamp", "refuse"]
OUTSIDE: tuple[Outside, ...] = get_args(Outside)
# Noise and placement make |f| of a sensor at rest differ from 1 g; only more than this is outside.
_MARGIN = 0.01
_MARGIN_RMS = 4.0


class Applied(Columns):
    """A table with the compensated force beside its columns.

    Force is in g, NaN where no force explains the reading.
    """

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"rows": n, "columns": {name: […]}}`` as what JSON can carry."""
        return {"rows": len(self["outside"]), **super().to_dict()}


def apply(
    calibration: Calibration,
    data: Source,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    outside: Outside = "flag",
) -> Applied:
    """Return the columns of a table with the compensated force beside them.

    Parameters
    ----------
    calibration : Calibration
    data : path, mapping of columns, or data frame
        Must have the calibration's outputs, and the columns its model uses.
    tilt : bool
        Add ``tilt_x_deg`` …, the angle of each axis above the horizon, for a sensor at rest.
    uncertainty : bool
        Add ``u_f_x`` … [g], and with tilt ``u_tilt_x_deg`` …, the noise of a reading included.
    outside : str
        'flag' rows beyond what was calibrated, 'clamp' the model's other columns (such as
        temperature) to the calibrated range as well, or 'refuse' the table.

    Returns
    -------
    Applied

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.
    TypeError
        `calibration` is something else: for a regression `multipos.correct` does this.
    """
    if not isinstance(calibration, Calibration):
        raise TypeError(
            f"`calibration` must be a Calibration, got {type(calibration).__name__}; for a "
            "regression call `multipos.correct`."
        )
    check_outside(outside)
    table = read_table(data, what="data")
    _check_columns(calibration, table.source, table.columns, tilt, uncertainty)
    added = add_columns(calibration, table, tilt=tilt, uncertainty=uncertainty, outside=outside)
    if outside == "refuse" and added["outside"].any():
        where = table.where(int(np.argmax(added["outside"])), calibration.outputs[0])
        raise _refusal(where, int(added["outside"].sum()), table.rows)
    kept = {name: copy(column) for name, column in table.columns.items()}  # the caller's own stay
    return Applied({**kept, **added})


@dataclass
class AppliedLog:
    """A log with the compensated force beside its columns, as CSV text that comes in pieces.

    Attributes
    ----------
    calibration : Calibration
    log : Log
    tilt, uncertainty, outside
        As for `apply`.
    progress : callable or None
        Is told how much of the log has been read, 0 to 1.
    rows, beyond : int
        Rows done so far, and those of them beyond what was calibrated.
    """

    calibration: Calibration
    log: Log
    tilt: bool = False
    uncertainty: bool = False
    outside: Outside = "flag"
    progress: Callable[[float], object] | None = None
    rows: int = 0
    beyond: int = 0

    def __iter__(self) -> Iterator[str]:
        """Yield header and rows; under 'refuse' the error comes when all rows have been seen."""
        carried = () if self.log.text else self.log.numeric  # rows of text are written as they are
        header = self.log.header if self.log.text else self.log.numeric
        begun = False
        for piece, added in self._applied(carried):
            if not begun:
                yield format_csv(dict.fromkeys((*header, *added), ()), self._delimiter)
            begun = True
            if not self.beyond or self.outside != "refuse":
                yield self._text(piece, added)

    def columns(self) -> dict[str, Column]:
        """Return all columns at once; what is added to them is computed piece by piece."""
        found: dict[str, list[Array]] = {}
        for _, added in self._applied(()):
            for name, column in added.items():
                found.setdefault(name, []).append(column)
        return {
            **read_log(self.log),
            **{name: np.concatenate(all_) for name, all_ in found.items()},
        }

    def _applied(self, carried: Sequence[str]) -> Iterator[tuple[Piece, dict[str, Array]]]:
        """Yield pieces with what is added to them; under 'refuse' the error comes at the end."""
        self.rows = self.beyond = 0
        first = None
        for piece in self.log.read(self._needed, carried):
            added = add_columns(
                self.calibration,
                piece.table,
                tilt=self.tilt,
                uncertainty=self.uncertainty,
                outside=self.outside,
            )
            beyond = added["outside"].astype(bool)
            if first is None and beyond.any():
                first = piece.table.where(int(np.argmax(beyond)), self.calibration.outputs[0])
            self.rows += piece.table.rows
            self.beyond += int(beyond.sum())
            yield piece, added
            if self.progress is not None:
                self.progress(piece.done)
        if first is not None and self.outside == "refuse":
            raise _refusal(first, self.beyond, self.rows)

    @property
    def _needed(self) -> tuple[str, ...]:
        return (*self.calibration.outputs, *self.calibration.model.environment)

    @property
    def _delimiter(self) -> str:
        return self.log.delimiter or ","

    def _text(self, piece: Piece, added: Mapping[str, Array]) -> str:
        if piece.lines is None:
            columns = {name: piece.table.columns[name] for name in self.log.numeric}
            return format_csv({**columns, **added}).partition("\n")[2]
        lines = piece.lines
        if not self.log.delimiter:
            lines = [",".join(line.split()) for line in lines]
        beside = format_csv(added, self._delimiter).partition("\n")[2].split("\n")
        rows = zip(lines, beside, strict=False)  # the last line break leaves one more, empty
        return "".join([f"{line}{self._delimiter}{cells}\n" for line, cells in rows])


def apply_log(
    calibration: Calibration,
    log: Log,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    outside: Outside = "flag",
    progress: Callable[[float], object] | None = None,
) -> AppliedLog:
    """Return a log with the compensated force beside its columns, to be written piece by piece.

    Raises
    ------
    MultiposError
        A column is missing. Bad cells and refused rows are found when the pieces are read.
    """
    check_outside(outside)
    _check_columns(calibration, log.source, log.columns, tilt, uncertainty)
    return AppliedLog(calibration, log, tilt, uncertainty, outside, progress)


def add_columns(
    calibration: Calibration, table: Table, *, tilt: bool, uncertainty: bool, outside: Outside
) -> dict[str, Array]:
    """Return the columns that a table gets, each row from itself alone, in order."""
    raw = np.column_stack([table.number(name, largest=LARGEST) for name in calibration.outputs])
    terms = [term for _, term in calibration.model.keys]
    environment = {
        name: table.number(name, largest=largest_value(terms, name))
        for name in calibration.model.environment
    }
    beyond, clamped = _environment_outside(calibration, table, environment)
    if outside == "clamp":
        environment = clamped
    axes = list(sensed_axes(calibration.model))
    tilts: dict[str, Array] = {}
    if tilt:
        rest = at_rest(calibration, raw, environment)
        force, found = rest[:, axes], tilt_at_rest(calibration, rest, environment)
        beyond |= np.isnan(found.tilt).any(axis=1)
        tilts = _by_axis("tilt_{}_deg", axes, np.degrees(found.tilt))
        if uncertainty:
            tilts |= _by_axis("u_tilt_{}_deg", axes, np.degrees(found.u))
    else:
        force = calibration.compensate(raw, environment)
    beyond |= _force_outside(calibration, force)
    added = _by_axis("f_{}", axes, force)
    if uncertainty:
        covariance = force_covariance(calibration, force, environment)
        added |= _by_axis("u_f_{}", axes, np.sqrt(np.einsum("nkk->nk", covariance)))
    added |= tilts
    if len(calibration.outputs) > len(axes):
        odd = parity(calibration, raw, force, environment, reading_noise(calibration))
        added["parity"] = odd.size
        added["fault"] = (odd.p < FAULT_LEVEL).astype(np.int64)
    return {**added, "outside": beyond.astype(np.int64)}


def _by_axis(name: str, axes: Sequence[int], values: Array) -> dict[str, Array]:
    """Return values (n, K) as columns named after their axes."""
    return {name.format(COMPONENTS[i]): values[:, column] for column, i in enumerate(axes)}


def check_outside(outside: str) -> None:
    """Refuse a way with rows outside that is none."""
    if outside not in OUTSIDE:
        raise UsageError(f"--outside takes {', '.join(OUTSIDE)}, got '{outside}'.")


def _check_columns(
    calibration: Calibration,
    source: str,
    columns: Mapping[str, Column] | tuple[str, ...],
    tilt: bool,
    uncertainty: bool,
) -> None:
    for name in (*calibration.outputs, *calibration.model.environment):
        if name not in columns:
            raise MultiposError(
                f"{source}: no column '{name}', which this calibration needs; "
                f"the columns are {', '.join(columns)}."
            )
    # What one reading gets, every reading gets.
    one = {name: calibration.readings.values[:1, i] for i, name in enumerate(calibration.outputs)}
    one |= {n: calibration.readings.environment[n][:1] for n in calibration.model.environment}
    added = add_columns(
        calibration, Table(source, one, rows=1), tilt=tilt, uncertainty=uncertainty, outside="flag"
    )
    for name in added:
        if name in columns:
            raise MultiposError(
                f"{source}: column '{name}' is there already; rename it, apply writes it."
            )


def _refusal(where: str, beyond: int, rows: int) -> MultiposError:
    return MultiposError(
        f"{where}: the reading is outside what was calibrated ({beyond} of {rows} rows are); "
        "use --outside flag to see them."
    )


def _force_outside(calibration: Calibration, force: Array) -> NDArray[np.bool_]:
    size = np.sqrt(np.einsum("ni,ni->n", force, force))
    largest = float(np.linalg.norm(calibration.reference, axis=1).max())
    limit = largest * (1.0 + _MARGIN) + _MARGIN_RMS * calibration.rms
    result: NDArray[np.bool_] = ~(size <= limit)  # NaN is outside
    return result


def _environment_outside(
    calibration: Calibration, table: Table, environment: Mapping[str, Array]
) -> tuple[NDArray[np.bool_], dict[str, Array]]:
    """Return which rows leave the calibrated range of a column, and the columns clamped to it."""
    beyond = np.zeros(table.rows, dtype=bool)
    clamped = {}
    for name, column in environment.items():
        seen = calibration.readings.environment[name]
        low, high = float(seen.min()), float(seen.max())
        beyond |= (column < low) | (column > high)
        clamped[name] = np.clip(column, low, high)
    return beyond, clamped

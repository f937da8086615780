"""Apply a calibration to a log: every column kept, force added, as CSV text that comes in pieces.

`apply_log` returns an `AppliedLog`, whose added columns are those of a table
(`multipos.compensation.added_columns`); a log may be of any length, for it is read, computed and
written piece by piece. `digits_written` returns to how many digits added columns are written.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.added_columns import (
    Outside,
    add_columns,
    check_beside,
    check_columns,
    check_outside,
    find_turn,
    found_applying,
    place_outside,
    refusal,
    wanted_columns,
)
from multipos.compensation.reading_noise import ReadingUncertainty, asked_uncertainty
from multipos.files import tables
from multipos.finding import Findings
from multipos.logs.opening import read_log
from multipos.logs.table import Log, Piece, called_as
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_DIGITS = 4  # of an uncertainty in text


@dataclass
class AppliedLog:
    """A log with the compensated force beside its columns, as CSV text that comes in pieces.

    Attributes
    ----------
    calibration : Calibration
    log : Log
    tilt, outside
        As for `apply`.
    uncertainty : ReadingUncertainty or None
        Of the force, where it is asked for.
    progress : callable or None
        Called with how much of the log has been read, 0 to 1.
    rows, beyond : int
        Rows done so far, and those of them beyond what was calibrated.
    samples : tuple of Finding
        What is wrong with the uncertainties, as the first piece shows it.
    """

    calibration: Calibration
    log: Log
    tilt: bool = False
    uncertainty: ReadingUncertainty | None = None
    outside: Outside = "flag"
    progress: Callable[[float], object] | None = None
    rows: int = 0
    beyond: int = 0
    samples: Findings = ()
    beside: Calibration | None = None

    @property
    def noise(self) -> str | None:
        """Which noise of one reading the uncertainties hold; None where there are none."""
        return None if self.uncertainty is None else self.uncertainty.noise.text

    @property
    def findings(self) -> Findings:
        """What was found about force and its uncertainties, of the rows done so far."""
        wanted = self.uncertainty
        of_noise = () if wanted is None else (*wanted.held, *self.samples)
        of_noise = (*of_noise, *find_turn(self.calibration, self.beside))
        return found_applying(self.calibration, of_noise, self.beyond, self.rows)

    def __iter__(self) -> Iterator[str]:
        """Yield header and rows; under 'refuse' the error comes when all rows have been seen."""
        carried = () if self.log.text else self.log.numeric  # rows of text are written as they are
        header = self.log.header if self.log.text else self.log.numeric
        begun = False
        for piece, added in self._applied(carried):
            if not begun:
                yield tables.format_csv(dict.fromkeys((*header, *added), ()), self._delimiter)
            begun = True
            if not self.beyond or self.outside != "refuse":
                yield self._text(piece, added)

    def parts(self) -> Iterator[dict[str, tables.Column]]:
        """Yield all columns piece by piece."""
        texts = [name for name in self.log.columns if name not in self.log.numeric]
        for piece, added in self._applied(self.log.numeric, texts):
            yield {**{name: piece.table.columns[name] for name in self.log.columns}, **added}

    def columns(self) -> dict[str, tables.Column]:
        """Return all columns at once; what is added to them is computed piece by piece."""
        found: dict[str, list[Array]] = {}
        for _, added in self._applied(()):
            for name, column in added.items():
                found.setdefault(name, []).append(column)
        return {
            **read_log(self.log),
            **{name: np.concatenate(all_) for name, all_ in found.items()},
        }

    def _applied(
        self, carried: Sequence[str], texts: Sequence[str] = ()
    ) -> Iterator[tuple[Piece, dict[str, Array]]]:
        """Yield pieces with what is added to them; under 'refuse' the error comes at the end."""
        self.rows = self.beyond = 0
        first = None
        for piece in self.log.read(self._needed, carried, texts):
            if self.uncertainty is not None and self.rows == 0:
                self.samples = self.uncertainty.find_samples(piece.table, self.log.columns)
            added = add_columns(
                self.calibration,
                piece.table,
                tilt=self.tilt,
                uncertainty=self.uncertainty,
                outside=self.outside,
                beside=self.beside,
            )
            beyond = added["outside"].astype(bool)
            if first is None and beyond.any():
                first = place_outside(self.calibration, piece.table, int(np.argmax(beyond)))
            self.rows += piece.table.rows
            self.beyond += int(beyond.sum())
            yield piece, added
            if self.progress is not None:
                self.progress(piece.done)
        if first is not None and self.outside == "refuse":
            raise refusal(first, self.beyond, self.rows)

    @property
    def _needed(self) -> tuple[str, ...]:
        needed = [*self.calibration.outputs, *self.calibration.model.environment]
        needed += () if self.uncertainty is None else self.uncertainty.noise.columns
        if self.beside is not None:
            needed += [*self.beside.outputs, *self.beside.model.environment]
        return tuple(dict.fromkeys(needed))

    @property
    def _delimiter(self) -> str:
        return self.log.delimiter or ","

    def _text(self, piece: Piece, added: Mapping[str, Array]) -> str:
        if piece.lines is None:
            columns = {name: piece.table.columns[name] for name in self.log.numeric}
            return tables.format_rows({**columns, **added}, digits=digits_written(added))
        lines = piece.lines()
        if not self.log.delimiter:
            lines = [",".join(line.split()) for line in lines]
        lines = tables.safe_rows(lines, self._delimiter)
        text = tables.format_rows(added, self._delimiter, digits_written(added))
        beside = text.splitlines(keepends=True)
        mark = repeat(self._delimiter)
        return "".join(chain.from_iterable(zip(lines, mark, beside, strict=False)))


def digits_written(added: Iterable[str]) -> dict[str, int]:
    """Return the significant digits of uncertainties in CSV; other numbers keep all of theirs."""
    return {name: _DIGITS for name in added if name.startswith(("u_", "U_"))}


def apply_log(
    calibration: Calibration,
    log: Log,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
    outside: Outside = "flag",
    beside: Calibration | None = None,
    progress: Callable[[float], object] | None = None,
) -> AppliedLog:
    """Return a log with the compensated force beside its columns, to be written piece by piece.

    Raises
    ------
    MultiposError
        A column is missing. Bad cells and refused rows are found when the pieces are read.
    """
    check_outside(outside)
    check_beside(calibration, beside, tilt)
    asked = wanted_columns(calibration)
    log = called_as(log, asked if beside is None else (*asked, *wanted_columns(beside)))
    wanted = asked_uncertainty(
        calibration, log.source, log.columns, uncertainty, reading_sd, parameters_only
    )
    check_columns(calibration, log.source, log.columns, tilt, wanted, log.units, beside)
    return AppliedLog(calibration, log, tilt, wanted, outside, progress, beside=beside)

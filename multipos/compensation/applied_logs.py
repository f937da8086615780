"""Apply a calibration to a log: every column kept, force added, as CSV text that comes in pieces.

What is added is that of a table (`multipos.compensation.added_columns`); a log may be of any
length, for it is read, computed and written piece by piece.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.added_columns import (
    Outside,
    add_columns,
    check_columns,
    check_outside,
    refusal,
)
from multipos.compensation.reading_noise import ReadingUncertainty, asked_uncertainty
from multipos.doubts.model_error import said_of_hidden
from multipos.files.tables import Column, format_csv
from multipos.logs.opening import read_log
from multipos.logs.table import Log, Piece
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration


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
        Is told how much of the log has been read, 0 to 1.
    rows, beyond : int
        Rows done so far, and those of them beyond what was calibrated.
    cautions : tuple of str
        What is doubtful in the uncertainties, as the first piece shows it.
    """

    calibration: Calibration
    log: Log
    tilt: bool = False
    uncertainty: ReadingUncertainty | None = None
    outside: Outside = "flag"
    progress: Callable[[float], object] | None = None
    rows: int = 0
    beyond: int = 0
    cautions: tuple[str, ...] = ()

    @property
    def noise(self) -> str | None:
        """Which noise of one reading the uncertainties hold; None where there are none."""
        return None if self.uncertainty is None else self.uncertainty.noise.text

    @property
    def warnings(self) -> tuple[str, ...]:
        """What there is to say of the force and its uncertainties, of the rows done so far."""
        hidden = said_of_hidden(self.calibration)
        if self.uncertainty is None:
            return hidden
        return (*hidden, *self.uncertainty.said, *self.cautions)

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
            if self.uncertainty is not None and self.rows == 0:
                self.cautions = self.uncertainty.cautions(piece.table, self.log.columns)
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
            raise refusal(first, self.beyond, self.rows)

    @property
    def _needed(self) -> tuple[str, ...]:
        beside = () if self.uncertainty is None else self.uncertainty.noise.columns
        return (*self.calibration.outputs, *self.calibration.model.environment, *beside)

    @property
    def _delimiter(self) -> str:
        return self.log.delimiter or ","

    def _text(self, piece: Piece, added: Mapping[str, Array]) -> str:
        if piece.lines is None:
            columns = {name: piece.table.columns[name] for name in self.log.numeric}
            return format_csv({**columns, **added}).partition("\n")[2]
        lines = piece.lines()
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
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
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
    wanted = asked_uncertainty(
        calibration, log.source, log.columns, uncertainty, reading_sd, parameters_only
    )
    check_columns(calibration, log.source, log.columns, tilt, wanted, log.units)
    return AppliedLog(calibration, log, tilt, wanted, outside, progress)

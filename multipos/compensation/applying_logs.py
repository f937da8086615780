"""Apply a calibration to a log: every column kept, force added, as CSV text that comes in pieces.

`apply_log` returns an `AppliedLog`, whose added columns are those of a table
(`multipos.compensation.added_columns`); a log may be of any length, for it is read, computed and
written piece by piece. `digits_written` returns to how many digits added columns are written.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Any

import numpy as np

from multipos.compensation.added_columns import Application, prepare, refusal, wanted_columns
from multipos.files import tables
from multipos.finding import Findings
from multipos.logs.opening import joined
from multipos.logs.table import Log, Piece, called_as
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration

_DIGITS = 4  # of an uncertainty in text


@dataclass
class AppliedLog:
    """A log with the compensated force beside its columns, as CSV text that comes in pieces.

    Attributes
    ----------
    application : Application
        What every piece gets.
    log : Log
    progress : callable or None
        Called with how much of the log has been read, 0 to 1.
    rows, beyond : int
        Rows done so far, and those of them beyond what was calibrated.
    samples : tuple of Finding
        What is wrong with the uncertainties, as the first piece shows it.
    """

    application: Application
    log: Log
    progress: Callable[[float], object] | None = None
    rows: int = 0
    beyond: int = 0
    samples: Findings = ()

    @property
    def noise(self) -> str | None:
        """Which noise of one reading the uncertainties hold; None where there are none."""
        return self.application.noise

    @property
    def findings(self) -> Findings:
        """What was found about force and its uncertainties, of the rows done so far."""
        return self.application.findings(self.samples, self.beyond, self.rows)

    def __iter__(self) -> Iterator[str]:
        """Yield header and rows; under 'refuse' the error comes when all rows have been seen."""
        carried = () if self.log.text else self.log.numeric  # rows of text are written as they are
        header = self.log.header if self.log.text else self.log.numeric
        begun = False
        for piece, added in self._applied(carried):
            if not begun:
                yield tables.format_csv(dict.fromkeys((*header, *added), ()), self._delimiter)
            begun = True
            if not self.beyond or self.application.outside != "refuse":
                yield self._text(piece, added)

    def parts(self) -> Iterator[dict[str, tables.Column]]:
        """Yield all columns piece by piece."""
        texts = [name for name in self.log.columns if name not in self.log.numeric]
        for piece, added in self._applied(self.log.numeric, texts):
            yield {**{name: piece.table.columns[name] for name in self.log.columns}, **added}

    def columns(self) -> dict[str, tables.Column]:
        """Return all columns at once; what is added to them is computed piece by piece."""
        parts = list(self.parts())
        return {name: joined([part[name] for part in parts]) for name in parts[0]} if parts else {}

    def _applied(
        self, carried: Sequence[str], texts: Sequence[str] = ()
    ) -> Iterator[tuple[Piece, dict[str, Array]]]:
        """Yield pieces with what is added to them; under 'refuse' the error comes at the end."""
        self.rows = self.beyond = 0
        asked, first = self.application, None
        for piece in self.log.read(self._needed, carried, texts):
            if self.rows == 0:
                self.samples = asked.samples(piece.table, self.log.columns)
            added = asked.columns(piece.table)
            beyond = added["outside"].astype(bool)
            if first is None and beyond.any():
                first = asked.place(piece.table, int(np.argmax(beyond)))
            self.rows += piece.table.rows
            self.beyond += int(beyond.sum())
            yield piece, added
            if self.progress is not None:
                self.progress(piece.done)
        if first is not None and asked.outside == "refuse":
            raise refusal(first, self.beyond, self.rows)

    @property
    def _needed(self) -> tuple[str, ...]:
        asked = self.application
        needed: list[str] = []
        for each in filter(None, (asked.calibration, asked.beside)):
            needed += [*each.outputs, *each.model.environment]
        needed += () if asked.uncertainty is None else asked.uncertainty.noise.columns
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


def apply_log(calibration: Calibration, log: Log, **options: Any) -> AppliedLog:
    """Return a log with the compensated force beside its columns, to be written piece by piece.

    Parameters
    ----------
    calibration : Calibration
    log : Log
    **options
        Of `multipos.apply`.

    Raises
    ------
    MultiposError
        A column is missing. Bad cells and refused rows are found when the pieces are read.
    """
    log = called_as(log, wanted_columns(calibration, options.get("beside")))
    return AppliedLog(prepare(calibration, log.source, log.columns, log.units, **options), log)

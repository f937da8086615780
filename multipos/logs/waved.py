"""Logs of a magnetometer that was turned about by hand: its rows as they are.

`read_rows` reads all rows, `moves` and `holds_most` tell whether there are rests to take instead;
`waved` returns the log of the rows that are `worth_keeping`, `find_cut_off` names outputs that end.

A magnetometer is not put down in positions but waved through all directions, and every row is a
reading of the field in some direction. `read_rows` returns them all, `moves` and `holds_most` tell
whether rests are taken instead, as where nine or more hold most of the log, and `waved` makes
readings of the rows. How noise is correlated from row to row is for the fit, which takes them in
the order of time (`multipos.estimation.correlated_rows`).
"""

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import quoted
from multipos.files.tables import Column
from multipos.finding import Finding, Findings
from multipos.logs.averages import Averages
from multipos.logs.samples import Samples, Timing
from multipos.logs.table import Log
from multipos.numerics.arrays import COMPONENTS, Array, median
from multipos.positions.readings import Readings
from multipos.results import Result, frozen, plain_dict

_FEWEST = 12  # rows
_BLOCK = 25  # rows, that stand still or not
_STILL = 8.0  # standard deviations of a row, over which a block moves
_MOST = 0.5  # of the rows, that rests hold where they are taken
_RESTS = 9
_CUT = 4  # rows in a run at the end of a range


@frozen
class Waved(Result):
    """The rows of a waved log.

    Attributes
    ----------
    source : str
    outputs : tuple of str
    rows : int
        Of the log.
    readings : Readings
        Labelled by their number in the log, from 1.
    findings : tuple of Finding
    unit : str or None
    """

    source: str = field(compare=False)
    outputs: tuple[str, ...]
    rows: int
    readings: Readings
    findings: Findings
    unit: str | None = None
    scheme_up: None = None

    @property
    def seen(self) -> str:
        """What was taken of the log, in a sentence."""
        return f"Outputs are {', '.join(self.outputs)}; {self.rows} rows as they are."

    def columns(self) -> dict[str, Column]:
        """Return the columns of a readings file."""
        return self.readings.columns()

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry."""
        content = {
            "source": self.source,
            "outputs": self.outputs,
            "rows": self.rows,
            "kept": self.readings.labels,
            "rests": (),
            "findings": self.findings,
        }
        return plain_dict(content)

    def __str__(self) -> str:
        return f"{self.source}: {len(self.readings)} of {self.rows} rows, as they are\n"


def read_rows(
    logs: Sequence[Log], outputs: tuple[str, ...], *, signed: int | None, drop_bad: bool
) -> tuple[Array, dict[str, Array]]:
    """Return all rows (n, M) of the outputs, and a column of the temperature where all have one.

    Raises
    ------
    MultiposError
        Rows of several sensors take turns, too few are left, or one is no number of a sensor.
    """
    warm = [name for name in ("temperature",) if all(name in log.numeric for log in logs)]
    parts: list[Array] = []
    for log in logs:
        timing = Timing(rate=1.0)  # no time is needed
        with Samples(
            log, outputs, timing, signed=signed, drop_bad=drop_bad, as_they_are=True
        ) as samples:
            samples.survey(None)
            columns = (*outputs, *samples.others)
            kept = [columns.index(name) for name in (*outputs, *warm)]
            parts += [piece[kept] for _, piece in samples.pieces()]
    data = np.concatenate(parts, axis=1)
    values, environment = data[: len(outputs)].T, dict(zip(warm, data[len(outputs) :], strict=True))
    if len(values) < _FEWEST:
        raise MultiposError(
            f"{logs[0].source}: {len(values)} rows, and a magnetometer that is waved takes "
            f"{_FEWEST} or more in all directions; record it longer."
        )
    return values, environment


def moves(values: Array) -> bool:
    """Tell whether most of a log (n, M) is in motion, so that its rests need not be looked for."""
    count = len(values) // _BLOCK
    if count < 2:
        return True
    bends = np.diff(values, 2, axis=0)
    sd = median(np.abs(bends), axis=0) / (0.6745 * np.sqrt(6.0))
    blocks = values[: count * _BLOCK].reshape(count, _BLOCK, -1)
    still = (np.ptp(blocks, axis=1) <= _STILL * np.maximum(sd, 1e-300)).all(axis=1)
    return float(still.mean()) < _MOST


def holds_most(found: Averages, rows: int) -> bool:
    """Tell whether rests are many enough, and hold most of the rows of the log."""
    held = sum(rest.rows.end - rest.rows.start for rest in found.rests)
    return len(found.rests) >= _RESTS and held > _MOST * rows


def waved(
    logs: Sequence[Log], outputs: tuple[str, ...], values: Array, environment: dict[str, Array]
) -> Waved:
    """Return the rows (n, 3) of a waved log as readings.

    Raises
    ------
    MultiposError
        Fewer than three outputs; of two that are turned level it names bias and scale factors.
    """
    source = logs[0].source
    if values.shape[1] < len(COMPONENTS):
        ends = zip(outputs, values.min(axis=0), values.max(axis=0), strict=True)
        shown = ", ".join(f"{n} {(a + b) / 2:.4g} and {(b - a) / 2:.4g}" for n, a, b in ends)
        raise MultiposError(
            f"{source}: a waved magnetometer is calibrated with three outputs; turned level, "
            f"middle and half range are {shown}, which are bias and scale factor times the level "
            "field if it made whole turns: record the third output too, in all directions."
        )
    said = f"{len(values)} rows are taken as they are, each a direction of its own"
    findings = [Finding("waved", "note", said), *find_cut_off(outputs, values)]
    units = {log.units.get(name) for log in logs for name in outputs}
    readings = Readings(
        values=values,
        outputs=outputs,
        positions=tuple(map(str, range(1, len(values) + 1))),
        environment=environment,
        source=source,
    )
    for log in logs:
        findings += log.left_out
    unit = units.pop() if len(units) == 1 else None
    return Waved(source, outputs, len(values), readings, tuple(findings), unit)


def find_cut_off(outputs: tuple[str, ...], values: Array) -> list[Finding]:
    """Find outputs that stay at one end of their range for several rows while others move."""
    cut = []
    for i, output in enumerate(outputs):
        for end in (values[:, i].max(), values[:, i].min()):
            at = values[:, i] == end
            runs = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(np.int8), [0]])))
            starts, ends = runs[::2], runs[1::2]
            longest = int(np.argmax(ends - starts))
            rows = slice(int(starts[longest]), int(ends[longest]))
            others = np.delete(values[rows], i, axis=1)
            if rows.stop - rows.start >= _CUT and (np.ptp(others, axis=0) > 0.0).all():
                cut.append((output, rows.start + 1, rows.stop))
                break
    if not cut:
        return []
    listed = ", ".join(f"{first} to {last}" for _, first, last in cut)
    text = f"readings of {quoted([output for output, _, _ in cut])} are saturated in rows {listed}"
    action = "Record again in a wider range, or farther from iron."
    names = tuple(output for output, _, _ in cut)
    return [Finding("saturated", "error", text, action, outputs=names)]

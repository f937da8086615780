"""Logs of a magnetometer that was turned about by hand: rows as they are, and those worth keeping.

`read_rows` reads all rows, `moves` and `holds_most` tell whether there are rests to take instead;
`waved` returns the log of the rows that are `worth_keeping`, `find_cut_off` names outputs that end.

A magnetometer is not put down in positions but waved through all directions, and every row is a
reading of the field in some direction. Slow noise e of the sensor, r (·) its correlation, makes the
misfits m = u'e of rows a lag apart have the mean

    E m_t m_t+k = s² r(k) u_t·u_t+k,                                                        (1)

which the sums over all t, divided by those of (u_t·u_t+k)², tell of the misfits to the ellipsoid
through all rows by least squares. Rows are kept as far apart as r takes to fall to a tenth, even in
time and no more than `_KEPT`; where the sensor stood, in a square of a cube's faces, no more than
`_OVER` times what is usual. What is left of correlation is for the fit, which takes rows in the
order of time (`multipos.estimation.correlated_rows`).

Rests are taken instead where nine or more hold most of the log.
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
from multipos.logs.ellipsoids import off_the_ellipsoid
from multipos.logs.table import Log
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array, Places, median
from multipos.positions.readings import Readings
from multipos.results import Result, frozen, plain_dict

_KEPT = 600  # rows that a fit is made of
_LEAST = 60  # rows that are kept whatever their correlation
_FORGOTTEN = 0.1  # correlation of rows that are as good as independent
_OVER = 4.0
_SQUARES = 4  # along an edge of a face of the cube
_FEWEST = 12  # rows
_BLOCK = 25  # rows, that stand still or not
_STILL = 8.0  # standard deviations of a row, over which a block moves
_MOST = 0.5  # of the rows, that rests hold where they are taken
_RESTS = 9
_CUT = 4  # rows in a run at the end of a range


@frozen
class Waved(Result):
    """The rows of a waved log that are worth keeping.

    Attributes
    ----------
    source : str
    outputs : tuple of str
    rows : int
        Of the log.
    readings : Readings
        Rows kept, labelled by their number in the log, from 1.
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
        for piece in log.read(() if drop_bad else outputs, outputs if drop_bad else (), ()):
            columns = [np.asarray(piece.table.columns[n], dtype=np.float64) for n in outputs]
            parts.append(np.column_stack(columns))
    values = np.concatenate(parts) if parts else np.empty((0, len(outputs)))
    if signed is not None:
        half = 2.0 ** (signed - 1)
        values = np.where(values >= half, values - 2.0 * half, values)
    far = (np.abs(values) > LARGEST) & np.isfinite(values)
    if far.any():
        row, column = np.argwhere(far)[0].tolist()
        raise MultiposError(
            f"{logs[0].source}: row {row + 1}, column '{outputs[column]}': "
            f"{values[row, column]:g} is no number that is measured (beyond {LARGEST:g} in any "
            "unit); correct it."
        )
    environment = {}
    for name in warm:
        pieces = [p.table.columns[name] for log in logs for p in log.read((), (name,), ())]
        column = np.concatenate([np.asarray(p, dtype=np.float64) for p in pieces])
        environment[name] = np.where(np.abs(column) <= LARGEST, column, np.nan)
    good = np.isfinite(values).all(axis=1)
    values, environment = values[good], {n: c[good] for n, c in environment.items()}
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
    """Return the rows (n, 3) of a waved log that are worth keeping."""
    source = logs[0].source
    rows, stride = worth_keeping(values)
    said = "rows are taken as they are, each a direction of its own"
    if len(rows) < len(values):
        said = f"{len(rows)} of {len(values)} rows are kept, even over directions and time"
    findings = [Finding("waved", "note", said), *find_cut_off(outputs, values)]
    if _LEAST * stride > len(values) > _LEAST:
        text = f"noise is correlated over {stride} rows, so that U of {len(values)} is too small"
        action = f"Record {_LEAST * stride} rows or more."
        findings.append(Finding("time-correlated", "warning", text, action))
    units = {log.units.get(name) for log in logs for name in outputs}
    readings = Readings(
        values=values[rows],
        outputs=outputs,
        positions=tuple(str(row + 1) for row in rows.tolist()),
        environment={name: column[rows] for name, column in environment.items()},
        source=source,
    )
    for log in logs:
        findings += log.left_out
    unit = units.pop() if len(units) == 1 else None
    return Waved(source, outputs, len(values), readings, tuple(findings), unit)


def worth_keeping(values: Array) -> tuple[Places, int]:
    """Return the rows (k,) of readings (n, 3) that are kept, in order, and the stride."""
    n = len(values)
    if values.shape[1] != len(COMPONENTS):
        return np.linspace(0, n - 1, min(n, _KEPT)).astype(np.intp), 1
    misfit, away = off_the_ellipsoid(values)
    stride = _stride(misfit, away)
    count = min(n, _KEPT, max(n // stride, _LEAST))
    rows = ((np.arange(count) + 0.5) * n / count).astype(np.intp)
    square = _squares_of(away[rows])
    sizes = np.bincount(square)
    usual = float(median(sizes[sizes > 0].astype(np.float64)))
    cap = max(int(_OVER * usual), _FEWEST)
    order = np.argsort(square, kind="stable")
    kept = []
    for own in np.split(order, np.cumsum(sizes)[:-1]):
        even = ((np.arange(cap) + 0.5) * len(own) / cap).astype(np.intp)
        kept.append(own[even] if len(own) > cap else own)
    return rows[np.sort(np.concatenate(kept))], stride


def _stride(misfit: Array, along: Array) -> int:
    """Return the least number of rows after which noise is forgotten, by eq. (1)."""
    n, lag = len(misfit), 1
    whole = float(misfit @ misfit) / n
    if not whole > 0.0:
        return 1
    while lag < n // 4:
        parallel = np.einsum("ni,ni->n", along[:-lag], along[lag:])
        found = float(np.sum(misfit[:-lag] * misfit[lag:] * parallel))
        if found < _FORGOTTEN * whole * float(parallel @ parallel):
            return lag
        lag = max(lag + 1, round(1.25 * lag))
    return lag


def _squares_of(along: Array) -> Places:
    """Return in which square of a cube's faces directions (n, 3) are."""
    largest = np.abs(along).argmax(axis=1)
    rows = np.arange(len(along))
    size = np.where(along[rows, largest] == 0.0, 1.0, along[rows, largest])
    face = 2 * largest + (size > 0.0)
    beside = np.stack([along[rows, (largest + k) % 3] / np.abs(size) for k in (1, 2)])
    cell = np.clip(((beside + 1.0) / 2.0 * _SQUARES).astype(np.intp), 0, _SQUARES - 1)
    return np.asarray((face * _SQUARES + cell[0]) * _SQUARES + cell[1])


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

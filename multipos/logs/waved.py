"""Logs of a magnetometer that was turned about by hand: rows as they are, and those worth keeping.

A magnetometer is not put down in positions but waved through all directions, and every row is a
reading of the field in some direction. Neighbours of a fast log have nearly the same direction and
the same slow noise; so of more rows than `_KEPT` those are kept that stand for most directions. A
sphere through the readings, |y|² = 2 c·y + (r² − |c|²) by least squares, gives each row a direction
y − c, which falls into one of the squares of a cube's faces; of every square so many rows are kept,
even in time, that all together are as many as wanted. What is left of their correlation is for the
fit, which takes rows in the order of time (`multipos.estimation.correlated_rows`).

Rests are taken instead where nine or more hold most of the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.spelling import quoted
from multipos.finding import Finding, Findings
from multipos.logs.averages import Averages
from multipos.logs.clock import time_columns
from multipos.logs.log_columns import choose_outputs
from multipos.logs.table import Log
from multipos.numerics.arrays import Array, median
from multipos.numerics.terms import COMPONENTS
from multipos.positions.headers import (
    MAGNETIC_UNITS,
    component,
    field_of_outputs,
    triads_of,
    unit_as_known,
)
from multipos.positions.readings import Readings
from multipos.results import Result, plain

_KEPT = 300  # rows that a fit is made of
_SQUARES = 4  # along an edge of a face of the cube
_FEWEST = 12  # rows
_BLOCK = 25  # rows, that stand still or not
_STILL = 8.0  # standard deviations of a row, over which a block moves
_MOST = 0.5  # of the rows, that rests hold where they are taken
_RESTS = 9
_CUT = 4  # rows in a run at the end of a range


@dataclass(frozen=True, eq=False)
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
        result: dict[str, Any] = plain(content)
        return result

    def __str__(self) -> str:
        return f"{self.source}: {len(self.readings)} of {self.rows} rows, as they are\n"


def magnetic_outputs(
    log: Log, outputs: Sequence[str] | None, kind: str | None, unit: str | None
) -> tuple[str, ...] | None:
    """Return the outputs of a log that are a magnetometer's; None where they are not."""
    if outputs is None and kind == "magnetic":
        named = [name for name in log.numeric if component(name).magnetic]
        triads = triads_of(named, {name: component(name) for name in named})
        outputs = triads[0] if len(triads) == 1 else None
    if outputs is None and kind != "magnetic":
        kinds = [component(name) for name in log.columns]
        if any(each.acceleration for each in kinds):
            return None
        stated = unit_as_known(unit or "") in MAGNETIC_UNITS
        if not (stated or any(each.magnetic for each in kinds) or _in_field(log, log.columns)):
            return None
    chosen = choose_outputs(log, outputs, time_columns(log)).names
    written = {log.units[name] for name in chosen if name in log.units}
    own = unit_as_known(unit) if unit else (written.pop() if len(written) == 1 else "reading")
    return chosen if field_of_outputs(chosen, own, None, kind) == "magnetic" else None


def _in_field(log: Log, names: Sequence[str]) -> bool:
    return any(log.units.get(name) in MAGNETIC_UNITS for name in names)


def read_rows(
    logs: Sequence[Log], outputs: tuple[str, ...], *, signed: int | None, drop_bad: bool
) -> tuple[Array, dict[str, Array]]:
    """Return all rows (n, M) of the outputs, and a column of the temperature where all have one.

    Raises
    ------
    MultiposError
        Rows of several sensors take turns, or too few are left.
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
    environment = {}
    for name in warm:
        pieces = [p.table.columns[name] for log in logs for p in log.read((), (name,), ())]
        environment[name] = np.concatenate([np.asarray(p, dtype=np.float64) for p in pieces])
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
    rows = worth_keeping(values)
    said = "rows are taken as they are, each a direction of its own"
    if len(rows) < len(values):
        said = f"{len(rows)} of {len(values)} rows are kept, even over directions and time"
    findings = [Finding("waved", "note", said), *_cut_off(outputs, values)]
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


def worth_keeping(values: Array, count: int = _KEPT) -> NDArray[np.intp]:
    """Return the rows (k,) of readings (n, 3) that are kept, k about `count` at most, in order."""
    n = len(values)
    if n <= count or values.shape[1] != len(COMPONENTS):
        return np.unique(np.linspace(0, n - 1, min(n, count)).round().astype(np.intp))
    square = _squares_of(values)
    sizes = np.bincount(square)
    cap = _even_cap(sizes[sizes > 0], count)
    order = np.argsort(square, kind="stable")
    starts = np.concatenate([[0], np.cumsum(sizes)])
    kept = []
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        own = order[start:end]
        if len(own) > cap:
            own = own[((np.arange(cap) + 0.5) * len(own) / cap).astype(np.intp)]
        kept.append(own)
    return np.sort(np.concatenate(kept))


def _squares_of(values: Array) -> NDArray[np.intp]:
    """Return in which square of a cube's faces the direction of each row is."""
    scale = float(np.abs(values).max()) or 1.0
    y = values / scale
    design = np.column_stack([2.0 * y, np.ones(len(y))])
    centre = np.linalg.lstsq(design, np.sum(y**2, axis=1), rcond=None)[0][:3]
    away = y - centre
    along = np.abs(away).argmax(axis=1)
    rows = np.arange(len(away))
    size = np.where(away[rows, along] == 0.0, 1.0, away[rows, along])
    face = 2 * along + (size > 0.0)
    beside = np.stack([away[rows, (along + k) % 3] / np.abs(size) for k in (1, 2)])
    cell = np.clip(((beside + 1.0) / 2.0 * _SQUARES).astype(np.intp), 0, _SQUARES - 1)
    return np.asarray((face * _SQUARES + cell[0]) * _SQUARES + cell[1])


def _even_cap(sizes: NDArray[np.intp], count: int) -> int:
    """Return how many rows of a square may be kept, so that all are no more than `count`."""
    low, high = 1, int(sizes.max())
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (
            (middle, high) if np.minimum(sizes, middle).sum() <= count else (low, middle - 1)
        )
    return low


def _cut_off(outputs: tuple[str, ...], values: Array) -> list[Finding]:
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
    text = f"{quoted([output for output, _, _ in cut])} is cut off at the end of its range, rows "
    text += ", ".join(f"{first} to {last}" for _, first, last in cut)
    action = "Record again in a wider range, or farther from iron."
    names = tuple(output for output, _, _ in cut)
    return [Finding("saturated", "error", text, action, outputs=names)]

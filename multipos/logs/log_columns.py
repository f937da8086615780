"""The names of a log's columns, and which of them are outputs.

`name_header` names the columns, `choose_outputs` and `magnetic_outputs` return the outputs: the
columns that a log names as acceleration, or as field, where it names other sensors beside them;
what a name says is for `multipos.positions.headers`. Where no name tells, `triad_of_gravity` finds
the columns that show gravity.

Three columns in a row that sense gravity turn with the sensor and keep their size; a gyro at rest
shows its bias, which neither turns nor means anything, and in motion any size. So blocks of rows
are taken in which nothing moves, the quietest third, and the triad is looked for whose size varies
least there while its direction changes.
"""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import listed, visible
from multipos.files.written_units import MAGNETIC_UNITS, split_unit
from multipos.finding import Findings
from multipos.logs.clock import time_columns
from multipos.logs.table import Log
from multipos.numerics.arrays import LARGEST_SAMPLE, Array, median
from multipos.positions import headers

_BLOCK = 32  # rows
_SHOWN = 40  # characters of a line in a message
_FEWEST = 12  # blocks
_VARIES = 0.15  # relative: by a bias of so many g the size of gravity does, over the directions
_TURNS = 0.5  # of its size: how far a component goes when the sensor is turned
_CLEAR = 3.0  # times the variation of the next: a magnetometer turns too


def triad_of_gravity(log: Log, names: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the three columns in a row that show gravity; None where that is not clear."""
    data = _first_cells(log, names)
    data = data[:, (np.abs(data) <= LARGEST_SAMPLE).all(axis=0)]  # and no NaN
    count = data.shape[1] // _BLOCK
    if count < _FEWEST:
        return None
    blocks = data[:, : count * _BLOCK].reshape(len(names), count, _BLOCK)
    mean, sd = blocks.mean(axis=2), blocks.std(axis=2)
    usual = median(sd, axis=1)[:, None]
    moves = (sd / np.where(usual > 0.0, usual, 1.0)).max(axis=0)
    quiet = mean[:, moves <= np.quantile(moves, 1.0 / 3.0)]
    varies = np.array([_variation(quiet[i : i + 3]) for i in range(len(names) - 2)])
    best = int(np.argmin(varies))
    rival = np.delete(varies, np.s_[max(best - 2, 0) : best + 3]).min(initial=np.inf)
    if varies[best] > _VARIES or _CLEAR * varies[best] > rival:
        return None
    return names[best : best + 3]


def _variation(means: Array) -> float:
    """Return how the size of means (3, n) varies, relatively; infinite where they do not turn."""
    size = np.linalg.norm(means, axis=0)
    usual = float(median(size))
    if not usual or float(np.ptp(means, axis=1).max()) < _TURNS * usual:
        return np.inf
    low, high = np.quantile(size, [0.1, 0.9]).tolist()
    return float(high - low) / usual


class Named(NamedTuple):
    """The columns of a log: their names, without units, and how the header has them."""

    columns: tuple[str, ...]
    header: tuple[str, ...]
    nameless: frozenset[str]
    headless: bool


def name_header(
    source: str, header: Sequence[str] | None, width: int, given: Sequence[str] | None
) -> Named:
    """Return the columns: as given, by the header, units in brackets aside, or 1, 2, 3, ….

    A column that the header leaves without a name has its number.

    Raises
    ------
    UsageError
        Not as many names are given as there are columns.
    MultiposError
        A name appears twice.
    """
    if given is not None and len(given) != width:
        raise UsageError(
            f"--columns names {len(given)} columns, but {source} has {width}; name each."
        )
    cells = [""] * width if header is None else [*header]
    bare = [split_unit(name)[0] for name in cells]
    unlike = len(set(bare)) == len(bare)  # else the units tell the columns apart
    names = given or (bare if unlike else cells)
    columns = tuple(name or str(i) for i, name in enumerate(names, 1))
    twice = next((name for name, count in Counter(columns).items() if count > 1), None)
    if twice is not None:
        raise MultiposError(
            f"{source}: column '{twice}' appears twice; rename one or give --columns."
        )
    if given is not None or header is None:
        return Named(columns, columns, frozenset(), given is None)
    pairs = list(zip(columns, cells, strict=True))
    nameless = frozenset(name for name, cell in pairs if not cell)
    return Named(columns, tuple(cell or name for name, cell in pairs), nameless, False)


class Outputs(NamedTuple):
    """The columns that are outputs, and what is to be said of the choice."""

    names: tuple[str, ...]
    findings: Findings


def choose_outputs(log: Log, given: Sequence[str] | None, clocks: Sequence[str]) -> Outputs:
    """Return the outputs of a log: as given, or by their names.

    Parameters
    ----------
    log : Log
    given : names, optional
    clocks : names
        Columns that tell the time, or a label.

    Raises
    ------
    MultiposError
        There is no such column, none can be an output, or one that is named as one holds text.
    UsageError
        More than three could be, or one is given twice.
    """
    if given is not None:
        found = tuple(map(log.find, given))
        if len(set(found)) < len(found):
            raise UsageError(f"--outputs names a column twice: {', '.join(found)}.")
        return Outputs(found, ())
    apart = {*clocks, *log.nameless, *filter(headers.is_environment, log.numeric)}
    apart |= {name for name, unit in log.units.items() if unit in headers.OF_SURROUNDINGS}
    names = [name for name in log.numeric if name not in apart]
    kinds = {name: headers.component(name) for name in log.columns}
    chosen, by = _by_name(names, kinds), "their names"
    idle = headers.idle_columns(chosen, kinds, partial(_first_cells, log))
    chosen = tuple(name for name in chosen if name not in idle)
    if len(chosen) > 3 and not any(kinds[name].acceleration for name in chosen):
        chosen, by = triad_of_gravity(log, chosen) or chosen, "what they show of gravity"
    texts = [name for name in log.columns if name not in log.numeric]
    headers.refuse_text(log.source, chosen, texts, kinds)
    linear = [n for n in chosen if kinds[n].axis >= 0 and headers.is_without_gravity(kinds[n].stem)]
    if linear:
        raise MultiposError(
            f"{log.source}: column '{linear[0]}' has gravity taken away, by its name; record "
            "acceleration with gravity, or name the outputs with --outputs."
        )
    if not chosen:
        raise MultiposError(
            f"{log.source}: no numeric column can be an output ({_seen(log)}); give a file of "
            "numbers, time,ax,ay,az in each line, or name its columns with --columns."
        )
    if len(chosen) > 3:
        line = f"; type multipos calibrate {Path(log.source).name} --outputs {','.join(chosen[:3])}"
        raise UsageError(
            f"{log.source}: {len(chosen)} columns could be outputs: {listed(chosen, 12)}; name "
            f"them with --outputs{f' ({_seen(log)}{line})' if log.headless else ''}."
        )
    others = [name for name in names if name not in idle]
    unused = headers.unused_columns((), idle)
    return Outputs(chosen, (*unused, *headers.find_others(chosen, others, by)))


def _seen(log: Log) -> str:
    """Return how many lines a log has, and what is in them."""
    first, *others = log.read((), (), (), lenient=True)
    rows = first.table.rows + sum(piece.table.rows for piece in others)
    if log.numeric or first.lines is None:
        names = ", no names" if log.headless else ""
        return f"{rows:,} lines, {len(log.numeric)} numbers each{names}"
    return f"{rows:,} lines like '{visible(first.lines()[0])[:_SHOWN]}'"


def _first_cells(log: Log, names: Sequence[str]) -> Array:
    """Return the numbers (k, n) of columns in the first piece of a log."""
    table = next(log.read((), names, lenient=True)).table
    return np.array([table.columns[name] for name in names], dtype=np.float64)


def _by_name(names: Sequence[str], kinds: dict[str, headers.NameParts]) -> tuple[str, ...]:
    """Return the outputs among numeric columns: the triad of acceleration, where there is one."""
    named = [name for name in names if kinds[name].acceleration]
    triads = headers.triads_of(named, kinds)
    if len(triads) == 1:
        return triads[0]
    if triads or (named and any(kinds[name].elsewhere for name in names)):
        return tuple(named)
    whole = headers.triads_of(names, kinds) if len(names) == 3 else []
    return whole[0] if whole else tuple(names)


def magnetic_outputs(
    log: Log, outputs: Sequence[str] | None, kind: str | None, unit: str | None
) -> tuple[str, ...] | None:
    """Return the outputs of a log that are a magnetometer's; None where they are not.

    A unit of tesla asks for them as `kind` does; G may be meant for g.
    """
    stated = headers.unit_as_known(unit or "") in MAGNETIC_UNITS
    if outputs is None and (kind == "magnetic" or (stated and str(unit).endswith("T"))):
        named = [name for name in log.numeric if headers.component(name).magnetic]
        triads = headers.triads_of(named, {name: headers.component(name) for name in named})
        outputs = triads[0] if len(triads) == 1 else None
    if outputs is None and kind != "magnetic":
        kinds = [headers.component(name) for name in log.columns]
        if any(each.acceleration for each in kinds):
            return None
        in_field = any(unit in MAGNETIC_UNITS for unit in log.units.values())
        if not (stated or in_field or any(each.magnetic for each in kinds)):
            return None
    chosen = choose_outputs(log, outputs, time_columns(log)).names
    written = {log.units[name] for name in chosen if name in log.units}
    own = (
        headers.unit_as_known(unit) if unit else (written.pop() if len(written) == 1 else "reading")
    )
    return chosen if headers.field_of_outputs(chosen, own, None, kind) == "magnetic" else None

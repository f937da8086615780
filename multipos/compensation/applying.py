"""Apply a calibration to a table of raw readings: every column kept, force added.

What is added stands in `multipos.compensation.applying`. A table in memory is done at once, a
file as a log (`multipos.compensation.applying`).

Apply a calibration to a log: every column kept, force added, as CSV text that comes in pieces.

What is added is that of a table (`multipos.compensation.applying`); a log may be of any
length, for it is read, computed and written piece by piece.

What a table of raw readings gets beside its columns: force, and what is asked of it, row by row.

Stand there ``f_x``, ``f_y``, ``f_z`` [g] for the axes that the sensor has, in the calibration's
convention, on request their uncertainties ``u_f_x``, ``U_f_x`` …, the noise of one reading included
(`multipos.compensation.reading_noise`), and ``outside``: 1 where a reading lies beyond what was
calibrated, that is where |f| exceeds the largest reference, where f leaves the known forces that
were applied, or where a column of the model leaves the range of the calibration's readings, 0
elsewhere.

With tilt the sensor is taken to be at rest (`multipos.sensor.tilt`): ``tilt_x_deg`` … are the
angles of its axes above the horizon, and one axis that it does not have follows from |f| = g with
that axis up. More outputs than axes leave a parity: ``parity`` and ``fault``
(`multipos.compensation.applying`).

A magnetometer gives ``b_x``, ``b_y``, ``b_z`` instead. With an accelerometer beside it, at rest, u
its specific force as a unit vector, ``heading_deg`` is that of case axis x from magnetic north, 0
to 360° by the east, without declination:

    n = b − (b·u) u,     e = n × u,     heading = atan2(x·e, x·n).

Parity: what more outputs than axes say of each other, whatever the force.

M outputs on K < M axes over-determine the force. Least squares leaves r = y − h(f), which lies in
the left null space of the Jacobian J (M, K), where no force reaches; with N (M, M − K) an
orthonormal basis of it, the parity vector and its covariance are

    p = N' r,    cov p = N' [diag(s²) + (dh/dp) C (dh/dp)'] N,                              (1)

s the noise of a reading and C the covariance of the parameters. ``size`` is |p| in the unit of
the readings, and p'(cov p)⁻¹p is χ² on M − K degrees of freedom where nothing is broken, or
(M − K) F where the noise is an estimate. A tail below `FAULT_LEVEL` is a fault. M − K = 1 tells
that an output has failed, not which one.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import chain, repeat
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.reading_noise import ReadingUncertainty, asked_uncertainty
from multipos.diagnostics.model_error import find_hidden
from multipos.errors import MultiposError, UsageError
from multipos.files import handed, tables
from multipos.finding import Finding, Findings, in_order
from multipos.logs.opening import open_log, read_log
from multipos.logs.table import Log, Piece, called_as
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array, Mask
from multipos.numerics.quantiles import f_tail
from multipos.numerics.terms import largest_value
from multipos.positions.headers import plain_names, require_units, under_names
from multipos.results import Columns
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import has_other_solutions, require_response, sensitivities
from multipos.sensor.tilt import at_rest, reading_noise, tilt_at_rest, triad_tilt, zeros_of_force
from multipos.uncertainty.unseen_terms import unseen_covariance
from multipos.uncertainty.validity import applied

_TOGETHER = 1 << 12  # rows, whose arrays stay in the processor's cache
_PLAIN = 8 * _TOGETHER  # without uncertainties, whose arrays are the larger ones
_DIGITS = 4  # of an uncertainty in text
FAULT_LEVEL = 1e-3  # share of sound readings that are called a fault


class Parity(NamedTuple):
    """Parity vectors (n, M − K), their length (n,) in reading units, and the tail p (n,)."""

    vector: Array
    size: Array
    p: Array


def parity(
    calibration: Calibration,
    raw: Array,
    force: Array,
    environment: Mapping[str, Array],
    noise: Array,
) -> Parity:
    """Return what the outputs of a redundant sensor say of each other.

    Parameters
    ----------
    calibration : Calibration
        Of more outputs than axes.
    raw : (n, M) array
    force : (n, K) array [g]
        Compensated from `raw`.
    environment : mapping of str to (n,) array
    noise : (M,) or (n, M) array
        Standard uncertainty of the readings.
    """
    model, parameters = calibration.model, calibration.parameters
    sensed = list(model.sensed_axes)
    sound = np.isfinite(force.sum(axis=1))
    full = np.zeros((len(raw), 3))
    full[:, sensed] = np.where(sound[:, None], force, 0.0)
    residual = raw - model.predict(parameters, full, environment)
    inverse, by_parameter = sensitivities(model, parameters, full, environment)
    # The left null space of J is the null space of J^+: its last right singular vectors.
    basis: Array = np.asarray(np.linalg.svd(inverse)[2])[:, len(sensed) :]
    m = len(model.outputs)
    covariance = by_parameter @ calibration.covariance @ by_parameter.transpose(0, 2, 1)
    covariance[:, range(m), range(m)] += np.broadcast_to(noise, raw.shape) ** 2
    vector = np.einsum("ndm,nm->nd", basis, residual)
    spread = basis @ covariance @ basis.transpose(0, 2, 1)
    distance = np.full(len(raw), np.nan)
    finite = np.isfinite(spread).all(axis=(1, 2), keepdims=True)
    volume = np.linalg.det(np.where(finite, spread, 0.0))
    known = np.flatnonzero(sound & np.isfinite(volume) & (volume > 0.0))
    weighted = np.linalg.solve(spread[known], vector[known][:, :, None])[:, :, 0]
    distance[known] = np.einsum("nd,nd->n", vector[known], weighted)
    degrees, dof = m - len(sensed), float(calibration.dof.min())
    p = np.array([f_tail(d / degrees, degrees, dof) for d in distance.tolist()])
    return Parity(vector, np.where(sound, np.linalg.norm(vector, axis=1), np.nan), p)


Outside = Literal["flag", "clamp", "refuse"]
OUTSIDE: tuple[Outside, ...] = get_args(Outside)


def add_columns(
    calibration: Calibration,
    table: tables.Table,
    *,
    tilt: bool,
    uncertainty: ReadingUncertainty | None,
    outside: Outside,
    beside: Calibration | None = None,
) -> dict[str, Array]:
    """Return the columns that a table gets, each row from itself alone, in order."""
    together = _PLAIN if uncertainty is None else _TOGETHER
    if table.rows > 2 * together:
        starts = range(0, table.rows, together)
        some = [_rows_of(table, start, together) for start in starts]
        how: dict[str, Any] = {
            "tilt": tilt,
            "uncertainty": uncertainty,
            "outside": outside,
            "beside": beside,
        }
        parts = [add_columns(calibration, part, **how) for part in some]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    require_response(calibration.model, calibration.parameters, calibration.mean_environment)
    raw = np.column_stack([table.number(name, largest=LARGEST) for name in calibration.outputs])
    terms = [term for _, term in calibration.model.keys]
    environment = {
        name: table.number(name, largest=largest_value(terms, name))
        for name in calibration.model.environment
    }
    beyond, clamped = _environment_outside(calibration, table, environment)
    if outside == "clamp":
        environment = clamped
    axes = list(calibration.model.sensed_axes)
    noise = None if uncertainty is None else uncertainty.noise.of(table)
    tilts: dict[str, Array] = {}
    if tilt:
        rest = at_rest(calibration, raw, environment)
        force, tilts = rest[:, axes], _tilts(calibration, rest, environment, uncertainty, noise)
        beyond |= np.any([np.isnan(tilts[f"tilt_{COMPONENTS[i]}_deg"]) for i in axes], axis=0)
    else:
        force = calibration.compensate(raw, environment)
    beyond |= ~applied(calibration).holds(force, axes)
    if not calibration.model.has_terms:
        beyond |= has_other_solutions(
            calibration.model,
            calibration.parameters,
            raw,
            environment,
            found=force,
            reach=float(np.linalg.norm(calibration.reference, axis=1).max()),
        )
    symbol = calibration.field.symbol
    added = _by_axis(f"{symbol}_{{}}", axes, force)
    if uncertainty is not None and noise is not None:
        u, U = uncertainty.of_force(force, environment, noise)
        added |= _by_axis(f"u_{symbol}_{{}}", axes, u) | _by_axis(f"U_{symbol}_{{}}", axes, U)
    added |= tilts
    if beside is not None:
        added["heading_deg"] = _heading(force, beside, table)
    if len(calibration.outputs) > len(axes):
        odd = parity(calibration, raw, force, environment, reading_noise(calibration))
        added["parity"] = odd.size
        added["fault"] = (odd.p < FAULT_LEVEL).astype(np.int64)
    return {**added, "outside": beyond.astype(np.int64)}


def _heading(field: Array, beside: Calibration, table: tables.Table) -> Array:
    """Return the heading (n,) of case axis x [degrees], NaN where it has none."""
    raw = np.column_stack([table.number(name, largest=LARGEST) for name in beside.outputs])
    environment = {name: table.number(name) for name in beside.model.environment}
    up = beside.sign * beside.compensate(raw, environment)
    with np.errstate(invalid="ignore", divide="ignore"):
        up = up / np.linalg.norm(up, axis=1)[:, None]
        north = field - np.einsum("ni,ni->n", field, up)[:, None] * up
        east = np.cross(north, up)
        found = np.degrees(np.arctan2(east[:, 0], north[:, 0])) % 360.0
    level = np.hypot(east[:, 0], north[:, 0]) > 0.0
    return np.where(level & (found < 360.0), found, np.where(level, 0.0, np.nan))


def check_beside(calibration: Calibration, beside: Calibration | None, tilt: bool) -> None:
    """Refuse a heading without a magnetometer and an accelerometer, and a tilt of the former."""
    if tilt and calibration.field.angle != "tilt":
        raise UsageError("--tilt is of accelerometers; a magnetometer has --with ACCEL.json.")
    if beside is None:
        return
    if (calibration.field.angle, beside.field.angle) != ("heading", "tilt"):
        raise UsageError("--with goes with a magnetometer, and takes an accelerometer's file.")
    for each in (calibration, beside):
        if sorted(each.model.axes) != list(COMPONENTS):
            raise UsageError("--with takes two triads; one of the calibrations has other axes.")


def find_turn(calibration: Calibration, beside: Calibration | None) -> Findings:
    """Say that the turn between two triads is not known, where one had no orientations."""
    if beside is None or (calibration.model.gauge is None and beside.model.gauge is None):
        return ()
    text = "the turn between the two triads is not known, and is not in the heading"
    action = "Calibrate both at known orientations of one case to have it."
    return (Finding("triads-turned", "warning", text, action),)


def _rows_of(table: tables.Table, start: int, together: int) -> tables.Table:
    """Return some rows of a table, as many as are worked on together."""
    rows = slice(start, start + together)
    columns = {name: column[rows] for name, column in table.columns.items()}
    lines = None if table.lines is None else table.lines[rows]
    count = min(together, table.rows - start)
    return replace(table, columns=columns, rows=count, lines=lines, first=table.first + start)


def _tilts(
    calibration: Calibration,
    rest: Array,
    environment: Mapping[str, Array],
    uncertainty: ReadingUncertainty | None,
    noise: Array | None,
) -> dict[str, Array]:
    """Return the tilt of each axis at rest, with its uncertainties where the noise is known."""
    axes = list(calibration.model.sensed_axes)
    if len(axes) == 3:
        angle = triad_tilt(rest, calibration.sign)
    else:
        angle = tilt_at_rest(calibration, rest, environment).tilt
    tilts = _by_axis("tilt_{}_deg", axes, np.degrees(angle))
    if uncertainty is not None and noise is not None:
        # what is a tilt at all does not depend on what is asked for
        estimated = noise if uncertainty.noise.own else np.zeros_like(noise)
        zeros = zeros_of_force(calibration, rest, environment, None, estimated)
        unseen = unseen_covariance(calibration, rest[:, axes], environment)
        sized = tilt_at_rest(calibration, rest, environment, noise, unseen, zeros)
        tilts |= _by_axis("u_tilt_{}_deg", axes, np.degrees(sized.u))
        tilts |= _by_axis("U_tilt_{}_deg", axes, np.degrees(sized.U))
    return tilts


def _by_axis(name: str, axes: Sequence[int], values: Array) -> dict[str, Array]:
    """Return values (n, K) as columns named after their axes."""
    return {name.format(COMPONENTS[i]): values[:, column] for column, i in enumerate(axes)}


def check_outside(outside: str) -> None:
    """Refuse a way with rows outside that is none."""
    if outside not in OUTSIDE:
        raise UsageError(f"--outside takes {', '.join(OUTSIDE)}, got '{outside}'.")


def check_columns(
    calibration: Calibration,
    source: str,
    columns: Mapping[str, tables.Column] | tuple[str, ...],
    tilt: bool,
    uncertainty: ReadingUncertainty | None,
    units: Mapping[str, str],
    beside: Calibration | None = None,
) -> None:
    """Refuse a table that lacks a column, has it in another unit, or has one that is added."""
    for name in (*calibration.outputs, *calibration.model.environment):
        if name not in columns:
            raise MultiposError(
                f"{source}: no column '{name}', which this calibration needs; "
                f"the columns are {', '.join(columns)}."
            )
    if beside is not None:
        check_columns(beside, source, columns, False, None, units)
    model = calibration.model
    require_units(source, units, model.outputs, model.environment, model.unit)
    # What one reading gets, every reading gets.
    one = {name: calibration.readings.values[:1, i] for i, name in enumerate(calibration.outputs)}
    one |= {n: calibration.readings.environment[n][:1] for n in calibration.model.environment}
    one |= {} if uncertainty is None else dict.fromkeys(uncertainty.noise.columns, np.ones(1))
    added = add_columns(
        calibration,
        tables.Table(source, one, rows=1),
        tilt=tilt,
        uncertainty=uncertainty,
        outside="flag",
    )
    for name in (*added, *(("heading_deg",) if beside is not None else ())):
        if name in columns:
            raise MultiposError(
                f"{source}: column '{name}' is there already; rename it, apply writes it."
            )


def _place_outside(calibration: Calibration, table: tables.Table, row: int) -> str:
    """Return the place of a row that is outside: at the column of the model that is, if one is."""
    columns = {name: table.number(name) for name in calibration.model.environment}
    _, clamped = _environment_outside(calibration, table, columns)
    apart = (name for name in columns if columns[name][row] != clamped[name][row])
    return table.where(row, next(apart, calibration.outputs[0]))


def refusal(where: str, beyond: int, rows: int) -> MultiposError:
    """Return the error of rows beyond what was calibrated, the first of which is named."""
    return MultiposError(
        f"{where}: the reading is outside what was calibrated ({beyond} of {rows} rows are); "
        "use --outside flag to see them."
    )


def _environment_outside(
    calibration: Calibration, table: tables.Table, environment: Mapping[str, Array]
) -> tuple[Mask, dict[str, Array]]:
    """Return which rows leave the calibrated range of a column, and the columns clamped to it."""
    beyond = np.zeros(table.rows, dtype=bool)
    clamped = {}
    for name, column in environment.items():
        seen = calibration.readings.environment[name]
        low, high = float(seen.min()), float(seen.max())
        beyond |= (column < low) | (column > high)
        clamped[name] = np.clip(column, low, high)
    return beyond, clamped


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
                first = _place_outside(self.calibration, piece.table, int(np.argmax(beyond)))
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


def wanted_columns(calibration: Calibration) -> tuple[str, ...]:
    """Return the columns that a calibration is applied to: what it needs, and the noise of rows."""
    stated = (f"u_{output}" for output in calibration.outputs)
    return (*calibration.outputs, *calibration.model.environment, *stated)


class AppliedColumns(Columns):
    """A table with what was made of it beside its columns.

    `noise` says which noise of one reading the uncertainties hold, None where there are none, and
    `findings` what was found about them.
    """

    noise: str | None
    findings: Findings

    def __init__(
        self,
        content: Mapping[str, Any],
        noise: str | None = None,
        findings: Findings = (),
    ) -> None:
        super().__init__(content)
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "findings", findings)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (dict(self), self.noise, self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"rows": n, "columns": {name: […]}}`` as what JSON can carry.

        With uncertainties ``"noise"`` stands between them.
        """
        said = {} if self.noise is None else {"noise": self.noise}
        findings = [each.to_dict() for each in self.findings]
        return {
            "rows": len(self["outside"]),
            **said,
            "findings": findings,
            **super().to_dict(),
        }


class Applied(AppliedColumns):
    """A table with the compensated force beside its columns.

    Force is in g, NaN where no force explains the reading.
    """


def apply(
    calibration: Calibration,
    data: tables.Source,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
    outside: Outside = "flag",
    beside: Calibration | None = None,
) -> Applied:
    """Return the columns of a table with the compensated force beside them.

    Parameters
    ----------
    calibration : Calibration
    data : path, open file, mapping of columns, data frame, or (n, M) array of the outputs
        Of a table, or of a log of any kind that `average` reads. Must have the calibration's
        outputs, and the columns its model uses.
    tilt : bool
        Add ``tilt_x_deg`` …, the angle of each axis above the horizon, for a sensor at rest.
    uncertainty : bool
        Add ``u_f_x`` …, ``U_f_x`` … [g], and with tilt ``u_tilt_x_deg``, ``U_tilt_x_deg`` …: of
        parameters, budget and the noise of one reading together. That noise is ``u_<output>`` of
        the table, else `reading_sd`, else that of an averaged reading of the calibration.
    reading_sd : float or (M,) array, optional
        Standard uncertainty of a reading of the table.
    parameters_only : bool
        Leave the noise of the reading out.
    outside : str
        'flag' rows beyond what was calibrated, 'clamp' the model's other columns (such as
        temperature) to the calibrated range as well, or 'refuse' the table.
    beside : Calibration, optional
        Of the accelerometer beside a magnetometer, whose outputs the table has as well: add
        ``heading_deg``, of case axis x from magnetic north, at rest.

    Returns
    -------
    Applied

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.
    TypeError
        `calibration` is something else: for a regression `multipos.correct` does this.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> log = {"ax": [0.5], "ay": [0.0], "az": [-0.86]}
    >>> found = mp.apply(cal, log, tilt=True, uncertainty=True)
    >>> list(found)[3:6]
    ['f_x', 'f_y', 'f_z']
    >>> print(f"{found.tilt_x_deg[0]:.1f} degrees, U of f_x {found.U_f_x[0]:.3f} g")
    -30.7 degrees, U of f_x 0.017 g
    """
    if not isinstance(calibration, Calibration):
        raise TypeError(
            f"needs a Calibration, got {type(calibration).__name__}; for a regression call "
            "`multipos.correct`, and `multipos.load` reads a calibration from its file."
        )
    check_outside(outside)
    check_beside(calibration, beside, tilt)
    data = handed.take_in(data, "data", calibration.outputs)
    if not isinstance(data, Mapping):  # a log of any kind that the command reads
        whole = apply_log(
            calibration,
            open_log(data),
            tilt=tilt,
            uncertainty=uncertainty,
            reading_sd=reading_sd,
            parameters_only=parameters_only,
            outside=outside,
            beside=beside,
        )
        columns = whole.columns()
        return Applied(columns, whole.noise, in_order((*whole.log.left_out, *whole.findings)))
    given = tables.read_table(data, what="data")
    table, units = plain_names(given)
    asked = wanted_columns(calibration)
    table, _ = under_names(table, asked if beside is None else (*asked, *wanted_columns(beside)))
    wanted = asked_uncertainty(
        calibration, table.source, table.columns, uncertainty, reading_sd, parameters_only
    )
    check_columns(calibration, table.source, table.columns, tilt, wanted, units, beside)
    added = add_columns(
        calibration, table, tilt=tilt, uncertainty=wanted, outside=outside, beside=beside
    )
    if outside == "refuse" and added["outside"].any():
        where = _place_outside(calibration, table, int(np.argmax(added["outside"])))
        raise refusal(where, int(added["outside"].sum()), table.rows)
    kept = {name: copy(column) for name, column in given.columns.items()}  # the caller's own stay
    said: Findings = ()
    if wanted is not None:
        said = (*wanted.held, *wanted.find_samples(table, table.columns))
    said = (*said, *find_turn(calibration, beside))
    findings = found_applying(calibration, said, int(added["outside"].sum()), table.rows)
    noise = None if wanted is None else wanted.noise.text
    return Applied({**kept, **added}, noise, findings)


def found_applying(c: Calibration, of_noise: Findings, beyond: int, rows: int) -> Findings:
    """Return what was found about compensated force."""
    found = in_order((*find_hidden(c), *of_noise, *find_outside(beyond, rows)))
    return tuple(replace(each, text=c.field.worded(each.text)) for each in found)


def find_outside(beyond: int, rows: int) -> Findings:
    """Return a warning of rows beyond what was calibrated, where there are any."""
    if not beyond:
        return ()
    text = f"{beyond} of {rows} rows are outside the calibrated range, where U may not hold"
    action = (
        "Check the unit of the readings." if beyond == rows else "Calibrate over a wider range."
    )
    return (Finding("outside", "warning", text, action),)

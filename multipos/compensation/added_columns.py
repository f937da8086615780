"""What a table of raw readings gets beside its columns: force, and what is asked of it, row by row.

`add_columns` returns the columns. `check_columns`, `check_outside` and `check_beside` refuse what
does not fit, `wanted_columns` names what is read; `found_applying` returns what is found about
force, `find_outside` and `find_turn` parts of it, and `refusal` the error of rows
outside, the first of which `place_outside` names.

Added are ``f_x``, ``f_y``, ``f_z`` [g] for the axes that the sensor has, in the calibration's
convention, on request their uncertainties ``u_f_x``, ``U_f_x`` …, the noise of one reading included
(`multipos.compensation.reading_noise`), and ``outside``: 1 where a reading lies beyond what was
calibrated, that is where |f| exceeds the largest reference, where f leaves the known forces that
were applied, or where a column of the model leaves the range of the calibration's readings, 0
elsewhere.

With tilt the sensor is taken to be at rest (`multipos.sensor.tilt`): ``tilt_x_deg`` … are the
angles of its axes above the horizon, and one axis that it does not have follows from |f| = g with
that axis up. More outputs than axes leave a parity: ``parity`` and ``fault``
(`multipos.compensation.parity`).

A magnetometer gives ``b_x``, ``b_y``, ``b_z`` instead. With an accelerometer beside it, at rest, u
its specific force as a unit vector, ``heading_deg`` is that of case axis x from magnetic north, 0
to 360° by the east, without declination:

    n = b − (b·u) u,     e = n × u,     heading = atan2(x·e, x·n).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from multipos.compensation.parity import FAULT_LEVEL, parity
from multipos.compensation.reading_noise import ReadingUncertainty
from multipos.diagnostics.model_error import find_hidden
from multipos.errors import MultiposError, UsageError
from multipos.files import tables
from multipos.finding import Finding, Findings, in_order
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array, Mask
from multipos.numerics.terms import largest_value
from multipos.positions.headers import require_units
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import has_other_solutions, require_response
from multipos.sensor.tilt import at_rest, reading_noise, tilt_at_rest, triad_tilt, zeros_of_force
from multipos.uncertainty.unseen_terms import unseen_covariance
from multipos.uncertainty.validity import applied

_TOGETHER = 1 << 12  # rows, whose arrays stay in the processor's cache


_PLAIN = 8 * _TOGETHER  # without uncertainties, whose arrays are the larger ones


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


def place_outside(calibration: Calibration, table: tables.Table, row: int) -> str:
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


def wanted_columns(calibration: Calibration) -> tuple[str, ...]:
    """Return the columns that a calibration is applied to: what it needs, and the noise of rows."""
    stated = (f"u_{output}" for output in calibration.outputs)
    return (*calibration.outputs, *calibration.model.environment, *stated)


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

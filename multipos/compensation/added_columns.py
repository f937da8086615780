"""What a table of raw readings gets beside its columns: force, and what is asked of it, row by row.

`prepare` refuses what does not fit, `check_outside` a way with rows outside, and returns an
`Application`, which makes the columns; `wanted_columns` names what is read. `found_applying`
returns what is found about force, `find_outside` and `find_turn` parts of it, and `refusal` the
error of rows outside.

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

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.parity import FAULT_LEVEL, parity
from multipos.compensation.reading_noise import ReadingUncertainty, asked_uncertainty
from multipos.diagnostics.model_error import find_hidden
from multipos.errors import MultiposError, UsageError
from multipos.files import tables
from multipos.finding import Finding, Findings, in_order
from multipos.numerics.arrays import COMPONENTS, LARGEST, Array, Mask
from multipos.numerics.terms import largest_value
from multipos.positions.headers import require_units
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import has_other_solutions, require_response
from multipos.sensor.tilt import at_rest, reading_noise, tilt_at_rest, triad_tilt, zeros_of_force
from multipos.uncertainty.unseen_terms import unseen_covariance
from multipos.uncertainty.validity import applied

_TOGETHER = 1 << 12  # rows, whose arrays stay in the processor's cache
_PLAIN = 8 * _TOGETHER  # without uncertainties, whose arrays are the larger ones

Outside = Literal["flag", "clamp", "refuse"]
OUTSIDE: tuple[Outside, ...] = get_args(Outside)


@frozen(eq=True)
class Application:
    """What a table gets beside its columns: made once, asked for every piece of a log.

    Attributes
    ----------
    calibration : Calibration
    tilt : bool
    uncertainty : ReadingUncertainty or None
        Of the force, where it is asked for.
    outside : str
    beside : Calibration or None
        As of `multipos.apply`.
    """

    calibration: Calibration
    tilt: bool
    uncertainty: ReadingUncertainty | None
    outside: Outside
    beside: Calibration | None

    @property
    def noise(self) -> str | None:
        """Which noise of one reading the uncertainties hold; None where there are none."""
        return None if self.uncertainty is None else self.uncertainty.noise.text

    def columns(self, table: tables.Table) -> dict[str, Array]:
        """Return the columns that a table gets, each row from itself alone, in order."""
        together = _PLAIN if self.uncertainty is None else _TOGETHER
        if table.rows > 2 * together:
            starts = range(0, table.rows, together)
            parts = [self.columns(_rows_of(table, start, together)) for start in starts]
            return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        c, model = self.calibration, self.calibration.model
        require_response(model, c.parameters, c.mean_environment)
        raw = np.column_stack([table.number(name, largest=LARGEST) for name in c.outputs])
        terms = [term for _, term in model.keys]
        environment = {
            name: table.number(name, largest=largest_value(terms, name))
            for name in model.environment
        }
        beyond, clamped = _environment_outside(c, table, environment)
        if self.outside == "clamp":
            environment = clamped
        axes = list(model.sensed_axes)
        noise = None if self.uncertainty is None else self.uncertainty.noise.of(table)
        tilts: dict[str, Array] = {}
        if self.tilt:
            rest = at_rest(c, raw, environment)
            force, tilts = rest[:, axes], _tilts(c, rest, environment, self.uncertainty, noise)
            beyond |= np.any([np.isnan(tilts[f"tilt_{COMPONENTS[i]}_deg"]) for i in axes], axis=0)
        else:
            force = c.compensate(raw, environment)
        beyond |= ~applied(c).holds(force, axes)
        if not model.has_terms:
            reach = float(np.linalg.norm(c.reference, axis=1).max())
            beyond |= has_other_solutions(
                model, c.parameters, raw, environment, found=force, reach=reach
            )
        symbol = c.field.symbol
        added = _by_axis(f"{symbol}_{{}}", axes, force)
        if self.uncertainty is not None and noise is not None:
            u, U = self.uncertainty.of_force(force, environment, noise)
            added |= _by_axis(f"u_{symbol}_{{}}", axes, u) | _by_axis(f"U_{symbol}_{{}}", axes, U)
        added |= tilts
        if self.beside is not None:
            added["heading_deg"] = _heading(force, self.beside, table)
        if len(c.outputs) > len(axes):
            odd = parity(c, raw, force, environment, reading_noise(c))
            added["parity"] = odd.size
            added["fault"] = (odd.p < FAULT_LEVEL).astype(np.int64)
        return {**added, "outside": beyond.astype(np.int64)}

    def place(self, table: tables.Table, row: int) -> str:
        """Return the place of a row outside: at the column of the model that is, if one is."""
        columns = {name: table.number(name) for name in self.calibration.model.environment}
        _, clamped = _environment_outside(self.calibration, table, columns)
        apart = (name for name in columns if columns[name][row] != clamped[name][row])
        return table.where(row, next(apart, self.calibration.outputs[0]))

    def samples(self, table: tables.Table, columns: Iterable[str]) -> Findings:
        """Return what the rows of a table say of the noise that they are taken to have."""
        return () if self.uncertainty is None else self.uncertainty.find_samples(table, columns)

    def findings(self, samples: Findings, beyond: int, rows: int) -> Findings:
        """Return what was found about compensated force and its uncertainties."""
        held = () if self.uncertainty is None else self.uncertainty.held
        said = (*held, *samples, *find_turn(self.calibration, self.beside))
        return found_applying(self.calibration, said, beyond, rows)


def prepare(
    calibration: Calibration,
    source: str,
    columns: Collection[str],
    units: Mapping[str, str],
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
    outside: Outside = "flag",
    beside: Calibration | None = None,
) -> Application:
    """Return what a table or log of these columns gets.

    Raises
    ------
    MultiposError
        A column is missing, has another unit, or is one that is added.
    UsageError
        Options say nothing, or the opposite.
    """
    check_outside(outside)
    _check_beside(calibration, beside, tilt)
    wanted = asked_uncertainty(
        calibration, source, columns, uncertainty, reading_sd, parameters_only
    )
    for each in filter(None, (calibration, beside)):
        _check_columns(each, source, columns, units)
    # What one reading gets, every reading gets.
    one = {name: calibration.readings.values[:1, i] for i, name in enumerate(calibration.outputs)}
    one |= {n: calibration.readings.environment[n][:1] for n in calibration.model.environment}
    one |= {} if wanted is None else dict.fromkeys(wanted.noise.columns, np.ones(1))
    alone = Application(calibration, tilt, wanted, outside, None)
    added = alone.columns(tables.Table(source, one, rows=1))
    for name in (*added, *(("heading_deg",) if beside is not None else ())):
        if name in columns:
            raise MultiposError(
                f"{source}: column '{name}' is there already; rename it, apply writes it."
            )
    return replace(alone, beside=beside)


def wanted_columns(*calibrations: Calibration | None) -> tuple[str, ...]:
    """Return the columns that calibrations are applied to: what they need, and noise of rows."""
    names: list[str] = []
    for each in filter(None, calibrations):
        stated = (f"u_{output}" for output in each.outputs)
        names += [*each.outputs, *each.model.environment, *stated]
    return tuple(names)


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


def _check_beside(calibration: Calibration, beside: Calibration | None, tilt: bool) -> None:
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


def _check_columns(
    calibration: Calibration, source: str, columns: Collection[str], units: Mapping[str, str]
) -> None:
    """Refuse a table that lacks a column, or has it in another unit."""
    model = calibration.model
    for name in (*calibration.outputs, *model.environment):
        if name not in columns:
            raise MultiposError(
                f"{source}: no column '{name}', which this calibration needs; "
                f"the columns are {', '.join(columns)}."
            )
    require_units(source, units, model.outputs, model.environment, model.unit)


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

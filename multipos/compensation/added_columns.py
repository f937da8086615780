"""What a table of raw readings gets beside its columns: force, and what is asked of it, row by row.

Stand there ``f_x``, ``f_y``, ``f_z`` [g] for the axes that the sensor has, in the calibration's
convention, on request their uncertainties ``u_f_x``, ``U_f_x`` …, the noise of one reading included
(`multipos.compensation.reading_noise`), and ``outside``: 1 where a reading lies beyond what was
calibrated, that is where |f| exceeds the largest reference, where f leaves the known forces that
were applied, or where a column of the model leaves the range of the calibration's readings, 0
elsewhere.

With tilt the sensor is taken to be at rest (`multipos.sensor.tilt`): ``tilt_x_deg`` … are the
angles of its axes above the horizon, and one axis that it does not have follows from |f| = g with
that axis up. More outputs than axes leave a parity: ``parity`` and ``fault``
(`multipos.sensor.parity`).
"""

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from multipos.compensation.reading_noise import ReadingUncertainty
from multipos.errors import MultiposError, UsageError
from multipos.files.tables import Column, Table
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.terms import COMPONENTS, largest_value
from multipos.positions.headers import require_units
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.inverse import has_other_solutions, sensed_axes
from multipos.sensor.parity import FAULT_LEVEL, parity
from multipos.sensor.tilt import at_rest, reading_noise, tilt_at_rest
from multipos.uncertainty.unseen import unseen_covariance
from multipos.uncertainty.validity import applied

Outside = Literal["flag", "clamp", "refuse"]
OUTSIDE: tuple[Outside, ...] = get_args(Outside)


def add_columns(
    calibration: Calibration,
    table: Table,
    *,
    tilt: bool,
    uncertainty: ReadingUncertainty | None,
    outside: Outside,
) -> dict[str, Array]:
    """Return the columns that a table gets, each row from itself alone, in order."""
    raw = np.column_stack([table.number(name, largest=LARGEST) for name in calibration.outputs])
    terms = [term for _, term in calibration.model.keys]
    environment = {
        name: table.number(name, largest=largest_value(terms, name))
        for name in calibration.model.environment
    }
    beyond, clamped = _environment_outside(calibration, table, environment)
    if outside == "clamp":
        environment = clamped
    axes = list(sensed_axes(calibration.model))
    noise = None if uncertainty is None else uncertainty.noise.of(table)
    tilts: dict[str, Array] = {}
    if tilt:
        rest = at_rest(calibration, raw, environment)
        force, tilts = rest[:, axes], _tilts(calibration, rest, environment, noise)
        beyond |= np.any([np.isnan(tilts[f"tilt_{COMPONENTS[i]}_deg"]) for i in axes], axis=0)
    else:
        force = calibration.compensate(raw, environment)
    beyond |= ~applied(calibration).holds(force, axes)
    if isinstance(calibration.model, ExpressionModel):
        beyond |= has_other_solutions(
            calibration.model,
            calibration.parameters,
            raw,
            environment,
            found=force,
            reach=float(np.linalg.norm(calibration.reference, axis=1).max()),
        )
    added = _by_axis("f_{}", axes, force)
    if uncertainty is not None and noise is not None:
        u, U = uncertainty.of_force(force, environment, noise)
        added |= _by_axis("u_f_{}", axes, u) | _by_axis("U_f_{}", axes, U)
    added |= tilts
    if len(calibration.outputs) > len(axes):
        odd = parity(calibration, raw, force, environment, reading_noise(calibration))
        added["parity"] = odd.size
        added["fault"] = (odd.p < FAULT_LEVEL).astype(np.int64)
    return {**added, "outside": beyond.astype(np.int64)}


def _tilts(
    calibration: Calibration, rest: Array, environment: Mapping[str, Array], noise: Array | None
) -> dict[str, Array]:
    """Return the tilt of each axis at rest, with its uncertainties where the noise is known."""
    axes = list(sensed_axes(calibration.model))
    found = tilt_at_rest(calibration, rest, environment)
    tilts = _by_axis("tilt_{}_deg", axes, np.degrees(found.tilt))
    if noise is not None:  # what is a tilt at all does not depend on what is asked for
        unseen = unseen_covariance(calibration, rest[:, axes], environment)
        sized = tilt_at_rest(calibration, rest, environment, noise, unseen)
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
    columns: Mapping[str, Column] | tuple[str, ...],
    tilt: bool,
    uncertainty: ReadingUncertainty | None,
    units: Mapping[str, str],
) -> None:
    """Refuse a table that lacks a column, has it in another unit, or has one that is added."""
    for name in (*calibration.outputs, *calibration.model.environment):
        if name not in columns:
            raise MultiposError(
                f"{source}: no column '{name}', which this calibration needs; "
                f"the columns are {', '.join(columns)}."
            )
    model = calibration.model
    require_units(source, units, model.outputs, model.environment, model.unit)
    # What one reading gets, every reading gets.
    one = {name: calibration.readings.values[:1, i] for i, name in enumerate(calibration.outputs)}
    one |= {n: calibration.readings.environment[n][:1] for n in calibration.model.environment}
    one |= {} if uncertainty is None else dict.fromkeys(uncertainty.noise.columns, np.ones(1))
    added = add_columns(
        calibration, Table(source, one, rows=1), tilt=tilt, uncertainty=uncertainty, outside="flag"
    )
    for name in added:
        if name in columns:
            raise MultiposError(
                f"{source}: column '{name}' is there already; rename it, apply writes it."
            )


def refusal(where: str, beyond: int, rows: int) -> MultiposError:
    """Return the error of rows beyond what was calibrated, the first of which is named."""
    return MultiposError(
        f"{where}: the reading is outside what was calibrated ({beyond} of {rows} rows are); "
        "use --outside flag to see them."
    )


def _environment_outside(
    calibration: Calibration, table: Table, environment: Mapping[str, Array]
) -> tuple[NDArray[np.bool_], dict[str, Array]]:
    """Return which rows leave the calibrated range of a column, and the columns clamped to it."""
    beyond = np.zeros(table.rows, dtype=bool)
    clamped = {}
    for name, column in environment.items():
        seen = calibration.readings.environment[name]
        low, high = float(seen.min()), float(seen.max())
        beyond |= (column < low) | (column > high)
        clamped[name] = np.clip(column, low, high)
    return beyond, clamped

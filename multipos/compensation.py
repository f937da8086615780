"""Apply a calibration to a table of raw readings: every column kept, force added.

Beside the columns that came in stand ``f_x``, ``f_y``, ``f_z`` [g] for the axes that the sensor
has, in the calibration's convention, on request their standard uncertainties ``u_f_x`` … from the
covariance of the parameters and, beyond ±1 g, the third-order term that the budget allows, and
``outside``: 1 where a reading lies beyond what was calibrated, that is where |f| exceeds the
largest reference or a column of the model leaves the range of the calibration's readings, 0
elsewhere.

With tilt the sensor is taken to be at rest (`multipos.tilt`): ``tilt_x_deg`` … are the angles of
its axes above the horizon, and one axis that it does not have follows from |f| = g with that
axis up. More outputs than axes leave a parity: ``parity`` and ``fault`` (`multipos.parity`).
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from multipos.calibration import Calibration
from multipos.errors import MultiposError, UsageError
from multipos.files import Column, Source, Table, read_table
from multipos.inverse import sensed_axes
from multipos.model import COMPONENTS
from multipos.parity import FAULT_LEVEL, parity
from multipos.tilt import at_rest, reading_noise, tilt_at_rest
from multipos.validity import force_covariance

Array = NDArray[np.float64]

OUTSIDE = ("flag", "clamp", "refuse")
# Noise and placement make |f| of a sensor at rest differ from 1 g; only more than this is outside.
_MARGIN = 0.01
_MARGIN_RMS = 4.0


def apply(
    calibration: Calibration,
    data: Source,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    outside: str = "flag",
) -> dict[str, Column]:
    """Return the columns of a table with the compensated force beside them.

    Parameters
    ----------
    calibration : Calibration
    data : path, mapping of columns, or data frame
        Must have the calibration's outputs, and the columns its model uses.
    tilt : bool
        Add ``tilt_x_deg`` …, the angle of each axis above the horizon, for a sensor at rest.
    uncertainty : bool
        Add ``u_f_x`` … [g], and with tilt ``u_tilt_x_deg`` …, the noise of a reading included.
    outside : str
        'flag' rows beyond what was calibrated, 'clamp' the model's other columns (such as
        temperature) to the calibrated range as well, or 'refuse' the table.

    Returns
    -------
    dict of str to sequence
        Columns in order; force in g, NaN where no force explains the reading.

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.
    """
    if outside not in OUTSIDE:
        raise UsageError(f"--outside takes {', '.join(OUTSIDE)}, got '{outside}'.")
    table = read_table(data, what="data")
    needed = (*calibration.outputs, *calibration.model.environment)
    missing = [name for name in needed if name not in table]
    if missing:
        raise MultiposError(
            f"{table.source}: no column '{missing[0]}', which this calibration needs; "
            f"the columns are {', '.join(table.columns)}."
        )
    raw = np.column_stack([table.number(name) for name in calibration.outputs])
    environment = {name: table.number(name) for name in calibration.model.environment}
    beyond, clamped = _environment_outside(calibration, table, environment)
    if outside == "clamp":
        environment = clamped
    axes = list(sensed_axes(calibration.model))
    if tilt:
        rest = at_rest(calibration, raw, environment)
        force, found = rest[:, axes], tilt_at_rest(calibration, rest, environment)
        beyond |= np.isnan(found.tilt).any(axis=1)
    else:
        force = calibration.compensate(raw, environment)
    beyond |= _force_outside(calibration, force)
    if outside == "refuse" and beyond.any():
        row = int(np.argmax(beyond))
        raise MultiposError(
            f"{table.where(row, needed[0])}: the reading is outside what was calibrated "
            f"({int(beyond.sum())} of {table.rows} rows are); use --outside flag to see them."
        )
    names = [COMPONENTS[i] for i in axes]
    added: dict[str, Column] = {
        f"f_{axis}": force[:, column].tolist() for column, axis in enumerate(names)
    }
    if uncertainty:
        covariance = force_covariance(calibration, force, environment)
        for column, axis in enumerate(names):
            added[f"u_f_{axis}"] = np.sqrt(covariance[:, column, column]).tolist()
    if tilt:
        for column, axis in enumerate(names):
            added[f"tilt_{axis}_deg"] = np.degrees(found.tilt[:, column]).tolist()
        for column, axis in enumerate(names if uncertainty else ()):
            added[f"u_tilt_{axis}_deg"] = np.degrees(found.u[:, column]).tolist()
    if len(calibration.outputs) > len(axes):
        odd = parity(calibration, raw, force, environment, reading_noise(calibration))
        added["parity"] = odd.size.tolist()
        added["fault"] = (odd.p < FAULT_LEVEL).astype(int).tolist()
    added["outside"] = beyond.astype(int).tolist()
    twice = [name for name in added if name in table]
    if twice:
        raise MultiposError(
            f"{table.source}: column '{twice[0]}' is there already; rename it, apply writes it."
        )
    return {**table.columns, **added}


def _force_outside(calibration: Calibration, force: Array) -> NDArray[np.bool_]:
    size = np.linalg.norm(force, axis=1)
    largest = float(np.linalg.norm(calibration.reference, axis=1).max())
    limit = largest * (1.0 + _MARGIN) + _MARGIN_RMS * calibration.rms
    result: NDArray[np.bool_] = ~(size <= limit)  # NaN is outside
    return result


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

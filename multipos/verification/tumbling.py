"""The front door of a tumble: any number of outputs, any mix of rolls, passes and known forces.

Every output is a tumble by itself (`multipos.verification.single_axis`). Together they tell more of
the turntable, since all of them stand on the same one (`multipos.uncertainty.turntable`), and how
their input axes lie to each other: with the direction of row i scaled to one along its own axis,

    M_ij = (dE_i/da_j)/K1_i,      M_ii = 1,                                                 (1)

off the diagonal delta_o along the pendulous axis of the output and −delta_p along its output axis.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Source
from multipos.finding import Findings, in_order
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import ModelText
from multipos.positions.attitudes import Convention
from multipos.positions.headers import field_of_outputs
from multipos.positions.orientations import orient, refuse_open_rolls
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings, select_outputs
from multipos.positions.scheme import Scheme
from multipos.results import Drawn, Result, Tabular, frozen, stacked
from multipos.sensor.gravity import FieldKind, StatedBench
from multipos.sensor.model import default_axes, stated_facing
from multipos.uncertainty.turntable import BesideTable, TableErrors, table_errors
from multipos.verification.coefficients import (
    TumbleCoefficient,
    coefficients_beside,
    find_hidden_table,
    find_without_u,
    fitted_coefficients,
    roles,
    those_that_hold,
)
from multipos.verification.single_axis import SCHEMA, Tumble, tumble_output


@frozen
class Tumbles(Result, Drawn, Tabular):
    """The tumbles of several outputs on one table.

    Attributes
    ----------
    outputs : dict of str to Tumble
    axes : tuple of str
        The input axis of each.
    table_errors : TableErrors
        By all outputs together.
    beside_table : dict of str to dict of str to TumbleCoefficient
        By output, the coefficients that no error of the table does the same as.
    misalignment, misalignment_u : (M, 3) arrays [rad]
        M_ij of eq. (1), a row an output; NaN where the points cannot tell.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> readings["second"] = 0.5 * volt
    >>> found = mp.tumble(readings, axes="x,x")
    >>> list(found.outputs), found.axes
    (['volt', 'second'], ('x', 'x'))
    """

    outputs: dict[str, Tumble]
    axes: tuple[str, ...]
    table_errors: TableErrors
    beside_table: dict[str, dict[str, TumbleCoefficient]]
    misalignment: Array
    misalignment_u: Array

    def __getitem__(self, output: str) -> Tumble:
        """Return the tumble of an output, as in ``tumble["ax"]["K2"]``."""
        return self.outputs[output]

    @property
    def findings(self) -> Findings:
        """What was found about any output, by its name where that is of one alone."""
        texts = [each.text for found in self.outputs.values() for each in found.findings]
        common = {text for text in texts if texts.count(text) == len(self.outputs)}
        return in_order(
            each if each.text in common else replace(each, text=f"{name}: {each.text}")
            for name, found in self.outputs.items()
            for each in found.findings
        )

    def columns(self) -> dict[str, Any]:
        """Return the coefficients of every output: output, then as of one."""
        return stacked("output", {name: found.columns() for name, found in self.outputs.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/howto/single-axis-tumble.md."""
        return {
            "schema": SCHEMA,
            "outputs": {name: found.to_dict() for name, found in self.outputs.items()},
            "misalignment": {
                "axes": self.axes,
                "value": self.misalignment,
                "u": self.misalignment_u,
                "unit": "rad",
            },
            "table_errors": self.table_errors.to_dict(),
            "beside_table": {
                output: {name: vars(entry) for name, entry in found.items()}
                for output, found in self.beside_table.items()
            },
            "findings": [each.to_dict() for each in self.findings],
        }


def tumble(
    readings: Source | Readings,
    *,
    outputs: Names | None = None,
    axes: Names | None = None,
    scheme: Source | Scheme | None = None,
    model: ModelText | None = None,
    convention: Convention = "specific-force",
    reading_sd: ArrayLike | None = None,
    gravity: float | None = None,
    gravity_u: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
    field: FieldKind | None = None,
    field_size: float | str | None = None,
    field_size_u: float | str | None = None,
    unit: str | None = None,
    range: Sequence[float] | None = None,
    confidence: float = 0.95,
) -> Tumble | Tumbles:
    """Calibrate accelerometers from rolls in gravity, and from known forces beside them.

    Parameters
    ----------
    readings : Readings, path, mapping of columns, or data frame
        At any number of angles of any rolls, evenly spaced or not, in the order of their taking.
    outputs : names, optional
        The outputs, where the readings have other columns.
    axes : names, optional
        The input axis i of each, p and o following in cyclic order: x of one output, else x, y, z;
        -x faces the other way.
    scheme, convention, reading_sd, gravity, gravity_u, latitude, height, field, field_size
    field_size_u, unit, range, confidence
        As in `multipos.fit`.
    model : str, optional
        Eq. (1) of `multipos.verification.coefficients` less what the points cannot separate; a
        model given is taken as it is.

    Returns
    -------
    Tumble
        Of one output; of several `Tumbles`.

    Raises
    ------
    MultiposError
        As in `multipos.fit`.
    RankError
        The points cannot separate K0 and K1 of an output, or the model given.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> found = mp.tumble(readings, unit="V")
    >>> K0 = found.coefficients["K0"]
    >>> print(f"K0 {1e3 * K0.value:.3f} mg, U {1e3 * K0.U:.3f} mg")
    K0 4.806 mg, U 0.001 mg
    """
    data = orient(read_readings(readings, outputs=outputs, unit=unit), scheme)
    refuse_open_rolls(data)
    if field_of_outputs(data.outputs, data.unit, None, field) == "magnetic":
        raise UsageError(
            "a tumble is of accelerometers in gravity; `multipos fit` takes the rolls."
        )
    own = _axes(data, axes)
    bench = StatedBench(
        gravity, gravity_u, latitude, height, field, field_size, field_size_u, range, confidence
    )
    sds = _each(reading_sd, len(own))
    found = {
        name: tumble_output(
            _alone(data, name), facing, bench, model=model, convention=convention, reading_sd=sd
        )
        for name, facing, sd in zip(data.outputs, stated_facing(axes) or own, sds, strict=True)
    }
    if len(found) == 1:
        return found[data.outputs[0]]
    return _together(found, own)


def _axes(data: Readings, axes: Names | None) -> tuple[str, ...]:
    """Return the input axis of every output."""
    if axes is None and len(data.outputs) == 1:
        return COMPONENTS[:1]
    own = default_axes(data.outputs, axes)
    strange = [axis for axis in own if axis not in COMPONENTS]
    if strange or len(own) != len(data.outputs):
        count = len(data.outputs)
        raise UsageError(
            f"--axes takes one of x, y, z for each of {count} outputs "
            f"({', '.join(data.outputs)}), got '{','.join(split_names(own, '--axes'))}'."
        )
    return own


def _each(reading_sd: ArrayLike | None, count: int) -> Sequence[float | None]:
    """Return the stated noise of every output."""
    if reading_sd is None:
        return [None] * count
    sd: list[float] = np.asarray(reading_sd, dtype=np.float64).ravel().tolist()
    if len(sd) not in (1, count):
        raise UsageError(f"--reading-sd takes 1 or {count} values, got {len(sd)}.")
    return sd * count if len(sd) == 1 else sd


def _alone(data: Readings, name: str) -> Readings:
    """Return readings of one output; the others are no columns of its surroundings."""
    if len(data.outputs) == 1:
        return data
    return replace(select_outputs(data, (name,)), environment=data.environment)


def _together(found: dict[str, Tumble], axes: tuple[str, ...]) -> Tumbles:
    table = table_errors(*(one.calibration for one in found.values()))
    beside: dict[str, dict[str, TumbleCoefficient]] = {}
    if table.beside is not None:
        beside = {
            name: coefficients_beside(one.calibration, axis, table.beside)
            for (name, one), axis in zip(found.items(), axes, strict=True)
        }
        found = {
            name: _beside_all(one, axis, beside[name], table.beside)
            for (name, one), axis in zip(found.items(), axes, strict=True)
        }
    value, u = np.full((len(axes), 3), np.nan), np.full((len(axes), 3), np.nan)
    for row, (one, axis) in enumerate(zip(found.values(), axes, strict=True)):
        i, p, o = (COMPONENTS.index(role) for role in roles(axis).values())
        value[row, i], u[row, i] = 1.0, 0.0
        for column, name, sign in ((p, "delta_o", 1.0), (o, "delta_p", -1.0)):
            if name in one.coefficients:
                value[row, column] = sign * one[name].value
                u[row, column] = one[name].u
    return Tumbles(found, axes, table, beside, value, u)


def _beside_all(
    one: Tumble, axis: str, beside: dict[str, TumbleCoefficient], found: BesideTable
) -> Tumble:
    """Return the tumble of an output with what all outputs together tell of the table."""
    plain = fitted_coefficients(one.calibration, axis)
    stated = one.calibration.readings.covariance is not None
    held = those_that_hold(plain, beside, found, stated=stated)
    before = {each.text for each in find_without_u(one.coefficients)}
    kept = (e for e in one.findings if e.text not in before and e.code != "hidden-table")
    said = (*find_without_u(held), *find_hidden_table(held, one.calibration, axis))
    return replace(one, coefficients=held, findings=in_order((*kept, *said)))

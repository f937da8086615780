"""Tumble: accelerometers with input, pendulous and output axis turned in gravity.

- `tumble` returns the `Tumbles` of all outputs, or the `Tumble` of one.
- `tumble_output` returns that of one output of readings.

Least squares give the coefficients of `multipos.verification.coefficients`. The Fourier view
(`multipos.positions.harmonics`) of their residuals is the test of table and model: what no term
explains.

Any number of outputs, any mix of rolls, passes and known forces: every output is a tumble by
itself. Together they show more of the turntable, since all of them stand on the same one
(`multipos.uncertainty.turntable`), and how their input axes lie to each other: with the direction
of row i scaled to one along its own axis,

    M_ij = (dE_i/da_j)/K1_i,      M_ii = 1,                                                 (1)

off the diagonal delta_o along the pendulous axis of the output and −delta_p along its output axis.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Source
from multipos.finding import Finding, Findings, in_order
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import takes_options
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import Formula, ModelText
from multipos.positions.attitudes import AngleZero, Convention
from multipos.positions.harmonics import (
    Harmonic,
    Roll,
    find_rolls,
    residual_series,
    series,
    strange_harmonics,
)
from multipos.positions.open_rolls import refuse_open_rolls
from multipos.positions.orientations import orient
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings, select_outputs
from multipos.positions.scheme import Scheme
from multipos.results import Drawn, Result, Tabular, frozen, stacked
from multipos.sensor.bench import BenchOptions, StatedBench
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import field_sensed
from multipos.sensor.model import Model, default_axes, stated_facing
from multipos.sensor.tilt import reading_noise
from multipos.uncertainty.dividing_head import find_head
from multipos.uncertainty.turntable import BesideTable, TableErrors, table_errors
from multipos.verification.coefficients import (
    DEFAULT,
    TumbleCoefficient,
    coefficients_beside,
    find_hidden_table,
    find_without_u,
    fitted_coefficients,
    formula_of,
    kept_coefficients,
    roles,
    those_that_hold,
)
from multipos.verification.hysteresis import Hysteresis, find_hysteresis

# Which a tumble says in its own words, or of which it has no option.
_OF_TUMBLE = ("hidden-table", "inseparable", "part-of-a-turn")


SCHEMA = "multipos/tumble/1"
_LEANING = 0.1  # rad, by which an input axis that is mounted by hand lies from where it should
_ROUNDING = 1e-12  # residuals below this part of the largest reading are rounding


@frozen
class Tumble(Result, Drawn, Tabular):
    """A single-axis tumble: coefficients, harmonics, and the calibration that they come from.

    Attributes
    ----------
    coefficients : dict of str to TumbleCoefficient
        Those that the points can tell, in the order of `COEFFICIENTS`; u and U are NaN of those
        that lean on errors of the table which are beyond chance.
    calibration : Calibration
    rolls : tuple of Roll
    harmonics, residual_harmonics : tuples of Harmonic
        Of the readings and of their residuals.
    table_errors : TableErrors
    unidentifiable : tuple of str
        What the points do not tell, or tell at the cost of another coefficient.
    hysteresis : dict of plane to Hysteresis
        Of the rolls that were passed forward and backward.
    findings : tuple of Finding
        Of the calibration, and of the tumble.
    beside_table : dict of str to TumbleCoefficient
        Those coefficients that no error of the table does the same as, estimated beside all.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> found = mp.tumble(readings, unit="V")
    >>> list(found.coefficients)
    ['K0', 'K1', 'delta_o', 'K2', 'K3', 'Kip']
    >>> print(f"{found.harmonics[1].order}: {found.harmonics[1].amplitude:.3f} V")
    1: 2.500 V
    """

    coefficients: dict[str, TumbleCoefficient]
    calibration: Calibration
    rolls: tuple[Roll, ...]
    harmonics: tuple[Harmonic, ...]
    residual_harmonics: tuple[Harmonic, ...]
    table_errors: TableErrors
    unidentifiable: tuple[str, ...]
    hysteresis: dict[str, Hysteresis]
    beside_table: dict[str, TumbleCoefficient]
    findings: Findings = ()

    @property
    def taken_as_zero(self) -> tuple[str, ...]:
        """Coefficients that the model leaves out."""
        return tuple(name for name in DEFAULT if name not in self.coefficients)

    def __getitem__(self, name: str) -> TumbleCoefficient:
        """Return a coefficient by name, as in ``tumble["K2"]``."""
        return self.coefficients[name]

    def columns(self) -> dict[str, Any]:
        """Return the coefficients: name, value, u, k, U, unit."""
        names = ("value", "u", "k", "U", "unit")
        fields = {key: [getattr(c, key) for c in self.coefficients.values()] for key in names}
        return {"name": list(self.coefficients), **fields}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/howto/single-axis-tumble.md."""
        return {
            "schema": SCHEMA,
            **{name: vars(found) for name, found in self.coefficients.items()},
            "harmonics": [entry.to_dict() for entry in self.harmonics],
            "residual_harmonics": [
                {**entry.to_dict(), "p": entry.p} for entry in self.residual_harmonics
            ],
            "hysteresis": {plane: vars(found) for plane, found in self.hysteresis.items()},
            "table_errors": self.table_errors.to_dict(),
            "beside_table": {name: vars(found) for name, found in self.beside_table.items()},
            "unidentifiable": self.unidentifiable,
            "taken_as_zero": self.taken_as_zero,
            "findings": [finding.to_dict() for finding in self.findings],
            "calibration": self.calibration.to_dict(),
        }


def tumble_output(
    data: Readings,
    facing: str,
    bench: StatedBench,
    *,
    model: ModelText | None,
    convention: Convention,
    reading_sd: float | None,
) -> Tumble:
    """Return the tumble of oriented readings of one output along an axis.

    Parameters
    ----------
    data : Readings
    facing : str
        Its input axis i, with a minus where it faces the other way; p and o follow in cyclic order.
    bench : StatedBench
    model, convention, reading_sd
        As in `multipos.tumble`.
    """
    axis = facing.removeprefix("-")
    sign = -1.0 if convention == "gravity" else 1.0
    rolls = find_rolls(data, axis, sign)
    limited = _on_part_of_a_turn(data, rolls)
    names, unidentifiable = kept_coefficients(
        data, axis, sign, limited=bool(limited), chosen=model is not None
    )
    calibration = fit(
        data,
        model=model or Formula(formula_of(names, axis)),
        axes=(facing,),
        convention=convention,
        reading_sd=reading_sd,
        exclude="none",  # a roll is judged by its harmonics, which need every angle
        **vars(bench),
    )
    coefficients = fitted_coefficients(calibration, axis)
    signal = calibration.readings.values[:, 0]
    rounding = _ROUNDING * float(np.abs(signal).max())
    residual = residual_series(
        rolls, calibration.residuals[:, 0], _design(calibration.model, calibration), rounding
    )
    sd = float(reading_noise(calibration)[0])
    table = table_errors(calibration)
    beside = {} if table.beside is None else coefficients_beside(calibration, axis, table.beside)
    stated = calibration.readings.covariance is not None
    held = those_that_hold(coefficients, beside, table.beside, stated=stated)
    findings = (
        *(each for each in calibration.findings if each.code not in _OF_TUMBLE),
        *_of_plane(coefficients, calibration),
        *limited,
        *strange_harmonics(residual),
        *find_without_u(held),
        *find_hidden_table(held, calibration, axis),
    )
    return Tumble(
        coefficients=held,
        calibration=calibration,
        rolls=rolls,
        harmonics=series(rolls, signal, sd if sd > rounding else None),
        residual_harmonics=residual,
        table_errors=table,
        unidentifiable=unidentifiable,
        findings=in_order(findings),
        hysteresis=find_hysteresis(
            _mounted_once(calibration.readings, rolls),
            signal / coefficients["K1"].value,
            calibration.confidence,
        ),
        beside_table=beside,
    )


def _mounted_once(readings: Readings, rolls: tuple[Roll, ...]) -> tuple[Roll, ...]:
    """Return the rolls that were not taken in several mountings, which differ by more."""
    axes = [one.roll.axis for one in find_head(readings)]
    return tuple(roll for roll in rolls if axes.count(roll.axis) < 2)


def _of_plane(found: Mapping[str, TumbleCoefficient], c: Calibration) -> Findings:
    """Find a plane where the input axis leans too far for the coefficients to be its own."""
    if {"no-signal", "turned"} & {finding.code for finding in c.findings}:
        return ()  # the same, said already
    sizes = [abs(found[name].value) for name in ("delta_o", "delta_p") if name in found]
    lean = math.hypot(*sizes)
    if not lean > _LEANING:
        return ()
    axis, degrees = c.model.axes[0], math.degrees(math.atan(lean))
    text = (
        f"the input axis of {c.outputs[0]} is {degrees:.2g} degrees from {axis}: K1 and the terms "
        f"of higher order are those along {axis}"
    )
    action = "Check roll_axis, the angle that is zero, and --axes."
    return (Finding("wrong-plane", "warning", text, action, outputs=c.outputs),)


def _on_part_of_a_turn(data: Readings, rolls: tuple[Roll, ...]) -> list[Finding]:
    """Say that no roll spans a turn, and what can be identified then; nothing where one does."""
    if not rolls or data.forced.any() or any(roll.spans_a_turn for roll in rolls):
        return []
    return [
        Finding(
            "part-of-a-turn",
            "warning",
            (
                f"the {len(roll.distinct)} angles in plane {roll.plane} leave "
                f"{np.degrees(roll.gap):.4g} of 360 degrees empty: no harmonics; results hold for "
                "these angles only"
            ),
            "Measure without a gap wider than 180 degrees.",
        )
        for roll in rolls
    ]


def _design(model: Model, calibration: Calibration) -> Array:
    phi = model.basis(calibration.reference, calibration.readings.environment)
    return np.asarray(phi[:, model.columns[0]])


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


@takes_options(BenchOptions, fit)
def tumble(
    readings: Source | Readings,
    *,
    outputs: Names | None = None,
    axes: Names | None = None,
    scheme: Source | Scheme | None = None,
    model: ModelText | None = None,
    convention: Convention = "specific-force",
    reading_sd: ArrayLike | None = None,
    unit: str | None = None,
    angle_zero: AngleZero = "up",
    **stated: Unpack[BenchOptions],
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
    scheme, convention, reading_sd, unit, angle_zero, gravity, gravity_u, latitude, height, field
    field_size, field_size_u, range, confidence
        As in `multipos.fit`.
    model : str, optional
        Eq. (1) of `multipos.verification.coefficients` less what the points cannot separate, and
        less Koq where it makes u of K3 more than twice as large; a model given is taken as it is.

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
    K0 4.807 mg, U 0.001 mg
    """
    data = orient(
        read_readings(readings, outputs=outputs, unit=unit, angle_zero=angle_zero), scheme
    )
    refuse_open_rolls(data)
    if field_sensed(data.outputs, data.unit, stated.get("field")).angle != "tilt":
        raise UsageError(
            "a tumble is of accelerometers in gravity; `multipos fit` takes the rolls."
        )
    own = _axes(data, axes)
    bench = StatedBench(**stated)
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
        for (name, one), axis in zip(tuple(found.items()), axes, strict=True):
            beside[name] = coefficients_beside(one.calibration, axis, table.beside)
            found[name] = _beside_all(one, axis, beside[name], table.beside)
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

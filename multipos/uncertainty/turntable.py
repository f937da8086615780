"""The turntable's own errors: what they do to readings, and which of them the data can tell.

The table is off by e(t), five quantities a roll, and its shaft off the horizon, three, which move
the readings by eqs. (1) to (3) of `multipos.uncertainty.turntable`. Against the terms of an
input axis along cos t, eq. (2) there is

    e_0: −sin t             a misalignment,
    c_1: −sin 2t / 2        the product of the two components,
    s_1: −sin²t             bias and second order,
    c_2: (sin t − sin 3t)/2 nothing else but the misalignment, so it can be identified,
    s_2: (cos 3t − cos t)/2 scale factor and third order:

eqs. (10) to (12) of docs/theory/tumble.md. Whatever a model leaves out can be estimated and stands
beside the names of the terms that would do the same. Between two rolls the zero of an output may
shift, which no term of the sensor does.

An output along the shaft reads the level of the shaft as a shift of its zero, its wobble as
misalignments.

Beside all of this the parameters of the sensor that no error does the same as are what none moves.

One dividing head for all rolls: its circle identified from the sensor by how the case is mounted.

The circle of a head is off by the same at the same angle h of the head, in whatever mounting,

    e(h) = c_1 cos h + s_1 sin h + c_2 cos 2h + s_2 sin 2h,                                 (1)

while the case stands at t = ±h + t_0 + e_0, each mounting with a sense, a start t_0 and a zero e_0
of its own. The readings move by

    dy = M (du/dt) (e_0 ± e(h)),                                                            (2)

u and M as in `multipos.uncertainty.turntable`. Against h = t, what c_1 does is the product of
two components, what s_1 does is second order with bias; in a mounting that goes round the other
way c_1 does the opposite, in one turned by half a turn both do. So one further roll, mounted
otherwise, tells the circle from all that is second order in every output, also in those that
it does not turn. What stays are the misalignments, for which the e_0 of each mounting pass.

Level and wobble of the shaft, eq. (3) there, are of each mounting.

The sensor and the table of one or several calibrations of the same positions, as columns.

How a turntable that is not where it says moves the readings of a roll.

The table says t and stands at t + e(t), on each roll with its own

    e(t) = e_0 + c_1 cos t + s_1 sin t + c_2 cos 2t + s_2 sin 2t,                           (3)

a zero offset of the encoder and two harmonics of its circle. A reading then moves by

    dy = M (du/dt) e(t),    u = (cos t, sin t) in the plane of the roll,                    (4)

M the linear part of the model.

The shaft a itself may stand off the horizon by l, and nod as it turns,

    f_a = ±g (l + w_c cos t + w_s sin t).                                                   (5)

Eqs. (10) and (11) of docs/theory/tumble.md.

What rolls tell of the turntable, and of the sensor beside it: results of `turntable`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import RankError
from multipos.estimation.gains import estimator_gain
from multipos.estimation.known import ZERO_NORM
from multipos.files.numbers import in_unit
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, median
from multipos.numerics.factoring import separability
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor, f_tail, t_tail
from multipos.positions.harmonics import Roll, find_rolls
from multipos.positions.readings import Readings
from multipos.results import Result, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model, build_model
from multipos.sensor.tilt import magnitude_of

QUANTITIES = ("zero_offset", "first_cos", "first_sin", "second_cos", "second_sin")
SHAFT = ("level", "wobble_cos", "wobble_sin")


def turn_of(calibration: Calibration, roll: Roll) -> Array:
    """Return df/dt (n, 3) [g] of a roll."""
    first, second = (COMPONENTS.index(name) for name in roll.plane)
    result = np.zeros((len(roll.rows), 3))
    result[:, first], result[:, second] = -np.sin(roll.angle), np.cos(roll.angle)
    return calibration.sign * magnitude_of(calibration) * result


def table_effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return eq. (4) per radian of each quantity of each roll (n M, 5 rolls)."""
    n, m = len(calibration.readings), len(linear)
    result = np.zeros((n, m, len(QUANTITIES) * len(rolls)))
    for place, roll in enumerate(rolls):
        t = roll.angle
        waves = (np.ones(len(t)), np.cos(t), np.sin(t), np.cos(2.0 * t), np.sin(2.0 * t))
        moved = turn_of(calibration, roll) @ linear.T
        for number_, wave in enumerate(waves):
            result[roll.rows, :, len(QUANTITIES) * place + number_] = wave[:, None] * moved
    return result.reshape(n * m, -1)


def shaft_effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return what eq. (5) does to the readings per radian of each quantity (n M, 3 rolls)."""
    n, m = len(calibration.readings), len(linear)
    result = np.zeros((n, m, len(SHAFT) * len(rolls)))
    size = calibration.sign * magnitude_of(calibration)
    for place, roll in enumerate(rolls):
        along = size * linear[:, COMPONENTS.index(roll.axis)]
        waves = (np.ones(len(roll.angle)), np.cos(roll.angle), np.sin(roll.angle))
        for number_, wave in enumerate(waves):
            result[roll.rows, :, len(SHAFT) * place + number_] = np.outer(wave, along)
    return result.reshape(n * m, -1)


_FOUND = 1e-3  # chance of a table's errors where there are none


@frozen
class TableError(Result):
    """One quantity of the table on one roll; value, u, U are None where it cannot be identified.

    `confounded_with` names the terms of the sensor that do the same to the readings, whether the
    model has them or leaves them out.
    """

    plane: str
    quantity: str
    value_deg: float | None
    u_deg: float | None
    U_deg: float | None
    confounded_with: tuple[str, ...]


@frozen
class ZeroShift(Result):
    """How far the zero of an output lies, on one roll, from where it was on the first."""

    plane: str
    output: str
    value: float
    u: float
    U: float
    unit: str
    p: float


@frozen
class BesideTable(Result):
    """The parameters of the sensor, estimated together with every error of the table.

    Attributes
    ----------
    keys : tuple of (output, term)
    parameters, covariance : (p,), (p, p) arrays
    identifiable : tuple of bool
        Which of them no error of the table does the same as.
    dof : float
    p : float
        Chance of residuals that shrink as much by a table without errors.
    """

    keys: tuple[tuple[str, str], ...]
    parameters: Array
    covariance: Array
    identifiable: tuple[bool, ...]
    dof: float
    p: float

    @property
    def off(self) -> bool:
        """Whether the errors of the table are beyond chance."""
        return self.p < _FOUND


@frozen
class TableErrors(Result, Tabular):
    """What the rolls of a calibration tell of the table, and of the sensor's zero between them.

    `errors` are of the angle, `shaft` is of the shaft; a plane is a roll, or a mounting on a head
    whose own angle is known, such as ``xy+0``, and ``head``.
    """

    errors: tuple[TableError, ...]
    zero_shifts: tuple[ZeroShift, ...]
    dof: float
    shaft: tuple[TableError, ...] = ()
    beside: BesideTable | None = None

    def columns(self) -> dict[str, Any]:
        """Return the errors of the angle and of the shaft; None where one cannot be identified."""
        found = (*self.errors, *self.shaft)
        of = ["angle"] * len(self.errors) + ["shaft"] * len(self.shaft)
        names = ("plane", "quantity", "value_deg", "u_deg", "U_deg", "confounded_with")
        return {"of": of, **{name: [getattr(error, name) for error in found] for name in names}}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it."""
        return {
            "errors": [vars(error) for error in self.errors],
            "shaft": [vars(error) for error in self.shaft],
            "zero_shifts": [vars(shift) for shift in self.zero_shifts],
            "dof": self.dof,
        }


_ROUNDING = 1e-12  # of the largest reading


class Bench:
    """The sensor and the table of one or several calibrations of the same positions, as columns."""

    def __init__(self, parts: tuple[Calibration, ...]) -> None:
        self.parts, self.first = parts, parts[0]
        self.models = tuple(part.model for part in parts)
        self.rolls = find_rolls(self.first.readings)
        self.names = tuple(name for model in self.models for name in model.names)
        self.keys = tuple((out, str(term)) for model in self.models for out, term in model.keys)
        self.outputs = tuple(output for model in self.models for output in model.outputs)
        self.values = np.concatenate([_response(part) for part in parts], axis=1)
        self.weight = np.tile(
            np.concatenate([_precision(part) for part in parts]), len(self.first.readings)
        )
        slopes = [
            part.model.linear_part(part.parameters, part.mean_environment)[:, 1:] for part in parts
        ]
        axes = [axis for model in self.models for axis in model.axes]
        own = np.array([[float(axis == name) for name in COMPONENTS] for axis in axes])
        self.linear, self.own = np.concatenate(slopes), own
        self.sensor = self.design(self.models)
        self.shifts = _shifts(self.outputs, len(self.first.readings), self.rolls)
        # What can be identified is a matter of structure: small cross terms must not seem to tell
        # it.
        self.effect, self.nominal = (
            table_effects(self.first, self.rolls, m) for m in (self.linear, own)
        )
        self.shaft, self.shaft_nominal = (
            shaft_effects(self.first, self.rolls, m) for m in (self.linear, own)
        )

    def design(self, models: Sequence[Model]) -> Array:
        """Return the design of models over all outputs (n M, p), output running fastest."""
        parts = [_slopes(m, part) for m, part in zip(models, self.parts, strict=True)]
        n, m, p = len(self.first.readings), len(self.outputs), sum(part.shape[2] for part in parts)
        whole, row, column = np.zeros((n, m, p)), 0, 0
        for part in parts:
            rows, columns = part.shape[1:]
            whole[:, row : row + rows, column : column + columns] = part
            row, column = row + rows, column + columns
        return whole.reshape(n * m, p)


def _slopes(model: Model, calibration: Calibration) -> Array:
    """Return the derivative of readings by the parameters of a model (n, M, p)."""
    own = model is calibration.model
    parameters = calibration.parameters if own else np.zeros(len(model.keys))
    return parameter_jacobian(
        model, parameters, calibration.reference, calibration.readings.environment
    )


def _response(calibration: Calibration) -> Array:
    """Return the readings (n, M) as a linear model has them."""
    c = calibration
    if not isinstance(c.model, ExpressionModel):
        return c.readings.values
    # about its solution, where it is linear
    return np.asarray(c.residuals + _slopes(c.model, c) @ c.parameters)


def _shifts(
    outputs: Sequence[str], n: int, rolls: tuple[Roll, ...]
) -> dict[tuple[str, str], Array]:
    """Return the columns (n M,) of a zero shift of each output on each roll after the first."""
    columns = {}
    for roll in rolls[1:]:
        for place, name in enumerate(outputs):
            member = np.zeros((n, len(outputs)))
            member[roll.rows, place] = 1.0
            columns[roll.plane, name] = member.ravel()
    return columns


def _precision(calibration: Calibration) -> Array:
    """Return the inverse standard deviation of each output (M,), one where none is known."""
    sd = calibration.residual_sd
    usable = np.isfinite(sd).all() and (sd > 0.0).all()
    return 1.0 / sd if usable else np.ones(len(sd))


def separable(design: Array, effects: Array) -> list[int]:
    """Return the columns of `effects` that the design does not explain, the earlier first."""
    kept: list[int] = []
    for column in range(effects.shape[1]):
        trial = np.column_stack([design, effects[:, [*kept, column]]])
        if np.abs(effects[:, column]).max() > ZERO_NORM and (
            separability(trial, least_norm=ZERO_NORM).rank == trial.shape[1]
        ):
            kept.append(column)
    return kept


Sizes = dict[int, tuple[float, float, float]]  # value, u and U of columns by their place


def solve_beside(bench: Bench, design: Array, identifiable: Mask) -> tuple[BesideTable, Sizes]:
    """Return the sensor beside errors of the table, and every column of the design with its U.

    Parameters
    ----------
    bench : Bench
    design : (n M, q) array
        The p columns of the sensor first, then those of the errors, fewer than there are rows.
    identifiable : (p,) array of bool
        Which parameters no error does the same as.
    """
    p, more = len(bench.keys), design.shape[1] - len(bench.keys)
    values = bench.values.ravel() * bench.weight
    found = solve(design * bench.weight[:, None], values)
    alone = solve(bench.sensor * bench.weight[:, None], values)
    dof = float(found.dof)
    variance = float(found.rss) / dof
    covariance = found.cofactor * variance
    gain = max(float(alone.rss) - float(found.rss), 0.0) / more
    least_variance = (
        _ROUNDING * float(np.abs(values).max())
    ) ** 2  # of residuals that are rounding alone
    chance = f_tail(gain / variance, more, dof) if variance > least_variance else 1.0
    u = np.sqrt(np.diag(covariance))
    k = coverage_factor(bench.first.confidence, dof)
    sizes = {i: (float(found.coefficients[i]), float(u[i]), k * float(u[i])) for i in range(len(u))}
    flags = tuple(map(bool, identifiable.tolist()))
    coefficients = found.coefficients[:p]
    return BesideTable(bench.keys, coefficients, covariance[:p, :p], flags, dof, chance), sizes


HEAD = "head_deg"
_SAME = 1e-3  # [rad] by which angles of one mounting may differ, as files round them
_FEWEST = 5  # rows of a mounting: three fit a head that turns twice as far
_MOST = 24  # mountings of a roll


class Mounting(NamedTuple):
    """Rows of a roll taken in one mounting: the case stands at `sense` times the head, and start.

    `roll` has these rows alone; `head` is the angle of the head [rad].
    """

    roll: Roll
    sense: float
    head: Array

    @property
    def name(self) -> str:
        """The plane, the sense and the start in degrees: ``xy+0``."""
        start = float(np.degrees(median(_wrap(self.roll.angle - self.sense * self.head))))
        return f"{self.roll.plane}{'+' if self.sense > 0.0 else '-'}{round(start) % 360}"


def find_head(readings: Readings) -> tuple[Mounting, ...]:
    """Return the mountings of rolls whose head is read; none where its angle fits no rolls."""
    mounted = tuple(_mounted(readings))
    return () if _unused(mounted) else mounted


def find_in_head(readings: Readings) -> list[Finding]:
    """Say where the angle of the head is missing, or turns otherwise than the roll."""
    return _unused(_mounted(readings))


def _unused(mounted: Iterable[Mounting]) -> list[Finding]:
    said = []
    for one in mounted:
        row = int(one.roll.rows[0]) + 1
        if not np.isfinite(one.head).all():
            text = f"readings of the roll about {one.roll.axis} lack `{HEAD}`; it is not used"
            said.append(Finding("head-unused", "warning", text, f"Complete `{HEAD}`."))
        elif len(one.head) < _FEWEST:
            text = (
                f"reading {row}: `{HEAD}` does not follow the angle of the roll about "
                f"{one.roll.axis}; it is not used"
            )
            said.append(Finding("head-unused", "warning", text, f"Correct `{HEAD}`."))
    return said


def _mounted(readings: Readings) -> list[Mounting]:
    if readings.up is None or HEAD not in readings.environment:
        return []
    head = np.radians(readings.environment[HEAD])
    found: list[Mounting] = []
    for roll in find_rolls(readings):
        turned = head[roll.rows]
        if not np.isfinite(turned).all():
            found.append(Mounting(roll, 1.0, turned))
            continue
        for sense, rows in _mountings(roll, turned):
            part = replace(roll, rows=roll.rows[rows], angle=roll.angle[rows])
            found.append(Mounting(part, sense, turned[rows]))
    return found


def _wrap(angle: Array) -> Array:
    """Return angles between −π and π."""
    return np.asarray(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


def _mountings(roll: Roll, head: Array) -> list[tuple[float, Places]]:
    """Return the sense and the places of the rows of each mounting of a roll.

    Of a head that turns by itself a single row, which is no mounting.
    Rows that fit two mountings, as at the start and half a turn on, go with their neighbours.
    """
    starts = {sense: roll.angle - sense * head for sense in (1.0, -1.0)}
    left = np.ones(len(head), dtype=bool)
    fits: list[tuple[float, Mask]] = []
    while left.any():
        row = int(np.argmax(left))
        if len(fits) == _MOST:
            return [(1.0, np.array([row]))]
        both = [(s, np.abs(_wrap(start - start[row])) < _SAME) for s, start in starts.items()]
        best = max(both, key=lambda one: int((one[1] & left).sum()))
        fits.append(best)
        left &= ~best[1]
    fitting = np.array([rows for _, rows in fits])
    clear = np.flatnonzero(fitting.sum(axis=0) == 1)
    place = np.argmax(fitting, axis=0)
    for row in np.flatnonzero(fitting.sum(axis=0) > 1).tolist():
        near = clear[fitting[place[clear], row]]
        if len(near):
            far = 2 * np.abs(near - row) + (near < row)  # of two as near, the one that follows
            place[row] = place[near[np.argmin(far)]]
    found = [(sense, np.flatnonzero(place == i)) for i, (sense, _) in enumerate(fits)]
    return [one for one in found if len(one[1])]


def head_errors(bench: Bench, mounted: tuple[Mounting, ...]) -> TableErrors:
    """Return the sensor beside the head, what the head is off by, and the zero of each mounting."""
    names, columns = _columns(bench, mounted, bench.linear)
    nominal = _columns(bench, mounted, bench.own)[1]
    free = separable(bench.sensor, nominal)
    free = [free[i] for i in separable(bench.sensor, columns[:, free])]
    design = np.column_stack([bench.sensor, columns[:, free]])
    null = separability(np.column_stack([bench.sensor, nominal]), least_norm=ZERO_NORM).null
    identifiable = (null == 0.0).all(axis=1)
    p = len(bench.keys)
    values: Sizes = {}
    beside = None
    if free and len(design) > design.shape[1]:
        beside, sizes = solve_beside(bench, design, identifiable[:p])
        places = enumerate(free, start=p)
        values = {column: sizes[place] for place, column in places if identifiable[p + column]}
    every = [*bench.names, *(f"{quantity} in {plane}" for plane, quantity in names)]
    errors = []
    for column, (plane, quantity) in enumerate(names):
        value, u_deg, U = (
            np.degrees(values[column]).tolist() if column in values else (None, None, None)
        )
        together = null[:, null[p + column] != 0.0]
        others = [
            every[j] for j in np.flatnonzero(together.any(axis=1)).tolist() if j != p + column
        ]
        errors.append(TableError(plane, quantity, value, u_deg, U, tuple(others)))
    felt = np.abs(nominal).max(axis=0, initial=0.0) > ZERO_NORM
    angle = tuple(error for error in errors if error.quantity in QUANTITIES)
    shaft = tuple(e for e, seen in zip(errors, felt, strict=True) if seen and e.quantity in SHAFT)
    return TableErrors(angle, (), 0.0 if beside is None else beside.dof, shaft, beside)


def _columns(
    bench: Bench, mounted: tuple[Mounting, ...], linear: Array
) -> tuple[list[tuple[str, str]], Array]:
    """Return plane and quantity of each column, and what it does to the readings per radian.

    The circle is the four columns before those of each mounting: its zero, level and wobble.
    """
    n, m = len(bench.first.readings), len(linear)
    circle = np.zeros((n, m, 4))
    own = np.zeros((n, m, 4 * len(mounted)))
    size = bench.first.sign * magnitude_of(bench.first)
    names = [("head", quantity) for quantity in QUANTITIES[1:]]
    for place, one in enumerate(mounted):
        rows, h = one.roll.rows, one.head
        moved = turn_of(bench.first, one.roll) @ linear.T
        waves = np.column_stack([np.cos(h), np.sin(h), np.cos(2.0 * h), np.sin(2.0 * h)])
        circle[rows] = one.sense * moved[:, :, None] * waves[:, None, :]
        along = size * linear[:, COMPONENTS.index(one.roll.axis)]
        own[rows, :, 4 * place] = moved
        nods = np.column_stack([np.ones(len(h)), waves[:, :2]])
        own[rows, :, 4 * place + 1 : 4 * place + 4] = along[None, :, None] * nods[:, None, :]
        names += [(one.name, quantity) for quantity in (QUANTITIES[0], *SHAFT)]
    return names, np.concatenate([circle, own], axis=2).reshape(n * m, -1)


_SPREAD = 8  # angles of a roll, from which on harmonics of the circle differ
_UNSEEN = 0.01  # of the square of an effect, which residuals keep of what they do not show
_HUNDREDTH = math.radians(0.01)
_NAMED = 2  # parameters
_POOR = 1.5  # times by which other parameters enlarge a u
_SHIFTED = 1e-3  # chance of a zero shift where there is none


def has_rolls(calibration: Calibration) -> bool:
    """Tell whether known positions go around far enough to speak of the table.

    A sensor of three axes may have a few positions in a plane by chance; eight are a roll.
    """
    c = calibration
    if c.estimator is not Estimator.LINEAR or c.readings.up is None:
        return False
    fewest = 8 if len(set(c.model.axes)) == len(COMPONENTS) else 3
    rolls = find_rolls(c.readings)
    return any(roll.spans_a_turn and len(roll.distinct) >= fewest for roll in rolls)


def table_errors(calibration: Calibration, *beside: Calibration) -> TableErrors:
    """Estimate the errors of the turntable from the rolls of a calibration, together with it.

    Every quantity of the angle that the model leaves room for is estimated, with the parameters and
    the zero shifts, in one weighted least-squares problem over all outputs. Where the readings have
    the angle of the head itself, `head_deg`, its circle is one for all mountings
    (`multipos.uncertainty.turntable`).

    Parameters
    ----------
    calibration : Calibration
        Of readings with at least one roll; without, everything is empty.
    beside : Calibrations
        Of further outputs that were read at the same positions.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> found = mp.table_errors(mp.fit(readings, axes="x", inputs="x,y"))
    >>> [(error.quantity, error.value_deg is None) for error in found.errors[:3]]
    [('zero_offset', True), ('first_cos', False), ('first_sin', False)]
    """
    for each in (calibration, *beside):
        require(each, Calibration)
    mounted = find_head(calibration.readings)
    try:
        bench = Bench((calibration, *beside))
        return head_errors(bench, mounted) if mounted else _estimate(bench)
    except RankError:  # beside a finished fit this says nothing, rather than end it
        return TableErrors((), (), 0.0)


def _estimate(bench: Bench) -> TableErrors:
    shifts, kept, design = _separated(bench.sensor, bench.shifts, bench.nominal, bench.effect)
    if not (kept or shifts) or len(design) <= design.shape[1]:
        return TableErrors(_described(bench, {}), (), 0.0, _shaft_described(bench, {}))
    c, weight = bench.first, bench.weight
    found = solve(design * weight[:, None], bench.values.ravel() * weight)
    dof = float(found.dof)
    u = np.sqrt(np.diag(found.cofactor) * float(found.rss) / dof)
    k = coverage_factor(c.confidence, dof)
    first = len(bench.keys)
    zero_shifts = []
    for place, (plane, output) in enumerate(shifts, start=first):
        value, sd = float(found.coefficients[place]), float(u[place])
        p = t_tail(value / sd, dof) if sd > 0.0 else 1.0
        zero_shifts.append(ZeroShift(plane, output, value, sd, k * sd, c.model.unit, p))
    values = {
        column: (float(found.coefficients[place]), float(u[place]), k * float(u[place]))
        for place, column in enumerate(kept, start=first + len(shifts))
    }
    beside, shaft = _beside(bench, design)
    errors = _described(bench, values)
    return TableErrors(errors, tuple(zero_shifts), dof, _shaft_described(bench, shaft), beside)


def _beside(bench: Bench, design: Array) -> tuple[BesideTable | None, Sizes]:
    """Return the sensor beside every error, and the errors of the shaft that can be identified."""
    free = separable(design, bench.shaft_nominal)
    free = [free[i] for i in separable(design, bench.shaft[:, free])]
    whole = np.column_stack([design, bench.shaft[:, free]])
    if len(whole) <= whole.shape[1]:
        return None, {}
    everything = np.column_stack(
        [bench.sensor, *bench.shifts.values(), bench.nominal, bench.shaft_nominal]
    )
    null = separability(everything, least_norm=ZERO_NORM).null
    kept, sizes = solve_beside(bench, whole, (null[: len(bench.keys)] == 0.0).all(axis=1))
    return kept, {column: sizes[i] for i, column in enumerate(free, start=design.shape[1])}


def _separated(
    sensor: Array, shifts: Mapping[tuple[str, str], Array], nominal: Array, effect: Array
) -> tuple[dict[tuple[str, str], Array], list[int], Array]:
    """Return the zero shifts and identifiable columns of `effect`, and the design of all."""
    free = separable(sensor, np.column_stack([*shifts.values(), nominal]))
    kept_shifts = {key: shifts[key] for i, key in enumerate(shifts) if i in free}
    design = np.column_stack([sensor, *kept_shifts.values()])
    kept = [i - len(shifts) for i in free if i >= len(shifts)]
    kept = [kept[i] for i in separable(design, effect[:, kept])]  # nor may small terms hide it
    return kept_shifts, kept, np.column_stack([design, effect[:, kept]])


def changes_unseen(calibration: Calibration) -> Array:
    """Return by how much harmonics of the table change each parameter (p,), and no residual.

    Of a hundredth of a degree, of the harmonic of one roll or of all alike that changes it most;
    zero where the rolls show every harmonic, or the covariance of the readings, the budget or the
    angle of the head states the table.
    """
    c = calibration
    changed = np.zeros(len(c.parameters))
    stated = c.readings.covariance is not None or "index" in c.budget_tables
    if c.estimator is not Estimator.LINEAR or c.readings.up is None or stated:
        return changed
    rolls = tuple(r for r in find_rolls(c.readings) if len(r.distinct) >= _SPREAD)
    if not any(roll.spans_a_turn for roll in rolls) or find_head(c.readings):
        return changed
    linear = c.model.linear_part(c.parameters, c.mean_environment)[:, 1:]
    each = table_effects(c, rolls, linear).reshape(-1, len(rolls), len(QUANTITIES))[:, :, 1:]
    effects = np.concatenate([*each.swapaxes(0, 1), each.sum(axis=1)], axis=1)
    gain = estimator_gain(c)
    slopes = parameter_jacobian(c.model, c.parameters, c.reference, c.readings.environment)
    left = effects - slopes.reshape(len(effects), -1) @ (gain @ effects)
    hidden = np.sum(left**2, axis=0) < _UNSEEN * np.sum(effects**2, axis=0)
    moved = np.abs(gain @ effects[:, hidden]).max(axis=1, initial=0.0)
    return np.asarray(np.where(moved > _UNSEEN * moved.max(initial=0.0), moved, 0.0) * _HUNDREDTH)


def in_words_of_unseen(changes: Sequence[tuple[str, float, str, float]]) -> str:
    """Return what U leaves out, from name, change, unit and U of what harmonics change."""
    largest = sorted(changes, key=lambda each: -each[1] / max(each[3], 1e-300))[:_NAMED]
    listed = ", ".join(f"{name} by {in_unit(size, unit)}" for name, size, unit, _ in largest)
    return (
        "U excludes harmonics of the table's angle, which these rolls cannot show: 0.01 degrees of "
        f"one change {listed}"
    )


def find_in_rolls(calibration: Calibration) -> list[Finding]:
    """Say which rolls leave much of the turn out, and which zeros shifted between rolls."""
    rolls, action = find_rolls(calibration.readings), "Take positions over the full circle."
    poor = any(not roll.spans_a_turn for roll in rolls) and _largest_loss(calibration) > _POOR
    own = tuple(axis for axis in calibration.model.inputs if axis in calibration.model.axes)
    if own != calibration.model.inputs:  # a tilt sensor has no more of the circle
        action = f"Fit with --inputs {','.join(own)}, or take positions over the full circle."
    said = [
        Finding(
            "part-of-a-turn",
            "warning",
            (
                f"the roll about {roll.axis} leaves {np.degrees(roll.gap):.4g} of "
                "360 degrees without a position; bias, scale and cross terms are "
                "poorly separated there"
            ),
            action,
        )
        for roll in rolls
        if not roll.spans_a_turn and poor
    ]
    said += find_in_head(calibration.readings)
    if len(rolls) < 2:
        return said
    for shift in table_errors(calibration).zero_shifts:
        if shift.p < _SHIFTED:
            text = (
                f"the bias of {shift.output} shifted by {shift.value:.2g} {shift.unit} between the "
                f"rolls in {rolls[0].plane} and {shift.plane}; U excludes it"
            )
            named, action = (shift.output,), "State the shift of the bench with state_bench."
            said.append(Finding("zero-shift", "warning", text, action, outputs=named, p=shift.p))
    return said


def _largest_loss(c: Calibration) -> float:
    """Return how many times, at most, a parameter's u is larger for the others being fitted."""
    largest = 1.0
    _, blocks = c.model.respond(c.parameters, c.reference, c.readings.environment)
    for _, slopes in blocks:
        inverse = np.linalg.pinv(slopes)
        loss = np.linalg.norm(inverse, axis=1) * np.linalg.norm(slopes, axis=0)
        largest = max(largest, float(loss.max(initial=1.0)))
    return largest


def _described(bench: Bench, values: Sizes) -> tuple[TableError, ...]:
    """Return every quantity with its value where the model and the positions can tell it."""
    names = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in QUANTITIES]
    hidden = _confounded(bench, bench.models, bench.nominal, names)
    fullest = [_fullest(model) for model in bench.models]
    same = _confounded(bench, fullest, bench.nominal, names)
    identifiable = {column: value for column, value in values.items() if not hidden[names[column]]}
    return _named(bench, QUANTITIES, identifiable, same, names)


def _shaft_described(bench: Bench, values: Sizes) -> tuple[TableError, ...]:
    """Return the quantities of the shaft that the outputs feel, as `_described` does."""
    table = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in QUANTITIES]
    names = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in SHAFT]
    both = np.column_stack([bench.nominal, bench.shaft_nominal])
    same = _confounded(bench, bench.models, both, [*table, *names])
    identifiable = {column: value for column, value in values.items() if not same[names[column]]}
    found = _named(bench, SHAFT, identifiable, same, names)
    felt = np.abs(bench.shaft_nominal).max(axis=0, initial=0.0) > ZERO_NORM
    return tuple(error for error, seen in zip(found, felt.tolist(), strict=True) if seen)


def _named(
    bench: Bench,
    quantities: Sequence[str],
    identifiable: Sizes,
    same: Mapping[str, tuple[str, ...]],
    names: Sequence[str],
) -> tuple[TableError, ...]:
    errors = []
    for column, name in enumerate(names):
        place, number_ = divmod(column, len(quantities))
        value, u, U = (
            np.degrees(identifiable[column]).tolist()
            if column in identifiable
            else (None, None, None)
        )
        plane = bench.rolls[place].plane
        errors.append(TableError(plane, quantities[number_], value, u, U, same[name]))
    return tuple(errors)


def _fullest(model: Model) -> Model:
    """Return the model of all terms up to second order and the own third."""
    formula = "1 + x + y + z + x*y + x*z + y*z + own^2 + own^3"
    return build_model(formula, model.outputs, model.axes, unit=model.unit)


def _confounded(
    bench: Bench, models: Sequence[Model], nominal: Array, names: list[str]
) -> dict[str, tuple[str, ...]]:
    """Return for each quantity what together does the same as it to the readings, by name."""
    base = [bench.design(models), *bench.shifts.values()]
    terms = [name for model in models for name in model.names]
    every = [
        *terms,
        *(f"zero shift of {output} in {plane}" for plane, output in bench.shifts),
        *names,
    ]
    null = separability(np.column_stack([*base, nominal]), least_norm=ZERO_NORM).null
    result: dict[str, tuple[str, ...]] = {}
    for row, name in enumerate(every):
        if name not in names:
            continue
        together = null[:, null[row] != 0.0]
        others = [every[j] for j in np.flatnonzero(together.any(axis=1)).tolist() if j != row]
        # One that no output feels at all has no company, but cannot be identified either.
        result[name] = tuple(others) or (("nothing that the outputs feel",) * bool(together.size))
    return result

"""The turntable's own errors: what they do to readings, and which of them the data can identify.

`table_errors` estimates them from the rolls of a calibration, together with the sensor;
`table_effects` returns their columns, `has_rolls` tells whether there are rolls enough,
`changes_unseen` by how much harmonics that no residual shows change each parameter and
`in_words_of_unseen` says it, `find_in_rolls` finds what is wrong with them, and `state_bench`
returns the covariance of readings on a bench whose errors are stated.

The table says t and stands at t + e(t), on each roll with its own

    e(t) = e_0 + c_1 cos t + s_1 sin t + c_2 cos 2t + s_2 sin 2t,                           (1)

a zero offset of the encoder and two harmonics of its circle. A reading then moves by

    dy = M (du/dt) e(t),    u = (cos t, sin t) in the plane of the roll,                    (2)

M the linear part of the model. The shaft a itself may stand off the horizon by l, and nod as it
turns,

    f_a = ±g (l + w_c cos t + w_s sin t).                                                   (3)

All of these are one design matrix beside that of the sensor. An error of size x moves the force at
position k by w_k d_k x, a wave w of its angle times the turn d = df/dt of the case or the direction
d = ±g a of the shaft, and its column is

    G_k = w_k M d_k.                                                                        (4)

Table, shaft and head (`multipos.uncertainty.dividing_head`) differ in waves and rows alone. Where
the errors are stated, each with a standard deviation u_q, with a zero that drifts by u_z from roll
to roll (columns of one) and an angle off by u_t at each position by itself (w one at that
position), readings have the covariance

    V = s² I + sum_q u_q² G_q G_q',                                                         (5)

s the noise of a reading. Against the terms of an input axis along cos t, eq. (2) is

    e_0: −sin t             a misalignment,
    c_1: −sin 2t / 2        the product of the two components,
    s_1: −sin²t             bias and second order,
    c_2: (sin t − sin 3t)/2 nothing else but the misalignment, so it can be identified,
    s_2: (cos 3t − cos t)/2 scale factor and third order.

Whatever a model leaves out can be estimated and stands beside the names of the terms that would do
the same. Between two rolls the zero of an output may shift, which no term of the sensor does. An
output along the shaft reads the level of the shaft as a shift of its zero, its wobble as
misalignments. Eqs. (10) to (13) of docs/theory/tumble.md.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from multipos.errors import RankError
from multipos.estimation.gains import estimator_gain
from multipos.estimation.known import ZERO_NORM
from multipos.files.numbers import in_unit
from multipos.finding import Finding, short_text
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor, f_tail, t_tail
from multipos.numerics.separability import separability
from multipos.positions.harmonics import Roll, find_rolls
from multipos.positions.readings import Readings
from multipos.results import Result, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model, build_model
from multipos.sensor.tilt import magnitude_of
from multipos.uncertainty.dividing_head import Mounting, find_head, find_in_head

QUANTITIES = ("zero_offset", "first_cos", "first_sin", "second_cos", "second_sin")
SHAFT = ("level", "wobble_cos", "wobble_sin")


# Rows (k,) of the readings, change of force d (k, 3) and waves w (k, q) of some errors.
Part = tuple[Places, Array, Array]


def _columns(n: int, linear: Array, parts: Iterable[Part]) -> Array:
    """Return eq. (4) of every error (n M, q), of a sensor with slopes M (M, 3)."""
    blocks = [np.zeros((n, len(linear), 0))]
    for rows, force, waves in parts:
        block = np.zeros((n, len(linear), waves.shape[1]))
        block[rows] = (force @ linear.T)[:, :, None] * waves[:, None, :]
        blocks.append(block)
    return np.concatenate(blocks, axis=2).reshape(n * len(linear), -1)


def _waves(angle: Array) -> Array:
    """Return (k, 5): one, and cosine and sine of the angle and its double."""
    t = angle
    return np.column_stack([np.ones(len(t)), np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)])


def _turn(calibration: Calibration, roll: Roll) -> Array:
    """Return df/dt (k, 3) [g] of a roll."""
    first, second = (COMPONENTS.index(name) for name in roll.plane)
    result = np.zeros((len(roll.rows), 3))
    result[:, first], result[:, second] = -np.sin(roll.angle), np.cos(roll.angle)
    return calibration.sign * magnitude_of(calibration) * result


def _along(calibration: Calibration, roll: Roll) -> Array:
    """Return the direction of the shaft of a roll, of the size of gravity (k, 3) [g]."""
    result = np.zeros((len(roll.rows), 3))
    result[:, COMPONENTS.index(roll.axis)] = calibration.sign * magnitude_of(calibration)
    return result


def _of_table(c: Calibration, rolls: Iterable[Roll]) -> list[Part]:
    return [(roll.rows, _turn(c, roll), _waves(roll.angle)) for roll in rolls]


def _of_shaft(c: Calibration, rolls: Iterable[Roll]) -> list[Part]:
    return [(roll.rows, _along(c, roll), _waves(roll.angle)[:, :3]) for roll in rolls]


def _of_head(c: Calibration, mounted: Sequence[Mounting]) -> list[Part]:
    """Return the circle of a head, and zero, level and wobble of each mounting."""
    rows = np.concatenate([one.roll.rows for one in mounted])
    turned = np.concatenate([one.sense * _turn(c, one.roll) for one in mounted])
    parts = [(rows, turned, _waves(np.concatenate([one.head for one in mounted]))[:, 1:])]
    for one in mounted:
        waves = _waves(one.head)[:, :3]
        parts.append((one.roll.rows, _turn(c, one.roll), waves[:, :1]))
        parts.append((one.roll.rows, _along(c, one.roll), waves))
    return parts


def table_effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return eq. (2) per radian of each quantity of each roll (n M, 5 rolls)."""
    return _columns(len(calibration.readings), linear, _of_table(calibration, rolls))


class Effects(NamedTuple):
    """What errors do to the readings, a column each.

    What can be identified is a matter of structure: small cross terms must not seem to tell it.

    Attributes
    ----------
    names : tuple of (plane, quantity), or (plane, output) of a shift of its zero
    texts : tuple of str
    actual, nominal : (n M, q) arrays
        With the slopes of the sensor, and with those of one that is exactly along its axes.
    """

    names: tuple[tuple[str, str], ...]
    texts: tuple[str, ...]
    actual: Array
    nominal: Array

    def with_(self, other: "Effects") -> "Effects":
        """Return the columns of both."""
        return Effects(
            self.names + other.names,
            self.texts + other.texts,
            np.column_stack([self.actual, other.actual]),
            np.column_stack([self.nominal, other.nominal]),
        )


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
        self.keys = tuple((out, str(term)) for model in self.models for out, term in model.keys)
        self.outputs = tuple(output for model in self.models for output in model.outputs)
        self.values = np.concatenate([_response(part) for part in parts], axis=1)
        self.weight = np.tile(
            np.concatenate([_precision(part) for part in parts]), len(self.first.readings)
        )
        self.weight *= np.concatenate([_kept(part) for part in parts], axis=1).ravel()
        slopes = [
            part.model.linear_part(part.parameters, part.mean_environment)[:, 1:] for part in parts
        ]
        axes = [axis for model in self.models for axis in model.axes]
        self.own = np.array([[float(axis == name) for name in COMPONENTS] for axis in axes])
        self.linear, self.sensor = np.concatenate(slopes), self.design(self.models)

    def effects(self, names: Iterable[tuple[str, str]], parts: list[Part]) -> Effects:
        """Return the columns of errors by their plane and quantity."""
        named, n = tuple(names), len(self.first.readings)
        texts = tuple(f"{quantity} in {plane}" for plane, quantity in named)
        columns = (_columns(n, slopes, parts) for slopes in (self.linear, self.own))
        return Effects(named, texts, *columns)

    def stages(self) -> tuple[tuple[Effects, Effects], ...]:
        """Return what is estimated one after another: shifts of zeros, and errors of the table."""
        c, mounted = self.first, find_head(self.first.readings)
        none = self.effects((), [])
        if mounted:
            names = [("head", quantity) for quantity in QUANTITIES[1:]]
            names += [(one.name, each) for one in mounted for each in (QUANTITIES[0], *SHAFT)]
            return ((none, self.effects(names, _of_head(c, mounted))),)
        rolls = find_rolls(c.readings)
        angle = [(roll.plane, quantity) for roll in rolls for quantity in QUANTITIES]
        shaft = [(roll.plane, quantity) for roll in rolls for quantity in SHAFT]
        shifts = _shifts(self.outputs, len(c.readings), rolls[1:])
        return (
            (shifts, self.effects(angle, _of_table(c, rolls))),
            (none, self.effects(shaft, _of_shaft(c, rolls))),
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
    environment = calibration.readings.environment
    return parameter_jacobian(model, parameters, _listed(calibration), environment)


def _listed(calibration: Calibration) -> Array:
    """Return the reference (n, 3) [g], as listed where it was estimated about that.

    At estimated positions no residual shows what the table moves, nor the noise of positions.
    """
    c, up, sd = calibration, calibration.readings.up, calibration.readings.orientation_sd
    if up is None or sd is None:
        return c.reference
    group = np.array(c.readings.group or [""] * len(up))
    about = (group == "") & (sd > 0.0) & np.isfinite(sd) & np.isfinite(up).all(axis=1)
    size = np.linalg.norm(c.reference, axis=1, keepdims=True)
    return np.where(about[:, None], c.sign * size * up, c.reference)


def _response(calibration: Calibration) -> Array:
    """Return the readings (n, M) as a linear model has them."""
    c = calibration
    if c.model.has_terms:
        return c.readings.values
    # about its solution, where it is linear
    left = c.readings.values - c.predict(_listed(c), c.readings.environment)
    return np.asarray(left + _slopes(c.model, c) @ c.parameters)


def _shifts(outputs: Sequence[str], n: int, rolls: Iterable[Roll]) -> Effects:
    """Return the columns of a zero shift of each output on each roll."""
    names = tuple((roll.plane, output) for roll in rolls for output in outputs)
    columns = np.zeros((n, len(outputs), len(names)))
    for column, (roll, place) in enumerate(product(rolls, range(len(outputs)))):
        columns[roll.rows, place, column] = 1.0
    flat = columns.reshape(n * len(outputs), -1)
    texts = tuple(f"zero shift of {output} in {plane}" for plane, output in names)
    return Effects(names, texts, flat, flat)


def _precision(calibration: Calibration) -> Array:
    """Return the inverse standard deviation of each output (M,), one where none is known."""
    sd = calibration.residual_sd
    usable = np.isfinite(sd).all() and (sd > 0.0).all()
    return 1.0 / sd if usable else np.ones(len(sd))


def _kept(calibration: Calibration) -> Array:
    """Return 0 for readings (n, M) that a robust fit set aside, 1 for the others."""
    c, shape = calibration, calibration.residuals.shape
    if c.robust_weight is None:
        return np.ones(shape)
    by_row = c.robust_weight.reshape(len(c.residuals), -1) > 0.0
    return np.broadcast_to(by_row, shape).astype(np.float64)


def _separable(design: Array, effects: Array) -> list[int]:
    """Return the columns of `effects` that the design does not explain, the earlier first."""
    kept: list[int] = []
    for column in range(effects.shape[1]):
        trial = np.column_stack([design, effects[:, [*kept, column]]])
        if np.abs(effects[:, column]).max() > ZERO_NORM and (
            separability(trial, least_norm=ZERO_NORM).rank == trial.shape[1]
        ):
            kept.append(column)
    return kept


Sizes = dict[str, tuple[float, float, float]]  # value, u and U


def _solve_beside(
    bench: Bench, design: Array, identifiable: Mask
) -> tuple[BesideTable, list[tuple[float, float, float]]]:
    """Return the sensor beside errors of the table, and value, u and U of these.

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
    dof = float(found.dof - np.count_nonzero(bench.weight == 0.0))
    variance = float(found.rss) / dof
    covariance = found.cofactor * variance
    gain = max(float(alone.rss) - float(found.rss), 0.0) / more
    least_variance = (
        _ROUNDING * float(np.abs(values).max())
    ) ** 2  # of residuals that are rounding alone
    chance = f_tail(gain / variance, more, dof) if variance > least_variance else 1.0
    u = np.sqrt(np.diag(covariance))[p:]
    U = coverage_factor(bench.first.confidence, dof) * u
    sizes = zip(found.coefficients[p:].tolist(), u.tolist(), U.tolist(), strict=True)
    flags = tuple(map(bool, identifiable.tolist()))
    coefficients = found.coefficients[:p]
    beside = BesideTable(bench.keys, coefficients, covariance[:p, :p], flags, dof, chance)
    return beside, list(sizes)


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
    try:
        return _estimate(Bench((calibration, *beside)))
    except RankError:  # beside a finished fit this says nothing, rather than end it
        return TableErrors((), (), 0.0)


def _estimate(bench: Bench) -> TableErrors:
    design, columns, p = bench.sensor, bench.effects((), []), len(bench.keys)
    sizes: Sizes = {}
    estimated: list[str] = []
    errors: list[TableError] = []
    beside, dof, solvable, stages = None, 0.0, True, bench.stages()
    for shifts, effects in stages:
        here = shifts.with_(effects)
        free = _separable(design, here.nominal)
        # nor may small terms hide it
        kept = [free[i] for i in _separable(design, here.actual[:, free])]
        design = np.column_stack([design, here.actual[:, kept]])
        estimated += [here.texts[i] for i in kept]
        columns = columns.with_(here)
        null, same = _confounded(bench, bench.models, columns)
        rows = np.count_nonzero(bench.weight)
        solvable = solvable and bool(estimated) and rows > design.shape[1]
        beside = None
        if solvable:
            beside, fitted = _solve_beside(bench, design, (null[:p] == 0.0).all(axis=1))
            sizes = dict(zip(estimated, fitted, strict=True)) | sizes  # angles without the shaft
            dof = dof or beside.dof
        identifiable = {text: size for text, size in sizes.items() if not same[text]}
        if len(stages) > 1 and not errors:  # terms that the model leaves out do the same, too
            same = _confounded(bench, [_fullest(model) for model in bench.models], columns)[1]
        errors += _described(effects, identifiable, same)
    angle = tuple(error for error in errors if error.quantity in QUANTITIES)
    shaft = tuple(error for error in errors if error.quantity in SHAFT)
    return TableErrors(angle, _zero_shifts(bench, stages[0][0], sizes, dof), dof, shaft, beside)


def _described(
    effects: Effects, sizes: Sizes, same: Mapping[str, tuple[str, ...]]
) -> list[TableError]:
    """Return every quantity with its size where it has one, of the shaft those that are felt."""
    felt = np.abs(effects.nominal).max(axis=0, initial=0.0) > ZERO_NORM
    errors = []
    for name, text, seen in zip(effects.names, effects.texts, felt.tolist(), strict=True):
        plane, quantity = name
        if seen or quantity in QUANTITIES:
            value, u, U = np.degrees(sizes[text]).tolist() if text in sizes else (None, None, None)
            errors.append(TableError(plane, quantity, value, u, U, same[text]))
    return errors


def _zero_shifts(bench: Bench, shifts: Effects, sizes: Sizes, dof: float) -> tuple[ZeroShift, ...]:
    unit, found = bench.first.model.unit, []
    for (plane, output), text in zip(shifts.names, shifts.texts, strict=True):
        if text in sizes:
            value, u, U = sizes[text]
            p = t_tail(value / u, dof) if u > 0.0 else 1.0
            found.append(ZeroShift(plane, output, value, u, U, unit, p))
    return tuple(found)


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
    said = [f"{name} by {in_unit(size, unit)}" for name, size, unit, _ in largest]
    head = (
        "U excludes harmonics of the table's angle, which these rolls cannot show: 0.01 degrees of "
        "one change "
    )
    return short_text(lambda count: head + ", ".join(said[:count]), len(said))


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


def _fullest(model: Model) -> Model:
    """Return the model of all terms up to second order and the own third."""
    formula = "1 + x + y + z + x*y + x*z + y*z + own^2 + own^3"
    return build_model(formula, model.outputs, model.axes, unit=model.unit)


def _confounded(
    bench: Bench, models: Sequence[Model], columns: Effects
) -> tuple[Array, dict[str, tuple[str, ...]]]:
    """Return the null space of sensor and errors, and what together does the same as each error."""
    names = [name for model in models for name in model.names]
    every = [*names, *columns.texts]
    whole = np.column_stack([bench.design(models), columns.nominal])
    null = separability(whole, least_norm=ZERO_NORM).null
    same: dict[str, tuple[str, ...]] = {}
    for row, name in enumerate(every[len(names) :], start=len(names)):
        together = null[:, null[row] != 0.0]
        others = [every[j] for j in np.flatnonzero(together.any(axis=1)).tolist() if j != row]
        # One that no output feels at all has no company, but cannot be identified either.
        same[name] = tuple(others) or (("nothing that the outputs feel",) * bool(together.size))
    return null, same


def state_bench(
    calibration: Calibration,
    *,
    reading_sd: float,
    zero_drift: float = 0.0,
    angle_sd_deg: float = 0.0,
    offset_sd_deg: float = 0.0,
    first_sd_deg: float = 0.0,
    second_sd_deg: float = 0.0,
    level_sd_deg: float = 0.0,
    wobble_sd_deg: float = 0.0,
) -> Readings:
    """Return a calibration's readings with the covariance that a stated bench gives them.

    Fitted again, they give the best estimate on that bench and an uncertainty with all of it in:
    orientation errors that the first fit estimated are left out, as the bench states them.

    Parameters
    ----------
    calibration : Calibration
        A first fit, for the scale factors that turn angles into readings.
    reading_sd : float
        Standard uncertainty of an averaged reading, in reading units.
    zero_drift : float
        Standard deviation of each output's zero from roll to roll, in reading units.
    angle_sd_deg : float
        Error of the table at each position by itself.
    offset_sd_deg, first_sd_deg, second_sd_deg : float
        Of e_0, and of each coefficient of the first and second harmonic, on every roll.
    level_sd_deg, wobble_sd_deg : float
        Of the shaft from the horizon, and of each coefficient of its nodding, on every roll.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> first = mp.fit(readings, axes="x", inputs="x,y")
    >>> known = mp.state_bench(first, reading_sd=5e-5, angle_sd_deg=0.01)
    >>> known.covariance.shape, bool(known.covariance[0, 0] < known.covariance[3, 3])
    ((12, 12), True)
    """
    require(calibration, Calibration)
    model, readings, c = calibration.model, calibration.readings, calibration
    rolls, (n, m) = find_rolls(readings), readings.values.shape
    linear = model.linear_part(c.parameters, c.mean_environment)[:, 1:]
    alone = [(roll.rows, _turn(c, roll), np.eye(len(roll.rows))) for roll in rolls]
    table = [offset_sd_deg, *[first_sd_deg] * 2, *[second_sd_deg] * 2]
    shaft = [level_sd_deg, *[wobble_sd_deg] * 2]
    covariance = np.eye(n * m) * reading_sd**2
    for parts, sd_deg in (
        (alone, [angle_sd_deg] * sum(len(roll.rows) for roll in rolls)),
        (_of_table(c, rolls), table * len(rolls)),
        (_of_shaft(c, rolls), shaft * len(rolls)),
    ):
        moved = _columns(n, linear, parts) * np.radians(sd_deg)
        covariance += moved @ moved.T
    shifted = _shifts(model.outputs, n, rolls).actual * zero_drift
    covariance += shifted @ shifted.T
    sd = np.zeros(n) if readings.orientation_sd is None else readings.orientation_sd
    sd = np.where(np.isinf(sd), sd, 0.0)
    return replace(readings, u=None, covariance=covariance, orientation_sd=sd)

"""The turntable's own errors: what they do to readings, and which of them the data can tell.

The table says t and stands at t + e(t), on each roll with its own

    e(t) = e_0 + c_1 cos t + s_1 sin t + c_2 cos 2t + s_2 sin 2t,                           (1)

a zero offset of the encoder and two harmonics of its circle. A reading then moves by

    dy = M (du/dt) e(t),    u = (cos t, sin t) in the plane of the roll,                    (2)

M the linear part of the model. Against the terms of an input axis along cos t, eq. (2) is

    e_0: −sin t             a misalignment,
    c_1: −sin 2t / 2        the product of the two components,
    s_1: −sin²t             bias and second order,
    c_2: (sin t − sin 3t)/2 nothing else but the misalignment, so it can be told,
    s_2: (cos 3t − cos t)/2 scale factor and third order:

eqs. (10) to (12) of docs/theory/tumble.md. Whatever a model leaves out can be estimated and stands
beside the names of the terms that would do the same. Between two rolls the zero of an output may
shift, which no term of the sensor does.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from multipos.estimation.known import FLOOR
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import separability, solve
from multipos.numerics.quantiles import coverage_factor, t_tail
from multipos.numerics.terms import COMPONENTS
from multipos.positions.harmonics import Roll, find_rolls
from multipos.positions.readings import Readings
from multipos.results import Result
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model, build_model
from multipos.sensor.tilt import magnitude_of

QUANTITIES = ("zero_offset", "first_cos", "first_sin", "second_cos", "second_sin")
_SHIFTED = 1e-3  # chance of a zero shift where there is none


@dataclass(frozen=True, eq=False)
class TableError(Result):
    """One quantity of eq. (1) on one roll; value, u, U are None where it cannot be told.

    `confounded_with` names the terms of the sensor that do the same to the readings, whether the
    model has them or leaves them out.
    """

    plane: str
    quantity: str
    value_deg: float | None
    u_deg: float | None
    U_deg: float | None
    confounded_with: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ZeroShift(Result):
    """How far the zero of an output lies, on one roll, from where it was on the first."""

    plane: str
    output: str
    value: float
    u: float
    U: float
    unit: str
    p: float


@dataclass(frozen=True, eq=False)
class TableErrors(Result):
    """What the rolls of a calibration tell of the table, and of the sensor's zero between them."""

    errors: tuple[TableError, ...]
    zero_shifts: tuple[ZeroShift, ...]
    dof: float

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it."""
        return {
            "errors": [vars(error) for error in self.errors],
            "zero_shifts": [vars(shift) for shift in self.zero_shifts],
            "dof": self.dof,
        }


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


def table_errors(calibration: Calibration) -> TableErrors:
    """Estimate the errors of the turntable from the rolls of a calibration, together with it.

    Every quantity of eq. (1) that the model leaves room for is estimated, with the parameters and
    the zero shifts, in one weighted least-squares problem over all outputs.

    Parameters
    ----------
    calibration : Calibration
        Of readings with at least one roll; without, everything is empty.
    """
    model, readings = calibration.model, calibration.readings
    rolls = find_rolls(readings)
    linear = model.linear_part(calibration.parameters, calibration.mean_environment)[:, 1:]
    own = np.array([[float(axis == name) for name in COMPONENTS] for axis in model.axes])
    effect = _effects(calibration, rolls, linear)
    # What can be told is a matter of structure: small cross terms must not seem to tell it.
    nominal = _effects(calibration, rolls, own)
    sensor, every = _design(model, calibration), _shifts(model, readings, rolls)
    shifts, kept, design = _told_apart(sensor, every, nominal, effect)
    weight = _weights(calibration)
    if (not kept and not shifts) or len(design) <= design.shape[1]:
        return TableErrors(_described(calibration, rolls, nominal, {}), (), 0.0)
    response = readings.values.ravel()
    if isinstance(model, ExpressionModel):  # about its solution, where it is linear
        response = calibration.residuals.ravel() + sensor @ calibration.parameters
    found = solve(design * weight[:, None], response * weight)
    dof = float(found.dof)
    u = np.sqrt(np.diag(found.cofactor) * float(found.rss) / dof)
    k = coverage_factor(calibration.confidence, dof)
    first = len(model.keys)
    zero_shifts = []
    for place, (plane, output) in enumerate(shifts, start=first):
        value, sd = float(found.coefficients[place]), float(u[place])
        p = t_tail(value / sd, dof) if sd > 0.0 else 1.0
        zero_shifts.append(ZeroShift(plane, output, value, sd, k * sd, model.unit, p))
    values = {
        column: (float(found.coefficients[place]), float(u[place]), k * float(u[place]))
        for place, column in enumerate(kept, start=first + len(shifts))
    }
    errors = _described(calibration, rolls, nominal, values)
    return TableErrors(errors, tuple(zero_shifts), dof)


def _told_apart(
    sensor: Array, shifts: Mapping[tuple[str, str], Array], nominal: Array, effect: Array
) -> tuple[dict[tuple[str, str], Array], list[int], Array]:
    """Return the zero shifts and columns of `effect` that can be told, and the design of all."""
    free = _separable(sensor, np.column_stack([*shifts.values(), nominal]))
    told = {key: shifts[key] for i, key in enumerate(shifts) if i in free}
    design = np.column_stack([sensor, *told.values()])
    kept = [i - len(shifts) for i in free if i >= len(shifts)]
    kept = [kept[i] for i in _separable(design, effect[:, kept])]  # nor may small terms hide it
    return told, kept, np.column_stack([design, effect[:, kept]])


def roll_warnings(calibration: Calibration) -> list[str]:
    """Say which rolls leave much of the turn out, and which zeros shifted between rolls."""
    rolls = find_rolls(calibration.readings)
    said = [
        f"the angles of the roll about {roll.axis} do not span a turn: "
        f"{np.degrees(roll.gap):.4g} of 360 degrees are without a position, where zero, scale "
        "factor and cross terms lean on each other"
        for roll in rolls
        if not roll.spans_a_turn
    ]
    if len(rolls) < 2:
        return said
    for shift in table_errors(calibration).zero_shifts:
        if shift.p < _SHIFTED:
            said.append(
                f"the zero of {shift.output} shifted by {shift.value:.3g} {shift.unit} between the "
                f"rolls in {rolls[0].plane} and {shift.plane}; the stated uncertainties leave that "
                "out unless it is in the covariance of the readings (state_bench)"
            )
    return said


def state_bench(
    calibration: Calibration,
    *,
    reading_sd: float,
    zero_drift: float = 0.0,
    angle_sd_deg: float = 0.0,
    offset_sd_deg: float = 0.0,
    first_sd_deg: float = 0.0,
    second_sd_deg: float = 0.0,
) -> Readings:
    """Return a calibration's readings with the covariance that a stated bench gives them.

    Fitted again, they give the best estimate on that bench and an uncertainty with all of it in.

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
    """
    model, readings = calibration.model, calibration.readings
    rolls = find_rolls(readings)
    linear = model.linear_part(calibration.parameters, calibration.mean_environment)[:, 1:]
    n, m = readings.values.shape
    covariance = np.eye(n * m) * reading_sd**2
    for roll in rolls:
        for output in range(m):
            member = np.zeros((n, m))
            member[roll.rows, output] = zero_drift
            covariance += np.outer(member, member)
        turned = np.zeros((n, m, n))
        turned[roll.rows, :, roll.rows] = _turn(calibration, roll) @ linear.T
        turned = turned.reshape(n * m, n) * np.radians(angle_sd_deg)
        covariance += turned @ turned.T
    sds = np.radians([offset_sd_deg, *[first_sd_deg] * 2, *[second_sd_deg] * 2])
    effect = _effects(calibration, rolls, linear) * np.tile(sds, len(rolls))
    return replace(readings, u=None, covariance=covariance + effect @ effect.T)


def _turn(calibration: Calibration, roll: Roll) -> Array:
    """Return df/dt (n, 3) [g] of a roll."""
    first, second = (COMPONENTS.index(name) for name in roll.plane)
    result = np.zeros((len(roll.rows), 3))
    result[:, first], result[:, second] = -np.sin(roll.angle), np.cos(roll.angle)
    return calibration.sign * magnitude_of(calibration) * result


def _effects(calibration: Calibration, rolls: tuple[Roll, ...], linear: Array) -> Array:
    """Return eq. (2) per radian of each quantity of each roll (n M, 5 rolls)."""
    n, m = calibration.readings.values.shape
    result = np.zeros((n, m, len(QUANTITIES) * len(rolls)))
    for place, roll in enumerate(rolls):
        t = roll.angle
        waves = (np.ones(len(t)), np.cos(t), np.sin(t), np.cos(2.0 * t), np.sin(2.0 * t))
        moved = _turn(calibration, roll) @ linear.T
        for number_, wave in enumerate(waves):
            result[roll.rows, :, len(QUANTITIES) * place + number_] = wave[:, None] * moved
    return result.reshape(n * m, -1)


def _design(model: Model, calibration: Calibration) -> Array:
    """Return the model's design over all outputs (n M, p), output running fastest."""
    own = model is calibration.model
    parameters = calibration.parameters if own else np.zeros(len(model.keys))
    slopes = parameter_jacobian(
        model, parameters, calibration.reference, calibration.readings.environment
    )
    return slopes.reshape(-1, len(model.keys))


def _shifts(
    model: Model, readings: Readings, rolls: tuple[Roll, ...]
) -> dict[tuple[str, str], Array]:
    """Return the columns (n M,) of a zero shift of each output on each roll after the first."""
    n, m = readings.values.shape
    columns = {}
    for roll in rolls[1:]:
        for output, name in enumerate(model.outputs):
            member = np.zeros((n, m))
            member[roll.rows, output] = 1.0
            columns[roll.plane, name] = member.ravel()
    return columns


def _weights(calibration: Calibration) -> Array:
    """Return the inverse standard deviation of each reading (n M,), equal where none is known."""
    sd = calibration.residual_sd
    usable = np.isfinite(sd).all() and (sd > 0.0).all()
    return np.tile(1.0 / sd if usable else np.ones(len(sd)), len(calibration.readings))


def _separable(design: Array, effects: Array) -> list[int]:
    """Return the columns of `effects` that the design does not explain, the earlier first."""
    kept: list[int] = []
    for column in range(effects.shape[1]):
        trial = np.column_stack([design, effects[:, [*kept, column]]])
        if np.abs(effects[:, column]).max() > FLOOR and (
            separability(trial, floor=FLOOR).rank == trial.shape[1]
        ):
            kept.append(column)
    return kept


def _described(
    calibration: Calibration,
    rolls: tuple[Roll, ...],
    nominal: Array,
    values: dict[int, tuple[float, float, float]],
) -> tuple[TableError, ...]:
    """Return every quantity with its value where the model and the positions can tell it."""
    names = [f"{quantity} in {roll.plane}" for roll in rolls for quantity in QUANTITIES]
    hidden = _confounded(calibration, calibration.model, nominal, names)
    same = _confounded(calibration, _fullest(calibration.model), nominal, names)
    errors = []
    for column, name in enumerate(names):
        place, number_ = divmod(column, len(QUANTITIES))
        told = not hidden[name] and column in values
        value, u, U = np.degrees(values[column]).tolist() if told else (None, None, None)
        errors.append(TableError(rolls[place].plane, QUANTITIES[number_], value, u, U, same[name]))
    return tuple(errors)


def _fullest(model: Model) -> Model:
    """Return the model of all terms up to second order and the own third."""
    formula = "1 + x + y + z + x*y + x*z + y*z + own^2 + own^3"
    return build_model(formula, model.outputs, model.axes, unit=model.unit)


def _confounded(
    calibration: Calibration, model: Model, nominal: Array, names: list[str]
) -> dict[str, tuple[str, ...]]:
    """Return for each quantity what together does the same as it to the readings, by name."""
    shifts = _shifts(model, calibration.readings, find_rolls(calibration.readings))
    base = [_design(model, calibration), *shifts.values()]
    every = [*model.names, *(f"zero shift of {output}" for _, output in shifts), *names]
    null = separability(np.column_stack([*base, nominal]), floor=FLOOR).null
    result: dict[str, tuple[str, ...]] = {}
    for row, name in enumerate(every):
        if name not in names:
            continue
        together = null[:, null[row] != 0.0]
        others = [every[j] for j in np.flatnonzero(together.any(axis=1)).tolist() if j != row]
        # One that no output feels at all has no company, but cannot be told either.
        result[name] = tuple(others) or (("nothing that the outputs feel",) * bool(together.size))
    return result

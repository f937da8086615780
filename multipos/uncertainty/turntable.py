"""The turntable's own errors: what they do to readings, and which of them the data can tell.

The table is off by e(t), five quantities a roll, and its shaft off the horizon, three, which move
the readings by eqs. (1) to (3) of `multipos.uncertainty.table_motion`. Against the terms of an
input axis along cos t, eq. (2) there is

    e_0: −sin t             a misalignment,
    c_1: −sin 2t / 2        the product of the two components,
    s_1: −sin²t             bias and second order,
    c_2: (sin t − sin 3t)/2 nothing else but the misalignment, so it can be told,
    s_2: (cos 3t − cos t)/2 scale factor and third order:

eqs. (10) to (12) of docs/theory/tumble.md. Whatever a model leaves out can be estimated and stands
beside the names of the terms that would do the same. Between two rolls the zero of an output may
shift, which no term of the sensor does.

An output along the shaft reads the level of the shaft as a shift of its zero, its wobble as
misalignments.

Beside all of this the parameters of the sensor that no error does the same as are what none moves.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.errors import RankError
from multipos.estimation.known import FLOOR
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor, t_tail
from multipos.numerics.separability import separability
from multipos.numerics.terms import COMPONENTS
from multipos.positions.harmonics import find_rolls
from multipos.results import require
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model
from multipos.sensor.stating import build_model
from multipos.uncertainty.bench_columns import Bench, Sizes, separable, solve_beside
from multipos.uncertainty.dividing_head import find_head, head_errors, said_of_head
from multipos.uncertainty.table_findings import BesideTable, TableError, TableErrors, ZeroShift
from multipos.uncertainty.table_motion import QUANTITIES, SHAFT

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
    (`multipos.uncertainty.dividing_head`).

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
    shifts, kept, design = _told_apart(bench.sensor, bench.shifts, bench.nominal, bench.effect)
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
    """Return the sensor beside every error, and the errors of the shaft that can be told."""
    free = separable(design, bench.shaft_nominal)
    free = [free[i] for i in separable(design, bench.shaft[:, free])]
    whole = np.column_stack([design, bench.shaft[:, free]])
    if len(whole) <= whole.shape[1]:
        return None, {}
    everything = np.column_stack(
        [bench.sensor, *bench.shifts.values(), bench.nominal, bench.shaft_nominal]
    )
    null = separability(everything, floor=FLOOR).null
    kept, sizes = solve_beside(bench, whole, (null[: len(bench.keys)] == 0.0).all(axis=1))
    return kept, {column: sizes[i] for i, column in enumerate(free, start=design.shape[1])}


def _told_apart(
    sensor: Array, shifts: Mapping[tuple[str, str], Array], nominal: Array, effect: Array
) -> tuple[dict[tuple[str, str], Array], list[int], Array]:
    """Return the zero shifts and columns of `effect` that can be told, and the design of all."""
    free = separable(sensor, np.column_stack([*shifts.values(), nominal]))
    told = {key: shifts[key] for i, key in enumerate(shifts) if i in free}
    design = np.column_stack([sensor, *told.values()])
    kept = [i - len(shifts) for i in free if i >= len(shifts)]
    kept = [kept[i] for i in separable(design, effect[:, kept])]  # nor may small terms hide it
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
    said += said_of_head(calibration.readings)
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


def _described(bench: Bench, values: Sizes) -> tuple[TableError, ...]:
    """Return every quantity with its value where the model and the positions can tell it."""
    names = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in QUANTITIES]
    hidden = _confounded(bench, bench.models, bench.nominal, names)
    fullest = [_fullest(model) for model in bench.models]
    same = _confounded(bench, fullest, bench.nominal, names)
    told = {column: value for column, value in values.items() if not hidden[names[column]]}
    return _named(bench, QUANTITIES, told, same, names)


def _shaft_described(bench: Bench, values: Sizes) -> tuple[TableError, ...]:
    """Return the quantities of the shaft that the outputs feel, as `_described` does."""
    table = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in QUANTITIES]
    names = [f"{quantity} in {roll.plane}" for roll in bench.rolls for quantity in SHAFT]
    both = np.column_stack([bench.nominal, bench.shaft_nominal])
    same = _confounded(bench, bench.models, both, [*table, *names])
    told = {column: value for column, value in values.items() if not same[names[column]]}
    found = _named(bench, SHAFT, told, same, names)
    felt = np.abs(bench.shaft_nominal).max(axis=0, initial=0.0) > FLOOR
    return tuple(error for error, seen in zip(found, felt.tolist(), strict=True) if seen)


def _named(
    bench: Bench,
    quantities: Sequence[str],
    told: Sizes,
    same: Mapping[str, tuple[str, ...]],
    names: Sequence[str],
) -> tuple[TableError, ...]:
    errors = []
    for column, name in enumerate(names):
        place, number_ = divmod(column, len(quantities))
        value, u, U = np.degrees(told[column]).tolist() if column in told else (None, None, None)
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

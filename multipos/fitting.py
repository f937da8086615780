"""The front door: from readings and a scheme to a complete calibration.

`fit` checks what it is given, builds the reference and the model, picks the estimator, and
completes the `Calibration` with its diagnostics.

An uncertain gravity scales every reference alike. A coefficient of degree d in force is
proportional to g^-d, so its sensitivity and the covariance all parameters share are

    c_j = -d_j p_j / g,      cov p += c c' u_g²,                                            (1)

with infinite degrees of freedom; the effective ones of the sum are Welch and Satterthwaite's,

    ν_eff = ν (u_c² / u_A²)²,     u_A from the readings, u_c combined.                      (2)

References
----------
JCGM 100:2008, clause 5.1 and G.4.1.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from multipos import __version__
from multipos.errors import MultiposError, UsageError
from multipos.estimation.known import (
    Solution,
    closed_form_difference,
    solve_closed_form,
    solve_known,
)
from multipos.estimation.losses import LOSSES, Loss
from multipos.estimation.model_selection import select_terms, with_selection
from multipos.estimation.placement import Placement, place
from multipos.estimation.uncertain import solve_uncertain
from multipos.files.lists import Names, split_names
from multipos.files.records import LARGEST as LARGEST_IN_FILES
from multipos.files.tables import Source
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.terms import COMPONENTS, formula_columns, largest_value, linear_term
from multipos.positions.attitudes import CONVENTIONS, Convention, check_convention
from multipos.positions.readings import (
    Readings,
    orient,
    read_readings,
    require_range,
    spread_reading_sd,
    stated_sd,
)
from multipos.positions.scheme import Scheme
from multipos.sensor.calibration import Calibration, Gravity
from multipos.sensor.diagnostics import Diagnostics, lack_of_fit
from multipos.sensor.expressions import Expression, build_expression
from multipos.sensor.model import GAUGES, Gauge, Model, build_model, default_axes
from multipos.uncertainty.budgets import Budget, read_budget
from multipos.uncertainty.budgets import Source as BudgetSource
from multipos.uncertainty.propagation import state_budget
from multipos.uncertainty.turntable import roll_warnings
from multipos.units import gravity_ratio, normal_gravity

_CONTRADICT = {
    "--closed-form": (
        "--unknown-orientation",
        "--orientation-sd",
        "--level-sd",
        "--robust",
        "--stepwise",
    ),
    "--unknown-orientation": ("--orientation-sd", "--level-sd"),
}
_TIED = "the listed directions leave no rotation of the case to choose"
_ILL_CONDITIONED = 1e4  # scaled condition at which four of the sixteen digits are gone


def fit(
    readings: "Source | Readings",
    *,
    scheme: "Source | Scheme | None" = None,
    model: str | Expression = "linear",
    convention: Convention = "specific-force",
    outputs: Names | None = None,
    axes: Names | None = None,
    inputs: Names = COMPONENTS,
    closed_form: bool = False,
    unknown_orientation: bool = False,
    orientation_sd: float | Literal["auto"] | None = None,
    gauge: Gauge = "lower",
    robust: Loss | None = None,
    pool: bool = False,
    stepwise: bool = False,
    reading_sd: ArrayLike | None = None,
    gravity: float | None = None,
    gravity_u: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
    level_sd: float = 0.0,
    budget: "BudgetSource | Budget | None" = None,
    unit: str | None = None,
    range: Sequence[float] | None = None,
    confidence: float = 0.95,
) -> Calibration:
    """Calibrate an accelerometer from readings at static positions.

    Parameters
    ----------
    readings : Readings, path, mapping of columns, or data frame
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        The orientation of each position; otherwise the readings' own columns say it.
    model : str or function
        'linear', 'own-quadratic', … or a formula such as '1 + x + y + z + own^2', or a Python
        function of the components and the parameters (see `multipos.sensor.expressions`).
    convention : str
        'specific-force': the axis that points up reads +1; 'gravity': the one that points down.
    outputs, axes, inputs : sequences of str, or comma-separated str, optional
        The output columns, the case axis each senses, and the components the model sees.
    closed_form : bool
        Use the six-position inversion instead of least squares.
    unknown_orientation : bool
        Nothing is known of the orientations but that gravity has the same size in all of them.
    orientation_sd : float [degrees] or 'auto', optional
        Standard deviation of every position about each axis, instead of the readings' own
        column; 'auto' estimates it together with the reading noise.
    gauge : str
        'lower' or 'symmetric': how the rotation of the case is fixed where nothing else does.
    robust : str, optional
        'huber', 'soft-l1' or 'cauchy': the loss that lets bad positions count less.
    pool : bool
        Use one residual variance for all outputs.
    stepwise : bool
        Keep of the model's terms only those that the readings support.
    reading_sd : float or M floats, optional
        Standard uncertainty of an averaged reading, in reading units.
    gravity, gravity_u : float [m/s²], optional
        Local gravity and its standard uncertainty; without it one g is the local gravity.
    latitude, height : float [degrees, m], optional
        Take gravity from the WGS 84 normal-gravity formula.
    level_sd : float [degrees]
        Standard deviation of a tilt that all positions share, about each level axis.
    budget : path, tables or Budget, optional
        What is known of the measurement beside the readings (`multipos.uncertainty.budgets`).
    unit : str, optional
        Unit of the readings.
    range : (low, high), optional
        Readings outside these limits are an error.
    confidence : float
        Coverage probability of U.

    Returns
    -------
    Calibration

    Raises
    ------
    MultiposError
        The data are at fault; the message says what, where, and the way out.
    RankError
        The positions cannot separate the parameters, which are named.
    ConvergenceError
        An uncertain or unknown orientation could not be solved for.
    UsageError
        An option is at fault.

    References
    ----------
    JCGM 100:2008, clauses 5.1, 6.2 and annex G; Song and Qin 2009 for the six positions.
    """
    _check_options(convention, gauge, robust, confidence)
    _check_together(closed_form, unknown_orientation, orientation_sd, level_sd, robust, stepwise)
    stated = None if budget is None else read_budget(budget)
    local = resolve_gravity(gravity, gravity_u, latitude, height)
    if stated is not None and stated.gravity is not None:
        if local is not None:
            raise UsageError("the options and the budget's [gravity] both state it; give one.")
        local = Gravity(*stated.gravity)
    used = formula_columns(model) if isinstance(model, str) else ()
    data = read_readings(readings, outputs=outputs, unit=unit, environment=used)
    data = _without_orientation(data, scheme) if unknown_orientation else orient(data, scheme)
    if range is not None:
        require_range(data, range)
    if reading_sd is not None:
        data = _with_reading_sd(data, reading_sd)
    built = _build(model, data, axes, inputs)
    _check_environment(data, built)
    signed = gravity_ratio(None if local is None else local.value)
    signed = -signed if convention == "gravity" else signed
    placement = place(data, signed, orientation_sd, level_sd)
    if gauge != GAUGES[0] and placement.listed.any():
        data = replace(data, notes=(*data.notes, f"--gauge {gauge} has no effect: {_TIED}"))
    if orientation_sd is not None:
        data = replace(
            data, orientation_sd=np.where(placement.spread < np.inf, placement.spread, np.nan)
        )
    if closed_form and not placement.exact:
        raise MultiposError(
            "--closed-form takes exact orientations, but the readings have groups or "
            "orientation_sd_deg above 0; leave --closed-form out."
        )

    def solve(chosen: Model) -> Solution:
        if closed_form:
            return solve_closed_form(chosen, placement.reference, data, pool=pool)
        if placement.exact and robust is None and isinstance(model, str):
            return solve_known(chosen, placement.reference, data, pool=pool)
        return solve_uncertain(chosen, data, placement, gauge=gauge, robust=robust, pool=pool)

    selection = None
    if stepwise and not isinstance(model, str):
        raise UsageError("--stepwise chooses among the terms of a formula, not of an expression.")
    if stepwise:
        whole = None if placement.exact else solve(built)
        built, selection = select_terms(
            built if whole is None else whole.model,
            placement.reference if whole is None else whole.reference,
            data,
        )
    solution = solve(built)
    if solution.orientation_sd is not None:
        data = replace(
            data,
            orientation_sd=np.where(
                np.isinf(solution.orientation_sd), np.nan, solution.orientation_sd
            ),
        )
    listed = np.where(placement.listed[:, None], placement.reference, np.nan)
    calibration = complete(
        solution,
        data,
        listed=listed,
        convention=convention,
        gravity=local,
        estimator=_estimator(placement, closed_form),
        criterion=_criterion(data, placement, closed_form, robust, model),
        confidence=confidence,
    )
    if selection is not None:
        calibration = with_selection(calibration, selection)
    return calibration if stated is None else state_budget(calibration, stated)


def complete(
    solution: Solution,
    readings: Readings,
    *,
    listed: Array,
    convention: Convention,
    gravity: Gravity | None,
    estimator: str,
    criterion: str,
    confidence: float,
) -> Calibration:
    """Return the calibration of a solution, with gravity's uncertainty and the diagnostics."""
    model, reference = solution.model, solution.reference
    parameters, covariance = solution.parameters, solution.covariance
    parameter_dof = solution.parameter_dof
    far = int(np.argmax(np.abs(parameters)))
    if not abs(parameters[far]) <= LARGEST_IN_FILES:
        raise MultiposError(
            f"the parameter '{model.names[far]}' is {parameters[far]:g}, which no file takes; give "
            "the columns of the model in a smaller unit, or the readings in a larger one."
        )
    if gravity is not None and gravity.u > 0.0:
        covariance, parameter_dof = _add_gravity(
            model, parameters, covariance, parameter_dof, gravity
        )
    warnings = [*readings.notes, *solution.warnings, *_warn_convention(model, solution, convention)]
    if solution.condition > _ILL_CONDITIONED:
        warnings.append(
            f"the positions separate the parameters badly (condition {solution.condition:.1e}); "
            "add positions that differ more"
        )
    exact = estimator in ("linear", "closed-form")
    diagnostics = Diagnostics(
        rank=len(parameters),
        parameters=len(parameters),
        condition=solution.condition,
        leverage=solution.leverage,
        lack_of_fit=_lack_of_fit(model, reference, readings, solution.residuals) if exact else {},
        outliers=solution.outliers,
        unidentifiable=solution.unidentifiable,
        warnings=tuple(warnings),
    )
    calibration = Calibration(
        model=model,
        parameters=parameters,
        covariance=covariance,
        parameter_dof=parameter_dof,
        dof=solution.dof,
        residuals=solution.residuals,
        residual_sd=solution.residual_sd,
        reference=reference,
        readings=readings,
        convention=convention,
        gravity=gravity,
        estimator=estimator,
        criterion=criterion,
        confidence=confidence,
        diagnostics=diagnostics,
        status=solution.status,
        created=_now(),
        version=__version__,
        cross_check=closed_form_difference(model, listed, readings),
        extra=solution.extra,
    )
    return _with_roll_warnings(calibration)


def _with_roll_warnings(calibration: Calibration) -> Calibration:
    """Return the calibration of one or two axes with what its rolls warn of."""
    said = roll_warnings(calibration) if len(calibration.outputs) < 3 else []
    if not said:
        return calibration
    found = calibration.diagnostics
    return replace(calibration, diagnostics=replace(found, warnings=(*found.warnings, *said)))


def _build(
    model: str | Expression,
    readings: Readings,
    axes: Names | None,
    inputs: Names,
) -> Model:
    own = default_axes(readings.outputs, axes)
    columns = tuple(readings.environment)
    if not isinstance(model, str):
        return build_expression(model, readings.outputs, own, readings.unit, columns)
    seen = split_names(inputs, "--inputs")
    return build_model(model, readings.outputs, own, seen, readings.unit, columns)


def _check_options(convention: str, gauge: str, robust: str | None, confidence: float) -> None:
    check_convention(convention)
    if gauge not in GAUGES:
        raise UsageError(f"unknown gauge '{gauge}'; give lower or symmetric.")
    if robust is not None and robust not in LOSSES:
        raise UsageError(f"unknown loss '{robust}'; --robust takes {', '.join(LOSSES)}.")
    if not 0.0 < confidence < 1.0:
        raise UsageError(f"--confidence must lie between 0 and 1, got {confidence}.")


def _check_together(
    closed_form: bool,
    unknown: bool,
    orientation_sd: float | Literal["auto"] | None,
    level_sd: float,
    robust: Loss | None,
    stepwise: bool,
) -> None:
    """Refuse options that contradict each other."""
    if isinstance(orientation_sd, str):
        if orientation_sd != "auto":
            raise UsageError(f"--orientation-sd takes degrees or 'auto', got '{orientation_sd}'.")
        if robust is not None:
            raise UsageError("--orientation-sd auto and --robust cannot judge the same residuals.")
    elif orientation_sd is not None and not 0.0 <= orientation_sd < 180.0:
        raise UsageError(
            f"--orientation-sd must lie between 0 and 180 degrees, got {orientation_sd}."
        )
    if not 0.0 <= level_sd < 90.0:
        raise UsageError(f"--level-sd must lie between 0 and 90 degrees, got {level_sd}.")
    given = {
        "--closed-form": closed_form,
        "--unknown-orientation": unknown,
        "--orientation-sd": orientation_sd is not None,
        "--level-sd": level_sd > 0.0,
        "--robust": robust is not None,
        "--stepwise": stepwise,
    }
    for first, others in _CONTRADICT.items():
        clash = [other for other in others if given[other]]
        if given[first] and clash:
            raise UsageError(f"{first} and {clash[0]} contradict each other; give one.")


def _estimator(placement: Placement, closed_form: bool) -> str:
    if closed_form:
        return "closed-form"
    if np.isinf(placement.spread).all():
        return "unknown-orientation"
    return "linear" if placement.exact else "uncertain-orientation"


def resolve_gravity(
    gravity: float | None, gravity_u: float | None, latitude: float | None, height: float | None
) -> Gravity | None:
    """Return the local gravity [m/s²] that the options state, or None."""
    if gravity is not None and latitude is not None:
        raise UsageError("--gravity and --latitude both state the gravity; give one.")
    if height is not None and latitude is None:
        raise UsageError("--height needs --latitude.")
    if gravity_u is not None and gravity is None:
        raise UsageError("--gravity-u needs --gravity.")
    if gravity_u is not None and not 0.0 <= gravity_u <= LARGEST:
        raise UsageError(
            f"--gravity-u must be 0 or more, and no more than {LARGEST:g}, got {gravity_u}."
        )
    if latitude is not None:
        try:
            return Gravity(normal_gravity(latitude, height or 0.0), 0.0)
        except ValueError as error:
            raise UsageError(str(error)) from None
    if gravity is None:
        return None
    if not 1.0 <= gravity <= 100.0:
        raise UsageError(f"--gravity must be in m/s², such as 9.81, got {gravity}.")
    return Gravity(gravity, gravity_u or 0.0)


def _add_gravity(
    model: Model, parameters: Array, covariance: Array, dof: Array, gravity: Gravity
) -> tuple[Array, Array]:
    """Return covariance and degrees of freedom with the common term of gravity, eqs. (1), (2)."""
    sensitivity = -model.force_degrees * parameters / gravity.value
    combined = covariance + np.outer(sensitivity, sensitivity) * gravity.u**2
    before, after = np.diag(covariance), np.diag(combined)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        effective = np.where(before > 0.0, dof * (after / before) ** 2, np.inf)
    effective[effective > LARGEST] = np.inf
    return combined, np.where(np.isnan(before), dof, effective)


def _warn_convention(model: Model, solution: Solution, convention: str) -> list[str]:
    own = [
        solution.parameters[model.keys.index((output, linear_term(axis)))]
        for output, axis in zip(model.outputs, model.axes, strict=True)
        if (output, linear_term(axis)) in model.keys
    ]
    if not own or max(own) >= 0.0:
        return []
    other = next(name for name in CONVENTIONS if name != convention)
    return [
        (
            f"every own-axis scale factor is negative under --convention {convention}; "
            f"the readings look like --convention {other}"
        )
    ]


def _lack_of_fit(
    model: Model, reference: Array, readings: Readings, residuals: Array
) -> dict[str, dict[str, object]]:
    # A repeat is a row with the same reference and surroundings, whatever its label.
    rows = np.column_stack([reference, *(readings.environment[n] for n in model.environment)])
    groups = [row.tobytes() for row in rows + 0.0]
    if len(set(groups)) == len(groups):
        return {}
    result: dict[str, dict[str, object]] = {}
    stated = stated_sd(readings)
    sd = np.ones_like(residuals) if stated is None else stated
    for i, (output, terms) in enumerate(zip(model.outputs, model.terms, strict=True)):
        tested = lack_of_fit(residuals[:, i], groups, len(terms), sd=sd[:, i])
        if tested is not None:
            f, lack, pure, p = tested
            result[output] = {"F": f, "dof": [lack, pure], "p": p}
    return result


def _criterion(
    readings: Readings,
    placement: Placement,
    closed_form: bool,
    robust: Loss | None,
    model: str | Expression,
) -> str:
    if closed_form:
        return "exact solution of the six-position equations"
    stated = readings.u is not None or readings.covariance is not None
    loss = "" if robust is None else f", {robust} loss"
    if placement.exact:
        kind = "" if isinstance(model, str) else "nonlinear "
        return f"{'weighted ' if stated else ''}{kind}least squares of the readings{loss}"
    noise = "stated reading noise" if stated else "equal reading noise"
    if np.isinf(placement.spread).all():
        return f"maximum likelihood of the readings, {noise}{loss}"
    return f"maximum a posteriori of readings and orientations, {noise}{loss}"


def _without_orientation(readings: Readings, scheme: object) -> Readings:
    """Return readings of which no orientation is used, saying what is ignored."""
    notes = readings.notes
    given = (readings.up, readings.rotation, readings.orientation_sd, readings.group)
    if any(columns is not None for columns in given):
        notes += ("the orientation columns are ignored, the orientation is taken as unknown",)
    if scheme is not None:
        notes += ("--scheme is ignored, the orientation is taken as unknown",)
    return replace(
        readings,
        up=None,
        rotation=None,
        orientation_sd=np.full(len(readings), np.nan),
        group=None,
        notes=notes,
    )


def _with_reading_sd(readings: Readings, reading_sd: ArrayLike) -> Readings:
    u = spread_reading_sd(reading_sd, readings.values.shape)
    notes = readings.notes
    if readings.u is not None or readings.covariance is not None:
        notes += ("the readings' own uncertainties are ignored, --reading-sd is used",)
    return replace(readings, u=u, covariance=None, notes=notes)


def _check_environment(readings: Readings, model: Model) -> None:
    for name in model.environment:
        bad = ~np.isfinite(readings.environment[name])
        if bad.any():
            raise MultiposError(
                f"{readings.source or 'the readings'}: row {int(np.argmax(bad)) + 1}, "
                f"column '{name}' is empty or not finite, but the model uses it."
            )
        limit = largest_value((term for _, term in model.keys), name)
        far = np.abs(readings.environment[name]) > limit
        if far.any():
            row = int(np.argmax(far))
            raise MultiposError(
                f"{readings.source or 'the readings'}: row {row + 1}, column '{name}': "
                f"{readings.environment[name][row]:g} is beyond {limit:.0e}, whose powers are no "
                "numbers in this model; correct it, or give the column in another unit."
            )


def _now() -> str:
    """Return the time in UTC; SOURCE_DATE_EPOCH, where set, makes results reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return moment.isoformat(timespec="seconds")

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

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos import __version__
from multipos.budgets import Budget, read_budget
from multipos.budgets import Source as BudgetSource
from multipos.calibration import Calibration, Gravity, labels
from multipos.diagnostics import Diagnostics, find_outliers, lack_of_fit
from multipos.errors import MultiposError, UsageError
from multipos.files import Source
from multipos.known import Solution, closed_form_difference, solve_closed_form, solve_known
from multipos.model import (
    COMPONENTS,
    Model,
    build_model,
    default_axes,
    formula_columns,
    linear_term,
)
from multipos.readings import Readings, orient, read_readings
from multipos.scheme import Scheme
from multipos.uncertainty import with_budget
from multipos.units import gravity_ratio, normal_gravity

Array = NDArray[np.float64]

CONVENTIONS = ("specific-force", "gravity")
_ILL_CONDITIONED = 1e4  # scaled condition at which four of the sixteen digits are gone


def fit(
    readings: "Source | Readings",
    *,
    scheme: "Source | Scheme | None" = None,
    model: str = "linear",
    convention: str = "specific-force",
    outputs: Sequence[str] | str | None = None,
    axes: Sequence[str] | str | None = None,
    inputs: Sequence[str] | str = COMPONENTS,
    closed_form: bool = False,
    pool: bool = False,
    reading_sd: ArrayLike | None = None,
    gravity: float | None = None,
    gravity_u: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
    budget: "BudgetSource | Budget | None" = None,
    unit: str | None = None,
    confidence: float = 0.95,
) -> Calibration:
    """Calibrate an accelerometer from readings at known orientations.

    Parameters
    ----------
    readings : Readings, path, mapping of columns, or data frame
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        The orientation of each position; otherwise the readings' own columns say it.
    model : str
        'linear', 'own-quadratic', … or a formula such as '1 + x + y + z + own^2'.
    convention : str
        'specific-force': the axis that points up reads +1; 'gravity': the one that points down.
    outputs, axes, inputs : sequences of str, or comma-separated str, optional
        The output columns, the case axis each senses, and the components the model sees.
    closed_form : bool
        Use the six-position inversion instead of least squares.
    pool : bool
        Use one residual variance for all outputs.
    reading_sd : float or M floats, optional
        Standard uncertainty of an averaged reading, in reading units.
    gravity, gravity_u : float [m/s²], optional
        Local gravity and its standard uncertainty; without it one g is the local gravity.
    latitude, height : float [degrees, m], optional
        Take gravity from the WGS 84 normal-gravity formula.
    budget : path, tables or Budget, optional
        What is known of the measurement beside the readings (`multipos.budgets`).
    unit : str, optional
        Unit of the readings.
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
    UsageError
        An option is at fault.

    References
    ----------
    JCGM 100:2008, clauses 5.1, 6.2 and annex G; Song and Qin 2009 for the six positions.
    """
    if convention not in CONVENTIONS:
        raise UsageError(f"unknown convention '{convention}'; give specific-force or gravity.")
    if not 0.0 < confidence < 1.0:
        raise UsageError(f"`confidence` must lie between 0 and 1, got {confidence}.")
    stated = None if budget is None else read_budget(budget)
    local = resolve_gravity(gravity, gravity_u, latitude, height)
    if stated is not None and stated.gravity is not None:
        if local is not None:
            raise UsageError("the options and the budget's [gravity] both state it; give one.")
        local = Gravity(*stated.gravity)
    used = formula_columns(model)
    data = orient(read_readings(readings, outputs=outputs, unit=unit, environment=used), scheme)
    if reading_sd is not None:
        data = _with_reading_sd(data, reading_sd)
    built = build_model(
        model,
        data.outputs,
        default_axes(data.outputs, axes),
        tuple(inputs.split(",")) if isinstance(inputs, str) else tuple(inputs),
        data.unit,
        tuple(data.environment),
    )
    _check_environment(data, built)
    sign = -1.0 if convention == "gravity" else 1.0
    assert data.up is not None
    reference = sign * gravity_ratio(None if local is None else local.value) * data.up + 0.0
    solve = solve_closed_form if closed_form else solve_known
    calibration = complete(
        solve(built, reference, data, pool=pool), built, reference, data,
        convention=convention, gravity=local, confidence=confidence,
        estimator="closed-form" if closed_form else "linear",
        criterion=_criterion(data, closed_form),
    )  # fmt: skip
    return calibration if stated is None else with_budget(calibration, stated)


def complete(
    solution: Solution,
    model: Model,
    reference: Array,
    readings: Readings,
    *,
    convention: str,
    gravity: Gravity | None,
    estimator: str,
    criterion: str,
    confidence: float,
) -> Calibration:
    """Return the calibration of a solution, with gravity's uncertainty and the diagnostics."""
    parameters, covariance = solution.parameters, solution.covariance
    parameter_dof = solution.parameter_dof
    if gravity is not None and gravity.u > 0.0:
        covariance, parameter_dof = _add_gravity(model, parameters, covariance, parameter_dof,
                                                 gravity)  # fmt: skip
    warnings = [*readings.notes, *solution.warnings, *_warn_convention(model, solution, convention)]
    if solution.condition > _ILL_CONDITIONED:
        warnings.append(
            f"the positions separate the parameters badly (condition {solution.condition:.1e}); "
            "add positions that differ more"
        )
    names = labels(readings)
    dof = solution.residual_dof.tolist()
    residual_sd = [
        float(np.sqrt(r @ r / nu)) if nu > 0 else math.nan
        for r, nu in zip(solution.residuals.T, dof, strict=True)
    ]
    diagnostics = Diagnostics(
        rank=len(parameters),
        parameters=len(parameters),
        condition=solution.condition,
        leverage=solution.leverage,
        lack_of_fit=_lack_of_fit(model, reference, readings, solution.residuals),
        outliers=find_outliers(solution.residuals, solution.leverage, dof, model.outputs, names),
        warnings=tuple(warnings),
    )
    return Calibration(
        model=model,
        parameters=parameters,
        covariance=covariance,
        parameter_dof=parameter_dof,
        dof=solution.dof,
        residuals=solution.residuals,
        residual_sd=np.array(residual_sd),
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
        cross_check=closed_form_difference(model, reference, readings),
    )


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
    if gravity_u is not None and not 0.0 <= gravity_u < math.inf:
        raise UsageError(f"--gravity-u must be 0 or more, got {gravity_u}.")
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
    degree = np.array([term.force_degree for _, term in model.keys])
    sensitivity = -degree * parameters / gravity.value
    combined = covariance + np.outer(sensitivity, sensitivity) * gravity.u**2
    before, after = np.diag(covariance), np.diag(combined)
    with np.errstate(divide="ignore", invalid="ignore"):
        effective = np.where(before > 0.0, dof * (after / before) ** 2, np.inf)
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
    for output, terms, column in zip(model.outputs, model.terms, residuals.T, strict=True):
        tested = lack_of_fit(column, groups, len(terms))
        if tested is not None:
            f, lack, pure, p = tested
            result[output] = {"F": f, "dof": [lack, pure], "p": p}
    return result


def _criterion(readings: Readings, closed_form: bool) -> str:
    if closed_form:
        return "exact solution of the six-position equations"
    stated = readings.u is not None or readings.covariance is not None
    return "weighted least squares of the readings" if stated else "least squares of the readings"


def _with_reading_sd(readings: Readings, reading_sd: ArrayLike) -> Readings:
    sd = np.asarray(reading_sd, dtype=np.float64).ravel()
    m = len(readings.outputs)
    if len(sd) not in (1, m):
        raise UsageError(f"--reading-sd takes 1 or {m} values, got {len(sd)}.")
    if not (np.isfinite(sd).all() and (sd > 0.0).all()):
        raise UsageError("--reading-sd must be above 0.")
    notes = readings.notes
    if readings.u is not None or readings.covariance is not None:
        notes += ("the readings' own uncertainties are ignored, --reading-sd is used",)
    u = np.broadcast_to(sd, readings.values.shape)
    return replace(readings, u=u, covariance=None, notes=notes)


def _check_environment(readings: Readings, model: Model) -> None:
    for name in model.environment:
        bad = ~np.isfinite(readings.environment[name])
        if bad.any():
            raise MultiposError(
                f"{readings.source or 'the readings'}: row {int(np.argmax(bad)) + 1}, "
                f"column '{name}' is empty or not finite, but the model uses it."
            )


def _now() -> str:
    """Return the time in UTC; SOURCE_DATE_EPOCH, where set, makes results reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return moment.isoformat(timespec="seconds")

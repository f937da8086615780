"""From a solution to a complete `Calibration`: gravity's uncertainty and the diagnostics."""

from dataclasses import replace

import numpy as np

from multipos import __version__
from multipos.errors import MultiposError
from multipos.estimation.closed_form import closed_form_difference
from multipos.estimation.gains import gravity_effect
from multipos.estimation.problem import Solution
from multipos.files.records import LARGEST as LARGEST_IN_FILES
from multipos.files.whole import now
from multipos.finding import Finding
from multipos.numerics.arrays import Array, count_different, row_keys
from multipos.positions.attitudes import Convention
from multipos.positions.readings import Readings, stated_sd
from multipos.sensor.calibration import Calibration
from multipos.sensor.fit_diagnostics import Diagnostics, lack_of_fit
from multipos.sensor.found import Estimator
from multipos.sensor.gravity import add_gravity
from multipos.sensor.model import Model

_CORRELATED = 1.0 + 1e-6  # the largest correlation, which rounding may pass
_CARRIED = (  # from a solution as they are
    *("model", "parameters", "covariance", "parameter_dof", "dof", "residuals", "residual_sd"),
    *("reference", "status", "variance_components", "orientations", "robust_weight"),
)


def complete(
    solution: Solution,
    readings: Readings,
    *,
    listed: Array,
    convention: Convention,
    estimator: Estimator,
    criterion: str,
    confidence: float,
) -> Calibration:
    """Return the calibration of a solution, with gravity's uncertainty and the diagnostics.

    Parameters
    ----------
    solution : Solution
    readings : Readings
        As used.
    listed : (n, 3) array [g]
        Reference that was listed, NaN where none was.
    convention, estimator, criterion, confidence
        As in `Calibration`.

    Raises
    ------
    MultiposError
        A parameter is too large a number for any file.
    """
    _require_in_files(solution)
    calibration = Calibration(
        **{name: getattr(solution, name) for name in _CARRIED},
        readings=readings,
        convention=convention,
        estimator=estimator,
        criterion=criterion,
        confidence=confidence,
        diagnostics=_diagnose(solution, readings, estimator),
        created=now(),
        version=__version__,
        cross_check=closed_form_difference(solution.model, listed, readings),
    )
    return _with_size(calibration)


def add_findings(c: Calibration, *said: Finding) -> Calibration:
    """Return a calibration with what more there is to say of it."""
    return replace(c, diagnostics=replace(c.diagnostics, findings=(*c.diagnostics.findings, *said)))


def _with_size(c: Calibration) -> Calibration:
    """Return the calibration with the uncertainty of the size of its field."""
    gravity = c.gravity
    if gravity is None or not gravity.u > 0.0:
        return c
    covariance, dof = add_gravity(c.covariance, c.parameter_dof, gravity, gravity_effect(c))
    return replace(c, covariance=covariance, parameter_dof=dof)


def _require_in_files(solution: Solution) -> None:
    size = np.abs(solution.parameters)
    far = int(np.argmax(size))
    if not size[far] <= LARGEST_IN_FILES:
        raise MultiposError(
            f"the parameter '{solution.model.names[far]}' is {solution.parameters[far]:g}, which "
            "no file takes; give the columns of the model in a smaller unit, or the readings in a "
            "larger one."
        )
    u = np.sqrt(np.diag(solution.covariance))
    if (np.abs(solution.covariance) > _CORRELATED * np.outer(u, u)).any():
        raise MultiposError(
            "sizes of readings or columns differ so much that covariances have no digits; set "
            "aside what is of another size, or give columns in another unit."
        )


def _diagnose(solution: Solution, readings: Readings, estimator: Estimator) -> Diagnostics:
    model, reference = solution.model, solution.reference
    return Diagnostics(
        rank=len(solution.parameters),
        parameters=len(solution.parameters),
        condition=solution.condition,
        leverage=solution.leverage,
        lack_of_fit=_lack_of_fit(model, reference, readings, solution.residuals)
        if estimator.exact
        else {},
        outliers=solution.outliers,
        unidentifiable=solution.unidentifiable,
        findings=(*readings.findings, *solution.findings),
        claim=solution.claim,
    )


def _lack_of_fit(
    model: Model, reference: Array, readings: Readings, residuals: Array
) -> dict[str, dict[str, object]]:
    # A repeat is a row with the same reference and surroundings, whatever its label.
    rows = np.column_stack([reference, *(readings.environment[n] for n in model.environment)])
    if count_different(rows) == len(rows):
        return {}
    groups = row_keys(rows)
    result: dict[str, dict[str, object]] = {}
    stated = stated_sd(readings)
    sd = np.ones_like(residuals) if stated is None else stated
    for i, (output, terms) in enumerate(zip(model.outputs, model.terms, strict=True)):
        tested = lack_of_fit(residuals[:, i], groups, len(terms), sd=sd[:, i])
        if tested is not None:
            f, lack, pure, p = tested
            result[output] = {"F": f, "dof": [lack, pure], "p": p}
    return result

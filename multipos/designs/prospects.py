"""Prospects: what more positions bring to a calibration.

`begin` returns what a calibration brings to the design of further positions, `begin_otherwise` the
same where the noise is stated otherwise, `rank_positions` the best next ones; `measured` and
`information_of` are the parts of which `capture` makes its next pose.

With the information N of the positions measured and I(u) of each further one at u, both of
`multipos.designs.information` with the sensor's own parameters and reading noise, the covariance

    C = N⁻¹      becomes      C' = (N + Σ I(u))⁻¹,      u_j'² = [C']_jj + c_j²,              (1)

where c_j² is what the calibration's uncertainty has beyond C and no position lowers, such as that
of gravity.
"""

import math
from dataclasses import replace

import numpy as np

from multipos.designs.information import Setting, make_setting
from multipos.errors import MultiposError, UsageError
from multipos.estimation.correlated_rows import order_in_time
from multipos.numerics.arrays import SMALLEST, Array, Mask
from multipos.positions.benches import read_bench
from multipos.positions.readings import diagonal
from multipos.positions.scheme import Scheme
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model

_OPEN = (
    "the positions of this calibration leave a parameter open, so nothing can be predicted from "
    "them; add positions that differ more, and fit again."
)


@frozen
class Begun:
    """What a calibration brings to the design of further positions.

    Attributes
    ----------
    setting : Setting
        Its model, sensor and noise, but for what was stated otherwise.
    up : (n, 3) array
        Of the positions measured.
    present : (p, p) array
        Their information N, with what is known beforehand.
    covered, fixed : (p,) arrays
        What scales N⁻¹, and c² of eq. (1).
    towards : str
        What the positions point along: 'up', or 'field' of a magnetometer.
    """

    setting: Setting
    up: Array
    present: Array
    covered: Array
    fixed: Array
    towards: str

    def u(self, further: Array) -> Array:
        """Return u (…, p) with the information (…, p, p) of further positions, eq. (1)."""
        return np.asarray(np.sqrt(_variances(self.present + further) * self.covered + self.fixed))


def begin(calibration: Calibration) -> Begun:
    """Return what a calibration brings to the design of further positions.

    Raises
    ------
    MultiposError
        It states no noise to predict from, or its model has other columns.
    """
    setting, present, covered = measured(calibration)
    fixed = np.maximum(calibration.u**2 - _variances(present) * covered, 0.0)
    towards = calibration.field.towards
    begun = Begun(setting, _up(calibration), present, covered, fixed, towards)
    kept = ~_of_session(setting.model)
    return begun if kept.all() else _without_drift(begun, kept)


def begin_otherwise(
    calibration: Calibration, orientation_sd: float | None, reading_sd: float | None
) -> Begun:
    """Return what a calibration brings to a design whose noise is stated otherwise, where it is.

    N⁻¹ is then the covariance as it stands. `orientation_sd` is in degrees, `reading_sd` in the
    unit of the readings.
    """
    begun = begin(calibration)
    if orientation_sd is None and reading_sd is None:
        return begun
    setting = begun.setting
    if orientation_sd is not None:
        stated = make_setting(setting.model, orientation_sd=orientation_sd)
        setting = replace(setting, orientation_sd=stated.orientation_sd)
    if reading_sd is not None:
        if not reading_sd > 0.0:
            raise UsageError(f"--reading-sd must be above 0, got {reading_sd}.")
        setting = replace(setting, sd=np.full(len(setting.model.outputs), reading_sd))
    present = information_of(setting, begun.up).sum(axis=0) + np.diag(setting.model.beliefs)
    return replace(begun, setting=setting, present=present, covered=np.ones_like(begun.covered))


def _without_drift(begun: Begun, kept: Mask) -> Begun:
    """Return what is left of a calibration whose session, and with it its drift, has ended."""
    assert begun.setting.parameters is not None
    setting = replace(
        begun.setting,
        model=begun.setting.model.without_drift(),
        parameters=begun.setting.parameters[kept],
    )
    return replace(
        begun,
        setting=setting,
        present=begun.present[np.ix_(kept, kept)],
        covered=begun.covered[kept],
        fixed=begun.fixed[kept],
    )


def rank_positions(
    calibration: Calibration, candidates: "str | Scheme" = "all-26"
) -> tuple[Array, Array]:
    """Return candidates (n, 3), best first, and how far u falls on geometric average."""
    begun, up = begin(calibration), read_bench(candidates)
    then = begun.u(information_of(begun.setting, up))
    ratios = then / begun.u(np.zeros_like(begun.present))
    fall = 1.0 - np.exp(np.log(ratios).mean(axis=1))
    order = np.argsort(-fall, kind="stable")
    return up[order], fall[order]


def measured(calibration: Calibration) -> tuple[Setting, Array, Array]:
    """Return the setting, the information of the readings, and what scales its inverse.

    The scale is 1 but where the fit found the noise other than it was stated, or slow.
    """
    model, readings = calibration.model, calibration.readings
    if model.environment:
        raise MultiposError(
            f"the model has column '{model.environment[0]}', which a position does not set; "
            "the gain of positions is available for models of specific force only."
        )
    unknown = calibration.estimator is Estimator.UNKNOWN
    sd = np.ones(len(model.outputs)) if unknown else calibration.residual_sd
    if calibration.noise is not None:
        variances = diagonal(calibration.noise).reshape(readings.values.shape)
        sd = np.sqrt(np.mean(variances, axis=0))
    if not all(np.all(np.isfinite(each) & (each >= SMALLEST)) for each in (calibration.u, sd)):
        raise MultiposError(
            "the calibration has no reading noise to predict from: as many terms as readings; "
            "fit again with --reading-sd."
        )
    spread = math.inf if unknown else 0.0
    if calibration.estimator is Estimator.UNCERTAIN and readings.orientation_sd is not None:
        stated = readings.orientation_sd[np.isfinite(readings.orientation_sd)]
        spread = float(np.sqrt(np.mean(stated**2)))
    size = calibration.sign * float(np.linalg.norm(calibration.reference, axis=1).mean())
    setting = Setting(model, spread, sd, calibration.parameters, size)
    # A drift ends with its session: one position more would say nothing of it.
    known = model.beliefs + np.where(_of_session(model), 1.0 / calibration.u**2, 0.0)
    measured_ = information_of(setting, _up(calibration)).sum(axis=0)
    present = np.asarray(measured_ + np.diag(known))
    ratio = calibration.u**2 / _variances(present)
    covered = np.empty(len(ratio))
    for part in setting.blocks:
        # gravity adds nothing to a bias: the least ratio is that of the noise alone
        covered[part] = ratio[part].min()
    if calibration.budget is None and order_in_time(readings) is not None:
        # what slow noise adds to a bias falls with more readings, as noise does
        biases = [str(term) == "1" for _, term in model.keys]
        covered[biases] = ratio[biases]
    if calibration.estimator is Estimator.UNCERTAIN:
        # U is that of a mixture, which each parameter has a share of its own in
        covered = _of_readings(calibration) / _variances(present)
    return setting, present, covered


def _of_readings(calibration: Calibration) -> Array:
    """Return the variances (p,) that the readings give, without what all positions share."""
    c = calibration
    if c.budget is not None and c.budget.scatter is not None:
        return np.diag(c.budget.scatter)
    if c.gravity is None:
        return c.u**2
    shared = c.model.force_degrees * c.parameters * c.gravity.u / c.gravity.value
    return np.asarray(c.u**2 - shared**2)


def _up(calibration: Calibration) -> Array:
    """Return the up vectors (n, 3) of the positions measured."""
    size = np.linalg.norm(calibration.reference, axis=1)
    return np.asarray(calibration.sign * calibration.reference / size[:, np.newaxis])


def _of_session(model: Model) -> Mask:
    """Return which parameters (p,) are those of the session."""
    return np.isin([str(term) for _, term in model.keys], model.of_session)


def information_of(setting: Setting, up: Array) -> Array:
    """Return I(u) of each position over all parameters, (n, p, p)."""
    p = len(setting.model.keys)
    pieces = np.zeros((len(up), p, p))
    for part, Z in zip(setting.blocks, setting.rows(up), strict=True):
        pieces[:, part, part] = Z.transpose(0, 2, 1) @ Z
    return pieces


def _variances(information: Array) -> Array:
    """Return the variances (…, p) of parameters, which information (…, p, p) has digits of."""
    try:
        variances = np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1)
    except np.linalg.LinAlgError:
        raise MultiposError(_OPEN) from None
    if not (variances > 0.0).all():  # a position tells so much more that no digit of others is left
        raise MultiposError(_OPEN)
    return np.asarray(variances)

"""What every estimator finds, before it is completed to a `Calibration`."""

from dataclasses import dataclass

from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Status
from multipos.sensor.fit_diagnostics import Claim
from multipos.sensor.found import FoundOrientations, VarianceComponents
from multipos.sensor.model import Model

DIRECT = Status(True, 0, "solved directly")


@dataclass(frozen=True, eq=False)
class Solution:
    """What an estimator finds, before it is completed to a `Calibration`.

    Attributes
    ----------
    model : Model
        As fitted, with its gauge.
    reference : (n, 3) array [g]
        As used; estimated where it was uncertain.
    parameters, covariance, parameter_dof : (p,), (p, p), (p,) arrays
        Without the common-mode terms of the uncertainty.
    inflation : (p,) array
        Root of what multiplies the variance that the weights of the readings alone give.
    dof : (M,) array
        Degrees of freedom of each output's noise; inf where it is known beforehand.
    residuals, leverage : (n, M) arrays
    residual_sd : (M,) array
        Standard deviation of a reading as the residuals show it; NaN where none is left.
    outliers, warnings, unidentifiable : tuples of str
    condition : float
    status : Status
    orientation_sd : (n,) array [rad] or None
        Where it was estimated; inf for unknown.
    variance_components, orientations, robust_weight
        As in `Calibration`.
    claim : Claim or None
        As in `Diagnostics`.
    """

    model: Model
    reference: Array
    parameters: Array
    covariance: Array
    parameter_dof: Array
    inflation: Array
    dof: Array
    residuals: Array
    residual_sd: Array
    leverage: Array
    outliers: tuple[str, ...]
    condition: float
    warnings: tuple[str, ...]
    unidentifiable: tuple[str, ...] = ()
    status: Status = DIRECT
    orientation_sd: Array | None = None
    variance_components: VarianceComponents | None = None
    orientations: FoundOrientations | None = None
    robust_weight: Array | None = None
    claim: Claim | None = None

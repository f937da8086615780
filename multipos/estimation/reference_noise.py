"""An applied force that is known with an uncertainty: what it adds to the noise of the readings.

A reading at a force f + δ, δ with standard uncertainties u_f of its components, moves by J δ,
J = dh/df, so that the readings of position k have

    V_k = U_k + J_k diag(u_f²) J_kᵀ,                                                        (1)

U_k what they state themselves. J is that of a first fit, which knows the scale factors well enough
for a weight. Readings that state nothing get a floor far below what they scatter
(`multipos.estimation.scatter` finds the rest), so that their noise stays what the residuals say.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.solution import Solution
from multipos.positions.readings import Readings

_FLOOR = 1e-3  # of a residual standard deviation: nothing beside the scatter that is found
_CORRELATED = 0.01  # below which outputs of one reading count as independent


def add_reference_noise(readings: Readings, solution: Solution) -> Readings:
    """Return readings whose noise holds what the forces add, eq. (1).

    Unchanged where the forces are exact, or nothing is left to tell the noise of the readings.
    """
    stated = readings.noise
    if readings.reference_u is None or not readings.reference_u.any():
        return readings
    if stated is None and not np.isfinite(solution.residual_sd).all():
        return readings
    n, m = readings.values.shape
    slopes = solution.model.force_jacobian(
        solution.parameters, solution.reference, readings.environment
    )
    moved = slopes * readings.reference_u[:, None, :]
    blocks = moved @ moved.transpose(0, 2, 1)
    if stated is None:
        floor = np.maximum(_FLOOR * solution.residual_sd, np.finfo(float).tiny ** 0.5)
        stated = np.tile(floor**2, n)
    variances = np.einsum("nmm->nm", blocks)
    apart = blocks - variances[:, :, None] * np.eye(m)
    if stated.ndim == 1:
        total = stated.reshape(n, m) + variances
        size = np.sqrt(total[:, :, None] * total[:, None, :])
        if (np.abs(apart) <= _CORRELATED * size).all():
            return replace(readings, u=np.sqrt(total), covariance=None)
        stated = np.diag(stated)
    covariance = stated.copy().reshape(n, m, n, m)
    covariance[np.arange(n), :, np.arange(n), :] += blocks
    return replace(readings, u=None, covariance=covariance.reshape(n * m, n * m))

"""Parity: what more outputs than axes say of each other, whatever the force.

`parity` returns it for every reading.

M outputs on K < M axes over-determine the force. Least squares leaves r = y − h(f), which lies in
the left null space of the Jacobian J (M, K), where no force reaches; with N (M, M − K) an
orthonormal basis of it, the parity vector and its covariance are

    p = N' r,    cov p = N' [diag(s²) + (dh/dp) C (dh/dp)'] N,                              (1)

s the noise of a reading and C the covariance of the parameters. ``size`` is |p| in the unit of
the readings, and p'(cov p)⁻¹p is χ² on M − K degrees of freedom where nothing is broken, or
(M − K) F where the noise is an estimate. A tail below `FAULT_LEVEL` is a fault. M − K = 1 tells
that an output has failed, not which one.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_tail
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensitivities

FAULT_LEVEL = 1e-3  # share of sound readings that are called a fault


class Parity(NamedTuple):
    """Parity vectors (n, M − K), their length (n,) in reading units, and the tail p (n,)."""

    vector: Array
    size: Array
    p: Array


def parity(
    calibration: Calibration,
    raw: Array,
    force: Array,
    environment: Mapping[str, Array],
    noise: Array,
) -> Parity:
    """Return what the outputs of a redundant sensor say of each other.

    Parameters
    ----------
    calibration : Calibration
        Of more outputs than axes.
    raw : (n, M) array
    force : (n, K) array [g]
        Compensated from `raw`.
    environment : mapping of str to (n,) array
    noise : (M,) or (n, M) array
        Standard uncertainty of the readings.
    """
    model, parameters = calibration.model, calibration.parameters
    sensed = list(model.sensed_axes)
    sound = np.isfinite(force.sum(axis=1))
    full = np.zeros((len(raw), 3))
    full[:, sensed] = np.where(sound[:, None], force, 0.0)
    residual = raw - model.predict(parameters, full, environment)
    inverse, by_parameter = sensitivities(model, parameters, full, environment)
    # The left null space of J is the null space of J^+: its last right singular vectors.
    basis: Array = np.asarray(np.linalg.svd(inverse)[2])[:, len(sensed) :]
    m = len(model.outputs)
    covariance = by_parameter @ calibration.covariance @ by_parameter.transpose(0, 2, 1)
    covariance[:, range(m), range(m)] += np.broadcast_to(noise, raw.shape) ** 2
    vector = np.einsum("ndm,nm->nd", basis, residual)
    spread = basis @ covariance @ basis.transpose(0, 2, 1)
    distance = np.full(len(raw), np.nan)
    finite = np.isfinite(spread).all(axis=(1, 2), keepdims=True)
    volume = np.linalg.det(np.where(finite, spread, 0.0))
    known = np.flatnonzero(sound & np.isfinite(volume) & (volume > 0.0))
    weighted = np.linalg.solve(spread[known], vector[known][:, :, None])[:, :, 0]
    distance[known] = np.einsum("nd,nd->n", vector[known], weighted)
    degrees, dof = m - len(sensed), float(calibration.dof.min())
    p = np.array([f_tail(d / degrees, degrees, dof) for d in distance.tolist()])
    return Parity(vector, np.where(sound, np.linalg.norm(vector, axis=1), np.nan), p)

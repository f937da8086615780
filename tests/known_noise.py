"""A calibration as if its readings had the noise that they state and no other."""

from dataclasses import replace

import numpy as np

from multipos.sensor.inverse import parameter_jacobian


def with_known_noise(cal):
    """The generalised least squares of a calibration's readings, their noise known beforehand."""
    readings = cal.readings
    n, m = readings.values.shape
    noise = readings.noise
    V = noise if noise.ndim == 2 else np.diag(noise)
    X = parameter_jacobian(cal.model, cal.parameters, cal.reference, readings.environment)
    X = X.reshape(n * m, -1)
    C = np.linalg.inv(X.T @ np.linalg.solve(V, X))
    parameters = C @ X.T @ np.linalg.solve(V, readings.values.ravel())
    return replace(
        cal,
        parameters=parameters,
        covariance=C,
        parameter_dof=np.full(len(parameters), np.inf),
        dof=np.full(m, np.inf),
        residuals=readings.values - (X @ parameters).reshape(n, m),
        variance_components=None,
    )

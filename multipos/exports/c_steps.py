"""How many steps the inverse of a model takes in C, and over what that is known.

A model that is not linear is solved by fixed steps, eq. (1) of `multipos.exports.c_body`.
The error shrinks at least by rho, the largest norm of 1 − P dh/df over twice the calibrated force
and the calibrated environment, so that

    steps = log(tolerance / largest force) / log(rho)                                      (2)

of them are enough wherever the force is up to a third beyond what was calibrated; where rho
exceeds one half nothing is written.
"""

import itertools

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensed_axes

_HEADROOM = 2.0  # times the largest calibrated force, over which rho is taken
_SLOWEST = 0.5
_TOLERANCE = {False: 1e-13, True: 1e-9}  # [g], by single precision
_GRID = 9


def environment_range(calibration: Calibration, name: str) -> tuple[float, float]:
    """Return the smallest and largest value of a column at calibration."""
    seen = calibration.readings.environment[name]
    return float(seen.min()), float(seen.max())


def needed_steps(calibration: Calibration, slope: Array, *, single: bool) -> tuple[int, float]:
    """Return the number of steps, eq. (2), and rho; `slope` (M, K) is K0.

    Raises
    ------
    MultiposError
        They would not converge.
    """
    largest = float(np.linalg.norm(calibration.reference, axis=1).max())
    rho = _contraction(calibration, slope)
    if not rho <= _SLOWEST:
        raise MultiposError(
            f"the inverse of this model does not converge in fixed steps over "
            f"{_HEADROOM * largest:.3g} g (contraction {rho:.2g}, at most {_SLOWEST} is safe); "
            "drop terms whose coefficient is not significant, or use apply."
        )
    reach = np.sqrt(3.0) * _HEADROOM * largest
    needed = np.log(_TOLERANCE[single] / reach) / np.log(max(rho, 1e-16))
    return 1 + int(np.ceil(needed)), rho


def force_grid(calibration: Calibration, headroom: float) -> tuple[Array, dict[str, Array]]:
    """Return forces (n, 3) [g] up to so many times the calibrated one, and columns with them."""
    model = calibration.model
    sensed = list(sensed_axes(model))
    reach = headroom * float(np.linalg.norm(calibration.reference, axis=1).max())
    line, still = np.linspace(-reach, reach, _GRID), np.zeros(1)
    axes = [line if i in sensed else still for i in range(3)]
    names = model.environment
    environment = [np.linspace(*environment_range(calibration, name), 5) for name in names]
    grid = np.array(list(itertools.product(*axes, *environment)))
    return grid[:, :3], dict(zip(names, grid[:, 3:].T, strict=True))


def _contraction(calibration: Calibration, slope: Array) -> float:
    model = calibration.model
    sensed = list(sensed_axes(model))
    grid, columns = force_grid(calibration, _HEADROOM)
    jacobian = model.force_jacobian(calibration.parameters, grid, columns)[:, :, sensed]
    if len(slope) > len(sensed):
        moved = np.linalg.inv(slope.T @ slope) @ jacobian.transpose(0, 2, 1) @ jacobian
    else:
        moved = np.linalg.inv(slope) @ jacobian
    return float(np.linalg.norm(np.eye(len(sensed)) - moved, ord=2, axis=(1, 2)).max())


def steps_in_words(steps: int, rho: float) -> str:
    """Return how a function with so many steps computes."""
    return f"{steps} steps, each shrinking the error at least {1.0 / max(rho, 1e-16):.3g} times"

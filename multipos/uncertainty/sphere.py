"""Force and tilt with their uncertainty over a sphere of directions.

`evaluate_sphere` returns them. Compensated force f has the covariance of the parameters by eq. (2)
of `multipos.sensor.inverse`, and what unseen terms add (`multipos.uncertainty.unseen_terms`). The
tilt of a sensed axis i is the angle above the horizon of that axis of the case,

    β_i = atan2(f_i, sqrt(sum_{j≠i} f_j²)),   or   asin(f_i / |f|)  with fewer than three;   (1)

a calibration is judged by what it gives at its worst direction and, as root mean square, over all
of them. The reading that is compensated adds its own noise, which is not in these numbers.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.quantiles import coverage_factor
from multipos.positions.scheme import read_scheme
from multipos.results import Keyed, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensitivities as inverse_sensitivities
from multipos.uncertainty.propagation import evaluate_budget
from multipos.uncertainty.unseen_terms import unseen_covariance

POINTS = "fibonacci-1000"  # even directions: the worst of them is within 1 % of the worst of all


@frozen
class Sphere(Keyed, Tabular):
    """How well force and tilt are known over a sphere of directions.

    Attributes
    ----------
    force, tilt_deg : mapping of str to mapping
        By sensed axis: `worst`, the largest u; `U`, `k` and `dof` there; `at`, the force along
        the sensed axes where it is [g]; `rms` of u. Force is in g; tilt is
        known of a triad only.
    """

    force: Mapping[str, Mapping[str, Any]]
    tilt_deg: Mapping[str, Mapping[str, Any]]

    def columns(self) -> dict[str, Any]:
        """Return a row for each quantity and axis."""
        rows = [(what, axis, entry) for what in self for axis, entry in self[what].items()]
        names = ("worst", "U", "k", "dof", "rms")
        return {
            "quantity": [what for what, _, _ in rows],
            "axis": [axis for _, axis, _ in rows],
            **{name: [entry[name] for _, _, entry in rows] for name in names},
        }


def evaluate_sphere(
    calibration: Calibration, *, size: float = 1.0, directions: str = POINTS
) -> Sphere:
    """Return how well force and tilt are known over a sphere of directions.

    Parameters
    ----------
    calibration : Calibration
    size : float [g]
        Radius of the sphere: 1 for a sensor at rest.
    directions : str
        Scheme whose up vectors are the directions.

    Returns
    -------
    Sphere
        ``found["force"]["x"]["U"]``: `force` [g] and, of a triad, `tilt_deg`, by axis; of each
        `worst`, the largest u; `U`, `k`, `dof` and the force `at` that direction; `rms` of u.
        The environment is the mean of the readings'.

    Examples
    --------
    >>> import multipos as mp
    >>> force = mp.evaluate_sphere(mp.demo().calibration)["force"]
    >>> print(", ".join(f"{axis}: {1e3 * entry['U']:.0f} mg" for axis, entry in force.items()))
    x: 13 mg, y: 162 mg, z: 17 mg
    """
    require(calibration, Calibration)
    c = calibration
    sensed = list(c.model.sensed_axes)
    force = size * read_scheme(directions).up[:, sensed]
    gradient, extra = _sensitivity(c, force)
    turns = {"force": np.broadcast_to(np.eye(len(sensed)), extra.shape)}
    if len(sensed) == len(COMPONENTS):
        turns["tilt_deg"] = np.degrees(_tilt_gradient(force))
    budget = evaluate_budget(c)
    result: dict[str, dict[str, dict[str, Any]]] = {"force": {}, "tilt_deg": {}}
    for name, turn in turns.items():
        for row, i in enumerate(sensed):
            u, dof, _ = budget.combine(np.einsum("nk,nkp->np", turn[:, row], gradient))
            beyond = np.einsum("nk,nkl,nl->n", turn[:, row], extra, turn[:, row])
            total = np.sqrt(u**2 + beyond)
            worst = int(np.argmax(total))
            # eq. (2) of `multipos.uncertainty.propagation` with what is beyond known for certain
            nu = float(dof[worst]) * float((total[worst] / u[worst]) ** 4) if u[worst] else np.inf
            k = coverage_factor(c.confidence, nu)
            result[name][COMPONENTS[i]] = {
                "worst": float(total[worst]),
                "U": k * float(total[worst]),
                "k": k,
                "dof": nu,
                "at": tuple(force[worst].tolist()),
                "rms": float(np.sqrt(np.mean(total**2))),
            }
    return Sphere(**result)


def _sensitivity(c: Calibration, force: Array) -> tuple[Array, Array]:
    """Return d f/d p (n, K, p) of compensated force, and the covariance (n, K, K) of unseen terms.

    At forces (n, K) along the sensed axes, in the mean environment of the readings.
    """
    environment = {name: np.full(len(force), mean) for name, mean in c.mean_environment.items()}
    full = np.zeros((len(force), len(COMPONENTS)))
    full[:, list(c.model.sensed_axes)] = force
    inverse, by_parameter = inverse_sensitivities(c.model, c.parameters, full, environment)
    return -inverse @ by_parameter, unseen_covariance(c, force, environment)


def _tilt_gradient(force: Array) -> Array:
    """Return d β_i / d f (n, 3, 3) [rad/g], by eq. (1)."""
    square = np.einsum("ni,ni->n", force, force)[:, None]
    rest = np.sqrt(np.maximum(square - force**2, np.finfo(float).tiny))
    gradient = -force[:, :, None] * force[:, None, :] / (square * rest)[:, :, None]
    axis = np.arange(3)
    gradient[:, axis, axis] = rest / square
    return np.asarray(gradient)

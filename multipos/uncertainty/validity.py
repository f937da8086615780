"""Where a calibration holds: force and tilt with uncertainty over the sphere, and beyond ±1 g.

Compensated force f has the covariance of the parameters by eq. (2) of `multipos.sensor.inverse`.
The tilt of a sensed axis i is the angle above the horizon of that axis of the case,

    β_i = atan2(f_i, sqrt(sum_{j≠i} f_j²)),   or   asin(f_i / |f|)  with fewer than three;   (1)

a calibration is judged by what it gives at its worst direction and, as root mean square, over all
of them. The reading that is compensated adds its own noise, which is not in these numbers.

What was applied is a sphere of |f| = g, and known forces, which along an axis go from the smallest
component to the largest and in size to the largest of them. Terms that the positions could not
show are in the uncertainty as far as the budget states them (`multipos.uncertainty.validity`):
between the directions applied, and beyond what was applied.

Terms that the positions did not show: what a budget's [unseen] does to compensated force.

A term φ of an output i that is not in the model, of size κ [g] beside the scale factor s_i, moves
the reading by s_i κ φ(f). The fit absorbed it as far as it looks like the model, so with the gain
G of the estimator, how parameters follow readings, compensated force is off by

    δf(f) = J⁺ (e_i s_i κ φ(f) − (dh/dp) G e_i s_i κ φ at the positions),                   (2)

of which only κ is unknown: its variance is what the budget states. A term that the model has is
absorbed whole. Of own³ at the six faces nothing is left at ±1 g along the axes, .4 κ between them,
and (f² − 1) f κ beyond. `[third_order]` is own³, relative to the scale factor.

Each output has a κ of its own, each product of `own*other` too.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from multipos.estimation.gains import estimator_gain
from multipos.numerics.arrays import COMPONENTS, Array, Environment, Mask
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import kind_terms
from multipos.positions.scheme import read_scheme
from multipos.results import Keyed, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.inverse import sensitivities as inverse_sensitivities


def unseen_sizes(calibration: Calibration) -> dict[str, float]:
    """Return the standard uncertainty [g] of each kind of term that the budget states."""
    tables = calibration.budget_tables
    if not tables:
        return {}
    from multipos.uncertainty.budgets import OF_FORCE_ALONE, read_budget

    stated = {name: tables[name] for name in (*OF_FORCE_ALONE, "cross") if name in tables}
    if not stated:
        return {}
    quantities = read_budget(stated).quantities
    sizes = {"other": quantities["cross"].u} if "cross" in quantities else {}
    if "third_order" in quantities:
        return sizes | {"own^3": quantities["third_order"].u}
    return sizes | dict(quantities["unseen"].settings if "unseen" in quantities else {})


def unseen_covariance(calibration: Calibration, force: Array, environment: Environment) -> Array:
    """Return the covariance (n, K, K) [g²] that unseen terms add, by eq. (2).

    Parameters
    ----------
    calibration : Calibration
        Zero unless its budget states such terms.
    force : (n, K) array [g]
        Compensated force, on the axes that the sensor has.
    environment : mapping of str to (n,) array
    """
    c = calibration
    sensed = list(c.model.sensed_axes)
    full = np.zeros((len(force), 3))
    full[:, sensed] = np.where(np.isfinite(force), force, 0.0)  # NaN: no force explains it
    moves = unseen_moves(c, full, environment)
    if not moves.size:
        return np.zeros((len(force), len(sensed), len(sensed)))
    jacobian = c.model.force_jacobian(c.parameters, full, environment)
    off = np.linalg.pinv(jacobian[:, :, sensed]) @ moves
    return np.asarray(off @ off.transpose(0, 2, 1))


def unseen_moves(calibration: Calibration, force: Array, environment: Environment) -> Array:
    """Return how each unseen term moves readings beyond what the fit absorbed (n, M, terms).

    The bracket of eq. (2), at one standard uncertainty of each term; without terms (n, M, 0).

    Parameters
    ----------
    calibration : Calibration
    force : (n, 3) array [g]
    environment : mapping of str to (n,) array
    """
    c = calibration
    sizes = unseen_sizes(c)
    if not any(sizes.values()):
        return np.zeros((len(force), len(c.outputs), 0))
    by_parameter = parameter_jacobian(c.model, c.parameters, force, environment)
    there = term_moves(c, sizes, c.reference).reshape(c.readings.values.size, -1)
    return np.asarray(term_moves(c, sizes, force) - by_parameter @ (estimator_gain(c) @ there))


def term_moves(c: Calibration, sizes: Mapping[str, float], force: Array) -> Array:
    """Return what terms that the model lacks do to readings, at their size, (n, M, terms)."""
    components = {axis: force[:, i] for i, axis in enumerate(COMPONENTS)}
    moves = [np.zeros((len(force), len(c.outputs)))]
    for kind, u in sizes.items():
        for output, axis in enumerate(c.model.axes):
            scale = c.sensitivity[output, COMPONENTS.index(axis)]
            for term in kind_terms(kind, axis, c.model.inputs):
                if term not in c.model.terms[output]:
                    moves.append(np.zeros((len(force), len(c.outputs))))
                    moves[-1][:, output] = u * scale * term.evaluate(components)
    return np.stack(moves, axis=2)


# Noise and orientation error make |f| of a sensor at rest differ from 1 g; only more than this is
# outside.
_MARGIN = 0.01
_MARGIN_RMS = 4.0
_ELSEWHERE = 0.25
POINTS = "fibonacci-1000"  # even directions: the worst of them is within 1 % of the worst of all


class ForcesSeen(NamedTuple):
    """The forces that a calibration has seen [g].

    Inside is what is no larger than `sphere`, and what is no larger than `largest` with components
    between `low` and `high`, all with a margin for noise and orientation error.
    """

    sphere: float
    largest: float
    low: Array  # (3,)
    high: Array  # (3,)
    margin: float
    unit: str = "g"

    def holds(self, force: Array, axes: Sequence[int]) -> Mask:
        """Tell which forces (n, K) along K axes are inside; NaN is not."""
        size = np.sqrt(np.einsum("ni,ni->n", force, force))
        if self.sphere == self.largest:
            return np.asarray(size <= self.limit(self.largest))
        low, high = self.box(axes)
        within = (force >= low) & (force <= high)
        seen = (size <= self.limit(self.largest)) & within.all(axis=1)
        return np.asarray((size <= self.limit(self.sphere)) | seen)

    def box(self, axes: Sequence[int]) -> tuple[Array, Array]:
        """Return between what the components along K axes may be, low (K,) and high (K,)."""
        room = self.margin + _MARGIN * self.largest
        return self.low[axes] - room, self.high[axes] + room

    def limit(self, size: float) -> float:
        """Return how large |f| may be where a size was applied."""
        return size * (1.0 + _MARGIN) + self.margin

    def in_words(self, axes: Sequence[int]) -> str:
        """Return what was applied, along K axes."""
        if self.sphere == self.largest:
            return f"up to {self.largest:.4g} {self.unit}".rstrip()
        parts = [f"{COMPONENTS[i]} {self.low[i]:.4g} to {self.high[i]:.4g}" for i in axes]
        return f"{', '.join(parts)} {self.unit}".rstrip()


def applied(calibration: Calibration) -> ForcesSeen:
    """Return the forces that a calibration has seen."""
    c = calibration
    forced = c.readings.forced
    size = np.linalg.norm(c.reference, axis=1)
    largest, margin = float(size.max()), _MARGIN_RMS * c.rms
    if not c.field.same_everywhere:
        margin += _ELSEWHERE * largest
    sphere = float(size[~forced].max(initial=0.0))
    known = c.reference[forced]
    low = known.min(axis=0, initial=-sphere)
    high = known.max(axis=0, initial=sphere)
    unit = c.field.unit or "times the local field"
    return ForcesSeen(sphere, largest, np.asarray(low), np.asarray(high), margin, unit)


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
    from multipos.uncertainty.propagation import evaluate_budget

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
    environment = {
        name: np.full(len(force), float(np.mean(c.readings.environment[name])))
        for name in c.model.environment
    }
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

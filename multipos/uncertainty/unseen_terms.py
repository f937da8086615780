"""Terms that the positions did not show: what a budget states of them does to compensated force.

`unseen_sizes` returns the sizes that the budget states, `term_moves` what terms do to readings,
`unseen_moves` what is left of that beside the fit, and `unseen_covariance` eq. (1) for force.

A term φ of an output i that is not in the model, of size κ [g] beside the scale factor s_i, moves
the reading by s_i κ φ(f). The fit absorbed it as far as it looks like the model, so with the gain
G of the estimator, how parameters follow readings, compensated force is off by

    δf(f) = J⁺ (e_i s_i κ φ(f) − (dh/dp) G e_i s_i κ φ at the positions),                   (1)

of which only κ is unknown: its variance is what the budget states. A term that the model has is
absorbed whole. Of own³ at the six faces nothing is left at ±1 g along the axes, .4 κ between them,
and (f² − 1) f κ beyond. `[third_order]` is own³, relative to the scale factor.

Each output has a κ of its own, each product of `own*other` too.
"""

from collections.abc import Mapping

import numpy as np

from multipos.estimation.gains import estimator_gain
from multipos.numerics.arrays import COMPONENTS, Array, Environment
from multipos.numerics.terms import kind_terms
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian


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
    """Return the covariance (n, K, K) [g²] that unseen terms add, by eq. (1).

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

    The bracket of eq. (1), at one standard uncertainty of each term; without terms (n, M, 0).

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

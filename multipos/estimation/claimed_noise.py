"""What a stated uncertainty is worth that was itself estimated from few samples.

The u_k of the readings of one output are estimates with d_k degrees of freedom. Weights 1/u_k² of
few of them favour those that came out small by chance, so that each is drawn towards what all of
them have in common, a scaled inverse χ² of d_0 degrees of freedom about s_0² [1]_:

    ũ_k² = (d_0 s_0² + d_k u_k²)/(d_0 + d_k),                                              (1)
    ψ'(d_0/2) = var(e) − mean ψ'(d_k/2),     ln s_0² = mean(e) + ψ(d_0/2) − ln(d_0/2),       (2)

with e_k = ln u_k² − ψ(d_k/2) + ln(d_k/2). Where the u_k differ by no more than chance allows, d_0
is infinite and all become one, Σ d_k u_k²/Σ d_k; where they truly differ, each stays what it is.

The floors of a fit then have by Welch and Satterthwaite

    ν_c = (Σ ũ_k²)²/Σ (ũ_k⁴/d_k),     1/ν' = 1/ν + w²/ν_c,                                  (3)

where w is the part that floors are of the variance of the readings, the rest being scatter from
rest to rest with its own ν. Where ν is infinite, U grows by k(ν_c)/k(∞).

References
----------
.. [1] G. K. Smyth, Stat. Appl. Genet. Mol. Biol. 3 (2004), article 3, section 6.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.solution import Solution
from multipos.numerics.arrays import Array
from multipos.numerics.polygamma import digamma, inverse_trigamma, trigamma
from multipos.positions.readings import Readings

_KNOWN = 1000.0  # degrees of freedom from which on u is taken as known
_FEW = 30.0  # below which it is said
_FEWEST = 3  # readings that tell what they have in common


def steady_floors(readings: Readings) -> Readings:
    """Return readings whose uncertainties are those of eq. (1), where they have few dof."""
    if readings.dof is None or readings.u is None:
        return readings
    u = drawn_together(readings.u[None], readings.dof[None])[0]
    least = float(readings.dof.min())
    if least >= _FEW:
        return replace(readings, u=u)
    said = (
        f"the readings' uncertainties have as few as {least:.2g} degrees of freedom: they are "
        "drawn towards what they have in common, and U is larger for it"
    )
    return replace(readings, u=u, notes=(*readings.notes, said))


def drawn_together(u: Array, dof: Array) -> Array:
    """Return ũ of eq. (1), of B units, from u and their degrees of freedom, (B, n, M) each.

    Where fewer than three readings of an output tell what they have in common, u stays.
    """
    drawn = u.copy()
    for unit, output in np.ndindex(u.shape[0], u.shape[2]):
        rows = np.flatnonzero(dof[unit, :, output] < _KNOWN)
        if len(rows) >= _FEWEST:
            square = u[unit, rows, output] ** 2
            drawn[unit, rows, output] = np.sqrt(_together(square, dof[unit, rows, output]))
    return drawn


def _together(square: Array, dof: Array) -> Array:
    """Return ũ² (n,) of eq. (1) from u² and their degrees of freedom."""
    half = dof / 2.0
    e = np.log(square) - digamma(half) + np.log(half)
    n = len(e)
    excess = float(np.sum((e - e.mean()) ** 2) / (n - 1) - trigamma(half).mean())
    if excess <= 0.0:
        return np.full(n, float(dof @ square) / float(dof.sum()))
    prior = 2.0 * inverse_trigamma(excess)
    own = np.array(prior / 2.0)
    common = np.exp(e.mean() + float(digamma(own)) - np.log(prior / 2.0))
    return np.asarray((prior * common + dof * square) / (prior + dof))


def carry_dof(solution: Solution, readings: Readings, *, joint: bool) -> Solution:
    """Return a solution with the degrees of freedom of the readings' uncertainties, eq. (3).

    Parameters
    ----------
    solution : Solution
    readings : Readings
    joint : bool
        Whether parameters rest on all outputs together.
    """
    if readings.dof is None or readings.u is None:
        return solution
    scatter = np.zeros(readings.dof.shape[1])
    found = solution.variance_components
    if found is not None and found.rest_to_rest is not None:
        scatter = np.array([found.rest_to_rest[o].value ** 2 for o in solution.model.outputs])
    spread = _spread(readings.u[None] ** 2, readings.dof[None], scatter)[0]
    if joint:
        spread = np.full(len(spread), spread.max())
    each = np.repeat(spread, [len(terms) for terms in solution.model.terms])
    with np.errstate(divide="ignore"):
        # what is infinite tells that nothing was found from residuals, and stays
        dof = np.where(np.isinf(solution.dof), np.inf, 1.0 / (1.0 / solution.dof + spread))
        own = 1.0 / (1.0 / solution.parameter_dof + each)
    return replace(solution, dof=dof, parameter_dof=own)


def carried_dof(dof: Array, floor: Array, claimed: Array, scatter: Array) -> Array:
    """Return degrees of freedom (B, M) with those of the floors, eq. (3), of B units.

    Parameters
    ----------
    dof, scatter : (B, M) arrays
        Of the variance of a reading, and τ².
    floor, claimed : (B, n, M) arrays
        Stated variances and their degrees of freedom.
    """
    return np.asarray(1.0 / (1.0 / dof + _spread(floor, claimed, scatter)))


def _spread(floor: Array, dof: Array, scatter: Array) -> Array:
    """Return w²/ν_c of eq. (3), (B, M)."""
    claimed = np.sum(floor, axis=1) ** 2 / np.sum(floor**2 / dof, axis=1)
    share = floor.mean(axis=1) / (floor.mean(axis=1) + scatter)
    return np.asarray(share**2 / claimed)

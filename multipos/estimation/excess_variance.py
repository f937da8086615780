"""The excess variance of readings beyond the uncertainty they state, at exact orientations.

`estimate_excess` returns that of B units.

A stated uncertainty is a lower bound: a reading of output i at position k has the variance

    V_ki = u_ki² + τ² d_i,                                                                  (1)

u as stated (the spread within a rest, a data sheet), τ² the excess variance (dark uncertainty)
from rest to rest and d_i that of one output relative to the others. As the fit is linear, one
integral about its solution at τ = 0 (`multipos.estimation.variances`) has them all. Correlated
readings are turned into the axes of their covariance, where they are independent.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.estimation.variances import Block, Linear, Posterior, excess_of, half_interval
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import block_design
from multipos.numerics.quantiles import coverage_factors

_MOST_DOF = 1000.0  # beyond which Student's t is normal to a thousandth


class ExcessVariance(NamedTuple):
    """The excess variance of readings of M outputs, and how well it is known.

    Attributes
    ----------
    variance, u, dof : (B, M) arrays
        τ² as the fit takes it, the standard uncertainty of τ, and the degrees of freedom of the
        variance of a reading, u² + τ².
    posterior : Posterior
        Of all parameters.
    """

    variance: Array
    u: Array
    dof: Array
    posterior: Posterior

    def standard_uncertainty(self, moves: Array, dof: Array) -> Array:
        """Return u (B, p) of estimates that moved by (B, p) from the solution at τ = 0."""
        U, _ = half_interval(self.posterior, moves)
        return U / coverage_factors(0.95, dof)


def estimate_excess(
    designs: Sequence[Array], residuals: Array, noise: Array, *, pool: bool = False
) -> ExcessVariance:
    """Return the excess variance of readings of B units beyond their stated noise.

    Parameters
    ----------
    designs : sequence of M (n, p_i) arrays
    residuals : (B, n, M) array
        Of the fit weighted by the stated noise.
    noise : (B, n, M) array, or (n M, n M) of one unit
        Stated variances, or their covariance.
    pool : bool
        One excess variance of all outputs.
    """
    count, n, m = residuals.shape
    design = block_design(designs)  # (n, M, p)
    if noise.ndim == 2:
        variance, axes = np.linalg.eigh(noise)
        turned = axes.T @ design.reshape(n * m, -1)
        error, design = residuals.reshape(1, -1) @ axes, turned[:, None]
        block = _block(error[..., None], design, np.maximum(variance, 0.0)[None, :, None])
    else:
        block = _block(residuals, design, noise)
    posterior = excess_of(Linear((block,)), equal=pool)
    tau = posterior.ratios[0]
    d = np.broadcast_to(posterior.outputs, (count, m))
    size = 1.0 / np.mean(1.0 / block.variance, axis=(1, 2))[:, None]
    precision = 1.0 / (size + tau**2)
    mean = posterior.mean(precision)
    spread = posterior.mean((precision - mean[:, None]) ** 2)
    with np.errstate(divide="ignore"):
        dof = np.minimum(2.0 * mean**2 / spread, _MOST_DOF)
    variance = np.maximum(1.0 / mean - size[:, 0], 0.0)[:, None] * d
    u = np.sqrt(posterior.mean((tau - posterior.mean(tau)[:, None]) ** 2))[:, None] * np.sqrt(d)
    return ExcessVariance(variance, u, np.repeat(dof[:, None], m, axis=1), posterior)


def _block(error: Array, design: Array, variance: Array) -> Block:
    """Return rows of units that share a design (n, M, p)."""
    whole = np.broadcast_to(design, (len(error), *design.shape))
    return Block(error, whole, np.zeros((*error.shape, 2)), variance)

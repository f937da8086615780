"""Which variances residuals at known positions show: equal, unequal, or across the force.

`across_the_force` tells whether orientation errors show, `orientation_sd` how large they are, and
`deviances_of` compares what equal outputs, unequal ones and orientation errors explain.

An orientation error moves readings across the normal n = H⁻ᵀ f, H = dh/df, and not along it. So
without a stated noise it shows in

    R = (|e|² − (n'e)²)/ν_across / ((n'e)²/ν_along),   n of length one,                     (1)

e over the standard deviations of outputs, which follows F where there is none. ν_along is the rank
of what the parameters leave of readings along the normals. With outputs by their response to one g,
and residual sums q of ν degrees of freedom each,

    D = Σ ν ln(q/ν)    over: all readings · each output · along and across the normals      (2)

is, but for a constant, twice the logarithm of the likelihood with the variance of each of them.
What orientation errors of s make of the squares is 2 s² in each of the ν rows of an output's
degrees of freedom, of a response of one, a = ⅔ ν (1 − ν/n) s² of it along the normals, as the fit
mixes rows of all directions. So the mean squares across and along differ by s² tr J J'/2, J J' =
H (|f|² − f f') H', times (2 ν − a)/ν_across − a/ν_along. Arrays have a leading axis of B units at
positions that they share.

Source: D. A. Harville 1977, J. Am. Stat. Assoc. 72 (restricted likelihood and degrees of freedom).
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.cofactors import cofactors_of
from multipos.numerics.quantiles import f_quantile
from multipos.results import frozen

LEVEL = 0.01  # at which one cause is preferred to another
TELLING = 6  # contrasts along the force from which orientation errors can be estimated
_LEAST = 1e-300  # of a sum of squares


@frozen
class Residuals:
    """Residuals of B units at known positions, as linear models.

    Attributes
    ----------
    error : (B, n, M) array
    basis : (n, T) array
        Columns of all outputs.
    columns : M arrays of int
        Which of them an output has.
    slopes : (B, n, M, 3) array, or (B, 1, M, 3) where all rows have the same
        H, in reading units per g.
    force : (n, 3) array [g]
    """

    error: Array
    basis: Array
    columns: Sequence[Places]
    slopes: Array
    force: Array

    @cached_property
    def normals(self) -> Array:
        """Vectors (B, n, 3) of readings that no rotation of the position moves."""
        cofactors = cofactors_of(np.moveaxis(self.slopes, (2, 3), (0, 1)))
        return np.asarray(np.einsum("ikbn,nk->bni", cofactors, self.force))

    @cached_property
    def dof(self) -> Array:
        """Degrees of freedom of each output (M,)."""
        return np.array([len(self.force) - len(own) for own in self.columns], dtype=np.float64)

    @cached_property
    def contrasts(self) -> int:
        """How many combinations of readings along the normals the parameters leave.

        A number of the positions, worked out for the first unit.
        """
        along = self.normals[0] / np.linalg.norm(self.normals[0], axis=1, keepdims=True)
        rows = [self.basis[:, own] * along[:, [i]] for i, own in enumerate(self.columns)]
        left = np.concatenate(rows, axis=1)
        sizes = np.linalg.svd(np.linalg.qr(left, mode="r"), compute_uv=False)
        return len(left) - int(np.sum(sizes > sizes[0] * max(left.shape) * np.finfo(float).eps))


def across_the_force(of: Residuals) -> Mask:
    """Return of which units R of eq. (1) is more than chance (B,), without a stated noise."""
    n, m = of.error.shape[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        # residuals over their standard deviations, whose squares sum to the degrees of freedom
        variance = np.einsum("bnm,bnm->bm", of.error, of.error) / of.dof
        square = np.einsum("bnm,bm->bn", of.normals**2, variance)
        along = np.sum(np.einsum("bnm,bnm->bn", of.normals, of.error) ** 2 / square, axis=1)
        total = float(of.dof.sum())
        suspect = (variance > 0.0).all(axis=1) & (along * m <= total)  # else it is along the force
        # R rises with the contrasts, of which there are n − p to n − 1; where its limit exists it
        # falls with both degrees of freedom
        fewest, most = float(n - sum(map(len, of.columns))), n - 1.0
        if fewest >= TELLING:
            largest = (total - along) / (total - most) / (along / most)
            suspect &= largest > f_quantile(1.0 - LEVEL, total - fewest, most)
        if not suspect.any() or of.contrasts < TELLING:
            return np.zeros(len(along), dtype=np.bool_)
        nu, left = total - of.contrasts, float(of.contrasts)
        ratio = (total - along) / nu / (along / left)
    return np.asarray(suspect & (ratio > f_quantile(1.0 - LEVEL, nu, left)))


def orientation_sd(of: Residuals) -> Array:
    """Return s (B,) [rad] of three outputs by their mean squares across and along the force."""
    response = np.linalg.norm(of.slopes, axis=3).mean(axis=1, keepdims=True)
    along, across = _apart(of, response)
    slopes = of.slopes / response[..., None]
    moved = np.einsum("bnik,nk->bni", slopes, of.force)
    whole = np.einsum("bnik,bnik->bn", slopes, slopes)
    whole = whole * np.einsum("nk,nk->n", of.force, of.force)
    size = 0.5 * np.mean(whole - np.einsum("bni,bni->bn", moved, moved), axis=1)
    n, total, nu = len(of.force), float(of.dof.sum()), max(float(of.contrasts), 1.0)
    left = total / len(of.dof)
    leaked = 2.0 / 3.0 * left * (1.0 - left / n)
    size *= (2.0 * left - leaked) / max(total - nu, 1.0) - leaked / nu
    return np.asarray(np.sqrt(np.maximum(across - along, 0.0) / size))


def deviances_of(of: Residuals) -> tuple[Array, Array, Array]:
    """Return D (B,) of eq. (2) of equal outputs, unequal ones, and orientation errors."""
    response = np.linalg.norm(of.slopes, axis=3).mean(axis=1, keepdims=True)
    squares = np.maximum(np.sum((of.error / response) ** 2, axis=1), _LEAST)
    total = float(of.dof.sum())
    equal = total * np.log(squares.sum(axis=1) / total)
    unequal = np.log(squares / of.dof) @ of.dof
    if of.error.shape[2] != of.slopes.shape[3] or of.contrasts < 1:
        return equal, unequal, np.full(len(equal), np.inf)
    along, across = _apart(of, response)
    nu = float(of.contrasts)
    oriented = nu * np.log(along) + (total - nu) * np.log(across)
    return equal, unequal, np.where(across > along, oriented, np.inf)


def _apart(of: Residuals, response: Array) -> tuple[Array, Array]:
    """Return mean squares (B,) along and across the normals, of outputs over their response."""
    error, normal = of.error / response, of.normals * response
    unit = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    along = np.sum(np.einsum("bnm,bnm->bn", unit, error) ** 2, axis=1)
    across = np.einsum("bnm,bnm->b", error, error) - along
    nu, total = max(float(of.contrasts), 1.0), float(of.dof.sum())
    return np.maximum(along, _LEAST) / nu, np.maximum(across, _LEAST) / max(total - nu, 1.0)

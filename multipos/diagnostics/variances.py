"""Likelihood of the variances that residuals at known positions show.

`explain_equal`, `explain_unequal` and `explain_orientations` estimate the variances of (1), and
`least_deviance` the deviance at a given s². `prefers_unequal` and `prefers_orientations` tell which
explains more, `hints_at_orientations` whether s² would help at all, and `across_the_force` whether
R of (4) is beyond chance.

Beside a stated noise Σ the residuals e of a linear fit may have one of three more variances,

    V_k = Σ_k + τ² I,    V_k = Σ_k + diag(τ_i²),    V_k = Σ_k + τ² I + s² J_k J_k',         (1)

excess variance equal in all outputs, unequal, and orientation error, J_k J_k' = H (|f|² − f f') H'
with H = dh/df. The restricted likelihood, with P = V⁻¹ − V⁻¹X (X'V⁻¹X)⁻¹ X'V⁻¹,

    D = −2 ln L = Σ ln det V_k + ln det X'V⁻¹X + e'Pe,                                      (2)

at its minimum separates them: the second and third against the first by χ² on M − 1 and on one
degree of freedom, at 1 %. Its slopes with V = Σ + Σ_j θ_j C_j, and the average of its observed and
expected curvature, are

    dD/dθ_j = tr P C_j − e'P C_j P e,    A_ij = e'P C_i P C_j P e.                          (3)

From the moments two steps θ_j e'P C_j P e / tr P C_j, then −A⁻¹ dD/dθ held at θ ≥ 0, lead to where
the next one gains less than `_SETTLED`. An orientation error moves readings across the normal
n = H⁻ᵀ f and not along it, so that without a stated noise it shows in

    R = (|e|² − (n'e)²)/ν_across / ((n'e)²/ν_along),   n of length one,                     (4)

which is tested first. Arrays have a leading axis of B units at positions that they share.

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72 (2); A. R. Gilmour, R. Thompson, B. R. Cullis 1995,
Biometrics 51 (3).
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.cofactors import cofactors_of
from multipos.numerics.factoring import log_determinant
from multipos.numerics.quantiles import chi2_quantile, f_quantile
from multipos.results import frozen

LEVEL = 0.01  # at which one cause is preferred to another
TELLING = 6  # contrasts along the force from which orientation errors can be estimated
_EQUAL = np.eye(3)[..., None, None]  # C of one variance in three outputs
_SUSPECT = 0.02  # of R in eq. (4), from which the likelihood is evaluated
_ITERATIONS = 20
_FIXED_POINTS = 2  # first steps, far from where A holds
_PARTS = (0.25, 0.05)  # of a step, where the whole leads up
_SETTLED = 0.01  # of the deviance
_LONGEST = 1e3  # times the mean square, beyond which a variance is a trial that runs away
_NO_SLOPE = 1e-200  # of J J', that moves nothing
_SINGULAR = 1e-14  # of what is one, that is rounding
_RIDGE = 1e-9  # of the mean square: what V has at least, so that its inverse has digits
_ROWS = 20_000  # whose products are made at once


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
    stated : (B, n, M) array
        Stated variances, or zeros.
    """

    error: Array
    basis: Array
    columns: Sequence[Places]
    slopes: Array
    force: Array
    stated: Array

    @cached_property
    def scale(self) -> Array:
        """Variance (B,) of the size of residuals and stated variances."""
        return np.asarray(np.mean(self.error**2 + self.stated, axis=(1, 2)))

    @cached_property
    def by_output(self) -> Array:
        """Residuals and stated variances (2, M, B, n)."""
        return np.stack([np.moveaxis(self.error, 2, 0), np.moveaxis(self.stated, 2, 0)])

    @cached_property
    def normals(self) -> Array:
        """Vectors (B, n, 3) of readings that no rotation of the position moves."""
        cofactors = cofactors_of(np.moveaxis(self.slopes, (2, 3), (0, 1)))
        return np.asarray(np.einsum("ikbn,nk->bni", cofactors, self.force))

    @cached_property
    def across(self) -> Array:
        """J J' (M, M, B, n) per rad²."""
        moved = np.einsum("bnik,nk->ibn", self.slopes, self.force)
        square = np.einsum("nk,nk->n", self.force, self.force)
        both = np.einsum("bnik,bnjk->ijbn", self.slopes, self.slopes)
        return np.asarray(square * both - moved[:, None] * moved)

    @cached_property
    def parameters(self) -> Places:
        """Place of every parameter among M rows of T columns (p,)."""
        width = self.basis.shape[1]
        return np.concatenate([i * width + own for i, own in enumerate(self.columns)])

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of all outputs."""
        return float(self.error[0].size - len(self.parameters))

    @cached_property
    def oriented(self) -> "Explained":
        """What orientation error explains of them."""
        return explain_orientations(self)

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

    def some(self, which: Places) -> "Residuals":
        """Return some of the units."""
        parts = self.error[which], self.slopes[which], self.stated[which]
        return Residuals(parts[0], self.basis, self.columns, parts[1], self.force, parts[2])


class Explained(NamedTuple):
    """Variances θ (B, J) of eq. (1), and the deviance there (B,)."""

    variances: Array
    deviance: Array


def explain_equal(of: Residuals) -> Explained:
    """Return τ² equal in all outputs."""
    unit = np.eye(of.error.shape[2])[..., None, None]
    square = np.einsum("bnm,bnm->b", of.error, of.error) / of.freedom
    return _fit(of, [unit], (square - of.stated.mean(axis=(1, 2)))[:, None])


def explain_unequal(of: Residuals) -> Explained:
    """Return τ_i² of every output."""
    n, m = of.error.shape[1:]
    each = [np.diag(row)[..., None, None] for row in np.eye(m)]
    dof = np.array([n - len(own) for own in of.columns])
    return _fit(of, each, np.sum(of.error**2, axis=1) / dof - of.stated.mean(axis=1))


def explain_orientations(of: Residuals) -> Explained:
    """Return τ² equal in all outputs, and s² [rad²], of three outputs."""
    unit = of.normals / np.linalg.norm(of.normals, axis=2, keepdims=True)
    square = np.einsum("bnm,bnm->b", of.error, of.error)
    along = np.sum(np.einsum("bnm,bnm->bn", unit, of.error) ** 2, axis=1)
    size = np.einsum("mmbn->b", of.across) / (2.0 * of.error.shape[1])
    tau2 = along / max(of.contrasts, 1) - of.stated.mean(axis=(1, 2))
    tau2 = np.maximum(tau2, 1e-3 * of.scale * (of.stated.max(axis=(1, 2)) == 0.0))
    rest = (square - along) / max(of.freedom - of.contrasts, 1.0)
    s2 = (rest - np.maximum(tau2, 0.0) - of.stated.mean(axis=(1, 2))) / size
    return _fit(of, [_EQUAL, of.across], np.stack([tau2, s2], axis=1))


def hints_at_orientations(of: Residuals, equal: Explained) -> Mask:
    """Return of which units eq. (2) falls with s² from zero, at the τ² of equal outputs (B,).

    Where it does not, s² = 0 is a minimum, and `explain_orientations` need not search.
    """
    theta = np.concatenate([equal.variances, np.zeros((len(equal.variances), 1))], axis=1)
    slopes = _evaluate(of, [_EQUAL, of.across], theta)
    return ~_held(theta, slopes)[:, 1]


def prefers_orientations(equal: Explained, moved: Explained) -> Mask:
    """Return of which units orientation error explains the residuals better (B,)."""
    # on the edge of what s² may be χ² has half its weight at zero
    gain = equal.deviance - moved.deviance
    return np.asarray(gain >= chi2_quantile(1.0 - 2.0 * LEVEL, 1.0))


def prefers_unequal(equal: Explained, unequal: Explained) -> Mask:
    """Return of which units unequal outputs explain the residuals better (B,)."""
    free = unequal.variances.shape[1] - 1.0
    gain = equal.deviance - unequal.deviance
    return np.asarray((gain > chi2_quantile(1.0 - LEVEL, free)) if free else gain > np.inf)


def across_the_force(of: Residuals) -> Mask:
    """Return of which units R of eq. (4) is more than chance (B,), without a stated noise."""
    n, m = of.error.shape[1:]
    dof = np.array([n - len(own) for own in of.columns])
    with np.errstate(divide="ignore", invalid="ignore"):
        # residuals over their standard deviations, whose squares sum to the degrees of freedom
        variance = np.einsum("bnm,bnm->bm", of.error, of.error) / dof
        square = np.einsum("bnm,bm->bn", of.normals**2, variance)
        along = np.sum(np.einsum("bnm,bnm->bn", of.normals, of.error) ** 2 / square, axis=1)
        total = of.freedom
        suspect = (variance > 0.0).all(axis=1) & (along * m <= total)  # else it is along the force
        # R rises with the contrasts, of which there are n − p to n − 1; where its limit exists it
        # falls with both degrees of freedom
        fewest, most = float(n - len(of.parameters)), n - 1.0
        if fewest >= TELLING:
            largest = (total - along) / (total - most) / (along / most)
            suspect &= largest > f_quantile(1.0 - _SUSPECT, total - fewest, most)
        if not suspect.any() or of.contrasts < TELLING:
            return np.zeros(len(along), dtype=np.bool_)
        nu, left = total - of.contrasts, float(of.contrasts)
        ratio = (total - along) / nu / (along / left)
    return np.asarray(suspect & (ratio > f_quantile(1.0 - _SUSPECT, nu, left)))


def least_deviance(of: Residuals, s2: float) -> float:
    """Return the least deviance of one unit whose orientations vary by s²."""
    tau2 = of.scale[0] * np.geomspace(1e-8, 1.0, 33)
    theta = np.column_stack([tau2, np.full_like(tau2, s2)])
    same = of.some(np.zeros(len(tau2), dtype=np.intp))
    return float(_evaluate(same, [_EQUAL, of.across], theta).deviance.min())


class _Slopes(NamedTuple):
    """D of eq. (2) (B,), the two parts of dD/dθ (B, J), and A (B, J, J) of eq. (3)."""

    deviance: Array
    expected: Array
    observed: Array
    curvature: Array


def _fit(of: Residuals, components: Sequence[Array], start: Array) -> Explained:
    """Return the variances θ (B, J) of components C_j (M, M, B, n) at the minimum of eq. (2)."""
    moved = [np.einsum("iibn->b", each) / each[0, :, 0].size for each in components]
    size = np.maximum(np.stack(np.broadcast_arrays(*moved), axis=1), _NO_SLOPE)
    most = _LONGEST * of.scale[:, None] / size
    theta = np.clip(start, 0.0, most)
    here = _evaluate(of, components, theta)
    deviance = here.deviance.copy()
    units = np.arange(len(theta))
    for turn in range(_ITERATIONS):
        step, gain = _step(theta[units], here)
        going = gain > _SETTLED
        if not going.any():
            break
        units, step, here = units[going], step[going], _some(here, going)
        left = of.some(units)
        parts = [_of_units(each, units) for each in components]
        fixed = _fixed_point(theta[units], here, _RIDGE * left.scale[:, None])
        fixed, newton = (np.clip(at, 0.0, most[units]) for at in (fixed, theta[units] + step))
        trials = [fixed, newton] if turn < _FIXED_POINTS else [newton, fixed]
        trials += [theta[units] + part * (newton - theta[units]) for part in _PARTS]
        trial, there = _first_down(left, parts, trials, here)
        better = there.deviance <= here.deviance
        units, here = units[better], _some(there, better)
        theta[units], deviance[units] = trial[better], here.deviance
    return Explained(theta, deviance)


def _first_down(
    of: Residuals, components: Sequence[Array], trials: Sequence[Array], here: _Slopes
) -> tuple[Array, _Slopes]:
    """Return of every unit the first of trials (B, J) that does not lead up, or the last."""
    trial, there = trials[0], _evaluate(of, components, trials[0])
    for following in trials[1:]:
        up = np.flatnonzero(~(there.deviance <= here.deviance))
        if not len(up):
            break
        trial[up] = following[up]
        parts = [_of_units(each, up) for each in components]
        other = _evaluate(of.some(up), parts, trial[up])
        for mine, each in zip(there, other, strict=True):
            mine[up] = each
    return trial, there


def _of_units(component: Array, units: Places) -> Array:
    return component if component.shape[2] == 1 else component[:, :, units]


def _some(slopes: _Slopes, which: Mask) -> _Slopes:
    return _Slopes(*(each[which] for each in slopes))


def _held(theta: Array, here: _Slopes) -> Mask:
    """Return which variances (B, J) are zero and would fall."""
    return np.asarray((theta == 0.0) & (here.expected > here.observed))


def _fixed_point(theta: Array, here: _Slopes, least: Array) -> Array:
    """Return θ_j e'P C_j P e / tr P C_j, at once the answer where one component is all of V."""
    start = np.maximum(theta, least)
    tells = start * here.expected > _SINGULAR  # of the degrees of freedom
    found = start * np.where(tells, here.observed / np.where(tells, here.expected, 1.0), 1.0)
    return np.where(_held(theta, here), 0.0, found)


def _step(theta: Array, here: _Slopes) -> tuple[Array, Array]:
    """Return steps (B, J) of what is not held at zero, and what they should gain (B,)."""
    own = np.einsum("bjj->bj", here.curvature)
    held = _held(theta, here) | ~(own > 1e-280)  # of what changes nothing a step has no length
    gradient = np.where(held, 0.0, here.expected - here.observed)
    free = ~held[:, :, None] & ~held[:, None, :]
    size = np.sqrt(np.where(held, 1.0, own))
    A = np.where(free, here.curvature / (size[:, :, None] * size[:, None, :]), 0.0)
    A += np.where(held, 1.0, 1e-9)[:, :, None] * np.eye(theta.shape[1])
    step = -np.linalg.solve(A, (gradient / size)[:, :, None])[:, :, 0] / size
    return step, -0.5 * np.einsum("bj,bj->b", step, gradient)


def _evaluate(of: Residuals, components: Sequence[Array], theta: Array) -> _Slopes:
    """Return the deviance with its slopes at variances θ (B, J)."""
    e, stated = of.by_output
    m, count, _ = e.shape
    V = np.zeros((m, *e.shape))
    V[np.arange(m), np.arange(m)] = stated + (_RIDGE * of.scale)[:, None]
    for j, component in enumerate(components):
        V += theta[:, [j]] * component
    W, log_det = _inverse(V)
    WC = [np.einsum("ikbn,kjbn->ijbn", W, component) for component in components]
    WCW = [np.einsum("ikbn,kjbn->ijbn", each, W) for each in WC]
    S, *lost = _information(of, np.stack([W, *WCW]))
    size = np.sqrt(np.einsum("bpp->bp", S))  # outputs, and columns, may be of very unlike size
    size = np.where(size > 0.0, size, 1.0)  # some rows may be zero in a column
    scales = size[:, :, None] * size[:, None, :]
    unit = S / scales + _SINGULAR * np.eye(size.shape[1])  # columns may be alike but for rounding
    inverse = np.linalg.inv(unit) / scales

    def projected(v: Array) -> Array:
        """Return P v of J vectors (J, M, B, n)."""
        white = np.einsum("ijbn,kjbn->kibn", W, v)
        own = (white @ of.basis).swapaxes(1, 2).reshape(len(v), count, -1)
        fitted = np.zeros_like(own)
        fitted[..., of.parameters] = np.einsum("bpq,kbq->kbp", inverse, own[..., of.parameters])
        back = fitted.reshape(len(v), count, m, -1).swapaxes(1, 2) @ of.basis.T
        return np.asarray(white - np.einsum("ijbn,kjbn->kibn", W, back))

    q = projected(e[None])[0]
    log_det = log_det + log_determinant(unit)[1] + 2.0 * np.log(size).sum(axis=1)
    pulled = np.stack([np.einsum("ijbn,jbn->ibn", component, q) for component in components])
    traces = [
        np.einsum("iibn->b", each) - np.einsum("bpq,bqp->b", inverse, own)
        for each, own in zip(WC, lost, strict=True)
    ]
    return _Slopes(
        deviance=log_det + np.einsum("mbn,mbn->b", e, q),
        expected=np.stack(traces, axis=1),
        observed=np.einsum("mbn,jmbn->bj", q, pulled),
        curvature=np.einsum("jmbn,kmbn->bjk", pulled, projected(pulled)),
    )


def _inverse(V: Array) -> tuple[Array, Array]:
    """Return V⁻¹ (M, M, B, n) and Σ ln det V (B,)."""
    size = V.max(axis=(0, 1, 3), initial=np.finfo(float).tiny)[:, None]  # no det underflows
    V = V / size
    if len(V) == 3:
        cofactors = cofactors_of(V)
        det = np.einsum("kbn,kbn->bn", V[0], cofactors[0])
        W = cofactors / (det * size)
    else:
        last = np.moveaxis(V, (0, 1), (2, 3))
        det = np.linalg.det(last)
        W = np.moveaxis(np.linalg.inv(last), (2, 3), (0, 1)) / size
    return W, np.asarray(np.sum(np.log(det) + len(V) * np.log(size), axis=1))


def _information(of: Residuals, W: Array) -> Array:
    """Return X'WX (K, B, p, p) of symmetric W (K, M, M, B, n)."""
    kinds, m, _, count, n = W.shape
    width = of.basis.shape[1]
    total = np.zeros((kinds, count, m * m, width * width))
    for first in range(0, n, _ROWS):
        phi = of.basis[first : first + _ROWS]
        products = (phi[:, :, None] * phi[:, None, :]).reshape(len(phi), -1)
        own = W[..., first : first + _ROWS].reshape(kinds, m * m, count, -1)
        total += own.swapaxes(1, 2) @ products
    whole = total.reshape(kinds, count, m, m, width, width).swapaxes(3, 4)
    whole = whole.reshape(kinds, count, m * width, m * width)
    return np.asarray(whole[..., of.parameters[:, None], of.parameters])

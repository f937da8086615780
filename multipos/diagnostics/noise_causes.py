"""Which variance explains residuals at known positions: of readings, of outputs, of orientations.

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
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.factoring import cofactors_of
from multipos.numerics.quantiles import chi2_quantile, f_quantile

LEVEL = 0.01  # at which one cause is preferred to another
TELLING = 6  # contrasts along the force from which orientation errors can be estimated
_SUSPECT = 0.02  # of R in eq. (4), from which the likelihood is evaluated
_ITERATIONS = 20
_FIXED_POINTS = 2  # first steps, far from where A holds
_PARTS = (0.25, 0.05)  # of a step, where the whole leads up
_SETTLED = 0.01  # of the deviance
_RIDGE = 1e-9  # of the mean square: what V has at least, so that its inverse has digits
_ROWS = 20_000  # whose products are made at once


@dataclass(frozen=True, eq=False)
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
    columns: Sequence[NDArray[np.intp]]
    slopes: Array
    force: Array
    stated: Array

    @cached_property
    def scale(self) -> Array:
        """Variance (B,) of the size of residuals and stated variances."""
        return np.asarray(np.mean(self.error**2 + self.stated, axis=(1, 2)))

    @cached_property
    def normals(self) -> Array:
        """Vectors (B, n, 3) of readings that no rotation of the position moves."""
        cofactors = cofactors_of(np.moveaxis(self.slopes, (2, 3), (0, 1)))
        return np.asarray(np.einsum("ikbn,nk->bni", cofactors, self.force))

    @cached_property
    def across(self) -> Array:
        """J J' (B, n, M, M) per rad²."""
        moved = np.einsum("bnik,nk->bni", self.slopes, self.force)
        square = np.einsum("nk,nk->n", self.force, self.force)[:, None, None]
        both = self.slopes @ self.slopes.transpose(0, 1, 3, 2)
        return np.asarray(square * both - moved[..., :, None] * moved[..., None, :])

    @cached_property
    def parameters(self) -> NDArray[np.intp]:
        """Place of every parameter among M rows of T columns (p,)."""
        width = self.basis.shape[1]
        return np.concatenate([i * width + own for i, own in enumerate(self.columns)])

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of all outputs."""
        return float(self.error[0].size - len(self.parameters))

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

    def some(self, which: NDArray[np.intp]) -> "Residuals":
        """Return some of the units."""
        parts = self.error[which], self.slopes[which], self.stated[which]
        return Residuals(parts[0], self.basis, self.columns, parts[1], self.force, parts[2])


class Explained(NamedTuple):
    """Variances θ (B, J) of eq. (1), and the deviance there (B,)."""

    variances: Array
    deviance: Array


def explain_equal(of: Residuals) -> Explained:
    """Return τ² equal in all outputs."""
    unit = np.eye(of.error.shape[2])[None, None]
    square = np.einsum("bnm,bnm->b", of.error, of.error) / of.freedom
    return _fit(of, [unit], (square - of.stated.mean(axis=(1, 2)))[:, None])


def explain_unequal(of: Residuals) -> Explained:
    """Return τ_i² of every output."""
    n, m = of.error.shape[1:]
    each = [np.diag(row)[None, None] for row in np.eye(m)]
    dof = np.array([n - len(own) for own in of.columns])
    return _fit(of, each, np.sum(of.error**2, axis=1) / dof - of.stated.mean(axis=1))


def explain_orientations(of: Residuals) -> Explained:
    """Return τ² equal in all outputs, and s² [rad²], of three outputs."""
    unit = of.normals / np.linalg.norm(of.normals, axis=2, keepdims=True)
    square = np.einsum("bnm,bnm->b", of.error, of.error)
    along = np.sum(np.einsum("bnm,bnm->bn", unit, of.error) ** 2, axis=1)
    size = np.einsum("bnmm->b", of.across) / (2.0 * of.error.shape[1])
    tau2 = along / max(of.contrasts, 1) - of.stated.mean(axis=(1, 2))
    tau2 = np.maximum(tau2, 1e-3 * of.scale * (of.stated.max(axis=(1, 2)) == 0.0))
    rest = (square - along) / max(of.freedom - of.contrasts, 1.0)
    s2 = (rest - np.maximum(tau2, 0.0) - of.stated.mean(axis=(1, 2))) / size
    return _fit(of, [np.eye(3)[None, None], of.across], np.stack([tau2, s2], axis=1))


def prefers_orientations(equal: Explained, moved: Explained) -> NDArray[np.bool_]:
    """Return of which units orientation error explains the residuals better (B,)."""
    # on the edge of what s² may be χ² has half its weight at zero
    gain = equal.deviance - moved.deviance
    return np.asarray(gain >= chi2_quantile(1.0 - 2.0 * LEVEL, 1.0))


def prefers_unequal(equal: Explained, unequal: Explained) -> NDArray[np.bool_]:
    """Return of which units unequal outputs explain the residuals better (B,)."""
    free = unequal.variances.shape[1] - 1.0
    gain = equal.deviance - unequal.deviance
    return np.asarray((gain > chi2_quantile(1.0 - LEVEL, free)) if free else gain > np.inf)


def across_the_force(of: Residuals) -> NDArray[np.bool_]:
    """Return of which units R of eq. (4) is more than chance (B,), without a stated noise."""
    n, m = of.error.shape[1:]
    dof = np.array([n - len(own) for own in of.columns])
    with np.errstate(divide="ignore", invalid="ignore"):
        sd = np.sqrt(np.einsum("bnm,bnm->bm", of.error, of.error) / dof)[:, None]
        e, normal = of.error / sd, of.normals * sd
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
        along = np.sum(np.einsum("bnm,bnm->bn", normal, e) ** 2, axis=1)
        total = np.einsum("bnm,bnm->b", e, e)
        suspect = (sd > 0.0).all(axis=(1, 2)) & (along * m <= total)  # else it lies along the force
        if not suspect.any() or of.contrasts < TELLING:
            return np.zeros(len(e), dtype=np.bool_)
        nu, left = of.freedom - of.contrasts, float(of.contrasts)
        ratio = (total - along) / nu / (along / left)
    return np.asarray(suspect & (ratio > f_quantile(1.0 - _SUSPECT, nu, left)))


class _Slopes(NamedTuple):
    """D of eq. (2) (B,), the two parts of dD/dθ (B, J), and A (B, J, J) of eq. (3)."""

    deviance: Array
    expected: Array
    observed: Array
    curvature: Array


def _fit(of: Residuals, components: Sequence[Array], start: Array) -> Explained:
    """Return the variances θ (B, J) of components C_j at the minimum of eq. (2)."""
    theta = np.maximum(start, 0.0)
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
        parts = [each if len(each) == 1 else each[units] for each in components]
        fixed = _fixed_point(theta[units], here, _RIDGE * left.scale[:, None])
        newton = np.maximum(theta[units] + step, 0.0)
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
        parts = [each if len(each) == 1 else each[up] for each in components]
        other = _evaluate(of.some(up), parts, trial[up])
        for mine, each in zip(there, other, strict=True):
            mine[up] = each
    return trial, there


def _some(slopes: _Slopes, which: NDArray[np.bool_]) -> _Slopes:
    return _Slopes(*(each[which] for each in slopes))


def _held(theta: Array, here: _Slopes) -> NDArray[np.bool_]:
    """Return which variances (B, J) are zero and would fall."""
    return np.asarray((theta == 0.0) & (here.expected > here.observed))


def _fixed_point(theta: Array, here: _Slopes, least: Array) -> Array:
    """Return θ_j e'P C_j P e / tr P C_j, at once the answer where one component is all of V."""
    found = np.maximum(theta, least) * here.observed / np.maximum(here.expected, 1e-300)
    return np.where(_held(theta, here), 0.0, found)


def _step(theta: Array, here: _Slopes) -> tuple[Array, Array]:
    """Return steps (B, J) of what is not held at zero, and what they should gain (B,)."""
    held = _held(theta, here)
    gradient = np.where(held, 0.0, here.expected - here.observed)
    free = ~held[:, :, None] & ~held[:, None, :]
    size = np.sqrt(np.maximum(np.einsum("bjj->bj", here.curvature), 1e-300))
    A = np.where(free, here.curvature / (size[:, :, None] * size[:, None, :]), 0.0)
    A += np.where(held, 1.0, 1e-9)[:, :, None] * np.eye(theta.shape[1])
    step = -np.linalg.solve(A, (gradient / size)[:, :, None])[:, :, 0] / size
    return step, -0.5 * np.einsum("bj,bj->b", step, gradient)


def _evaluate(of: Residuals, components: Sequence[Array], theta: Array) -> _Slopes:
    """Return the deviance with its slopes at variances θ (B, J)."""
    (count, _, m), e = of.error.shape, of.error
    diagonal = of.stated + (_RIDGE * of.scale)[:, None, None]
    V = diagonal[..., None] * np.eye(m)
    for j, component in enumerate(components):
        V = V + theta[:, j, None, None, None] * component
    W, log_det = _inverse(V)
    S = _information(of, W)
    inverse = np.linalg.inv(S)

    def projected(v: Array) -> Array:
        """Return P v (B, n, M)."""
        white = np.einsum("bnij,bnj->bni", W, v)
        fitted = np.zeros((count, m * of.basis.shape[1]))
        own = (of.basis.T @ white).transpose(0, 2, 1).reshape(count, -1)[:, of.parameters]
        fitted[:, of.parameters] = np.einsum("bpq,bq->bp", inverse, own)
        back = of.basis @ fitted.reshape(count, m, -1).transpose(0, 2, 1)
        return np.asarray(white - np.einsum("bnij,bnj->bni", W, back))

    q = projected(e)
    deviance = log_det + np.linalg.slogdet(S)[1] + np.einsum("bnm,bnm->b", e, q)
    pulled = [np.einsum("bnij,bnj->bni", np.broadcast_to(C, V.shape), q) for C in components]
    expected = np.empty((count, len(components)))
    for j, component in enumerate(components):
        WC = W @ component
        lost = np.einsum("bpq,bqp->b", inverse, _information(of, WC @ W))
        expected[:, j] = np.einsum("bnii->b", WC) - lost
    observed = np.stack([np.einsum("bnm,bnm->b", q, each) for each in pulled], axis=1)
    stepped = [projected(each) for each in pulled]
    curvature = [[np.einsum("bnm,bnm->b", a, b) for b in stepped] for a in pulled]
    return _Slopes(deviance, expected, observed, np.moveaxis(np.array(curvature), 2, 0))


def _inverse(V: Array) -> tuple[Array, Array]:
    """Return V⁻¹ (B, n, M, M) and Σ ln det V (B,)."""
    if V.shape[2] != 3:
        return np.asarray(np.linalg.inv(V)), np.asarray(np.linalg.slogdet(V)[1].sum(axis=1))
    moved = np.moveaxis(V, (2, 3), (0, 1))
    cofactors = cofactors_of(moved)
    det = np.einsum("kbn,kbn->bn", moved[0], cofactors[0])
    W = np.ascontiguousarray(np.moveaxis(cofactors / det, (0, 1), (2, 3)))
    return W, np.asarray(np.log(det).sum(axis=1))


def _information(of: Residuals, W: Array) -> Array:
    """Return X'WX (B, p, p) of symmetric W (B, n, M, M)."""
    count, n, m, _ = W.shape
    width = of.basis.shape[1]
    total = np.zeros((count, m * m, width * width))
    for first in range(0, n, _ROWS):
        phi = of.basis[first : first + _ROWS]
        products = (phi[:, :, None] * phi[:, None, :]).reshape(len(phi), -1)
        total += W[:, first : first + _ROWS].reshape(count, -1, m * m).transpose(0, 2, 1) @ products
    whole = total.reshape(count, m, m, width, width).transpose(0, 1, 3, 2, 4)
    whole = whole.reshape(count, m * width, m * width)
    return np.asarray(whole[:, of.parameters[:, None], of.parameters])

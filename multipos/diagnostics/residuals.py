"""Cautions about what the residuals show, of readings that are no gross error.

- Repeats scatter less than the model misses their means (lack of fit, an F test of the fit).
- Rows whose correlation U follows from count as fewer. What else residuals show in the order of
  their rows stands in `multipos.diagnostics.row_order`.

Cautions about what was stated of readings and positions, with the cause that the data prefer. A
missing term comes before all of them: it has its own test, and looks like any of them.

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

Uncertain and unknown orientations take the noise of outputs as equal, or as stated. With the
projection P = W − WA S⁻¹A'W of `multipos.estimation.likelihood` and v_i the variances taken, the
score of ln v_i and its information are

    U_i = ½ Σ_k (v_i (Σ_k⁻¹ r_k)_i² / φ − v_i P_ki,ki),    I_ij = ½ Σ_kl v_i v_j P_ki,lj²,      (5)

φ the common factor that makes Σ U_i zero; U'I⁻¹U follows χ² on M − 1 where they are right.

References
----------
D. A. Harville 1977, J. Am. Stat. Assoc. 72 (2); A. R. Gilmour, R. Thompson, B. R. Cullis 1995,
Biometrics 51 (3).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.diagnostics.columns import repeated_rows
from multipos.diagnostics.score_tests import significant
from multipos.estimation.gains import information_at_solution
from multipos.estimation.known import REJECTED
from multipos.estimation.likelihood import weigh
from multipos.estimation.outliers import Outlying, find_outlying_rows
from multipos.files.numbers import p_in_words
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, resolution
from multipos.numerics.factoring import cofactors_of, is_regular
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_quantile
from multipos.positions.readings import diagonal
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.found import Estimator

LEVEL = 0.01  # at which one cause is preferred to another
TELLING = 6  # contrasts along the force from which orientation errors can be estimated
_SUSPECT = 0.02  # of R in eq. (4), from which the likelihood is evaluated
_ITERATIONS = 20
_FIXED_POINTS = 2  # first steps, far from where A holds
_PARTS = (0.25, 0.05)  # of a step, where the whole leads up
_SETTLED = 0.01  # of the deviance
_LONGEST = 1e3  # times the mean square, beyond which a variance is a trial that runs away
_NO_SLOPE = 1e-200  # of J J', that moves nothing
_SINGULAR = 1e-14  # of what is one, that is rounding
_RIDGE = 1e-9  # of the mean square: what V has at least, so that its inverse has digits
_GROSSLY = 2.0  # times the orientation sd of the others, which a gross error makes of it
_ROWS = 20_000  # whose products are made at once
_EQUAL = np.eye(3)[..., None, None]  # of three outputs


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
    log_det = log_det + np.linalg.slogdet(unit)[1] + 2.0 * np.log(size).sum(axis=1)
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


_LEVEL = 0.01  # at which repeats reject the model, all outputs together
_ROUNDING = 1e-12  # of a response: residuals that are nothing
_SHOWN = 4
_NAMED = 2  # outlying readings in one sentence
_GROSS = 100.0  # times that residuals are smaller without rows that nobody should use
_ENOUGH = 3  # degrees of freedom without them
_SIGN = 0.2  # of an error: how near twice the reading it is where a sign was lost


def outlier(c: Calibration, *, sought: bool = False) -> Finding | None:
    """Find positions that stick out, and readings whose sign is lost.

    Rows that are outliers may have been sought before the fit, and none be there.
    """
    of_rows = None if sought else outlier_of_rows(c)
    if of_rows is not None:
        return of_rows
    found = c.diagnostics.outliers
    noise = c.residual_sd > _ROUNDING * np.linalg.norm(c.sensitivity, axis=1) if found else ()
    if not found or not np.any(noise):
        return None
    if understated_orientations(c) is not None:
        return None
    more = f"; and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return Finding(
        "outlier",
        "warning",
        f"{'; '.join(found[:_NAMED])}{more}",
        "Measure again, omit it, or fit with --robust huber.",
        rows=_named_in(found, c.readings.labels),
    )


def _named_in(texts: Sequence[str], labels: Sequence[str]) -> tuple[str, ...]:
    """Return the labels of positions that texts begin with."""
    begun = {
        text[len("position ") : end]
        for text in texts
        if text.startswith("position ")
        for end, mark in enumerate(text)
        if mark in ": "
    }
    return tuple(dict.fromkeys(label for label in labels if label in begun))


def outlying_rows(c: Calibration) -> Outlying | None:
    """Return the rows that are outliers, where all positions are listed, or none."""
    readings, reference = c.readings, None
    if c.estimator is not Estimator.UNKNOWN:
        if readings.group is not None or readings.open_roll is not None or readings.up is None:
            return None
        size = np.linalg.norm(c.reference, axis=1, keepdims=True)
        reference = c.reference if c.estimator.exact else c.sign * size * readings.up
        if not np.isfinite(reference).all():
            return None
    sd = None if reference is None else readings.orientation_sd
    return find_outlying_rows(c.model, readings, reference, sd)


def outlier_of_rows(c: Calibration) -> Finding | None:
    """Find rows that are off the fit of the others, by the readings and positions alone."""
    found = outlying_rows(c)
    return None if found is None else _outlying(c, found)


def _outlying(c: Calibration, found: Outlying) -> Finding:
    labels = [c.readings.labels[row] for row in found.rows.tolist()]
    off = [f"{1e3 * size:.3g} mg" for size in found.off.tolist()]
    gross = found.ratio > _GROSS and found.dof >= _ENOUGH
    pairs = list(zip(labels, off, strict=True))
    said = ", ".join(f"{label} ({size})" for label, size in pairs[:_SHOWN])
    more = f" and {len(pairs) - _SHOWN} more" if len(pairs) > _SHOWN else ""
    one = len(pairs) == 1
    said = f"position {said} deviates" if one else f"positions {said}{more} deviate"
    named = ",".join(dict.fromkeys(labels))
    lost = _signs_lost(c, found)
    if lost:
        cells = ", ".join(f"{output} of position {label}" for label, output in lost)
        return Finding(
            "flipped-row",
            "error" if gross else "warning",
            f"{cells} has the wrong sign: reversed, it agrees with the other readings",
            f"Correct the sign, or set aside with --exclude {named}.",
            rows=tuple(dict.fromkeys(labels)),
            outputs=tuple(dict.fromkeys(output for _, output in lost)),
        )
    lower = f"; residuals without are {found.ratio:.2g} times smaller" if gross else ""
    return Finding(
        "outlier",
        "error" if gross else "warning",
        f"{said} from the fit of the others{lower}",
        f"Measure again, or set aside with --exclude {named}.",
        rows=tuple(dict.fromkeys(labels)),
    )


def _signs_lost(c: Calibration, found: Outlying) -> list[tuple[str, str]]:
    """Return the labels and outputs whose signs, turned, explain all outliers; none otherwise."""
    if found.errors is None:
        return []
    values = c.readings.values[found.rows]
    # Twice the reading is what a sign is off by, to a twentieth, biases of a few percent included.
    turned = np.abs(found.errors - 2.0 * values) < _SIGN * np.abs(found.errors)
    size = np.linalg.norm(found.errors, axis=1, keepdims=True)
    if not (turned | (np.abs(found.errors) < _SIGN * size)).all():
        return []
    return [
        (c.readings.labels[found.rows[row]], c.outputs[column])
        for row, column in np.argwhere(turned & (np.abs(found.errors) >= _SIGN * size)).tolist()
    ]


def lack_of_fit(c: Calibration) -> Finding | None:
    """Find outputs whose repeats scatter less than the model misses them."""
    if c.effective_rows:  # neighbours are no repeats
        return None
    level = _LEVEL / len(c.outputs)
    small = {}
    for output, test in c.diagnostics.lack_of_fit.items():
        p, i = test["p"], c.outputs.index(output)
        if not isinstance(p, float) or p >= level:
            continue
        # repeats that agree because they are rounded say nothing of the noise
        if c.residual_sd[i] > resolution(c.readings.values[:, i]):
            small[output] = p
    if not small or repeated_rows(c) is not None:  # copies are no repeats
        return None
    said = ", ".join(f"{output} ({p_in_words(p)})" for output, p in small.items())
    return Finding(
        "lack-of-fit",
        "warning",
        (
            f"residuals exceed what repeats of a position show: {said}; a term is missing, or "
            "positions are not as listed"
        ),
        "Fit with more terms, or with --orientation-sd auto.",
        outputs=tuple(small),
    )


def effective_number(c: Calibration) -> Finding | None:
    """Find rows that count as fewer, of whose correlation U follows."""
    if not c.effective_rows:
        return None
    n = len(c.residuals)
    fewer = {output: rows for output, rows in c.effective_rows.items() if rows < n}
    said = ", ".join(f"{output} {max(rows, 1.0):.2g}" for output, rows in fewer.items())
    return Finding(
        "time-correlated",
        "warning",
        (
            f"noise of neighbouring rows is correlated: {n} rows equal fewer independent ones "
            f"({said}); U includes it"
        ),
        "Measure the positions several times, in random order.",
        outputs=tuple(fewer),
    )


_FEW = 6.0  # degrees of freedom below which the law of eq. (5) is not reached
_MOST = 600  # readings beyond which eq. (5) is not worked out


def rejected_noise(c: Calibration) -> Finding | None:
    """Find a stated noise that the residuals reject, and name the cause that the data favour."""
    claim = c.diagnostics.claim
    if claim is None or not claim.chi2 > chi2_quantile(REJECTED, claim.dof):
        return None
    found = c.variance_components
    scatter = found and found.rest_to_rest
    added = "U was increased"
    if scatter:
        sizes = ", ".join(dict.fromkeys(f"{part.value:.2g}" for part in scatter.values()))
        added = f"U includes an excess of {sizes} {c.model.unit}"
    cause, action = _cause(c)
    return Finding(
        "denied-noise",
        "warning",
        (
            f"residuals exceed the stated noise (chi-square {claim.chi2:.4g} on "
            f"{claim.dof:g} dof); {added}; {cause}"
        ),
        action,
    )


def orientation_error(
    c: Calibration, residuals: Callable[[], Residuals], outlying: Sequence[str] = ()
) -> Finding | None:
    """Find readings that scatter across the force, as orientation errors make them.

    Where positions are outlying, those that are not must do so too.
    """
    if c.noise is not None or not _separable(c):
        return None
    of = residuals()
    if not across_the_force(of)[0] or significant(c.diagnostics.model_tests):
        return None
    if outlying:
        kept = np.array([label not in outlying for label in c.readings.labels])
        others = _of_rows(c, kept, c.reference)
        if others is None or not across_the_force(others)[0]:
            return None
    degrees = _orientation_error(explain_equal(of), of.oriented)
    if degrees is None:
        return None
    return Finding(
        "placement",
        "warning",
        (
            f"residuals suggest orientation errors of {degrees:.2g} degrees (1 sigma); U takes "
            "positions as exact"
        ),
        "Fit with --orientation-sd auto.",
    )


def understated_orientations(c: Calibration) -> Finding | None:
    """Find positions off by more than stated, where some were set aside or do not fit.

    Asked of the others: a gross error of one position is no cause of theirs.
    """
    if c.estimator is not Estimator.UNCERTAIN:
        return None
    said = {row for each in c.diagnostics.findings if each.code == "set-aside" for row in each.rows}
    said.update(_named_in(c.diagnostics.outliers, c.readings.labels))
    sd, up = c.readings.orientation_sd, c.readings.up
    known = any(each.code == "placement" for each in c.diagnostics.findings)
    if known or not said or sd is None or up is None:
        return None
    kept = np.array([label not in said for label in c.readings.labels])
    if not _is_triad(c) or not (np.isfinite(sd[kept]) & (sd[kept] > 0.0)).all():
        return None
    of = _at_listed(c, kept, up, sd)
    if of is None or of.contrasts < 1:
        return None
    moved, size = explain_orientations(of), math.sqrt(float(np.mean(sd[kept] ** 2)))
    found = math.sqrt(float(moved.variances[0, 1]))
    if found <= size:
        return None
    gain = _least_deviance(of, size**2) - moved.deviance[0]
    if gain < chi2_quantile(1.0 - 2.0 * LEVEL, 1.0):
        return None
    whole = _at_listed(c, np.ones_like(kept), up, sd)
    assert whole is not None
    every = math.sqrt(float(explain_orientations(whole).variances[0, 1]))
    if every < _GROSSLY * found:  # else one of them is a gross error besides
        found = every
    degrees, stated = math.degrees(found), math.degrees(size)
    robust = ", without --robust" if c.robust_weight is not None else ""
    return Finding(
        "placement",
        "warning",
        (
            f"residuals suggest orientation errors of {degrees:.2g} degrees (1 sigma), more than "
            f"the stated {stated:.2g}; positions that do not fit follow from it"
        ),
        f"Fit with --orientation-sd auto{robust}.",
    )


def _at_listed(c: Calibration, kept: Mask, up: Array, sd: Array) -> Residuals | None:
    """Return residuals of rows at their listed positions, whose slopes are larger where sd is."""
    of = _of_rows(c, kept, c.sign * np.linalg.norm(c.reference, axis=1, keepdims=True) * up)
    if of is None:
        return None
    relative = sd[kept] / np.sqrt(np.mean(sd[kept] ** 2))
    return replace(of, slopes=of.slopes * relative[:, None, None])


def _of_rows(c: Calibration, kept: Mask, reference: Array) -> Residuals | None:
    """Return residuals of rows at known positions, by least squares; None without any."""
    force, values = reference[kept], c.readings.values[kept]
    columns = {name: column[kept] for name, column in c.readings.environment.items()}
    basis, error = c.model.basis(force, columns), np.empty_like(values)
    for i, own in enumerate(c.model.columns):
        if len(basis) <= len(own):
            return None
        Q = np.linalg.qr(basis[:, own])[0]
        error[:, i] = values[:, i] - Q @ (Q.T @ values[:, i])
    slopes = c.model.force_jacobian(c.parameters, force, columns)
    stated = np.zeros_like(values)
    if c.readings.noise is not None:
        stated = diagonal(c.readings.noise).reshape(c.residuals.shape)[kept]
    return Residuals(error[None], basis, c.model.columns, slopes[None], force, stated[None])


def _least_deviance(of: Residuals, s2: float) -> float:
    """Return the least deviance of one unit whose orientations vary by s²."""
    tau2 = of.scale[0] * np.geomspace(1e-8, 1.0, 33)
    theta = np.column_stack([tau2, np.full_like(tau2, s2)])
    same = of.some(np.zeros(len(tau2), dtype=np.intp))
    return float(_evaluate(same, [_EQUAL, of.across], theta).deviance.min())


def unequal_noise(c: Calibration) -> Finding | None:
    """Find outputs of unequal noise where the likelihood takes them as equal, or as stated."""
    if c.estimator.exact or c.robust_weight is not None or len(c.outputs) < 2:
        return None
    p, sizes = judge_equality(c)
    if not p < _LEVEL or significant(c.diagnostics.model_tests):
        return None
    noisiest, quietest = int(np.argmax(sizes)), int(np.argmin(sizes))
    return Finding(
        "unequal-noise",
        "warning",
        (
            f"{c.outputs[noisiest]} is {sizes[noisiest] / sizes[quietest]:.2g} times as noisy as "
            f"{c.outputs[quietest]} ({p_in_words(p)}); its U is too small, as the fit takes "
            f"{'stated' if c.readings.noise is not None else 'equal'} noise"
        ),
        "State the noise of each output with --reading-sd.",
        outputs=c.outputs,
    )


_STATE = "State a larger --reading-sd."
_STATE_EACH = "State the noise of each output with --reading-sd."
_EXCESS = "the likely cause is variation from rest to rest"


def _cause(c: Calibration) -> tuple[str, str]:
    """Return the likely cause of noise beyond the stated one, and the action in this mode."""
    if c.estimator.exact:
        return _cause_at_known(c)
    if c.robust_weight is None and judge_equality(c)[0] < _LEVEL:
        return "the outputs differ in noise", _STATE_EACH
    return _EXCESS, _STATE


def _cause_at_known(c: Calibration) -> tuple[str, str]:
    plain = c.readings.noise is not None and c.readings.noise.ndim == 1 and c.robust_weight is None
    if not plain or isinstance(c.model, ExpressionModel):
        return _EXCESS, _STATE
    of = residuals_of(c)
    equal, unequal = explain_equal(of), explain_unequal(of)
    degrees, contrasts = None, 1
    if _separable(c):
        contrasts = of.contrasts
        moved = explain_orientations(of) if hints_at_orientations(of, equal)[0] else equal
        degrees = None if moved is equal else _orientation_error(equal, moved)
        if degrees is not None and moved.deviance[0] <= unequal.deviance[0]:
            size = f"the likely cause is orientation errors of {degrees:.2g} degrees"
            if contrasts >= TELLING:
                return size, "Fit with --orientation-sd auto."
            return f"{size} or variation from rest to rest", f"Fit with {_sd(degrees)}."
    if degrees is None and contrasts < 1:
        # A turn moves the two outputs across a face, a scatter all three.
        off = math.sqrt(1.5 * float(np.mean(equal.variances[0] / np.sum(c.sensitivity**2, axis=1))))
        text = "orientation errors and variation from rest to rest cannot be separated"
        return text, f"Add {_sd(math.degrees(off))} if the sensor was positioned by hand."
    if prefers_unequal(equal, unequal)[0]:
        pairs = zip(c.outputs, np.sqrt(unequal.variances[0]).tolist(), strict=True)
        sizes = ", ".join(f"{output} {size:.2g}" for output, size in pairs)
        return f"{_EXCESS}, unequal in the outputs ({sizes} {c.model.unit})", _STATE_EACH
    return _EXCESS, _STATE


def _sd(degrees: float) -> str:
    return f"--orientation-sd {degrees:.2g}"


def residuals_of(c: Calibration) -> Residuals:
    """Return the residuals of a calibration at known positions, as a batch of one."""
    stated = np.zeros_like(c.residuals)
    if c.readings.noise is not None:
        stated = diagonal(c.readings.noise).reshape(c.residuals.shape)
    columns, rows = c.readings.environment, 1 if c.model.is_linear else len(c.residuals)
    return Residuals(
        error=c.residuals[None],
        basis=c.model.basis(c.reference, columns),
        columns=c.model.columns,
        slopes=c.model.force_jacobian(c.parameters, c.reference[:rows], columns)[None],
        force=c.reference,
        stated=stated[None],
    )


def _orientation_error(equal: Explained, moved: Explained) -> float | None:
    """Return how far positions were off [degrees], where the likelihood prefers that at 1 %."""
    if not prefers_orientations(equal, moved)[0]:
        return None
    return math.degrees(math.sqrt(moved.variances[0, 1]))


def judge_equality(c: Calibration) -> tuple[float, Array]:
    """Test by eq. (5) whether outputs have the noise that an uncertain or unknown fit takes.

    Returns
    -------
    p : float
    sizes : (M,) array
        Standard deviations that the residuals show.
    """
    n, m = c.residuals.shape
    if n * m > _MOST:
        return 1.0, np.full(m, np.nan)
    problem, optimum = information_at_solution(c)
    if float(problem.degrees.sum()) - problem.unknowns < _FEW:
        return 1.0, np.full(m, np.nan)
    P = optimum.projection()
    push = weigh(problem.precision, optimum.point.residuals)
    precision = problem.precision
    if precision.ndim == 3:
        precision = np.diagonal(precision, axis1=1, axis2=2)
    V = 1.0 / precision
    root = np.sqrt(V)
    P *= root[:, :, None, None] * root
    traces = np.einsum("nini->i", P)
    squares = np.einsum("ni,ni->i", root * push, root * push)
    if not squares.any():
        return 1.0, np.zeros(m)  # readings so coarse that nothing is left
    common = squares.sum() / traces.sum()
    U = 0.5 * (squares / common - traces)
    information = 0.5 * np.einsum("kilj,kilj->ij", P, P)
    solved = np.linalg.solve(information, U)
    statistic = U @ solved
    sizes = np.sqrt(np.mean(V, axis=0) * common * np.maximum(1.0 + solved, 0.05))
    return chi2_tail(float(statistic), m - 1.0), sizes


def _separable(c: Calibration) -> bool:
    """Tell whether orientation error shows beside excess variance: a triad, all rows counted."""
    return c.estimator.exact and c.robust_weight is None and _is_triad(c)


def _is_triad(c: Calibration) -> bool:
    """Tell whether three outputs along three axes, in gravity alone, sense a rotation."""
    three = sorted(c.model.axes) == list(COMPONENTS) and not c.readings.forced.any()
    if not three or isinstance(c.model, ExpressionModel):
        return False
    linear = c.model.linear_part(c.parameters, c.mean_environment)[:, 1:]
    return is_regular(linear) or int(np.linalg.matrix_rank(linear)) == len(COMPONENTS)

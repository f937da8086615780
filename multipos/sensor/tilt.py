"""Tilt: the angle of a case axis above the horizon, from the force on a sensor at rest.

`tilt_at_rest` returns the `Tilt` of forces, which `at_rest` finds from readings. `triad_tilt` with
`triad_tilt_u`, and `axis_tilt` with `axis_tilt_interval`, are its equations, `true_tilt` that of up
vectors. `force_uncertainty` is what parameters and one reading add to force, `reading_noise` the
noise of such a reading, `zeros_of_force` what zeros of soaks add; `magnitude_of` and
`beyond_vertical` say how large a force at rest is and may seem.

With s = +1 under the convention 'specific-force' and −1 under 'gravity', the axis i of a triad
and of a sensor with fewer axes stand above the horizon by

    theta_i = atan2(s f_i, h_i),    h_i = sqrt(f_j² + f_k²)         three axes,            (1)
    theta_i = asin(s f_i/g)                                         one or two axes,        (2)

eqs. (24) and (25) of docs/theory/linear-fit.md. A triad needs no g and is good all the way round.
The arcsine loses its slope at ±90°: there u/(g cos theta) would be infinite, and the truth is that
the interval f ± U maps to a finite one, so its longer side is the uncertainty,

    U(theta) = max(|asin((f + U)/g) − theta|, |theta − asin((f − U)/g)|),                   (3)

with the arguments clipped to ±1. Away from ±90° it is U/(g cos theta); at ±90° it is about
sqrt(2 U/g). Because the arcsine is monotonic, (3) covers the tilt where f ± U covers the force.
Where |f| exceeds g by more than U of that axis at the vertical no tilt explains the reading: the
angle is NaN.

The force itself is that of a sensor at rest: with two axes the third component follows from |f| = g
(`multipos.sensor.inverse`, eq. (3)) and is taken to point up unless it is known to point down. For
one new reading of noise s, C the covariance of the parameters,

    cov f = A [(df/dp) C (df/dp)' + J^+ diag(s²) J^+'] A',    A = (I − c f'/w)⁻¹.           (4)

A carries what the unseen component w of size sqrt(g² − |f|²) adds, c = J^+ dh/dw (A = I without
one). Near the vertical, where w falls below 2 |c f|, two solutions merge and neither can be
distinguished from the other; they differ by no more than 2 c |c f|, which is then taken instead of
A.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.numerics.arrays import Array, quadratic
from multipos.numerics.quantiles import coverage_by_tenths
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import invert_at_rest, sensitivities, unseen_leak
from multipos.sensor.temperature import has_zeros, zeros_of_soaks

_ROUNDING = 1e-12  # [g], by which a noise-free |f| may exceed g


class Tilt(NamedTuple):
    """Tilt (n, K) of the axes that the sensor has, its u and U [rad]; NaN beyond the vertical."""

    tilt: Array
    u: Array
    U: Array


def at_rest(
    calibration: Calibration, raw: Array, environment: Mapping[str, Array], up: Array | None = None
) -> Array:
    """Return the force (n, 3) [g] on a sensor at rest.

    Parameters
    ----------
    calibration : Calibration
    raw : (n, M) array
    environment : mapping of str to (n,) array
    up : (n, 3) array, optional
        Tells which way an unseen component points; it points up where not given.
    """
    model, others = calibration.model, list(calibration.model.unseen_axes)
    sign = np.full(len(raw), calibration.sign)
    if up is not None and len(others) == 1:
        sign *= np.where(up[:, others[0]] < 0.0, -1.0, 1.0)
    return invert_at_rest(
        model,
        calibration.parameters,
        raw,
        environment,
        magnitude=magnitude_of(calibration),
        sign=sign,
    )


class ZerosOfForce(NamedTuple):
    """What zeros that differ from soak to soak do to force, (n, K, K) each [g²].

    `covariance` is added to that of force and `expanded` is the square of its part of U; what
    `force_uncertainty` has of it already is `contained`.
    """

    covariance: Array
    expanded: Array
    contained: Array


def zeros_of_force(
    calibration: Calibration,
    rest: Array,
    environment: Mapping[str, Array],
    run: Readings | None,
    estimated: Array,
) -> ZerosOfForce:
    """Return what zeros of soaks do to the force (n, 3) [g] of a run, None of single readings.

    `estimated` is as of `zeros_of_soaks`.
    """
    c = calibration
    if not has_zeros(c):
        size = len(c.model.sensed_axes)
        return ZerosOfForce(*np.zeros((3, len(rest), size, size)))
    held = np.where(np.isfinite(rest), rest, 0.0)
    inverse, X = sensitivities(c.model, c.parameters, held, environment)
    zeros = zeros_of_soaks(c, X, run, estimated)
    variance = np.sum(zeros.columns**2, axis=2)
    factors = coverage_by_tenths(c.confidence, zeros.dof) ** 2
    each = (variance, factors * variance, zeros.contained)
    return ZerosOfForce(*((inverse * v[:, None]) @ inverse.transpose(0, 2, 1) for v in each))


def tilt_at_rest(
    calibration: Calibration,
    rest: Array,
    environment: Mapping[str, Array],
    noise: Array | None = None,
    unseen: Array | None = None,
    zeros: ZerosOfForce | None = None,
) -> Tilt:
    """Return the tilt that a force (n, 3) at rest tells, with its uncertainty.

    Parameters
    ----------
    calibration : Calibration
    rest : (n, 3) array [g]
        From `at_rest`.
    environment : mapping of str to (n,) array
    noise : (n, M) or (M,) array, optional
        Standard uncertainty of the readings; `reading_noise` where not given.
    unseen : (n, K, K) array, optional [g²]
        As in `force_uncertainty`.
    zeros : ZerosOfForce, optional
        Of soaks.
    """
    axes = list(calibration.model.sensed_axes)
    noise = reading_noise(calibration) if noise is None else noise
    own, dof = force_uncertainty(calibration, rest, environment, noise, unseen)
    k = coverage_by_tenths(calibration.confidence, dof)
    if zeros is None:
        zeros = ZerosOfForce(*np.zeros((3, *own.shape)))
    own = own - zeros.contained
    sign, magnitude, force = calibration.sign, magnitude_of(calibration), rest[:, axes]
    if len(axes) == 3:
        u = triad_tilt_u(force, own)
        U = k * u
        if zeros.covariance.any():
            U = np.hypot(U, triad_tilt_u(force, zeros.expanded))
            u = triad_tilt_u(force, own + zeros.covariance)
        return Tilt(triad_tilt(force, sign), u, U)
    u2, own2, expanded2 = (
        np.einsum("nkk->nk", each) for each in (own + zeros.covariance, own, zeros.expanded)
    )
    return Tilt(
        axis_tilt(force, magnitude, sign, beyond_vertical(calibration)),
        axis_tilt_interval(force, magnitude, np.sqrt(u2)),
        axis_tilt_interval(force, magnitude, np.sqrt(k**2 * own2 + expanded2)),
    )


def beyond_vertical(calibration: Calibration) -> Array:
    """Return by how much |f| may exceed g (K,) [g] along each axis, and still be the vertical.

    One number an axis: U of the force with that axis up or down, whichever is larger, with the
    noise of a reading of the calibration, in the mean of its environment.
    """
    axes = list(calibration.model.sensed_axes)
    upright = magnitude_of(calibration) * np.concatenate([np.eye(3)[axes], -np.eye(3)[axes]])
    environment = {
        name: np.full(len(upright), value) for name, value in calibration.mean_environment.items()
    }
    covariance, dof = force_uncertainty(
        calibration, upright, environment, reading_noise(calibration)
    )
    k = coverage_by_tenths(calibration.confidence, dof)
    U = (k * np.sqrt(np.einsum("nkk->nk", covariance))).reshape(2, len(axes), len(axes))
    largest: Array = U.max(axis=0)[range(len(axes)), range(len(axes))]
    return np.nan_to_num(largest) + _ROUNDING


def reading_noise(calibration: Calibration) -> Array:
    """Return the standard uncertainty (M,) of one reading, a mean over positions.

    NaN where nothing is left to estimate it from. Where the outputs were pooled it is one number,
    to which their common degrees of freedom belong.
    """
    c = calibration
    square = np.mean(c.sd_of_readings**2, axis=0)
    own = np.array([len(c.readings) - len(terms) for terms in c.model.terms])
    if c.estimator.exact and np.isfinite(c.dof).all() and (c.dof > own).all() and own.all():
        square = np.full(len(square), float(own @ square) / float(own.sum()))
    return np.asarray(np.sqrt(square))


def force_uncertainty(
    calibration: Calibration,
    rest: Array,
    environment: Mapping[str, Array],
    noise: Array,
    unseen: Array | None = None,
) -> tuple[Array, Array]:
    """Return the covariance (n, K, K) [g²] of force from new readings, eq. (4), and its dof (n, K).

    `unseen` (n, K, K) is what terms that the positions did not show add. The degrees of freedom
    are Welch and Satterthwaite's over the outputs. Two components that one axis leaves unseen count
    as what they are: anything on a circle.
    """
    model, parameters = calibration.model, calibration.parameters
    held = np.where(np.isfinite(rest), rest, 0.0)
    inverse, by_parameter = sensitivities(model, parameters, held, environment)
    from_parameters: Array = inverse @ by_parameter
    n, k, m = inverse.shape
    spread = np.broadcast_to(noise, (n, m)) ** 2
    flat = from_parameters.reshape(-1, from_parameters.shape[2])
    moved = (flat @ calibration.covariance).reshape(from_parameters.shape)
    result: Array = moved @ from_parameters.transpose(0, 2, 1)
    result += (inverse * spread[:, None, :]) @ inverse.transpose(0, 2, 1)
    if unseen is not None:
        result += unseen
    total = np.einsum("nkk->nk", result)
    size = np.where(total > 0.0, total, 1.0)  # squares of shares of it do not overflow
    effective = np.zeros((n, k))
    for output, part in enumerate(model.slices):
        own, block = from_parameters[:, :, part], calibration.covariance[part, part]
        share = quadratic(own, block)
        share += inverse[:, :, output] ** 2 * spread[:, [output]]
        effective += (share / size) ** 2 / (calibration.dof[output] or math.nan)
    shared = model.output_of == len(model.outputs)  # what several outputs tell together
    if shared.any():
        own, block = from_parameters[:, :, shared], calibration.covariance[np.ix_(shared, shared)]
        effective += (quadratic(own, block) / size) ** 2 / (calibration.dof.sum() or math.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = np.where(effective == 0.0, np.inf, (total / size) ** 2 / effective)
    if k == 1:
        result[:, 0, 0] += _unseen_circle(calibration, rest)
    elif k == 2:
        result = _with_unseen(calibration, held, environment, result)
    result[~np.isfinite(rest).all(axis=1)] = np.nan
    return result, dof


def _with_unseen(
    calibration: Calibration, rest: Array, environment: Mapping[str, Array], covariance: Array
) -> Array:
    """Return the covariance (n, 2, 2) [g²] with what the unseen component adds, A of eq. (4)."""
    model = calibration.model
    leak = unseen_leak(model, calibration.parameters, rest, environment)
    seen, unseen = rest[:, list(model.sensed_axes)], rest[:, model.unseen_axes[0]]
    lever = np.abs(np.einsum("nk,nk->n", leak, seen))
    merging = np.abs(unseen) <= 2.0 * lever
    turn = np.einsum("ni,nj->nij", leak, seen) / np.where(merging, 1.0, unseen)[:, None, None]
    gain = np.linalg.inv(np.eye(2) - np.where(merging[:, None, None], 0.0, turn))
    apart = 2.0 * leak * (lever * merging)[:, None]
    result: Array = gain @ covariance @ gain.transpose(0, 2, 1)
    result += np.einsum("ni,nj->nij", apart, apart)
    return result


def _unseen_circle(calibration: Calibration, rest: Array) -> Array:
    """Return the variance (n,) [g²] from cross terms on two components of unknown direction."""
    linear = calibration.model.linear_part(calibration.parameters, calibration.mean_environment)
    (own,) = calibration.model.sensed_axes
    others = list(calibration.model.unseen_axes)
    weight = np.mean((linear[:, [1 + axis for axis in others]] / linear[:, [1 + own]]) ** 2, axis=0)
    level = np.maximum(magnitude_of(calibration) ** 2 - rest[:, own] ** 2, 0.0)
    return np.asarray(weight.sum() / 2.0 * level)


def magnitude_of(calibration: Calibration) -> float:
    """Return the size of the reference [g]: one, or the stated gravity over standard gravity."""
    return calibration.field.magnitude


def true_tilt(up: Array) -> Array:
    """Return the angle of each case axis above the horizon (n, 3) [rad], from up vectors (n, 3)."""
    across = np.column_stack([np.hypot(up[:, j], up[:, k]) for j, k in ((1, 2), (0, 2), (0, 1))])
    return np.asarray(np.arctan2(up, across))


def triad_tilt(force: Array, sign: float) -> Array:
    """Return eq. (1) for force (n, 3) [g], in radians."""
    return true_tilt(sign * force)


def triad_tilt_u(force: Array, covariance: Array) -> Array:
    """Return the standard uncertainty (n, 3) [rad] of eq. (1), to first order.

    Parameters
    ----------
    force : (n, 3) array [g]
    covariance : (n, 3, 3) array [g²]
    """
    result = np.empty(force.shape)
    for i in range(3):
        others = [axis for axis in range(3) if axis != i]
        square = np.einsum("nk,nk->n", force, force)
        level = np.hypot(force[:, others[0]], force[:, others[1]])
        across = covariance[:, others][:, :, others]
        gradient = np.empty((len(force), 3))
        gradient[:, i] = level
        # Nearly upright, the direction of the level part is noise: its worst one is taken.
        upright = level <= np.sqrt(np.trace(across, axis1=1, axis2=2))
        away = force[:, others] / np.where(level > 0.0, level, 1.0)[:, None]
        if upright.any():
            steep = across[upright]
            away[upright] = np.linalg.eigh(np.where(np.isfinite(steep), steep, 0.0))[1][:, :, -1]
        gradient[:, others] = -force[:, [i]] * away
        gradient /= np.where(square > 0.0, square, np.nan)[:, None]  # of no force there is no tilt
        variance = np.einsum("nij,ni,nj->n", covariance, gradient, gradient)
        result[:, i] = np.sqrt(np.maximum(variance, 0.0))
    return result


def axis_tilt(force: Array, magnitude: float, sign: float, U: ArrayLike) -> Array:
    """Return eq. (2) for force of any shape [g], in radians; NaN beyond g and U."""
    ratio = sign * force / magnitude
    allowed = np.asarray(U, dtype=np.float64) / magnitude
    return np.where(np.abs(ratio) <= 1.0 + allowed, _arcsine(ratio), np.nan)


def axis_tilt_interval(force: Array, magnitude: float, U: Array) -> Array:
    """Return eq. (3) in radians, for force and its U (or u) of the same shape [g]."""
    centre = _arcsine(force / magnitude)
    above = _arcsine((force + U) / magnitude) - centre
    below = centre - _arcsine((force - U) / magnitude)
    return np.asarray(np.maximum(above, below))


def _arcsine(ratio: ArrayLike) -> Array:
    return np.asarray(np.arcsin(np.clip(ratio, -1.0, 1.0)))

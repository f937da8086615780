"""The errors of a run at known positions, and their uncertainty.

At each position and axis the error is what is said less what is known, of the force [g] or of the
tilt [degrees]: before by the nominal conversion (raw − bias)/scale, after by the calibration,

    e = f − f_ref,    u² = u²(f) + u²(f_ref),    U = k u,                                   (1)

with u(f) of eq. (4) of `multipos.sensor.tilt`, the noise of the run's own readings in it, and
u(f_ref) from ``orientation_sd_deg`` and ``reference_u_x`` … where it states them. Where readings
state their u, the scatter from rest to rest that the calibration found beyond what its own readings
state is in the noise as well. The positions of the run are known, so a component that the sensor
does not have is taken on its known side.

Linearity is the largest departure from the least-squares line against the reference, in percent of
that line's span: from −1 to +1 g for force, over the angles of the run for tilt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.positions.readings import Readings
from multipos.positions.stated_noise import spread_reading_sd
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import invert, sensed_axes
from multipos.sensor.nominal import Nominal, nominal_force
from multipos.sensor.tilt import (
    at_rest,
    coverage_by_tenths,
    force_uncertainty,
    magnitude_of,
    reading_noise,
    tilt_at_rest,
    triad_tilt,
    true_tilt,
)
from multipos.uncertainty.unseen import unseen_covariance

# Reference, error before and after compensation, u and U, (n, K) each.
Errors = tuple[Array, Array, Array, Array, Array]


def run_noise(
    calibration: Calibration, data: Readings, reading_sd: ArrayLike | None
) -> tuple[Array, Array]:
    """Return the standard uncertainty of the run's readings (n, M), and its estimated part."""
    shape = data.values.shape
    nothing = np.zeros(shape)
    if reading_sd is not None:
        return spread_reading_sd(reading_sd, shape), nothing
    if data.u is None:
        noise = np.broadcast_to(reading_noise(calibration), shape)
        return noise, np.where(np.isinf(calibration.dof), 0.0, noise)
    found = calibration.variance_components
    if found is None or found.rest_to_rest is None:
        return data.u, nothing
    scatter = np.array([found.rest_to_rest[output].value for output in calibration.outputs])
    return np.hypot(data.u, scatter), np.broadcast_to(scatter, shape)


def known_force(calibration: Calibration, data: Readings) -> Array:
    """Return what the run is known to stand in (n, 3) [g], in the calibration's convention."""
    assert data.up is not None
    known = calibration.sign * magnitude_of(calibration) * data.up
    if data.force is None:
        return known
    return np.where(data.forced[:, None], calibration.sign * data.force, known)


def force_errors(
    calibration: Calibration, data: Readings, known: Array, nominal: Nominal, noise: Array
) -> Errors:
    """Return the errors of force [g] against what the run is known to stand in (n, 3)."""
    axes = list(sensed_axes(calibration.model))
    rest = at_rest(calibration, data.values, data.environment, data.up)
    if data.force is not None:
        rest = np.where(data.forced[:, None], _explained(calibration, data, known), rest)
    reference = known[:, axes]
    unseen = unseen_covariance(calibration, rest[:, axes], data.environment)
    covariance, dof = force_uncertainty(calibration, rest, data.environment, noise, unseen)
    square = np.einsum("ni,ni->n", known, known)[:, None]
    across = np.sqrt(np.maximum(square - reference**2, 0.0))
    own = np.sqrt(np.einsum("nkk->nk", covariance))
    u = np.hypot(own, across * _placement(data))
    if data.reference_u is not None:
        u = np.hypot(u, data.reference_u[:, axes])
    before = nominal_force(calibration.model, data.values, nominal) - reference
    return reference, before, rest[:, axes] - reference, u, _expanded(calibration, own, u, dof) * u


def _explained(calibration: Calibration, data: Readings, known: Array) -> Array:
    """Return the force (n, 3) [g] that explains the readings, what no output senses as known."""
    force = known.copy()
    force[:, list(sensed_axes(calibration.model))] = invert(
        calibration.model, calibration.parameters, data.values, data.environment, unseen=known
    )
    return force


def require_known(calibration: Calibration, data: Readings, tilt: bool) -> None:
    """Refuse known forces where tilt is asked for, or beside a gravity of unknown size."""
    forced = data.forced
    if tilt and forced.any():
        raise MultiposError(
            f"{data.source or 'the run'}: position '{data.labels[int(np.argmax(forced))]}' has a "
            "known force and is not at rest, which has no tilt; compare force, or leave it out."
        )
    both = np.concatenate([forced, calibration.readings.forced])
    if calibration.gravity is None and both.any() and not both.all():
        raise MultiposError(
            f"{data.source or 'the run'}: known forces are in standard g, and what that is in "
            "local gravity the calibration does not know; fit it with --gravity or --latitude."
        )


def tilt_errors(calibration: Calibration, data: Readings, nominal: Nominal, noise: Array) -> Errors:
    """Return the errors of tilt [degrees] against the positions of the run."""
    assert data.up is not None
    axes = list(sensed_axes(calibration.model))
    reference = true_tilt(data.up)[:, axes]
    rest = at_rest(calibration, data.values, data.environment, data.up)
    unseen = unseen_covariance(calibration, rest[:, axes], data.environment)
    found = tilt_at_rest(calibration, rest, data.environment, noise, unseen)
    placed = _placement(data)
    force = nominal_force(calibration.model, data.values, nominal)
    if len(axes) == 3:
        before = triad_tilt(force, calibration.sign)
    else:
        before = np.arcsin(np.clip(calibration.sign * force / magnitude_of(calibration), -1.0, 1.0))
    k = coverage_by_tenths(calibration.confidence, np.full(found.u.shape, np.inf))
    U = np.hypot(found.U, k * placed)
    u = np.hypot(found.u, placed)
    arrays = (reference, before - reference, found.tilt - reference, u, U)
    degrees = [np.degrees(array) for array in arrays]
    return degrees[0], degrees[1], degrees[2], degrees[3], degrees[4]


def _placement(data: Readings) -> Array:
    """Return how well each position of the run is known (n, 1) [rad]; exact where not stated."""
    if data.orientation_sd is None:
        return np.zeros((len(data), 1))
    sd = data.orientation_sd
    return np.where(np.isfinite(sd), sd, 0.0)[:, None]


def _expanded(calibration: Calibration, own: Array, u: Array, dof: Array) -> Array:
    """Return k of a sum of which only the part `own` has finite degrees of freedom."""
    with np.errstate(divide="ignore", invalid="ignore"):
        effective = np.where(own > 0.0, dof * (u / own) ** 4, np.inf)
    return coverage_by_tenths(calibration.confidence, effective)


def line_departure(reference: Array, error: Array, counted: NDArray[np.bool_], tilt: bool) -> Array:
    """Return the largest departure from the least-squares line (K,), in percent of its span."""
    result = np.full(reference.shape[1], np.nan)
    for column, (known, wrong, used) in enumerate(
        zip(reference.T, error.T, counted.T, strict=True)
    ):
        rows = used & np.isfinite(wrong)
        x, y = known[rows], (known + wrong)[rows]
        if not len(x) or np.ptp(x) < 1e-9:
            continue
        centred = x - x.mean()
        slope = float(centred @ y) / float(centred @ centred)
        if abs(slope) < 1e-9:  # an output that does not answer has no line to depart from
            continue
        span = abs(slope) * (float(np.ptp(x)) if tilt else 2.0)
        left = y - y.mean() - slope * centred
        result[column] = 100.0 * float(np.abs(left).max()) / span
    return result

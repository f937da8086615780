"""Check: the errors of an independent run at known positions, before and after compensation.

- `check` returns errors, verdicts and findings; of a regression those of
  `multipos.verification.regression_checks`.
- `average_run` returns the means of a run that is a raw log.
- `run_noise`, `known_force` and `require_known` say what the run is held to.
- `force_errors` and `tilt_errors` are its errors, `line_departure` their linearity.

Whether the run as a whole agrees with the calibration is for `multipos.verification.agreement`.
Where a run is so far off that it may have been taken wrongly, it is fitted by itself, and what is
wrong of it, such as rows interchanged or in another unit, is a finding of the check.

At each position and axis the error is what is said less what is known, of the force [g] or of the
tilt [degrees]: before by the nominal conversion (raw − bias)/scale, after by the calibration,

    e = f − f_ref,    u² = u²(f) + u²(f_ref),    U = k u,                                   (1)

with u(f) of eq. (4) of `multipos.sensor.tilt`, the noise of the run's own readings in it, and
u(f_ref) from ``orientation_sd_deg`` and ``reference_u_x`` … where it states them. Zeros that differ
from soak to soak (`multipos.sensor.temperature`), those of calibration and run, are in u, and in U
with their own k. Where readings state their u, the scatter from rest to rest that the calibration
found beyond what its own readings state is in the noise as well. The positions of the run are
known, so a component that the sensor does not have is taken on its known side.

Linearity is the largest departure from the least-squares line against the reference, in percent of
that line's span: from −1 to +1 g for force, over the angles of the run for tilt.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import CalibrationWarning, MultiposError, UsageError
from multipos.files.handed import take_in
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Source
from multipos.files.written_units import unit_of
from multipos.finding import Finding, Findings, about, errors_of, in_order
from multipos.fitting.fit_readings import fit
from multipos.logs.averages import Averages
from multipos.logs.averaging import average
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.quantiles import coverage_by_tenths
from multipos.positions.headers import require_units
from multipos.positions.open_rolls import refuse_open_rolls
from multipos.positions.orientations import are_samples, orient
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings, require_range, spread_reading_sd
from multipos.positions.scheme import Scheme, read_scheme
from multipos.regression.regression import Regression, Regressions
from multipos.results import require
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import invert, require_response
from multipos.sensor.nominal import Nominal, nominal_force, read_nominal
from multipos.sensor.tilt import (
    at_rest,
    force_uncertainty,
    magnitude_of,
    reading_noise,
    tilt_at_rest,
    triad_tilt,
    true_tilt,
    zeros_of_force,
)
from multipos.uncertainty.unseen_terms import unseen_covariance
from multipos.verification.agreement import judge_run, stated_orientation_sd
from multipos.verification.regression_checks import check_regression
from multipos.verification.verdicts import Check, family_confidence, require_limit

# Reference, error before and after compensation, u and U, (n, K) each.
Errors = tuple[Array, ...]


class RunNoise(NamedTuple):
    """Standard uncertainty of a run's readings (n, M), and the part estimated with the fit."""

    whole: Array
    estimated: Array


def run_noise(calibration: Calibration, data: Readings, reading_sd: ArrayLike | None) -> RunNoise:
    """Return the noise of a run's readings."""
    shape = data.values.shape
    nothing = np.zeros(shape)
    if reading_sd is not None:
        return RunNoise(spread_reading_sd(reading_sd, shape), nothing)
    if data.u is None:
        noise = np.broadcast_to(reading_noise(calibration), shape)
        return RunNoise(noise, np.where(np.isinf(calibration.dof), 0.0, noise))
    found = calibration.variance_components
    if found is None or found.rest_to_rest is None:
        return RunNoise(data.u, nothing)
    scatter = np.array([found.rest_to_rest[output].value for output in calibration.outputs])
    return RunNoise(np.hypot(data.u, scatter), np.broadcast_to(scatter, shape))


def known_force(calibration: Calibration, data: Readings) -> Array:
    """Return what the run is known to stand in (n, 3) [g], in the calibration's convention."""
    assert data.up is not None
    known = calibration.sign * magnitude_of(calibration) * data.up
    if data.force is None:
        return known
    return np.where(data.forced[:, None], calibration.sign * data.force, known)


def force_errors(
    calibration: Calibration, data: Readings, known: Array, nominal: Nominal, noise: RunNoise
) -> Errors:
    """Return the errors of force [g] against what the run is known to stand in (n, 3)."""
    axes = list(calibration.model.sensed_axes)
    rest = at_rest(calibration, data.values, data.environment, data.up)
    if data.force is not None:
        rest = np.where(data.forced[:, None], _explained(calibration, data, known), rest)
    reference = known[:, axes]
    unseen = unseen_covariance(calibration, rest[:, axes], data.environment)
    covariance, dof = force_uncertainty(calibration, rest, data.environment, noise.whole, unseen)
    square = np.einsum("ni,ni->n", known, known)[:, None]
    across = np.sqrt(np.maximum(square - reference**2, 0.0))
    zeros = zeros_of_force(calibration, rest, data.environment, data, noise.estimated)
    left = np.einsum("nkk->nk", covariance - zeros.contained)
    own = np.sqrt(np.maximum(left, 0.0))  # of rounding
    u = np.hypot(own, across * stated_orientation_sd(data)[:, None])
    if data.reference_u is not None:
        u = np.hypot(u, data.reference_u[:, axes])
    of_zeros, U_zeros = (
        np.sqrt(np.einsum("nkk->nk", each)) for each in (zeros.covariance, zeros.expanded)
    )
    U = np.hypot(_expanded(calibration, own, u, dof) * u, U_zeros)
    before = nominal_force(calibration.model, data.values, nominal) - reference
    return reference, before, rest[:, axes] - reference, np.hypot(u, of_zeros), U


def _explained(calibration: Calibration, data: Readings, known: Array) -> Array:
    """Return the force (n, 3) [g] that explains the readings, what no output senses as known."""
    force = known.copy()
    force[:, list(calibration.model.sensed_axes)] = invert(
        calibration.model, calibration.parameters, data.values, data.environment, unseen=known
    )
    return force


def require_known(calibration: Calibration, data: Readings, tilt: bool) -> None:
    """Refuse known forces where tilt is asked for, or beside a gravity of unknown size."""
    forced = data.forced
    if tilt and calibration.field.angle != "tilt":
        raise UsageError("--tilt is of accelerometers; a magnetic field is not level.")
    if tilt and forced.any():
        raise MultiposError(
            f"{data.source or 'the run'}: position '{data.labels[int(np.argmax(forced))]}' has a "
            "known force and is not at rest, which has no tilt; compare force, or leave it out."
        )
    both = np.concatenate([forced, calibration.readings.forced])
    if calibration.gravity is None and both.any() and not both.all():
        raise MultiposError(
            f"{data.source or 'the run'}: known forces are in standard g, and the calibration does "
            "not state local gravity; fit it with --gravity or --latitude."
        )


def tilt_errors(
    calibration: Calibration, data: Readings, nominal: Nominal, noise: RunNoise
) -> Errors:
    """Return the errors of tilt [degrees] against the positions of the run."""
    assert data.up is not None
    axes = list(calibration.model.sensed_axes)
    reference = true_tilt(data.up)[:, axes]
    rest = at_rest(calibration, data.values, data.environment, data.up)
    unseen = unseen_covariance(calibration, rest[:, axes], data.environment)
    zeros = zeros_of_force(calibration, rest, data.environment, data, noise.estimated)
    found = tilt_at_rest(calibration, rest, data.environment, noise.whole, unseen, zeros)
    of_orientation = stated_orientation_sd(data)[:, None]
    force = nominal_force(calibration.model, data.values, nominal)
    if len(axes) == 3:
        before = triad_tilt(force, calibration.sign)
    else:
        before = np.arcsin(np.clip(calibration.sign * force / magnitude_of(calibration), -1.0, 1.0))
    k = coverage_by_tenths(calibration.confidence, np.full(found.u.shape, np.inf))
    U = np.hypot(found.U, k * of_orientation)
    u = np.hypot(found.u, of_orientation)
    arrays = (reference, before - reference, found.tilt - reference, u, U)
    return tuple(np.degrees(array) for array in arrays)


def _expanded(calibration: Calibration, own: Array, u: Array, dof: Array) -> Array:
    """Return k of a sum of which only the part `own` has finite degrees of freedom."""
    with np.errstate(divide="ignore", invalid="ignore"):
        effective = np.where(own > 0.0, dof * (u / own) ** 4, np.inf)
    return coverage_by_tenths(calibration.confidence, effective)


def line_departure(reference: Array, error: Array, counted: Mask, reach: float | None) -> Array:
    """Return the largest departure from the least-squares line (K,), in percent of its span.

    The span is that of ± `reach`, where it is None of what was covered.
    """
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
        span = abs(slope) * (float(np.ptp(x)) if reach is None else 2.0 * reach)
        left = y - y.mean() - slope * centred
        result[column] = 100.0 * float(np.abs(left).max()) / span
    return result


RUN = "the run"  # before the findings about a run that is fitted by itself
_FAR_OFF = 0.25  # [g], which no sensor is off after its calibration


def check(
    calibration: Calibration | Regression | Regressions,
    readings: Source | Readings,
    *,
    scheme: Source | Scheme | None = None,
    outputs: Names | None = None,
    tilt: bool = False,
    limit_deg: float | None = None,
    limit_g: float | None = None,
    within_deg: float | None = None,
    nominal: Sequence[float] | None = None,
    reading_sd: ArrayLike | None = None,
    range: Sequence[float] | None = None,
) -> Check:
    """Return the errors of a run at known positions, before and after compensation.

    Parameters
    ----------
    calibration : Calibration or Regression
        Of the options a regression takes `limit_g` only (`check_regression`).
    readings : Readings, path, mapping of columns, or data frame
        An independent run; its ``u_…`` are the uncertainty of its readings. For a regression a
        table with its response and its variables.
        A raw log is averaged first, and its rests matched to the scheme.
    scheme : Scheme, name, path, mapping of columns, or data frame, optional
        The positions; otherwise the readings' own columns say them.
    outputs : sequence of str, or comma-separated str, optional
        The columns of the run that are the calibration's outputs, in their order.
    tilt : bool
        Compare tilt in degrees and not force in g; a limit in degrees does so by itself.
    limit_deg, limit_g : float, optional
        Largest error allowed.
    within_deg : float, optional
        Count only axes that stand within so many degrees of the horizon.
    nominal : (bias, scale), optional
        The conversion (raw − bias)/scale used before the calibration: by default that which the
        calibration was made with, else (0, 1).
    reading_sd : float or M floats, optional
        Standard uncertainty of a reading of the run; by default that of the calibration's.
    range : (low, high), optional
        Readings outside it are an error.

    Returns
    -------
    Check

    Raises
    ------
    MultiposError
        The data are at fault: an output missing, no orientation, a reading out of range.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> run = mp.simulate(cal, "faces-6", reading_sd=2e-4, seed=1)
    >>> found = mp.check(cal, run, limit_g=0.02)
    >>> sorted(set(found.verdicts.ravel().tolist()))
    ['indeterminate', 'pass']
    """
    require(calibration, Calibration, Regression, Regressions)
    if isinstance(calibration, Regression | Regressions):
        _refuse_options(
            {
                "--scheme": scheme,
                "--outputs": outputs,
                "--tilt": tilt or None,
                "--limit-deg": limit_deg,
                "--within-deg": within_deg,
                "--reading-sd": reading_sd,
                "--range": range,
                "--nominal": nominal,
            }
        )
        return check_regression(calibration, readings, limit_g=limit_g)
    tilt = tilt or limit_deg is not None
    _check_options(tilt, limit_deg, limit_g, within_deg)
    before = calibration.nominal or Nominal(0.0, 1.0)
    if nominal is not None:
        before = read_nominal(nominal)
    require_response(calibration.model, calibration.parameters, calibration.mean_environment)
    data = _read_run(calibration, readings, scheme, outputs)
    if range is not None:
        require_range(data, range)
    noise = run_noise(calibration, data, reading_sd)
    require_known(calibration, data, tilt)
    known = known_force(calibration, data)
    limit = limit_deg if tilt else limit_g
    found = _check_run(calibration, data, known, noise, tilt, limit, within_deg, before)
    agreement, findings = judge_run(calibration, data, known, *noise)
    of_rows = _of_the_run(calibration, data, known)
    if errors_of(of_rows):  # which are the cause, and no change of the sensor is
        findings = tuple(map(_without_cause, findings))
    findings = (*of_rows, *findings)
    every = in_order((*findings, *found.findings))
    return replace(found, consistency=agreement, findings=every)


def _without_cause(found: Finding) -> Finding:
    if found.code != "run-disagrees":
        return found
    return replace(found, text=found.text.partition("; probable cause")[0], action="")


def average_run(
    calibration: Calibration,
    run: Source | Readings,
    scheme: Source | Scheme | None = None,
    outputs: Names | None = None,
) -> Averages | None:
    """Return the means of a run that is a raw log; None of a table of means.

    Parameters
    ----------
    calibration : Calibration
    run, scheme, outputs
        As of `check`.
    """
    if isinstance(run, Readings):
        return None
    names = _columns_of_run(calibration, outputs)
    averaged = partial(
        average, run, outputs=names, scheme=scheme, convention=calibration.convention
    )
    try:
        data = read_readings(run, outputs=names, environment=calibration.model.environment)
    except MultiposError:  # a log without header, or of another kind than tables
        with suppress(MultiposError):
            return averaged()
        return None
    stated = data.up is not None or data.force is not None
    return None if stated or not are_samples(data) or _fits(scheme, data) else averaged()


def _fits(scheme: Source | Scheme | None, data: Readings) -> bool:
    """Tell whether a scheme has as many positions as there are rows, which are then no samples."""
    return scheme is not None and len(read_scheme(scheme)) == len(data)


def _columns_of_run(calibration: Calibration, outputs: Names | None) -> tuple[str, ...]:
    """Return the columns of a run that are the outputs of a calibration."""
    names = calibration.outputs if outputs is None else split_names(outputs, "--outputs")
    if len(names) != len(calibration.outputs):
        raise UsageError(
            f"--outputs names {len(names)} columns, and the calibration has the outputs "
            f"{', '.join(calibration.outputs)}; name one for each, in their order."
        )
    return names


def _read_run(
    calibration: Calibration,
    readings: Source | Readings,
    scheme: Source | Scheme | None,
    outputs: Names | None,
) -> Readings:
    """Return a run with its positions, held to what the calibration needs."""
    if not isinstance(readings, Readings):  # an open file is read once
        readings = take_in(readings, "run", calibration.outputs)
    means = average_run(calibration, readings, scheme, outputs)
    if means is None:
        names = _columns_of_run(calibration, outputs)
        data = read_readings(readings, outputs=names, environment=calibration.model.environment)
    else:
        data = replace(means.readings, up=None, findings=means.findings)
    called = {name.casefold(): name for name in calibration.model.environment}
    seen = {called.get(name.casefold(), name): c for name, c in data.environment.items()}
    data = replace(data, outputs=calibration.outputs, environment=seen)
    require_units(
        data.source or "the run",
        dict.fromkeys(data.outputs, data.unit) if unit_of(data.unit) else {},
        data.outputs,
        (),
        calibration.model.unit,
    )
    missing = [name for name in calibration.model.environment if name not in data.environment]
    if missing:
        raise MultiposError(
            f"{data.source or 'the run'}: no column '{missing[0]}', which the model of the "
            "calibration uses; add it to the run."
        )
    data = orient(data, scheme)
    refuse_open_rolls(data)
    return data


def _check_run(
    calibration: Calibration,
    data: Readings,
    known: Array,
    noise: RunNoise,
    tilt: bool,
    limit: float | None,
    within_deg: float | None,
    nominal: Nominal,
) -> Check:
    """Return errors and verdicts of a run that is known to stand in a force (n, 3) [g]."""
    assert data.up is not None

    def errors(of: Calibration) -> Errors:
        if tilt:
            return tilt_errors(of, data, nominal, noise)
        return force_errors(of, data, known, nominal, noise)

    axes = list(calibration.model.sensed_axes)
    reference, before, after, u, U = errors(calibration)
    level = np.nan_to_num(np.degrees(true_tilt(data.up)))[:, axes]
    # A hair's breadth more, so that 60 degrees from a cosine is within 60.
    counted = np.abs(level) <= (90.0 if within_deg is None else within_deg) + 1e-6
    if not counted.any():
        raise MultiposError(f"no position of the run is within {within_deg:g} degrees of level.")
    reach = None if tilt else calibration.field.full_scale
    U_family = None
    if limit is not None:
        sharper = replace(
            calibration, confidence=family_confidence(calibration.confidence, int(counted.sum()))
        )
        U_family = errors(sharper)[4]
    return Check(
        quantity="tilt" if tilt else "force",
        unit="deg" if tilt else calibration.field.printed,
        axes=tuple(COMPONENTS[i] for i in axes),
        positions=data.labels,
        reference=reference,
        before=before,
        after=after,
        u=u,
        U=U,
        U_family=U_family,
        limit=limit,
        counted=counted,
        linearity_percent={
            "before": line_departure(reference, before, counted, reach),
            "after": line_departure(reference, after, counted, reach),
        },
        bias=nominal.bias,
        scale=nominal.scale,
        confidence=calibration.confidence,
        source=data.source,
        sha256=data.sha256,
        findings=data.findings,
        calibration=calibration.created,
        against=None,
        consistency=None,
    )


def _refuse_options(given: Mapping[str, object]) -> None:
    """Refuse options that are given, and of which a regression knows nothing."""
    for name, value in given.items():
        if value is not None:
            raise UsageError(
                f"{name} goes with a calibration; a regression is checked row by "
                "row, against --limit-g."
            )


def _check_options(
    tilt: bool,
    limit_deg: float | None,
    limit_g: float | None,
    within_deg: float | None,
) -> None:
    if tilt and limit_g is not None:
        raise UsageError("--limit-g is a limit of force; give --limit-deg for tilt.")
    given = {"--limit-deg": limit_deg, "--limit-g": limit_g, "--within-deg": within_deg}
    for name, value in given.items():
        if value is not None:
            require_limit(name, value)


def _of_the_run(calibration: Calibration, data: Readings, known: Array) -> Findings:
    """Return what is wrong with a run that is far off, found by a fit of the run by itself."""
    c = calibration
    left = data.values - c.model.predict(c.parameters, known, data.environment)
    response = np.linalg.norm(c.sensitivity, axis=1)
    if c.model.gauge is not None or not (np.abs(left) > _FAR_OFF * response).any():
        return ()
    run = replace(data, u=None, dof=None, covariance=None, orientation_sd=None, findings=())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        try:
            found = fit(
                run,
                axes=c.facing or c.model.axes,
                inputs=c.model.inputs,
                convention=c.convention,
                exclude="none",  # else rows that are interchanged are set aside, and nothing said
                **c.field.stated(),
            )
        except MultiposError:  # too few positions to fit
            return ()
    return about(RUN, errors_of(found.findings))

"""Orientations known badly, or not at all: from readings to a solution of the one likelihood.

`solve_uncertain` states the problem of `multipos.likelihood`, starts it without a guess,
finds the reading noise where it is not given, and says what the result is worth:

- where nothing ties the readings to the directions of the world (every position unknown, or in a
  group of unknown rotation), the rotation of the case is a convention: a gauge fixes it, lower
  triangular or symmetric, with own-axis scale factors positive;
- a start comes from least squares at the listed directions, or from the ellipsoid on which
  readings at rest lie (`multipos.ellipsoid`), turned to the listed directions where some are;
- reading noise that is not given follows from the residuals: by F/nu where orientations are exact
  or unknown, with nu = sum m_k − (parameters and shared unknowns), m_k = M, less two where a
  position is unknown; by restricted maximum likelihood (`multipos.variances`) where
  orientation errors share the blame; under a robust loss by the median misfit.

A robust loss multiplies the covariance by Huber's factor, with psi(z) = z rho'(z²),

    K² [sum q w² / nu] / mean(psi')²,     K = 1 + (p/N) var(psi')/mean(psi')²,               (1)

which is the empirical spread of the estimating equations. With unknown directions the noise
pushes readings off the sphere, and scale factors come out larger by sigma²/(scale² g²).

References
----------
P. J. Huber, *Robust Statistics*, 1981, section 7.6; JCGM 102.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.calibration import Calibration, Status, labels
from multipos.diagnostics import find_outlying_positions
from multipos.errors import MultiposError
from multipos.identifiability import condition, formal_only
from multipos.inverse import parameter_jacobian
from multipos.known import DENIED, Solution, reading_noise
from multipos.likelihood import (
    Optimum,
    Problem,
    evaluate,
    linearise,
    maximise,
    start_state,
)
from multipos.losses import loss_slope, loss_weight
from multipos.model import Model
from multipos.quantiles import chi2_quantile
from multipos.readings import Readings, read_readings
from multipos.rotations import rotation_vector
from multipos.starts import reduced_information, search, too_few
from multipos.variances import Components, estimate_components, linearised

Array = NDArray[np.float64]

_ROUNDS = 30  # of noise and solution in turn
_SETTLED = 1e-6  # change of ln variance at which they agree
_RELATIVE_NOISE = 1e-3  # of the readings' spread: any value serves where only ratios matter
_NOTHING_LEFT = (
    "as many unknowns as equations: nothing is left to estimate the uncertainty from; "
    "give --reading-sd or more positions"
)
_FIRST_SPREAD = np.radians(0.1)
_STATED_BIAS = 0.1  # of u: a bias of the scale factors beyond it is stated
_BEYOND_DOUBT = 1e-6  # chance below which a robust fit sets a position aside
_ASIDE = 1e-12  # weight of such a position: nothing, but its residual is still reported
_MEDIAN_SETTLED = 1e-4  # change of ln variance far below what a median can tell
_MEDIAN_CHI2 = {1: 0.45493642, 2: 1.38629436, 3: 2.36597388, 4: 3.35669398}


@dataclass(frozen=True)
class Placement:
    """What is known of the positions.

    Attributes
    ----------
    reference : (n, 3) array [g]
        Listed ±g u; anything where `spread` is infinite.
    spread : (n,) array [rad]
        Standard deviation per axis; 0 exact, inf unknown.
    group : (n,) array of int
        Number of the group that shares an unknown rotation, −1 for none.
    attitude : (n, 3, 3) array or None
        Level to case, where `level_sd` is above 0.
    level_sd : float [rad]
    estimate_spread : bool
        `spread` is relative; its size is estimated.
    """

    reference: Array
    spread: Array
    group: NDArray[np.intp]
    attitude: Array | None = None
    level_sd: float = 0.0
    estimate_spread: bool = False

    @property
    def exact(self) -> bool:
        """Whether every position is known exactly, so that the fit is linear."""
        return not self.spread.any() and not self.groups and not self.level_sd

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1


def place(
    readings: Readings, signed: float, orientation_sd: float | str | None, level_sd_deg: float
) -> Placement:
    """Return what readings and options say of the positions.

    Parameters
    ----------
    readings : Readings
        With up vectors; NaN where a position's `orientation_sd` is NaN, unknown.
    signed : float [g]
        Magnitude of the reference, negative under the gravity convention.
    orientation_sd : float [degrees], 'auto' or None
        Instead of the readings' own.
    level_sd_deg : float [degrees]
    """
    n = len(readings)
    names = list(dict.fromkeys(label for label in readings.group or () if label))
    group = np.array([names.index(label) if label else -1 for label in readings.group or [""] * n])
    if isinstance(orientation_sd, float | int):
        spread = np.full(n, np.radians(orientation_sd))
    elif readings.orientation_sd is not None:
        # Within a group an empty cell means that only the group's rotation is unknown.
        own = readings.orientation_sd
        spread = np.where(np.isnan(own), np.where(group >= 0, 0.0, np.inf), own)
    else:
        spread = np.zeros(n)
    estimate = orientation_sd == "auto"
    if estimate and not (np.isfinite(spread) & (spread > 0.0)).any():
        spread = np.where(np.isinf(spread), spread, _FIRST_SPREAD)
    up = np.full((n, 3), np.nan) if readings.up is None else readings.up
    unknown = np.isinf(spread)
    missing = np.isnan(up).any(axis=1) & ~unknown
    if missing.any():
        raise MultiposError(
            f"position '{labels(readings)[int(np.argmax(missing))]}' has no orientation; give it, "
            "or leave its orientation_sd_deg empty for unknown."
        )
    reference = signed * np.where(unknown[:, None], [1.0, 0.0, 0.0], up) + 0.0
    return Placement(
        reference=reference,
        spread=spread,
        group=group,
        attitude=_attitude(readings, unknown) if level_sd_deg else None,
        level_sd=float(np.radians(level_sd_deg)),
        estimate_spread=estimate,
    )


def _attitude(readings: Readings, unknown: NDArray[np.bool_]) -> Array:
    rotation = np.full((len(readings), 3, 3), np.nan) if readings.rotation is None else (
        readings.rotation
    )  # fmt: skip
    open_heading = np.isnan(rotation).any(axis=(1, 2)) & ~unknown
    if open_heading.any():
        names = [labels(readings)[row] for row in np.flatnonzero(open_heading)[:6].tolist()]
        raise MultiposError(
            f"--level-sd needs the heading, and position {', '.join(map(repr, names))} has none; "
            "give direction, roll_deg pitch_deg yaw_deg, a quaternion, or roll_axis angle_deg."
        )
    return np.where(unknown[:, None, None], np.eye(3), rotation)


def solve_uncertain(
    model: Model,
    readings: Readings,
    placement: Placement,
    *,
    gauge: str = "lower",
    robust: str | None = None,
) -> Solution:
    """Fit all outputs together by the likelihood of eqs. (1)–(4) of `multipos.likelihood`.

    Raises
    ------
    RankError
        The positions cannot separate the parameters, which are named with a way out.
    ConvergenceError
        No start led to a minimum.
    MultiposError
        Too few positions, or readings that do not spread.
    """
    if placement.exact and len(model.outputs) > 1:
        return _solve_separately(model, readings, placement, robust)
    if not (np.isfinite(placement.spread) & (placement.group < 0)).any():
        model = model.with_gauge(gauge)
    if np.isinf(placement.spread).any():
        _require_triad(model)
    problem = _state_problem(model, readings, placement, robust)
    nu = float(problem.degrees.sum()) - len(model.keys) - problem.shared
    nu += 2.0 if placement.level_sd > 0.0 else 0.0
    if nu < 0:
        raise too_few(problem)
    optimum = search(problem)
    if robust is not None:
        problem, optimum, worth = _robust(problem, optimum, readings)
    elif reading_noise(readings) is not None:
        worth = _believe(optimum.point.objective, nu)
    elif (np.isfinite(placement.spread) & (placement.spread > 0.0)).any():
        problem, optimum, worth = _estimate_noise(problem, optimum, placement)
    elif nu > 0:
        worth = Worth(optimum.point.objective / nu, nu)
    else:
        worth = Worth(np.nan, 0.0, warnings=(_NOTHING_LEFT,))
    return _solution(problem, optimum, readings, nu, worth)


def _solve_separately(
    model: Model, readings: Readings, placement: Placement, robust: str | None
) -> Solution:
    """Fit each output alone where orientations are exact: nothing ties them together."""
    parts = [
        solve_uncertain(
            model.only(output), read_readings(readings, outputs=[output]), placement, robust=robust
        )
        for output in model.outputs
    ]
    covariance = np.zeros((len(model.keys), len(model.keys)))
    for part, where in zip(parts, model.slices, strict=True):
        covariance[where, where] = part.covariance

    def said(name: str) -> tuple[str, ...]:
        pairs = zip(model.outputs, parts, strict=True)
        return tuple(f"{output}: {text}" for output, part in pairs for text in getattr(part, name))

    return replace(
        parts[0],
        model=model,
        parameters=np.concatenate([part.parameters for part in parts]),
        covariance=covariance,
        parameter_dof=np.concatenate([part.parameter_dof for part in parts]),
        variance=np.concatenate([part.variance for part in parts]),
        dof=np.concatenate([part.dof for part in parts]),
        residuals=np.column_stack([part.residuals for part in parts]),
        residual_sd=np.concatenate([part.residual_sd for part in parts]),
        leverage=np.column_stack([part.leverage for part in parts]),
        condition=max(part.condition for part in parts),
        outliers=said("outliers"),
        warnings=said("warnings"),
        unidentifiable=said("unidentifiable"),
    )


@dataclass(frozen=True)
class Worth:
    """What the covariance of the likelihood is to be multiplied by, and how well that is known."""

    factor: float
    dof: float  # inf where the stated noise is believed
    parameter_dof: Array | None = None
    warnings: tuple[str, ...] = ()
    extra: tuple[tuple[str, Any], ...] = ()


def _state_problem(
    model: Model, readings: Readings, placement: Placement, robust: str | None
) -> Problem:
    values = readings.values
    n, m = values.shape
    noise = reading_noise(readings)
    if noise is None:
        size = np.sqrt(np.mean((values - values.mean(axis=0)) ** 2))
        if not size > 0.0:
            raise MultiposError("all readings are the same; turn the sensor between them.")
        precision = np.full((n, m), 1.0 / (_RELATIVE_NOISE * size) ** 2)
    elif noise.ndim == 1:
        precision = 1.0 / noise.reshape(n, m)
    else:
        precision = _block_precision(noise, n, m)
    return Problem(
        model=model, values=values, environment=readings.environment, precision=precision,
        reference=placement.reference, spread=placement.spread, group=placement.group,
        weight=np.ones(n),
        groups=placement.groups, attitude=placement.attitude,
        level_spread=placement.level_sd, robust=robust,
    )  # fmt: skip


def _block_precision(covariance: Array, n: int, m: int) -> Array:
    blocks = covariance.reshape(n, m, n, m)
    own = blocks[np.arange(n), :, np.arange(n), :]
    rest = covariance.copy().reshape(n, m, n, m)
    rest[np.arange(n), :, np.arange(n), :] = 0.0
    if rest.any():
        raise MultiposError(
            "readings correlated between positions cannot be combined with uncertain or unknown "
            "orientations; give a covariance within each position only."
        )
    return np.asarray(np.linalg.inv(own))


def _require_triad(model: Model) -> None:
    if sorted(model.axes) != ["x", "y", "z"] or set(model.inputs) != {"x", "y", "z"}:
        raise MultiposError(
            f"unknown orientations need three outputs, one along each axis; got "
            f"{', '.join(model.outputs)} along {', '.join(model.axes)}. Give the orientations."
        )


def _believe(chi2: float, nu: float) -> Worth:
    """Judge a stated noise by all residuals together, as INTERFACE does output by output."""
    if nu <= 0 or chi2 <= chi2_quantile(DENIED, nu):
        return Worth(1.0, np.inf)
    warning = (
        f"the residuals deny the stated noise (chi-square {chi2:.4g} on {nu:g} degrees of "
        f"freedom): the covariance is multiplied by {chi2 / nu:.4g}; larger placement error is "
        "the usual cause, see --orientation-sd"
    )
    return Worth(chi2 / nu, nu, warnings=(warning,))


def _estimate_noise(
    problem: Problem, optimum: Optimum, placement: Placement
) -> tuple[Problem, Optimum, Worth]:
    """Find noise and solution in turn, by restricted maximum likelihood."""
    sigma2 = 1.0 / float(problem.precision.mean())
    # Residuals at the listed positions bound the noise from above; a start within a few decades.
    found: Components | None = None
    spread = problem.spread
    for _ in range(_ROUNDS):
        linear = replace(linearised(problem, optimum), spread=spread)
        found = estimate_components(linear, sigma2, orientation=placement.estimate_spread)
        change = abs(np.log(found.sigma2 / sigma2)) + abs(np.log(found.factor))
        sigma2 = found.sigma2
        spread = np.where(np.isfinite(spread), spread * np.sqrt(found.factor), spread)
        problem = replace(
            problem, precision=np.full_like(problem.precision, 1.0 / sigma2), spread=spread
        )
        optimum = maximise(problem, optimum.state)
        if change < _SETTLED:
            break
    assert found is not None
    sd = np.sqrt(np.diag(found.log_covariance)) / 2.0  # relative u of a standard deviation
    said: dict[str, Any] = {
        "reading_sd": {"value": np.sqrt(sigma2), "u": np.sqrt(sigma2) * float(sd[0])}
    }
    words = [f"reading noise {np.sqrt(sigma2):.3g} (to {100.0 * sd[0]:.0f} %)"]
    if placement.estimate_spread:
        value = float(np.degrees(spread[np.isfinite(spread)].max()))
        said["orientation_sd_deg"] = {"value": value, "u": value * float(sd[1])}
        words.append(f"orientation error {value:.3g} degrees (to {100.0 * sd[1]:.0f} %)")
    warnings = [f"estimated by restricted maximum likelihood: {' and '.join(words)}"]
    if sd.max() > 1.0:
        warnings.append(
            "one of the estimated variances is hardly determined; state it, or add positions "
            "(18 or more serve)"
        )
    dof = 2.0 / float(found.log_covariance[0, 0])
    worth = Worth(
        1.0, dof, np.minimum(found.dof, 1e9), tuple(warnings), (("variance_components", said),)
    )
    return problem, optimum, worth


def _robust(
    problem: Problem, optimum: Optimum, readings: Readings
) -> tuple[Problem, Optimum, Worth]:
    """Find the noise where it is not stated, and set aside what is beyond doubt, worst first."""
    stated = reading_noise(readings) is not None
    limit = np.array([chi2_quantile(1.0 - _BEYOND_DOUBT, m) for m in problem.degrees])
    said = []
    # At most a quarter of the positions: beyond that it is the model that does not fit.
    for _ in range(len(limit) // 4 + 1):
        kept = problem.weight == 1.0
        nu = float(problem.degrees[kept].sum()) - len(problem.model.keys) - problem.shared
        if not stated and nu > 0:
            problem, optimum = _settle_noise(problem, optimum, nu)
        excess = np.where(kept, optimum.point.q / limit, 0.0)
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0:
            break
        misfit = float(np.sqrt(optimum.point.q[worst] / problem.degrees[worst]))
        said.append(
            f"position {labels(readings)[worst]} is set aside: it does not fit by {misfit:.3g} "
            "times the noise"
        )
        weight = np.where(np.arange(len(limit)) == worst, _ASIDE, 1.0)
        column = weight.reshape(-1, *[1] * (problem.precision.ndim - 1))
        problem = replace(
            problem, precision=problem.precision * column, weight=problem.weight * weight
        )
        optimum = maximise(problem, optimum.state)
    factor = _huber_factor(problem, optimum, nu)
    return problem, optimum, Worth(factor, nu, warnings=tuple(said))


def _settle_noise(problem: Problem, optimum: Optimum, nu: float) -> tuple[Problem, Optimum]:
    """Scale the noise to the median misfit, which a few bad positions do not move."""
    kept = problem.weight == 1.0
    degrees = problem.degrees[kept]
    typical = np.array([_MEDIAN_CHI2[int(m)] for m in degrees])
    for _ in range(_ROUNDS):
        ratio = float(np.median(optimum.point.q[kept] / typical)) * float(degrees.sum()) / nu
        ratio = max(ratio, 1e-12)
        problem = replace(problem, precision=problem.precision / ratio)
        optimum = maximise(problem, optimum.state)
        if abs(np.log(ratio)) < _MEDIAN_SETTLED:
            break
    return problem, optimum


def _huber_factor(problem: Problem, optimum: Optimum, nu: float) -> float:
    """Return the factor of eq. (1) on the covariance without weights."""
    kept = problem.weight == 1.0
    q, degrees = optimum.point.q[kept], problem.degrees[kept]
    weight = loss_weight(problem.robust, q, degrees)
    slope = loss_slope(problem.robust, q, degrees)
    mean = max(float(slope.mean()), 0.05)
    used = 1.0 - nu / float(degrees.sum())
    correction = 1.0 + used * float(slope.var()) / mean**2
    return correction**2 * float(np.sum(q * weight**2)) / max(nu, 1.0) / mean**2


def _solution(
    problem: Problem, optimum: Optimum, readings: Readings, nu: float, worth: Worth
) -> Solution:
    model, state, point = problem.model, optimum.state, optimum.point
    p, m = len(model.keys), problem.values.shape[1]
    plain = optimum.normal if problem.robust is None else linearise(
        replace(problem, robust=None), state, point
    )  # fmt: skip
    information = reduced_information(plain, p)
    covariance = np.linalg.inv(information)
    covariance = (covariance + covariance.T) / 2.0 * worth.factor
    u = np.sqrt(np.diag(covariance))
    jacobian = parameter_jacobian(model, state.theta, point.force, problem.environment)
    leverage = np.einsum(
        "nij,njp,nip->ni", plain.marginal, jacobian @ np.linalg.inv(information), jacobian
    )
    magnitude = float(np.linalg.norm(problem.reference, axis=1).mean())
    misfit = point.q / problem.weight / (worth.factor if np.isfinite(worth.factor) else 1.0)
    robust = problem.robust is not None
    precision = problem.precision if problem.precision.ndim == 2 else np.diagonal(
        problem.precision, axis1=1, axis2=2
    )  # fmt: skip
    kept = problem.weight == 1.0
    residual_sd = np.sqrt(
        np.mean(1.0 / precision[kept], axis=0) * (1.0 if robust else worth.factor)
    )
    if not robust and np.isinf(worth.dof) and nu > 0:
        residual_sd = residual_sd * np.sqrt(point.objective / nu)
    return Solution(
        model=model,
        reference=point.force,
        parameters=state.theta,
        covariance=covariance,
        parameter_dof=np.full(p, worth.dof) if worth.parameter_dof is None
        else worth.parameter_dof,
        variance=np.full(m, worth.factor),
        dof=np.full(m, worth.dof),
        residuals=point.residuals,
        residual_sd=residual_sd,
        leverage=leverage,
        outliers=find_outlying_positions(
            misfit, problem.degrees, np.inf if robust else nu, labels(readings)
        ),
        condition=condition(information),
        unidentifiable=formal_only(model, state.theta, u, magnitude),
        warnings=(*worth.warnings, *_scale_bias(problem, state.theta, u, residual_sd, magnitude)),
        status=_status(optimum),
        extra={**dict(worth.extra), **_found_orientations(problem, optimum, readings)},
    )  # fmt: skip


def _scale_bias(
    problem: Problem, theta: Array, u: Array, sd: Array, magnitude: float
) -> tuple[str, ...]:
    """State the second-order bias of the scale factors where it matters."""
    if not np.isinf(problem.spread).all():
        return ()
    said = []
    for i in problem.model.own_scales:
        output = problem.model.outputs.index(problem.model.keys[i][0])
        bias = float(sd[output] ** 2 / (abs(theta[i]) * magnitude**2))
        if bias > _STATED_BIAS * u[i]:
            said.append(
                f"`{problem.model.names[i]}` is larger by about {bias:.2g} than it should be, "
                "because noise pushes readings off the sphere (sigma^2/g^2); average longer"
            )
    return tuple(said)


def _found_orientations(problem: Problem, optimum: Optimum, readings: Readings) -> dict[str, Any]:
    """Return what was found of orientations: how far off positions are, groups, tilt [degrees]."""
    if (problem.spread == 0.0).all() and not problem.shared:
        return {}
    state = optimum.state
    off = np.degrees(np.hypot(state.step[:, 0], state.step[:, 1]))
    found: dict[str, Any] = {
        "orientation_error_deg": np.where(np.isfinite(problem.spread), off, np.nan)
    }
    if problem.groups:
        names = dict.fromkeys(label for label in readings.group or () if label)
        found["group_rotation_deg"] = {
            name: np.degrees(rotation_vector(turn))
            for name, turn in zip(names, state.turns, strict=True)
        }
    if problem.level_spread > 0.0:
        found["level_sd_deg"] = np.degrees(problem.level_spread)
        found["level_tilt_deg"] = np.degrees(state.tilt)
    return found


def uncertain_gain(calibration: Calibration) -> Array:
    """Return how parameters follow readings, d(parameters)/d(readings), (p, n M).

    Of an uncertain or unknown orientation, near its solution: with A and W of
    `multipos.likelihood`, S^-1 A'W, orientations and shared unknowns moving along. Outputs run
    fastest. A robust loss is left out: it holds for positions that fit.
    """
    readings, reference = calibration.readings, calibration.reference
    n, m = readings.values.shape
    size = np.linalg.norm(reference, axis=1)
    sign = -1.0 if calibration.convention == "gravity" else 1.0
    level = float(calibration.extra.get("level_sd_deg", 0.0))
    placement = place(readings, sign * float(size.mean()), None, level)
    problem = _state_problem(calibration.model, readings, placement, None)
    if reading_noise(readings) is None:
        problem = replace(problem, precision=np.tile(1.0 / calibration.residual_sd**2, (n, 1)))
    turns = np.tile(np.eye(3), (problem.groups, 1, 1))
    # About the solution itself: its reference is the listed one, already turned and stepped.
    problem = replace(problem, reference=reference)
    state = start_state(problem, calibration.parameters, reference / size[:, None], turns)
    normal = linearise(problem, state, evaluate(problem, state))
    p = len(calibration.parameters)
    slopes = parameter_jacobian(calibration.model, state.theta, reference, readings.environment)
    everything = np.concatenate([slopes, normal.shared], axis=2)
    weighted = normal.marginal @ everything  # (n, M, p + shared)
    solved = np.linalg.solve(normal.information, weighted.reshape(n * m, -1).T)
    return np.asarray(solved[:p])


def _status(optimum: Optimum) -> Status:
    return Status(
        optimum.converged,
        optimum.iterations,
        f"converged in {optimum.iterations} iterations",
        optimum.last_step,
        optimum.gradient,
    )

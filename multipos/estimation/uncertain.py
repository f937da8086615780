"""Uncertain, unknown and other partly known orientations: from readings to a solution.

`solve_uncertain` states the problem of `multipos.estimation.likelihood`, starts it without a guess
(`multipos.estimation.starts`), estimates the reading noise where it is not given
(`multipos.estimation.noise`, `multipos.estimation.robustness`), and completes the solution. Where
nothing ties the readings to the directions of the world (every position unknown, or in a group of
unknown rotation), the rotation of the case is a convention: a gauge fixes it, lower triangular or
symmetric.

Maximum likelihood has a bias of second order. Noise perpendicular to the direction moves the
estimated position along the sphere, which curves away, so that a triad of scale factors k_i with
noise σ_i in units of g has own-axis scale factors too large by

    (k_i/g²) (sum over the others of σ_j²/k_j²)/2 · s²/(s² + σ²),                           (1)

nothing for exact positions, and the whole for unknown ones (s infinite). It is reported where it
is more than a tenth of u; the theory page derives it.

References
----------
JCGM 102; docs/theory/orientations.md.
"""

from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.estimation.identifiability import condition, formal_only
from multipos.estimation.information import FisherInformation
from multipos.estimation.noise import (
    NoiseEstimate,
    estimate_noise,
    estimate_tied_noise,
    with_degrees,
)
from multipos.estimation.problem import (
    RELATIVE_NOISE,
    Optimum,
    Problem,
    Solution,
    State,
    state_problem,
)
from multipos.estimation.starts import (
    own_starts,
    reduced_information,
    require_information,
    search,
    too_few,
)
from multipos.finding import Finding, Findings, about
from multipos.numerics.arrays import SMALLEST, Array, Places
from multipos.numerics.losses import Loss
from multipos.numerics.rotations import rotation_vector
from multipos.positions.open_rolls import across
from multipos.positions.orientations import StatedOrientations
from multipos.positions.readings import Readings, select_outputs
from multipos.sensor.fit_diagnostics import NoiseTest
from multipos.sensor.found import FoundOrientations, VarianceComponents
from multipos.sensor.model import ROLL_GAUGES, Gauge, Model
from multipos.sensor.studentised import find_outlying_positions

_REPORTED_BIAS = 1.96 / 3.0  # of u: a bias of the scale factors beyond a third of U is reported


def solve_uncertain(
    model: Model,
    readings: Readings,
    stated_up: StatedOrientations,
    *,
    gauge: Gauge = "lower",
    robust: Loss | None = None,
    pool: bool = False,
    parts: int = 1,
) -> Solution:
    """Fit all outputs together by eqs. (1)–(4) of `multipos.estimation.likelihood`.

    Parameters
    ----------
    model : Model
    readings : Readings
    stated_up : StatedOrientations
        Orientations and what is known of them.
    gauge : str
        'lower' or 'symmetric', where nothing ties the readings to the directions of the world.
    robust : str, optional
        Name of a loss of `multipos.numerics.losses`.
    pool : bool
        One residual variance for all outputs where orientations are exact, and so fitted one
        by one; elsewhere there is one anyway.
    parts : int
        Number of outputs that are fitted one by one, of which this is one.

    Raises
    ------
    RankError
        The positions cannot separate the parameters, which are named with a way out.
    ConvergenceError
        No start led to a minimum.
    MultiposError
        Too few positions, or readings that do not spread.
    """
    tied = model.shares_parameters
    if stated_up.exact and len(model.outputs) > 1 and not (pool or tied or _correlated(readings)):
        return _solve_separately(model, readings, stated_up, robust)
    model = _with_gauge(model, stated_up, gauge)
    problem = state_problem(model, readings, stated_up, None if robust is None else "huber")
    if stated_up.estimated:
        problem = _with_small_sds(problem)
    if _degrees(problem, model) < 0:
        raise too_few(problem)
    held: Findings = ()
    if not model.has_terms and problem.adrift:
        problem, held = _without_free_rotations(problem, gauge)
    nu = _degrees(problem, model)
    optimum, fisher = search(problem)
    searched, reached = problem, optimum
    stated = readings.noise is not None
    unstated = not (stated or stated_up.estimated or problem.has_prior or robust is not None)
    dof: Array | None = None
    if unstated and (problem.has_parameter_prior or (tied and not pool)):
        problem, optimum, noise, dof = estimate_tied_noise(problem, optimum)
    elif robust is not None:
        from multipos.estimation.robustness import judge_robustly

        problem, optimum, noise = judge_robustly(
            problem, optimum, robust, readings.labels, stated=stated
        )
    else:
        problem, optimum, noise = estimate_noise(
            problem, optimum, nu, stated=stated, estimate_sd=stated_up.estimated
        )
    noise = replace(noise, findings=(*held, *noise.findings))
    if problem is not searched or optimum is not reached or problem.robust is not None:
        fisher = require_information(problem.plain, optimum)
    found = _solution(problem, optimum, fisher, readings, nu, noise, parts)
    return found if dof is None else with_degrees(found, problem, optimum, dof)


def _diagonal(precision: Array) -> Array:
    """Return the precision (n, M) of each reading."""
    return precision if precision.ndim == 2 else np.diagonal(precision, axis1=1, axis2=2)


def _degrees(problem: Problem, model: Model) -> float:
    """Return the degrees of freedom: readings and priors less what is unknown."""
    return float(problem.degrees.sum()) - problem.unknowns + int(np.count_nonzero(model.beliefs))


def _with_small_sds(problem: Problem) -> Problem:
    """Return the problem whose orientation sds, of any size yet, do not drown the noise."""
    noise = float(np.sqrt(1.0 / np.max(_diagonal(problem.precision))))
    size = float(np.sqrt(np.mean((problem.values - problem.values.mean(axis=0)) ** 2)))
    by = min(noise / (RELATIVE_NOISE * size), 1.0) if size > 0.0 else 1.0
    sd = problem.orientation_sd
    return replace(problem, orientation_sd=np.where(np.isfinite(sd), by * sd, sd))


def _with_gauge(model: Model, stated_up: StatedOrientations, gauge: Gauge) -> Model:
    """Return the model without the parameters that free rotations of the case fix.

    Raises
    ------
    MultiposError
        The model has too few outputs for positions of unknown orientation.
    """
    listed = stated_up.listed.any()
    if not listed or np.isinf(stated_up.orientation_sd).any() or stated_up.rolls is not None:
        _require_triad(model)
    if listed or not model.has_terms:
        return model
    if stated_up.rolls is None:
        return model.with_gauge(gauge)
    about = stated_up.rolls.axes
    if len(about) > 1:  # no rotation leaves two axes where they are
        return model
    return model.with_gauge(next(name for name in ROLL_GAUGES if name.endswith(about[0])))


def _without_free_rotations(problem: Problem, gauge: Gauge) -> tuple[Problem, Findings]:
    """Return the problem with parameters held that fix the rotation of the case, and the note."""
    from multipos.estimation.user_models import rotations_to_hold
    from multipos.sensor.own_models import hold

    model = problem.model
    fixed = rotations_to_hold(problem, own_starts(problem)[0], gauge)
    if not fixed:
        said = "no rotation of the case is free: the model itself fixes its axes"
        return problem, (Finding("free-rotation", "note", said),)
    names = ", ".join(f"`{name}` of {output} at {value:g}" for output, name, value in fixed)
    said = f"a rotation of the case is free in this model; it was fixed by holding {names}"
    return replace(problem, model=hold(model, fixed)), (Finding("free-rotation", "note", said),)


def _correlated(readings: Readings) -> bool:
    """Return whether outputs are correlated, so that they cannot be fitted one by one."""
    noise = readings.noise
    return noise is not None and noise.ndim == 2


def _solve_separately(
    model: Model, readings: Readings, stated_up: StatedOrientations, robust: Loss | None
) -> Solution:
    """Fit each output alone where orientations are exact: nothing ties them together."""
    parts = [
        solve_uncertain(
            model.only(output),
            select_outputs(readings, (output,)),
            stated_up,
            robust=robust,
            parts=len(model.outputs),
        )
        for output in model.outputs
    ]

    def joined(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts])

    def stacked(name: str) -> Array:
        return np.column_stack([getattr(part, name) for part in parts])

    def said(name: str) -> tuple[str, ...]:
        pairs = zip(model.outputs, parts, strict=True)
        return tuple(f"{output}: {text}" for output, part in pairs for text in getattr(part, name))

    return replace(
        parts[0],
        model=model,
        parameters=joined("parameters"),
        covariance=_block_diagonal(model, [part.covariance for part in parts]),
        parameter_dof=joined("parameter_dof"),
        inflation=joined("inflation"),
        dof=joined("dof"),
        residuals=stacked("residuals"),
        residual_sd=joined("residual_sd"),
        leverage=stacked("leverage"),
        condition=max(part.condition for part in parts),
        outliers=said("outliers"),
        findings=tuple(
            each
            for output, part in zip(model.outputs, parts, strict=True)
            for each in about(output, part.findings)
        ),
        unidentifiable=said("unidentifiable"),
        status=max((part.status for part in parts), key=lambda status: status.iterations),
        variance_components=_joined([part.variance_components for part in parts]),
        robust_weight=None if robust is None else stacked("robust_weight"),
        claim=_together([part.claim for part in parts if part.claim is not None]),
    )


def _block_diagonal(model: Model, covariances: list[Array]) -> Array:
    """Return the covariance (p, p) of parameters that outputs do not share."""
    whole = np.zeros((len(model.keys), len(model.keys)))
    for covariance, where in zip(covariances, model.slices, strict=True):
        whole[where, where] = covariance
    return whole


def _joined(parts: list[VarianceComponents | None]) -> VarianceComponents | None:
    """Return the noise of outputs that were fitted one by one."""
    found = [part.rest_to_rest for part in parts if part is not None and part.rest_to_rest]
    if len(found) < len(parts):
        return parts[0]
    return VarianceComponents({output: one for part in found for output, one in part.items()})


def _together(stated_noise: list[NoiseTest]) -> NoiseTest | None:
    """Return the test of the stated noise of outputs that were fitted one by one."""
    if not stated_noise:
        return None
    return NoiseTest(
        sum(claim.chi2 for claim in stated_noise), sum(claim.dof for claim in stated_noise)
    )


def _require_triad(model: Model) -> None:
    if sorted(model.axes) != ["x", "y", "z"] or set(model.inputs) != {"x", "y", "z"}:
        raise MultiposError(
            "unknown orientations and open rolls need three outputs, one along each axis; got "
            f"{', '.join(model.outputs)} along {', '.join(model.axes)}. Give the orientations."
        )
    if len(model.own_scales) < 3 and model.has_terms:
        raise MultiposError(
            "unknown orientations need the scale factor of every output along its own axis; add "
            "the term 'own' to the model, or give the orientations."
        )


def _solution(
    problem: Problem,
    optimum: Optimum,
    fisher: FisherInformation,
    readings: Readings,
    nu: float,
    noise: NoiseEstimate,
    parts: int,
) -> Solution:
    model, state, point = problem.model, optimum.state, optimum.point
    p, m = len(model.keys), problem.values.shape[1]
    information = reduced_information(fisher.information, p)
    inverse = np.asarray(np.linalg.inv(information))
    inverse = (inverse + inverse.T) / 2.0
    formal = np.sqrt(np.diag(inverse))
    u = np.sqrt(noise.factor) * formal if noise.u is None else noise.u
    covariance = inverse * np.outer(u / formal, u / formal)
    magnitude = float(problem.magnitude.mean())
    sized = np.isfinite(noise.factor) and noise.factor > 0.0  # 0 where every residual is
    misfit = point.q / problem.weight / (noise.factor if sized else 1.0)
    robust = problem.robust is not None
    precision = _diagonal(problem.precision)
    kept = problem.weight == 1.0
    residual_sd = np.sqrt(
        np.mean(1.0 / precision[kept], axis=0) * (1.0 if robust else noise.factor)
    )
    if not robust and np.isinf(noise.dof) and nu > 0:
        residual_sd = residual_sd * np.sqrt(point.objective / nu)
    return Solution(
        model=model,
        reference=point.force,
        parameters=state.theta if noise.moves is None else state.theta + noise.moves,
        covariance=covariance,
        parameter_dof=np.full(p, noise.dof) if noise.parameter_dof is None else noise.parameter_dof,
        inflation=u / formal,
        dof=np.full(m, noise.dof),
        residuals=point.residuals,
        residual_sd=residual_sd,
        leverage=fisher.leverage(inverse),
        outliers=find_outlying_positions(
            misfit,
            problem.degrees,
            noise.dof if robust else nu,
            readings.labels,
            robust=robust,
            parts=parts,
        ),
        condition=condition(information),
        unidentifiable=formal_only(model, state.theta, u, magnitude),
        findings=(
            *noise.findings,
            *model.at_bounds(state.theta),
            *_scale_bias(problem, state.theta, u, residual_sd, magnitude),
        ),
        status=optimum.status,
        orientation_sd=noise.orientation_sd,
        variance_components=noise.components,
        orientations=_found_orientations(problem, optimum, readings),
        robust_weight=noise.weight,
        claim=noise.claim,
    )


def _scale_bias(problem: Problem, theta: Array, u: Array, sd: Array, magnitude: float) -> Findings:
    """Return findings on the second-order bias of scale factors, eq. (1), where it matters."""
    model = problem.model
    own = list(model.own_scales)
    if not problem.orientation_sd.any() or len(own) != 3 or len(model.outputs) != 3:
        return ()
    response = np.abs(theta[own]) * magnitude
    if not (response > SMALLEST * sd).all():
        return ()  # an output does not respond, and other findings say so
    relative = (sd / response) ** 2  # (3,), variances in g² per g²
    across = (relative.sum() - relative) / 2.0
    # s²/(s² + sigma²), 1 where s is infinite
    fraction = 1.0 - relative.mean() / (problem.orientation_sd**2 + relative.mean())
    bias = across * float(fraction.mean()) * np.abs(theta[own])
    return tuple(
        Finding(
            "scale-bias",
            "warning",
            (
                f"`{model.names[i]}` is too large by about {size:.2g}, as noise biases the "
                "estimated orientations (sigma^2/g^2)"
            ),
            "Average longer.",
        )
        for i, size in zip(own, bias.tolist(), strict=True)
        if size > _REPORTED_BIAS * u[i]
    )


def _found_orientations(
    problem: Problem, optimum: Optimum, readings: Readings
) -> FoundOrientations | None:
    """Return the estimated orientations; None where all were exact."""
    if (problem.orientation_sd == 0.0).all() and not problem.shared:
        return None
    state = optimum.state
    off = np.degrees(np.hypot(state.step[:, 0], state.step[:, 1]))
    turns = zip(_labels(readings, problem.group), state.turns, strict=True)
    tilted = problem.level_sd > 0.0
    return FoundOrientations(
        orientation_error_deg=np.where(np.isfinite(problem.orientation_sd), off, np.nan),
        group_rotation_deg={name: np.degrees(rotation_vector(turn)) for name, turn in turns}
        or None,
        inclination_deg=_inclinations(problem, state, readings) or None,
        level_sd_deg=float(np.degrees(problem.level_sd)) if tilted else None,
        level_tilt_deg=np.degrees(state.tilt) if tilted else None,
    )


def _inclinations(problem: Problem, state: State, readings: Readings) -> dict[str, float]:
    """Return how far up the axis of each group of rolls points [degrees]."""
    if problem.rolls is None:
        return {}
    sign = np.sign(np.sum(problem.reference * across(problem.rolls.vectors)))
    tilts = np.degrees(sign * state.inclination).tolist()
    return dict(zip(_labels(readings, problem.rolls.cone), tilts, strict=True))


def _labels(readings: Readings, number: Places) -> list[str]:
    """Return the labels of groups in the order of their numbers (n,), −1 for none."""
    pairs = zip(readings.group or (), number.tolist(), strict=False)
    return list(dict.fromkeys(label for label, own in pairs if own >= 0))

"""The noise of the readings of one unit, and the uncertainty of its parameters that follows.

`estimate_noise` returns problem, optimum and factor with the noise that was found, and
`estimate_tied_noise` those of outputs that are tied. `linear_model` is the linear model about an
optimum, and `with_degrees` gives a solution the degrees of freedom of its outputs.

- **Stated** noise is a lower bound; the excess variance is integrated over.
- **Unstated** noise, equal in all readings, is F/ν where every position is exact or unknown, F of
  `multipos.estimation.likelihood`, and ν = Σ m_k − (parameters and shared unknowns) the degrees of
  freedom: m_k = M outputs at a position, less two where nothing is known of its orientation.
- Where orientation errors explain part of the residuals, noise is integrated over, alone or
  together with the orientation sd (`multipos.estimation.orientation_variance`).

Where every position is unknown, a noise that is not stated, or whose statement the χ² test rejects,
may be unequal from axis to axis (`multipos.estimation.unequal_axes`).

Where priors or shared parameters tie the outputs and no noise is stated, a prior weighs in its own
unit, so that the noise decides how much it counts, and outputs that share a parameter weigh each
other. The noise of each output is then that of its residuals, searched for together with the
parameters,

    s_i² = Σ_k r_ki² / ν_i,    ν_i = n − Σ_k h_ki,    h = diag(A S⁻¹ A' W),                  (1)

S the information with the priors in it; one s for all outputs where orientations are unknown, with
ν = Σ m_k − p + Σ_j (S⁻¹)_jj/sd_j². A parameter that several outputs determine has Welch and
Satterthwaite's degrees of freedom over what each of them adds to its variance.

Source: JCGM 100:2008, G.4.1.
"""

from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from multipos.estimation import descent, known, likelihood, posteriors, starts
from multipos.estimation.orientation_variance import (
    SEPARATING,
    Block,
    Components,
    Linear,
    contrasts,
    find_both,
    find_excess,
    harmonic_mean,
    least_variance,
)
from multipos.estimation.problem import Optimum, Problem, Solution, start_state
from multipos.estimation.uncertain_orientations import STILL, UncertainSearch
from multipos.estimation.unknown_orientations import UnknownSearch
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import LARGEST, Array, Mask, Places, median
from multipos.numerics.quantiles import chi2_quantile
from multipos.numerics.rotations import step_on_sphere
from multipos.results import frozen
from multipos.sensor.fit_diagnostics import NoiseTest
from multipos.sensor.found import Component, OrientationSpread, RestToRest, VarianceComponents
from multipos.sensor.inverse import parameter_jacobian

_DETERMINED = 2.0  # factor to either side within which an orientation error is called determined
_ROUNDING = 1e-9  # relative, below which no sd is known
_RANK = 1e-7  # of the largest singular value, scaled, below which nothing is determined
_NO_UNCERTAINTY = Finding(
    "no-dof",
    "warning",
    "as many unknowns as equations: there are no residuals to estimate the uncertainty from",
    "State --reading-sd, or add positions.",
)
_NO_ORIENTATION_SD = Finding(
    "no-dof",
    "warning",
    "as many unknowns as equations: there are no residuals to estimate the orientation sd from",
    "State --orientation-sd in degrees, or add positions.",
)
_INSEPARABLE = Finding(
    "inseparable",
    "warning",
    (
        "orientation errors and noise cannot be separated at these positions; U takes all "
        "residuals as noise"
    ),
    "State --orientation-sd in degrees, or add positions (18 or more).",
)


@frozen
class NoiseEstimate:
    """The factor on the covariance of the likelihood, and how well it is known."""

    factor: float
    dof: float  # inf where the noise is known beforehand
    orientation_sd: Array | None = None  # (n,) [rad], where it is not as listed
    findings: Findings = ()
    components: VarianceComponents | None = None
    u: Array | None = None  # (p,), where it is not the root of the covariance times the factor
    parameter_dof: Array | None = None  # (p,), where they are not `dof`
    weight: Array | None = None  # (n,) of each position under a robust loss
    claim: NoiseTest | None = None  # of the stated noise, where there is one
    unstated: Array | None = None  # (n, M), fraction of variances in which axes may be unequal


Found = tuple[Problem, Optimum, NoiseEstimate]


def estimate_noise(
    problem: Problem, optimum: Optimum, nu: float, *, stated: bool, estimate_sd: bool
) -> Found:
    """Return problem and optimum with the estimated noise, and what it makes of the covariance.

    Parameters
    ----------
    problem, optimum
        With the stated noise, or with one of any size.
    nu : float
        Degrees of freedom.
    stated : bool
        Whether the readings state their noise.
    estimate_sd : bool
        Whether the size of the orientation sd is to be estimated.
    """
    if nu <= 0 and (estimate_sd or not stated):
        found = _NO_ORIENTATION_SD if stated else _NO_UNCERTAINTY
        return problem, optimum, NoiseEstimate(np.nan, 0.0, findings=(found,))
    if estimate_sd:
        return _both(problem, optimum, nu, stated)
    if stated:
        return _with_excess(problem, optimum, nu)
    if problem.has_prior:
        return _with_orientation_errors(problem, optimum, nu)
    unstated = np.ones(problem.values.shape)
    return problem, optimum, NoiseEstimate(optimum.point.objective / nu, nu, unstated=unstated)


def _with_excess(first: Problem, start: Optimum, nu: float) -> Found:
    """Return the solution with the excess variance added to the stated noise."""
    if nu <= 0:
        return first, start, NoiseEstimate(1.0, np.inf)
    unit, found = _find(first, start, nu, both=False)
    claim = NoiseTest(start.point.objective, nu)
    unexplained = unit.optimum.point.objective > chi2_quantile(STILL, nu)
    if unexplained and first.prior.any() and _separates(linear_model(first, start))[0]:
        # the stated orientation sds are then a lower bound as well
        unit, found = _find(first, start, nu, both=True, least=True)
        text = (
            f"residuals suggest orientation errors of {_widest(unit.problem):.2g} degrees (1 "
            "sigma), more than stated; U includes them"
        )
        noise = _noise_of(unit.problem, found, stated=True)
        orientation_sd = unit.problem.orientation_sd
        findings = (Finding("placement", "warning", text, "Fit with --orientation-sd auto."),)
        noise = replace(noise, findings=findings, orientation_sd=orientation_sd, claim=claim)
        return unit.problem, unit.optimum, noise
    noise = _noise_of(unit.problem, found, stated=True)
    unstated = None
    if first.precision.ndim == 2 and claim.chi2 > chi2_quantile(known.REJECTED, nu):
        unstated = np.maximum(1.0 - unit.problem.precision / first.precision, 0.0)
    noise = replace(noise, findings=known.overstated(claim), claim=claim, unstated=unstated)
    return unit.problem, unit.optimum, noise


def _with_orientation_errors(problem: Problem, optimum: Optimum, nu: float) -> Found:
    """Return the solution with an estimated noise, given stated orientation sds."""
    linear = linear_model(problem, optimum)
    first = _least_noise(problem, optimum, linear, _separates(linear))
    unit, found = _find(first, descent.resume(first, optimum), nu, both=False, stated=False)
    noise = _noise_of(unit.problem, found, stated=False)
    estimated = Finding("estimated-noise", "note", f"estimated {_noise_in_words(noise)}")
    noise = replace(noise, findings=(estimated,))
    return unit.problem, unit.optimum, noise


def _both(first: Problem, optimum: Optimum, nu: float, stated: bool) -> Found:
    """Return the solution with noise and orientation sd estimated, where readings separate them."""
    linear = linear_model(first, optimum)
    separated = _separates(linear)
    if not separated[0]:
        exact, exactly, noise = estimate_noise(
            *_at_listed(first, optimum), nu, stated=stated, estimate_sd=False
        )
        findings = (*noise.findings, _INSEPARABLE)
        noise = replace(noise, orientation_sd=exact.orientation_sd, findings=findings)
        return exact, exactly, noise
    if not stated:
        first = _least_noise(first, optimum, linear, separated)
    unit, found = _find(first, optimum, nu, both=True, stated=stated)
    noise = _noise_of(unit.problem, found, stated=stated)
    sd = _widest(unit.problem)
    ends = (found.low[0], found.high[0])
    low, high = (sd * float(np.sqrt(end / found.factor[0])) for end in ends)
    determined = high <= _DETERMINED**2 * low
    words = (
        f"orientation errors of {sd:.2g} degrees (68 %: {low:.2g} to {high:.2g})"
        if determined
        else f"orientation errors of {low:.2g} to {high:.2g} degrees (68 %)"
    )
    assert noise.components is not None
    text = f"estimated {_noise_in_words(noise)} and {words}"
    noise = replace(
        noise,
        orientation_sd=unit.problem.orientation_sd,
        findings=(Finding("estimated-noise", "note", text),),
        components=replace(
            noise.components,
            orientation_sd_deg=OrientationSpread(sd, (high - low) / 2.0, determined),
        ),
    )
    return unit.problem, unit.optimum, noise


def _find(
    first: Problem,
    optimum: Optimum,
    nu: float,
    *,
    both: bool,
    stated: bool = True,
    least: bool = False,
) -> "tuple[_Unit, Components]":
    """Return the unit under the estimated noise, and its variance components."""
    unit, parameters = _Unit(first, first, optimum), len(first.model.keys)
    valid = np.ones(1, dtype=np.bool_)
    if both:
        return unit, find_both(unit, valid, parameters, nu, stated=stated, least=least)
    return unit, find_excess(unit, valid, parameters, nu, stated=stated)


class _Unit:
    """A problem of any kind at its optimum, whose noise is estimated: a batch of one."""

    def __init__(self, first: Problem, problem: Problem, optimum: Optimum) -> None:
        self.first, self.problem, self.optimum = first, problem, optimum

    @property
    def size(self) -> Array:
        variance = np.diagonal(_covariances(self.first), axis1=1, axis2=2)
        return harmonic_mean(variance[None])

    def of(self, units: NDArray[Any]) -> Self:
        return self

    def put(self, units: Places, other: Self) -> None:
        self.problem, self.optimum = other.problem, other.optimum

    def linear(self) -> Linear:
        return linear_model(self.first, self.optimum)

    def squares(self) -> tuple[Array, Array]:
        point = self.optimum.point
        return np.array([point.objective]), np.array([np.sum(point.residuals**2)])

    def searched(self, excess: Array, factor: Array | None, end: float) -> "tuple[_Unit, Mask]":
        problem = replace(self.first, precision=_precision(self.first, float(excess[0])))
        if factor is not None:
            sd = self.first.orientation_sd * np.sqrt(factor[0])
            problem = replace(problem, orientation_sd=sd)
        optimum = descent.resume(problem, self.optimum, end)
        return _Unit(self.first, problem, optimum), np.ones(1, dtype=np.bool_)


def linear_model(problem: Problem, optimum: Optimum) -> Linear:
    """Return the linear model about an optimum, with the variances that `problem` states.

    Positions are taken by how many combinations of their readings no free angle moves.
    """
    state, point = optimum.state, optimum.point
    if UnknownSearch.fits(problem):
        sphere = UnknownSearch.of_problem(problem)
        return sphere.linear(sphere.place(state, point), sphere.variance)
    if UncertainSearch.fits(problem):
        listed = UncertainSearch.of_problem(problem)
        return listed.linear(listed.begin(state))
    normal = likelihood.linearise(problem, state, point)
    slopes = parameter_jacobian(problem.model, state.theta, point.force, problem.environment)
    error = point.residuals + np.einsum("nmi,ni->nm", normal.jacobian, state.step)
    design = np.concatenate([slopes, normal.shared], axis=2)
    tied = np.isfinite(problem.orientation_sd) & (problem.orientation_sd > 0.0)
    sd = np.where(tied, problem.orientation_sd, 0.0)[:, None, None]
    spread = sd * normal.jacobian * np.where(problem.rolled[:, None, None], [0.0, 1.0], 1.0)
    plain = problem.precision.ndim == 2
    variance = 1.0 / problem.precision if plain else _covariances(problem)
    blocks = []
    free = np.where(problem.unknown, 2, np.where(problem.rolled, 1, 0))
    for count in (0, 1, 2):
        rows = free == count
        if rows.any():
            block = (error[rows], design[rows], spread[rows], variance[rows])
            blocks.append(_without_free(*block, normal.jacobian[rows, :, :count]))
    return _identifiable(problem, state.theta, tuple(blocks))


def _without_free(
    error: Array, design: Array, spread: Array, variance: Array, free: Array
) -> Block:
    """Return a block of combinations of its readings that free angles (k, M, c) do not move."""
    if not free.shape[2]:
        return Block(error[None], design[None], spread[None], variance[None])
    axes = np.linalg.svd(free)[0].transpose(0, 2, 1)[:, free.shape[2] :]
    r = axes.shape[1]
    if variance.ndim == 2 and not np.ptp(variance, axis=1).any():
        left = variance[:, :r]
    else:
        full = variance if variance.ndim == 3 else variance[:, :, None] * np.eye(len(axes[0, 0]))
        left = axes @ full @ axes.transpose(0, 2, 1)
        left = left[:, :, 0] if r == 1 else left
    error = np.einsum("krm,km->kr", axes, error)
    return Block(error[None], (axes @ design)[None], (axes @ spread)[None], left[None])


def _identifiable(problem: Problem, theta: Array, blocks: tuple[Block, ...]) -> Linear:
    """Return the linear model with priors, without combinations that nothing determines.

    Such as a rotation about the only direction of a group.
    """
    p, P = len(theta), blocks[0].design.shape[3]
    prior, gradient, penalty = np.zeros(P), np.zeros(P), 0.0
    if problem.has_parameter_prior:
        excess, slope = problem.model.belief(theta)
        prior[:p], gradient[:p], penalty = slope**2, -slope * excess, float(excess @ excess)
    if problem.level_sd > 0.0:
        prior[-2:] = 1.0 / problem.level_sd**2
    if p == P:
        return Linear(blocks, np.diag(prior), gradient, penalty)
    sd = 1.0 / np.sqrt(
        median(
            problem.precision
            if problem.precision.ndim == 2
            else np.einsum("nmm->nm", problem.precision)
        )
    )
    rows = [block.design.reshape(-1, P) / sd for block in blocks]
    whole = np.concatenate([*rows, np.diag(np.sqrt(prior))])
    scale = np.linalg.norm(whole, axis=0)
    scale = 1.0 / np.where(scale > 0.0, scale, 1.0)
    _, sizes, vectors = np.linalg.svd(whole * scale, full_matrices=False)
    outer = scale[:, None] * vectors[sizes > _RANK * sizes[0]].T
    reduced = tuple(block._replace(design=block.design @ outer) for block in blocks)
    information = outer.T @ (prior[:, None] * outer)
    return Linear(reduced, information, outer.T @ gradient, penalty, outer[:p])


def _covariances(problem: Problem) -> Array:
    """Return the stated covariance of each position (n, M, M)."""
    if problem.precision.ndim == 3:
        return np.asarray(np.linalg.inv(problem.precision))
    return np.asarray((1.0 / problem.precision)[:, :, None] * np.eye(problem.values.shape[1]))


def _precision(problem: Problem, excess: float) -> Array:
    """Return the precision of readings that vary by τ² in excess of their noise."""
    if problem.precision.ndim == 2:
        return np.asarray(1.0 / (1.0 / problem.precision + excess))
    covariances = _covariances(problem)
    return np.asarray(np.linalg.inv(covariances + excess * np.eye(covariances.shape[1])))


def _least_noise(problem: Problem, optimum: Optimum, linear: Linear, separated: Mask) -> Problem:
    """Return the problem with a noise so small that it changes nothing.

    Where no orientation has an sd it is a small part of the residuals.
    """
    spreads, values = linear.spreads, problem.values
    if not spreads.any():
        spreads, separated = np.array([np.sum(optimum.point.residuals**2)]), np.array([True])
    least = least_variance(spreads, values[None], separated)
    return replace(problem, precision=np.full(values.shape, 1.0 / least[0]))


def _separates(linear: Linear) -> Mask:
    """Return whether readings separate noise from orientation errors; where few do, U fails."""
    blocks = linear.blocks
    # the errors of a position touch two combinations of its readings at most
    untouched = sum(each.error[0].size - 2 * each.error.shape[1] for each in blocks)
    if untouched - blocks[0].design.shape[3] >= SEPARATING:
        return np.ones(1, dtype=np.bool_)
    return contrasts(linear) >= SEPARATING


def _at_listed(problem: Problem, optimum: Optimum) -> tuple[Problem, Optimum]:
    """Return the problem of positions that are where they are listed, and its optimum."""
    tied = np.isfinite(problem.orientation_sd)
    exact = replace(problem, orientation_sd=np.where(tied, 0.0, problem.orientation_sd))
    direction = step_on_sphere(optimum.state.centre, optimum.state.basis, optimum.state.step)
    state = start_state(exact, optimum.state.theta, direction, optimum.state.turns)
    return exact, descent.maximise(exact, state)


def _noise_of(problem: Problem, found: Components, *, stated: bool) -> NoiseEstimate:
    """Return the noise of variance components."""
    p, dof = len(problem.model.keys), float(found.dof[0])
    if stated:
        excess = RestToRest(float(np.sqrt(found.excess[0])), float(found.u[0]), dof)
        components = VarianceComponents(dict.fromkeys(problem.model.outputs, excess))
    else:
        sd = float(problem.precision.mean() ** -0.5)
        u_sd = max(float(found.u[0]), _ROUNDING * sd)
        components = VarianceComponents(reading_sd=Component(sd, u_sd))
    each = np.full(p, dof)
    if problem.has_parameter_prior:  # the noise matters less to a parameter that is known anyway
        each = posteriors.dof_of_tails(found.tails[0])
    u = posteriors.standard_uncertainty(found.U[0], each)
    return NoiseEstimate(1.0, dof, components=components, u=u, parameter_dof=each)


def _noise_in_words(noise: NoiseEstimate) -> str:
    assert noise.components is not None
    reading, excess = noise.components.reading_sd, noise.components.rest_to_rest
    if reading is not None:
        unsure = f"uncertain by {100.0 * reading.u / reading.value:.0f} %"
        return f"reading noise of {reading.value:.2g} ({unsure})"
    assert excess is not None
    value = next(iter(excess.values())).value
    return f"excess noise of {value:.2g} from position to position"


def _widest(problem: Problem) -> float:
    """Return the largest orientation sd [degrees] of positions that are not unknown."""
    tied = problem.orientation_sd[np.isfinite(problem.orientation_sd)]
    return float(np.degrees(tied.max()))


_ROUNDS = 50
_CONVERGED = 1e-6  # relative change of a variance: a thousandth of its uncertainty
_LEAST_NOISE = 1e-12  # of the largest reading: below it no noise is known


def estimate_tied_noise(
    problem: Problem, optimum: Optimum
) -> tuple[Problem, Optimum, NoiseEstimate, Array]:
    """Return problem and optimum with the noise of eq. (1), and its degrees of freedom ν_i (M,)."""
    n, m = problem.values.shape
    least = (_LEAST_NOISE * float(np.abs(problem.values).max())) ** 2
    dof = np.zeros(m)
    for _ in range(_ROUNDS):
        dof = _degrees(problem, optimum)
        if dof.min() <= 0.0:
            noise = NoiseEstimate(np.nan, 0.0, findings=(_NO_UNCERTAINTY,))
            return problem, optimum, noise, np.zeros(m)
        square = np.sum(optimum.point.residuals**2, axis=0)
        if not problem.exact.all():
            square = np.full(m, square.sum())
        variance = np.maximum(square / dof, least)
        before = 1.0 / problem.precision[0]
        problem = replace(problem, precision=np.tile(1.0 / variance, (n, 1)))
        optimum = descent.resume(problem, optimum)
        if np.abs(variance / before - 1.0).max() <= _CONVERGED:
            break
    # of outputs that are fitted together each has all of them
    together = dof.sum() if problem.exact.all() else dof[0]
    return problem, optimum, NoiseEstimate(1.0, float(together)), dof


def with_degrees(solution: Solution, problem: Problem, optimum: Optimum, dof: Array) -> Solution:
    """Return a solution whose degrees of freedom are those of the outputs, ν_i (M,)."""
    if not problem.exact.all() or not dof.all():
        return solution
    slopes = parameter_jacobian(
        problem.model, optimum.state.theta, optimum.point.force, problem.environment
    )
    gain = np.linalg.inv(_information(problem, optimum)) @ slopes.transpose(1, 2, 0)  # (M, p, n)
    gain = gain * problem.precision.T[:, None, :]
    parts = np.einsum("mpn,nm->pm", gain**2, 1.0 / problem.precision)
    total = parts.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        own = np.where(total > 0.0, total**2 / (parts**2 / dof).sum(axis=1), np.inf)
        # information of the prior has no noise of readings in it
        own = own * (np.diag(solution.covariance) / total) ** 2
    return replace(solution, parameter_dof=np.where(own <= LARGEST, own, np.inf), dof=dof)


def _information(problem: Problem, optimum: Optimum) -> Array:
    plain = likelihood.linearise(problem.plain, optimum.state, optimum.point)
    return starts.reduced_information(plain.information, len(optimum.state.theta))


def _degrees(problem: Problem, optimum: Optimum) -> Array:
    """Return ν of eq. (1) of each output, or of all of them together for each."""
    m = problem.values.shape[1]
    inverse = np.linalg.inv(_information(problem, optimum))
    if not problem.exact.all():
        fractions = float(np.diag(inverse) @ problem.model.beliefs)
        return np.full(m, float(problem.degrees.sum()) - problem.unknowns + fractions)
    slopes = parameter_jacobian(
        problem.model, optimum.state.theta, optimum.point.force, problem.environment
    )
    leverage = np.einsum("nmp,pq,nmq->nm", slopes, inverse, slopes) * problem.precision
    return np.asarray(len(problem.values) - leverage.sum(axis=0))

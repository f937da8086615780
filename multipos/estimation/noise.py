"""The noise of the readings of one unit, and the uncertainty of its parameters that follows.

`estimate_noise` returns problem, optimum and factor with the noise that was found, and
`estimate_tied_noise` those of outputs that are tied. `with_degrees` gives a solution the degrees of
freedom of its outputs.

- **Unstated** noise, equal in all readings, is F/ν where every position is exact or unknown, F of
  `multipos.estimation.likelihood`, and ν = Σ m_k − (parameters and shared unknowns) the degrees of
  freedom: m_k = M outputs at a position, less two where nothing is known of its orientation; u
  allows for outputs of unequal noise.
- All else, the excess of **stated** noise and the sds of orientations and labels, is integrated
  over by `multipos.estimation.variances`; at few positions of which nothing is stated the estimate
  is that which orientation errors reach least.

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

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from multipos.estimation import descent, known, likelihood, starts, variances
from multipos.estimation.problem import Optimum, Problem, Solution, start_state
from multipos.estimation.units import FINEST, WIDEST, Units, linear_model
from multipos.estimation.variances import Components, StatedComponents
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import LARGEST, Array, Mask, median
from multipos.numerics.quantiles import coverage_factors
from multipos.results import frozen
from multipos.sensor.fit_diagnostics import NoiseTest
from multipos.sensor.found import Component, OrientationSpread, RestToRest, VarianceComponents
from multipos.sensor.inverse import parameter_jacobian

_DETERMINED = 2.0  # factor to either side within which an orientation error is called determined
_MORE = 2.0  # times the stated orientation sd, from which on a larger one is said
_ROUNDING = 1e-9  # relative, below which no sd is known
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
    moves: Array | None = None  # (p,), from the optimum to the estimate
    weight: Array | None = None  # (n,) of each position under a robust loss
    claim: NoiseTest | None = None  # of the stated noise, where there is one


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
    if not stated and not estimate_sd and not problem.has_prior:
        return problem, optimum, _of_residuals(problem, optimum, nu)
    if nu <= 0:
        return problem, optimum, NoiseEstimate(1.0, np.inf)
    few = problem.places < variances.SEPARATING
    alone = problem.tied.all() and not problem.shared and not problem.repeats
    if few and alone and not stated:
        return _by_own_axes(problem, optimum)
    tied = bool(problem.tied.any())
    orientation: Any = ("free" if estimate_sd else "centre") if tied else "exact"
    few = few and tied and not problem.repeats
    return _with_components(problem, optimum, nu, StatedComponents(stated, orientation, few))


def _of_residuals(problem: Problem, optimum: Optimum, nu: float) -> NoiseEstimate:
    """Return the noise as residuals show it; outputs may be unequal where all are fitted."""
    noise = NoiseEstimate(float(optimum.point.objective) / nu, nu)
    if problem.exact.all() or not optimum.point.objective > 0.0:
        return noise
    linear = linear_model(problem, optimum).without_noise()
    if linear.outer is not None:
        return noise
    u, dof = variances.with_unequal_outputs(linear)
    return replace(noise, u=u[0], parameter_dof=dof[0])


def _with_components(first: Problem, optimum: Optimum, nu: float, given: StatedComponents) -> Found:
    """Return the solution under the variance components that readings show."""
    unit = Units(first, first, optimum, stated=given.noise)
    found = variances.estimate(unit, np.ones(1, dtype=np.bool_), given)
    problem = unit.problem
    dof = median(found.dof[0])
    u = found.U[0] / coverage_factors(0.95, found.dof[0])
    noise = NoiseEstimate(
        1.0,
        float(dof),
        components=_components(problem, found, given, float(dof)),
        u=u,
        parameter_dof=found.dof[0],
        moves=found.moves[0] if problem.repeats else None,
    )
    findings: list[Finding] = []
    if given.noise:
        claim = NoiseTest(_misfit_alone(unit, found, nu), nu)
        noise = replace(noise, claim=claim)
        findings += known.overstated(claim)
    if given.orientation == "exact":
        return problem, unit.optimum, replace(noise, findings=tuple(findings))
    assert noise.components is not None
    spread = noise.components.orientation_sd_deg
    assert spread is not None
    if given.orientation == "centre" and found.low[0] > _MORE**2:
        text = (
            f"residuals suggest orientation errors of {spread.value:.2g} degrees (1 sigma), more "
            "than stated; U includes them"
        )
        action = "State a larger --orientation-sd, or leave it out."
        findings.append(Finding("placement", "note", text, action))
    text = f"estimated {_noise_in_words(noise)} and orientation errors of {spread.in_words}"
    findings.append(Finding("estimated-noise", "note", text))
    sd = problem.orientation_sd
    return problem, unit.optimum, replace(noise, orientation_sd=sd, findings=tuple(findings))


def _misfit_alone(unit: Units, found: Components, nu: float) -> float:
    """Return F under the stated noise alone, at the likely orientation errors.

    Where it is more than ν, at the largest of them: what these explain denies no noise.
    """
    nothing = np.zeros_like(found.noise)
    likely, most = (
        unit.searched(nothing, factor)[0].optimum.point.objective
        for factor in (found.factor, found.high)
    )
    return float(likely if likely <= nu else max(most, nu))


def _components(
    problem: Problem, found: Components, given: StatedComponents, dof: float
) -> VarianceComponents:
    """Return the noise, and the sds of orientations, of a unit."""
    variance, u = found.noise[0], float(found.u[0])
    rest_to_rest = reading = spread = None
    if given.noise:
        sds = np.sqrt(variance).tolist()
        parts = [RestToRest(sd, u, dof) for sd in sds]
        rest_to_rest = dict(zip(problem.model.outputs, parts, strict=True))
    else:
        sd = float(np.sqrt(variance.mean()))
        reading = Component(sd, max(u, _ROUNDING * sd))
    if given.orientation != "exact":
        value = _widest(problem)
        ends = (found.low[0], found.high[0])
        low, high = (value * float(np.sqrt(end / found.factor[0])) for end in ends)
        source: Literal["stated", "estimated"]
        source = "stated" if given.orientation == "centre" else "estimated"
        determined = high <= _DETERMINED**2 * low
        half = max((high - low) / 2.0, _ROUNDING * value)
        spread = OrientationSpread(value, half, determined, low, max(high, low), source)
    return VarianceComponents(rest_to_rest, reading, spread)


def _by_own_axes(first: Problem, optimum: Optimum) -> Found:
    """Return the solution at few positions of which nothing is stated."""
    unit = Units(first, first, optimum, stated=False)
    linear = unit.linear()
    noise, factor = variances.own_axes_weights(linear)
    noise = max(noise, (FINEST * float(np.abs(first.values).max())) ** 2)
    factor = min(factor, (WIDEST / float(first.orientation_sd.max())) ** 2)
    m = first.values.shape[1]
    following, _ = unit.searched(np.full((1, m), noise), np.array([factor]))
    U, dof = variances.by_own_axes(following.linear(), _are_crossed(first))
    text = (
        "noise and orientation errors are inseparable here: biases and own scale factors are of "
        "own-axis readings, and U holds where orientations are exact"
    )
    action = "State --reading-sd, or --orientation-sd in degrees (0: exact), or read each twice."
    finding = Finding("inseparable", "note", text, action)
    u = U / coverage_factors(0.95, np.array([dof]))[0]
    sd = float(np.sqrt(noise))
    components = VarianceComponents(reading_sd=Component(sd, sd / math.sqrt(2.0 * dof)))
    estimate = NoiseEstimate(
        1.0,
        dof,
        following.problem.orientation_sd,
        (finding,),
        components,
        u,
        np.full(len(u), dof),
    )
    # What angles would take up is noise as likely: residuals are those at the listed directions.
    problem, state = following.problem, start_state(first, following.optimum.state.theta)
    point = likelihood.evaluate(problem, state)
    return problem, replace(following.optimum, state=state, point=point), estimate


def _are_crossed(problem: Problem) -> Mask:
    """Return which parameters (p,) are neither constant nor the scale of an own axis."""
    model = problem.model
    if not model.has_terms:
        return np.ones(len(model.keys), dtype=np.bool_)
    own = {*model.own_scales}
    return np.array([bool(t.factors) and i not in own for i, (_, t) in enumerate(model.keys)])


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

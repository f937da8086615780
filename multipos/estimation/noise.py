"""How noisy the readings are, and what a solution of the likelihood is therefore worth.

- **Stated** noise is a floor, beside which readings scatter from rest to rest.
- **Unstated** noise, equal in all readings, is F/nu where every position is exact or unknown, F of
  `multipos.estimation.likelihood`.
- Where orientation errors share the blame for the residuals, noise is integrated over
  (`multipos.estimation.orientation_variance`), alone or together with the orientation sd.

Where every position is unknown, a noise that is not stated, or that is denied, may be unequal from
axis to axis (`multipos.estimation.unequal_axes`). The degrees of freedom are nu = sum m_k −
(parameters and shared unknowns), with m_k = M outputs at a position, less two where nothing is
known of its orientation.

Reading noise where priors or shared parameters tie the outputs, and nothing states it.

A prior weighs in its own unit, so that the noise decides how much it counts, and outputs that share
a parameter weigh each other. The noise of each output is then what its residuals say, searched for
together with the parameters,

    s_i² = Σ_k r_ki² / ν_i,    ν_i = n − Σ_k h_ki,    h = diag(A S⁻¹ A' W),                  (1)

S the information with the priors in it; one s for all outputs where orientations are unknown,
with ν = Σ m_k − p + Σ_j (S⁻¹)_jj/sd_j². A parameter that several outputs tell has Welch and
Satterthwaite's degrees of freedom over what each of them adds to its variance.

Source: JCGM 100:2008, G.4.1.
"""

from dataclasses import dataclass, replace

import numpy as np

from multipos.estimation.descent import resume
from multipos.estimation.known import DENIED, overstated
from multipos.estimation.likelihood import linearise
from multipos.estimation.orientation_variance import (
    as_scatter,
    integrate_both,
    integrate_placed,
    least_floor,
    tells_apart,
)
from multipos.estimation.posteriors import Posterior, standard_uncertainty
from multipos.estimation.problem import Optimum, Problem
from multipos.estimation.solution import Solution
from multipos.estimation.starts import reduced_information
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile
from multipos.sensor.fit_diagnostics import Claim
from multipos.sensor.found import Component, Placed, RestToRest, VarianceComponents
from multipos.sensor.inverse import parameter_jacobian

STILL = 0.99  # χ² point beyond which a scatter does not explain what readings differ by
_DETERMINED = 2.0  # factor to either side within which a placement is called determined
_ROUNDING = 1e-9  # relative, below which no sd is known
_NOTHING_LEFT = "as many unknowns as equations: nothing is left to estimate the "
_INSEPARABLE = (
    "these positions cannot tell placement from scatter: all that readings differ by is taken as "
    "scatter from position to position, and --orientation-sd auto found no orientation error; "
    "state it, or add positions (18 or more serve)"
)


@dataclass(frozen=True, eq=False)
class Appraisal:
    """What the covariance of the likelihood is to be multiplied by, and how well that is known."""

    factor: float
    dof: float  # inf where the noise is known beforehand
    orientation_sd: Array | None = None  # (n,) [rad], where it is not as listed
    warnings: tuple[str, ...] = ()
    components: VarianceComponents | None = None
    u: Array | None = None  # (p,), where it is not the root of the covariance times the factor
    weight: Array | None = None  # (n,) of each position under a robust loss
    claim: Claim | None = None  # of the stated noise, where there is one
    loose: Array | None = None  # (n, M), share of variances in which axes may be unequal


Found = tuple[Problem, Optimum, Appraisal]


def judge_noise(
    problem: Problem, optimum: Optimum, nu: float, *, stated: bool, estimate_sd: bool
) -> Found:
    """Return problem and optimum with the noise that was found, and what they are worth.

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
        words = (
            "orientation sd from; state it, or give more positions"
            if stated
            else "uncertainty from; give --reading-sd or more positions"
        )
        return problem, optimum, Appraisal(np.nan, 0.0, warnings=(_NOTHING_LEFT + words,))
    if estimate_sd:
        return _both(problem, optimum, nu, stated)
    if stated:
        return _beside_stated(problem, optimum, nu)
    if problem.has_prior:
        return _beside_placement(problem, optimum, nu)
    loose = np.ones(problem.values.shape)
    return problem, optimum, Appraisal(optimum.point.objective / nu, nu, loose=loose)


def _beside_stated(first: Problem, start: Optimum, nu: float) -> Found:
    """Add to the stated noise what readings scatter from rest to rest."""
    if nu <= 0:
        return first, start, Appraisal(1.0, np.inf)
    problem, optimum, posterior = integrate_placed(first, start, nu)
    claim = Claim(start.point.objective, nu)
    unexplained = optimum.point.objective > chi2_quantile(STILL, nu)
    if unexplained and problem.prior.any() and tells_apart(first, start):
        # the placement is then a floor as well, and no longer what was stated
        problem, optimum, both = integrate_both(first, start, nu, floor=True)
        said = (
            "no scatter alone explains the residuals: positions were off by more than was stated, "
            f"some {_widest(problem):.2g} degrees, see --orientation-sd auto"
        )
        worth = _worth(problem, both.posterior, stated=True)
        orientation_sd = problem.orientation_sd
        worth = replace(worth, warnings=(said,), orientation_sd=orientation_sd, claim=claim)
        return problem, optimum, worth
    worth = _worth(problem, posterior, stated=True)
    loose = None
    if first.precision.ndim == 2 and claim.chi2 > chi2_quantile(DENIED, nu):
        loose = np.maximum(1.0 - problem.precision / first.precision, 0.0)
    return problem, optimum, replace(worth, warnings=overstated(claim), claim=claim, loose=loose)


def _beside_placement(problem: Problem, optimum: Optimum, nu: float) -> Found:
    """Find a noise of which nothing is stated, beside a placement of which something is."""
    first = least_floor(problem, optimum)
    problem, optimum, posterior = integrate_placed(
        first, resume(first, optimum), nu, believed=False
    )
    worth = _worth(problem, posterior, stated=False)
    return problem, optimum, replace(worth, warnings=(f"estimated: {_noise_in_words(worth)}",))


def _both(first: Problem, optimum: Optimum, nu: float, stated: bool) -> Found:
    """Find noise and placement together, where readings tell one from the other."""
    if not tells_apart(first, optimum):
        exact, found, worth = judge_noise(
            *as_scatter(first, optimum), nu, stated=stated, estimate_sd=False
        )
        warnings = (*worth.warnings, _INSEPARABLE)
        return exact, found, replace(worth, orientation_sd=exact.orientation_sd, warnings=warnings)
    if not stated:
        first = least_floor(first, optimum)
    problem, optimum, both = integrate_both(first, optimum, nu, believed=stated)
    worth = _worth(problem, both.posterior, stated=stated)
    sd = _widest(problem)
    low, high = (sd * float(np.sqrt(end[0] / both.factor[0])) for end in both.span)
    determined = high <= _DETERMINED**2 * low
    words = (
        f"orientation error {sd:.2g} degrees (68 %: {low:.2g} to {high:.2g})"
        if determined
        else f"orientation error not determined (68 %: {low:.2g} to {high:.2g} degrees)"
    )
    assert worth.components is not None
    worth = replace(
        worth,
        orientation_sd=problem.orientation_sd,
        warnings=(f"estimated together: {_noise_in_words(worth)}, {words}",),
        components=replace(
            worth.components, orientation_sd_deg=Placed(sd, (high - low) / 2.0, determined)
        ),
    )
    return problem, optimum, worth


def _worth(problem: Problem, posterior: Posterior, *, stated: bool) -> Appraisal:
    """Return what a posterior makes of the covariance, with the noise that it found."""
    tau2, u_tau, _ = (float(each[0]) for each in posterior.summary)
    p, dof = len(problem.model.keys), float(posterior.shape[0])
    if stated:
        scatter = RestToRest(float(np.sqrt(tau2)), u_tau, dof)
        components = VarianceComponents(dict.fromkeys(problem.model.outputs, scatter))
    else:
        sd = float(problem.precision.mean() ** -0.5)
        components = VarianceComponents(reading_sd=Component(sd, max(u_tau, _ROUNDING * sd)))
    u = standard_uncertainty(posterior.centred[0], np.full(p, dof))
    return Appraisal(1.0, dof, components=components, u=u)


def _noise_in_words(worth: Appraisal) -> str:
    assert worth.components is not None
    reading, scatter = worth.components.reading_sd, worth.components.rest_to_rest
    if reading is not None:
        return f"reading noise {reading.value:.3g} (to {100.0 * reading.u / reading.value:.0f} %)"
    assert scatter is not None
    value = next(iter(scatter.values())).value
    return f"scatter from position to position {value:.3g} beside the stated noise"


def _widest(problem: Problem) -> float:
    """Return the largest orientation sd [degrees] of positions that are not unknown."""
    tied = problem.orientation_sd[np.isfinite(problem.orientation_sd)]
    return float(np.degrees(tied.max()))


_ROUNDS = 50
_SETTLED = 1e-6  # relative change of a variance: a thousandth of what is known of it
_ROUNDING_BELIEVED = 1e-12  # of the largest reading: below it no noise is known


def judge_tied(problem: Problem, optimum: Optimum) -> tuple[Problem, Optimum, Appraisal, Array]:
    """Return problem and optimum with the noise of eq. (1), its worth, and ν_i (M,)."""
    n, m = problem.values.shape
    least = (_ROUNDING_BELIEVED * float(np.abs(problem.values).max())) ** 2
    dof = np.zeros(m)
    for _ in range(_ROUNDS):
        dof = _degrees(problem, optimum)
        if dof.min() <= 0.0:
            said = "as many unknowns as equations: nothing is left to estimate the uncertainty "
            said += "from; give --reading-sd or more positions"
            return problem, optimum, Appraisal(np.nan, 0.0, warnings=(said,)), np.zeros(m)
        square = np.sum(optimum.point.residuals**2, axis=0)
        if not problem.exact.all():
            square = np.full(m, square.sum())
        variance = np.maximum(square / dof, least)
        before = 1.0 / problem.precision[0]
        problem = replace(problem, precision=np.tile(1.0 / variance, (n, 1)))
        optimum = resume(problem, optimum)
        if np.abs(variance / before - 1.0).max() <= _SETTLED:
            break
    return problem, optimum, Appraisal(1.0, float(dof.sum() if m > 1 else dof[0])), dof


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
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(total > 0.0, total**2 / (parts**2 / dof).sum(axis=1), np.inf)
        # what the prior says has no readings' noise in it
        own = own * (np.diag(solution.covariance) / total) ** 2
    return replace(solution, parameter_dof=np.where(np.isnan(own), np.inf, own), dof=dof)


def _information(problem: Problem, optimum: Optimum) -> Array:
    plain = linearise(replace(problem, robust=None), optimum.state, optimum.point)
    return reduced_information(plain.information, len(optimum.state.theta))


def _degrees(problem: Problem, optimum: Optimum) -> Array:
    """Return ν of eq. (1) of each output, or of all of them together for each."""
    m = problem.values.shape[1]
    inverse = np.linalg.inv(_information(problem, optimum))
    if not problem.exact.all():
        shares = float(np.diag(inverse) @ problem.model.beliefs)
        return np.full(m, float(problem.degrees.sum()) - problem.unknowns + shares)
    slopes = parameter_jacobian(
        problem.model, optimum.state.theta, optimum.point.force, problem.environment
    )
    leverage = np.einsum("nmp,pq,nmq->nm", slopes, inverse, slopes) * problem.precision
    return np.asarray(len(problem.values) - leverage.sum(axis=0))

"""How noisy the readings are, and what a solution of the likelihood is therefore worth.

- **Stated** noise is a floor, beside which readings scatter from rest to rest
  (`multipos.estimation.placed_scatter`).
- **Unstated** noise, equal in all readings, is F/nu where every position is exact or unknown.
- Where orientation errors share the blame for the residuals, noise is estimated by restricted
  maximum likelihood (`multipos.estimation.variances`), alone or together with the orientation sd.

The degrees of freedom are nu = sum m_k − (parameters and shared unknowns), with m_k = M outputs
at a position, less two where nothing is known of its orientation.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.descent import resume
from multipos.estimation.known import judge_claim
from multipos.estimation.placed_scatter import (
    as_scatter,
    contrasts,
    integrate_both,
    integrate_placed,
)
from multipos.estimation.problem import Optimum, Problem
from multipos.estimation.scatter import standard_uncertainty
from multipos.estimation.variances import Components, components, linearised, maximise_restricted
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import chi2_quantile
from multipos.sensor.found import Component, Placed, RestToRest, VarianceComponents

_ROUNDS = 30  # of noise and solution in turn
_SETTLED = 1e-5  # change of ln variance at which they agree
_DETERMINED = 2.0  # factor to either side within which a placement is called determined
_STILL = 0.95  # χ² point beyond which a scatter does not explain what readings differ by
_TELLING = 6  # contrasts that tell scatter from placement: with fewer, U does not cover
_INSEPARABLE = (
    "these positions cannot tell placement from scatter: all that readings differ by is taken as "
    "scatter from position to position, and --orientation-sd auto found no orientation error; "
    "state it, or add positions (18 or more serve)"
)
_NOTHING_LEFT = "as many unknowns as equations: nothing is left to estimate the "


@dataclass(frozen=True)
class Worth:
    """What the covariance of the likelihood is to be multiplied by, and how well that is known."""

    factor: float
    dof: float  # inf where the stated noise is believed
    parameter_dof: Array | None = None
    orientation_sd: Array | None = None  # (n,) [rad], where the orientation sd was estimated
    warnings: tuple[str, ...] = ()
    components: VarianceComponents | None = None
    u: Array | None = None  # (p,), where it is not the root of the covariance times the factor
    weight: Array | None = None  # (n,) of each position under a robust loss


def judge_noise(
    problem: Problem, optimum: Optimum, nu: float, *, stated: bool, estimate_sd: bool
) -> tuple[Problem, Optimum, Worth]:
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
        return problem, optimum, Worth(np.nan, 0.0, warnings=(_NOTHING_LEFT + words,))
    if estimate_sd and stated:
        return _both_beside_stated(problem, optimum, nu)
    if estimate_sd or (problem.has_prior and not stated):
        return _estimate(problem, optimum, stated, estimate_sd)
    if not stated:
        return problem, optimum, Worth(optimum.point.objective / nu, nu)
    if nu <= 0:
        return problem, optimum, Worth(1.0, np.inf)
    return _beside_stated(problem, optimum, nu)


def _beside_stated(first: Problem, optimum: Optimum, nu: float) -> tuple[Problem, Optimum, Worth]:
    """Add to the stated noise what readings scatter from rest to rest (`placed_scatter`)."""
    chi2, start = optimum.point.objective, optimum
    problem, optimum, posterior = integrate_placed(first, optimum, nu)
    if (
        optimum.point.objective > chi2_quantile(_STILL, nu)
        and problem.prior.any()
        and contrasts(first, start) >= _TELLING
    ):
        return _placed_worse(first, start, nu, chi2)
    tau2, u_tau, _ = posterior.summary
    tau, dof = float(np.sqrt(tau2)), posterior.shape
    p, outputs = len(problem.model.keys), problem.model.outputs
    unit = problem.model.unit
    worth = Worth(
        1.0,
        dof,
        warnings=judge_claim(chi2, nu, np.array([tau2]), unit),
        components=VarianceComponents(dict.fromkeys(outputs, RestToRest(tau, u_tau, dof))),
        u=standard_uncertainty(posterior.expanded(np.zeros(p)), np.full(p, dof)),
    )
    return problem, optimum, worth


def _placed_worse(
    first: Problem, optimum: Optimum, nu: float, chi2: float
) -> tuple[Problem, Optimum, Worth]:
    """Take the stated placement for a floor, where no scatter explains what readings differ by."""
    problem, optimum, both = integrate_both(first, optimum, nu, stated=True)
    tau2, u_tau, _ = both.posterior.summary
    tau, dof = float(np.sqrt(tau2)), both.posterior.shape
    tied = problem.orientation_sd[np.isfinite(problem.orientation_sd)]
    p, outputs = len(problem.model.keys), problem.model.outputs
    said = (
        *judge_claim(chi2, nu, np.array([tau2]), problem.model.unit),
        "no scatter alone explains the residuals: positions were off by more than was stated, "
        f"some {np.degrees(tied.max()):.2g} degrees, see --orientation-sd auto",
    )
    worth = Worth(
        1.0,
        dof,
        orientation_sd=problem.orientation_sd,
        warnings=said,
        components=VarianceComponents(dict.fromkeys(outputs, RestToRest(tau, u_tau, dof))),
        u=standard_uncertainty(both.posterior.expanded(np.zeros(p)), np.full(p, dof)),
    )
    return problem, optimum, worth


def _both_beside_stated(
    first: Problem, optimum: Optimum, nu: float
) -> tuple[Problem, Optimum, Worth]:
    """Find scatter from rest to rest and placement together, where readings tell them apart."""
    if contrasts(first, optimum) < _TELLING:
        problem, optimum, worth = _beside_stated(*as_scatter(first, optimum), nu)
        return (
            problem,
            optimum,
            replace(
                worth,
                orientation_sd=problem.orientation_sd,
                warnings=(*worth.warnings, _INSEPARABLE),
            ),
        )
    problem, optimum, both = integrate_both(first, optimum, nu)
    tau2, u_tau, _ = both.posterior.summary
    tau, dof = float(np.sqrt(tau2)), both.posterior.shape
    p, outputs = len(problem.model.keys), problem.model.outputs
    tied = problem.orientation_sd[np.isfinite(problem.orientation_sd)]
    sd = float(np.degrees(tied.max()))
    low, high = (sd * float(np.sqrt(end / both.factor)) for end in both.span)
    determined = high <= _DETERMINED**2 * low
    words = (
        f"orientation error {sd:.2g} degrees (68 %: {low:.2g} to {high:.2g})"
        if determined
        else f"orientation error not determined (68 %: {low:.2g} to {high:.2g} degrees)"
    )
    scatter = f"scatter from position to position {tau:.3g} {problem.model.unit}"
    worth = Worth(
        1.0,
        dof,
        orientation_sd=problem.orientation_sd,
        warnings=(f"estimated together: {scatter} beside the stated noise, {words}",),
        components=VarianceComponents(
            rest_to_rest=dict.fromkeys(outputs, RestToRest(tau, u_tau, dof)),
            orientation_sd_deg=Placed(sd, (high - low) / 2.0, determined),
        ),
        u=standard_uncertainty(both.posterior.expanded(np.zeros(p)), np.full(p, dof)),
    )
    return problem, optimum, worth


def _estimate(
    problem: Problem, optimum: Optimum, stated: bool, orientation: bool
) -> tuple[Problem, Optimum, Worth]:
    """Find variances and solution in turn, by restricted maximum likelihood."""
    first = problem
    v = np.zeros(2)  # ln of the factors on noise and orientation variances
    free = np.array([not stated, orientation])
    for _ in range(_ROUNDS):
        linear = linearised(first, optimum)
        found = maximise_restricted(linear, v, free)
        change = float(np.abs(found - v).max())
        v = found
        problem = replace(
            first,
            precision=first.precision * np.exp(-v[0]),
            orientation_sd=first.orientation_sd * np.exp(v[1] / 2.0),
        )
        optimum = resume(problem, optimum)
        if change < _SETTLED:
            break
    told = components(linearised(first, optimum), v, free)
    words, said = _in_words(problem, told, free)
    warnings = [f"estimated by restricted maximum likelihood: {' and '.join(words)}"]
    estimated = (said.reading_sd, said.orientation_sd_deg)
    if max(part.u / part.value for part in estimated if part is not None) > 1.0:
        warnings.append(
            "one of the estimated variances is hardly determined; state it, or add positions "
            "(18 or more serve)"
        )
    worth = Worth(
        1.0,
        np.inf if stated else max(2.0 / float(told.log_covariance[0, 0]), 1.0),
        told.dof,
        problem.orientation_sd if orientation else None,
        tuple(warnings),
        said,
    )
    return problem, optimum, worth


def _in_words(
    problem: Problem, told: Components, free: NDArray[np.bool_]
) -> tuple[list[str], VarianceComponents]:
    """Return the standard deviations that were estimated, with u, as words and as numbers."""
    relative = np.sqrt(np.diag(told.log_covariance)) / 2.0  # of a standard deviation
    words, reading, orientation = [], None, None
    if free[0]:
        value = float(problem.precision.mean() ** -0.5)
        reading = Component(value, value * float(relative[0]))
        words.append(f"reading noise {value:.3g} (to {100.0 * relative[0]:.0f} %)")
    if free[1]:
        tied = problem.orientation_sd[np.isfinite(problem.orientation_sd)]
        value = float(np.degrees(tied.max()))
        u = float(relative[-1])
        orientation = Placed(value, value * u, u <= _DETERMINED - 1.0)
        words.append(f"orientation error {value:.3g} degrees (to {100.0 * relative[-1]:.0f} %)")
    return words, VarianceComponents(reading_sd=reading, orientation_sd_deg=orientation)

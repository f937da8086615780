"""Reading noise where priors or shared parameters tie the outputs, and nothing states it.

A prior weighs in its own unit, so that the noise decides how much it counts, and outputs that share
a parameter weigh each other. The noise of each output is then what its residuals say, searched for
together with the parameters,

    s_i² = Σ_k r_ki² / ν_i,    ν_i = n − Σ_k h_ki,    h = diag(A S⁻¹ A' W),                  (1)

S the information with the priors in it; one s for all outputs where orientations are unknown,
with ν = Σ m_k − p + Σ_j (S⁻¹)_jj/sd_j². A parameter that several outputs tell has Welch and
Satterthwaite's degrees of freedom over what each of them adds to its variance.

Source: JCGM 100:2008, G.4.1.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.descent import resume
from multipos.estimation.likelihood import linearise
from multipos.estimation.noise import Appraisal
from multipos.estimation.problem import Optimum, Problem
from multipos.estimation.solution import Solution
from multipos.estimation.starts import reduced_information
from multipos.numerics.arrays import Array
from multipos.sensor.inverse import parameter_jacobian

_ROUNDS = 50
_SETTLED = 1e-6  # relative change of a variance: a thousandth of what is known of it
_ROUNDING = 1e-12  # of the largest reading: below it no noise is known


def judge_tied(problem: Problem, optimum: Optimum) -> tuple[Problem, Optimum, Appraisal, Array]:
    """Return problem and optimum with the noise of eq. (1), its worth, and ν_i (M,)."""
    n, m = problem.values.shape
    least = (_ROUNDING * float(np.abs(problem.values).max())) ** 2
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

"""A solution of the likelihood as a linear model of its readings.

About an optimum the readings at the listed positions have residuals e_k (n, M) with

    e = A theta + error,      cov error_k = Sigma_k + s_k² J_k J_k',                        (1)

Sigma_k, s_k, J_k, A as in `multipos.estimation.likelihood`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.likelihood import linearise
from multipos.estimation.problem import Optimum, Problem
from multipos.numerics.arrays import Array
from multipos.sensor.inverse import parameter_jacobian


@dataclass(frozen=True, eq=False)
class Linearised:
    """A solution as a linear model of its readings, eq. (1)."""

    error: Array  # (n, M), residuals at the listed positions
    design: Array  # (n, M, p + q), A: parameters and shared unknowns
    jacobian: Array  # (n, M, 2)
    precision: Array  # (n, M, M), Sigma^-1
    orientation_sd: Array  # (n,) [rad]
    prior: Array  # (p + q,) information of the unknowns themselves
    p: int
    rolled: NDArray[np.bool_]  # (n,), rolls whose first angle is free
    pull: Array | float = 0.0  # (p + q,) of the priors of parameters towards their centres

    @property
    def tied(self) -> NDArray[np.bool_]:
        """Positions (n,) that are off by their sd."""
        return np.isfinite(self.orientation_sd) & (self.orientation_sd > 0.0)

    @property
    def spread(self) -> Array:
        """What a turn by its sd does to each position, s_k J_k (n, M, 2); 0 for a free turn."""
        size = np.where(self.tied, self.orientation_sd, 0.0)[:, None, None]
        return np.asarray(self.jacobian * size * np.where(self.rolled[:, None, None], [0, 1], 1))


def linearised(problem: Problem, optimum: Optimum) -> Linearised:
    """Return the linear model about an optimum, with the variances that `problem` states."""
    state = optimum.state
    normal = linearise(problem, state, optimum.point)
    p, m = len(state.theta), problem.values.shape[1]
    slopes = parameter_jacobian(
        problem.model, state.theta, optimum.point.force, problem.environment
    )
    prior = np.zeros(p + problem.shared)
    pull = np.zeros(p + problem.shared)
    if problem.believed:
        excess, slope = problem.model.belief(state.theta)
        prior[:p], pull[:p] = slope**2, -slope * excess
    if problem.level_sd > 0.0:
        prior[-2:] = 1.0 / problem.level_sd**2
    precision = problem.precision
    return Linearised(
        error=optimum.point.residuals + np.einsum("nmi,ni->nm", normal.jacobian, state.step),
        design=np.concatenate([slopes, normal.shared], axis=2),
        jacobian=normal.jacobian,
        precision=precision if precision.ndim == 3 else precision[:, :, None] * np.eye(m),
        orientation_sd=problem.orientation_sd,
        prior=prior,
        pull=pull,
        p=p,
        rolled=problem.rolled,
    )

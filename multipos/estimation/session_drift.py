"""The drift of a session that settles: its time constant τ, and what τ adds to U.

`find_time_constant` returns τ and its uncertainty where an exponential fits better than a line, and
`with_time_constant` is a calibration whose U holds it.

Beside the model of the sensor each output has an amplitude times one function of the time t from
the first row,

    y_k = h(θ, f_k) + a c(t_k),      c(t) = t − mean,  or  c(t) = exp(−t/τ).                 (1)

About a fit with either, with A, W and N = A'WA of `multipos.estimation.likelihood` for everything
but the amplitudes, D = c ⊗ I their slopes and y what the fit leaves with its own drift put back,

    q(c) = y'My − y'MD (D'MD)⁻¹ D'My,      M = W − WA N⁻¹ A'W.                               (2)

Angles that positions are off by are eliminated in W, so that this is one formula for orientations
known or not. The size of the noise is not known: q^(−ν/2) is the likelihood of c, ν the degrees of
freedom. An exponential is taken where the best is more likely than the line by half the logarithm
of the number of readings, as which Schwarz counts a parameter. ln τ is its mean over a flat prior,
between two thirds of the time from row to row and twice the session, and so is its variance.

Parameters follow τ by g = −G a ∂c/∂ln τ, G their gain (`multipos.estimation.gains`), so that

    cov → cov + u²(ln τ) g g'.                                                               (3)

Where rows are worth fewer independent ones, u² is as many times larger.

Source: G. Schwarz, Ann. Statist. 6, 1978.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from multipos.estimation.gains import about_solution, estimator_gain
from multipos.estimation.likelihood import evaluate, linearise, weigh
from multipos.estimation.problem import Problem, State
from multipos.numerics.arrays import SMALLEST, Array, Mask
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import DRIFT, Model

_SHORTEST = 0.7  # of the time from row to row
_LONGEST = 2.0  # of the session
_NODES = 24  # of ln τ
_GRIDS = 4  # each where the one before found something
_SEEN = 1e-4  # of the most likely
_FEWEST = 3.0  # degrees of freedom


def find_time_constant(c: Calibration, elapsed: Array) -> tuple[float, float] | None:
    """Return τ and its standard uncertainty; None where a line fits as well.

    Parameters
    ----------
    c : Calibration
        With a drift of either kind.
    elapsed : (n,) array
        Time of its rows from the first row of the session.
    """
    span = float(np.ptp(elapsed))
    problem, state = about_solution(c)
    readings = float(problem.degrees.sum())
    nu = readings - problem.unknowns
    if nu < _FEWEST or not span > 0.0:
        return None
    misfits = _misfits(c, problem, state)

    def likelihoods(columns: Array) -> Array:
        return -0.5 * nu * np.log(np.maximum(misfits(columns), SMALLEST))

    shortest = _SHORTEST * span / (len(elapsed) - 1)
    nodes = np.linspace(math.log(shortest), math.log(_LONGEST * span), _NODES)
    for _ in range(_GRIDS):
        log = likelihoods(np.exp(-elapsed / np.exp(nodes)[:, None]))
        weights = np.exp(log - log.max())
        mean = float(weights @ nodes / weights.sum())
        variance = float(weights @ (nodes - mean) ** 2 / weights.sum())
        seen = np.flatnonzero(weights > _SEEN)
        low, high = max(seen[0] - 1, 0), min(seen[-1] + 1, _NODES - 1)
        nodes = np.linspace(nodes[low], nodes[high], _NODES)
    line = likelihoods(elapsed[None] - elapsed.mean())[0]
    if not log.max() - line > 0.5 * math.log(readings):
        return None
    tau = math.exp(mean)
    return tau, tau * math.sqrt(variance)


def _misfits(c: Calibration, problem: Problem, state: State) -> Callable[[Array], Array]:
    """Return what gives q (K,) of columns c (K, n), eq. (2)."""
    point = evaluate(problem, state)
    normal = linearise(problem, state, point)
    own = parameter_jacobian(c.model, state.theta, point.force, problem.environment)
    drifts = _drifts(c.model)
    others = np.append(~drifts, np.ones(normal.shared.shape[2], dtype=np.bool_))
    A, W = np.concatenate([own, normal.shared], axis=2)[:, :, others], normal.marginal
    drift = np.outer(problem.environment[DRIFT], _amplitudes(c))
    back = np.einsum("nij,nj->ni", W, drift)
    left = weigh(problem.precision, point.residuals)
    # with the angles that the solution has taken from where positions are listed
    along = np.einsum("nmi,nm->ni", normal.jacobian, left)
    sd = np.where(problem.tied, problem.orientation_sd, 0.0)
    square = np.sum(point.residuals * left) + np.sum((sd[:, None] * along) ** 2)
    square += np.sum(drift * back)
    N, gradient = normal.information[np.ix_(others, others)], np.einsum("nma,nm->a", A, back)

    def misfits(columns: Array) -> Array:
        crossed = np.einsum("kn,nma->kma", columns, W @ A)
        inside = np.linalg.solve(N, gradient)
        through = np.linalg.solve(N, crossed.transpose(0, 2, 1))
        pushed = columns @ (left + back) - crossed @ inside
        within = np.einsum("kn,nij->kij", columns**2, W) - crossed @ through
        taken = np.linalg.solve(within, pushed[..., None])[..., 0]
        return np.asarray(square - gradient @ inside - np.einsum("km,km->k", pushed, taken))

    return misfits


def _drifts(model: Model) -> Mask:
    """Return which parameters (p,) are amplitudes."""
    return np.array([str(term) == DRIFT for _, term in model.keys])


def _amplitudes(c: Calibration) -> Array:
    """Return the amplitude (M,) of each output, 0 where its drift was left out."""
    found, drifts = np.zeros(len(c.outputs)), _drifts(c.model)
    found[c.model.output_of[drifts]] = c.parameters[drifts]
    return found


def with_time_constant(c: Calibration) -> Calibration:
    """Return a calibration whose covariance holds what τ is uncertain by, eq. (3)."""
    if c.model.drift_tau is None:
        return c
    tau, u = c.model.drift_tau
    column = c.readings.environment[DRIFT]
    slope = -column * np.log(np.maximum(column, SMALLEST))
    g = estimator_gain(c) @ np.outer(slope, _amplitudes(c)).ravel()
    rows = c.effective_rows
    worth = 1.0 if rows is None else len(column) / float(np.mean(list(rows.values())))
    covariance = c.covariance + (u / tau) ** 2 * worth * np.outer(g, g)
    return replace(c, covariance=covariance)

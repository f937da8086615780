"""A zero of its own in every run or soak: what zeros differ by enters the uncertainty.

- `spread_zeros` returns a solution with what the zeros make of its U.
- `without_zeros` returns the readings less what their runs differ by, in which outliers and causes
  are looked for.

Rows that a column `run` gives the same label share a zero beside the model's, as of a switch-on or
a mounting; so do those of a soak, a stay at one temperature of a model with terms of temperature
(`multipos.sensor.temperature`).

In one output of n rows and R zeros, with Z one column a zero,

    y = X p + Z a + e,    a ~ N(0, κ σ²),    e ~ N(0, σ²).                                   (1)

The estimate stays least squares, b = B y with B = (X'X)⁻¹X', so that the bias is the mean of the
runs where each has the same positions, and for any κ

    cov b = s² (B B' + κ B Z Z' B'),    s² = (e'e − Σ κ d²(u'e)²/(1 + κ d²))/ν,             (2)

e the residuals, ν = n − p and u, d the left singular vectors and singular values of what X leaves
of Z. κ is not decided upon but integrated over, by its restricted likelihood, a probability of .3
that it is nothing and else a prior even in the logarithm of the variance of a zero's mean, m rows a
zero,

    p(κ) ∝ Π (1 + κ d²)^−½ s^−ν (1 + κ m)⁻¹.                                                (3)

U is half the interval that holds the mixture of Student's t with (2) and ν degrees of freedom, its
degrees of freedom are those of the mixture's tails, and correlations those of the mean of (2). It is that of the mean over zeros: what the zero of the
next run adds stands in U of compensated force. Restricted likelihood and mixture are those of
correlated rows (`multipos.estimation.correlated_rows`), with one law in place of another.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.correlated_rows import sd_of_rows
from multipos.estimation.problem import Solution
from multipos.estimation.variances import dof_of, half_of_mixture
from multipos.finding import Finding
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import coverage_factor, coverage_factors
from multipos.positions.headers import RUN
from multipos.positions.readings import Readings
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model
from multipos.sensor.temperature import runs_of

_COVERAGE = 0.95  # that of `half_of_mixture`
_SEEN = 1e-6  # of a column of ones, below which nothing is left of a run
_NODES = 200  # of ln(1 + κ m)
_NONE = 0.3  # probability that zeros are alike
_WIDE = 1e6  # times the ratio of mean squares, up to which κ m goes
_ROUNDING = 1e-12  # of the largest reading, below which a residual is nothing


def spread_zeros(
    solution: Solution, readings: Readings, zeros: Places, estimator: Estimator
) -> Solution:
    """Return a solution whose U holds what zeros (n,) differ by, eqs. (2) and (3).

    Robust fits, models of one's own, orientations that are not exact and readings whose covariance
    is given are left as they are, with a warning where a column gives the zeros.
    """
    model, by_run = solution.model, runs_of(readings, solution.model) is not None
    if (
        not estimator.exact
        or not model.has_terms
        or solution.robust_weight is not None
        or readings.covariance is not None
    ):
        return _with_finding(solution, _UNUSED) if by_run else solution
    sd = sd_of_rows(solution, readings)
    phi = model.basis(solution.reference, readings.environment)
    Z = (zeros[:, None] == np.unique(zeros)).astype(np.float64)
    u, covariance, sizes = np.sqrt(np.diag(solution.covariance)), solution.covariance.copy(), []
    ratio, dof = np.ones(len(u)), solution.parameter_dof.copy()
    for i, columns in enumerate(model.columns):
        weight, mine = 1.0 / sd[:, [i]], model.slices[i]
        error = solution.residuals[:, i]
        if np.abs(error).max() <= _ROUNDING * np.abs(readings.values[:, i]).max():
            return solution
        found = _judge(phi[:, columns] * weight, error * weight[:, 0], Z * weight)
        if found is None:
            return solution
        longer, own_dof, correlation, size = found
        before = coverage_factors(_COVERAGE, dof[mine])
        dof[mine] = np.minimum(dof[mine], own_dof)
        ratio[mine] = longer * before / coverage_factors(_COVERAGE, dof[mine])
        covariance[mine, mine] = correlation * np.outer(*[u[mine] * ratio[mine]] * 2)
        sizes.append(f"{model.outputs[i]} {size:.2g}")
    inflation = solution.inflation * ratio
    solution = replace(solution, covariance=covariance, inflation=inflation, parameter_dof=dof)
    if not by_run:
        return solution
    text = (
        f"bias is the mean of {Z.shape[1]} runs, whose zeros differ by {', '.join(sizes)} "
        f"{model.unit} (standard deviation); U of the bias includes it"
    )
    return _with_finding(solution, Finding("zero-per-soak", "note", text))


def without_zeros(readings: Readings, model: Model, reference: Array) -> Readings:
    """Return readings of one zero: less what their runs differ by, in least squares of eq. (1).

    They are what rows are held against one by one, at references (n, 3) [g].
    """
    runs = runs_of(readings, model)
    if runs is None or not model.has_terms:
        return readings
    phi = model.basis(reference, readings.environment)
    Z = (runs[:, None] == np.unique(runs)).astype(np.float64)
    values = readings.values.copy()
    for i, columns in enumerate(model.columns):
        design = np.column_stack([phi[:, columns], Z])
        found = np.linalg.lstsq(design, values[:, i], rcond=None)[0]
        zeros = Z @ found[len(columns) :]
        values[:, i] -= zeros - zeros.mean()
    environment = {name: each for name, each in readings.environment.items() if name != RUN}
    return replace(readings, values=values, environment=environment)


_UNUSED = Finding(
    "run-unused",
    "warning",
    "column 'run' is not used: runs are a random effect of least squares at known orientations, "
    "and U of this fit excludes how the zero differs between them",
    "Fit at known orientations, or fit each run and compare.",
)


def _with_finding(solution: Solution, said: Finding) -> Solution:
    return replace(solution, findings=(*solution.findings, said))


def _judge(X: Array, e: Array, Z: Array) -> tuple[Array, Array, Array, float] | None:
    """Return U (p,) over that of independent rows, its dof, correlations, and the sd of zeros.

    None where zeros leave nothing to judge them by, such as one row each.

    Parameters
    ----------
    X, e, Z : (n, p), (n,), (n, R) arrays
        Design, residuals and zeros, whitened.
    """
    n, p = X.shape
    Q, T = np.linalg.qr(X)
    B = Q @ np.linalg.inv(T).T
    U, d, _ = np.linalg.svd(Z - Q @ (Q.T @ Z), full_matrices=False)
    seen = d > _SEEN * np.linalg.norm(Z)
    d2, explained = d[seen] ** 2, (U[:, seen].T @ e) ** 2
    nu, q, total = float(n - p), float(seen.sum()), float(e @ e)
    left = total - explained.sum()
    if q < 1.0 or nu - q < 1.0 or not left > 0.0:
        return None
    within, between = left / (nu - q), float(explained.mean())
    m = float(d2.mean())
    kappa = np.expm1(np.linspace(0.0, np.log1p(_WIDE * (1.0 + between / within)), _NODES)) / m
    known = 1.0 + kappa[:, None] * d2
    s2 = (total - (1.0 - 1.0 / known) @ explained) / nu
    log = -0.5 * np.log(known).sum(axis=1) - 0.5 * nu * np.log(s2)
    prior = np.full(_NODES, (1.0 - _NONE) / _NODES)
    prior[0] += _NONE
    weight = prior * np.exp(log - log.max())
    weight /= weight.sum()
    moved = B.T @ Z
    own, moved = B.T @ B, moved @ moved.T
    variances = s2[:, None] * (np.diag(own) + kappa[:, None] * np.diag(moved))
    half = half_of_mixture(weight[None], variances[None], np.full((1, p), nu))[0]
    independent = coverage_factor(_COVERAGE, nu) * np.sqrt(total / nu * np.diag(own))
    mean = (weight @ s2) * own + (weight @ (s2 * kappa)) * moved
    correlation = mean / np.sqrt(np.outer(np.diag(mean), np.diag(mean)))
    dof = np.minimum(dof_of(weight[None], variances[None])[0], nu)
    return half / independent, dof, correlation, float(np.sqrt(max(between - within, 0.0) / m))

"""A zero of its own in every run: what runs differ by enters the uncertainty of the biases.

- `spread_runs` returns a solution with what the runs make of its U.
- `without_zeros` returns the readings less what their runs differ by, in which outliers and causes
  are looked for.

Rows that a column `run` gives the same label share a zero beside the model's, as of a switch-on or
a mounting.

In one output of n rows and R runs, with Z one column a run,

    y = X p + Z a + e,    a ~ N(0, κ σ²),    e ~ N(0, σ²).                                   (1)

The estimate stays least squares, b = B y with B = (X'X)⁻¹X', so that the bias is the mean of the
runs where each has the same positions, and for any κ

    cov b = s² (B B' + κ B Z Z' B'),    s² = (e'e − Σ κ d²(u'e)²/(1 + κ d²))/ν,             (2)

e the residuals, ν = n − p and u, d the left singular vectors and singular values of what X leaves
of Z. κ is not decided upon but integrated over, by its restricted likelihood and a prior even in
the logarithm of the variance of a run's mean, m rows a run,

    p(κ) ∝ Π (1 + κ d²)^−½ s^−ν (1 + κ m)⁻¹.                                                (3)

U is half the interval that holds the mixture of Student's t with (2) and ν degrees of freedom. It
is that of the mean over runs: what the zero of the next run adds stands in U of compensated force
(`multipos.sensor.temperature`). Restricted likelihood and mixture are those of correlated rows
(`multipos.estimation.correlated_rows`), with one law in place of another.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.correlated_rows import sd_of_rows
from multipos.estimation.problem import Solution
from multipos.estimation.variances import half_of_mixture
from multipos.finding import Finding
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import coverage_factor
from multipos.positions.headers import RUN
from multipos.positions.readings import Readings
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model
from multipos.sensor.temperature import runs_of

_COVERAGE = 0.95  # that of `half_of_mixture`
_SEEN = 1e-6  # of a column of ones, below which nothing is left of a run
_NODES = 200  # of ln(1 + κ m)
_WIDE = 1e6  # times the ratio of mean squares, up to which κ m goes
_ROUNDING = 1e-12  # of the largest reading, below which a residual is nothing


def spread_runs(
    solution: Solution, readings: Readings, runs: Places, estimator: Estimator
) -> Solution:
    """Return a solution whose U holds what the zero of runs (n,) differs by, eqs. (2) and (3).

    Robust fits, models of one's own, orientations that are not exact and readings whose covariance
    is given are left as they are, with a warning.
    """
    model = solution.model
    if (
        not estimator.exact
        or not model.has_terms
        or solution.robust_weight is not None
        or readings.covariance is not None
    ):
        return _with_finding(solution, _UNUSED)
    sd = sd_of_rows(solution, readings)
    phi = model.basis(solution.reference, readings.environment)
    Z = (runs[:, None] == np.unique(runs)).astype(np.float64)
    ratio, sizes = np.ones(len(solution.parameters)), []
    for i, columns in enumerate(model.columns):
        weight = 1.0 / sd[:, [i]]
        error = solution.residuals[:, i]
        if np.abs(error).max() <= _ROUNDING * np.abs(readings.values[:, i]).max():
            return solution
        found = _judge(phi[:, columns] * weight, error * weight[:, 0], Z * weight)
        if found is None:
            return solution
        ratio[model.slices[i]], size = found
        sizes.append(f"{model.outputs[i]} {size:.2g}")
    text = (
        f"bias is the mean of {Z.shape[1]} runs, whose zeros differ by {', '.join(sizes)} "
        f"{model.unit} (standard deviation); U of the bias includes it"
    )
    return replace(
        _with_finding(solution, Finding("zero-per-soak", "note", text)),
        covariance=solution.covariance * np.outer(ratio, ratio),
        inflation=solution.inflation * ratio,
    )


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


def _judge(X: Array, e: Array, Z: Array) -> tuple[Array, float] | None:
    """Return U (p,) over that of independent rows, and the sd of zeros of an output.

    None where runs leave nothing to judge them by, such as one row each.

    Parameters
    ----------
    X, e, Z : (n, p), (n,), (n, R) arrays
        Design, residuals and runs, whitened.
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
    weight = np.exp(log - log.max())
    own, moved = np.sum(B**2, axis=0), np.sum((B.T @ Z) ** 2, axis=1)
    variances = s2[:, None] * (own + kappa[:, None] * moved)
    dof = np.full((1, p), nu)
    half = half_of_mixture(weight[None] / weight.sum(), variances[None], dof)[0]
    independent = coverage_factor(_COVERAGE, nu) * np.sqrt(total / nu * own)
    return half / independent, float(np.sqrt(max(between - within, 0.0) / m))

"""A zero of its own in every run or soak: what zeros differ by enters the uncertainty.

- `spread_zeros` returns a solution with what the zeros make of its U.
- `without_zeros` returns the readings less what their runs differ by, in which outliers and causes
  are looked for.

Rows that a column `run` gives the same label share a zero beside the model's, as of a switch-on or
a mounting; so do those of a soak, a stay at one temperature of a model with terms of temperature
(`multipos.sensor.temperature`).

In one output of n rows, with Z one column a zero,

    y = X p + Z a + e,    a ~ N(0, κ σ²),    e ~ N(0, σ²).                                   (1)

The estimate stays least squares, so that the bias is the mean of the runs where each has the same
positions. κ is not decided upon but integrated over (`multipos.estimation.variances`, where rows of
a zero share it as those of a label do): with the probability .2 there is none, else its logarithm
is uniform,

    p(κ | y) ∝ p(κ) |V|^−½ |X'V⁻¹X|^−½ s^−ν,    V = I + κ Z Z'.                              (2)

U is half the interval about the estimate that holds the mixture of Student's t of ν = n − p degrees
of freedom, and its degrees of freedom are those that the tails of the mixture have. It is that of
the mean over zeros: what the zero of the next run adds stands in U of compensated force.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation import variances
from multipos.estimation.correlated_rows import sd_of_rows
from multipos.estimation.problem import Solution
from multipos.finding import Finding
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import coverage_factors
from multipos.positions.headers import RUN
from multipos.positions.readings import Readings
from multipos.sensor.found import Estimator
from multipos.sensor.model import Model
from multipos.sensor.temperature import SEEN, runs_of

_COVERAGE = 0.95  # that of `half_of_mixture`
_MOST = 1e5  # ratio beyond which sums of squares have no digits left
_NONE = 0.2  # probability that zeros are alike
_LOW, _HIGH = 0.3, 1e3  # their sd, to that of the mean of their rows and to what they show
_ROUNDING = 1e-12  # of the largest reading, below which a residual is nothing


def spread_zeros(
    solution: Solution, readings: Readings, zeros: Places, estimator: Estimator
) -> Solution:
    """Return a solution whose U holds what zeros (n,) differ by, eq. (2).

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
    Z = zeros[:, None] == np.unique(zeros)
    ratio, dof, sizes = np.ones(len(solution.parameters)), solution.parameter_dof.copy(), []
    for i, columns in enumerate(model.columns):
        weight, mine = 1.0 / sd[:, i], model.slices[i]
        error = solution.residuals[:, i]
        if np.abs(error).max() <= _ROUNDING * np.abs(readings.values[:, i]).max():
            return solution
        Q = np.linalg.qr(phi[:, columns])[0]
        left = np.linalg.svd(Z - Q @ (Q.T @ Z), compute_uv=False)
        contrasts = np.sum(left > SEEN * np.sqrt(len(Z) / Z.shape[1]))
        if not 1 <= contrasts < len(error) - len(columns):  # nothing to judge zeros by
            return solution
        U, own_dof = _judge(phi[:, columns] * weight[:, None], error * weight, weight, zeros)
        u = np.sqrt(np.diag(solution.covariance)[mine])
        dof[mine] = np.minimum(dof[mine], own_dof)
        ratio[mine] = U / (coverage_factors(_COVERAGE, dof[mine]) * u)
        means = [error[each].mean() for each in Z.T]
        sizes.append(f"{model.outputs[i]} {np.std(means, ddof=1):.2g}")
    inflation, covariance = solution.inflation * ratio, solution.covariance * np.outer(ratio, ratio)
    solution = replace(solution, covariance=covariance, inflation=inflation, parameter_dof=dof)
    if not by_run:
        return solution
    text = (
        f"bias is the mean of {Z.shape[1]} runs, whose zeros differ by "
        f"{', '.join(sizes)} {model.unit} (standard deviation); U of the bias includes it"
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


def _judge(X: Array, e: Array, weight: Array, zeros: Places) -> tuple[Array, Array]:
    """Return U (p,) and its degrees of freedom, of rows whitened by their weights (n,)."""
    n, p = X.shape
    shared = weight[None, :, None, None] * [1.0, 0.0, 0.0]  # as a rotation of one component
    block = variances.Block(
        *(e[None, :, None], X[None, :, None], np.zeros((1, n, 1, 2)), np.ones((1, n, 1))),
        turned=np.array(shared),
        label=zeros,
    )
    square = np.bincount(zeros, weight**2)
    mean = np.bincount(zeros, weight * e) / square
    noise = np.std(e - weight * mean[zeros])
    size = np.sqrt(1.0 / square.mean())  # at which a zero is as the noise of its mean
    high = min(_HIGH * (size + mean.std() / noise), _MOST)
    axis = variances.Axis(np.array([min(_LOW * size, high / 2.0)]), np.array([high]), _NONE)
    linear, names = variances.Linear((block,)), variances.Names(stated=False, label=0)
    found = variances.integrate(linear, [axis], names)
    tails = variances.dof_of(found.weights, found.variances)[0]
    return variances.half_interval(found)[0][0], np.minimum(tails, float(n - p))

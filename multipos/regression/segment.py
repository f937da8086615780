"""One segment of a regression: its coefficients, its tests, and how its terms were chosen.

`Segment` holds them; `combined_variance` returns the variance of sums of coefficients, and
`format_span` names a segment by its range.

A response is described by coefficients of terms,

    response = Σ_t b_t φ_t(variables) + residual.                                           (1)

The overall test compares what the k slopes explain with what is left,

    F = (Σ (ŷ − ȳ)²/k) / (Σ (y − ŷ)²/(n − k − 1)),                                          (2)

against the F that chance exceeds with probability 1 − confidence. Without a constant there is no
mean to compare with: ȳ = 0 and n − k.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.files.numbers import number
from multipos.numerics.arrays import Array, Places, quadratic
from multipos.numerics.quantiles import t_tail
from multipos.numerics.selection import Step, Tested
from multipos.numerics.terms import CONSTANT, Term, evaluate_terms, linear_term
from multipos.regression.region import Region
from multipos.results import Result, frozen


def combined_variance(X: Array, covariance: Array) -> Array:
    """Return x'Cx (n,) of rows x of X (n, q), at least what its own rounding leaves unknown."""
    sums = np.abs(X) @ np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return np.maximum(quadratic(X, covariance), np.finfo(np.float64).eps * sums**2)


class Coefficient(NamedTuple):
    """One term with its coefficient.

    The robust figures are None where rows are independent; `dof` is None without runs.
    """

    term: str
    value: float
    u: float
    t: float
    p: float
    u_robust: float | None = None
    t_robust: float | None = None
    p_robust: float | None = None
    dof: float | None = None


@frozen
class Robust(Result):
    """What the figures become where rows are not independent (`multipos.regression.correlation`).

    Attributes
    ----------
    kind : str
        'hac'; in files of version 0.2 also 'cluster' or 'effective'.
    covariance : (q, q) array
        Of the segment's coefficients.
    F, p : float
    dof : (k, ν) tuple
        Of F.
    t_dof : float
    n_effective, lag_one : float
        How many independent rows these are equivalent to; correlation of neighbouring residuals.
    """

    kind: str
    covariance: Array
    F: float
    p: float
    dof: tuple[float, float]
    t_dof: float
    n_effective: float
    lag_one: float


@frozen
class Between(Result):
    """What differs from run to run, eq. (2) of `multipos.regression.runs`.

    Attributes
    ----------
    runs : int
    variable : str or None
        Whose slope differs as well; None where it cannot be identified.
    centre : float
        v̄ of this variable.
    covariance : (1, 1) or (2, 2) array
        Ψ, of the constant at v̄ and the slope.
    """

    runs: int
    variable: str | None
    centre: float
    covariance: Array

    @property
    def dof(self) -> int:
        """Degrees of freedom of Ψ."""
        return self.runs - 1

    @property
    def sd(self) -> float:
        """Standard deviation of the constant from run to run."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def slope_sd(self) -> float | None:
        """Standard deviation of the slope, where it can be identified."""
        return None if self.variable is None else float(np.sqrt(self.covariance[1, 1]))

    def variance(self, columns: Mapping[str, Array], rows: Places) -> Array:
        """Return z'Ψz of eq. (3) there, at some rows of a table's columns."""
        z = self.columns(columns, rows)
        return combined_variance(z, self.covariance)

    def columns(self, columns: Mapping[str, Array], rows: Places) -> Array:
        """Return z, what runs may differ by, at some rows of a table's columns."""
        z = np.ones((len(rows), len(self.covariance)))
        if self.variable is not None:
            z[:, 1] = columns[self.variable][rows] - self.centre
        return z

    def of_coefficients(self, terms: Sequence[Term]) -> Array:
        """Return what the scatter between runs adds to the covariance of terms, L Ψ L'/m."""
        L = np.zeros((len(terms), len(self.covariance)))
        L[terms.index(CONSTANT), 0] = 1.0
        if self.variable is not None:
            L[terms.index(linear_term(self.variable)), 1] = 1.0
            L[terms.index(CONSTANT), 1] = -self.centre
        return np.asarray(L @ self.covariance @ L.T / self.runs)


class LeftOut(NamedTuple):
    """A candidate that a segment does not support, and why."""

    term: str
    reason: str


@frozen
class Segment(Result):
    """The model of one segment.

    Attributes
    ----------
    range : (low, high) tuple
        Of the segment variable, or of the first variable where there are no segments.
    branch : str or None
        'heating' or 'cooling' where these are separate, in a file of version 0.2.
    n : int
    terms : tuple of q Term
    values, covariance : (q,), (q, q) arrays
    dof : (k, ν) tuple
        Slopes, and rows less coefficients.
    r2, adjusted_r2, rms, aicc, press : float
        rms is the residual standard deviation on ν; press the root mean square of the errors of
        predicting each row from all others.
    F, F_critical, p : float
    limits : mapping of variable to (low, high)
        What the segment's rows cover.
    path : tuple of Step
    runner_up : Tested or None
    F_to_enter : float
    collinear : tuple of str
    robust : Robust or None
    between : Between or None
        What differs from one switch-on to the next, where runs are distinguished; then `covariance`
        has it too.
    """

    range: tuple[float, float]
    n: int
    terms: tuple[Term, ...]
    values: Array
    covariance: Array
    dof: tuple[int, int]
    r2: float
    adjusted_r2: float
    rms: float
    aicc: float
    press: float
    F: float
    F_critical: float
    p: float
    limits: Mapping[str, tuple[float, float]]
    path: tuple[Step, ...] = ()
    runner_up: Tested | None = None
    F_to_enter: float = float("nan")
    collinear: tuple[str, ...] = ()
    robust: Robust | None = None
    between: Between | None = None
    left_out: tuple[LeftOut, ...] = ()
    region: Region | None = None
    branch: str | None = None

    @property
    def significant(self) -> bool:
        """Whether F passes its critical value."""
        return bool(self.F_critical < self.F)

    @property
    def used(self) -> tuple[str, ...]:
        """The variables of its terms, and of those that its region is about."""
        terms = self.terms if self.region is None else self.region.terms
        return tuple(dict.fromkeys(f.variable for term in terms for f in term.factors))

    @cached_property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """The terms with their coefficients, u, t and p."""
        u = np.sqrt(np.diag(self.covariance)).tolist()
        robust = self.robust
        wide = [None] * len(u) if robust is None else np.sqrt(np.diag(robust.covariance)).tolist()
        found: list[Coefficient] = []
        for term, b, s, w in zip(self.terms, self.values.tolist(), u, wide, strict=True):
            t = b / s if s > 0.0 else np.nan if s != s or b == 0.0 else np.copysign(np.inf, b)
            row = Coefficient(str(term), b, s, t, t_tail(t, self.dof[1]))
            if robust is not None and w is not None:
                t = b / w if w > 0.0 else np.nan
                row = row._replace(u_robust=w, t_robust=t, p_robust=t_tail(t, robust.t_dof))
            found.append(row if self.between is None else self._judged_by_runs(row, len(found)))
        return tuple(found)

    def _judged_by_runs(self, row: Coefficient, i: int) -> Coefficient:
        """Return a coefficient with p by the effective degrees of freedom, as runs are few."""
        assert self.between is not None  # or there are no runs to judge by
        share = float(self.between.of_coefficients(self.terms)[i, i])
        wide = row.u if row.u_robust is None else row.u_robust
        nu = self.dof[1] if self.robust is None else self.robust.t_dof
        rest = wide**2 - share
        lost = share**2 / (self.between.runs - 1) + (rest**2 / nu if nu > 0 else 0.0)
        dof = wide**4 / lost if lost > 0.0 else float(nu)
        row = row._replace(dof=dof, p=t_tail(row.t, dof))
        return row if row.t_robust is None else row._replace(p_robust=t_tail(row.t_robust, dof))

    def design(self, columns: Mapping[str, Array], rows: Places) -> Array:
        """Return the segment's design at some rows of a table's columns."""
        chosen = {f.variable: columns[f.variable][rows] for t in self.terms for f in t.factors}
        return evaluate_terms(self.terms, chosen, len(rows))


def format_span(variable: str, span: tuple[float, float], branch: str | None) -> str:
    """Return a segment in words."""
    text = f"{variable} {number(span[0], 5)} to {number(span[1], 5)}"
    return text if branch is None else f"{text}, {branch}"

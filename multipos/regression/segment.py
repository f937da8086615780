"""One segment of a regression: its coefficients, its tests, and how its terms were chosen.

A response is described by coefficients of terms,

    response = Σ_t b_t φ_t(variables) + residual.                                           (1)

The overall test compares what the k slopes explain with what is left,

    F = (Σ (ŷ − ȳ)²/k) / (Σ (y − ŷ)²/(n − k − 1)),                                          (2)

against the F that chance exceeds with probability 1 − confidence. Without a constant there is no
mean to compare with: ȳ = 0 and n − k.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import t_tail
from multipos.numerics.selection import Step, Tested
from multipos.numerics.subsets import Subset
from multipos.numerics.terms import Term, evaluate_terms
from multipos.results import Result


class Coefficient(NamedTuple):
    """One term with its coefficient; the robust figures are None where rows are independent."""

    term: str
    value: float
    u: float
    t: float
    p: float
    u_robust: float | None = None
    t_robust: float | None = None
    p_robust: float | None = None


@dataclass(frozen=True, eq=False)
class Robust(Result):
    """What the figures become where rows are not independent (`multipos.regression.correlation`).

    Attributes
    ----------
    kind : str
        'hac', 'cluster' or 'effective'.
    covariance : (q, q) array
        Of the segment's coefficients.
    F, p : float
    dof : (k, ν) tuple
        Of F.
    t_dof : float
    n_effective, lag_one : float
        How many independent rows these are worth; correlation of neighbouring residuals.
    """

    kind: str
    covariance: Array
    F: float
    p: float
    dof: tuple[float, float]
    t_dof: float
    n_effective: float
    lag_one: float


@dataclass(frozen=True, eq=False)
class Segment(Result):
    """The model of one segment.

    Attributes
    ----------
    range : (low, high) tuple
        Of the segment variable, or of the first variable where there are no segments.
    branch : str or None
        'heating' or 'cooling' where these are separate.
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
    subsets : tuple of (terms, Subset)
    robust : Robust or None
    """

    range: tuple[float, float]
    branch: str | None
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
    subsets: tuple[tuple[tuple[str, ...], Subset], ...] = ()
    robust: Robust | None = None

    @property
    def significant(self) -> bool:
        """Whether F passes its critical value."""
        return bool(self.F_critical < self.F)

    @cached_property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """The terms with their coefficients, u, t and p."""
        u = np.sqrt(np.diag(self.covariance)).tolist()
        robust = self.robust
        wide = [None] * len(u) if robust is None else np.sqrt(np.diag(robust.covariance)).tolist()
        found = []
        for term, b, s, w in zip(self.terms, self.values.tolist(), u, wide, strict=True):
            t = b / s if s > 0.0 else np.nan if s != s or b == 0.0 else np.copysign(np.inf, b)
            row = Coefficient(str(term), b, s, t, t_tail(t, self.dof[1]))
            if robust is not None and w is not None:
                t = b / w if w > 0.0 else np.nan
                row = row._replace(u_robust=w, t_robust=t, p_robust=t_tail(t, robust.t_dof))
            found.append(row)
        return tuple(found)

    def design(self, columns: Mapping[str, Array], rows: NDArray[np.intp]) -> Array:
        """Return the segment's design at some rows of a table's columns."""
        chosen = {f.variable: columns[f.variable][rows] for t in self.terms for f in t.factors}
        return evaluate_terms(self.terms, chosen, len(rows))

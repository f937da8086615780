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

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from multipos.files.numbers import number
from multipos.files.records import (
    ANY_NUMBER,
    FIGURE,
    NOT_NEGATIVE,
    P_VALUE,
    VARIANCES,
    Entries,
    Figure,
    Flag,
    Listed,
    Maybe,
    Text,
    Whole,
    require_covariance,
)
from multipos.files.schema import Stored, also, narrowed, schema_of
from multipos.numerics.arrays import Array, Places, quadratic
from multipos.numerics.quantiles import t_tail
from multipos.numerics.selection import Step, Tested
from multipos.numerics.terms import CONSTANT, Term, evaluate_terms, linear_term
from multipos.regression.region import TERM, Region
from multipos.results import Result, frozen


def combined_variance(X: Array, covariance: Array) -> Array:
    """Return x'Cx (n,) of rows x of X (n, q), at least what its own rounding leaves unknown."""
    sums = np.abs(X) @ np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return np.maximum(quadratic(X, covariance), np.finfo(np.float64).eps * sums**2)


Range = Annotated[tuple[float, float], Entries((ANY_NUMBER, ANY_NUMBER))]
Size = Annotated[float, Maybe(NOT_NEGATIVE, math.nan)]
Branch = Literal["heating", "cooling"]
_Chance = Annotated[float, Maybe(P_VALUE.kind, math.nan)]
_Optional = Annotated[float | None, FIGURE, Stored(optional=True)]
_F = Maybe(FIGURE.kind, math.inf)  # of a term that leaves no residual
_ACTION = Text(("add", "remove"))
_TESTED = narrowed(Tested, action=_ACTION, F=_F, p=P_VALUE)
_STEP = narrowed(
    Step,
    action=_ACTION,
    F=_F,
    p=P_VALUE,
    runner_up=Maybe(_TESTED),
    tested=Listed(_TESTED),
)


class Coefficient(NamedTuple):
    """One term with its coefficient.

    The robust figures are None where rows are independent; `dof` is None without runs. `factors` is
    the term itself, by which a file knows it.
    """

    term: str
    value: float
    u: Size
    t: Figure
    p: Figure
    u_robust: _Optional = None
    t_robust: _Optional = None
    p_robust: _Optional = None
    dof: _Optional = None
    factors: Annotated[Term, TERM] = CONSTANT


class RunnerUp(NamedTuple):
    """The strongest term left outside, and the F that it would have needed."""

    term: str
    F: Annotated[float, _F]
    p: Figure
    F_to_enter: Figure


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

    kind: Annotated[Literal["hac", "cluster", "effective"], Stored("robust")]
    covariance: Annotated[Array, VARIANCES, Stored("covariance_robust")]
    F: Annotated[float, FIGURE, Stored("F_robust")]
    p: Annotated[float, Maybe(P_VALUE.kind, math.nan), Stored("p_robust")]
    dof: Annotated[tuple[float, float], Entries((FIGURE, FIGURE)), Stored("dof_robust")]
    t_dof: Annotated[float, FIGURE, Stored("t_dof_robust")]
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

    runs: Annotated[int, Whole(2)]
    variable: str | None
    centre: float
    covariance: Annotated[Array, VARIANCES]

    _also = tuple(also(name, Stored(after="covariance")) for name in ("dof", "sd", "slope_sd"))

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
    runner_up : RunnerUp or None
    collinear : tuple of str
    robust : Robust or None
    between : Between or None
        What differs from one switch-on to the next, where runs are distinguished; then `covariance`
        has it too.
    """

    range: Range
    n: int
    terms: Annotated[tuple[Term, ...], Stored(nowhere=True)]
    values: Annotated[Array, Stored(nowhere=True)]
    covariance: Annotated[Array, VARIANCES]
    dof: Annotated[tuple[int, int], Entries((Whole(), Whole()))]
    r2: Figure
    adjusted_r2: Figure
    rms: Size
    aicc: Figure
    press: Size
    F: Figure
    F_critical: Figure
    p: _Chance
    limits: Mapping[str, Range]
    path: Annotated[tuple[Step, ...], Listed(_STEP)] = ()
    runner_up: RunnerUp | None = None
    collinear: tuple[str, ...] = ()
    robust: Annotated[Robust | None, Stored(flat=True)] = None
    between: Annotated[
        Between | None, Maybe(schema_of(Between)), Stored("between_runs", optional=True)
    ] = None
    left_out: tuple[LeftOut, ...] = ()
    region: Annotated[Region | None, Stored(optional=True)] = None
    branch: Branch | None = None

    _also = (
        also("coefficients", Listed(schema_of(Coefficient)), Stored("terms", after="n")),
        also("significant", Flag(), Stored(after="F")),
    )

    @classmethod
    def _upgraded(cls, content: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what a file says, with what version 0.1 did not write."""
        return {"left_out": [], **content}

    @classmethod
    def _from_file(
        cls,
        *,
        coefficients: tuple[Coefficient, ...],
        covariance: Array,
        F: float,
        significant: bool,
        robust: Robust | None,
        **values: Any,
    ) -> "Segment":
        """Return the segment that a file describes.

        Raises
        ------
        ValueError
            Coefficients, covariances and limits that do not fit each other.
        """
        found = cls(
            terms=tuple(each.factors for each in coefficients),
            values=np.array([each.value for each in coefficients]),
            covariance=_square(covariance, len(coefficients), "covariance"),
            F=math.inf if significant and F != F else F,
            robust=None if robust is None else _robust(robust, len(coefficients)),
            **values,
        )
        require_covariance(found.covariance, np.array([each.u for each in coefficients]))
        found._require_whole()
        return found

    def _require_whole(self) -> None:
        """Hold a segment's parts to each other."""
        region, between = self.region, self.between
        terms = self.terms if region is None else (*self.terms, *region.terms)
        if not {f.variable for term in terms for f in term.factors}.issubset(self.limits):
            raise ValueError("a segment lacks the limits of a variable of its terms")
        if region is not None and region.terms[: len(self.terms)] != self.terms:
            raise ValueError("the terms of a segment's region do not begin with its own")
        if any(low > high for low, high in (self.range, *self.limits.values())):
            raise ValueError("a segment's range or limits end before they begin")
        if between is not None:
            size = 1 if between.variable is None else 2
            known = size == 1 or linear_term(between.variable or "") in self.terms
            if between.covariance.shape != (size, size) or CONSTANT not in self.terms or not known:
                raise ValueError("'between_runs' of a segment does not fit its terms")
            require_covariance(between.covariance, np.sqrt(np.diag(between.covariance)))

    @property
    def significant(self) -> bool:
        """Whether F passes its critical value."""
        return bool(self.F_critical < self.F)

    @property
    def robust_covariance(self) -> Array:
        """Covariance of the coefficients that holds where rows depend on each other as well."""
        return self.covariance if self.robust is None else self.robust.covariance

    @property
    def robust_dof(self) -> float:
        """Degrees of freedom of `robust_covariance`."""
        return float(self.dof[1]) if self.robust is None else self.robust.t_dof

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
            row = Coefficient(str(term), b, s, t, t_tail(t, self.dof[1]), factors=term)
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
        nu = self.robust_dof
        rest = wide**2 - share
        lost = share**2 / (self.between.runs - 1) + (rest**2 / nu if nu > 0 else 0.0)
        dof = wide**4 / lost if lost > 0.0 else nu
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


def _robust(found: Robust, size: int) -> Robust:
    """Return what a file says of rows that depend on each other, held to its segment's terms."""
    covariance = _square(found.covariance, size, "covariance_robust")
    with np.errstate(invalid="ignore"):
        require_covariance(covariance, np.sqrt(np.diag(covariance)))
    return replace(found, covariance=covariance)


def _square(array: Array, size: int, key: str) -> Array:
    """Return a covariance of the segment's terms."""
    array = array if size else array.reshape(0, 0)
    if array.shape != (size, size):
        raise ValueError(f"'{key}' of a segment has shape {array.shape} for {size} terms")
    return array

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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.files.records import require_covariance
from multipos.numerics.arrays import Array
from multipos.numerics.factors import factor_from_list, factor_to_list
from multipos.numerics.quantiles import t_tail
from multipos.numerics.selection import Step, Tested
from multipos.numerics.subsets import Subset
from multipos.numerics.terms import Term, evaluate_terms
from multipos.results import Result

# What stands beside 'robust' in a file.
_ROBUST = (
    "covariance_robust",
    "F_robust",
    "p_robust",
    "dof_robust",
    "t_dof_robust",
    "n_effective",
    "lag_one",
)


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


def segment_to_dict(s: Segment) -> dict[str, Any]:
    """Return a segment as what JSON can carry."""
    terms = []
    for coefficient, term in zip(s.coefficients, s.terms, strict=True):
        row = {k: v for k, v in coefficient._asdict().items() if v is not None}
        terms.append({**row, "factors": [factor_to_list(f) for f in term.factors]})
    content: dict[str, Any] = {
        "range": s.range,
        "branch": s.branch,
        "n": s.n,
        "terms": terms,
        "covariance": s.covariance,
        "r2": s.r2,
        "adjusted_r2": s.adjusted_r2,
        "rms": s.rms,
        "aicc": s.aicc,
        "press": s.press,
        "F": s.F,
        "F_critical": s.F_critical,
        "p": s.p,
        "dof": s.dof,
        "significant": s.significant,
        "path": [_step_dict(step) for step in s.path],
        "runner_up": None
        if s.runner_up is None
        else {
            "term": s.runner_up.term,
            "F": s.runner_up.F,
            "p": s.runner_up.p,
            "F_to_enter": s.F_to_enter,
        },
        "collinear": s.collinear,
        "limits": dict(s.limits),
    }
    if s.subsets:
        content["subsets"] = [
            {
                "terms": names,
                "rss": b.rss,
                "r2": b.r2,
                "adjusted_r2": b.adjusted_r2,
                "aicc": b.aicc,
                "bic": b.bic,
            }
            for names, b in s.subsets
        ]
    if s.robust is not None:
        r = s.robust
        content |= {
            "F_robust": r.F,
            "p_robust": r.p,
            "dof_robust": r.dof,
            "robust": r.kind,
            "t_dof_robust": r.t_dof,
            "covariance_robust": r.covariance,
            "n_effective": r.n_effective,
            "lag_one": r.lag_one,
        }
    return content


def _step_dict(step: Step) -> dict[str, Any]:
    tested = [found._asdict() for found in step.tested]
    runner_up = None if step.runner_up is None else step.runner_up._asdict()
    return {
        "step": step.step,
        "action": step.action,
        "term": step.term,
        "F": step.F,
        "p": step.p,
        "dof": step.dof,
        "runner_up": runner_up,
        "tested": tested,
    }


def segment_from_dict(c: Mapping[str, Any]) -> Segment:
    """Return the segment that `segment_to_dict` described.

    Raises
    ------
    ValueError
        Coefficients, covariances and limits that do not fit each other.
    """
    terms = tuple(Term(tuple(map(factor_from_list, entry["factors"]))) for entry in c["terms"])
    covariance = _square(c, "covariance")
    require_covariance(covariance, _numbers([entry["u"] for entry in c["terms"]]))
    used = {factor.variable for term in terms for factor in term.factors}
    if not used.issubset(c["limits"]):
        raise ValueError("a segment lacks the limits of a variable of its terms")
    if any(low > high for low, high in (c["range"], *c["limits"].values())):
        raise ValueError("a segment's range or limits end before they begin")
    robust = None
    if "robust" in c:
        missing = [key for key in _ROBUST if key not in c]
        if missing:
            raise ValueError(f"a segment with 'robust' lacks '{missing[0]}'")
        wide = _square(c, "covariance_robust")
        with np.errstate(invalid="ignore"):
            require_covariance(wide, np.sqrt(np.diag(wide)))
        robust = Robust(
            c["robust"],
            wide,
            _number(c["F_robust"]),
            _number(c["p_robust"]),
            tuple(map(_number, c["dof_robust"])),  # type: ignore[arg-type]
            _number(c["t_dof_robust"]),
            c["n_effective"],
            c["lag_one"],
        )
    found = c["runner_up"]
    runner_up = (
        None
        if found is None
        else Tested("add", found["term"], _number(found["F"], np.inf), found["p"])
    )
    return Segment(
        range=tuple(c["range"]),
        branch=c["branch"],
        n=c["n"],
        terms=terms,
        values=np.array([entry["value"] for entry in c["terms"]], dtype=np.float64),
        covariance=covariance,
        dof=tuple(c["dof"]),
        r2=_number(c["r2"]),
        adjusted_r2=_number(c["adjusted_r2"]),
        rms=_number(c["rms"]),
        aicc=_number(c["aicc"]),
        press=_number(c["press"]),
        F=_number(c["F"], np.inf if c["significant"] else np.nan),
        F_critical=_number(c["F_critical"]),
        p=_number(c["p"]),
        limits={name: tuple(pair) for name, pair in c["limits"].items()},
        path=tuple(_step(step) for step in c["path"]),
        runner_up=runner_up,
        F_to_enter=np.nan if found is None else _number(found["F_to_enter"]),
        collinear=tuple(c["collinear"]),
        subsets=tuple(_subset(s, c["terms"]) for s in c.get("subsets", [])),
        robust=robust,
    )


def _subset(c: Mapping[str, Any], terms: Any) -> tuple[tuple[str, ...], Subset]:
    names = tuple(c["terms"])
    figures = (_number(c[key], -np.inf) for key in ("rss", "r2", "adjusted_r2", "aicc", "bic"))
    return names, Subset(tuple(range(len(names))), *figures)


def _step(c: Mapping[str, Any]) -> Step:
    tested = tuple(_tested(found) for found in c["tested"])
    runner_up = None if c["runner_up"] is None else _tested(c["runner_up"])
    F = _number(c["F"], np.inf)
    return Step(c["step"], c["action"], c["term"], F, c["p"], c["dof"], runner_up, tested)


def _tested(c: Mapping[str, Any]) -> Tested:
    return Tested(c["action"], c["term"], _number(c["F"], np.inf), c["p"])


def _number(value: float | None, missing: float = float("nan")) -> float:
    return missing if value is None else float(value)


def _numbers(value: Any) -> Array:
    return np.array(value, dtype=np.float64)


def _square(c: Mapping[str, Any], key: str) -> Array:
    """Return a covariance of the segment's terms, null as NaN."""
    size = len(c["terms"])
    array = _numbers(c[key]).reshape(-1, size) if not size else _numbers(c[key])
    if array.shape != (size, size):
        raise ValueError(f"'{key}' of a segment has shape {array.shape} for {size} terms")
    return array

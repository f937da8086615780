"""Regressions in files: what a regression file holds, key by key, its writing and its reading.

What a regression derives again when it is read (t and p of its coefficients) is not read and not
described here; what every key means is in `docs/reference/formats`.
"""

import os
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    FIGURE,
    INPUT,
    NOT_NEGATIVE,
    P_VALUE,
    POSITIVE,
    SHARE,
    TEXTS,
    VARIANCES,
    AnyOf,
    Entries,
    Fields,
    Flag,
    Kind,
    Listed,
    Maybe,
    Named,
    Text,
    Whole,
    require,
    require_covariance,
)
from multipos.files.trees import read_json
from multipos.numerics.arrays import Array
from multipos.numerics.factors import factor_from_list, factor_to_list
from multipos.numerics.selection import Step, Tested
from multipos.numerics.subsets import Subset
from multipos.numerics.terms import Term
from multipos.regression.hysteresis import BRANCHES
from multipos.regression.result import Regression
from multipos.regression.segment import Robust, Segment
from multipos.results import plain

SCHEMA = "multipos/regression/1"
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

_PAIR = Listed(ANY_NUMBER, 2, 2)
_FUNCTION = AnyOf((ANY_TEXT, Flag()))  # which are known is said in `numerics.factors`
_POWER = Whole(0, 300)  # a power is so many multiplications in every row
_STEP: dict[str, Kind] = {
    "action": Text(("add", "remove")),
    "term": ANY_TEXT,
    "F": FIGURE,
    "p": P_VALUE,
}

REGRESSION = Fields(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
        "input": INPUT,
        "response": ANY_TEXT,
        "variables": TEXTS,
        "candidates": TEXTS,
        "method": Text(("full", "stepwise", "backward", "subsets")),
        "thresholds": Named(ANY_NUMBER),
        "confidence": SHARE,
        "n": Whole(1),
        "dropped": Whole(),
        "segment_variable": Maybe(ANY_TEXT),
        "edges": Listed(ANY_NUMBER),
        "continuous": Flag(),
        "branch_column": Maybe(ANY_TEXT),
        "time": Maybe(ANY_TEXT),
        "rates": Named(POSITIVE),
        "hysteresis": Maybe(
            Fields(
                {
                    "column": ANY_TEXT,
                    "F": FIGURE,
                    "dof": _PAIR,
                    "p": P_VALUE,
                    "significant": Flag(),
                }
            )
        ),
        "cross_validation": Maybe(
            Fields({"blocks": Whole(1), "rms": NOT_NEGATIVE, "r2": ANY_NUMBER})
        ),
        "warnings": TEXTS,
        "segments": Listed(
            Fields(
                {
                    "range": _PAIR,
                    "branch": Maybe(Text(("heating", "cooling"))),
                    "n": Whole(),
                    "terms": Listed(
                        Fields(
                            {
                                "value": ANY_NUMBER,
                                "u": Maybe(NOT_NEGATIVE),
                                "factors": Listed(Entries((ANY_TEXT, _POWER, _FUNCTION))),
                            }
                        )
                    ),
                    "covariance": VARIANCES,
                    "r2": FIGURE,
                    "adjusted_r2": FIGURE,
                    "rms": Maybe(NOT_NEGATIVE),
                    "aicc": FIGURE,
                    "press": Maybe(NOT_NEGATIVE),
                    "F": FIGURE,
                    "F_critical": FIGURE,
                    "p": P_VALUE,
                    "dof": Listed(Whole(), 2, 2),
                    "significant": Flag(),
                    "path": Listed(
                        Fields(
                            {
                                "step": Whole(),
                                **_STEP,
                                "dof": Whole(),
                                "runner_up": Maybe(Fields(_STEP)),
                                "tested": Listed(Fields(_STEP)),
                            }
                        )
                    ),
                    "runner_up": Maybe(
                        Fields({"term": ANY_TEXT, "F": FIGURE, "p": P_VALUE, "F_to_enter": FIGURE})
                    ),
                    "collinear": TEXTS,
                    "limits": Named(_PAIR),
                },
                {
                    "subsets": Listed(
                        Fields(
                            {
                                "terms": TEXTS,
                                "rss": FIGURE,
                                "r2": FIGURE,
                                "adjusted_r2": FIGURE,
                                "aicc": FIGURE,
                                "bic": FIGURE,
                            }
                        )
                    ),
                    "robust": Text(("hac", "cluster", "effective")),
                    "covariance_robust": VARIANCES,
                    "F_robust": FIGURE,
                    "p_robust": P_VALUE,
                    "dof_robust": Listed(FIGURE, 2, 2),
                    "t_dof_robust": FIGURE,
                    "n_effective": ANY_NUMBER,
                    "lag_one": ANY_NUMBER,
                },
            ),
            1,
        ),
    }
)


def regression_dict(r: Regression) -> dict[str, Any]:
    """Return everything that a regression holds as what JSON can carry."""
    content = {
        "schema": SCHEMA,
        "multipos_version": r.version,
        "created": r.created,
        "input": {"file": r.source, "sha256": r.sha256},
        "response": r.response,
        "variables": r.variables,
        "candidates": r.candidates,
        "method": r.method,
        "thresholds": dict(r.thresholds),
        "confidence": r.confidence,
        "n": r.n,
        "dropped": r.dropped,
        "segment_variable": r.segment_variable,
        "edges": r.edges,
        "continuous": r.continuous,
        "branch_column": r.branch_column,
        "time": r.time,
        "rates": dict(r.rates),
        "segments": [segment_to_dict(segment) for segment in r.segments],
        "hysteresis": r.hysteresis,
        "cross_validation": r.cross_validation,
        "warnings": r.warnings,
    }
    result: dict[str, Any] = plain(content)
    return result


def load_regression(path: str | os.PathLike[str]) -> Regression:
    """Read a regression written by `Regression.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no regression does.
    """
    content = read_json(path, SCHEMA)
    require(content, REGRESSION, str(path), "run regress again")
    try:
        regression = _from_dict(content)
        _check_consistency(regression)
    except ValueError as error:
        raise MultiposError(f"{path}: not a regression: {error}; run regress again.") from None
    return regression


def _from_dict(c: Mapping[str, Any]) -> Regression:
    return Regression(
        response=c["response"],
        variables=tuple(c["variables"]),
        candidates=tuple(c["candidates"]),
        method=c["method"],
        segments=tuple(segment_from_dict(s) for s in c["segments"]),
        segment_variable=c["segment_variable"],
        edges=tuple(c["edges"]),
        continuous=c["continuous"],
        branch_column=c["branch_column"],
        time=c["time"],
        rates=c["rates"],
        confidence=c["confidence"],
        n=c["n"],
        dropped=c["dropped"],
        hysteresis=c["hysteresis"],
        cross_validation=c["cross_validation"],
        warnings=tuple(c["warnings"]),
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        created=c["created"],
        version=c["multipos_version"],
        thresholds=c["thresholds"],
    )


def _check_consistency(r: Regression) -> None:
    """Hold segments, edges, branches and rates of a file to each other."""
    edges, branches = r.edges, (None,) if r.branch_column is None else BRANCHES
    if any(low >= high for low, high in pairwise(edges)):
        raise ValueError("its edges do not ascend")
    if edges and r.segment_variable is None:
        raise ValueError("it has edges, but no variable that they are of")
    expected = [branch for branch in branches for _ in range(len(edges) + 1)]
    if [segment.branch for segment in r.segments] != expected:
        raise ValueError("its segments do not fit its edges and branches")
    if r.segment_variable is None and not r.variables:
        raise ValueError("it has no variables")
    if r.rates and (r.time is None or not all(name.endswith("_rate") for name in r.rates)):
        raise ValueError("it has rates, but no time or column that they are of")


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

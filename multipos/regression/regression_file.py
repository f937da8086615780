"""Regressions in files: what a regression file holds, key by key, its writing and its reading.

What a regression derives again when it is read (t and p of its coefficients) is not read and not
described here; what every key means is in `docs/reference/formats`.

Segments in regression files: what a file holds of each, its writing and its reading.
"""

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    FIGURE,
    INPUT,
    NAME,
    NAMES,
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
    require_covariance,
    restore,
)
from multipos.files.trees import read_json
from multipos.finding import FINDINGS, read_findings
from multipos.numerics.arrays import Array
from multipos.numerics.selection import Step, Subset, Tested
from multipos.numerics.terms import CONSTANT, Term, factor_from_list, factor_to_list, linear_term
from multipos.regression.hysteresis import BRANCHES
from multipos.regression.junctions import Junction
from multipos.regression.region import Region
from multipos.regression.regression import Balance, Regression, Regressions
from multipos.regression.segment import Between, Coefficient, LeftOut, Robust, Segment
from multipos.results import plain

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

_FACTORS = Listed(Entries((ANY_TEXT, _POWER, _FUNCTION)))
SEGMENT = Fields(
    {
        "range": _PAIR,
        "branch": Maybe(Text(("heating", "cooling"))),
        "n": Whole(),
        "terms": Listed(
            Fields(
                {
                    "value": ANY_NUMBER,
                    "u": Maybe(NOT_NEGATIVE),
                    "factors": _FACTORS,
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
        "left_out": Listed(Fields({"term": ANY_TEXT, "reason": ANY_TEXT})),
        "region": Fields(
            {
                "terms": Listed(_FACTORS, 1),
                "factor": Listed(Listed(ANY_NUMBER), 1),
                "limit": NOT_NEGATIVE,
            }
        ),
        "robust": Text(("hac", "cluster", "effective")),
        "covariance_robust": VARIANCES,
        "F_robust": FIGURE,
        "p_robust": P_VALUE,
        "dof_robust": Listed(FIGURE, 2, 2),
        "t_dof_robust": FIGURE,
        "n_effective": ANY_NUMBER,
        "lag_one": ANY_NUMBER,
        "between_runs": Maybe(
            Fields(
                {
                    "runs": Whole(2),
                    "variable": Maybe(ANY_TEXT),
                    "centre": ANY_NUMBER,
                    "covariance": VARIANCES,
                }
            )
        ),
    },
)


def segment_to_dict(s: Segment) -> dict[str, Any]:
    """Return a segment as what JSON can carry."""
    content: dict[str, Any] = {
        "range": s.range,
        "branch": s.branch,
        "n": s.n,
        "terms": [_term_dict(*each) for each in zip(s.coefficients, s.terms, strict=True)],
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
        "runner_up": None if s.runner_up is None else _runner_up_dict(s.runner_up, s.F_to_enter),
        "collinear": s.collinear,
        "limits": dict(s.limits),
        "left_out": [one._asdict() for one in s.left_out],
    }
    if s.region is not None:
        content["region"] = _region_dict(s.region)
    if s.subsets:
        content["subsets"] = [_subset_dict(names, found) for names, found in s.subsets]
    if s.robust is not None:
        content |= _robust_dict(s.robust)
    if s.between is not None:
        content["between_runs"] = _between_dict(s.between)
    return content


def _region_dict(region: Region) -> dict[str, Any]:
    terms = [[factor_to_list(f) for f in term.factors] for term in region.terms]
    return {"terms": terms, "factor": region.factor, "limit": region.limit}


def _term_dict(coefficient: Coefficient, term: Term) -> dict[str, Any]:
    row = {k: v for k, v in coefficient._asdict().items() if v is not None}
    return {**row, "factors": [factor_to_list(f) for f in term.factors]}


def _runner_up_dict(found: Tested, to_enter: float) -> dict[str, Any]:
    return {"term": found.term, "F": found.F, "p": found.p, "F_to_enter": to_enter}


def _subset_dict(names: Sequence[str], found: Subset) -> dict[str, Any]:
    return {
        "terms": names,
        "rss": found.rss,
        "r2": found.r2,
        "adjusted_r2": found.adjusted_r2,
        "aicc": found.aicc,
        "bic": found.bic,
    }


def _robust_dict(found: Robust) -> dict[str, Any]:
    return {
        "F_robust": found.F,
        "p_robust": found.p,
        "dof_robust": found.dof,
        "robust": found.kind,
        "t_dof_robust": found.t_dof,
        "covariance_robust": found.covariance,
        "n_effective": found.n_effective,
        "lag_one": found.lag_one,
    }


def _between_dict(found: Between) -> dict[str, Any]:
    return {
        "runs": found.runs,
        "dof": found.runs - 1,
        "sd": found.sd,
        "slope_sd": found.slope_sd,
        "variable": found.variable,
        "centre": found.centre,
        "covariance": found.covariance,
    }


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
    terms = tuple(_term(entry["factors"]) for entry in c["terms"])
    region = _region(c["region"]) if "region" in c else None
    covariance = _square(c, "covariance")
    require_covariance(covariance, _numbers([entry["u"] for entry in c["terms"]]))
    _check_limits(c, terms if region is None else (*terms, *region.terms))
    found = c["runner_up"]
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
        runner_up=None if found is None else _tested({"action": "add", **found}),
        F_to_enter=np.nan if found is None else _number(found["F_to_enter"]),
        collinear=tuple(c["collinear"]),
        subsets=tuple(_subset(s, c["terms"]) for s in c.get("subsets", [])),
        robust=_robust(c) if "robust" in c else None,
        between=_between(c["between_runs"], terms) if c.get("between_runs") else None,
        left_out=tuple(LeftOut(one["term"], one["reason"]) for one in c.get("left_out", ())),
        region=region,
    )


def _term(factors: Sequence[list[Any]]) -> Term:
    return Term(tuple(map(factor_from_list, factors)))


def _region(c: Mapping[str, Any]) -> Region:
    """Return what rows of a fit fill, its rows as long as it has terms."""
    if {len(row) for row in c["factor"]} != {len(c["terms"])} or not all(map(any, c["factor"])):
        raise ValueError("the factor of a segment's region does not fit its terms")
    return Region(tuple(map(_term, c["terms"])), _numbers(c["factor"]), c["limit"])


def _check_limits(c: Mapping[str, Any], terms: tuple[Term, ...]) -> None:
    """Hold a segment's range and the limits of its variables to each other and to its terms."""
    used = {factor.variable for term in terms for factor in term.factors}
    if not used.issubset(c["limits"]):
        raise ValueError("a segment lacks the limits of a variable of its terms")
    if any(low > high for low, high in (c["range"], *c["limits"].values())):
        raise ValueError("a segment's range or limits end before they begin")


def _robust(c: Mapping[str, Any]) -> Robust:
    """Return what a segment says where its rows depend on each other."""
    missing = [key for key in _ROBUST if key not in c]
    if missing:
        raise ValueError(f"a segment with 'robust' lacks '{missing[0]}'")
    covariance = _square(c, "covariance_robust")
    with np.errstate(invalid="ignore"):
        require_covariance(covariance, np.sqrt(np.diag(covariance)))
    return Robust(
        c["robust"],
        covariance,
        _number(c["F_robust"]),
        _number(c["p_robust"]),
        tuple(map(_number, c["dof_robust"])),  # type: ignore[arg-type]
        _number(c["t_dof_robust"]),
        c["n_effective"],
        c["lag_one"],
    )


def _between(c: Mapping[str, Any], terms: tuple[Term, ...]) -> Between:
    """Return what differs between runs, held to the terms that it is about."""
    covariance = _numbers(c["covariance"])
    size = 1 if c["variable"] is None else 2
    known = CONSTANT in terms and (size == 1 or linear_term(c["variable"]) in terms)
    if covariance.shape != (size, size) or not known:
        raise ValueError("'between_runs' of a segment does not fit its terms")
    require_covariance(covariance, np.sqrt(np.diag(covariance)))
    return Between(c["runs"], c["variable"], c["centre"], covariance)


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


SCHEMA = "multipos/regression/1"

REGRESSION = Fields(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
        "input": INPUT,
        "response": NAME,
        "variables": NAMES,
        "candidates": TEXTS,
        "method": Text(("full", "stepwise", "backward", "subsets")),
        "thresholds": Named(ANY_NUMBER),
        "confidence": SHARE,
        "n": Whole(1),
        "dropped": Whole(),
        "segment_variable": Maybe(NAME),
        "edges": Listed(ANY_NUMBER),
        "continuous": Flag(),
        "branch_column": Maybe(NAME),
        "time": Maybe(NAME),
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
        "segments": Listed(SEGMENT, 1),
    },
    {
        "causal": Flag(),
        **FINDINGS,
        "balance": Listed(Named(AnyOf((FIGURE, Flag()))), 1),
        "run": Maybe(NAME),
        "jumps": Listed(
            Fields(
                {
                    "edge": ANY_NUMBER,
                    "branch": Maybe(Text(BRANCHES)),
                    "jump": ANY_NUMBER,
                    "u": Maybe(NOT_NEGATIVE),
                    "U": Maybe(NOT_NEGATIVE),
                }
            )
        ),
    },
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
        "causal": r.causal,
        "run": r.run,
        "jumps": [
            {"edge": j.edge, "branch": j.branch, "jump": j.jump, "u": j.u, "U": j.U}
            for j in r.junctions
        ],
        "segments": [segment_to_dict(segment) for segment in r.segments],
        "hysteresis": r.hysteresis,
        "cross_validation": r.cross_validation,
        "findings": [finding.to_dict() for finding in r.findings],
    }
    if r.balance is not None:
        content["balance"] = r.balance.rows()
    result: dict[str, Any] = plain(content)
    return result


def load_regression(path: str | os.PathLike[str]) -> Regression | Regressions:
    """Read a regression written by `Regression.save`, or those of several responses.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no regression does.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> table = {"T": T, "error": 0.01 + 5e-4 * T + 1e-4 * np.sin(7.0 * T)}
    >>> found = mp.regress(table, response="error", variables="T")
    >>> found.save("model.json")
    >>> mp.load_regression("model.json") == found
    True
    """
    content = read_json(path, SCHEMA)
    if "responses" not in content:
        return _restored(content, str(path))
    responses = content["responses"]
    if not isinstance(responses, dict) or not responses:
        raise MultiposError(
            f"{path}: 'responses' holds no regressions; the file is damaged, run regress again."
        )
    found = {name: _restored(one, f"{path}: {name}") for name, one in responses.items()}
    wrong = [name for name, r in found.items() if r.response != name]
    if wrong:
        raise MultiposError(
            f"{path}: '{wrong[0]}' holds the regression of another response; the file is damaged, "
            "run regress again."
        )
    return Regressions(found)


def _restored(content: Any, where: str) -> Regression:
    return restore(
        content, REGRESSION, _from_dict, where, what="regression", again="run regress again"
    )


def _from_dict(c: Mapping[str, Any]) -> Regression:
    regression = Regression(
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
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        created=c["created"],
        version=c["multipos_version"],
        thresholds=c["thresholds"],
        causal=c.get("causal", False),
        run=c.get("run"),
        findings=read_findings(c),
        junctions=tuple(_junction(entry) for entry in c.get("jumps", ())),
        balance=_balance(c["balance"]) if "balance" in c else None,
    )
    _check_cuts(regression)
    _check_variables(regression)
    return regression


def _junction(c: Mapping[str, Any]) -> Junction:
    u, U = (float("nan") if c[key] is None else c[key] for key in ("u", "U"))
    return Junction(c["edge"], c["branch"], c["jump"], u, U)


def _balance(points: Sequence[Mapping[str, Any]]) -> Balance:
    """Return predictions in thermal balance, held to being of one variable."""
    names = {name for point in points for name in point} - {"predicted", "U", "outside"}
    if len(names) != 1 or any(len(point) != 4 for point in points):
        raise ValueError("'balance' is not of one variable")
    (variable,) = names
    at, predicted, U = (
        np.array([_number(point[name]) for point in points])
        for name in (variable, "predicted", "U")
    )
    return Balance(variable, at, predicted, U, np.array([bool(p["outside"]) for p in points]))


def _check_cuts(r: Regression) -> None:
    """Hold segments, edges and branches of a file to each other."""
    edges, branches = r.edges, (None,) if r.branch_column is None else BRANCHES
    if any(low >= high for low, high in pairwise(edges)):
        raise ValueError("its edges do not ascend")
    if edges and r.segment_variable is None:
        raise ValueError("it has edges, but no variable that they are of")
    expected = [branch for branch in branches for _ in range(len(edges) + 1)]
    if [segment.branch for segment in r.segments] != expected:
        raise ValueError("its segments do not fit its edges and branches")


def _check_variables(r: Regression) -> None:
    """Hold a file to having what its segments and its rates are of."""
    if r.segment_variable is None and not r.variables:
        raise ValueError("it has no variables")
    if r.rates and (r.time is None or not all(name.endswith("_rate") for name in r.rates)):
        raise ValueError("it has rates, but no time or column that they are of")

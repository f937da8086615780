"""Regressions in files: what a regression file holds, key by key, its writing and its reading.

What a regression derives again when it is read (t and p of its coefficients) is not read and not
described here; what every key means is in `docs/reference/formats`.
"""

import math
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
    Record,
    Text,
    Whole,
    require_covariance,
    restore,
)
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json
from multipos.finding import FINDINGS, findings_upgraded, read_findings
from multipos.numerics.arrays import Array
from multipos.numerics.factors import factor_from_list, factor_to_list
from multipos.numerics.selection import Step, Tested
from multipos.numerics.terms import CONSTANT, Term, linear_term
from multipos.regression.branches import BRANCHES
from multipos.regression.junctions import Junction
from multipos.regression.region import Region
from multipos.regression.regression import Balance, Regression, Regressions
from multipos.regression.segment import Between, Coefficient, LeftOut, Robust, Segment
from multipos.results import plain_dict

_PAIR = Listed(ANY_NUMBER, 2, 2)
_FUNCTION = AnyOf((ANY_TEXT, Flag()))  # which are known is said in `numerics.factors`
_POWER = Whole(0, 300)  # a power is so many multiplications in every row
_F = Maybe(FIGURE.kind, math.inf)  # of a term that leaves no residual

_TESTED: dict[str, Kind] = {"action": Text(("add", "remove")), "F": _F, "p": P_VALUE}
_ANOTHER = Record.of(Tested, _TESTED)
_STEP = Record.of(Step, {**_TESTED, "runner_up": Maybe(_ANOTHER), "tested": Listed(_ANOTHER)})
_FACTORS = Listed(Entries((ANY_TEXT, _POWER, _FUNCTION)))
_REGION = {
    "terms": Listed(_FACTORS, 1),
    "factor": Listed(Listed(ANY_NUMBER), 1),
    "limit": NOT_NEGATIVE,
}
_ROBUST = Record(
    {
        "covariance_robust": VARIANCES,
        "F_robust": FIGURE,
        "p_robust": Maybe(P_VALUE.kind, math.nan),
        "dof_robust": Listed(FIGURE, 2, 2),
        "robust": Text(("hac", "cluster", "effective")),
        "t_dof_robust": FIGURE,
        "n_effective": ANY_NUMBER,
        "lag_one": ANY_NUMBER,
    },
    make=Robust,
    names={
        "robust": "kind",
        **{f"{name}_robust": name for name in ("F", "p", "dof", "t_dof", "covariance")},
    },
)
_BETWEEN = Record.of(
    Between, {"runs": Whole(2), "covariance": VARIANCES}, derived=("dof", "sd", "slope_sd")
)
_LEFT_OUT = Record.of(LeftOut)

# What a segment has under its own name; the rest hangs together.
_FIGURES = Record(
    {
        "range": _PAIR,
        "branch": Maybe(Text(("heating", "cooling"))),
        "n": Whole(),
        "r2": FIGURE,
        "adjusted_r2": FIGURE,
        "rms": Maybe(NOT_NEGATIVE, math.nan),
        "aicc": FIGURE,
        "press": Maybe(NOT_NEGATIVE, math.nan),
        "F_critical": FIGURE,
        "p": Maybe(P_VALUE.kind, math.nan),
        "dof": Listed(Whole(), 2, 2),
        "path": Listed(_STEP),
        "collinear": TEXTS,
        "limits": Named(_PAIR),
    },
    {"left_out": Listed(_LEFT_OUT)},
)
SEGMENT = Fields(
    {
        **_FIGURES.needed,
        "terms": Listed(
            Fields({"value": ANY_NUMBER, "u": Maybe(NOT_NEGATIVE), "factors": _FACTORS}),
        ),
        "covariance": VARIANCES,
        "F": FIGURE,
        "significant": Flag(),
        "runner_up": Maybe(
            Fields({"term": ANY_TEXT, "F": FIGURE, "p": P_VALUE, "F_to_enter": FIGURE})
        ),
    },
    {
        **_FIGURES.optional,
        **_ROBUST.needed,
        "region": Fields(_REGION),
        "between_runs": Maybe(_BETWEEN),
    },
)


def segment_to_dict(s: Segment) -> dict[str, Any]:
    """Return a segment as what JSON can carry."""
    content: dict[str, Any] = {
        **_FIGURES.write(s),
        "terms": [_term_dict(*each) for each in zip(s.coefficients, s.terms, strict=True)],
        "covariance": s.covariance,
        "F": s.F,
        "significant": s.significant,
        "runner_up": None
        if s.runner_up is None
        else {**_ANOTHER.write(s.runner_up), "F_to_enter": s.F_to_enter},
    }
    if s.region is not None:
        terms = [[factor_to_list(f) for f in term.factors] for term in s.region.terms]
        content["region"] = {"terms": terms, "factor": s.region.factor, "limit": s.region.limit}
    if s.robust is not None:
        content |= _ROBUST.write(s.robust)
    if s.between is not None:
        content["between_runs"] = _BETWEEN.write(s.between)
    return content


def _term_dict(coefficient: Coefficient, term: Term) -> dict[str, Any]:
    row = {k: v for k, v in coefficient._asdict().items() if v is not None}
    return {**row, "factors": [factor_to_list(f) for f in term.factors]}


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
    if region is not None and region.terms[: len(terms)] != terms:
        raise ValueError("the terms of a segment's region do not begin with its own")
    found = c["runner_up"]
    return Segment(
        **_FIGURES.read(c),
        terms=terms,
        values=np.array([entry["value"] for entry in c["terms"]], dtype=np.float64),
        covariance=covariance,
        F=(_F if c["significant"] else FIGURE).read(c["F"]),
        runner_up=None if found is None else _ANOTHER.read({"action": "add", **found}),
        F_to_enter=math.nan if found is None else FIGURE.read(found["F_to_enter"]),
        robust=_robust(c) if "robust" in c else None,
        between=_between(c["between_runs"], terms) if c.get("between_runs") else None,
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
    missing = [key for key in _ROBUST.needed if key not in c]
    if missing:
        raise ValueError(f"a segment with 'robust' lacks '{missing[0]}'")
    covariance = _square(c, "covariance_robust")
    with np.errstate(invalid="ignore"):
        require_covariance(covariance, np.sqrt(np.diag(covariance)))
    found: Robust = _ROBUST.read({**c, "covariance_robust": covariance})
    return found


def _between(c: Mapping[str, Any], terms: tuple[Term, ...]) -> Between:
    """Return what differs between runs, held to the terms that it is about."""
    found: Between = _BETWEEN.read(c)
    size = 1 if found.variable is None else 2
    known = CONSTANT in terms and (size == 1 or linear_term(found.variable or "") in terms)
    if found.covariance.shape != (size, size) or not known:
        raise ValueError("'between_runs' of a segment does not fit its terms")
    require_covariance(found.covariance, np.sqrt(np.diag(found.covariance)))
    return found


def _numbers(value: Any) -> Array:
    return np.array(value, dtype=np.float64)


def _square(c: Mapping[str, Any], key: str) -> Array:
    """Return a covariance of the segment's terms, null as NaN."""
    size = len(c["terms"])
    array = _numbers(c[key]) if size else _numbers(c[key]).reshape(0, 0)
    if array.shape != (size, size):
        raise ValueError(f"'{key}' of a segment has shape {array.shape} for {size} terms")
    return array


SCHEMA = "multipos/regression/1"

_SIZE = Maybe(NOT_NEGATIVE, math.nan)
_JUNCTION = Record.of(Junction, {"branch": Maybe(Text(BRANCHES)), "u": _SIZE, "U": _SIZE})
# What a regression has under its own name, or another; the rest hangs together.
_WHOLE = Record(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
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
    },
    {"causal": Flag(), "run": Maybe(NAME), "jumps": Listed(_JUNCTION)},
    names={"multipos_version": "version", "jumps": "junctions"},
)
REGRESSION = Fields(
    {**_WHOLE.needed, "input": INPUT, "segments": Listed(SEGMENT, 1)},
    {**_WHOLE.optional, **FINDINGS, "balance": Listed(Named(AnyOf((FIGURE, Flag()))), 1)},
)


def regression_dict(r: Regression) -> dict[str, Any]:
    """Return everything that a regression holds as what JSON can carry."""
    content = {
        "schema": SCHEMA,
        "input": {"file": r.source, "sha256": r.sha256},
        **_WHOLE.write(r),
        "segments": [segment_to_dict(segment) for segment in r.segments],
        "findings": [finding.to_dict() for finding in r.findings],
    }
    if r.balance is not None:
        content["balance"] = r.balance.rows()
    return plain_dict(content)


def load_regression(path: StrPath) -> Regression | Regressions:
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
        findings_upgraded(content),
        REGRESSION,
        _from_dict,
        where,
        what="regression",
        again="run regress again",
    )


def _from_dict(c: Mapping[str, Any]) -> Regression:
    regression = Regression(
        **_WHOLE.read(c),
        segments=tuple(segment_from_dict(s) for s in c["segments"]),
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        findings=read_findings(c),
        balance=_balance(c["balance"]) if "balance" in c else None,
    )
    _check_cuts(regression)
    _check_variables(regression)
    return regression


def _balance(points: Sequence[Mapping[str, Any]]) -> Balance:
    """Return predictions in thermal balance, held to being of one variable."""
    names = {name for point in points for name in point} - {"predicted", "U", "outside"}
    if len(names) != 1 or any(len(point) != 4 for point in points):
        raise ValueError("'balance' is not of one variable")
    (variable,) = names
    at, predicted, U = (
        np.array([FIGURE.read(point[name]) for point in points])
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

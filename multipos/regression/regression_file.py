"""Regressions in files: what a regression file holds, key by key, its writing and its reading.

What a regression derives again when it is read (t and p of its coefficients) is not read and not
described here; what every key means is in `docs/reference/formats`.
"""

import os
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

from multipos.doubt import DOUBTS, read_doubt
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
    Fields,
    Flag,
    Listed,
    Maybe,
    Named,
    Text,
    Whole,
    restore,
)
from multipos.files.trees import read_json
from multipos.regression.hysteresis import BRANCHES
from multipos.regression.junctions import Junction
from multipos.regression.result import Regression
from multipos.regression.segment_file import SEGMENT, segment_from_dict, segment_to_dict
from multipos.regression.several import Regressions
from multipos.results import plain

SCHEMA = "multipos/regression/1"
_PAIR = Listed(ANY_NUMBER, 2, 2)

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
        "warnings": TEXTS,
        "segments": Listed(SEGMENT, 1),
    },
    {
        "causal": Flag(),
        "doubts": DOUBTS,
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
        "doubts": [doubt.to_dict() for doubt in r.doubts],
        "warnings": r.warnings,
    }
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
        warnings=tuple(c["warnings"]),
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        created=c["created"],
        version=c["multipos_version"],
        thresholds=c["thresholds"],
        causal=c.get("causal", False),
        run=c.get("run"),
        doubts=tuple(map(read_doubt, c.get("doubts", ()))),
        junctions=tuple(_junction(entry) for entry in c.get("jumps", ())),
    )
    _check_cuts(regression)
    _check_variables(regression)
    return regression


def _junction(c: Mapping[str, Any]) -> Junction:
    u, U = (float("nan") if c[key] is None else c[key] for key in ("u", "U"))
    return Junction(c["edge"], c["branch"], c["jump"], u, U)


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

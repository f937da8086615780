"""Checks in files: what the file of a check holds, key by key, its writing and its reading.

What a check derives again when it is read (its summary and verdicts) is not read and not described
here; what every key means is in `docs/reference/check-and-tumble`.
"""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.doubt import DOUBTS, read_doubt
from multipos.errors import MultiposError
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    AXIS,
    FIGURE,
    INPUT,
    NOT_NEGATIVE,
    P_VALUE,
    POSITIVE,
    SHARE,
    TEXTS,
    AnyOf,
    Entries,
    Fields,
    Flag,
    Listed,
    Maybe,
    Named,
    Text,
    restore,
)
from multipos.files.trees import read_json
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.verification.agreement import Agreement
from multipos.verification.verdicts import Check, judge_errors, worst

SCHEMA = "multipos/check/1"
_BY_AXIS = ("reference", "before", "after", "u", "U", "U_family", "counted", "by_axis")
_ERRORS = Named(ANY_NUMBER)
_BY_AXIS_OR_NONE = Named(Maybe(ANY_NUMBER))
_UNCERTAINTIES = Named(Maybe(NOT_NEGATIVE))
_LINEARITY = Fields({"linearity_percent": Maybe(NOT_NEGATIVE)})

CHECK = Fields(
    {
        "input": INPUT,
        "calibration": ANY_TEXT,
        "quantity": Text(("force", "tilt")),
        "unit": Text(("g", "deg")),
        "limit": Maybe(POSITIVE),
        "confidence": SHARE,
        "nominal": Fields({"bias": ANY_NUMBER, "scale": ANY_NUMBER}),
        "axes": Listed(AXIS, 1, len(COMPONENTS)),
        "positions": Listed(
            Fields(
                {
                    "position": ANY_TEXT,
                    "reference": _ERRORS,
                    "before": _BY_AXIS_OR_NONE,
                    "after": _BY_AXIS_OR_NONE,
                    "u": _UNCERTAINTIES,
                    "U": _UNCERTAINTIES,
                    "counted": Named(Flag()),
                },
                {"U_family": _UNCERTAINTIES},
            ),
            1,
        ),
        "by_axis": Named(Fields({"before": _LINEARITY, "after": _LINEARITY})),
        "warnings": TEXTS,
    },
    {
        "consistency": Maybe(
            Fields(
                {
                    "statistic": FIGURE,
                    "dof": AnyOf((Maybe(NOT_NEGATIVE), Entries((POSITIVE, Maybe(POSITIVE))))),
                    "p": P_VALUE,
                    "test": ANY_TEXT,
                }
            )
        ),
        "doubts": DOUBTS,
    },
)


def check_dict(c: Check) -> dict[str, Any]:
    """Return everything that a check holds, as JSON carries it."""
    rows = []
    for row, label in enumerate(c.positions):
        entry: dict[str, Any] = {"position": label}
        for name in ("reference", "before", "after", "u", "U", "En"):
            entry[name] = dict(zip(c.axes, getattr(c, name)[row].tolist(), strict=True))
        if c.U_family is not None:
            entry["U_family"] = dict(zip(c.axes, c.U_family[row].tolist(), strict=True))
        entry["verdict"] = worst(c.verdicts[row])
        entry["counted"] = dict(zip(c.axes, c.counted[row].tolist(), strict=True))
        rows.append(entry)
    return {
        "schema": SCHEMA,
        "input": {"file": c.source, "sha256": c.sha256},
        "calibration": c.calibration,
        "quantity": c.quantity,
        "against": c.against,
        "unit": c.unit or None,
        "limit": c.limit,
        "confidence": c.confidence,
        "nominal": None if c.bias is None else {"bias": c.bias, "scale": c.scale},
        "axes": c.axes,
        "positions": rows,
        **c.summary(),
        "run_verdict": c.run_verdict,
        "consistency": None if c.consistency is None else c.consistency.to_dict(),
        "by_axis": {axis: c.summary(axis) for axis in c.axes},
        "by_segment": {
            name: {"rows": int(rows.sum()), **c.summary(segment=name)}
            for name, rows in c.segments.items()
        },
        "doubts": [doubt.to_dict() for doubt in c.doubts],
        "warnings": c.warnings,
    }


def load_check(path: str | os.PathLike[str]) -> Check:
    """Read a check of a calibration written by `Check.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema or of a regression, or holds what no
        check does.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> found = mp.check(cal, mp.simulate(cal, "faces-6", seed=1))
    >>> found.save("check.json")
    >>> mp.load_check("check.json") == found
    True
    """
    content = read_json(path, SCHEMA)
    if content.get("against") is not None:
        raise MultiposError(
            f"{path}: the check of a regression; a report of a calibration needs a check of it."
        )
    return restore(content, CHECK, _from_dict, str(path), what="check", again="run check again")


def _from_dict(c: Mapping[str, Any]) -> Check:
    axes = tuple(c["axes"])
    for row in [*c["positions"], {"by_axis": c["by_axis"]}]:
        for key, entry in row.items():
            if key in _BY_AXIS and set(entry) != set(axes):
                raise ValueError(f"'{key}' is of {', '.join(entry)}, not of its axes")

    def column(name: str) -> Array:
        rows = [[row[name][axis] for axis in axes] for row in c["positions"]]
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(axes))

    after, U, counted = column("after"), column("U"), column("counted").astype(bool)
    linearity = {
        when: np.array(
            [c["by_axis"][axis][when]["linearity_percent"] for axis in axes], dtype=np.float64
        )
        for when in ("before", "after")
    }
    return Check(
        quantity=c["quantity"],
        unit=c["unit"],
        axes=axes,
        positions=tuple(row["position"] for row in c["positions"]),
        reference=column("reference"),
        before=column("before"),
        after=after,
        u=column("u"),
        U=U,
        limit=c["limit"],
        verdicts=judge_errors(after, U, c["limit"], counted),
        counted=counted,
        linearity_percent=linearity,
        bias=c["nominal"]["bias"],
        scale=c["nominal"]["scale"],
        confidence=c["confidence"],
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        warnings=tuple(c["warnings"]),
        calibration=c["calibration"],
        U_family=column("U_family") if all("U_family" in row for row in c["positions"]) else None,
        consistency=_agreement(c.get("consistency")),
        doubts=tuple(map(read_doubt, c.get("doubts", ()))),
    )


def _agreement(c: Mapping[str, Any] | None) -> Agreement | None:
    """Return what a file says of the run as a whole; an unlimited dof is null there."""
    if c is None:
        return None
    statistic, p = (math.nan if c[key] is None else float(c[key]) for key in ("statistic", "p"))
    dof: float | list[float] = math.nan
    if isinstance(c["dof"], list):
        dof = [math.inf if value is None else float(value) for value in c["dof"]]
    elif c["dof"] is not None:
        dof = float(c["dof"])
    return Agreement(statistic, dof, p, c["test"])

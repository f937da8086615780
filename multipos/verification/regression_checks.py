"""Check of a regression: its response on an independent run, before and after correction.

The response is an error that the run knows, and what the regression leaves of it is

    e = response − predicted,    u² = x' C x + rms²,    U = k u,                            (1)

with u of eq. (1) of `multipos.compensation.correction`, that is of predicting one new row, and k
from Student's t. A column that is corrected by the same prediction (``apply --correct``) has the
same error left. Rows outside what the regression was fitted to are not counted, because it says
nothing there.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.compensation.correction import (
    correct,
    range_column,
    read_predictors,
    read_runs,
)
from multipos.errors import MultiposError
from multipos.files.tables import Source, read_table
from multipos.finding import Finding, in_order
from multipos.numerics.quantiles import coverage_factor
from multipos.regression.prediction import place_rows
from multipos.regression.regression import Regression, Regressions, format_span
from multipos.verification.agreement import no_agreement
from multipos.verification.verdicts import (
    Check,
    family_confidence,
    judge_errors,
    require_limit,
)


def check_regression(
    regression: Regression, data: Source, *, limit_g: float | None = None
) -> Check:
    """Return the errors of a run before and after correction, row by row and by segment.

    Parameters
    ----------
    regression : Regression
    data : path, mapping of columns, or data frame
        An independent run with the response and the columns that the model uses.
    limit_g : float, optional
        Largest error allowed, for a response in g.

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or every row is outside what was fitted.
    UsageError
        The limit is not above 0.
    """
    if limit_g is not None:
        require_limit("--limit-g", limit_g)
    r = regression
    table = read_table(data, what="run")
    if r.response not in table:
        raise MultiposError(
            f"{table.source}: no column '{r.response}', the response; a check needs to know the "
            f"error of every row. The columns are {', '.join(table.columns)}."
        )
    found = correct(r, table, uncertainty=True)
    outside = np.asarray(found["outside"]).astype(bool)
    if outside.all():
        raise MultiposError(
            f"{table.source}: all {table.rows} rows are outside what the regression was fitted to; "
            "a check needs a run within it."
        )
    run = read_runs(r, table)
    columns = read_predictors(r, table, run)
    place = place_rows(r, columns, table.rows, run)
    against, reference = range_column(r, table, columns)
    after, u, U = (
        np.asarray(found[name])[:, None] for name in ("corrected", "u_corrected", "U_corrected")
    )
    counted = ~outside[:, None]
    nothing = np.array([np.nan])
    text = (
        f"{int(outside.sum())} of {table.rows} rows are outside what the regression was fitted to "
        "and are not counted"
    )
    return Check(
        quantity=r.response,
        unit="" if limit_g is None else "g",
        axes=(r.response,),
        positions=tuple(str(row + 1) for row in range(table.rows)),
        reference=reference[:, None],
        before=table.number(r.response)[:, None],
        after=after,
        u=u,
        U=U,
        U_family=None if limit_g is None else U * _family_factor(r, int(counted.sum())),
        limit=limit_g,
        verdicts=judge_errors(after, U, limit_g, counted),
        counted=counted,
        linearity_percent={"before": nothing, "after": nothing},
        bias=None,
        scale=None,
        confidence=r.confidence,
        source=table.source,
        sha256=table.sha256,
        findings=(Finding("outside", "warning", text),) if outside.any() else (),
        calibration=r.created,
        against=against,
        segments=_rows_by_segment(r, place),
        consistency=no_agreement("rows of a regression follow each other and are not independent"),
    )


def check_regressions(
    regressions: Regressions, data: Source, *, limit_g: float | None = None
) -> Check:
    """Return the errors of a run before and after, a column for each response.

    Parameters
    ----------
    regressions : Regressions
    data, limit_g
        As of `check_regression`.

    Raises
    ------
    MultiposError, UsageError
        As of `check_regression`.
    """
    table = read_table(data, what="run")
    found = [check_regression(r, table, limit_g=limit_g) for r in regressions.values()]
    first = found[0]
    same = all(one.segments == first.segments for one in found)
    nothing = np.full(len(found), np.nan)
    family = None
    if limit_g is not None:
        errors = sum(int(one.counted.sum()) for one in found)
        pairs = zip(regressions.values(), found, strict=True)
        family = np.hstack([one.U * _family_factor(r, errors) for r, one in pairs])

    def stacked(name: str) -> Any:
        return np.hstack([getattr(one, name) for one in found])

    return replace(
        first,
        quantity=", ".join(regressions),
        axes=tuple(regressions),
        reference=stacked("reference"),
        before=stacked("before"),
        after=stacked("after"),
        u=stacked("u"),
        U=stacked("U"),
        U_family=family,
        verdicts=stacked("verdicts"),
        counted=stacked("counted"),
        linearity_percent={"before": nothing, "after": nothing},
        findings=in_order(each for one in found for each in one.findings),
        segments=first.segments if same else {},
    )


def _family_factor(r: Regression, errors: int) -> float:
    """Return by how much U is larger for so many rows together, by the fewest dof of a segment."""
    nu = min(float(segment.dof[1]) for segment in r.segments)
    sharper = coverage_factor(family_confidence(r.confidence, errors), nu)
    return sharper / coverage_factor(r.confidence, nu)


def _rows_by_segment(r: Regression, place: NDArray[np.intp]) -> dict[str, NDArray[np.bool_]]:
    return {
        f"{number}: {format_span(r.range_variable, s.range, s.branch)}": place == number - 1
        for number, s in enumerate(r.segments, start=1)
    }

"""The front door of regression: from a table to a tested piecewise model.

`regress` reads the columns, forms rates and the list of terms, cuts the rows into segments and
branches, has every segment fitted (`multipos.regression.piecewise`), and says what a reader should
know before believing it (`multipos.regression.cautions`).

Where a rate is named, heating and cooling are modelled apart if they differ.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from multipos import __version__
from multipos.errors import UsageError
from multipos.files.characters import visible
from multipos.files.lists import Names, split_names, split_numbers
from multipos.files.moments import now
from multipos.files.tables import Source, read_table
from multipos.numerics.quantiles import check_confidence
from multipos.numerics.selection import thresholds
from multipos.numerics.subsets import CRITERIA, SubsetCriterion
from multipos.numerics.terms import largest_value
from multipos.regression.candidates import read_candidates
from multipos.regression.cautions import (
    doubt_segments,
    jumps_said,
    order_said,
    state_cautions,
)
from multipos.regression.cutting import Cut, fit_cut, settle_edges
from multipos.regression.hysteresis import compare_branches
from multipos.regression.junctions import Junction, find_junctions
from multipos.regression.observations import (
    Observations,
    check_columns,
    read_observations,
)
from multipos.regression.piecewise import METHODS, Plan
from multipos.regression.result import Regression
from multipos.regression.robust import ROBUST, RowDependence
from multipos.regression.segment import Segment
from multipos.regression.several import Regressions
from multipos.regression.validation import check_by_blocks


def regress(
    data: Source,
    *,
    response: Names,
    variables: Names | None = None,
    degree: int | None = None,
    terms: str | None = None,
    stepwise: bool = False,
    backward: bool = False,
    subsets: bool = False,
    enter: float | None = None,
    remove: float | None = None,
    f_enter: float | None = None,
    f_remove: float | None = None,
    criterion: SubsetCriterion = "aicc",
    hierarchy: bool = False,
    segment: str | None = None,
    min_rows: int | None = None,
    continuous: bool = False,
    branches: str | None = None,
    time: str | None = None,
    rate_window: float | None = None,
    causal: bool = False,
    run: str | None = None,
    robust: RowDependence = "hac",
    cluster: str | None = None,
    cross_validate: int | None = None,
    confidence: float = 0.95,
    drop_missing: bool = False,
) -> Regression | Regressions:
    """Describe one column by others, in segments, with terms that the data support.

    Parameters
    ----------
    data : path, mapping of columns, or data frame
    response : names
        The column that is described; several, one for each axis, are described by the same
        variables, each by itself.
    variables : names, optional
        Those the terms are made of; a name that ends `_rate` and is no column is formed from
        the column without that ending. Not needed beside `terms`.
    degree : int, optional
        All products of variables up to this degree; 1 by default.
    terms : str, optional
        A formula instead, such as '1 + A + A^2 + A*B'; without 1 there is no intercept.
    stepwise, backward, subsets : bool
        Choose terms forward with removal, backward, or by the criterion over all subsets.
    enter, remove, f_enter, f_remove : float, optional
        Thresholds as p (.05 and .10) or as F.
    criterion : str
        'aicc', 'bic' or 'adjusted_r2', for subsets.
    hierarchy : bool
        T before T².
    segment : str, optional
        'VARIABLE:EDGE,EDGE' or 'VARIABLE:auto'.
    min_rows : int, optional
        Fewest rows of a segment that is found; twice the terms by default.
    continuous : bool
        No jump at the edges.
    branches : str, optional
        A rate; heating and cooling are modelled apart where they differ.
    time : str, optional
        The time column; `time` where there is one.
    rate_window : float, optional
        Width of the smoothed derivative, in the unit of time.
    causal : bool
        Rates from the rows up to each, by the recursion that the exported C runs.
    run : str, optional
        A column that tells one switch-on from another; time may start again in each.
    robust : str
        'hac' or 'effective', for F_robust where rows are correlated in time.
    cluster : str, optional
        A column whose equal values mark rows that belong together.
    cross_validate : int, optional
        Check by leaving out this many blocks of time in turn.
    confidence : float
        Of the critical F.
    drop_missing : bool
        Leave out rows with an empty cell.

    Returns
    -------
    Regression, or Regressions of several responses

    Raises
    ------
    MultiposError
        The data are at fault; the message says what, where, and the way out.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> table = {"T": T, "error": 0.01 + 5e-4 * T + 1e-4 * np.sin(7.0 * T)}
    >>> found = mp.regress(table, response="error", variables="T")
    >>> (segment,) = found.segments
    >>> [str(term) for term in segment.terms], segment.significant
    (['1', 'T'], True)
    >>> print(f"rms {1e6 * segment.rms:.0f}e-6")
    rms 72e-6
    """
    arguments = dict(locals())  # all arguments as they are, for each of several responses
    responses = split_names(response, "--response")
    if len(responses) > 1:
        return _regress_each(responses, arguments)
    (response,) = responses
    method = _method(stepwise, backward, subsets)
    limits = thresholds(enter, remove, f_enter, f_remove)
    names, candidates = read_candidates(response, variables, degree, terms)
    _check_options(
        method, criterion, robust, confidence, cross_validate, response, branches, cluster, run
    )
    plan = Plan(candidates, names, method, limits, criterion, hierarchy, confidence, robust)
    if run is not None and not plan.constant:
        raise UsageError("--run is about the constant; add 1 to --terms, or leave out --run.")
    wanted, given = _parse_segment(segment, continuous)
    table = read_table(data, what="data")
    read = read_observations(
        table,
        response,
        [*names, *(name for name in (wanted, branches) if name)],
        time=time,
        rate_window=rate_window,
        causal=causal,
        cluster=cluster,
        run=run,
        drop_missing=drop_missing,
        largest={name: largest_value(candidates, name) for name in names},
    )
    source, sha256 = table.source, table.sha256
    del table  # whose text may be most of what is in memory
    check_columns(source, read.data, response, names, constant=plan.constant)
    edges, said = settle_edges(plan, read.data, wanted, given, min_rows)
    cut = Cut(wanted, edges, continuous, branches)
    result = _describe(plan, response, read, cut, cross_validate)
    return replace(
        result,
        causal=causal,
        run=run,
        source=visible(source) if sha256 else None,
        sha256=sha256,
        warnings=(
            *(doubt.text for doubt in result.doubts),
            *read.notes,
            *order_said(read, result),
            *said,
            *result.warnings,
        ),
    )


def _regress_each(responses: Sequence[str], given: Mapping[str, Any]) -> Regressions:
    """Describe several columns by the same arguments, each by itself."""
    if len(set(responses)) < len(responses):
        raise UsageError(f"--response names a column twice: {','.join(responses)}.")
    table = read_table(given["data"], what="data")
    found = {}
    for name in responses:
        one = regress(**{**given, "data": table, "response": (name,)})
        assert isinstance(one, Regression)  # of one name
        found[name] = one
    return Regressions(found)


def _describe(
    plan: Plan, response: str, read: Observations, cut: Cut, blocks: int | None
) -> Regression:
    """Return the fitted segments with what tells how far to believe them."""
    hysteresis = None
    if cut.branch_column is not None:
        hysteresis = compare_branches(
            plan.terms, read.data, cut.branch_column, cut.variable, cut.edges, plan.confidence
        )
        if not hysteresis["significant"]:
            cut = replace(cut, branch_column=None)
    segments = fit_cut(plan, read.data, cut)
    validation = None
    if blocks is not None:
        validation = check_by_blocks(
            read.data,
            blocks,
            lambda some: _assemble(plan, response, fit_cut(plan, some, cut), cut),
        )
    junctions: tuple[Junction, ...] = ()
    if not cut.continuous:
        junctions = find_junctions(
            segments, read.data, cut.variable, cut.edges, cut.branch_column, plan.confidence
        )
    return replace(
        _assemble(plan, response, segments, cut),
        junctions=junctions,
        time=read.time,
        rates=read.rates,
        n=len(read.data),
        dropped=read.dropped,
        hysteresis=hysteresis,
        cross_validation=validation,
        doubts=doubt_segments(segments),
        warnings=(
            *state_cautions(plan, segments, hysteresis, validation),
            *jumps_said(cut.variable, junctions),
        ),
    )


def _assemble(plan: Plan, response: str, segments: Sequence[Segment], cut: Cut) -> Regression:
    """Return the result of fitted segments, without what concerns the whole table."""
    used = plan.limits.__dict__ if plan.method in ("stepwise", "backward") else {}
    return Regression(
        response=response,
        variables=plan.variables,
        candidates=tuple(map(str, plan.terms)),
        method=plan.method,
        segments=tuple(segments),
        segment_variable=cut.variable,
        edges=cut.edges,
        continuous=cut.continuous,
        branch_column=cut.branch_column,
        time=None,
        rates={},
        confidence=plan.confidence,
        n=0,
        dropped=0,
        hysteresis=None,
        cross_validation=None,
        warnings=(),
        source=None,
        sha256=None,
        created=now(),
        version=__version__,
        thresholds={name: value for name, value in used.items() if value is not None},
    )


# --- options


def _method(stepwise: bool, backward: bool, subsets: bool) -> str:
    asked = [
        name for name, on in zip(METHODS[1:], (stepwise, backward, subsets), strict=True) if on
    ]
    if len(asked) > 1:
        raise UsageError(f"--{asked[0]} and --{asked[1]} are two ways to choose terms; give one.")
    return asked[0] if asked else "full"


def _check_options(
    method: str,
    criterion: SubsetCriterion,
    robust: RowDependence,
    confidence: float,
    blocks: int | None,
    response: str,
    branches: str | None,
    cluster: str | None,
    run: str | None,
) -> None:
    _check_columns_named(response, branches, cluster, run)
    if criterion not in CRITERIA:
        raise UsageError(f"--criterion takes {', '.join(CRITERIA)}, got '{criterion}'.")
    if criterion != CRITERIA[0] and method != "subsets":
        raise UsageError("--criterion chooses among --subsets; give both.")
    if robust not in ROBUST:
        raise UsageError(f"--robust takes {', '.join(ROBUST)}, got '{robust}'.")
    check_confidence(confidence)
    if blocks is not None and blocks < 2:
        raise UsageError(f"--cross-validate takes 2 blocks or more, got {blocks}.")


def _check_columns_named(
    response: str, branches: str | None, cluster: str | None, run: str | None
) -> None:
    if cluster is not None and run is not None:
        raise UsageError(
            "--cluster changes the tests alone, --run what is uncertain too; give one of them."
        )
    for option, name in (("--branches", branches), ("--cluster", cluster), ("--run", run)):
        if name == response:
            raise UsageError(f"{option} names the response '{response}'; give another column.")


def _parse_segment(
    text: str | None, continuous: bool
) -> tuple[str | None, tuple[float, ...] | None]:
    """Return the segment variable and its edges; None where they are to be found."""
    if text is None:
        if continuous:
            raise UsageError("--continuous joins segments; give --segment VARIABLE:EDGE,….")
        return None, None
    variable, colon, rest = text.rpartition(":")
    if not (colon and variable and rest):
        raise UsageError(f"--segment takes VARIABLE:EDGE,EDGE or VARIABLE:auto, got '{text}'.")
    return variable, None if rest.strip() == "auto" else _parse_edges(rest)


def _parse_edges(rest: str) -> tuple[float, ...]:
    try:
        edges = split_numbers(rest)
    except ValueError:
        raise UsageError(f"--segment: '{rest}' is not a list of numbers, nor 'auto'.") from None
    if any(b <= a for a, b in pairwise(edges)) or not np.isfinite(edges).all():
        raise UsageError(f"--segment: edges must be finite and increase, got '{rest}'.")
    return edges

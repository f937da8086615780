"""The front door of regression: from a table to a tested piecewise model.

`regress` reads the columns, forms rates and the list of terms, cuts the rows into segments and has
them fitted (`multipos.regression.cutting`), and says what a reader should know before relying on it
(`multipos.regression.remarks`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from multipos import __version__
from multipos.errors import UsageError
from multipos.files.spelling import Names, split_names, split_numbers, visible
from multipos.files.tables import Source, read_table
from multipos.files.whole import now
from multipos.finding import Finding, in_order, repeated_files
from multipos.numerics.quantiles import check_confidence
from multipos.numerics.selection import thresholds
from multipos.numerics.terms import largest_value
from multipos.positions.headers import in_celsius, under_names
from multipos.regression.candidates import read_candidates
from multipos.regression.cutting import Cut, fit_cut, settle_edges
from multipos.regression.junctions import Junction, find_junctions
from multipos.regression.observations import (
    Observations,
    check_columns,
    join_runs,
    read_observations,
)
from multipos.regression.piecewise import Plan
from multipos.regression.prediction import thermal_balance
from multipos.regression.regression import Regression, Regressions
from multipos.regression.remarks import (
    find_collinear,
    find_imbalance,
    find_in_choice,
    find_in_segments,
    find_jumps,
    find_switch_on,
)


def regress(
    data: Source | Sequence[Source],
    *,
    response: Names,
    variables: Names | None = None,
    degree: int | None = None,
    terms: str | None = None,
    stepwise: bool = False,
    enter: float | None = None,
    remove: float | None = None,
    f_enter: float | None = None,
    f_remove: float | None = None,
    hierarchy: bool = False,
    segment: str | None = None,
    min_rows: int | None = None,
    free: bool = False,
    continuous: bool = False,
    time: str | None = None,
    rate_window: float | None = None,
    causal: bool = False,
    run: str | None = None,
    confidence: float = 0.95,
    drop_missing: bool = False,
) -> Regression | Regressions:
    """Describe one column by others, in segments, with terms that the data support.

    Parameters
    ----------
    data : path, mapping of columns, or data frame, or a sequence of these
        Several are runs, one switch-on each.
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
    stepwise : bool
        Choose terms forward with removal.
    enter, remove, f_enter, f_remove : float, optional
        Thresholds as p (.05 and .10) or as F.
    hierarchy : bool
        T before T².
    segment : str, optional
        'VARIABLE:EDGE,EDGE' or 'VARIABLE:auto'.
    min_rows : int, optional
        Fewest rows of a segment that is found; twice the terms by default.
    free : bool
        Each segment by itself, so that the model may jump at the edges.
    continuous : bool
        No jump at the edges, which is so unless they are free.
    time : str, optional
        The time column; `time` where there is one.
    rate_window : float, optional
        Width of the smoothed derivative, in the unit of time.
    causal : bool
        Rates from the rows up to each, by the recursion that the exported C runs.
    run : str, optional
        A column that tells one switch-on from another; time may start again in each.
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
    if isinstance(data, list | tuple) and len(data) > 1:
        data, run = join_runs(data, run)
    elif isinstance(data, list | tuple):
        (data,) = data
    arguments = dict(locals())  # all arguments as they are, for each of several responses
    responses = split_names(response, "--response")
    if len(responses) > 1:
        return _regress_each(responses, arguments)
    (response,) = responses
    limits = thresholds(enter, remove, f_enter, f_remove)
    names, candidates = read_candidates(response, variables, degree, terms)
    check_confidence(confidence)
    plan = Plan(candidates, names, limits if stepwise else None, hierarchy, confidence)
    if run is not None:
        _check_run(run, response, plan)
    wanted, given = _parse_segment(segment, free, continuous)
    sources = (name.removesuffix("_rate") for name in names)
    options = (each for each in (wanted, time, run) if each)
    asked = dict.fromkeys((response, *names, *sources, *options))
    table, units = under_names(read_table(data, what="data"), asked)
    converted: list[Finding] = []
    table = in_celsius(table, units, converted)
    read = read_observations(
        table,
        response,
        names if wanted is None else [*names, wanted],
        time=time,
        rate_window=rate_window,
        causal=causal,
        run=run,
        drop_missing=drop_missing,
        largest={name: largest_value(candidates, name) for name in names},
    )
    source, sha256, found = table.source, table.sha256, (*repeated_files(table.copies), *converted)
    del table  # whose text may be most of what is in memory
    check_columns(source, read.data, response, names, constant=plan.constant)
    edges = settle_edges(plan, read.data, wanted, given, min_rows, free=free)
    cut = Cut(wanted, edges, bool(edges) and not free)
    _require_bending(plan, cut)
    result = _describe(plan, response, read, cut)
    return replace(
        result,
        causal=causal,
        run=run,
        source=visible(source) if sha256 else None,
        sha256=sha256,
        findings=in_order(
            (*found, *read.findings, *result.findings),
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


def _describe(plan: Plan, response: str, read: Observations, cut: Cut) -> Regression:
    """Return the fitted segments with what tells how well they are determined."""
    segments = fit_cut(plan, read.data, cut)
    junctions: tuple[Junction, ...] = ()
    if not cut.continuous:
        junctions = find_junctions(segments, read.data, cut.variable, cut.edges, plan.confidence)
    used = {} if plan.limits is None else vars(plan.limits)
    model = Regression(
        response=response,
        variables=plan.variables,
        candidates=tuple(map(str, plan.terms)),
        method="full" if plan.limits is None else "stepwise",
        segments=tuple(segments),
        segment_variable=cut.variable,
        edges=cut.edges,
        continuous=cut.continuous,
        time=read.time,
        rates=read.rates,
        confidence=plan.confidence,
        n=len(read.data),
        dropped=read.dropped,
        source=None,
        sha256=None,
        created=now(),
        version=__version__,
        thresholds={name: value for name, value in used.items() if value is not None},
        junctions=junctions,
    )
    balance = thermal_balance(model, read.data.columns)
    return replace(
        model,
        balance=balance,
        findings=(
            *find_in_segments(segments),
            *find_collinear(model, read.data),
            *find_jumps(cut.variable, junctions),
            *find_imbalance(balance),
            *find_switch_on(read.data),
            *find_in_choice(plan, segments),
        ),
    )


# --- options


def _check_run(run: str, response: str, plan: Plan) -> None:
    if run == "":
        raise UsageError("--run names no column; give one, or leave it out.")
    if run == response:
        raise UsageError(f"--run names the response '{response}'; give another column.")
    if not plan.constant:
        raise UsageError("--run is about the constant; add 1 to --terms, or leave out --run.")


def _require_bending(plan: Plan, cut: Cut) -> None:
    """Refuse segments that join, of a variable that no term has."""
    variables = {f.variable for term in plan.terms for f in term.factors}
    if cut.edges and cut.continuous and cut.variable not in variables:
        raise UsageError(
            f"no term has '{cut.variable}', so segments that join at its edges are all one; add it "
            "to --variables, or fit each by itself with --free."
        )


def _parse_segment(
    text: str | None, free: bool, continuous: bool
) -> tuple[str | None, tuple[float, ...] | None]:
    """Return the segment variable and its edges; None where they are to be found."""
    if free and continuous:
        raise UsageError("--free and --continuous exclude each other; give one.")
    if text is None:
        if free or continuous:
            option = "--free parts" if free else "--continuous joins"
            raise UsageError(f"{option} segments; give --segment VARIABLE:EDGE,….")
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

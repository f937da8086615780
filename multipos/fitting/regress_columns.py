"""The front door of regression: from a table to a tested piecewise model.

`regress` reads the columns, forms rates and the list of terms, cuts the rows into segments and
branches, has every segment fitted (`multipos.regression.piecewise`), and says what a reader should
know before believing it (`multipos.fitting.regress_columns`).

Where a rate is named, heating and cooling are modelled apart if they differ.

What a reader should know before believing a regression: what was chosen, jumps, too few rows.

Validation by blocks of time: the error of a model on data it has not seen.

Leaving out single rows of a log proves nothing, since the neighbours that stay know the answer. So
the rows are cut into consecutive blocks of time; each is predicted by a model whose terms were
chosen and fitted on the other blocks alone,

    rms_cv² = Σ (y_k − ŷ_k without the block of k)² / n,       R²_cv = 1 − n rms_cv² / Σ (y − ȳ)².

Edges that were found stay where they are: they are not judged by this.

Sources: P. Burman, E. Chow, D. Nolan, Biometrika 81, 1994 (blocks for dependent data).

Rows cut into segments and branches, each of which is fitted.

Edges are given, or found where they lower the criterion; branches are the rows of
heating and of cooling, by the sign of a rate.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from multipos import __version__
from multipos.errors import MultiposError, UsageError
from multipos.files.numbers import p_in_words
from multipos.files.spelling import Names, split_names, split_numbers, visible
from multipos.files.tables import Source, read_table
from multipos.files.whole import now
from multipos.finding import Finding, Findings, in_order, repeated_files
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import check_confidence
from multipos.numerics.selection import CRITERIA, SubsetCriterion, thresholds
from multipos.numerics.terms import evaluate_terms, largest_value
from multipos.positions.headers import in_celsius, under_names
from multipos.regression import observations, prediction, segmentation, variation
from multipos.regression.correlation import Noise, find_noise, whitening_of
from multipos.regression.junctions import (
    BRANCHES,
    Junction,
    branch_of,
    compare_branches,
    find_junctions,
)
from multipos.regression.piecewise import (
    METHODS,
    Plan,
    fit_segments,
    read_candidates,
)
from multipos.regression.regression import Balance, Regression, Regressions, format_span
from multipos.regression.robust import ROBUST, RowDependence, within_runs
from multipos.regression.segment import Segment
from multipos.results import frozen

_MOST_NAMED = 3  # terms that are left out
_ENDS = 0.1  # share of the points in balance that may be outside, at the ends of the range


def find_order(read: observations.Observations, result: Regression) -> Findings:
    """Say by what rows are neighbours, where that was of any consequence."""
    return read.order if any(s.robust is not None for s in result.segments) else ()


def find_in_choice(
    plan: Plan,
    segments: Sequence[Segment],
    hysteresis: Mapping[str, Any] | None,
    validation: Mapping[str, Any] | None,
) -> list[Finding]:
    """Say what the choice of terms, the branches and each segment leave open."""
    said = []
    if not plan.constant:
        text = "no intercept: F and R² are about zero, not about the mean, dof n − k"
        said.append(Finding("no-intercept", "note", text))
    if plan.method != "full":
        text = "terms were chosen by the data that test them: F and p of the model are optimistic"
        action = "" if validation else "Check it by blocks of time with --cross-validate."
        said.append(Finding("selected-terms", "note", text, action))
    if hysteresis is not None and not hysteresis["significant"]:
        p = hysteresis["p"]
        text = (
            f"heating and cooling do not differ ({p_in_words(p)}): one model for both"
            if p == p
            else "too few independent rows to separate heating from cooling: one model for both"
        )
        said.append(Finding("one-branch", "note", text))
    for where, segment in _named(segments):
        said += _find_in_segment(plan, segment, where)
    return said


def find_in_segments(segments: Sequence[Segment]) -> Findings:
    """Find segments that nothing tests, and rows whose noise is correlated, once for all."""
    found, fewer = [], []
    for where, segment in _named(segments):
        robust = segment.robust
        if segment.dof[0] > 0 and segment.dof[1] == 0:
            text = f"{where}: as many terms as rows, so there are no residuals to test it"
            action = "Add rows, or drop terms."
            found.append(Finding("no-redundancy", "warning", text, action))
        apart = robust is None or robust.kind == "cluster" or robust.n_effective == segment.n
        if robust is not None and not apart:
            fewer.append((segment.n, robust.n_effective, robust.lag_one))
    if fewer:
        rows, equal, lag = (list(each) for each in zip(*fewer, strict=True))
        count = equal[0] if len(set(equal)) == 1 else sum(equal)  # one number is of all segments
        text = (
            f"noise of neighbouring rows is correlated ({max(lag):.2f}); {sum(rows)} rows equal "
            f"about {count:.0f} independent ones"
        )
        action = "Judge terms by F_robust."
        found.append(Finding("time-correlated", "warning", text, action))
    return tuple(found)


def _named(segments: Sequence[Segment]) -> Iterator[tuple[str, Segment]]:
    """Yield segments with what they are called."""
    for number, segment in enumerate(segments, start=1):
        yield f"segment {number}" if len(segments) > 1 else "the model", segment


def find_jumps(variable: str | None, junctions: Sequence[Junction]) -> Findings:
    """Name the largest jump that is none by chance, and the way without."""
    clear = [j for j in junctions if j.clear]
    if not clear:
        return ()
    most = max(clear, key=lambda j: abs(j.jump))
    text = (
        f"the model jumps at {variable} = {most.edge:.6g} by up to {abs(most.jump):.2g} "
        f"(U {most.U:.2g})"
    )
    return (Finding("jump", "warning", text, "Leave out --free to fit without a jump."),)


def find_imbalance(balance: Balance | None) -> Findings:
    """Say where nothing was measured in thermal balance, which is how most sensors are used."""
    if balance is None or balance.outside.mean() <= _ENDS:
        return ()
    outside, points = int(balance.outside.sum()), len(balance.at)
    text = (
        f"in thermal balance (rate 0) {outside} of {points} points over {balance.variable} are "
        "outside the data; predictions there are extrapolated"
    )
    return (Finding("balance", "warning", text, "Add soaks at these temperatures."),)


def find_switch_on(data: observations.Data) -> tuple[Finding, ...]:
    """Say that one switch-on cannot tell what the next one has."""
    if data.run is not None:
        return ()
    text = "the change of bias from one switch-on to the next is not in U"
    action = "Measure several switch-ons and name their column with --run."
    return (Finding("turn-on", "warning", text, action),)


def _find_in_segment(plan: Plan, segment: Segment, where: str) -> list[Finding]:
    said = []
    k, nu = segment.dof
    if k == 0:
        text = f"{where}: no term is supported by the data; the model is the mean alone"
        if not plan.constant:
            text = f"{where}: no term is supported by the data; the model is zero, as it lacks 1"
        said.append(Finding("mean-only", "warning", text))
    elif nu > 0 and not segment.significant:
        text = f"{where} is not significant: F = {segment.F:.3g} is below {segment.F_critical:.3g}"
        said.append(Finding("not-significant", "warning", text, p=segment.p))
    if segment.left_out:
        names = ", ".join(one.term for one in segment.left_out[:_MOST_NAMED])
        more = len(segment.left_out) - _MOST_NAMED
        names += f" and {more} more" if more > 0 else ""
        text = f"{where}: {names} omitted, as the columns hardly vary there, or cancel"
        said.append(Finding("left-out", "note", text))
    if segment.collinear:
        text = f"{where}: {', '.join(segment.collinear)} cannot be separated from the model"
        said.append(Finding("collinear-terms", "note", text))
    robust = segment.robust
    if robust is not None and segment.significant and not robust.p < 1.0 - plan.confidence:
        text = f"{where}: significant by F, not by F_robust ({p_in_words(robust.p)})"
        said.append(Finding("not-robust", "warning", text, p=robust.p))
        if robust.kind != "cluster" and robust.n_effective == segment.n:
            text = (
                f"{where}: {segment.n} rows cannot separate white from slow noise: F "
                f"({p_in_words(segment.p)}) holds for white, F_robust for the slowest possible"
            )
            action = "Record more rows, or several runs."
            said.append(Finding("slow-or-white", "warning", text, action))
    return said


def check_by_blocks(
    data: observations.Data, blocks: int, fit: Callable[[observations.Data], Regression]
) -> dict[str, Any]:
    """Return {blocks, rms, r2, rms_of_blocks} of predictions of blocks left out one after another.

    Parameters
    ----------
    data : Data
        Rows in the order of time where they have one, else as they stand.
    blocks : int
    fit : function
        Chooses and fits a model on some of the rows.

    Raises
    ------
    MultiposError
        There are fewer rows than blocks, or a model cannot be fitted without one of them.
    """
    if blocks > len(data):
        raise MultiposError(
            f"--cross-validate {blocks} takes a row or more a block, but there are {len(data)} "
            "rows; give fewer blocks."
        )
    order = np.arange(len(data)) if data.order is None else data.order.order
    errors = np.empty(len(data))
    parts = np.array_split(order, blocks)
    for number, left_out in enumerate(parts, start=1):
        kept = np.setdiff1d(np.arange(len(data)), left_out)
        try:
            model = fit(data.take(kept))
        except MultiposError as error:
            raise MultiposError(
                f"--cross-validate, without block {number} of {blocks}: {error}"
            ) from None
        unseen = {name: column[left_out] for name, column in data.columns.items()}
        errors[left_out] = data.response[left_out] - model.predict(unseen)
    total = float(((data.response - data.response.mean()) ** 2).sum())
    return {
        "blocks": blocks,
        "rms": float(np.sqrt(np.mean(errors**2))),
        # A response that never changes, fitted without an intercept, has nothing to compare with.
        "r2": 1.0 - float((errors**2).sum()) / total if total > 0.0 else np.nan,
        "rms_of_blocks": [float(np.sqrt(np.mean(errors[part] ** 2))) for part in parts],
    }


@frozen(eq=True)
class Cut:
    """How rows are cut: at edges of a variable, and by the sign of a rate."""

    variable: str | None
    edges: tuple[float, ...]
    continuous: bool
    branch_column: str | None


def settle_edges(
    plan: Plan,
    data: observations.Data,
    variable: str | None,
    given: tuple[float, ...] | None,
    min_rows: int | None,
    *,
    free: bool,
) -> tuple[tuple[float, ...], Findings]:
    """Return the edges that are given or found, and what there is to say of them.

    Raises
    ------
    MultiposError
        An edge is outside the data.
    UsageError
        `min_rows` are no more than the terms.
    """
    if variable is None:
        return (), ()
    if given is not None:
        segmentation.check_edges(variable, given, data.columns[variable])
        return given, ()
    edges = _find_edges(plan, data, variable, min_rows, free)
    if not edges:
        text = f"no edge in {variable} improves the model enough: one segment"
        return (), (Finding("one-segment", "note", text),)
    return edges, ()


def _find_edges(
    plan: Plan, data: observations.Data, variable: str, min_rows: int | None, free: bool
) -> tuple[float, ...]:
    p = len(plan.terms)
    minimum = 2 * p if min_rows is None else min_rows
    if minimum <= p and plan.method == "full":
        raise UsageError(f"--min-rows must be above the number of terms, {p}; got {minimum}.")
    read = data
    design, data = within_runs(evaluate_terms(plan.terms, data.columns, len(data)), data)
    values = data.columns[variable]
    response = data.response
    whitening = None
    if data.order is not None:
        # what five segments leave is close to noise alone, whatever the edges will be
        bins = np.unique(np.quantile(values, [0.2, 0.4, 0.6, 0.8]))
        noise = _noise(design, data, segmentation.segment_of(values, bins.tolist()))
        whitening = whitening_of(data.order, noise)
        if whitening is not None:
            design, response = whitening(design), whitening(response)

    def adjust(columns: Array) -> Array:
        within = within_runs(columns, read)[0]
        return within if whitening is None else whitening(within)

    joined = None
    if not free and segmentation.hinges(plan.terms, variable, [0.0], both=False):
        joined = segmentation.Joined(plan.terms, variable, data.columns, adjust)
    return segmentation.find_edges(values, design, response, minimum=minimum, joined=joined)


def _noise(design: Array, data: observations.Data, place: observations.Rows) -> Noise | None:
    """Return what is known of the noise that fits to the rows of each place leave."""
    apart = [np.where((place == i)[:, np.newaxis], design, 0.0) for i in np.unique(place)]
    return find_noise(np.column_stack(apart), data.response, data.order)


@frozen(eq=True)
class _Branch:
    """Rows of one sign of the rate, or all where `name` is None, and the segment of each."""

    name: str | None
    rows: observations.Rows
    place: observations.Rows


def _branches(data: observations.Data, cut: Cut) -> list[_Branch]:
    n = len(data)
    place = np.zeros(n, dtype=np.intp)
    if cut.variable is not None:
        place = segmentation.segment_of(data.columns[cut.variable], cut.edges)
    if cut.branch_column is None:
        return [_Branch(None, np.arange(n), place)]
    sign = branch_of(data.columns[cut.branch_column], data.run)
    return [
        _Branch(name, np.flatnonzero(sign == b), place[sign == b])
        for b, name in enumerate(BRANCHES)
    ]


def fit_cut(plan: Plan, data: observations.Data, cut: Cut) -> list[Segment]:
    """Return the fitted segments, branch by branch.

    Raises
    ------
    MultiposError
        A segment has no rows, or fewer than terms, or terms that its rows cannot tell apart.
    """
    fit = _fit_joined if cut.continuous and cut.edges else _fit_apart
    branches = _branches(data, cut)
    design, within = within_runs(evaluate_terms(plan.terms, data.columns, len(data)), data)
    place = np.empty(len(data), dtype=np.intp)
    for b, branch in enumerate(branches):
        place[branch.rows] = branch.place + b * (len(cut.edges) + 1)
    variances = variation.term_variances(plan.terms, data.columns)
    data = replace(data, noise=_noise(design, within, place), variances=variances)
    return [segment for branch in branches for segment in fit(plan, data, cut, branch)]


def _fit_joined(plan: Plan, data: observations.Data, cut: Cut, branch: _Branch) -> list[Segment]:
    """Return the segments of one branch without a jump at the edges."""
    variable, spans = _spans(plan, data, cut)
    for number, span in enumerate(spans):
        _require_rows(branch, number, _segment_name(number, variable, span, branch))
    where = "the continuous model" if branch.name is None else f"the {branch.name} branch"
    rows = data.take(branch.rows)
    return fit_segments(plan, rows, variable, cut.edges, spans, branch.name, where)


def _fit_apart(plan: Plan, data: observations.Data, cut: Cut, branch: _Branch) -> list[Segment]:
    """Return the segments of one branch, each fitted by itself."""
    variable, spans = _spans(plan, data, cut)
    segments = []
    for number, span in enumerate(spans):
        where = "the table"
        if cut.edges or branch.name:
            where = _segment_name(number, variable, span, branch)
        _require_rows(branch, number, where)
        mine = branch.rows[branch.place == number]
        some = data if len(mine) == len(data) else data.take(mine)
        alone = where == "the table"
        segments += fit_segments(plan, some, variable, (), (span,), branch.name, where, alone=alone)
    return segments


def _require_rows(branch: _Branch, number: int, where: str) -> None:
    if number not in branch.place:
        raise MultiposError(f"{where} has no rows; move the edge, or give more rows.")


def _spans(plan: Plan, data: observations.Data, cut: Cut) -> tuple[str, list[tuple[float, float]]]:
    """Return the variable that segments lie along, and from where to where each goes."""
    variable = cut.variable or plan.variables[0]
    values = data.columns[variable]
    return variable, list(pairwise([float(values.min()), *cut.edges, float(values.max())]))


def _segment_name(number: int, variable: str, span: tuple[float, float], branch: _Branch) -> str:
    return f"segment {number + 1} ({format_span(variable, span, branch.name)})"


def regress(
    data: Source | Sequence[Source],
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
    free: bool = False,
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
    free : bool
        Each segment by itself, so that the model may jump at the edges.
    continuous : bool
        No jump at the edges, which is so unless they are free.
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
        Check by leaving out this many blocks of time, one after another.
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
        data, run = observations.join_runs(data, run)
    elif isinstance(data, list | tuple):
        (data,) = data
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
    wanted, given = _parse_segment(segment, free, continuous)
    sources = (name.removesuffix("_rate") for name in names)
    options = (each for each in (wanted, branches, time, run, cluster) if each)
    asked = dict.fromkeys((response, *names, *sources, *options))
    table, units = under_names(read_table(data, what="data"), asked)
    converted: list[Finding] = []
    table = in_celsius(table, units, converted)
    read = observations.read_observations(
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
    source, sha256, found = table.source, table.sha256, (*repeated_files(table.copies), *converted)
    del table  # whose text may be most of what is in memory
    observations.check_columns(source, read.data, response, names, constant=plan.constant)
    edges, said = settle_edges(plan, read.data, wanted, given, min_rows, free=free)
    cut = Cut(wanted, edges, bool(edges) and not free, branches)
    _require_bending(plan, cut)
    result = _describe(plan, response, read, cut, cross_validate)
    return replace(
        result,
        causal=causal,
        run=run,
        source=visible(source) if sha256 else None,
        sha256=sha256,
        findings=in_order(
            (*found, *read.findings, *find_order(read, result), *said, *result.findings),
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
    plan: Plan, response: str, read: observations.Observations, cut: Cut, blocks: int | None
) -> Regression:
    """Return the fitted segments with what tells how well they are determined."""
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
    model = _assemble(plan, response, segments, cut)
    balance = prediction.thermal_balance(model, read.data.columns)
    return replace(
        model,
        junctions=junctions,
        balance=balance,
        time=read.time,
        rates=read.rates,
        n=len(read.data),
        dropped=read.dropped,
        hysteresis=hysteresis,
        cross_validation=validation,
        findings=(
            *find_in_segments(segments),
            *find_jumps(cut.variable, junctions),
            *find_imbalance(balance),
            *find_switch_on(read.data),
            *find_in_choice(plan, segments, hysteresis, validation),
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
    if cluster is not None and run is not None:
        raise UsageError(
            "--cluster changes the tests alone, --run what is uncertain too; give one of them."
        )
    for option, name in (("--branches", branches), ("--cluster", cluster), ("--run", run)):
        if name == "":
            raise UsageError(f"{option} names no column; give one, or leave it out.")
        if name == response:
            raise UsageError(f"{option} names the response '{response}'; give another column.")
    if criterion not in CRITERIA:
        raise UsageError(f"--criterion takes {', '.join(CRITERIA)}, got '{criterion}'.")
    if criterion != CRITERIA[0] and method != "subsets":
        raise UsageError("--criterion chooses among --subsets; give both.")
    if robust not in ROBUST:
        raise UsageError(f"--robust takes {', '.join(ROBUST)}, got '{robust}'.")
    check_confidence(confidence)
    if blocks is not None and blocks < 2:
        raise UsageError(f"--cross-validate takes 2 blocks or more, got {blocks}.")


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

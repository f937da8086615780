"""Fits of one segment, or of all segments without a jump: selection, fit, tests.

`fit_segments` returns the segments of some rows, by the terms and limits of a `Plan`.

The rows are factored once for the selection (`multipos.numerics.selection`); the terms that come
out are fitted by `multipos.numerics.least_squares`, so what is reported has full precision whatever
the path was.

The figures of a fit of q coefficients, k slopes, to n rows, with leverage h:

    rms² = rss/(n − q),      press² = Σ (e/(1 − h))²/n,      R²_adj = 1 − (rss/(n−q))/(tss/(n−1)).

Segments fitted together without a jump share their degrees of freedom: their coefficients are
L b of the coefficients b of all columns, their covariance is L C L', n − q counts all rows,
and F is that of Wald, b' C⁻¹ b / k. A segment's rms is on its rows less its leverage.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError, RankError
from multipos.files.records import LARGEST
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import LinearFit, solve
from multipos.numerics.quantiles import f_quantile, f_tail
from multipos.numerics.selection import (
    Guard,
    Selection,
    Thresholds,
    akaike_criterion,
    compress,
    select_stepwise,
)
from multipos.numerics.separability import join_combinations
from multipos.numerics.terms import CONSTANT, Term, evaluate_terms
from multipos.regression.candidates import stands_on
from multipos.regression.correlation import wald
from multipos.regression.observations import Data, Rows
from multipos.regression.region import Region, largest_leverage, region_factor
from multipos.regression.robust import RobustFit, robust_fit, robust_test
from multipos.regression.runs import add_between, find_between, runs_lost, within_runs
from multipos.regression.segment import LeftOut, RunnerUp, Segment
from multipos.regression.segmentation import Hinge, hinges, segment_of
from multipos.regression.variation import LEAST, Contributions, by_degree, varying
from multipos.regression.whitening import whitening_of
from multipos.results import frozen


@frozen(eq=True)
class Plan:
    """What is fitted in every segment, and how it is judged.

    Attributes
    ----------
    terms : tuple of Term
        Candidates.
    variables : tuple of str
        Whose limits are kept.
    limits : Thresholds or None
        Of terms that are chosen stepwise; None where all are taken.
    hierarchy : bool
    confidence : float
    """

    terms: tuple[Term, ...]
    variables: tuple[str, ...]
    limits: Thresholds | None = None
    hierarchy: bool = False
    confidence: float = 0.95

    @property
    def constant(self) -> bool:
        """Whether there is an intercept."""
        return CONSTANT in self.terms


@frozen
class _Fit:
    """Chosen columns of a design and their least squares."""

    selection: Selection
    found: LinearFit | None  # None where nothing was chosen
    design: Array
    residuals: Array
    leverage: Array
    covariance: Array  # (q, q), classical
    dof: int


class _Demand(NamedTuple):
    """What columns are held to, eqs. (1) and (2) of `multipos.regression.variation`.

    `order` is that in which each must vary beyond those before it; None where all may stay.
    """

    variances: Array
    cancel: Callable[[Sequence[int], Array], bool]
    order: Sequence[int] | None


def _span(plan: Plan, data: Data) -> float:
    """Return the range of the response, from zero where there is no constant."""
    y = data.response
    return float(np.ptp(y) if plan.constant else np.abs(y).max())


def _left_out(plan: Plan, selection: Selection, kept: Sequence[Term]) -> tuple[LeftOut, ...]:
    """Return the candidates that a fit does not support, each with the reason."""
    names = [str(term) for term in plan.terms]
    absent = [j for j, term in enumerate(plan.terms) if term not in kept]
    short = (
        f"varies here, beyond the terms kept, by less than {LEAST:g} of its variance in the table; "
        "its effect is part of the constant and of these terms"
    )
    cancel = "its coefficient and others would cancel, each larger than the response's range"
    found = [LeftOut(names[j], short) for j in absent if j in selection.short]
    found += [LeftOut(names[j], cancel) for j in absent if j in selection.cancelling]
    return tuple(found)


def _regions(
    plan: Plan,
    data: Data,
    kept: Array,
    short: Sequence[int],
    variable: str,
    parts: Sequence[tuple[tuple[Term, ...], Array | None, Rows, tuple[float, float]]],
) -> tuple[Region | None, ...]:
    """Return the region of each segment of a fit: its terms, how they share columns, rows, span.

    A segment reaches to its edges: the row next to each is counted as if it were there.
    """
    if not kept.shape[1]:
        return (None,) * len(parts)
    assert data.variances is not None  # which `fit_cut` has seen to
    left_out = [plan.terms[j] for j in short if data.variances[j] > 0.0]
    shortest = np.sqrt(LEAST * len(data) * data.variances[[plan.terms.index(t) for t in left_out]])
    beyond = evaluate_terms(left_out, data.columns, len(data))
    found: list[tuple[Region, dict[str, Array], int] | None] = []
    for terms, L, rows, span in parts:
        if not terms and not left_out:
            found.append(None)
            continue
        G = region_factor(kept, beyond, shortest, L)
        _check_size("factor of the region", np.abs(G).max(axis=0), (*terms, *left_out))
        region = Region((*terms, *left_out), G, np.inf)
        columns = {name: column[rows] for name, column in data.columns.items()}
        for edge in span if len(rows) else ():
            next_to = int(np.argmin(np.abs(columns[variable] - edge)))
            columns = {name: np.append(column, column[next_to]) for name, column in columns.items()}
            columns[variable][-1] = edge
        found.append((region, columns, len(columns[variable])))
    limit = largest_leverage([one for one in found if one is not None])
    return tuple(None if one is None else replace(one[0], limit=limit) for one in found)


def fit_segments(
    plan: Plan,
    data: Data,
    variable: str,
    edges: Sequence[float],
    spans: Sequence[tuple[float, float]],
    where: str,
    *,
    alone: bool = False,
) -> list[Segment]:
    """Fit segments at once, continuous across the edges between them; of one there are none.

    Parameters
    ----------
    plan : Plan
    data : Data
        The rows of all segments.
    variable : str
        What edges and spans are of.
    edges : sequence of float
    spans : sequence of (low, high)
    where : str
        The segments in words, for messages.
    alone : bool
        Whether a segment is all there is, so that terms are held to nothing but what the rows tell.

    Raises
    ------
    MultiposError
        Fewer rows than terms, or terms that these rows cannot tell apart.
    """
    place = segment_of(data.columns[variable], edges)
    parts = [np.flatnonzero(place == s) for s in range(len(spans))]
    base = evaluate_terms(plan.terms, data.columns, len(data))
    assert data.variances is not None  # which `fit_cut` has seen to
    extra = _changing(plan, [base[rows] for rows in parts], data.variances, variable, edges)
    original = np.column_stack((base, *(h.evaluate(data.columns) for h in extra)))
    read = data
    design, data = within_runs(original, data, where)
    names = [*map(str, plan.terms), *map(str, extra)]
    requires = [*stands_on(plan.terms), *(frozenset({plan.terms.index(h.term)}) for h in extra)]
    every: tuple[Term | Hinge, ...] = (*plan.terms, *extra)
    sizes = [
        Contributions(read.take(rows).columns, _span(plan, data)) for rows in parts if len(rows)
    ]

    def cancel(columns: Sequence[int], b: Array) -> bool:
        locally = [_local([every[j] for j in columns], edges[:s]) for s in range(len(parts))]
        return any(size.cancel(t, L @ b) for size, (t, L) in zip(sizes, locally, strict=True))

    variances = np.concatenate([data.variances, original[:, len(plan.terms) :].var(axis=0)])
    order = [*by_degree(plan.terms), *range(len(plan.terms), len(every))]
    demand = _Demand(variances, cancel, None if alone else order)
    fit = _fit(plan, design, data, names, requires, where, demand)
    chosen = [every[j] for j in fit.selection.columns]
    b = np.zeros(0) if fit.found is None else fit.found.coefficients
    robust = None if fit.found is None else robust_fit(fit.found, fit.design, data)
    short = [j for j in fit.selection.short if j < len(plan.terms)]
    locally = [_local(chosen, edges[:s]) for s in range(len(spans))]
    left = original[:, list(fit.selection.columns)]
    rows_of = [
        (terms, L if edges else None, rows, span)
        for (terms, L), rows, span in zip(locally, parts, spans, strict=True)
    ]
    regions = _regions(plan, read, left, short, variable, rows_of)
    segments = []
    for s, span in enumerate(spans):
        terms, L = locally[s]
        estimate = terms, L @ b, L @ fit.covariance @ L.T
        test = _tested(fit, data.response, estimate, joined=bool(edges))
        turned = None if robust is None else robust.turned(L)
        segment = _segment(plan, fit, data, parts[s], estimate, test, span, turned)
        left_out = _left_out(plan, fit.selection, terms)
        segments.append(replace(segment, left_out=left_out, region=regions[s]))
    if read.run is None:
        return segments
    size = len(data) if robust is None else robust.n_effective
    linear = [column if isinstance(column, Term) else None for column in chosen]
    between = find_between(left, read, linear, b, variable, size)
    return [add_between(segment, between) for segment in segments]


def _changing(
    plan: Plan, parts: Sequence[Array], variances: Array, variable: str, edges: Sequence[float]
) -> list[Hinge]:
    """Return the columns that let terms change at edges on both sides of which they vary."""
    order = by_degree(plan.terms)
    supported = [set(varying(base, variances, order)) for base in parts] if edges else []
    return [
        h
        for h in hinges(plan.terms, variable, edges, both=plan.limits is not None)
        if {plan.terms.index(h.term)} <= supported[(s := edges.index(h.edge))] & supported[s + 1]
    ]


def _tested(
    fit: _Fit, y: Array, estimate: tuple[tuple[Term, ...], Array, Array], *, joined: bool
) -> tuple[float, int]:
    """Return F and k of a segment's slopes: Wald's where it is joined, else that of all rows."""
    terms, values, covariance = estimate
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    if joined:
        return wald(values[slopes], covariance[np.ix_(slopes, slopes)])
    mean, k = float(y.mean()) if CONSTANT in terms else 0.0, len(slopes)
    explained = float(((y - fit.residuals - mean) ** 2).sum())
    rss = float(fit.residuals @ fit.residuals)
    if not k or fit.dof <= 0:
        return np.nan, k
    return (explained / k) / (rss / fit.dof) if rss > 0.0 else np.inf, k


def _local(
    chosen: Sequence[Term | Hinge], below: Sequence[float]
) -> tuple[tuple[Term, ...], Array]:
    """Return the terms of a segment above some edges, and how they are made of the coefficients."""
    rows: dict[Term, Array] = {}
    unit = np.eye(len(chosen))
    for j, column in enumerate(chosen):
        if isinstance(column, Term):
            rows[column] = rows.get(column, 0.0) + unit[j]
        elif column.acts(below):
            lift = column.edge**column.power
            rows[column.term] = rows.get(column.term, 0.0) + unit[j]
            rows[column.rest] = rows.get(column.rest, 0.0) - lift * unit[j]
    return tuple(rows), np.array(list(rows.values())).reshape(len(rows), len(chosen))


def _fit(
    plan: Plan,
    design: Array,
    data: Data,
    names: list[str],
    requires: list[frozenset[int]],
    where: str,
    demand: _Demand,
) -> _Fit:
    (n, p), response, lost = design.shape, data.response, runs_lost(data)
    _require_rows(plan, n, p + lost, where)
    try:
        selection = _select(plan, design, data, names, requires, lost, demand)
        columns = list(selection.columns)
        if not columns:
            none, zero = np.zeros((0, 0)), np.zeros(n)
            return _Fit(selection, None, design[:, :0], response, zero, none, n - lost)
        chosen = design if len(columns) == p else design[:, columns]
        found = solve(chosen, response, names=[names[j] for j in columns], rows="rows")
        dof = found.dof - lost
        s2 = float(found.rss) / dof if dof else np.nan
        covariance, left, leverage = found.cofactor * s2, found.residuals, found.leverage
        u = np.sqrt(np.diag(found.cofactor) * s2)
        sizes = np.fmax(np.abs(found.coefficients), u)
        _check_size("coefficient", sizes, [names[j] for j in columns])
    except RankError as error:
        said = join_combinations(error.combinations) or str(error)
        raise RankError(
            f"{where}: {said}; drop a term, give rows that separate them, or use --stepwise.",
            rank=error.rank,
            parameters=error.parameters,
            combinations=error.combinations,
        ) from None
    except MultiposError as error:
        raise MultiposError(f"{where}: {error}") from None
    return _Fit(selection, found, chosen, left, leverage, covariance, dof)


def _require_rows(plan: Plan, n: int, p: int, where: str) -> None:
    full = plan.limits is None
    if n < (p if full else int(plan.constant) + 2):
        raise MultiposError(
            f"{where} has {n} rows for {p} terms; move the edge, give more rows or fewer terms"
            + (", or use --stepwise." if full else ".")
        )


def _check_size(what: str, sizes: Array, terms: Sequence[object]) -> None:
    """Refuse a number of a term that could not be read back from a file."""
    far = int(np.argmax(sizes))
    if not sizes[far] <= LARGEST:
        raise MultiposError(
            f"the {what} of '{terms[far]}' is {sizes[far]:g}, which no file takes; "
            "give the variables in a smaller unit, or the response in a larger one."
        )


def _select(
    plan: Plan,
    design: Array,
    data: Data,
    names: list[str],
    requires: list[frozenset[int]],
    lost: int,
    demand: _Demand,
) -> Selection:
    """Return the columns that are taken: all that vary, or those that are chosen stepwise."""
    every = range(len(names))
    if plan.limits is None:
        kept = list(every)
        if demand.order is not None:
            kept = sorted(varying(design, demand.variances, demand.order))
        return Selection(tuple(kept), short=tuple(j for j in every if j not in kept))
    whitening = whitening_of(data.order, data.noise)
    plain = triangle = compress(design, data.response)
    if whitening is not None:
        triangle = compress(whitening(design), whitening(data.response))
    least = np.sqrt(LEAST * len(design) * demand.variances)
    return select_stepwise(
        replace(triangle, rows=triangle.rows - lost),
        names,
        plan.limits,
        forced=[j for j in every if names[j] == str(CONSTANT)],
        requires=requires if plan.hierarchy else None,
        guard=Guard(plain, least, demand.cancel),
    )


def _segment(
    plan: Plan,
    fit: _Fit,
    data: Data,
    rows: Rows,
    estimate: tuple[tuple[Term, ...], Array, Array],
    test: tuple[float, int],
    span: tuple[float, float],
    robust: RobustFit | None,
) -> Segment:
    """Return a segment of its rows by terms, values and covariance; F on k; its span."""
    (terms, values, covariance), (F, k) = estimate, test
    y, e, h = data.response[rows], fit.residuals[rows], fit.leverage[rows]
    constant = CONSTANT in terms
    rss, tss = float(e @ e), float(((y - (y.mean() if constant else 0.0)) ** 2).sum())
    left = fit.dof if len(rows) == len(data) else len(rows) - float(h.sum())
    whole = float(fit.residuals @ fit.residuals)
    variance = rss / left if left > 0 else np.nan
    lost = rss / tss if tss > 0.0 else np.nan
    ratio = variance / (tss / (len(rows) - constant)) if tss > 0.0 else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        press = float(np.sqrt(np.mean((e / (1.0 - h)) ** 2)))
    selection, names = fit.selection, [str(term) for term in plan.terms]
    return Segment(
        range=span,
        n=len(rows),
        terms=terms,
        values=values,
        covariance=covariance,
        dof=(k, fit.dof),
        r2=1.0 - lost,
        adjusted_r2=1.0 - ratio,
        rms=float(np.sqrt(variance)),
        aicc=akaike_criterion(whole, len(data), fit.design.shape[1]),
        press=press,
        F=F,
        F_critical=f_quantile(plan.confidence, k, fit.dof),
        p=f_tail(F, k, fit.dof) if F == F else np.nan,
        limits={
            name: (float(data.columns[name][rows].min()), float(data.columns[name][rows].max()))
            for name in plan.variables
        },
        path=selection.path,
        runner_up=_runner_up(selection),
        collinear=tuple(
            name for name in selection.collinear if name in names and name not in map(str, terms)
        ),
        robust=robust_test(robust, terms, values, (F, k, fit.dof), plan.confidence),
    )


def _runner_up(selection: Selection) -> RunnerUp | None:
    best = selection.runner_up
    return None if best is None else RunnerUp(best.term, best.F, best.p, selection.F_to_enter)

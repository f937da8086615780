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

from collections.abc import Sequence
from dataclasses import replace

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
    Triangle,
    akaike_criterion,
    compress,
    select_stepwise,
)
from multipos.numerics.separability import join_combinations
from multipos.numerics.terms import CONSTANT, Term, evaluate_terms
from multipos.regression.candidates import stands_on
from multipos.regression.correlation import wald
from multipos.regression.observations import Data
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


class _Whole:
    """The rows of segments that are fitted at once, and the columns that describe all of them."""

    def __init__(
        self,
        plan: Plan,
        data: Data,
        variable: str,
        edges: Sequence[float],
        spans: Sequence[tuple[float, float]],
        where: str,
    ) -> None:
        self.plan, self.read, self.where = plan, data, where
        self.variable, self.edges, self.spans = variable, edges, spans
        place = segment_of(data.columns[variable], edges)
        self.parts = [np.flatnonzero(place == s) for s in range(len(spans))]
        base = evaluate_terms(plan.terms, data.columns, len(data))
        assert data.variances is not None  # which `fit_cut` has seen to
        changing = self._changing(base, data.variances)
        self.columns: tuple[Term | Hinge, ...] = (*plan.terms, *changing)
        self.original = np.column_stack((base, *(h.evaluate(data.columns) for h in changing)))
        of_changes = self.original[:, len(plan.terms) :].var(axis=0)
        self.variances = np.concatenate([data.variances, of_changes])
        self.design, self.data = within_runs(self.original, data, where)
        self.names, self.lost = [*map(str, self.columns)], runs_lost(data)

    def _changing(self, base: Array, variances: Array) -> list[Hinge]:
        """Return the columns that let terms change at edges on both sides of which they vary."""
        terms, edges = self.plan.terms, self.edges
        order = by_degree(terms)
        supported = [set(varying(base[p], variances, order)) for p in self.parts] if edges else []
        return [
            h
            for h in hinges(terms, self.variable, edges, both=self.plan.limits is not None)
            if {terms.index(h.term)} <= supported[(s := edges.index(h.edge))] & supported[s + 1]
        ]

    @property
    def order(self) -> list[int]:
        """The order in which each column must vary beyond those before it."""
        count = len(self.plan.terms)
        return [*by_degree(self.plan.terms), *range(count, len(self.columns))]

    @property
    def requires(self) -> list[frozenset[int]]:
        """Which columns each one stands on."""
        terms = self.plan.terms
        changing = (h for h in self.columns if isinstance(h, Hinge))
        return [*stands_on(terms), *(frozenset({terms.index(h.term)}) for h in changing)]

    def local(self, chosen: Sequence[int], s: int) -> tuple[tuple[Term, ...], Array]:
        """Return the terms of a segment, and how they are made of the coefficients of columns."""
        rows: dict[Term, Array] = {}
        for unit, j in zip(np.eye(len(chosen)), chosen, strict=True):
            column = self.columns[j]
            if isinstance(column, Term):
                rows[column] = rows.get(column, 0.0) + unit
            elif column.acts(self.edges[:s]):
                lift = column.edge**column.power
                rows[column.term] = rows.get(column.term, 0.0) + unit
                rows[column.rest] = rows.get(column.rest, 0.0) - lift * unit
        return tuple(rows), np.array(list(rows.values())).reshape(len(rows), len(chosen))

    def guard(self, triangle: Triangle) -> Guard:
        """Return what columns are held to, eqs. (1) and (2) of `multipos.regression.variation`."""
        y = self.read.response
        span = float(np.ptp(y) if self.plan.constant else np.abs(y).max())
        sizes = [Contributions(self.read.take(part).columns, span) for part in self.parts]

        def cancel(columns: Sequence[int], b: Array) -> bool:
            for s, size in enumerate(sizes):
                terms, L = self.local(columns, s)
                if size.cancel(terms, L @ b):
                    return True
            return False

        return Guard(triangle, np.sqrt(LEAST * len(y) * self.variances), cancel)


@frozen
class _Fit:
    """Chosen columns and their least squares."""

    selection: Selection
    found: LinearFit | None  # None where nothing was chosen
    design: Array
    values: Array
    residuals: Array
    leverage: Array
    covariance: Array  # (q, q), classical
    dof: int

    @property
    def chosen(self) -> tuple[int, ...]:
        """The places of the columns."""
        return self.selection.columns


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
    whole = _Whole(plan, data, variable, edges, spans, where)
    fit = _fit(whole, alone=alone)
    robust = None if fit.found is None else robust_fit(fit.found, fit.design, whole.data)
    segments = [
        replace(_segment(whole, fit, s, robust), region=region)
        for s, region in enumerate(_regions(whole, fit))
    ]
    if data.run is None:
        return segments
    size = len(data) if robust is None else robust.n_effective
    left, columns = whole.original[:, list(fit.chosen)], [whole.columns[j] for j in fit.chosen]
    between = find_between(left, data, columns, fit.values, variable, size)
    return [add_between(segment, between) for segment in segments]


def _fit(whole: _Whole, *, alone: bool) -> _Fit:
    (n, p), response, lost = whole.design.shape, whole.data.response, whole.lost
    _require_rows(whole.plan, n, p + lost, whole.where)
    try:
        selection = _select(whole, alone=alone)
        columns = list(selection.columns)
        if not columns:
            none, zero = np.zeros((0, 0)), np.zeros(n)
            empty = whole.design[:, :0]
            return _Fit(selection, None, empty, zero[:0], response, zero, none, n - lost)
        design = whole.design if len(columns) == p else whole.design[:, columns]
        names = [whole.names[j] for j in columns]
        found = solve(design, response, names=names, rows="rows")
        dof = found.dof - lost
        s2 = float(found.rss) / dof if dof else np.nan
        covariance, left, leverage = found.cofactor * s2, found.residuals, found.leverage
        values, u = found.coefficients, np.sqrt(np.diag(found.cofactor) * s2)
        _check_size("coefficient", np.fmax(np.abs(values), u), names)
    except RankError as error:
        said = join_combinations(error.combinations) or str(error)
        raise RankError(
            f"{whole.where}: {said}; drop a term, give rows that separate them, or use --stepwise.",
            rank=error.rank,
            parameters=error.parameters,
            combinations=error.combinations,
        ) from None
    except MultiposError as error:
        raise MultiposError(f"{whole.where}: {error}") from None
    return _Fit(selection, found, design, values, left, leverage, covariance, dof)


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


def _select(whole: _Whole, *, alone: bool) -> Selection:
    """Return the columns that are taken: all that vary, or those that are chosen stepwise."""
    plan, data, names = whole.plan, whole.data, whole.names
    every = range(len(names))
    if plan.limits is None:
        kept = every if alone else sorted(varying(whole.design, whole.variances, whole.order))
        return Selection(tuple(kept), short=tuple(j for j in every if j not in kept))
    whitening = whitening_of(data.order, data.noise)
    plain = triangle = compress(whole.design, data.response)
    if whitening is not None:
        triangle = compress(whitening(whole.design), whitening(data.response))
    return select_stepwise(
        replace(triangle, rows=triangle.rows - whole.lost),
        names,
        plan.limits,
        forced=[j for j in every if names[j] == str(CONSTANT)],
        requires=whole.requires if plan.hierarchy else None,
        guard=whole.guard(plain),
    )


def _regions(whole: _Whole, fit: _Fit) -> list[Region | None]:
    """Return the region of each segment.

    A segment reaches to its edges: the row next to each is counted as if it were there.
    """
    kept, plan, data = whole.original[:, list(fit.chosen)], whole.plan, whole.read
    if not kept.shape[1]:
        return [None] * len(whole.parts)
    short = [j for j in fit.selection.short if j < len(plan.terms) and whole.variances[j] > 0.0]
    left_out = [plan.terms[j] for j in short]
    shortest = np.sqrt(LEAST * len(data) * whole.variances[short])
    beyond = evaluate_terms(left_out, data.columns, len(data))
    found: list[tuple[Region, dict[str, Array], int] | None] = []
    for s, (part, span) in enumerate(zip(whole.parts, whole.spans, strict=True)):
        terms, L = whole.local(fit.chosen, s)
        if not terms and not left_out:
            found.append(None)
            continue
        # A term that varies too little beside its changes at both sides of an edge is in these.
        own = [i for i, term in enumerate(left_out) if term not in terms]
        every = (*terms, *(left_out[i] for i in own))
        G = region_factor(kept, beyond[:, own], shortest[own], L if whole.edges else None)
        _check_size("factor of the region", np.abs(G).max(axis=0), every)
        columns = {name: column[part] for name, column in data.columns.items()}
        for edge in span:
            next_to = int(np.argmin(np.abs(columns[whole.variable] - edge)))
            columns = {name: np.append(column, column[next_to]) for name, column in columns.items()}
            columns[whole.variable][-1] = edge
        region = Region(every, G, np.inf)
        found.append((region, columns, len(columns[whole.variable])))
    limit = largest_leverage([one for one in found if one is not None])
    return [None if one is None else replace(one[0], limit=limit) for one in found]


def _tested(
    whole: _Whole, fit: _Fit, terms: Sequence[Term], values: Array, covariance: Array
) -> tuple[float, int]:
    """Return F and k of a segment's slopes: Wald's where it is joined, else that of all rows."""
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    if whole.edges:
        return wald(values[slopes], covariance[np.ix_(slopes, slopes)])
    y = whole.data.response
    mean, k = float(y.mean()) if CONSTANT in terms else 0.0, len(slopes)
    explained = float(((y - fit.residuals - mean) ** 2).sum())
    rss = float(fit.residuals @ fit.residuals)
    if not k or fit.dof <= 0:
        return np.nan, k
    return (explained / k) / (rss / fit.dof) if rss > 0.0 else np.inf, k


def _segment(whole: _Whole, fit: _Fit, s: int, robust: RobustFit | None) -> Segment:
    """Return a segment, without its region."""
    plan, data, rows, selection = whole.plan, whole.data, whole.parts[s], fit.selection
    terms, L = whole.local(fit.chosen, s)
    values, covariance = L @ fit.values, L @ fit.covariance @ L.T
    F, k = _tested(whole, fit, terms, values, covariance)
    y, e, h = data.response[rows], fit.residuals[rows], fit.leverage[rows]
    constant = CONSTANT in terms
    rss, tss = float(e @ e), float(((y - (y.mean() if constant else 0.0)) ** 2).sum())
    left = fit.dof if len(rows) == len(data) else len(rows) - float(h.sum())
    of_all = float(fit.residuals @ fit.residuals)
    variance = rss / left if left > 0 else np.nan
    lost = rss / tss if tss > 0.0 else np.nan
    ratio = variance / (tss / (len(rows) - constant)) if tss > 0.0 else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        press = float(np.sqrt(np.mean((e / (1.0 - h)) ** 2)))
    names = [str(term) for term in plan.terms if term not in terms]
    return Segment(
        range=whole.spans[s],
        n=len(rows),
        terms=terms,
        values=values,
        covariance=covariance,
        dof=(k, fit.dof),
        r2=1.0 - lost,
        adjusted_r2=1.0 - ratio,
        rms=float(np.sqrt(variance)),
        aicc=akaike_criterion(of_all, len(data), fit.design.shape[1]),
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
        collinear=tuple(name for name in selection.collinear if name in names),
        robust=robust_test(robust, L, terms, values, (F, k, fit.dof), plan.confidence),
        left_out=_left_out(plan, selection, terms),
    )


def _left_out(plan: Plan, selection: Selection, kept: Sequence[Term]) -> tuple[LeftOut, ...]:
    """Return the candidates that a fit does not support, each with the reason."""
    short = (
        f"varies here, beyond the terms kept, by less than {LEAST:g} of its variance in the table; "
        "its effect is part of the constant and of these terms"
    )
    cancel = "its coefficient and others would cancel, each larger than the response's range"
    return tuple(
        LeftOut(str(term), reason)
        for places, reason in ((selection.short, short), (selection.cancelling, cancel))
        for j, term in enumerate(plan.terms)
        if j in places and term not in kept
    )


def _runner_up(selection: Selection) -> RunnerUp | None:
    best = selection.runner_up
    return None if best is None else RunnerUp(best.term, best.F, best.p, selection.F_to_enter)

"""Rows cut into segments and branches, each of which is fitted.

Edges are given, or found where they are worth their coefficients; branches are the rows of
heating and of cooling, by the sign of a rate.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.terms import evaluate_terms
from multipos.regression.hysteresis import BRANCHES, branch_of
from multipos.regression.observations import Data, Rows
from multipos.regression.piecewise import Plan, fit_continuous, fit_segment
from multipos.regression.result import format_span
from multipos.regression.runs import within_runs
from multipos.regression.segment import Segment
from multipos.regression.segmentation import check_edges, find_edges, segment_of
from multipos.regression.whitening import Noise, find_noise, whitening_of


@dataclass(frozen=True)
class Cut:
    """How rows are cut: at edges of a variable, and by the sign of a rate."""

    variable: str | None
    edges: tuple[float, ...]
    continuous: bool
    branch_column: str | None


def settle_edges(
    plan: Plan,
    data: Data,
    variable: str | None,
    given: tuple[float, ...] | None,
    min_rows: int | None,
) -> tuple[tuple[float, ...], tuple[str, ...]]:
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
        check_edges(variable, given, data.columns[variable])
        return given, ()
    edges = _find_edges(plan, data, variable, min_rows)
    if not edges:
        return (), (f"no edge in {variable} is worth its coefficients: one segment",)
    return edges, ()


def _find_edges(plan: Plan, data: Data, variable: str, min_rows: int | None) -> tuple[float, ...]:
    p = len(plan.terms)
    minimum = 2 * p if min_rows is None else min_rows
    if minimum <= p and plan.method == "full":
        raise UsageError(f"--min-rows must be above the number of terms, {p}; got {minimum}.")
    design, data = within_runs(evaluate_terms(plan.terms, data.columns, len(data)), data)
    values = data.columns[variable]
    response = data.response
    if data.order is not None:
        # what five segments leave is close to noise alone, whatever the edges will be
        bins = np.unique(np.quantile(values, [0.2, 0.4, 0.6, 0.8]))
        noise = _noise(design, data, segment_of(values, bins.tolist()))
        whitening = whitening_of(data.order, noise)
        if whitening is not None:
            design, response = whitening(design), whitening(response)
    return find_edges(values, design, response, minimum=minimum)


def _noise(design: Array, data: Data, place: Rows) -> Noise | None:
    """Return what is told of the noise that fits to the rows of each place leave."""
    apart = [np.where((place == i)[:, np.newaxis], design, 0.0) for i in np.unique(place)]
    return find_noise(np.column_stack(apart), data.response, data.order)


@dataclass(frozen=True)
class _Branch:
    """Rows of one sign of the rate, or all where `name` is None, and the segment of each."""

    name: str | None
    rows: Rows
    place: Rows


def _branches(data: Data, cut: Cut) -> list[_Branch]:
    n = len(data)
    place = np.zeros(n, dtype=np.intp)
    if cut.variable is not None:
        place = segment_of(data.columns[cut.variable], cut.edges)
    if cut.branch_column is None:
        return [_Branch(None, np.arange(n), place)]
    sign = branch_of(data.columns[cut.branch_column], data.run)
    return [
        _Branch(name, np.flatnonzero(sign == b), place[sign == b])
        for b, name in enumerate(BRANCHES)
    ]


def fit_cut(plan: Plan, data: Data, cut: Cut) -> list[Segment]:
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
    data = replace(data, noise=_noise(design, within, place))
    return [segment for branch in branches for segment in fit(plan, data, cut, branch)]


def _fit_joined(plan: Plan, data: Data, cut: Cut, branch: _Branch) -> list[Segment]:
    """Return the segments of one branch without a jump at the edges."""
    variable, spans = _spans(plan, data, cut)
    for number, span in enumerate(spans):
        if number not in branch.place:
            empty = _segment_name(number, variable, span, branch)
            raise MultiposError(f"{empty} has no rows; move the edge, or give more rows.")
    where = "the continuous model" if branch.name is None else f"the {branch.name} branch"
    rows = data.take(branch.rows)
    return fit_continuous(plan, rows, variable, cut.edges, spans, branch.name, where)


def _fit_apart(plan: Plan, data: Data, cut: Cut, branch: _Branch) -> list[Segment]:
    """Return the segments of one branch, each fitted by itself."""
    variable, spans = _spans(plan, data, cut)
    segments = []
    for number, span in enumerate(spans):
        where = "the table"
        if cut.edges or branch.name:
            where = _segment_name(number, variable, span, branch)
        mine = branch.rows[branch.place == number]
        some = data if len(mine) == len(data) else data.take(mine)
        segments.append(fit_segment(plan, some, variable, span, branch.name, where))
    return segments


def _spans(plan: Plan, data: Data, cut: Cut) -> tuple[str, list[tuple[float, float]]]:
    """Return the variable that segments lie along, and from where to where each goes."""
    variable = cut.variable or plan.variables[0]
    values = data.columns[variable]
    return variable, list(pairwise([float(values.min()), *cut.edges, float(values.max())]))


def _segment_name(number: int, variable: str, span: tuple[float, float], branch: _Branch) -> str:
    return f"segment {number + 1} ({format_span(variable, span, branch.name)})"

"""Rows cut into segments, each of which is fitted by itself, or all at once without a jump.

`settle_edges` returns the edges that are given, or finds them where they lower the criterion of
`multipos.regression.segmentation`. `fit_cut` returns the fitted segments.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.terms import evaluate_terms
from multipos.regression.observations import Data, Rows
from multipos.regression.piecewise import Plan, fit_segments
from multipos.regression.runs import within_runs
from multipos.regression.segment import Segment, format_span
from multipos.regression.segmentation import Joined, check_edges, find_edges, hinges, segment_of
from multipos.regression.variation import term_variances
from multipos.regression.whitening import Noise, find_noise, whitening_of
from multipos.results import frozen


@frozen(eq=True)
class Cut:
    """How rows are cut: at edges of a variable, and whether the model may jump there."""

    variable: str | None
    edges: tuple[float, ...]
    continuous: bool


def settle_edges(
    plan: Plan,
    data: Data,
    variable: str | None,
    given: tuple[float, ...] | None,
    min_rows: int | None,
    *,
    free: bool,
) -> tuple[float, ...]:
    """Return the edges that are given or found.

    Raises
    ------
    MultiposError
        An edge is outside the data.
    UsageError
        `min_rows` are no more than the terms.
    """
    if variable is None:
        return ()
    values = data.columns[variable]
    if given is not None:
        check_edges(variable, given, values)
        return given
    p = len(plan.terms)
    minimum = 2 * p if min_rows is None else min_rows
    if minimum <= p and plan.limits is None:
        raise UsageError(f"--min-rows must be above the number of terms, {p}; got {minimum}.")
    read = data
    design, data = within_runs(evaluate_terms(plan.terms, data.columns, len(data)), data)
    response = data.response
    # what five segments leave is close to noise alone, whatever the edges will be
    bins = np.unique(np.quantile(values, [0.2, 0.4, 0.6, 0.8]))
    noise = _noise(design, data, segment_of(values, bins.tolist()))
    whitening = whitening_of(data.order, noise)
    if whitening is not None:
        design, response = whitening(design), whitening(response)

    def adjust(columns: Array) -> Array:
        within = within_runs(columns, read)[0]
        return within if whitening is None else whitening(within)

    joined = None
    if not free and hinges(plan.terms, variable, [0.0], both=False):
        joined = Joined(plan.terms, variable, read.columns, adjust)
    return find_edges(values, design, response, minimum=minimum, joined=joined)


def _noise(design: Array, data: Data, place: Rows) -> Noise | None:
    """Return what is known of the noise that fits to the rows of each place leave."""
    apart = [np.where((place == i)[:, np.newaxis], design, 0.0) for i in np.unique(place)]
    return find_noise(np.column_stack(apart), data.response, data.order)


def fit_cut(plan: Plan, data: Data, cut: Cut) -> list[Segment]:
    """Return the fitted segments, by ascending range.

    Raises
    ------
    MultiposError
        A segment has no rows, or fewer than terms, or terms that its rows cannot tell apart.
    """
    variable = cut.variable or plan.variables[0]
    values = data.columns[variable]
    place = segment_of(values, cut.edges)
    design, within = within_runs(evaluate_terms(plan.terms, data.columns, len(data)), data)
    noise, variances = _noise(design, within, place), term_variances(plan.terms, data.columns)
    data = replace(data, noise=noise, variances=variances)
    spans = list(pairwise([float(values.min()), *cut.edges, float(values.max())]))
    if not cut.edges:
        return fit_segments(plan, data, variable, (), spans, "the table", alone=True)
    named = [f"segment {i} ({format_span(variable, s, None)})" for i, s in enumerate(spans, 1)]
    for number, where in enumerate(named):
        if number not in place:
            raise MultiposError(f"{where} has no rows; move the edge, or give more rows.")
    if cut.continuous:
        return fit_segments(plan, data, variable, cut.edges, spans, "the continuous model")
    segments = []
    for number, (span, where) in enumerate(zip(spans, named, strict=True)):
        some = data.take(np.flatnonzero(place == number))
        segments += fit_segments(plan, some, variable, (), (span,), where)
    return segments

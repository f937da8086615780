"""Segments: where one variable is cut so that a model per piece explains the response best.

`segment_of` returns the segment of each row, `check_edges` refuses edges outside the data, and
`find_edges` returns those that explain the response best. `hinges` are the columns that let terms
change at edges without a jump, `residual_sum` is that of all columns of a triangle.

**Edges.** The rows are sorted by the variable and cut into fine bins; each bin is compressed to a
triangle (`multipos.numerics.selection`), and the rows from bin i to bin j are the triangles
between, joined. With c(i, j) the residual sum of the whole list of terms there, the best m segments
follow from the best m − 1 (Bellman),

    D_1(j) = c(0, j),      D_m(j) = min_i D_{m−1}(i) + c(i, j),                             (1)

no segment with fewer rows than asked. Their number is what makes

    n ln(D_m/n) + (m p + m − 1) ln n                                                       (2)

smallest: p coefficients a segment, and every edge counts. Before they are compared, each edge moves
to the best of finer cuts between its neighbouring bins, or a jump inside a bin would ask for a
segment of its own. Where rows are correlated in time, they are made independent first
(`multipos.regression.whitening`).

**No jump.** A correction that jumps at an edge is a step in the output. With the edge e of variable
v, a term r v^k that carries v gets a second column beside it,

    h(row) = r (v^k − e^k) above e,    0 below,                                            (3)

which is zero at the edge whatever r is; the fit over all segments at once is then continuous, and
the coefficients of each segment are sums of those of (3): d of v^k r, and −d e^k of r. Where terms
are chosen one by one, its mirror image below the edge is a candidate too, or a term of the lowest
segment alone would need two columns at once.

Where edges are looked for, those of (1) are where it begins. With the c coefficients d of (3) at
an edge,

    −Σ d k e^(k−1) r above e,    0 below                                                   (4)

is the column of a change of e: Gauss–Newton steps, halved until they lessen the residual sum of all
rows, move the edges, and (2) counts p + (m − 1)(c + 1) for its m p + m − 1.

Sources: R. Bellman, Commun. ACM 4, 1961; J. Bai, P. Perron, J. Appl. Econometrics 18, 2003;
Y.-C. Yao, Statist. Probab. Lett. 6, 1988 (the penalty); V. M. R. Muggeo, Statist. Med. 22, 2003
(moving edges).
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from math import log

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import number
from multipos.numerics.arrays import Array, Places
from multipos.numerics.factoring import column_scales
from multipos.numerics.factors import Factor
from multipos.numerics.selection import Triangle, compress, join
from multipos.numerics.terms import Term
from multipos.results import frozen

Rows = Places

MOST = 6  # segments that are looked for
_BINS = 48  # candidate edges and one: every pair of them is fitted
_STEPS = 20  # that edges may move without a jump
_SHORTEST = 0.1  # part of a step that is still tried
_SETTLED = 1e-6  # relative change of the residual sum at which edges stay


@frozen(eq=True)
class Hinge:
    """A column of eq. (3): the term, and the edge above or below which it acts."""

    term: Term
    variable: str
    edge: float
    above: bool = True

    def __str__(self) -> str:
        side = "above" if self.above else "below"
        return f"{self.term} {side} {self.variable} = {self.edge:.10g}"

    @property
    def power(self) -> int:
        """Power of the segment variable in the term."""
        return next(f.power for f in self.term.factors if f.variable == self.variable)

    @property
    def rest(self) -> Term:
        """The term without the segment variable: what keeps it continuous at the edge."""
        return Term(tuple(f for f in self.term.factors if f.variable != self.variable))

    def evaluate(self, columns: Mapping[str, Array]) -> Array:
        """Return the column."""
        v = columns[self.variable]
        power = Term((Factor("v", self.power),))
        lift = power.evaluate({"v": v}) - power.evaluate({"v": self.edge})
        here = (v >= self.edge) == self.above
        return np.asarray(np.where(here, lift * self.rest.evaluate(columns), 0.0))

    def acts(self, edges_below: Sequence[float]) -> bool:
        """Tell whether it acts in the segment that has these edges below it."""
        return (self.edge in edges_below) == self.above


def hinges(
    terms: Sequence[Term], variable: str, edges: Sequence[float], *, both: bool
) -> tuple[Hinge, ...]:
    """Return the columns that let terms change at edges without a jump, eq. (3); both sides'."""
    carrying = [  # |v| bends at zero and nowhere else, so it stays as it is
        term
        for term in terms
        if any(f.variable == variable and f.power and not f.function for f in term.factors)
    ]
    sides = (True, False) if both else (True,)
    return tuple(
        Hinge(t, variable, edge, side) for side in sides for edge in edges for t in carrying
    )


def segment_of(values: Array, edges: Sequence[float]) -> Places:
    """Return the number of the segment of each row, from 0; an edge belongs to the one above."""
    return np.searchsorted(np.asarray(edges, dtype=np.float64), values, side="right")


@frozen
class Joined:
    """A model without a jump at its edges, eq. (3).

    Attributes
    ----------
    terms : sequence of Term
    variable : str
    columns : mapping of str to (n,) array
        Of the variables of the terms, in the order of the response.
    adjust : function
        Makes of columns (n, q) those of independent rows.
    """

    terms: Sequence[Term]
    variable: str
    columns: Mapping[str, Array]
    adjust: Callable[[Array], Array]

    @property
    def values(self) -> int:
        """Different values of the variable that determine its highest power in one segment."""
        return 1 + max(h.power for h in hinges(self.terms, self.variable, [0.0], both=False))

    def changes(self, edges: Sequence[float]) -> Array:
        """Return the columns of eq. (3) beside one another, edge by edge (n, (m − 1) c)."""
        every = hinges(self.terms, self.variable, edges, both=False)
        return self.adjust(np.column_stack([h.evaluate(self.columns) for h in every]))

    def moves(self, edges: Sequence[float], d: Array) -> Array:
        """Return the columns of eq. (4), one for each edge (n, m − 1)."""
        above = [self.columns[self.variable] >= edge for edge in edges]
        found = np.zeros((len(above[0]), len(edges)))
        for h, size in zip(hinges(self.terms, self.variable, edges, both=False), d, strict=True):
            i = edges.index(h.edge)
            slope = size * h.power * h.edge ** (h.power - 1)
            found[:, i] -= np.where(above[i], slope * h.rest.evaluate(self.columns), 0.0)
        return self.adjust(found)


def find_edges(
    values: Array, design: Array, response: Array, *, minimum: int, joined: Joined | None = None
) -> tuple[float, ...]:
    """Return the edges that explain the response best, by eqs. (1) and (2).

    Parameters
    ----------
    values : (n,) array
        The variable to cut.
    design : (n, p) array
        All candidate terms.
    response : (n,) array
    minimum : int
        Fewest rows of a segment.
    joined : Joined, optional
        The model where it may not jump at an edge.

    Returns
    -------
    tuple of float
        In ascending order; empty where one segment does.
    """
    n, p = design.shape
    order = np.argsort(values, kind="stable")
    v = values[order]
    X, y = design[order] / column_scales(design), response[order]
    data = _Sorted(v, X, y, _cuts(v, minimum), minimum, 1 if joined is None else joined.values)
    cost = _costs(data)
    best, score = cost[0], np.inf
    chosen: tuple[float, ...] = ()
    last: list[Rows] = []
    # of a response that is nothing throughout no logarithm is lost
    least_rss = max((1e-12 * float(np.linalg.norm(y))) ** 2, float(np.finfo(float).tiny))
    for m in range(1, MOST + 1):
        if m > 1:
            if len(best) < 2:  # rows make no more segments
                break
            total = best[:-1, np.newaxis] + cost[1:]
            last.append(total.argmin(axis=0))
            best = total.min(axis=0)
        if not np.isfinite(best[-1]):
            break
        rss, rows = _polish(data, _trace(last, len(data.bins)))
        edges = tuple(float(v[i - 1] + v[i]) / 2.0 for i in rows)
        count = m * p + m - 1
        if joined is not None and edges:
            rss, edges = _move(joined, edges, design, response, data)
            count = p + len(edges) + len(hinges(joined.terms, joined.variable, edges, both=False))
        bic = n * log(max(rss, least_rss) / n) + count * log(n)
        if bic < score:
            score, chosen = bic, edges
    return chosen


class _Sorted:
    """Rows sorted by the segment variable, with triangles of their bins ready made."""

    def __init__(
        self, v: Array, X: Array, y: Array, cuts: Sequence[int], minimum: int, values: int
    ) -> None:
        self.v, self.X, self.y, self.cuts = v, X, y, cuts
        self.minimum, self.values = minimum, values  # of a segment, at the least
        self.distinct = np.cumsum(np.diff(v, prepend=v[0]) > 0.0)
        self.bins = [compress(X[a:b], y[a:b]) for a, b in pairwise(cuts)]

    def enough(self, start: int, end: int) -> bool:
        """Tell whether rows start … end make a segment, by their number and by their values."""
        if end - start < max(self.minimum, 1):
            return False
        return bool(self.distinct[end - 1] - self.distinct[start] + 1 >= self.values)

    def triangle(self, start: int, end: int) -> Triangle:
        """Return the triangle of rows start … end, of whole bins where they are inside."""
        first, last = bisect_left(self.cuts, start), bisect_right(self.cuts, end) - 1
        if first >= last:
            return compress(self.X[start:end], self.y[start:end])
        parts = list(self.bins[first:last])
        for a, b in ((start, self.cuts[first]), (self.cuts[last], end)):
            if a < b:
                parts.append(compress(self.X[a:b], self.y[a:b]))
        return join(parts)


def _polish(data: _Sorted, bins: Sequence[int]) -> tuple[float, tuple[int, ...]]:
    """Move one edge after another among finer cuts; return the residual sum and the rows."""
    n, cuts = len(data.v), data.cuts
    edges = [cuts[i] for i in bins]
    for i, place in enumerate(bins):
        start, end = (edges[i - 1] if i else 0), (edges[i + 1] if i + 1 < len(edges) else n)
        low = max(cuts[place - 1], start + data.minimum)
        high = min(cuts[place + 1], end - data.minimum)
        finer = _between(data.v, low, high)
        fine = [j for j in finer if data.enough(start, j) and data.enough(j, end)]
        fine = sorted({edges[i], *fine})
        if len(fine) > 1:
            edges[i] = _best_edge(data, start, fine, end)
    rss = sum(residual_sum(data.triangle(a, b)) for a, b in pairwise((0, *edges, n)))
    return rss, tuple(edges)


def _best_edge(data: _Sorted, start: int, fine: Sequence[int], end: int) -> int:
    """Return the one of some rows at which start … end is cut with the least residual sum."""
    parts = [data.triangle(a, b) for a, b in pairwise((start, *fine, end))]
    left = list(accumulate(parts[:-1], lambda a, b: join([a, b])))
    right = list(accumulate(parts[:0:-1], lambda a, b: join([a, b])))[::-1]
    costs = [residual_sum(a) + residual_sum(b) for a, b in zip(left, right, strict=True)]
    return fine[int(np.argmin(costs))]


def _move(
    joined: Joined, edges: tuple[float, ...], design: Array, response: Array, data: _Sorted
) -> tuple[float, tuple[float, ...]]:
    """Move edges without a jump to where all rows have the least residual sum, eq. (4)."""
    p = design.shape[1]

    def solve(columns: Array) -> tuple[float, Array]:
        scale = column_scales(columns)
        rss, b = _fitted(compress(columns / scale, response))
        return rss, b / scale

    columns = np.column_stack([design, joined.changes(edges)])
    rss, b = solve(columns)
    for _ in range(_STEPS):
        least, both = solve(np.column_stack([columns, joined.moves(edges, b[p:])]))
        if least > (1.0 - _SETTLED) * rss:
            break
        step, before, part = both[-len(edges) :], rss, 1.0
        while rss == before and part > _SHORTEST:
            tried = tuple(float(e) for e in np.asarray(edges) + part * step)
            part /= 2.0
            rows = np.searchsorted(data.v, tried).tolist()
            if not all(data.enough(a, b) for a, b in pairwise((0, *rows, len(data.v)))):
                continue
            there = np.column_stack([design, joined.changes(tried)])
            less, coefficients = solve(there)
            if less < rss:
                rss, edges, columns, b = less, tried, there, coefficients
        if rss > (1.0 - _SETTLED) * before:
            break
    return rss, edges


def _between(v: Array, low: int, high: int) -> list[int]:
    """Rows before which sorted values may be cut, evenly from low to high, both included."""
    wanted = np.unique(np.linspace(low, high, _BINS + 1).astype(int))
    return sorted({int(np.searchsorted(v, v[i], side="left")) for i in wanted if i < len(v)})


def _cuts(v: Array, minimum: int) -> list[int]:
    """Rows before which sorted values may be cut: quantiles, never between equal values."""
    n = len(v)
    wanted = np.linspace(0, n, min(_BINS, max(1, 4 * n // max(minimum, 1))) + 1).astype(int)
    inner = [int(np.searchsorted(v, v[i], side="left")) for i in wanted[1:-1]]
    return sorted({0, n, *inner})


def _costs(data: _Sorted) -> Array:
    """c(i, j) of eq. (1) as cost[i, j − 1]: residual sums of bins i … j − 1, inf where too few."""
    bins, cuts = data.bins, data.cuts
    cost = np.full((len(bins), len(bins)), np.inf)
    for i in range(len(bins)):
        whole = None
        for j in range(i, len(bins)):
            whole = bins[j] if whole is None else join([whole, bins[j]])
            if data.enough(cuts[i], cuts[j + 1]):
                cost[i, j] = residual_sum(whole)
    return cost


def residual_sum(triangle: Triangle) -> float:
    """Return the residual sum of all columns, of which some may say the same."""
    return _fitted(triangle)[0]


def _fitted(triangle: Triangle) -> tuple[float, Array]:
    """Return the residual sum of all columns, and their coefficients."""
    X, y = triangle.R[:, :-1], triangle.R[:, -1]
    b = np.asarray(np.linalg.lstsq(X, y, rcond=1e-10)[0], dtype=np.float64)
    return float(((y - X @ b) ** 2).sum()), b


def _trace(last: Sequence[Rows], bins: int) -> tuple[int, ...]:
    """Return the bins that begin the second and later segments, from the choices of eq. (1)."""
    found: list[int] = []
    j = bins - 1
    for choice in reversed(last):
        i = int(choice[j])
        found.append(i + 1)
        j = i
    return tuple(reversed(found))


def check_edges(variable: str, edges: Sequence[float], values: Array) -> None:
    """Refuse an edge outside the data."""
    low, high = float(values.min()), float(values.max())
    for edge in edges:
        if not low < edge < high:
            raise MultiposError(
                f"the edge {variable} = {edge:.10g} is outside the data, which run from "
                f"{number(low, 6)} to {number(high, 6)}; give edges between."
            )

"""Stepwise selection of terms: forward with removal, on any list of columns.

`compress` factors a design and its response once, and `join` makes of several such triangles that
of all their rows. `thresholds` makes of options when a term goes in and out. `select_stepwise`
returns the columns chosen with every step of the way, `coefficients` those of some columns by least
squares. `akaike_criterion` is that of a fitted model, for few data.

A design X (n, p) and a response y are factored once, [X y] = Q R, and R (p + 1 columns, as many
rows) stands for all n rows from then on: whatever subset S of the columns is fitted,

    min |y − X_S b| = min |R_y − R_S b|,                                                   (1)

so a step costs operations on a small triangle however long the log is, and nothing is squared
or subtracted that a fit to all rows would not. With k columns in the model, e its residual and
z_j what column j has that the model has not, on R,

    F to enter  = (z_j'e)²/(z_j'z_j) / s_j²,   s_j² = |e − z_j (z_j'e)/(z_j'z_j)|² / (n − k − 1),
    F to remove = b_j² / (s² C_jj),            s² = |e|² / (n − k),                         (2)

each on 1 and the degrees of freedom of its s². Forward selection with removal [1]_ looks for a
term to remove (the weakest, where its p is above `remove`), then for one to add (the strongest,
where its p is below `enter`), until neither is there.

**It ends.** With enter ≤ remove, a term goes in only where it divides the residual sum by more than
1 + F_in/ν, and out only where that multiplies it by less than 1 + F_out/ν, at the same ν, and
F_in ≥ F_out. A cycle crosses every ν as often up as down and would end with a smaller residual sum
than it began with: there is none. Where rounding makes one, what stood before ends the search.

**Guard.** A column whose z_j is less than 1e-5 of the column itself (beyond the terms that are
always in) has half its digits in common with the model: it is not entered, and named. Who
selects may ask for more of a column (`Guard`): a length of its own on the rows as they are, and
coefficients that do not cancel each other.

The criterion of a model with q coefficients and residual sum rss on n rows, counting the variance
(the smaller the better), is [2]_

    AICc = n ln(rss/n) + 2 K + 2 K (K + 1)/(n − K − 1),   K = q + 1.

References
----------
.. [1] M. A. Efroymson, Multiple regression analysis, in A. Ralston, H. S. Wilf (eds.),
   Mathematical Methods for Digital Computers, Wiley 1960.
.. [2] C. M. Hurvich, C.-L. Tsai, Biometrika 76, 1989.
"""

from collections.abc import Callable, Sequence
from math import inf, log
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.factoring import BLOCK
from multipos.numerics.quantiles import f_quantile, f_tail
from multipos.results import Result, frozen

COLLINEAR = 1e-5  # part of a column's length below which it says nothing of its own
NOTHING = 1e-12  # part of a column's length below which what the forced terms leave is rounding
_EXACT = 1e-14  # part of what the forced terms leave below which a residual is rounding
_ROUNDING = 1e-15  # likewise, of the response as a whole


@frozen
class Triangle:
    """Triangular factor of a design and its response, which stands for all rows, eq. (1).

    Attributes
    ----------
    R : (q, p + 1) array
        q = p + 1, or the number of rows where there are fewer; the response is the last column.
    rows : int
    """

    R: Array
    rows: int


class Tested(NamedTuple):
    """A term that could be added or removed at a step, with its F on 1 and `dof`."""

    action: str
    term: str
    F: float
    p: float


@frozen
class Step(Result):
    """One term added or removed: its F and p, the second best, and every term that was tested."""

    step: int
    action: str
    term: str
    F: float
    p: float
    dof: int
    runner_up: Tested | None
    tested: tuple[Tested, ...]


@frozen(eq=True)
class Selection:
    """Columns chosen, and how.

    Attributes
    ----------
    columns : tuple of int
        In ascending order.
    path : tuple of Step
    runner_up : Tested or None
        The strongest term left outside the final model.
    F_to_enter : float
        What the runner-up would have needed.
    collinear : tuple of str
        Terms that share their digits with the model.
    short, cancelling : tuple of int
        Columns that a `Guard` kept out: too little of their own, or coefficients that cancel.
    """

    columns: tuple[int, ...]
    path: tuple[Step, ...] = ()
    runner_up: Tested | None = None
    F_to_enter: float = float("nan")
    collinear: tuple[str, ...] = ()
    short: tuple[int, ...] = ()
    cancelling: tuple[int, ...] = ()


class Guard(NamedTuple):
    """What a column must have to be entered, beside its F.

    Attributes
    ----------
    triangle : Triangle
        Of the rows as they are, where those of the selection are whitened.
    least : (p,) array
        Length of a column outside the model below which it stays out.
    cancel : function
        From columns and their coefficients to whether these cancel each other.
    """

    triangle: Triangle
    least: Array
    cancel: Callable[[Sequence[int], Array], bool]


@frozen(eq=True)
class Thresholds:
    """When a term goes in and out: by p (`enter`, `remove`), or by F where `f_enter` is given."""

    enter: float = 0.05
    remove: float = 0.10
    f_enter: float | None = None
    f_remove: float | None = None

    def __post_init__(self) -> None:
        """Refuse thresholds that would let a term go in and out for ever."""
        if (self.f_enter is None) != (self.f_remove is None):
            raise UsageError("--f-enter and --f-remove go together; give both.")
        if self.f_enter is not None and self.f_remove is not None:
            if not 0.0 <= self.f_remove <= self.f_enter < np.inf:
                raise UsageError(
                    f"--f-remove must not be above --f-enter, or terms go in and out for ever, and "
                    f"both finite; got {self.f_enter:g} and {self.f_remove:g}."
                )
        elif not 0.0 < self.enter <= self.remove <= 1.0:
            raise UsageError(
                f"--remove must not be below --enter, or terms go in and out for ever, and both "
                f"between 0 and 1; got {self.enter:g} and {self.remove:g}."
            )

    def enters(self, found: Tested) -> bool:
        """Tell whether a tested term is strong enough to go in."""
        return found.p < self.enter if self.f_enter is None else self.f_enter < found.F

    def leaves(self, found: Tested) -> bool:
        """Tell whether a tested term is weak enough to go out."""
        return found.p > self.remove if self.f_remove is None else self.f_remove > found.F

    def needed(self, dof: int) -> float:
        """Return the F that a term needs to go in."""
        return f_quantile(1.0 - self.enter, 1, dof) if self.f_enter is None else self.f_enter


def thresholds(
    enter: float | None, remove: float | None, f_enter: float | None, f_remove: float | None
) -> Thresholds:
    """Return the thresholds that options state; p thresholds and F thresholds exclude each other.

    The defaults are .05 and .10; beside a stated one that does not fit them, twice or half of it.
    """
    if (enter is not None or remove is not None) and (f_enter is not None or f_remove is not None):
        raise UsageError("--enter and --remove are p, --f-enter and --f-remove F; give one kind.")
    if enter is None:
        enter = 0.05 if remove is None else min(0.05, remove / 2.0)
    if remove is None:
        remove = 0.10 if enter < 0.10 else min(2.0 * enter, 1.0)
    return Thresholds(enter, remove, f_enter, f_remove)


def compress(design: ArrayLike, response: ArrayLike) -> Triangle:
    """Factor a design (n, p) and response (n,) once for all subsets, eq. (1)."""
    X, y = np.asarray(design, dtype=np.float64), np.asarray(response, dtype=np.float64)
    n, p = X.shape
    limit = max(2 * (p + 1), BLOCK // (p + 1))
    parts = [
        _triangular(np.column_stack((X[i : i + limit], y[i : i + limit])))
        for i in range(0, n, limit)
    ]
    return join([Triangle(R, min(limit, n - i * limit)) for i, R in enumerate(parts)])


def join(parts: Sequence[Triangle]) -> Triangle:
    """Return the triangle of the rows of several triangles together."""
    rows = sum(part.rows for part in parts)
    factors = [part.R for part in parts]
    width = factors[0].shape[1]
    while len(factors) > 1:  # a tree: triangles are stacked while they fit the cache
        group = max(2, BLOCK // width**2)
        factors = [
            _triangular(np.vstack(factors[i : i + group])) for i in range(0, len(factors), group)
        ]
    return Triangle(factors[0], rows)


def _triangular(a: Array) -> Array:
    return np.asarray(np.linalg.qr(a, mode="r"))


def coefficients(triangle: Triangle, columns: Sequence[int]) -> Array:
    """Return those of some columns, which are independent, by least squares."""
    Q, R = np.linalg.qr(triangle.R[:, list(columns)])
    return np.asarray(np.linalg.solve(R, Q.T @ triangle.R[:, -1]))


def select_stepwise(
    triangle: Triangle,
    names: Sequence[str],
    limits: Thresholds,
    *,
    forced: Sequence[int] = (),
    requires: Sequence[frozenset[int]] | None = None,
    guard: Guard | None = None,
) -> Selection:
    """Select columns forward with removal, starting from those that are forced.

    Parameters
    ----------
    triangle : Triangle
    names : sequence of p str
    limits : Thresholds
    forced : sequence of int
        Columns that are always in.
    requires : sequence of p sets of int, optional
        Columns that must be in before a column may enter, and stay while it is in.
    guard : Guard, optional

    Returns
    -------
    Selection
    """
    search = _TermSearch(triangle, names, forced, requires, guard)
    path: list[Step] = []
    stood: set[tuple[frozenset[int], ...]] = set()
    while (now := (frozenset(search.inside), frozenset(search.cancelling))) not in stood:
        stood.add(now)
        removable, addable = search.removable(), search.addable()
        tested = (*removable, *addable)
        out = min(removable, key=lambda t: t.F, default=None)
        best = max(addable, key=lambda t: t.F, default=None)
        if out is not None and limits.leaves(out):
            rest = [t for t in removable if t is not out]
            runner_up = min(rest, key=lambda t: t.F, default=None)
            path.append(search.take(len(path) + 1, out, runner_up, tested))
        elif best is not None and limits.enters(best) and search.cancels(best):
            search.refuse(best)
        elif best is not None and limits.enters(best):
            rest = [t for t in addable if t is not best]
            runner_up = max(rest, key=lambda t: t.F, default=None)
            path.append(search.take(len(path) + 1, best, runner_up, tested))
        else:
            break
    return search.result(path, best, limits)


class _TermSearch:
    """The model as it stands between two steps: which columns are in, and what each would do."""

    def __init__(
        self,
        triangle: Triangle,
        names: Sequence[str],
        forced: Sequence[int],
        requires: Sequence[frozenset[int]] | None,
        guard: Guard | None,
    ) -> None:
        self.triangle = triangle
        X, self.y, self.rows = triangle.R[:, :-1], triangle.R[:, -1], triangle.rows
        # F does not depend on lengths; by powers of two, so that nothing is rounded
        self.X = np.ldexp(X, -np.frexp(np.abs(X).max(axis=0, initial=0.0))[1])
        self.names, self.forced = names, frozenset(forced)
        self.requires = requires or [frozenset()] * len(names)
        self.inside = set(forced)
        self.collinear: set[int] = set()
        self.guard, self.short, self.cancelling = guard, set[int](), set[int]()
        base = _residual(self.X, self._basis(sorted(self.forced)))
        self.scale = np.linalg.norm(base, axis=0)
        self.dead = self.scale <= NOTHING * np.linalg.norm(self.X, axis=0)
        total = float(np.linalg.norm(_residual(self.y, self._basis(sorted(self.forced)))))
        self.exact = max(_EXACT * total, _ROUNDING * float(np.linalg.norm(self.y)))

    def _basis(self, columns: Sequence[int]) -> Array:
        return np.asarray(np.linalg.qr(self.X[:, list(columns)])[0])

    def removable(self) -> list[Tested]:
        """Return F to remove of every term that may go, eq. (2)."""
        columns = sorted(self.inside)
        dof = self.rows - len(columns)
        if dof <= 0 or not columns:
            return []
        Q, R = np.linalg.qr(self.X[:, columns])
        inverse = np.linalg.inv(R)
        b = inverse @ (Q.T @ self.y)
        rss = float((_residual(self.y, Q) ** 2).sum())
        needed = frozenset().union(*(self.requires[j] for j in columns))
        found = []
        for place, j in enumerate(columns):
            if j in self.forced or j in needed:
                continue
            gain = float(b[place] ** 2 / (inverse[place] @ inverse[place]))
            F = gain / (rss / dof) if rss > 0.0 else float("inf")
            found.append(Tested("remove", self.names[j], F, f_tail(F, 1, dof)))
        return found

    def addable(self) -> list[Tested]:
        """Return F to enter of every term that may come in, eq. (2)."""
        Q = self._basis(sorted(self.inside))
        e = _residual(self.y, Q)
        dof = self.rows - len(self.inside) - 1
        if dof <= 0 or float(np.linalg.norm(e)) <= self.exact:
            return []
        outside = [j for j in range(len(self.names)) if j not in self.inside]
        Z = _residual(self.X[:, outside], Q)
        length = np.linalg.norm(Z, axis=0)
        found = []
        self.collinear, self.short = set(), self._too_short(outside)
        for place, j in enumerate(outside):
            if self.dead[j] or length[place] <= COLLINEAR * self.scale[j]:
                self.collinear.add(j)
                continue
            if j in self.short or j in self.cancelling:
                continue
            if not self.requires[j] <= self.inside:
                continue
            z = Z[:, place] / length[place]
            part = float(z @ e)
            rss = float(((e - z * part) ** 2).sum())
            exact = rss <= self.exact**2
            F = float("inf") if exact else part * part / (rss / dof)
            found.append(Tested("add", self.names[j], F, f_tail(F, 1, dof)))
        return found

    def _too_short(self, outside: Sequence[int]) -> set[int]:
        """Return the columns that have less of their own than the guard asks for."""
        if self.guard is None:
            return set()
        X = self.guard.triangle.R[:, :-1]
        Q = np.linalg.qr(X[:, sorted(self.inside)])[0]
        length = np.linalg.norm(_residual(X[:, list(outside)], Q), axis=0)
        short = length < self.guard.least[list(outside)]
        return {j for j, less in zip(outside, short.tolist(), strict=True) if less}

    def cancels(self, found: Tested) -> bool:
        """Tell whether the guard refuses the coefficients with a term that could be added."""
        if self.guard is None:
            return False
        columns = sorted(self.inside | {list(self.names).index(found.term)})
        return self.guard.cancel(columns, coefficients(self.triangle, columns))

    def refuse(self, found: Tested) -> None:
        """Keep a term out for good, for what it makes of the coefficients."""
        self.cancelling.add(list(self.names).index(found.term))

    def take(
        self, step: int, found: Tested, runner_up: Tested | None, tested: tuple[Tested, ...]
    ) -> Step:
        """Add or remove a term, and return the step for the record."""
        column = list(self.names).index(found.term)
        adds = found.action == "add"
        dof = self.rows - len(self.inside) - int(adds)
        if adds:
            self.inside.add(column)
            self.cancelling.clear()  # which they may not do beside the new one
        else:
            self.inside.remove(column)
        return Step(step, found.action, found.term, found.F, found.p, dof, runner_up, tested)

    def result(self, path: list[Step], best: Tested | None, limits: Thresholds) -> Selection:
        """Return the model as it stands."""
        dof = self.rows - len(self.inside) - 1
        collinear = tuple(self.names[j] for j in sorted(self.collinear - self.inside))
        needed = limits.needed(dof) if best is not None else float("nan")
        return Selection(
            columns=tuple(sorted(self.inside)),
            path=tuple(path),
            runner_up=best,
            F_to_enter=needed,
            collinear=collinear,
            short=tuple(sorted(self.short - self.inside)),
            cancelling=tuple(sorted(self.cancelling)),
        )


def _residual(columns: Array, basis: Array) -> Array:
    """What columns have outside a basis; twice, so that rounding of the first pass goes too."""
    once = columns - basis @ (basis.T @ columns)
    return np.asarray(once - basis @ (basis.T @ once))


def akaike_criterion(rss: float, n: int, coefficients: int) -> float:
    """Return AICc of a model; inf where there are too few rows for it."""
    if not rss > 0.0:
        return -inf
    K = coefficients + 1
    if n <= K + 1:
        return inf
    return n * log(rss / n) + 2 * K + 2 * K * (K + 1) / (n - K - 1)

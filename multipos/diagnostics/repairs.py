"""The one repair that would explain readings which no linear sensor explains.

`look` returns the linear view of a calibration and `listed_reference` the reference that it holds;
`candidates` are the best repairs of each kind. `explain_failure` names rows in another unit, which
`rows_in_another_unit` finds, where a fit ends with an error, and `refuse_drowned` refuses readings
of which one drowns the others.

A row may belong to another position, have been taken upside down, or stand in another unit; a
converter may have wrapped around; angles may have been radians. Each such repair is tried, on the
linear view of the readings; `gross_errors` says which one is accepted.

**Changes.** All changes of readings y' = y + d v' in a few rows have closed forms: with M = I − QQ'
the projector on the residuals, r = M y,

    rss' = rss + 2 d (v·r) + d² v'Mv.                                                       (1)

One row k with columns x and residual e may have had others, x' and y'. With G = (X'X)⁻¹, β the
coefficients and h = x'Gx its leverage, the other rows leave rss − e²/(1 − h), and it adds

    r²/v,    r = y' − x''β + (x''Gx) e/(1 − h),    v = 1 + x''Gx' + (x''Gx)²/(1 − h).       (2)

**Another unit.** Wherever a triad at rest points, its readings are of one size, but for bias and
scale factors:

    |y_k| = |b + K f_k|,    a third to three times the median for a bias below half a g.    (3)

A row beyond that by a factor that two units have between them is in another one. Such a row leaves
no ellipsoid on which the readings could lie, so the estimator fails, and this says why.

**The linear view** is the plainest picture there is, whatever model was fitted and however
uncertain the positions were: least squares of

    y_k = b + K u_k,                                                                        (4)

with u the reference as listed [g], y (M,) the readings, b and K (M, 3), and terms of other
columns beside them where the model has any. What no linear sensor explains is measured by

    rho = sqrt(mean over outputs of  s_i² / |K_i|²),                                        (5)

s_i the residual standard deviation of output i and |K_i| its response to one g: the residual
as a share of the signal. Misplacement by two degrees makes it .035, noise alone about 1.
Sensor models of second and third order change it by their own size, a percent or so.
"""

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import listed
from multipos.numerics.arrays import COMPONENTS, SMALLEST, Array, Mask, Places, median
from multipos.positions.order import lay_out
from multipos.positions.readings import Readings
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY, cos_deg, sin_deg

_RANK = 1e-9  # of the largest singular value: columns of a roll that stays in one plane


@frozen
class View:
    """Readings under eq. (4).

    Attributes
    ----------
    even, odd : (n, a), (n, b) arrays
        Columns that keep and that change their sign with the reference; the first three of `odd`
        are the reference [g].
    values : (n, M) array
    """

    even: Array
    odd: Array
    values: Array

    @cached_property
    def _decomposed(self) -> tuple[Array, Array, Array]:
        design = np.hstack([self.even, self.odd])
        left, size, right = np.linalg.svd(design, full_matrices=False)
        kept = size > _RANK * size[0]
        return left[:, kept], size[kept], right[kept]

    @property
    def basis(self) -> Array:
        """An orthonormal basis (n, r) of what eq. (4) can give."""
        return self._decomposed[0]

    @cached_property
    def residuals(self) -> Array:
        """What eq. (4) leaves (n, M)."""
        basis = self.basis
        return np.asarray(self.values - basis @ (basis.T @ self.values))

    @cached_property
    def sensitivity(self) -> Array:
        """K (M, 3); zero along what the positions do not show."""
        left, size, right = self._decomposed
        coefficients = right.T @ ((left.T @ self.values) / size[:, None])
        first = self.even.shape[1]
        return np.asarray(coefficients[first : first + 3].T)

    @property
    def dof(self) -> int:
        """Degrees of freedom of one output."""
        return len(self.values) - len(self._decomposed[1])

    @cached_property
    def response(self) -> Array:
        """|K_i| (M,), never quite zero."""
        least_norm = 1e-12 * float(np.abs(self.values).max()) + np.finfo(float).tiny
        return np.asarray(np.maximum(np.linalg.norm(self.sensitivity, axis=1), least_norm))

    @cached_property
    def misfit(self) -> float:
        """rho of eq. (5); NaN without degrees of freedom."""
        if self.dof <= 0:
            return float("nan")
        squares = np.sum((self.residuals / self.response) ** 2, axis=0)
        return float(np.sqrt(squares.mean() / self.dof))

    @cached_property
    def misfit_but_one(self) -> float:
        """The smallest rho that leaving out one position gives; one outlier does not move it."""
        if self.dof <= 1:
            return self.misfit
        left = 1.0 - np.sum(self.basis**2, axis=1)
        scaled = self.residuals / self.response
        explained = np.sum(scaled**2, axis=1) / np.maximum(left, _RANK)
        rest = np.sum(scaled**2) - float(explained[left > _RANK].max(initial=0.0))
        return float(np.sqrt(max(rest, 0.0) / self.values.shape[1] / (self.dof - 1)))

    @cached_property
    def left_over(self) -> float:
        """Root mean square of the residuals as force [g]; NaN where K gives none."""
        if np.linalg.matrix_rank(self.sensitivity / self.response[:, None], tol=1e-3) < 1:
            return float("nan")
        force = self.residuals @ np.linalg.pinv(self.sensitivity, rcond=1e-3).T
        return float(np.sqrt(np.mean(np.sum(force**2, axis=1))))

    def with_values(self, values: Array) -> "View":
        """Return other readings at the same positions."""
        other = View(self.even, self.odd, values)
        other.__dict__["_decomposed"] = self._decomposed  # of the positions alone
        return other

    def turned(self, rows: Places) -> "View":
        """Return the same readings with the reference turned over in some rows."""
        sign = np.ones((len(self.odd), 1))
        sign[rows] = -1.0
        return View(self.even, sign * self.odd, self.values)

    def at(self, reference: Array) -> "View":
        """Return the same readings at other references (n, 3) [g]; other columns are left out."""
        return View(self.even[:, :1], reference, self.values)


def look(c: Calibration) -> View | None:
    """Return the linear view of a calibration; None where it does not know its positions."""
    reference = listed_reference(c)
    if reference is None:
        return None
    even, odd = [np.ones(len(reference))], list(reference.T)
    for term in c.model.basis_terms if c.model.environment else ():
        if not term.environment or term.force_degree > 1:
            continue
        variables = c.model.variables(reference, c.readings.environment)
        column = np.broadcast_to(term.evaluate(variables), len(reference))
        if term.along is None:
            even.append(column - column.mean())
        else:  # K shall be the response at the temperature of the day, not at zero
            own = reference[:, COMPONENTS.index(term.along)]
            square = max(float(own @ own), np.finfo(float).tiny)
            odd.append(column - float(column @ own) / square * own)
    return View(np.column_stack(even), np.column_stack(odd), c.readings.values)


def listed_reference(c: Calibration) -> Array | None:
    """Return the reference as listed (n, 3) [g]; None where a position is not listed."""
    if c.estimator.exact:
        return c.reference
    up, sd = c.readings.up, c.readings.orientation_sd
    if up is None or np.isnan(up).any() or c.readings.group is not None:
        return None
    if sd is not None and not np.isfinite(sd).all():
        return None
    size = np.linalg.norm(c.reference, axis=1, keepdims=True)
    return np.asarray(c.sign * size * up)


Rows = Places
FACTORS = (
    STANDARD_GRAVITY,
    1.0 / STANDARD_GRAVITY,
    1000.0,
    1e-3,
    1000.0 * STANDARD_GRAVITY,
    1e-3 / STANDARD_GRAVITY,
    180.0 / np.pi,
    np.pi / 180.0,
)
_TAKEN = 0.1  # of the step of a converter, that a signal spans at least which ran over its end
_LEVEL = 0.05  # of a direction or reading [g], below which its sign says too little
_ROWS = 60  # of those that fit worst, among which one or two are looked for
_TURNS = 12  # of an alternation between rows and fit


@frozen(eq=True)
class Repair:
    """A change of the data that might explain them.

    Attributes
    ----------
    code : str
        Of the finding.
    rows : tuple of int
        What is changed.
    view : View
        The data as changed.
    outputs : tuple of int
        Those changed, where not all are.
    size : float
        The factor, or the step of a converter in reading units.
    tried : int
        How many repairs of its kind this is the best of.
    fitted : bool
        Whether a number was fitted for each changed output, as the step of a converter is.
    shrunk : float
        The logarithm of the factors by which readings became smaller, summed.
    component : int
        Of the direction, whose sign is wrong; −1 where the direction is right.
    """

    code: str
    rows: tuple[int, ...]
    view: View
    outputs: tuple[int, ...] = ()
    size: float = 1.0
    tried: int = 1
    fitted: bool = False
    shrunk: float = 0.0
    component: int = -1


def candidates(view: View, guess: Array, *, slight: bool = False) -> tuple[list[Repair], int]:
    """Return the best repair of each kind, and how many were tried.

    Parameters
    ----------
    view : View
    guess : (M, 3) array
        Which way each output should respond, for a first sight of rows that are upside down.
    slight : bool
        No row is off by as much as another unit, side or end of the range makes it: rows can only
        be interchanged with neighbours, or all angles be radians.
    """
    rows = _worst_rows(view)
    found, tried = _interchanges(view, rows)
    if slight:
        return [*found, *_radians(view)], tried + (len(FACTORS) + 1) * len(rows)
    repairs, count = _single_rows(view, rows)
    found, tried = found + repairs, tried + count
    several = [
        *_other_order(view),
        *_many_flips(view, guess),
        *_many_factors(view),
        *_wrapped(view),
        *_radians(view),
    ]
    return found + several, tried + len(several)


def _worst_rows(view: View) -> Rows:
    """Return the rows that fit worst, in their order."""
    if len(view.values) <= _ROWS:
        return np.arange(len(view.values))
    size = np.sum((view.residuals / view.response) ** 2, axis=1)
    return np.sort(np.argsort(size)[-_ROWS:])


def _squares(view: View) -> tuple[Array, Array]:
    """Return the residual sums (M,), and what makes outputs of any unit comparable (M,)."""
    spread = np.var(view.values, axis=0)
    return np.sum(view.residuals**2, axis=0), 1.0 / np.maximum(spread, 1e-24 * spread.max())


def _projector(view: View, rows: Rows) -> Array:
    basis = view.basis[rows]
    return np.asarray(np.eye(len(rows)) - basis @ basis.T)


def _interchanges(view: View, rows: Rows) -> tuple[list[Repair], int]:
    """Return the best interchanges of two rows, by eq. (1)."""
    rss, weight = _squares(view)
    M, e, y = _projector(view, rows), view.residuals[rows], view.values[rows]
    d = y[None, :] - y[:, None]  # what row i gains
    diagonal = np.diag(M)
    curvature = (diagonal[:, None] + diagonal[None, :] - 2.0 * M)[:, :, None]
    total = (rss + 2.0 * d * (e[:, None] - e[None, :]) + d**2 * curvature) @ weight
    place = np.arange(len(rows))
    first, second = np.nonzero(place[:, None] < place)
    moved = np.abs(d[first, second]).max(axis=1) > 0.0
    first, second = first[moved], second[moved]
    best = np.argsort(total[first, second])[:6]
    found = []
    for i, j in zip(rows[first[best]].tolist(), rows[second[best]].tolist(), strict=True):
        values = view.values.copy()
        values[[i, j]] = values[[j, i]]
        again = view.with_values(values)
        found.append(Repair("interchanged-rows", (i, j), again, tried=len(first)))
    return found, len(first)


def _other_order(view: View) -> Iterator[Repair]:
    """Yield the readings as those of the same positions laid out against drift."""
    rows = lay_out(view.odd[:, :3], "spread")
    if (rows != np.arange(len(rows))).any():
        values = np.empty_like(view.values)
        values[rows] = view.values
        again = view.with_values(values)
        yield Repair("interchanged-rows", tuple(range(len(rows))), again)


class _Other(NamedTuple):
    """What a row may have been: its columns (K, p) and readings (K, M) for K rows."""

    code: str
    columns: Array
    values: Array
    possible: Mask
    outputs: tuple[int, ...] = ()
    component: int = -1
    size: float = 1.0


def _others(view: View, rows: Rows) -> Iterator[_Other]:
    """Yield all that single rows may have been: upside down, of another sign, or unit."""
    even, odd, y = view.even[rows], view.odd[rows], view.values[rows]
    as_listed, every = np.hstack([even, odd]), np.ones(len(rows), dtype=np.bool_)
    yield _Other("flipped-row", np.hstack([even, -odd]), y, every)
    yield _Other("flipped-row", as_listed, -y, every)
    slanted = np.sum(np.abs(odd[:, :3]) > _LEVEL, axis=1) > 1
    for component in range(3):
        turned = odd.copy()
        turned[:, component] *= -1.0
        possible = slanted & (np.abs(odd[:, component]) > _LEVEL)
        columns = np.hstack([even, turned])
        yield _Other("flipped-direction", columns, y, possible, component=component)
    for output in range(y.shape[1] if y.shape[1] > 1 else 0):
        values = y.copy()
        values[:, output] *= -1.0
        possible = np.abs(y[:, output]) > _LEVEL * view.response[output]
        yield _Other("flipped-row", as_listed, values, possible, outputs=(output,))
    for factor in FACTORS:
        yield _Other("row-unit", as_listed, factor * y, every, size=factor)


def _single_rows(view: View, rows: Rows) -> tuple[list[Repair], int]:
    """Return the best of what each kind of change explains in one row.

    By eq. (2), of what the rows may have been.
    """
    X = np.hstack([view.even, view.odd])
    G = np.linalg.pinv(X.T @ X, rcond=_RANK, hermitian=True)
    beta = G @ (X.T @ view.values)
    x, e = X[rows], view.residuals[rows]
    rss, weight = _squares(view)
    left = np.maximum(1.0 - np.einsum("kp,pq,kq->k", x, G, x), _RANK)[:, None]
    rest = rss - e**2 / left
    best: dict[str, tuple[float, int, _Other]] = {}
    tried = 0
    for other in _others(view, rows):
        across = np.einsum("kp,pq,kq->k", other.columns, G, x)[:, None]
        own = np.einsum("kp,pq,kq->k", other.columns, G, other.columns)[:, None]
        off = other.values - other.columns @ beta + across * e / left
        total = (rest + off**2 / (1.0 + own + across**2 / left)) @ weight
        total[~other.possible] = np.inf
        tried += int(other.possible.sum())
        place = int(np.argmin(total))
        if total[place] < best.get(other.code, (np.inf, 0, other))[0]:
            best[other.code] = float(total[place]), place, other
    found = [_as_repair(view, rows, place, other, tried) for _, place, other in best.values()]
    return found, tried


def _as_repair(view: View, rows: Rows, place: int, other: _Other, tried: int) -> Repair:
    """Return the repair of one row."""
    row, first = int(rows[place]), view.even.shape[1]
    values, odd = view.values.copy(), view.odd.copy()
    values[row], odd[row] = other.values[place], other.columns[place, first:]
    again = View(view.even, odd, values)
    if (odd == view.odd).all():
        again = view.with_values(values)
    return Repair(
        other.code,
        (row,),
        again,
        other.outputs,
        size=1.0 / other.size,
        tried=tried,
        shrunk=-float(np.log(other.size)) * values.shape[1],
        component=other.component,
    )


def _many_flips(view: View, guess: Array) -> Iterator[Repair]:
    """Yield sets of rows upside down: as first guessed, then alternating with the fit."""
    n = len(view.values)
    reference = view.odd[:, :3]
    middle = (view.values.max(axis=0) + view.values.min(axis=0)) / 2.0
    width = np.ptp(view.values, axis=0)
    width = np.maximum(width, 1e-12 * width.max())
    looks = np.sum((view.values - middle) / width * (reference @ guess.T), axis=1) < 0.0
    order = np.arange(n)
    seen = set()
    for start in (looks, order % 2 == 1, order >= n // 2):
        rows = _alternate(start, partial(_upside_down, view))
        if 2 * len(rows) > n:  # the others are the exception
            rows = np.setdiff1d(order, rows)
        if len(rows) > 1 and rows.tobytes() not in seen:
            seen.add(rows.tobytes())
            yield Repair("flipped-row", tuple(rows.tolist()), view.turned(rows))


def _upside_down(view: View, rows: Rows) -> Mask:
    """Return which rows are nearer to the other side of the fit where `rows` are turned."""
    trial = view.turned(rows)
    here = trial.residuals
    odd = trial.odd[:, :3] @ trial.sensitivity.T
    there = here + 2.0 * odd
    nearer = np.sum((there / trial.response) ** 2, axis=1) < np.sum(
        (here / trial.response) ** 2, axis=1
    )
    now = np.zeros(len(nearer), dtype=bool)
    now[rows] = True
    return np.asarray(now ^ nearer)


def _alternate(start: Mask, step: Callable[[Rows], Mask]) -> Rows:
    """Return the rows of a set that the fit to it gives again, or the last of some turns."""
    chosen = start
    for _ in range(_TURNS):
        after = step(np.flatnonzero(chosen))
        if (after == chosen).all():
            break
        chosen = after
    return np.flatnonzero(chosen)


def _many_factors(view: View) -> Iterator[Repair]:
    """Yield sets of rows in another unit: the largest readings first, then alternating."""
    n, outputs = view.values.shape
    width = np.abs(view.values).mean(axis=0)
    width = np.maximum(width, 1e-12 * width.max())
    size = np.linalg.norm(view.values, axis=1), np.linalg.norm(view.values / width, axis=1)
    orders = np.argsort(size, axis=1)  # outputs of one unit, and of several
    for factor in (STANDARD_GRAVITY, 1000.0, 180.0 / np.pi):
        counts = range(2, n - 1, 1 + n // _ROWS)
        splits = [order[n - larger :] for order in orders for larger in counts]
        trials = [(_divided(view, rows, factor).misfit, rows) for rows in splits]
        if not trials:
            continue
        _, first = min(trials, key=lambda trial: trial[0])
        start = np.zeros(n, dtype=bool)
        start[first] = True
        larger = _alternate(start, partial(_too_large, view, factor=factor))
        smaller = np.setdiff1d(np.arange(n), larger)
        few, times = (larger, factor) if len(larger) <= len(smaller) else (smaller, 1.0 / factor)
        yield Repair(
            "row-unit",
            tuple(few.tolist()),
            _divided(view, larger, factor),
            size=times,
            tried=len(trials),
            shrunk=len(larger) * outputs * float(np.log(factor)),
        )


def _divided(view: View, rows: Rows, factor: float) -> View:
    values = view.values.copy()
    values[rows] /= factor
    return view.with_values(values)


def _too_large(view: View, rows: Rows, factor: float) -> Mask:
    """Return which rows are nearer to the fit when divided, where `rows` are."""
    trial = _divided(view, rows, factor)
    expected = trial.values - trial.residuals
    as_is, divided = (
        np.sum(((values - expected) / trial.response) ** 2, axis=1)
        for values in (view.values, view.values / factor)
    )
    return np.asarray(divided < as_is)


def _wrapped(view: View) -> Iterator[Repair]:
    """Yield the outputs whose largest or smallest readings came out at the other end.

    With v the rows that wrapped, +1 at the top and −1 at the bottom of the own component, eq. (1)
    is smallest for the step −(v·r)/(v'Mv), and it must be wider than all that was read.
    """
    n, outputs = view.values.shape
    if n > _ROWS:
        return
    M = _projector(view, np.arange(n))
    values, changed, rows, step = view.values.copy(), [], set(), 0.0
    for output in range(outputs):
        found = _wrap_of(view, M, output)
        if found is not None:
            v, width = found
            values[:, output] += width * v
            changed.append(output)
            rows |= set(np.flatnonzero(v).tolist())
            step = max(step, width)
    if changed:
        view = view.with_values(values)
        yield Repair(
            "wrapped",
            tuple(sorted(rows)),
            view,
            tuple(changed),
            step,
            tried=8 * (n // 2 + 1) ** 2,  # of `_wrap_of`
            fitted=True,
        )


def _wrap_of(view: View, M: Array, output: int) -> tuple[Array, float] | None:
    """Return the rows of one output that wrapped (n,), ±1, and the step; None where none did."""
    n = len(view.values)
    e, y = view.residuals[:, output], view.values[:, output]
    before, tried = float(e @ e), []
    for order in (*np.argsort(view.odd[:, :3], axis=0).T, np.argsort(-e)):
        half = n // 2 + 1
        top = np.zeros((half, n))
        bottom = np.zeros((half, n))
        for k in range(1, half):
            top[k:, order[n - k]] = 1.0
            bottom[k:, order[k - 1]] = 1.0
        v = (top[:, None] - bottom[None]).reshape(-1, n)[1:]
        for sign in (1.0, -1.0):
            u = sign * v
            curvature = np.maximum(np.einsum("ij,ij->i", u @ M, u), 1e-9)
            step = -(u @ e) / curvature
            left = e @ e + 2.0 * step * (u @ e) + step**2 * curvature
            left = np.where(step >= 0.98 * np.ptp(y), left, np.inf)
            for k in np.flatnonzero(left < 0.25 * before).tolist():
                if np.ptp(y + step[k] * u[k]) < _TAKEN * step[k]:
                    continue
                tried.append((float(left[k]), int(np.abs(u[k]).sum()), u[k], float(step[k])))
    if not tried:
        return None
    least = min(left for left, *_ in tried)
    enough = [each for each in tried if each[0] <= max(4.0 * least, 0.01 * before)]
    _, _, rows, width = min(enough, key=lambda each: (each[1], each[0]))
    return rows, width


def _radians(view: View) -> Iterator[Repair]:
    """Yield the readings at the angles that were meant, where radians were read as degrees."""
    up = view.odd[:, :3]
    size = np.linalg.norm(up, axis=1, keepdims=True)
    sign = np.sign(up.sum(axis=0) @ np.array([1.0, 1.0, -1.0])) or 1.0
    up = sign * up / size
    degree = 180.0 / np.pi
    if (up[:, 2] < -0.98).all():  # roll and pitch: level is z down
        pitch = degree**2 * np.arcsin(up[:, 0])
        roll = degree**2 * np.arctan2(-up[:, 1], -up[:, 2])
        meant = np.column_stack(
            [
                sin_deg(pitch),
                -sin_deg(roll) * cos_deg(pitch),
                -cos_deg(roll) * cos_deg(pitch),
            ]
        )
    elif (np.maximum(up[:, 0], up[:, 1]) > 0.98).all():  # turns about a horizontal axis
        meant = np.zeros_like(up)
        about_x = np.abs(up[:, 0]) < 1e-9
        about_y = ~about_x & (np.abs(up[:, 1]) < 1e-9)
        for rows, first, second in (
            (about_x, 1, 2),
            (about_y, 0, 2),
            (~about_x & ~about_y, 0, 1),
        ):
            angle = degree**2 * np.arctan2(up[rows, second], up[rows, first])
            meant[rows, first], meant[rows, second] = cos_deg(angle), sin_deg(angle)
    else:
        return
    rows = tuple(range(len(up)))
    yield Repair("angles-in-radians", rows, view.at(sign * size * meant))


_APART = 3.0  # times the median size of a row
_NEAR = 1.6  # times a known factor
_SHOWN = 6
_DROWNED = 1e12  # times the median reading: doubles hold 16 digits, and a fit needs some of them


def explain_failure(error: MultiposError, readings: Readings) -> MultiposError:
    """Return an error that names the rows in another unit, if there are any; else the same."""
    rows, factor = rows_in_another_unit(readings)
    if not rows:
        return error
    some = listed(rows, _SHOWN)
    named = f"position {some} looks" if len(rows) == 1 else f"positions {some} look"
    return MultiposError(
        f"{readings.source or 'the readings'}: {named} to be in another unit, {factor:.4g} times "
        f"the others; bring all rows to one unit (otherwise: {str(error).rstrip('.')})."
    )


def refuse_drowned(readings: Readings) -> None:
    """Refuse readings of which one is so large that no digit is left of the others beside it.

    Raises
    ------
    MultiposError
    """
    size = np.abs(readings.values)
    largest = float(size.max())
    if 2 * np.count_nonzero(_DROWNED * size >= largest) > size.size + 1 or not largest > 0.0:
        return  # more than half of them have digits left
    typical = float(median(size[size > 0.0]))
    if not largest > _DROWNED * typical:
        return
    row, column = divmod(int(size.argmax()), size.shape[1])
    raise MultiposError(
        f"{readings.source or 'the readings'}: position {readings.labels[row]}: "
        f"{readings.outputs[column]} is {largest:.3g}, next to which other readings lose all "
        f"digits, of {typical:.3g} as a rule; leave such rows out, or look at the file."
    )


def rows_in_another_unit(readings: Readings) -> tuple[tuple[str, ...], float]:
    """Return the labels of rows by eq. (3), and the factor; none where no factor is known."""
    size = np.linalg.norm(readings.values, axis=1)
    middle = float(np.sort(size)[(len(size) - 1) // 2])  # of halves the smaller
    if not middle > SMALLEST * float(size.max()):
        return (), 1.0
    ratio = size / middle
    odd = np.flatnonzero((ratio > _APART) | (ratio < 1.0 / _APART))
    if not len(odd) or 2 * len(odd) > len(size):
        return (), 1.0
    logs, known = np.log(np.maximum(ratio[odd], np.finfo(float).tiny)), np.array(FACTORS)
    nearest = float(known[np.argmin(np.abs(np.log(known) - logs.mean()))])
    if float(np.abs(logs - np.log(nearest)).max()) > np.log(_NEAR):
        return (), 1.0
    return tuple(readings.labels[i] for i in odd.tolist()), nearest

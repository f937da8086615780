"""Rows that belong to no calibration, found however many of them there are beside each other.

`find_outlying_rows` returns the rows that are outliers of a set of readings, `find_outliers` those
of regressions, which `view_of` makes.

Several outliers hide each other from studentised residuals, and what they scatter passes for noise.
So the readings are fitted by least trimmed squares [1]_, the h of n rows that lie best; at most a
third of the rows, and half of the degrees of freedom, are left out. Then a set S of i rows is
taken for outliers, the largest for which every part of it is beyond chance: for the j < i that are
least far off,

    x = RSS_i/RSS_j,    p = I_x((ν − i)/2, (i − j)/2) · M · C(n − j, i − j) ≤ α/m,          (1)

RSS_j of an output without the other j, ν its n − p degrees of freedom, M outputs of which the
least p counts, C(n − j, i − j) the ways to choose the rows, and m the most that S may be. So good
readings, of equal noise or of the noise stated, have one named in fewer than α = 1 % of sets,
whatever search chose S. Where readings state unlike uncertainties, S must pass both with these as
weights and with none, since what rows scatter beside them is not known yet.

At known orientations readings are linear in the parameters. At unknown ones the ellipsoid is,

    r² = c'φ(y) + Σ c_t f_i t(f),    φ = (x² − z², y² − z², x, y, z, 1, xy, xz, yz),        (2)

y = (x, y, z) the centred readings, r their size, t terms beyond the linear, to first order. Among
rows that may be noisier than others (`multipos.sensor.unlike_rows`) a reading must stick out
from these as well.

References
----------
.. [1] P. J. Rousseeuw, K. Van Driessen, Computing LTS regression for large data sets, Data Mining
   and Knowledge Discovery 12 (2006), 29–45: steps of concentration, starts drawn.
"""

import math
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, resolution
from multipos.numerics.factoring import Covariance, column_scales, factor
from multipos.numerics.terms import Term, kind_terms
from multipos.positions.readings import Readings, diagonal
from multipos.results import frozen
from multipos.sensor.model import Model
from multipos.sensor.studentised import OUTLIER_LEVEL, ROWS_NAMED
from multipos.sensor.unlike_rows import p_values_of_units

_LINEAR = frozenset(("1", *COMPONENTS))
_KINDS = ("own^2", "own^3", "own*|own|", "own*other")  # terms that may be what sticks out
_NEARLY = 4.0  # times the variance that is left without the rows
_ALIKE = 1.2  # ratio of standard deviations up to which rows are taken as equally noisy
_STEP = 3.0  # times the resolution that a row is off at least
_LEVEL = 0.0075  # α, so that noise which eq. (2) makes a little unequal names 1 % at most
_GAP = 4.0  # times the largest residual of the others, where there are several outliers
_RIVAL = 2.0  # ln of the likelihood by which one row must beat every other
_STARTS = 60  # at most, and fewer where so many have one without outliers but for .5 %
_MISSED = 0.005
_STEPS, _LAST = 2, 8  # of concentration, of every start and of the best ones
_KEPT = 4  # starts that go on
_SAMPLE = 2000  # rows, of more of which a sample is searched first
_ROWS = 10_000  # of many, worked out at once
_HELD = 16  # designs of which random starts are kept
_BLOCK = 40  # rows, of more of which several are put back at once
_ROUNDING = 1e-9  # of the readings: residuals that are nothing
_RIDGE = 1e-12
_SINGULAR = 1e-9
_ALONE = 1e-3  # root of what others leave of a row, below which it all but determines a parameter


@frozen
class Outlying:
    """Rows that are outliers.

    Attributes
    ----------
    rows : (k,) array of int
    off : (k,) array
        How far off the readings are from the fit without them, over the response to one g [g].
    errors : (k, M) array or None
        The same by output [reading unit]; None of unknown orientations.
    ratio : float
        rms of the residuals with them over that without.
    dof : int
        Degrees of freedom of an output without them.
    """

    rows: Places
    off: Array
    errors: Array | None
    ratio: float
    dof: int


def find_outlying_rows(
    model: Model, readings: Readings, reference: Array | None, orientation_sd: Array | None = None
) -> Outlying | None:
    """Return the rows that are outliers, None where there are none.

    Parameters
    ----------
    model : Model
        Of formulas; rows are not looked for in a model of one's own.
    readings : Readings
    reference : (n, 3) array [g] or None
        As listed; None where nothing is known of the orientations.
    orientation_sd : (n,) array [rad], optional
        Of the directions listed.
    """
    if type(model) is not Model:
        return None
    noise = readings.noise
    variance = None if noise is None else diagonal(noise).reshape(readings.values.shape)
    if reference is None:
        return _off_ellipsoid(model, readings, variance)
    return _off_line(model, readings, variance, reference, orientation_sd)


def _off_line(
    model: Model,
    readings: Readings,
    variance: Array | None,
    reference: Array,
    orientation_sd: Array | None,
) -> Outlying | None:
    """Return the outliers among readings at known orientations."""
    y, phi = readings.values, model.basis(reference, readings.environment)
    columns = [tuple(each.tolist()) for each in model.columns]
    each_once = {own: phi[:, own] for own in dict.fromkeys(columns)}
    designs = [each_once[own] for own in columns]
    del phi  # of many rows it is large
    means = {name: float(np.mean(readings.environment[name])) for name in model.environment}

    def fitted(kept: Mask) -> tuple[Array, Array]:
        """Return what is left of all readings, and the response of each output to one g."""
        fits = {
            own: np.linalg.lstsq(X[kept], y[kept], rcond=None)[0] for own, X in each_once.items()
        }
        b = [fits[own][:, m] for m, own in enumerate(columns)]
        left = y - np.column_stack([X @ each for X, each in zip(designs, b, strict=True)])
        slopes = (model.linear_map(means) @ np.concatenate(b))[:, 1:]
        return left, np.maximum(np.linalg.norm(slopes, axis=1), np.finfo(float).tiny)

    if orientation_sd is not None and orientation_sd.any():
        across = np.outer(orientation_sd, fitted(np.ones(len(y), dtype=np.bool_))[1]) ** 2
        variance = across if variance is None else variance + across
        if not (np.isfinite(variance) & (variance > 0.0)).all():
            return None  # some positions are exact, or unknown, and others are not
    views = _views(designs, y, variance)
    rows = find_outliers(views)
    kept = _without(rows, len(y))
    if not len(rows) or _is_explained_by_any(views[-1], kept):
        return None
    if len(model.outputs) > 1:
        if variance is not None and len(views) == 1:
            views = [view_of(designs, y, variance), *views]
        rows = _beyond_noisy_rows(views[::-1], kept)
        kept = _without(rows, len(y))
    if not len(rows):
        return None
    variables = {axis: reference[:, i] for i, axis in enumerate(COMPONENTS)}

    def with_terms(kind: str) -> Iterator[Array]:
        """Yield the designs with the terms of a kind."""
        for X, axis in zip(designs, model.axes, strict=True):
            yield np.column_stack([X, *_columns(kind_terms(kind, axis, model.inputs), variables)])

    each = views[-1]
    if len(each_once) > 1:
        each = tuple(view_of([X], y[:, [m]])[0] for m, X in enumerate(designs))
    if _is_explained(each, kept, y, map(with_terms, _KINDS)):
        return None
    left, response = fitted(kept)
    least = [_STEP * resolution(each) for each in y.T]
    rows = rows[(np.abs(left[rows]) > least).any(axis=1)]
    with np.errstate(over="ignore"):  # of an output that hardly responds it is infinite
        off = np.linalg.norm(left[rows] / response, axis=1)
    return _outlying(views[-1], rows, off, left[rows], kept)


def _off_ellipsoid(model: Model, readings: Readings, variance: Array | None) -> Outlying | None:
    """Return the outliers among readings of unknown orientations, eq. (2), which are of triads."""
    if readings.values.shape[1] != len(COMPONENTS):
        return None
    centre = readings.values.mean(axis=0)
    size = np.sqrt(np.mean((readings.values - centre) ** 2, axis=0))
    if not (size > 0.0).all():
        return None
    x, y, z = scaled = ((readings.values - centre) / size).T
    square = np.sum(scaled**2, axis=0)
    columns = [x * x - z * z, y * y - z * z, x, y, z, np.ones_like(x)]
    crossed = any("cross_" in name for name in model.names)
    if crossed:
        columns += [x * y, x * z, y * z]
    force = np.empty_like(scaled.T)
    for axis, each in zip(model.axes, scaled / np.sqrt(square), strict=True):
        force[:, COMPONENTS.index(axis)] = each
    variables = model.variables(force, readings.environment)
    for output, term in model.keys:
        if str(term) not in _LINEAR:
            along = force[:, COMPONENTS.index(model.axes[model.outputs.index(output)])]
            columns.append(along * term.evaluate(variables))
    X = np.column_stack(columns)
    if variance is not None:
        along = np.sum(scaled**2 / square * variance.T / size[:, None] ** 2, axis=0)
        variance = along[:, None]
    views = _views([X], square[:, None], variance)
    rows = find_outliers(views)
    kept = _without(rows, len(x))

    def with_terms(kind: str) -> list[Array]:
        """Return the design with the terms of a kind, of all outputs."""
        found = [X]
        for axis in model.axes:
            terms = _columns(kind_terms(kind, axis, model.inputs), variables)
            found += [force[:, COMPONENTS.index(axis)] * each for each in terms]
        return [np.column_stack(found)]

    if not len(rows) or _is_explained(views[-1], kept, square[:, None], map(with_terms, _KINDS)):
        return None
    c = np.linalg.lstsq(X[kept], square[kept], rcond=None)[0]
    form = np.diag([1.0 - c[0], 1.0 - c[1], 1.0 + c[0] + c[1]])
    if crossed:
        form[np.triu_indices(3, 1)] = form[np.tril_indices(3, -1)] = -c[6:9] / 2.0
    if not np.linalg.eigvalsh(form)[0] > 0.0:
        return None  # without the rows it is no ellipsoid
    radius = c[5] + 0.25 * float(c[2:5] @ np.linalg.solve(form, c[2:5]))
    off = np.abs(np.sqrt(np.maximum(1.0 + (square - X @ c)[rows] / radius, 0.0)) - 1.0)
    step = max(resolution(each) / s for each, s in zip(readings.values.T, size, strict=True))
    rows, off = rows[off > _STEP * step], off[off > _STEP * step]
    return _outlying(views[-1], rows, off, None, kept)


def _columns(terms: Iterable[Term], variables: Mapping[str, Array]) -> list[Array]:
    return [np.asarray(term.evaluate(variables)) for term in terms]


def _is_explained_by_any(view: "View", kept: Mask) -> bool:
    """Tell, of an unweighted view, whether one term more explains the rows even if it is zero.

    So it does then of some of the rows only, which leave more, on more degrees of freedom.
    """
    every, least = _squares(_left_of(view, np.vstack([np.ones_like(kept), kept])))
    dof = np.concatenate([np.full(part.least.size, part.dof) for part in view])
    return bool(((dof > 2) & (every / (dof - 1.0) < _NEARLY * least / dof)).all())


def _is_explained(
    view: "View", kept: Mask, values: Array, others: Iterable[Iterable[Array]]
) -> bool:
    """Tell whether terms that the model lacks explain what rows set aside would, or nearly.

    Parameters
    ----------
    view : View
        Unweighted, with the terms of the model; each output a part, in order.
    kept : (n,) array of bool
    values : (n, M) array
    others : designs of all outputs, with the terms of a kind beside those of the model
    """
    out = int(np.sum(~kept))
    dof = np.array([part.dof for part in view for _ in part.least.flat])
    least = _squares(_left_of(view, kept[None]))[0] / (dof - out)
    every = np.concatenate([np.sum(part.values**2, axis=2).ravel() for part in view])

    def is_enough(X: Array, m: int) -> bool:
        """Tell whether a design explains an output, as it does where its terms may be zero."""
        spare, most = len(X) - X.shape[1], _NEARLY * float(least[m])
        if spare > 1 and every[m] < most * spare:
            return True
        (part,) = view_of([X], values[:, [m]])
        return part.dof > 1 and float(np.sum(part.values**2)) < most * part.dof

    return any(all(is_enough(X, m) for m, X in enumerate(designs)) for designs in others)


def _without(rows: Places, n: int) -> Mask:
    kept = np.ones(n, dtype=np.bool_)
    kept[rows] = False
    return kept


def _views(designs: Sequence[Array], values: Array, variance: Array | None) -> list["View"]:
    """Return the regression weighted as stated, where that is unlike for rows, and unweighted."""
    plain = [view_of(designs, values)]
    if variance is None:
        return plain
    spread = np.sqrt(variance.max(axis=0) / variance.min(axis=0)).max()
    return [view_of(designs, values, variance), *plain] if spread > _ALIKE else plain


def _outlying(
    view: "View", rows: Places, off: Array, errors: Array | None, kept: Mask
) -> Outlying | None:
    if not len(rows):
        return None
    dof = min(part.dof for part in view)
    left = dof - int(np.sum(~kept))
    before, after = _squares(_left_of(view, np.vstack([np.ones_like(kept), kept])))
    return Outlying(rows, off, errors, math.sqrt(float(np.max(before / after)) * left / dof), left)


def _beyond_noisy_rows(views: Sequence["View"], kept: Mask) -> Places:
    """Return the rows, of those not kept, that are beyond chance even if rows are unlike.

    They are so weighted as stated, or unweighted: what is stated of many may be wrong.
    """
    rows = np.flatnonzero(~kept)
    if min(part.dof for part in views[0]) < ROWS_NAMED:
        return rows
    least, size = np.ones(len(rows)), 1
    for view in views:
        left = np.concatenate([part.values.reshape(-1, len(kept)) for part in view]).T
        each_once = [(Q.T, part.least.shape[1]) for part in view for Q in part.basis]
        bases = [Q for Q, outputs in each_once for _ in range(outputs)]
        leverage = np.column_stack([np.einsum("np,np->n", Q, Q) for Q in bases])
        questioned = np.repeat(~kept[:, None], left.shape[1], axis=1)
        (p,) = p_values_of_units(left[None], leverage, bases, questioned[None])
        if np.isnan(p[rows]).any():
            return rows
        least, size = np.minimum(least, p[rows].min(axis=1)), left.size
    return rows[least < OUTLIER_LEVEL / size]


@frozen
class Part:
    """G designs of p columns, each of m outputs of equal variances, as whitened regressions.

    Attributes
    ----------
    both : (G, p + m, n) array
        Orthonormal columns of a design as rows, and what they leave of the readings.
    least : (G, m) array
        Squared residual of a reading that is rounding.
    """

    both: Array
    least: Array

    @property
    def basis(self) -> Array:
        """Orthonormal columns of the designs, as rows (G, p, n)."""
        return self.both[:, : -self.least.shape[1]]

    @property
    def values(self) -> Array:
        """What they leave of the readings (G, m, n)."""
        return self.both[:, -self.least.shape[1] :]

    @property
    def dof(self) -> int:
        """Degrees of freedom of an output."""
        return int(self.both.shape[2] - self.basis.shape[1])


View = tuple[Part, ...]


def view_of(designs: Sequence[Array], values: Array, variance: Array | None = None) -> View:
    """Return the regression of values (n, M) on M designs (n, p), with variances (n, M).

    Outputs of one and the same array of a design share it, and designs of one shape a part.
    """
    sharing: dict[tuple[int, bytes], list[int]] = {}
    for m, design in enumerate(designs):
        own = b"" if variance is None else variance[:, m].tobytes()
        sharing.setdefault((id(design), own), []).append(m)
    alike: dict[tuple[int, int], list[list[int]]] = {}
    for members in sharing.values():
        alike.setdefault((designs[members[0]].shape[1], len(members)), []).append(members)
    parts: list[Part] = []
    for every in alike.values():
        first = [members[0] for members in every]
        one = len(first) == 1  # of many rows a copy is large
        X = designs[first[0]][None] if one else np.stack([designs[m] for m in first])
        y = values.T[np.array(every)]
        if variance is not None:
            root = np.sqrt(variance.T[first])
            X, y = X / root[:, :, None], y / root[:, None]
        parts += _parts(X, y)
    return tuple(parts)


def _parts(X: Array, y: Array) -> list[Part]:
    """Return readings (G, m, n) on whitened designs (G, n, p): one part where these have rank p."""
    bases = _orthonormal(X)
    if len(bases) == 1:
        return [_part(bases[0], y)]
    return [_part(basis, values[None]) for basis, values in zip(bases, y, strict=True)]


def _orthonormal(X: Array) -> list[Array]:
    """Return orthonormal columns of designs (G, n, p) as rows, each alone where one lacks rank."""
    Q, R = factor(Covariance(None, 0), X)
    left, sizes, _ = np.linalg.svd(R / column_scales(R)[:, None], full_matrices=False)
    full = sizes > _SINGULAR * sizes[:, :1]
    if full.all():
        return [Q.swapaxes(1, 2)]
    return [(q @ turn[:, own]).T[None] for q, turn, own in zip(Q, left, full, strict=True)]


def _part(basis: Array, y: Array) -> Part:
    both = np.concatenate([basis, y], axis=1)
    left = both[:, basis.shape[1] :]
    least = np.maximum((_ROUNDING * np.abs(left).max(axis=2)) ** 2, 1e-300)  # of an output of zeros
    left -= (y @ basis.swapaxes(1, 2)) @ basis
    return Part(both, least)


def find_outliers(views: Sequence[View]) -> Places:
    """Return the rows that are outliers in every view of the same readings, by eq. (1)."""
    n = views[0][0].both.shape[2]
    most = min(n // 3, min(part.dof for view in views for part in view) // 2)
    if most < 1:
        return np.zeros(0, dtype=np.intp)
    counts = [most]
    while (fewer := _fewer(counts[-1])) > 0:
        counts.append(fewer)
    for view in views:
        left = _best(view, most)[1]
        (far,) = _far(left)
        first = np.sort(np.argpartition(far, n - most - 1)[n - most - 1 :])  # fewer to be sorted
        order = first[np.argsort(-far[first], kind="stable")]
        beyond = _whole_is_beyond(view, left, order, counts)
        sets = np.ones((len(beyond), n), dtype=np.bool_)
        for kept, out in zip(sets, beyond, strict=True):
            kept[order[:out]] = False
        for each in views:
            if len(sets):
                sets = sets[_parts_are_beyond(each, sets, most)]
        if len(sets):
            rows = np.flatnonzero(~sets[0])
            return rows if _is_the_only_one(views[-1], rows) else rows[:0]
    return np.zeros(0, dtype=np.intp)


def _is_the_only_one(view: View, rows: Places) -> bool:
    """Tell, of one row, whether no other is nearly as likely, such as the one opposite."""
    if len(rows) > 1:
        return True
    likely = np.zeros(view[0].both.shape[2])
    for part in view:
        Q, e = part.basis, part.values
        left = np.maximum(1.0 - np.einsum("gpn,gpn->gn", Q, Q), _ALONE**2)[:, None]
        least = np.sum(e**2, axis=2, keepdims=True) - e**2 / left
        least = np.maximum(least, part.least[..., None])
        likely += 0.5 * (part.dof - 1) * np.log(least).sum(axis=(0, 1))
    return bool(np.delete(likely, rows).min() > likely[rows[0]] + _RIVAL)


def _fewer(out: int) -> int:
    """Return how many rows to leave out after so many."""
    return out - max(1, out // _BLOCK)


_Left = list[tuple[Array, Array]]


def _best(view: View, most: int) -> tuple[Mask, _Left]:
    """Return the best set (1, n) that leaves out so many rows, and what is left.

    Of many rows the best set of a sample is where the search of all begins, and nearly ends.
    """
    n = view[0].both.shape[2]
    starts: Mask
    if n > _SAMPLE:
        rows = np.sort(_drawn(n, 1, n)[0].argpartition(_SAMPLE)[:_SAMPLE])
        root = math.sqrt(n / _SAMPLE)
        sample = tuple(
            Part(np.concatenate([root * part.basis, part.values], axis=1)[:, :, rows], part.least)
            for part in view
        )
        starts = np.zeros((1, n), dtype=np.bool_)
        starts[:, rows] = _best(sample, most * _SAMPLE // n)[0]
    else:
        p = max(part.basis.shape[1] for part in view)
        good = (1.0 - most / n) ** (p + 1)
        number = min(_STARTS, math.ceil(math.log(_MISSED) / math.log1p(-good)))
        starts = _started(n, number, p)
    kept = np.vstack([np.ones((1, n), dtype=np.bool_), starts])
    kept, left = _concentrated(view, kept, _left_of(view, kept), most, _STEPS)
    if n <= _SAMPLE:
        best = np.argsort(_objective(left), kind="stable")[:_KEPT]
        some = [(e[best], squares[best]) for e, squares in left]
        kept, left = _concentrated(view, kept[best], some, most, _LAST)
    one = [int(np.argmin(_objective(left)))]
    return kept[one], [(e[one], squares[one]) for e, squares in left]


def _drawn(seed: int, rows: int, columns: int) -> NDArray[np.uint64]:
    """Return numbers drawn at random, by Python's own generator: NumPy's is slow to import."""
    drawn = random.Random(seed).randbytes(8 * rows * columns)
    return np.frombuffer(drawn, "<u8").reshape(rows, columns)


@lru_cache(maxsize=_HELD)
def _started(n: int, number: int, p: int) -> Mask:
    """Return random sets (number, n) of p + 1 rows."""
    return np.asarray(_drawn(n, number, n).argsort(axis=1) <= p)


def _left_of(view: View, kept: Mask) -> _Left:
    """Return of every part residuals (B, m, n), and sums (B, m) of squares of the B sets kept."""
    found = []
    for part in view:
        (G, p, n), m = part.basis.shape, part.least.shape[1]
        sums = np.zeros((len(kept), G, p, p + m))
        for first in range(0, n, _ROWS):
            rows = slice(first, first + _ROWS)
            Q, both, weight = part.basis[..., rows], part.both[..., rows], 1.0 * kept[:, rows]
            if n > _SAMPLE:  # of one set or two
                sums += (Q * weight[:, None, None]) @ both.swapaxes(1, 2)
                continue
            products = (Q[:, :, None] * both[:, None]).reshape(-1, weight.shape[1])
            sums += (weight @ products.T).reshape(sums.shape)
        fitted = np.linalg.solve(sums[..., :p] + _RIDGE * np.eye(p), sums[..., p:])
        found.append(_residuals(part, kept, np.asarray(fitted.transpose(1, 3, 0, 2))))
    return found


def _residuals(part: Part, kept: Mask, coefficients: Array) -> tuple[Array, Array]:
    """Return residuals (B, G m, n) by coefficients (G, m, B, p), and squares of the sets kept."""
    G, m, count, p = coefficients.shape
    e = (coefficients.reshape(G, m * count, p) @ part.basis).reshape(G * m, count, -1)
    np.subtract(part.values.reshape(G * m, 1, -1), e, out=e)
    squares = np.einsum("kbn,kbn,bn->bk", e, e, kept)
    return e.transpose(1, 0, 2), squares + part.least.ravel()


def _objective(left: _Left) -> Array:
    return np.asarray(np.log(_squares(left)).sum(axis=1))


def _far(left: _Left) -> Array:
    """Return how far off rows are, (B, n), in units of what the sets kept show."""
    each = [np.einsum("bmn,bmn,bm->bn", e, e, 1.0 / squares) for e, squares in left]
    return each[0] if len(each) == 1 else np.asarray(np.sum(each, axis=0))


def _squares(left: _Left) -> Array:
    """Return the sums of squares of all outputs (B, M), of B sets."""
    return np.concatenate([squares for _, squares in left], axis=1)


def _concentrated(view: View, kept: Mask, left: _Left, out: int, steps: int) -> tuple[Mask, _Left]:
    """Return sets (B, n) after steps of concentration that leave out so many, and what is left."""
    for _ in range(steps):
        far = np.argpartition(_far(left), -out, axis=1)[:, -out:]
        before, kept = kept, np.ones_like(kept)
        kept[np.arange(len(kept))[:, None], far] = False
        if (kept == before).all():
            break
        del left  # of many rows it is large
        left = _left_of(view, kept)
    return kept, left


def _whole_is_beyond(view: View, left: _Left, order: Places, counts: list[int]) -> list[int]:
    """Return how many of the first rows in an order are beyond chance, eq. (1) at j = 0.

    By the sums of products between one count and the next, of what a fit leaves of all rows. Where
    the last of the rows and the next one in order do not stand apart, not all of them do.
    """
    cuts, squares = [0, *sorted(counts)], []
    at = np.array(cuts[1:])
    inner, outer = np.zeros((2, len(at)))
    for part, (e, _) in zip(view, left, strict=True):
        p, apart = part.basis.shape[1], e[0].reshape(part.values.shape)
        both = np.concatenate([part.basis, apart], axis=1)
        pieces = [both[:, :, order[first:last]] for first, last in pairwise(cuts)]
        both[:, :, order[: cuts[-1]]] = 0.0
        products = [each @ each.swapaxes(1, 2) for each in (both, *pieces[::-1])]
        sums = np.cumsum(products, axis=0)[::-1]
        along = sums[..., :p, p:]
        fitted = np.linalg.solve(sums[..., :p, :p] + _RIDGE * np.eye(p), along)
        least = np.einsum("bgmm->bgm", sums[..., p:, p:])
        least = np.maximum(least - np.sum(along * fitted, axis=2), 0.0) + part.least
        squares.append(least.reshape(len(cuts), -1))
        for far, rows in ((outer, order[at - 1]), (inner, order[at])):
            off = apart[..., rows].T - np.einsum("kgpm,gpk->kmg", fitted[1:], part.basis[..., rows])
            far += np.sum(off**2 / least[1:].swapaxes(1, 2), axis=(1, 2))
    every = np.concatenate(squares, axis=1)
    far_off = np.flatnonzero((at == 1) | (outer > _GAP**2 * inner))[::-1]
    outs = at[far_off].tolist()
    beyond = _are_beyond(view, every[1 + far_off] / every[0], outs, [0] * len(outs), counts[0])
    return [out for out, is_beyond in zip(outs, beyond, strict=True) if is_beyond]


def _parts_are_beyond(view: View, sets: Mask, most: int) -> Mask:
    """Tell of which sets (B, n) the rows not kept stand apart, every part beyond chance, eq. (1).

    Rows stand apart from all others, but one alone, which may be near: a third of rows that are ten
    times noisier has its smaller errors among those of the others.
    """
    outs = np.sum(~sets, axis=1)
    left = _left_of(view, sets)
    far, smallest = _far(left), _squares(left)
    nearest = np.where(sets, np.inf, far).min(axis=1, initial=np.inf)
    beyond = (outs == 1) | (nearest > _GAP**2 * np.where(sets, far, 0.0).max(axis=1, initial=0.0))
    alive, inner, back = np.flatnonzero(beyond), sets[beyond], outs[beyond]
    far = far[beyond]
    while len(alive):
        back = np.array([_fewer(j) for j in back.tolist()])
        order = np.argsort(np.where(inner, -1.0, far), axis=1, kind="stable")
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(sets.shape[1])[None], axis=1)
        inner = rank < (sets.shape[1] - back)[:, None]
        left = _left_of(view, inner)
        x = smallest[alive] / _squares(left)
        passed = _are_beyond(view, x, outs[alive].tolist(), back.tolist(), most)
        beyond[alive[~passed]] = False
        going = passed & (back > 0)
        alive, inner, back, far = alive[going], inner[going], back[going], _far(left)[going]
    return np.asarray(beyond)


def _are_beyond(
    view: View, x: Array, outs: Sequence[int], backs: Sequence[int], most: int
) -> NDArray[np.bool_]:
    """Tell which x (K, M) of eq. (1), of i rows and j < i, are beyond chance."""
    outputs, dofs = [part.least.size for part in view], [part.dof for part in view]
    n, limit = view[0].both.shape[2], math.log(_LEVEL / most) - math.log(x.shape[1])
    least = np.minimum.reduceat(x, np.cumsum([0, *outputs[:-1]]), axis=1).tolist()
    beyond = np.empty(len(least), dtype=np.bool_)
    for k, (each, i, j) in enumerate(zip(least, outs, backs, strict=True)):
        pairs = zip(each, dofs, strict=True)
        log = min(_log_beta_tail(ratio, 0.5 * (dof - i), 0.5 * (i - j)) for ratio, dof in pairs)
        beyond[k] = log < 0.0 and log + _log_choices(n - j, i - j) <= limit
    return beyond


def _log_choices(n: int, k: int) -> float:
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0)


def _log_beta_tail(x: float, a: float, b: float) -> float:
    """Return a bound from above of ln I_x(a, b), near where I is small; 0 where it is not.

    As t^a (1 − t)^(b − 1) rises by t^(a−1) (1 − t)^(b−1) (a − (b − 1) t/(1 − t)) at least.
    """
    if not x < 1.0:
        return 0.0
    if x <= 0.0:
        return -math.inf
    slope = a - max(b - 1.0, 0.0) * x / (1.0 - x)
    if slope <= 0.0:
        return 0.0
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    return min(a * math.log(x) + (b - 1.0) * math.log1p(-x) - math.log(slope) - log_beta, 0.0)

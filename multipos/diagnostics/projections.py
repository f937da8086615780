"""What positions show of terms that a model lacks: projections, and what they leave unseen.

`lacking` returns the kinds of terms that a model lacks, `formula_with` its formula with them, and
`project` what a fit leaves of their columns, which `seen_rows` and `left_of` work out; `hides`
tells whether a kind is hidden. `values_of` and `terms_of` are the columns of all terms, `sphere`
the directions that force may have. `is_level` and `level_of` hold the noise of readings, and
`shown_sizes` is how large terms are that positions show.

With the whitened design X = Q R and columns Z of terms that are not in it, V = Z − QQ'Z is what a
fit leaves of them. At known orientations V depends on the positions and not on the readings; its
orthonormal rows are kept from one fit to the next.

**Hidden.** A combination c that is not fitted puts force at f off by E(f) c, E = Z(f) − X(f) X⁺Z.
One just large enough to be found, c'V'Vc ≈ λ, puts it off by √(λ r) of the noise, while u of force
is √l of it:

    r = max c'Ec / c'V'Vc, E the mean of E(f)'E(f),    l = mean of |X(f) R⁻¹|²,             (1)

means over the sphere. √(r/l) is .4 to .8 where positions are spread evenly, 4 to 18 at six faces
that are 3° to 1° off, infinite at the faces; where it passes `_HIDDEN` terms spoil U long before
they are found. Where no positions could show a combination E is zero as well, and little where
the model does nearly the same: own·|own| beside own and own³.

**Kinds.** The terms that a model could have are the standard ones up to third order that it lacks,
written for an output of any axis, `own` and `other` standing for components:

    1, own, other · own², own|own|, own³, own·other · and of every column, the next power of it
    alone and with own, up to the third.                                                    (2)

They are those of the standard models (IEEE Std 1293: K0, K1 and misalignment; K2, Koq, K3, Kip and
Kio). Squares and products of the other components are not among them: x² + y² + z² = 1 at rest.

**Sizes.** What is hidden can only be stated, in a budget's [unseen]; what nobody knows is guessed
from its kin. Of a term of second or third order, fitted or tested beside the model, with
coefficients c_i of standard uncertainty u_i in outputs that respond by |K_i|,

    size = sqrt(mean over i of (c_i² + u_i²) / |K_i|²)   [g],                                (3)

which holds what was found and what noise leaves open. For a tested one, c = (V'V)⁻¹V'e and
u² = s²(V'V)⁻¹ with V what the fit leaves of its column and s² of what it leaves of residuals e:
what a fit with the term would give, without the fit.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import COMPONENTS, Array, Places
from multipos.numerics.factoring import Covariance, column_norms, factor
from multipos.numerics.least_squares import block_design
from multipos.numerics.terms import NAMED, Term, kind_terms
from multipos.positions.scheme import read_scheme
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model

OF_FORCE = ("1", "own", "other", "own^2", "own*|own|", "own^3", "own*other")
_HIGHEST = 3
_COLUMN = "temperature"  # the column that is asked of though the model does not use it


class Kind(NamedTuple):
    """A kind of term, and what of it each output lacks."""

    name: str
    terms: tuple[tuple[Term, ...], ...]


class ModelSetting(NamedTuple):
    """What the kinds depend on, in a form that can be looked up fast."""

    names: tuple[str, ...]  # of the parameters
    axes: tuple[str, ...]
    inputs: tuple[str, ...]
    columns: tuple[str, ...]
    adrift: bool


def lacking(c: Calibration) -> tuple[Kind, ...]:
    """Return the kinds of terms that a calibration's model lacks, wholly or in part."""
    model = c.model
    used = model.environment
    if _COLUMN not in used and _varies(c, _COLUMN):
        used = (*used, _COLUMN)
    setting = ModelSetting(model.names, model.axes, model.inputs, used, model.gauge is not None)
    return _kinds(setting, _Unhashed(model))


def formula_with(model: Model, kinds: tuple[str, ...]) -> str:
    """Return the formula of a model with more terms."""
    return " + ".join((NAMED.get(model.text, model.text), *kinds))


class _Unhashed:
    """A model beside the setting that says it all, so that looking up costs no hash of it."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return True


@lru_cache(maxsize=64)
def _kinds(setting: ModelSetting, unhashed: _Unhashed) -> tuple[Kind, ...]:
    model = unhashed.model
    names = [*OF_FORCE, *(name for column in setting.columns for name in _powers(model, column))]
    if setting.adrift:  # what lies along other axes is a rotation of the case
        names.remove("other")
    found = (
        Kind(
            name,
            tuple(
                tuple(term for term in kind_terms(name, axis, model.inputs) if term not in has)
                for axis, has in zip(model.axes, model.terms, strict=True)
            ),
        )
        for name in names
    )
    return tuple(kind for kind in found if any(kind.terms))


def _powers(model: Model, column: str) -> list[str]:
    """Return the next power of a column alone, and with the own component."""
    result = []
    for along in (False, True):
        powers = [
            dict(term.environment).get(column, 0)
            for axis, terms in zip(model.axes, model.terms, strict=True)
            for term in terms
            if term.force_degree == along and term.along == (axis if along else None)
        ]
        power = max(powers, default=0) + 1
        if power <= _HIGHEST:
            name = column if power == 1 else f"{column}^{power}"
            result.append(f"{name}*own" if along else name)
    return result


def _varies(c: Calibration, name: str) -> bool:
    column = c.readings.environment.get(name)
    return column is not None and bool(np.isfinite(column).all()) and bool(np.ptp(column) > 0.0)


_HIDDEN = 2.0  # of the root of r/l: a term just found puts force off by some ten u
IDENTIFIABLE = 1e-8  # of a column's square, below which what is left of it tells nothing
_IMITATED = 0.1  # of a term, within which the model does the same over the sphere
_APPLIED = 1e-9  # of the largest square, below which a direction was never applied
_NOTHING = 1e-12  # of a column's square, below which it is rounding
_DIRECTIONS = 100
_KEPT = 8  # projections
_ROWS = 10_000  # of many, worked out at once
_MANY = 100_000  # positions, whose projection is too large to keep


class Setting:
    """What a projection depends on: positions, terms and weights; equal where these are."""

    def __init__(self, c: Calibration, kinds: tuple[Kind, ...], added: tuple[str, ...]) -> None:
        self.calibration: Calibration = c
        self.kinds: tuple[Kind, ...] = kinds
        self.added: tuple[str, ...] = added

    @cached_property
    def _key(self) -> tuple[object, ...]:
        c, columns = self.calibration, self.calibration.readings.environment
        return (
            *(c.model.names, c.model.axes, c.model.inputs, self.added),
            *(kind.name for kind in self.kinds),
            *(c.reference.tobytes(), *(columns[name].tobytes() for name in sorted(columns))),
            b"" if is_level(c) or c.noise is None else c.noise.tobytes(),
            b"" if c.robust_weight is None else c.robust_weight.tobytes(),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Setting) and self._key == other._key


@frozen
class Projection:
    """V at known orientations, as orthonormal rows in blocks of a kind and an output.

    Attributes
    ----------
    whitener : (n, M) or (n M, n M) array
    fitted : tuple of arrays
        Q of each output's design, or of the one of all.
    rows : (R, n) or (R, n M) array
    output : (R,) array
        The column of whitened residuals that a row is for, rising.
    starts, place : arrays
        Where blocks begin, and their place among (kinds, outputs).
    q : (kinds, outputs) array
    left : (outputs,) array
        Degrees of freedom without the terms.
    names, hidden : tuples of str
    """

    whitener: Array
    fitted: tuple[Array, ...]
    rows: Array
    output: Places
    starts: Places
    place: Places
    q: Array
    left: Array
    names: tuple[str, ...]
    hidden: tuple[str, ...]

    @cached_property
    def of_outputs(self) -> list[slice]:
        """The rows of every column of residuals."""
        ends = np.searchsorted(self.output, np.arange(len(self.left) + 1)).tolist()
        return [slice(*each) for each in pairwise(ends)]

    def whitened(self, residuals: Array) -> Array:
        """Return residuals (n, M) as columns that the rows take."""
        if self.whitener.shape == residuals.shape:
            return self.whitener * residuals
        return np.asarray((self.whitener @ residuals.ravel())[:, None])


@frozen
class _Part:
    """The design Q R of one output, or of all, and terms (R, n) by kind; and on the sphere.

    The terms are the first of the rows of the projection that are still to be filled in.
    """

    basis: Array
    triangle: Array
    terms: Array
    design_there: Array
    terms_there: Array
    kinds: tuple[slice, ...]


def project(setting: Setting) -> Projection:
    """Return the projection of a setting; a kind is hidden where it is of any output."""
    many = len(setting.calibration.readings) > _MANY
    return _projection.__wrapped__(setting) if many else _projection(setting)


@lru_cache(maxsize=_KEPT)
def _projection(setting: Setting) -> Projection:
    c, kinds = setting.calibration, setting.kinds
    together = c.noise is not None and c.noise.ndim == 2
    whitener, weight = _whitener(c)
    count = 1 if together else len(c.outputs)
    q = np.zeros((len(kinds), count))
    size_of_all = sum(len(terms) for kind in kinds for terms in kind.terms)
    rows = np.empty((size_of_all, c.residuals.size if together else len(c.residuals)))
    part_of = (_joint_part if together else _own_parts)(c, kinds, whitener)
    sizes: list[int] = []
    place: list[int] = []
    fitted, hidden = [], set()
    for column in range(count):
        Q, seen, unseen = _see(part_of(column, rows[sum(sizes) :]), setting)
        fitted.append(Q)
        hidden |= unseen
        for k, number in seen.items():
            sizes.append(number)
            place.append(k * count + column)
            q[k, column] = number
    left = np.array([weight.sum()] if together else weight.sum(axis=0))
    return Projection(
        whitener=whitener,
        fitted=tuple(fitted),
        rows=rows[: sum(sizes)],
        output=np.repeat(np.array(place, dtype=np.intp) % count, sizes),
        starts=np.cumsum(sizes, dtype=np.intp) - np.array(sizes, dtype=np.intp),
        place=np.array(place, dtype=np.intp),
        q=q,
        left=left - [Q.shape[1] for Q in fitted],
        names=tuple(kind.name for kind in kinds),
        hidden=tuple(kind.name for kind in kinds if kind.name in hidden),
    )


def _see(part: _Part, setting: Setting) -> tuple[Array, dict[int, int], set[str]]:
    """Return Q of a part, how many rows are seen of kinds by number, and hidden kinds.

    Orthonormal rows of what Q leaves of the kinds take the place of the terms, from the first on.
    """
    Q = part.basis
    there = part.design_there @ np.linalg.inv(part.triangle)
    size = float(np.mean(np.sum(there**2, axis=1)))
    named = list(zip(setting.kinds, part.kinds, strict=True))
    for kind, mine in named:
        if kind.name in setting.added:
            Z = part.terms[mine].T
            Q = np.column_stack([Q, seen_rows(left_of(Q, Z), column_norms(Z)).T])
    scale = column_norms(part.terms.T)
    along = _take_out(Q, part.terms)
    error = np.zeros((len(there), len(part.terms)))
    if not setting.added:
        error = part.terms_there - there @ along.T
    seen: dict[int, int] = {}
    hidden = set()
    for k, (kind, mine) in enumerate(named):
        V = part.terms[mine]
        if not len(V) or kind.name in setting.added:
            continue
        gram = V @ V.T
        asked = not setting.added and kind.name in OF_FORCE
        if asked and hides(gram, error[:, mine], part.terms_there[:, mine], size):
            hidden.add(kind.name)
        turns = _turns(gram, scale[mine])
        if len(turns):
            first = sum(seen.values())
            for start in range(0, V.shape[1], _ROWS):
                block = slice(start, start + _ROWS)
                part.terms[first : first + len(turns), block] = turns @ V[:, block]
            seen[k] = len(turns)
    return Q, seen, hidden


def hides(gram: Array, error: Array, whole: Array, size: float) -> bool:
    """Tell whether √(r/l) of eq. (1) passes its limit, and the error is one.

    Parameters
    ----------
    gram : (q, q) array
        V'V.
    error : (J, q) array
        E(f) at directions f.
    whole : (J, q) array
        The terms there.
    size : float
        l.
    """
    mean = error.T @ error / len(error)
    squares = mean.diagonal()
    if not (squares > _IMITATED**2 * np.einsum("jq,jq->q", whole, whole) / len(whole)).any():
        return False
    if not size > 0.0:  # no term is of force
        return False
    scale = float(gram.trace()) + float(squares.sum()) / (len(gram) * size)
    ratio = np.linalg.solve(gram + _NOTHING * scale * np.eye(len(gram)), mean)
    limit = _HIDDEN**2 * size  # passed by the largest eigenvalue, and so by their sum
    return bool(ratio.trace() > limit and np.linalg.eigvals(ratio).real.max() > limit)


def seen_rows(V: Array, scale: Array) -> Array:
    """Return orthonormal rows (r, n) of the part of V (n, q) beyond rounding of columns' norms."""
    return np.asarray(_turns(V.T @ V, scale) @ V.T)


def _turns(gram: Array, scale: Array) -> Array:
    """Return T (r, q), TV' orthonormal rows, by V'V and the norms of columns without the fit."""
    size = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(gram / np.multiply.outer(size, size))
    identifiable = values > IDENTIFIABLE
    return np.asarray((vectors[:, identifiable] / np.sqrt(values[identifiable])).T / size)


def values_of(
    kinds: Sequence[Kind], force: Array, environment: Mapping[str, Array]
) -> tuple[Array, Places]:
    """Return all terms as columns (n, M, R) of readings, and the kind of each (R,)."""
    rows, output_of, kind_of = terms_of(kinds, force, environment)
    result = np.zeros((len(force), len(kinds[0].terms), len(rows)))
    result[:, output_of, np.arange(len(rows))] = rows.T
    return result, kind_of


def terms_of(
    kinds: Sequence[Kind],
    force: Array,
    environment: Mapping[str, Array],
    room: Array | None = None,
) -> tuple[Array, Places, Places]:
    """Return all terms as rows (R, n), the first of a room, and the output and kind of each."""
    variables = {axis: force[:, i] for i, axis in enumerate(COMPONENTS)} | dict(environment)
    places = [
        (k, output, term)
        for k, kind in enumerate(kinds)
        for output, terms in enumerate(kind.terms)
        for term in terms
    ]
    result = np.empty((len(places), len(force))) if room is None else room[: len(places)]
    for row, (_, _, term) in enumerate(places):
        result[row] = term.evaluate(variables)
    kind_of, output_of = np.array([place[:2] for place in places], dtype=np.intp).reshape(-1, 2).T
    return result, output_of, kind_of


def sphere(c: Calibration) -> tuple[Array, dict[str, Array]]:
    """Return directions (J, 3) [g] that force may have, with the mean of every other column.

    Of the components that the model sees, within what was applied: on a circle, or a line, where
    all positions lie in a plane, or along one.
    """
    seen = np.array([axis in c.model.inputs for axis in COMPONENTS])
    values, vectors = np.linalg.eigh((c.reference * seen).T @ (c.reference * seen))
    applied = values > _APPLIED * values[-1]
    up = _directions(int(applied.sum())) @ vectors[:, applied].T
    size = float(np.linalg.norm(c.reference, axis=1).mean())
    means = {
        name: np.full(_DIRECTIONS, float(np.mean(column)))
        for name, column in c.readings.environment.items()
    }
    return size * up, means


@lru_cache(maxsize=3)
def _directions(dimensions: int) -> Array:
    """Return points (J, dimensions) spread evenly over a sphere, a circle or from −1 to 1."""
    if dimensions == 1:
        return np.linspace(-1.0, 1.0, _DIRECTIONS)[:, None]
    if dimensions == 2:
        angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        return np.column_stack([np.cos(angle), np.sin(angle)])
    return read_scheme(f"fibonacci-{_DIRECTIONS}").up


def is_level(c: Calibration) -> bool:
    """Tell whether all readings of an output have the same noise, so that no projection has it."""
    noise = c.noise
    return (
        noise is not None
        and noise.ndim == 1
        and not np.ptp(noise.reshape(len(c.readings), -1), axis=0).any()
    )


def level_of(c: Calibration) -> Array | float:
    """Return what levels the noise of outputs (M,) with each other, where projections do not."""
    noise = c.noise
    if noise is None or not is_level(c):
        return 1.0
    return np.asarray(1.0 / np.sqrt(noise[: c.residuals.shape[1]]))


def left_of(Q: Array, Z: Array) -> Array:
    """Return what orthonormal columns Q (n, p) leave of others Z (n, q)."""
    V = Z.T.copy()
    _take_out(Q, V)
    return V.T


def _take_out(Q: Array, rows: Array) -> Array:
    """Take orthonormal columns Q (n, p) out of rows (R, n), in place; return rows @ Q."""
    blocks = [slice(first, first + _ROWS) for first in range(0, len(Q), _ROWS)]
    along, rest = np.zeros((2, len(rows), Q.shape[1]))
    for block in blocks:
        along += rows[:, block] @ Q[block]
    for block in blocks:  # twice is enough
        rows[:, block] -= along @ Q[block].T
        rest += rows[:, block] @ Q[block]
    for block in blocks:
        rows[:, block] -= rest @ Q[block].T
    return along


def _whitener(c: Calibration) -> tuple[Array, Array]:
    """Return what whitens residuals, and how much each of them (n, M) counts."""
    shape = c.residuals.shape
    weight = np.broadcast_to(1.0, shape)
    if c.robust_weight is not None:
        weight = np.broadcast_to(c.robust_weight.reshape(shape[0], -1), shape)
    if c.noise is not None and c.noise.ndim == 2:
        root = np.sqrt(weight).reshape(-1, 1)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(c.noise)) * root), weight
    if c.noise is not None and not is_level(c):
        return np.sqrt(weight / c.noise.reshape(shape)), weight
    return weight if c.robust_weight is None else np.sqrt(weight), weight


def _own_parts(
    c: Calibration, kinds: tuple[Kind, ...], whitener: Array
) -> Callable[[int, Array], _Part]:
    """Return what gives the part of an output, its terms in a room."""
    directions, means = sphere(c)
    there = c.model.basis(directions, means)
    designs = _designs(c, whitener)

    def part_of(i: int, room: Array) -> _Part:
        alone = [Kind(kind.name, (kind.terms[i],)) for kind in kinds]
        rows = terms_of(alone, c.reference, c.readings.environment, room)[0]
        rows *= whitener[:, i]
        rows_there = terms_of(alone, directions, means)[0]
        return _Part(
            *designs[i], rows, there[:, c.model.columns[i]], rows_there.T, _places_of(alone)
        )

    return part_of


def _designs(c: Calibration, whitener: Array) -> list[tuple[Array, Array]]:
    """Return Q and R of the whitened design (n, p) of each output, the same where it is shared."""
    phi = c.model.basis(c.reference, c.readings.environment)
    equal = all(np.array_equal(each, whitener[:, 0]) for each in whitener.T)
    keys = [(0 if equal else i, *own.tolist()) for i, own in enumerate(c.model.columns)]
    plain = Covariance(None, 0)
    found = {key: factor(plain, phi[:, key[1:]] * whitener[:, [key[0]]]) for key in set(keys)}
    return [found[key] for key in keys]


def _joint_part(
    c: Calibration, kinds: tuple[Kind, ...], whitener: Array
) -> Callable[[int, Array], _Part]:
    """Return what gives the part of outputs whose readings are correlated, its terms in a room."""
    directions, means = sphere(c)
    found = []
    for force, columns in ((c.reference, c.readings.environment), (directions, means)):
        phi = c.model.basis(force, columns)
        whole = block_design([phi[:, mine] for mine in c.model.columns])
        terms, _ = values_of(kinds, force, columns)
        found += [each.reshape(-1, each.shape[2]) for each in (whole, terms)]
    here, beside, there, beside_there = found
    Q, R = np.linalg.qr(whitener @ here)

    def part_of(_: int, room: Array) -> _Part:
        room[:] = (whitener @ beside).T
        return _Part(Q, R, room, there, beside_there, _places_of(kinds))

    return part_of


def _places_of(kinds: Sequence[Kind]) -> tuple[slice, ...]:
    """Return where the terms of each kind stand among all."""
    ends = np.cumsum([sum(map(len, kind.terms)) for kind in kinds]).tolist()
    return tuple(slice(*each) for each in zip([0, *ends], ends, strict=False))


_LEAST_LEFT = 1e-3  # of a column's square, which must be left of it to tell a size
_LOWER = ("1", "own", "other")


def shown_sizes(c: Calibration) -> dict[str, float]:
    """Return eq. (3) by kind [g]; of known orientations with one noise an output, else nothing."""
    plain = c.estimator.exact and c.noise is None and c.robust_weight is None
    if not plain or not c.model.has_terms:
        return {}
    response = np.linalg.norm(c.sensitivity, axis=1)
    if not response.all():
        return {}
    found: dict[str, list[float]] = {}
    for (output, term), value, u in zip(
        c.model.keys, c.parameters.tolist(), c.u.tolist(), strict=True
    ):
        if term.force_degree > 1 and math.isfinite(u):
            size = response[c.outputs.index(output)]
            found.setdefault(str(term), []).append((value**2 + u**2) / size**2)
    for kind in lacking(c):
        if kind.name in OF_FORCE and kind.name not in _LOWER:
            found |= {kind.name: squares} if (squares := _tested(c, kind, response)) else {}
    return {name: math.sqrt(float(np.mean(squares))) for name, squares in found.items()}


def _tested(c: Calibration, kind: Kind, response: Array) -> list[float]:
    """Return (c² + u²)/|K|² of each column of a kind that the positions tell."""
    phi = c.model.basis(c.reference, c.readings.environment)
    result = []
    for i, (columns, terms) in enumerate(zip(c.model.columns, kind.terms, strict=True)):
        if not terms:
            continue
        Z = values_of([Kind(kind.name, (terms,))], c.reference, c.readings.environment)[0][:, 0]
        Q = np.linalg.qr(phi[:, columns])[0]
        V = left_of(Q, Z)
        gram, nu = V.T @ V, len(Z) - Q.shape[1] - Z.shape[1]
        identifiable = np.linalg.eigvalsh(gram)[0] > _LEAST_LEFT * np.sum(Z**2, axis=0).max()
        if nu < 1 or not identifiable:
            continue
        inverse = np.linalg.inv(gram)
        coefficients = inverse @ (V.T @ c.residuals[:, i])
        rest = c.residuals[:, i] - V @ coefficients
        square = coefficients**2 + float(rest @ rest) / nu * np.diag(inverse)
        result += (square / response[i] ** 2).tolist()
    return result

"""What positions show of terms that a model lacks: projections, and what they leave unseen.

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

The terms that a model could have: the standard ones up to third order that it lacks.

Kinds of terms are written for an output of any axis, `own` and `other` standing for components:

    1, own, other · own², own|own|, own³, own·other · and of every column, the next power of it
    alone and with own, up to the third.                                                    (2)

They are those of the standard models (IEEE Std 1293: K0, K1 and misalignment; K2, Koq, K3, Kip and
Kio). Squares and products of the other components are not among them: x² + y² + z² = 1 at rest.

How large the terms of higher order are that the positions do show, for a guess at the others.

What is hidden can only be stated, in a budget's [unseen]; what nobody knows is guessed from its
kin. Of a term of second or third order, fitted or tested beside the model, with coefficients c_i
of standard uncertainty u_i in outputs that respond by |K_i|,

    size = sqrt(mean over i of (c_i² + u_i²) / |K_i|²)   [g],                                (3)

which holds what was found and what noise leaves open. For a tested one, c = (V'V)⁻¹V'e and
u² = s²(V'V)⁻¹ with V what the fit leaves of its column and s² of what it leaves of residuals e:
what a fit with the term would give, without the fit.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import block_design
from multipos.numerics.terms import COMPONENTS, NAMED, Term, kind_terms
from multipos.positions.scheme import read_scheme
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
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
    own: tuple[tuple[Term, ...], ...] = model.terms
    if isinstance(model, ExpressionModel):
        own = ((),) * len(model.outputs)  # its derivatives tell what it has
    found = (
        Kind(
            name,
            tuple(
                tuple(term for term in kind_terms(name, axis, model.inputs) if term not in has)
                for axis, has in zip(model.axes, own, strict=True)
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


class Setting:
    """What a projection depends on: positions, terms and weights; equal where these are."""

    def __init__(self, c: Calibration, kinds: tuple[Kind, ...], added: tuple[str, ...]) -> None:
        self.calibration: Calibration = c
        self.kinds: tuple[Kind, ...] = kinds
        self.added: tuple[str, ...] = added
        columns = c.readings.environment
        self._key = (
            *(c.model.names, c.model.axes, c.model.inputs, tuple(kind.name for kind in kinds)),
            *(added, c.reference.tobytes(), *(columns[name].tobytes() for name in sorted(columns))),
            b"" if is_level(c) or c.noise is None else c.noise.tobytes(),
            b"" if c.robust_weight is None else c.robust_weight.tobytes(),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Setting) and self._key == other._key


@dataclass(frozen=True, eq=False)
class Projection:
    """V at known orientations, as orthonormal rows in blocks of a kind and an output.

    Attributes
    ----------
    whitener : (n, M) or (n M, n M) array
    fitted : tuple of arrays
        Q of each output's design, or of the one of all.
    rows : (R, n) or (R, n M) array
    output : (R,) array
        The column of whitened residuals that a row is for.
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
    output: NDArray[np.intp]
    starts: NDArray[np.intp]
    place: NDArray[np.intp]
    q: Array
    left: Array
    names: tuple[str, ...]
    hidden: tuple[str, ...]

    def whitened(self, residuals: Array) -> Array:
        """Return residuals (n, M) as columns that the rows take."""
        if self.whitener.shape == residuals.shape:
            return self.whitener * residuals
        return np.asarray((self.whitener @ residuals.ravel())[:, None])


@dataclass(frozen=True, eq=False)
class _Part:
    """The design of one output, or of all, and the terms of each kind; here and on the sphere."""

    design: Array
    terms: tuple[Array, ...]
    design_there: Array
    terms_there: tuple[Array, ...]


@lru_cache(maxsize=_KEPT)
def project(setting: Setting) -> Projection:
    """Return the projection of a setting; a kind is hidden where it is of any output."""
    c, kinds = setting.calibration, setting.kinds
    together = c.noise is not None and c.noise.ndim == 2
    whitener, weight = _whitener(c)
    parts = [_joint_part(c, kinds, whitener)] if together else _own_parts(c, kinds, whitener)
    q = np.zeros((len(kinds), len(parts)))
    blocks: list[Array] = []
    place: list[int] = []
    fitted, hidden = [], set()
    for column, part in enumerate(parts):
        Q, R = np.linalg.qr(part.design)
        there = part.design_there @ np.linalg.inv(R)
        for kind, Z in zip(kinds, part.terms, strict=True):
            if kind.name in setting.added:
                Q = np.column_stack([Q, seen_rows(left_of(Q, Z), Z).T])
        fitted.append(Q)
        for k, (kind, Z, Z_there) in enumerate(
            zip(kinds, part.terms, part.terms_there, strict=True)
        ):
            if not Z.shape[1] or kind.name in setting.added:
                continue
            V = left_of(Q, Z)
            if not setting.added and kind.name in OF_FORCE:
                error = Z_there - there @ (Q.T @ Z)
                size = float(np.mean(np.sum(there**2, axis=1)))
                hidden |= {kind.name} if hides(V.T @ V, error, Z_there, size) else set()
            rows = seen_rows(V, Z)
            if len(rows):
                blocks.append(rows)
                place.append(k * len(parts) + column)
                q[k, column] = len(rows)
    left = np.array([weight.sum()] if together else weight.sum(axis=0))
    sizes = np.array([len(rows) for rows in blocks], dtype=np.intp)
    return Projection(
        whitener=whitener,
        fitted=tuple(fitted),
        rows=np.concatenate([np.zeros((0, len(parts[0].design))), *blocks]),
        output=np.repeat(np.array(place, dtype=np.intp) % len(parts), sizes),
        starts=np.cumsum(sizes) - sizes,
        place=np.array(place, dtype=np.intp),
        q=q,
        left=left - [Q.shape[1] for Q in fitted],
        names=tuple(kind.name for kind in kinds),
        hidden=tuple(kind.name for kind in kinds if kind.name in hidden),
    )


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
    if not (np.mean(error**2, axis=0) > _IMITATED**2 * np.mean(whole**2, axis=0)).any():
        return False
    scale = float(np.trace(gram)) + size**-1.0 * float(np.mean(error**2))
    mean = error.T @ error / len(error)
    ratio = np.linalg.eigvals(np.linalg.solve(gram + _NOTHING * scale * np.eye(len(gram)), mean))
    return bool(ratio.real.max() > _HIDDEN**2 * size)


def seen_rows(V: Array, Z: Array) -> Array:
    """Return orthonormal rows (r, n) of the part of V (n, q) that is more than rounding of Z."""
    scale = np.sqrt(np.einsum("nq,nq->q", Z, Z))
    U = V / np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(U.T @ U)
    identifiable = values > IDENTIFIABLE
    return np.asarray((U @ vectors[:, identifiable] / np.sqrt(values[identifiable])).T)


def values_of(
    kinds: Sequence[Kind], force: Array, environment: Mapping[str, Array]
) -> tuple[Array, NDArray[np.intp]]:
    """Return all terms as columns (n, M, R) of readings, and the kind of each (R,)."""
    rows, output_of, kind_of = terms_of(kinds, force, environment)
    result = np.zeros((len(force), len(kinds[0].terms), len(rows)))
    result[:, output_of, np.arange(len(rows))] = rows.T
    return result, kind_of


def terms_of(
    kinds: Sequence[Kind], force: Array, environment: Mapping[str, Array]
) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Return all terms as rows (R, n), and the output and kind of each (R,)."""
    variables = {axis: force[:, i] for i, axis in enumerate(COMPONENTS)} | dict(environment)
    places = [
        (k, output, term)
        for k, kind in enumerate(kinds)
        for output, terms in enumerate(kind.terms)
        for term in terms
    ]
    result = np.empty((len(places), len(force)))
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
    V = Z - Q @ (Q.T @ Z)
    return np.asarray(V - Q @ (Q.T @ V))  # twice is enough


def _whitener(c: Calibration) -> tuple[Array, Array]:
    """Return what whitens residuals, and how much each of them (n, M) counts."""
    shape = c.residuals.shape
    weight = np.ones(shape)
    if c.robust_weight is not None:
        weight = np.broadcast_to(c.robust_weight.reshape(shape[0], -1), shape)
    if c.noise is not None and c.noise.ndim == 2:
        root = np.sqrt(weight).reshape(-1, 1)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(c.noise)) * root), weight
    variances = np.ones(shape)
    if c.noise is not None and not is_level(c):
        variances = c.noise.reshape(shape)
    return np.asarray(np.sqrt(weight / variances)), weight


def _own_parts(c: Calibration, kinds: tuple[Kind, ...], whitener: Array) -> list[_Part]:
    directions, means = sphere(c)
    here = c.model.basis(c.reference, c.readings.environment)
    there = c.model.basis(directions, means)
    result = []
    for i, columns in enumerate(c.model.columns):
        alone = [Kind(kind.name, (kind.terms[i],)) for kind in kinds]
        weight = whitener[:, [i]]
        result.append(
            _Part(
                here[:, columns] * weight,
                tuple(weight * z for z in _by_kind(alone, c.reference, c.readings.environment)),
                there[:, columns],
                _by_kind(alone, directions, means),
            )
        )
    return result


def _joint_part(c: Calibration, kinds: tuple[Kind, ...], whitener: Array) -> _Part:
    """Return the part of outputs whose readings are correlated."""
    directions, means = sphere(c)
    designs = []
    for force, columns in ((c.reference, c.readings.environment), (directions, means)):
        phi = c.model.basis(force, columns)
        whole = block_design([phi[:, mine] for mine in c.model.columns])
        terms = _by_kind(kinds, force, columns)
        designs.append([each.reshape(-1, each.shape[2]) for each in (whole, *terms)])
    (here, *z_here), (there, *z_there) = designs
    return _Part(whitener @ here, tuple(whitener @ z for z in z_here), there, tuple(z_there))


def _by_kind(
    kinds: Sequence[Kind], force: Array, environment: Mapping[str, Array]
) -> tuple[Array, ...]:
    """Return the columns of each kind, (n, q) of one output, (n, M, q) of several."""
    values, kind_of = values_of(kinds, force, environment)
    if values.shape[1] == 1:
        values = values[:, 0]
    return tuple(values[..., kind_of == k] for k in range(len(kinds)))


_LEAST_LEFT = 1e-3  # of a column's square, which must be left of it to tell a size
_LOWER = ("1", "own", "other")


def shown_sizes(c: Calibration) -> dict[str, float]:
    """Return eq. (3) by kind [g]; of known orientations with one noise an output, else nothing."""
    plain = c.estimator.exact and c.noise is None and c.robust_weight is None
    if not plain or isinstance(c.model, ExpressionModel):
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

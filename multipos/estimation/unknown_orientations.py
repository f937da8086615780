"""Unknown orientations of triads: one number a position, B units at once.

`estimate_unknown` fits B units of which `share_sphere` is what they share; `search` is where their
searches end, and `fit_ellipsoids` where they start, as `linear_parameters`. `is_along_force` tells
where all of this holds, `combined` are outputs of coefficients, and `symmetric_root` is a square
root of M M'.

Where nothing is known of any position and three outputs see it, what is left of a reading after
its two angles are eliminated is its part along the normal of the surface that the readings of all
directions form. With the residuals r = y − h(f) of variances Σ, G = dh/df and A = dh/dθ,

    W = m m',      m = n/√(n'Σn),      n = det(G) G⁻ᵀ f,                                    (1)
    S = Σ a a',    a = A'm,            S d = Σ a m'r,                                       (2)

and the direction follows along the surface, which needs no projection:

    df = G⁻¹ (x − Σ m m'x),            x = r − A d,        f'df = 0.                        (3)

That is `multipos.estimation.likelihood` at s = ∞ to the digit, in a fifth of its operations; a test
holds the two together. A robust loss weights the rows a by the root of its weight. Units share the
form of the equations and nothing else. Each starts on the ellipsoid on which its readings lie: with
y = b + M d and |d| = g,

    (y − b)' (M M')⁻¹ (y − b) = g²,                                                         (4)

a quadric. With S₀ a symmetric matrix of trace zero, it is one that is linear in its unknowns,

    |y|² = y'S₀y + 2 v'y + w,      B = I − S₀,    b = B⁻¹v,    ρ² = w + v'B⁻¹v,             (5)

and (y − b)'B(y − b) = ρ². It is fitted to centred, scaled readings by least squares, so that
neither a unit nor a guess is needed. M M' = (ρ²/g²) B⁻¹ then, and M is its lower triangular
(Cholesky) or symmetric square root: any other differs by a rotation, which no reading at rest can
show. What the positions do not determine stays zero in S₀, as on a sphere. Noise can make the
quadric something else than an ellipsoid; then cross terms are left out of S₀, and last all of it.

Stated noise is a lower bound: its excess is integrated over. Where nothing is stated, u allows for
axes of unequal noise (both in `multipos.estimation.variances`).

`estimate_unknown` leaves a unit to the fit of one where the ellipsoid needs more care than least
squares, where a search has not ended, where S is badly conditioned, where noise might hide a
parameter, or where stated uncertainties cannot be weights.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from multipos.estimation.batches import (
    Estimates,
    Solution,
    compensated,
    join_estimates,
    model_coefficients,
)
from multipos.estimation.identifiability import plausible_range
from multipos.estimation.known import ROUNDING
from multipos.estimation.problem import Point, Problem, State
from multipos.estimation.stated_uncertainty import StatedNoise, combined_jointly, taken_by_blocks
from multipos.estimation.variances import (
    Block,
    Linear,
    StatedComponents,
    estimate,
    with_unequal_outputs,
)
from multipos.files.records import LARGEST
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, median
from multipos.numerics.cofactors import cofactors_of
from multipos.numerics.levenberg_marquardt import STRICT, Rules, descend
from multipos.numerics.losses import Loss, loss, loss_weight
from multipos.numerics.quantiles import coverage_factors
from multipos.numerics.rotations import step_on_sphere, tangent_basis
from multipos.results import frozen
from multipos.sensor.model import Model


@frozen
class SharedSphere:
    """What units of unknown orientation share.

    Attributes
    ----------
    model : Model
        With its gauge.
    size : float [g]
        Of the reference.
    environment : mapping of str to (n,) array
        Other columns of the model.
    """

    model: Model
    size: float
    environment: Mapping[str, Array]


class Place(NamedTuple):
    """Units (B) at a point of their search; positions run fastest in memory."""

    theta: Array  # (B, p)
    coefficients: Array  # of the terms of each output, (B, M, T)
    q: Array  # what each position adds to F, (B, n)
    objective: Array  # F, (B,)
    step: Array  # t from the listed directions (2, B, n) [rad]; of unknown ones (0, B, n)
    force: Array  # (3, B, n) [g]
    phi: Array  # terms of the model, (T, B, n)
    residuals: Array  # (M, B, n)

    def of(self, units: NDArray[Any]) -> "Place":
        """Return some of the units."""
        across = [each[:, units] for each in self[4:]]
        return Place(*(each[units] for each in self[:4]), *across)

    def put(self, units: Places, other: "Place") -> None:
        """Put other units in places of these."""
        for mine, theirs in zip(self[:4], other[:4], strict=True):
            mine[units] = theirs
        for mine, theirs in zip(self[4:], other[4:], strict=True):
            mine[:, units] = theirs

    def point(self, model: Model) -> Point:
        """Return the place of one unit as other searches have it."""
        phi = self.phi[:, 0]
        blocks = tuple((rows, phi.take(columns, axis=0).T) for columns, rows in model.contributions)
        force, residuals = self.force[:, 0].T, self.residuals[:, 0].T
        return Point(force, blocks, residuals, self.q[0], float(self.objective[0]))


class Surface(NamedTuple):
    """The normal equations, eqs. (1), (2)."""

    information: Array  # (B, p, p)
    gradient: Array  # (B, p)
    rows: Array  # a, (B, p, n)
    height: Array  # m'r, (B, n)
    cofactors: Array  # (3, 3, B, n), of G
    determinant: Array  # (B, n)
    normal: Array  # m, (3, B, n)
    across: Array  # Σm, (3, B, n)
    excess: Array  # (B, n), how far outside a reading lies, relative to the force


def combined(coefficients: Array, phi: Array) -> Array:
    """Return the outputs (M, B, n) of coefficients (B, M, T) and terms (T, B, n)."""
    found = coefficients @ phi.transpose(1, 0, 2)
    return np.ascontiguousarray(found.transpose(1, 0, 2))


def is_along_force(problem: Problem) -> bool:
    """Return whether all positions of a triad are unknown and its outputs uncorrelated.

    W is then that of eq. (1).
    """
    return bool(
        problem.unknown.all()
        and problem.precision.ndim == 2
        and problem.values.shape[1] == 3
        and not problem.shared
    )


@frozen
class UnknownSearch:
    """What a step of the search needs.

    Attributes
    ----------
    shared : SharedSphere
    values, variance : (3, B, n) arrays
        Readings and Σ.
    robust : str or None
        Name of a loss.
    degrees : (n,) array
        Degrees of freedom of each position, which the loss asks for.
    """

    shared: SharedSphere
    values: Array
    variance: Array
    robust: Loss | None = None
    degrees: Array = field(default_factory=lambda: np.ones(1))
    rules = Rules()

    @staticmethod
    def fits(problem: Problem) -> bool:
        """Return whether a problem is one of these, with a model of terms."""
        return is_along_force(problem) and type(problem.model) is Model

    @classmethod
    def of_problem(cls, problem: Problem) -> Self:
        """Return the search of a problem that `fits`, a batch of one."""
        model = problem.model
        columns = {name: problem.environment[name] for name in model.fitted_columns}
        return cls(
            SharedSphere(model, float(problem.magnitude[0]), columns),
            problem.values.T[:, None],
            1.0 / problem.precision.T[:, None],
            problem.robust,
            problem.degrees,
        )

    def begin(self, state: State) -> Place:
        """Return the place of a state."""
        direction = state.centre
        if state.step.any():
            direction = step_on_sphere(direction, state.basis, state.step)
        return self.at(state.theta[None], (self.shared.size * direction.T)[:, None])

    def place(self, state: State, point: Point) -> Place:
        """Return the place of a state at which the model is known."""
        theta, force, residuals = state.theta[None], point.force.T[:, None], point.residuals.T
        coefficients, phi = model_coefficients(self.shared.model, theta), self._phi(force)
        misfits = point.q[None], np.array([point.objective])
        return Place(theta, coefficients, *misfits, force[:0], force, phi, residuals[:, None])

    def end(self, place: Place, state: State) -> tuple[State, Point]:
        """Return state and point of a place, from the state of the beginning."""
        centre = (place.force[:, 0] / self.shared.size).T
        found = replace(
            state,
            theta=place.theta[0],
            centre=centre,
            basis=tangent_basis(centre),
            step=np.zeros_like(state.step),
        )
        return found, place.point(self.shared.model)

    def of(self, units: Places) -> Self:
        """Return the search of some of the units."""
        return replace(self, values=self.values[:, units], variance=self.variance[:, units])

    def at(self, theta: Array, force: Array) -> Place:
        """Return units at parameters (B, p) and forces (3, B, n)."""
        return self._at(theta, model_coefficients(self.shared.model, theta), force)

    def _at(self, theta: Array, coefficients: Array, force: Array) -> Place:
        phi = self._phi(force)
        residuals = self.values - combined(coefficients, phi)
        misfits = self._misfits(residuals)
        return Place(theta, coefficients, *misfits, force[:0], force, phi, residuals)

    def under_noise(self, place: Place) -> Place:
        """Return a place with the misfits that this noise makes of its residuals."""
        q, objective = self._misfits(place.residuals)
        return place._replace(q=q, objective=objective)

    def _misfits(self, residuals: Array) -> tuple[Array, Array]:
        q = np.einsum("mbn,mbn->bn", residuals, residuals / self.variance)
        total = q if self.robust is None else loss(self.robust, q, self.degrees)
        return q, total.sum(axis=1)

    def linearise(self, place: Place) -> Surface:
        """Return the normal equations of eqs. (1), (2), weighted by the loss."""
        model, size = self.shared.model, self.shared.size
        G = model.force_slopes(place.coefficients, place.force, self.shared.environment)
        cofactors = cofactors_of(G)
        determinant = np.einsum("ibn,ibn->bn", G[0], cofactors[0])
        normal = np.einsum("mibn,ibn->mbn", cofactors, place.force)
        across = self.variance * normal
        height = np.einsum("mbn,mbn->bn", normal, place.residuals)
        excess = height / (determinant * size**2)
        root = 1.0 / np.sqrt(np.einsum("mbn,mbn->bn", normal, across))
        normal *= root
        across *= root
        height *= root
        outputs, columns, copies = model.rows
        rows = normal.take(outputs, axis=0) * place.phi.take(columns, axis=0)
        for parameter, output, column in copies:
            rows[parameter] += normal[output] * place.phi[column]
        rows = np.ascontiguousarray(rows.transpose(1, 0, 2))
        weighted = rows
        if self.robust is not None:
            weighted = rows * loss_weight(self.robust, place.q, self.degrees)[:, None]
        return Surface(
            weighted @ rows.transpose(0, 2, 1),
            (weighted @ height[:, :, None])[:, :, 0],
            rows,
            height,
            cofactors,
            determinant,
            normal,
            across,
            excess,
        )

    def move(self, place: Place, surface: Surface, step: Array, damping: Array) -> Place:
        """Return places after steps (B, p) of the parameters, directions following by eq. (3)."""
        change = model_coefficients(self.shared.model, step)
        left = place.residuals - combined(change, place.phi)
        left -= surface.across * np.einsum("mbn,mbn->bn", surface.normal, left)
        turn = np.einsum("mibn,mbn->ibn", surface.cofactors, left) / surface.determinant
        # as in `multipos.estimation.likelihood`: damped like the rest, and eased far outside the
        # sphere
        ease = (1.0 + damping[:, None]) * (1.0 + np.maximum(surface.excess, 0.0))
        force = place.force + turn / ease
        force *= self.shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force))
        return self._at(place.theta + step, place.coefficients + change, force)

    def solution(self, place: Place, surface: Surface) -> Solution:
        """Return units about places."""
        m = surface.normal
        slopes = m[:, None] * surface.rows.transpose(1, 0, 2)
        push = place.residuals / self.variance
        of_units = m[:, None] * m, slopes, surface.information, push, self.variance, place.force
        return Solution(*of_units, place.objective, m, surface.rows)

    def linear(self, place: Place, stated: Array) -> Linear:
        """Return the linear models of what lies along the normals, of length one.

        `stated` (3, B, n) are the variances to state.
        """
        surface = self.linearise(place)
        length = np.sqrt(np.einsum("mbn,mbn->bn", surface.normal, surface.normal))
        design = surface.rows.transpose(0, 2, 1) / length[:, :, None]
        mix = surface.normal / length
        variance = np.einsum("mbn,mbn->bn", mix**2, stated)
        none = np.zeros((*length.shape, 1, 2))
        error = (surface.height / length)[..., None]
        whole = (error, design[:, :, None], none, variance[..., None])
        return Linear((Block(*whole, np.moveaxis(mix, 0, 2)[:, :, None]),))

    def _phi(self, force: Array) -> Array:
        _, count, n = force.shape
        columns = {name: np.tile(each, count) for name, each in self.shared.environment.items()}
        phi = self.shared.model.basis(force.reshape(3, -1).T, columns)
        return phi.T.reshape(-1, count, n)


def search(start: Any, place: Place, decrement: float = STRICT) -> tuple[Place, Mask]:
    """Return where the searches of units end, unknown or uncertain, and of which they do."""
    largest = np.sqrt((start.values**2 / start.variance).max(axis=(0, 2)))
    found, ended = descend(start, place, start.rules._replace(decrement=decrement), largest)
    return found, ended.converged


class SearchedUnits:
    """Units at the end of their searches, whose noise is estimated: with the stated one first."""

    def __init__(self, first: Any, search: Any, place: Place, *, stated: bool = True) -> None:
        """Take the searches under the first noise, which is `stated` or any, and the present."""
        self.first, self.search, self.found, self.stated = first, search, place, stated

    def of(self, units: Places) -> Self:
        """Return some of the units."""
        parts = (each.of(units) for each in (self.first, self.search, self.found))
        return type(self)(*parts, stated=self.stated)

    def put(self, units: Places, other: Self) -> None:
        """Put other units in places of these."""
        self.search.variance[:, units] = other.search.variance
        self.found.put(units, other.found)

    def with_noise(self, noise: Array) -> Array:
        """Return variances (M, B, n) of noise (B, M) beside what is stated."""
        more = noise.T[:, :, None]
        if self.stated:
            return np.asarray(self.first.variance + more)
        return np.array(np.broadcast_to(more, self.first.variance.shape))

    def under(self, **noise: Array) -> tuple[Self, Mask]:
        """Return the units under another noise, searched on from here, and which have ended."""
        following = replace(self.first, **noise)
        place, ended = search(following, following.under_noise(self.found))
        return type(self)(self.first, following, place, stated=self.stated), ended


class _Units(SearchedUnits):
    def linear(self) -> Linear:
        found: Linear = self.search.linear(self.found, self.first.variance)
        return found

    def searched(self, noise: Array, factor: Array | None) -> tuple[Self, Mask]:
        return self.under(variance=self.with_noise(noise))


_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_STILL = 1e-6  # relative change of an output below which it may be none
_SPREAD = 1e-3  # ratio of squared extents of the readings, below which they may be flat
_SEEN = 1e-6  # relative eigenvalue below which a coefficient is not seen in the positions
_SHOWN = 1e-5  # the same, below which it may not be
_FLATTEST = 4e-4  # squared ratio of semi-axes below which a quadric is no ellipsoid
_ROUND = 0.01  # the same, below which it may not be one
_WORST = 1e-8  # eigenvalue of the scaled information below which a fit is doubted for it
_CLEAR = 200.0  # of the readings: information beyond which no noise hides a parameter


def share_sphere(
    model: Model, size: float, environment: Mapping[str, Array]
) -> SharedSphere | None:
    """Return what units share, or None where a batch does not do the fit of one does."""
    own = model.axes == model.inputs == COMPONENTS and len(model.own_scales) == len(COMPONENTS)
    if not own or not model.has_all_linear:
        return None
    return SharedSphere(model, size, {name: environment[name] for name in model.environment})


def estimate_unknown(
    shared: SharedSphere,
    values: Sequence[Array],
    stated: Sequence[Array] = (),
    stated_dof: Sequence[Array] = (),
) -> Estimates:
    """Fit B units of unknown orientation.

    Parameters
    ----------
    shared : SharedSphere
    values : 3 arrays (B, n)
        Readings of each output.
    stated, stated_dof : 3 arrays (B, n), or none
        Their standard uncertainties, and the degrees of freedom of those.
    """
    parts = []
    for y, noise in taken_by_blocks(values, stated, stated_dof, _AT_ONCE):
        with np.errstate(all="ignore"):  # a trial may run away, and is then left out
            parts.append(_estimate(shared, y, noise))
    return join_estimates(parts)


class _Found(NamedTuple):
    """Where the searches of B units ended, and the uncertainty of their parameters."""

    place: Place
    u: Array  # (B, p)
    dof: Array  # (B, p)
    valid: Mask
    search: UnknownSearch
    surface: Surface


def _estimate(shared: SharedSphere, values: Array, noise: StatedNoise | None) -> Estimates:
    model = shared.model
    n, p = values.shape[2], len(model.keys)
    variance = np.ones_like(values) if noise is None else np.moveaxis(noise.u**2, 2, 0).copy()
    valid, theta, force = _start(shared, values)
    start = UnknownSearch(shared, values, variance)
    place, ended = search(start, start.at(theta, force))
    surface = start.linearise(place)
    nu = float(n - p)
    factor = place.objective / nu
    valid &= ended & _is_identifiable(shared, place, surface.information, factor)
    chi2 = None
    if noise is None:
        valid &= _inverse(surface.information).valid
        u, dof = np.full((2, *place.theta.shape), np.nan)
        some = np.flatnonzero(valid)
        if len(some):
            linear = start.linear(place, variance).without_noise().of(some)
            u[some], dof[some] = with_unequal_outputs(linear)
        found = _Found(place, u, dof, valid, start, surface)
    else:
        chi2 = place.objective.copy()
        found = _with_excess(start, place, noise, valid)
    place, valid = found.place, found.valid & (np.abs(found.place.theta).max(axis=1) <= LARGEST)
    valid &= (place.theta[:, list(model.own_scales)] > 0.0).all(axis=1)
    squares = np.einsum("mbn,mbn->b", place.residuals, place.residuals)
    valid &= squares > ROUNDING**2 * np.einsum("mbn,mbn->b", values, values)
    force = place.force.transpose(1, 2, 0)
    left = compensated(
        model,
        shared.environment,
        force,
        model_coefficients(model, place.theta),
        values,
        place.residuals,
    )
    length = np.linalg.norm(force + left.force, axis=2)
    rms = np.sqrt(np.mean((length - shared.size) ** 2, axis=1))
    valid &= left.inverted.sound
    of_units = place.theta, found.u, found.dof, rms, place.residuals
    solution = found.search.solution(place, found.surface)
    estimates = Estimates(*of_units, *left.inverted[:2], valid, chi2)
    return estimates._replace(solutions=(solution,))


def _with_excess(start: UnknownSearch, place: Place, noise: StatedNoise, valid: Mask) -> _Found:
    """Return the solutions with the excess variance of readings whose noise is stated."""
    first = replace(start, variance=start.variance.copy())
    units = _Units(first, start, place)
    try:
        found = estimate(units, valid & noise.sound, StatedComponents(True, "exact"))
    except np.linalg.LinAlgError:  # some unit is as good as singular
        nothing = np.full(place.theta.shape, np.nan)
        return _Found(place, nothing, nothing, np.zeros_like(valid), start, start.linearise(place))
    u = found.U / coverage_factors(0.95, found.dof)
    dof = combined_jointly(found.dof, noise, found.noise)
    surface = units.search.linearise(units.found)
    return _Found(units.found, u, dof, found.valid, units.search, surface)


def _start(shared: SharedSphere, values: Array) -> tuple[Mask, Array, Array]:
    """Return which units have an ellipsoid, parameters (B, p) and forces (3, B, n) there."""
    model = shared.model
    crossed = any("cross_" in name for name in model.names)
    found = fit_ellipsoids(values.transpose(1, 0, 2), crossed=crossed)
    matrix = found.lower / shared.size
    if model.gauge == "symmetric":
        matrix = symmetric_root(matrix)
    linear = np.concatenate([found.bias[:, :, None], matrix], axis=2)
    centred = values.transpose(1, 0, 2) - found.bias[:, :, None]
    force = np.linalg.solve(matrix, centred).transpose(1, 0, 2)
    force = force * (shared.size / np.sqrt(np.einsum("ibn,ibn->bn", force, force)))
    return found.clear, linear_parameters(model, linear), force


def linear_parameters(model: Model, linear: Array) -> Array:
    """Return parameters (B, p) with constants and slopes (B, M, 4) of each output, others 0."""
    theta = np.zeros((len(linear), len(model.keys)))
    for i, (output, term) in enumerate(model.keys):
        column = {"1": 0, "x": 1, "y": 2, "z": 3}.get(str(term))
        if column is not None:
            theta[:, i] = linear[:, model.outputs.index(output), column]
    return theta


def symmetric_root(lower: Array) -> Array:
    """Return the symmetric square roots of L L' (…, 3, 3)."""
    left, singular, _ = np.linalg.svd(lower)
    return np.asarray((left * singular[..., None, :]) @ np.swapaxes(left, -1, -2))


class Ellipsoids(NamedTuple):
    """Ellipsoids of the readings of B units.

    Attributes
    ----------
    bias : (B, 3) array
    lower : (B, 3, 3) array
        Lower triangular M times g.
    change, thickness : (B,) arrays
        The least root mean square of an output about its mean, relative to the largest reading,
        and the ratio of the squared extents of the cloud of readings.
    clear : (B,) array of bool
        Which least squares give well, of readings that spread.
    """

    bias: Array
    lower: Array
    change: Array
    thickness: Array
    clear: Mask


def fit_ellipsoids(values: Array, *, crossed: bool) -> Ellipsoids:
    """Return the ellipsoids on which readings (B, 3, n) lie, eqs. (4), (5).

    Without cross terms in M, six coefficients are fitted instead of nine.
    """
    n = values.shape[2]
    centre = values.sum(axis=2) / n
    y = values - centre[:, :, None]
    square = y @ y.transpose(0, 2, 1)
    size = np.sqrt(np.einsum("bii->bi", square) / n)
    largest = np.abs(values).max(axis=(1, 2))
    change = size.min(axis=1) / np.where(largest > 0.0, largest, 1.0)
    size = np.where(size > 0.0, size, 1.0)
    extent = np.linalg.eigvalsh(square)
    thickness = extent[:, 0] / np.where(extent[:, -1] > 0.0, extent[:, -1], 1.0)
    points = y / size[:, :, None]
    found = _quadrics(points, crossed=crossed)
    clear = found.clear & (change > _STILL) & (thickness > _SPREAD)
    bias, square, good = found.bias, found.square, found.good
    for quadrics in (_quadrics, _spheres):
        bad = np.flatnonzero(~good)
        if not len(bad):
            break
        simpler = quadrics(points[bad], crossed=False)
        bias[bad], square[bad], good[bad] = simpler.bias, simpler.square, simpler.good
    lower = size[:, :, None] * np.linalg.cholesky(square)
    return Ellipsoids(centre + size * bias, lower, change, thickness, clear)


class _Quadrics(NamedTuple):
    bias: Array  # b, (B, 3)
    square: Array  # ρ² B⁻¹, (B, 3, 3)
    good: Mask  # that are ellipsoids
    clear: Mask  # far from anything else


def _quadrics(points: Array, *, crossed: bool) -> _Quadrics:
    """Return the quadrics of eq. (5) of points (B, 3, n)."""
    x, y, z = np.moveaxis(points, 1, 0)
    columns = [x * x - z * z, y * y - z * z, 2 * x, 2 * y, 2 * z, np.ones_like(x)]
    if crossed:
        columns += [2 * x * y, 2 * x * z, 2 * y * z]
    c, weakest = _least_squares(columns, points)
    form = np.zeros((len(points), 3, 3))
    form[:, 0, 0], form[:, 1, 1], form[:, 2, 2] = 1.0 - c[0], 1.0 - c[1], 1.0 + c[0] + c[1]
    if crossed:
        for place, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), start=6):
            form[:, i, j] = form[:, j, i] = -c[place]
    axes = np.linalg.eigvalsh(form)
    good = axes[:, 0] > _FLATTEST * axes[:, -1]
    form[~good] = np.eye(3)
    inverse = np.asarray(np.linalg.inv(form), dtype=np.float64)
    bias = np.einsum("bij,jb->bi", inverse, c[2:5])
    radius = c[5] + np.einsum("jb,bj->b", c[2:5], bias)
    good &= radius > 0.0
    square = inverse * np.where(good, radius, 1.0)[:, None, None]
    clear = good & (weakest > _SHOWN) & (axes[:, 0] > _ROUND * axes[:, -1])
    return _Quadrics(bias, square, good, clear)


def _spheres(points: Array, *, crossed: bool) -> _Quadrics:
    """Return the same of spheres, which are ellipsoids always."""
    x, y, z = np.moveaxis(points, 1, 0)
    c, _ = _least_squares([2 * x, 2 * y, 2 * z, np.ones_like(x)], points)
    radius = np.maximum(c[3] + np.sum(c[:3] ** 2, axis=0), 1.0)
    good = np.ones(len(points), dtype=np.bool_)
    square = np.asarray(radius[:, None, None] * np.eye(3), dtype=np.float64)
    return _Quadrics(c[:3].T, square, good, good)


def _least_squares(columns: list[Array], points: Array) -> tuple[Array, Array]:
    """Return the coefficients (c, B) of |y|², zero where the positions do not determine them.

    With them the least eigenvalue (B,) of their information, relative to the largest.
    """
    design = np.stack(columns, axis=1)
    square = np.einsum("bin,bin->bn", points, points)
    values, vectors = np.linalg.eigh(design @ design.transpose(0, 2, 1))
    kept = values > _SEEN * values[:, -1:]
    turned = np.einsum("bcq,bc->bq", vectors, (design @ square[:, :, None])[:, :, 0])
    turned *= kept / np.where(kept, values, 1.0)
    return np.einsum("bcq,bq->cb", vectors, turned), values[:, 0] / values[:, -1]


class _Inverse(NamedTuple):
    """Inverses of matrices (B, p, p), and which of these are well conditioned."""

    matrix: Array
    valid: Mask


def _inverse(information: Array) -> _Inverse:
    scale = np.sqrt(np.einsum("bpp->bp", information))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    valid = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~valid] = np.eye(scaled.shape[1])
    sizes = np.linalg.eigvalsh(scaled)
    valid &= sizes[:, 0] > _WORST * sizes[:, -1]
    scaled[~valid] = np.eye(scaled.shape[1])
    return _Inverse(np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :]), valid)


def _is_identifiable(shared: SharedSphere, place: Place, information: Array, factor: Array) -> Mask:
    """Return which units determine every parameter far beyond what noise alone could explain."""
    model = shared.model
    typical = median(place.theta, axis=0)
    limit = plausible_range(model, typical, shared.size)
    if limit is None:
        return np.zeros(len(factor), dtype=np.bool_)
    relative = information * np.outer(limit, limit) / factor[:, None, None]
    valid = np.isfinite(relative).all(axis=(1, 2))
    relative[~valid] = 0.0
    n = place.force.shape[2]
    return np.asarray(valid & (np.linalg.eigvalsh(relative)[:, 0] > _CLEAR * n))

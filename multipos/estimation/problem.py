"""The data of an estimation problem, a point of its search, its end, and what estimators return.

`state_problem` states a problem with its noise and `pose` one with a precision, which
`precision_of` returns; `start_state`, `put_on_circles` and `standing` are points of its search.
`over_circle`, `circle_basis`, `mean_latitudes`, `spread_inclinations` and `eliminate_free` are of
rolls of open angle, and `turn_to_axes` and `turn_about` turn a whole case.

The equations are those of `multipos.estimation.likelihood`. Arrays have one row per position, but
are laid out with positions running fastest in memory, since a position is two or three numbers and
there may be many of them.

**Rolls of open angle** are directions on a circle about a case axis. With a the axis, a direction
of latitude lambda = asin(u·a) stands over the point c of the circle, u = cos(lambda) c +
sin(lambda) a. Of the two angles t of `multipos.estimation.likelihood` the first then runs along the
circle and is free, the second leads towards a: it is tied to the inclination beta of the axis by
the sd of the position,

    u = E(c, (t_1, beta + t_2)),        t_1 free,    t_2 ~ N(0, s²),                         (1)

and held at zero where s is. beta is 0, or an unknown that the rolls of a group share, whose slopes
are those of t_2. With J = (J_1, J_2), both eliminated one after the other, c = J_2' Sigma^-1 J_1,

    W_1 = Sigma^-1 − Sigma^-1 J_1 J_1' Sigma^-1 / h_1,          h_1 = J_1' Sigma^-1 J_1,
    W = W_1 − W_1 J_2 J_2' W_1 / h_2,                           h_2 = J_2' W_1 J_2 + 1/s²,     (2)
    H^-1 = ((1/h_1 + c²/(h_1² h_2), −c/(h_1 h_2)), (−c/(h_1 h_2), 1/h_2)).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.finding import Findings
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.numerics.losses import Loss
from multipos.numerics.rotations import align, directions, tangent_basis
from multipos.positions.open_rolls import OpenRolls, across
from multipos.positions.orientations import StatedOrientations, listed_rows
from multipos.positions.readings import Readings
from multipos.results import frozen
from multipos.sensor.fit_diagnostics import NoiseTest
from multipos.sensor.found import FoundOrientations, Status, VarianceComponents
from multipos.sensor.model import Block, Model

_DETERMINED = 0.02  # of the mean square: rolls that spread less about a circle do not tell its axis
_WEAK = 1e-3  # weight of the case as it stands, beside what ties it
_FAINT = 1e-24  # of the largest, below which a turn moves nothing


def over_circle(direction: Array, axis: Array) -> tuple[Array, Array]:
    """Return the points of the circles (n, 3) below directions (n, 3), and latitudes (n,) [rad]."""
    height = np.einsum("ni,ni->n", direction, axis)
    foot = direction - height[:, None] * axis
    along = np.linalg.norm(foot, axis=1)[:, None] > 0.0
    foot = np.where(along, foot, across(axis))  # over the axis itself
    return directions(foot), np.arcsin(np.clip(height, -1.0, 1.0))


def circle_basis(direction: Array, axis: Array) -> Array:
    """Return the basis (n, 3, 2) along the circle through each direction, and towards its axis."""
    along = directions(np.cross(axis, direction))
    return np.stack([along, np.cross(direction, along)], axis=2)


def mean_latitudes(rolls: OpenRolls, latitude: Array) -> Array:
    """Return the inclination (C,) [rad] of each group's axis, from the latitudes (n,) of all."""
    return np.array([latitude[rolls.cone == g].mean() for g in range(rolls.cones)])


def spread_inclinations(rolls: OpenRolls, inclination: Array) -> Array:
    """Return the inclination (n,) [rad] of each position's axis, 0 where it is level."""
    return np.append(inclination, 0.0)[rolls.cone]


def eliminate_free(
    precision: Array, jacobian: Array, weighted: Array, prior: Array
) -> tuple[Array, Array, Array]:
    """Eliminate both angles by eq. (2), of which the first has no prior.

    Parameters
    ----------
    precision : (n, M, M) array
    jacobian, weighted : (n, M, 2) arrays
        J and Sigma^-1 J; the second column of J is zero where that angle is held.
    prior : (n,) array
        1/s² of the second angle, above 0 where it is held.

    Returns
    -------
    (gain, inverse, marginal)
        As in `multipos.estimation.likelihood.Eliminated`.
    """
    one, two = weighted[:, :, 0], weighted[:, :, 1]
    first = np.einsum("nm,nm->n", jacobian[:, :, 0], one)
    seen = first > _FAINT * np.einsum("nmi,nmi->n", jacobian, weighted)
    by_first = seen / np.where(seen, first, 1.0)
    both = np.einsum("nm,nm->n", jacobian[:, :, 1], one) * by_first
    left = two - both[:, None] * one
    by_second = 1.0 / (np.einsum("nm,nm->n", jacobian[:, :, 1], left) + prior)
    marginal = precision - by_first[:, None, None] * one[:, :, None] * one[:, None, :]
    marginal -= by_second[:, None, None] * left[:, :, None] * left[:, None, :]
    inverse = np.empty((len(first), 2, 2))
    inverse[:, 0, 0] = by_first + both**2 * by_second
    inverse[:, 0, 1] = inverse[:, 1, 0] = -both * by_second
    inverse[:, 1, 1] = by_second
    return weighted @ inverse, inverse, np.asarray(marginal)


def turn_to_axes(rolls: OpenRolls, direction: Array, listed: Mask, reference: Array) -> Array:
    """Return the rotation or reflection (3, 3) that brings rolls and listed directions home.

    The plane of the rolls about an axis says where that axis is, but for its sense; where nothing
    is listed, that of the axis as it stands is kept.

    Parameters
    ----------
    direction : (n, 3) array
        In a frame that is free to turn.
    listed : (n,) array of bool
        Rows whose direction is known to be along `reference` (n, 3).
    """
    sources, targets = _planes(rolls, direction)
    known = directions(reference[listed])
    adrift = not listed.any()
    mirrors = (1.0,) if adrift else (1.0, -1.0)
    senses = [(1.0,) * len(sources)] if adrift else list(product((1.0, -1.0), repeat=len(sources)))
    goal = np.concatenate([known, targets, _WEAK * np.eye(3)])
    best, least = np.eye(3), np.inf
    for mirror, sense in product(mirrors, senses):
        signed = np.array(sense)[:, None] * sources
        source = np.concatenate([mirror * direction[listed], signed, _WEAK * np.eye(3)])
        turn = align(source, goal)
        misfit = float(np.sum((source @ turn.T - goal) ** 2))
        if misfit < least:
            best, least = mirror * turn, misfit
    return best


def _planes(rolls: OpenRolls, direction: Array) -> tuple[Array, Array]:
    """Return the normals of the rolls about each axis that they determine (k, 3), and the axes."""
    normals, axes = [], []
    for name in rolls.axes:
        axis = np.eye(3)[COMPONENTS.index(name)]
        rows = rolls.rows & (rolls.vectors @ axis > 0.0)
        within = direction[rows]
        for cone in set(rolls.cone[rows].tolist()) - {-1}:
            mine = rolls.cone[rows] == cone
            within[mine] -= within[mine].mean(axis=0)
        sizes, vectors = np.linalg.eigh(within.T @ within / len(within))
        if sizes[1] > _DETERMINED:
            normal = vectors[:, 0]
            normals.append(normal * (np.sign(normal @ axis) or 1.0))
            axes.append(axis)
    return np.array(normals).reshape(-1, 3), np.array(axes).reshape(-1, 3)


def turn_about(axis: str, matrix: Array) -> Array:
    """Return the rotation (3, 3) about an axis that zeroes what a gauge has as zero.

    `matrix` (3, 3) holds the slopes of the outputs on x, y and z; of the two axes beside `axis`
    the output on the first then does not sense the second.
    """
    p, q = (i for i, name in enumerate(COMPONENTS) if name != axis)
    size = float(np.hypot(matrix[p, p], matrix[p, q]))
    turn = np.eye(3)
    if size > 0.0:
        c, s = matrix[p, p] / size, matrix[p, q] / size
        turn[p, p] = turn[q, q] = c
        turn[p, q], turn[q, p] = s, -s
    return turn


RELATIVE_NOISE = 1e-3  # of the readings' spread: any value serves where only ratios matter


def rows_of(units: Places, n: int) -> Places:
    """Return the rows of units of n positions each."""
    return np.asarray((units[:, None] * n + np.arange(n)).ravel())


@frozen
class Problem:
    """Readings and the orientations of their positions, eqs. (1)–(3) of `likelihood`.

    Attributes
    ----------
    model : Model
    values : (n, M) array
    environment : mapping of str to (n,) array
    precision : (n, M) or (n, M, M) array
        Inverse variances, or inverse covariances, of each reading.
    reference : (n, 3) array [g]
        Listed reference ±g u, of any direction where `orientation_sd` is infinite.
    orientation_sd : (n,) array [rad]
        s_k.
    group : (n,) array of int
        Number of the group, −1 for none.
    weight : (n,) array
        What the precision of each position has been multiplied by, 1 but for those set aside.
    groups : int
    attitude : (n, 3, 3) array or None
        Level to case, where a tilt of the table is estimated.
    level_sd : float [rad]
        s_level; 0 for a level table.
    robust : str or None
        Name of the loss; the thresholds of q count in `degrees` of freedom a position.
    held : tuple of int
        Parameters that the search leaves where they start.
    rolls : OpenRolls or None
        Positions whose angle about an axis is open; `orientation_sd` is across their circle.
    label : (n,) array of int or None
        Number of the label of each position, whose rows share an orientation error.
    units : int
        B, of which the rows are those of as many positions each, one after the other; they share
        no unknowns.
    """

    model: Model
    values: Array
    environment: Mapping[str, Array]
    precision: Array
    reference: Array
    orientation_sd: Array
    group: Places
    weight: Array
    groups: int = 0
    attitude: Array | None = None
    level_sd: float = 0.0
    robust: Loss | None = None
    held: tuple[int, ...] = ()
    rolls: OpenRolls | None = None
    label: Places | None = None
    units: int = 1

    def __post_init__(self) -> None:
        """Let positions run fastest in memory: every operation is on all of them at once."""
        for name in ("values", "precision", "reference"):
            object.__setattr__(self, name, np.asfortranarray(getattr(self, name)))

    def of(self, units: Places) -> "Problem":
        """Return the problem of some of the units."""
        if len(units) == self.units:
            return self
        rows = rows_of(units, len(self.values) // self.units)
        return replace(
            self,
            values=self.values[rows],
            environment={name: column[rows] for name, column in self.environment.items()},
            precision=self.precision[rows],
            reference=self.reference[rows],
            orientation_sd=self.orientation_sd[rows],
            group=self.group[rows],
            weight=self.weight[rows],
            units=len(units),
        )

    def under_noise_of(self, units: Places, other: "Problem") -> "Problem":
        """Return the problem with the noise and orientation sds of other units in place of some."""
        precision, sd = self.precision.copy(order="K"), self.orientation_sd.copy()
        rows = rows_of(units, len(self.values) // self.units)
        precision[rows], sd[rows] = other.precision, other.orientation_sd
        return replace(self, precision=precision, orientation_sd=sd)

    @cached_property
    def plain(self) -> "Problem":
        """The problem without a loss."""
        return self if self.robust is None else replace(self, robust=None)

    @cached_property
    def magnitude(self) -> Array:
        """Size of the reference (n,) [g]."""
        return np.asarray(np.linalg.norm(self.reference, axis=1))

    @cached_property
    def prior(self) -> Array:
        """1/s² (n,); exact positions get 0 here, their steps are held at zero instead."""
        with np.errstate(divide="ignore"):
            return np.where(self.orientation_sd > 0.0, 1.0 / self.orientation_sd**2, 0.0)

    @cached_property
    def exact(self) -> Mask:
        """Positions known exactly, (n,)."""
        return np.asarray((self.orientation_sd == 0.0) & ~self.rolled)

    @cached_property
    def rolled(self) -> Mask:
        """Positions that are rolls of open angle, (n,)."""
        return np.zeros(len(self.values), bool) if self.rolls is None else self.rolls.rows

    @cached_property
    def tied(self) -> Mask:
        """Positions that are about where they are listed, (n,)."""
        return np.isfinite(self.orientation_sd) & (self.orientation_sd > 0.0)

    @property
    def places(self) -> int:
        """Number of positions that differ by their labels."""
        return len(self.values) if self.label is None else int(self.label.max()) + 1

    @property
    def repeats(self) -> bool:
        """Whether rows share a label."""
        return self.places < len(self.values)

    @cached_property
    def unknown(self) -> Mask:
        """Positions of which nothing is known, (n,)."""
        return np.isinf(self.orientation_sd)

    @cached_property
    def degrees(self) -> Array:
        """Degrees of freedom that each position leaves, (n,): M, less the angles that are free."""
        return np.asarray(self.values.shape[1] - 2.0 * self.unknown - 1.0 * self.rolled)

    @property
    def listed(self) -> Mask:
        """Rows whose direction is listed in the world's axes."""
        return listed_rows(self.orientation_sd, self.group, self.rolls)

    @property
    def adrift(self) -> bool:
        """Whether nothing ties the readings to the directions of the world."""
        return not self.listed.any()

    @property
    def free_axis(self) -> str | None:
        """The case axis about which all may turn: that of every roll, where nothing is listed."""
        if self.rolls is None or not self.adrift or len(self.rolls.axes) > 1:
            return None
        return self.rolls.axes[0]

    @property
    def shared(self) -> int:
        """Number of unknowns that positions share, in addition to the parameters."""
        return 3 * self.groups + self.cones + (2 if self.level_sd > 0.0 else 0)

    @cached_property
    def cones(self) -> int:
        """Number of unknown inclinations that rolls share."""
        return 0 if self.rolls is None else self.rolls.cones

    @property
    def unknowns(self) -> int:
        """Number of parameters and shared unknowns; a tilt, tied to zero, costs none."""
        return len(self.model.keys) + 3 * self.groups + self.cones

    @cached_property
    def has_parameter_prior(self) -> bool:
        """Whether parameters have priors."""
        return bool(self.model.beliefs.any())

    @property
    def has_prior(self) -> bool:
        """Whether orientations are tied to where they should be by a standard deviation."""
        return bool(self.prior.any()) or self.level_sd > 0.0


@frozen
class State:
    """A point of the search: parameters, steps on the sphere and shared rotations."""

    theta: Array  # (p,), or (B, p) of units
    centre: Array  # (n, 3) unit, from which `step` starts
    basis: Array  # (n, 3, 2)
    step: Array  # (n, 2) [rad]
    turns: Array  # (G, 3, 3), Exp([rho_g]x)
    tilt: Array  # (2,) [rad]
    inclination: Array  # (C,) [rad], beta of the axes that rolls share


@frozen
class Point:
    """The model and objective at a state."""

    force: Array  # (n, 3) [g]
    blocks: tuple[Block, ...]  # dh/dtheta, by output
    residuals: Array  # (n, M)
    q: Array  # (n,)
    objective: Array | float  # (B,), of one unit a number


Standing = tuple[State, Point]


def some_units(here: Standing, units: Places) -> Standing:
    """Return some of several units."""
    rows = rows_of(units, len(here[0].step) // len(here[0].theta))
    return _joined(lambda a: a[units], lambda a: a[rows], here)


def with_units(here: Standing, units: Places, other: Standing) -> Standing:
    """Return several units with others in places of some."""
    rows = rows_of(units, len(here[0].step) // len(here[0].theta))

    def put(a: Array, b: Array, places: Places) -> Array:
        a = a.copy(order="K")
        a[places] = b
        return a

    return _joined(lambda a, b: put(a, b, units), lambda a, b: put(a, b, rows), here, other)


def _joined(
    of_units: Callable[..., Array], of_rows: Callable[..., Array], *each: Standing
) -> Standing:
    """Return what two functions make of arrays by unit and by row; one unit may have others."""
    states, points = zip(*each, strict=True)
    state = replace(
        states[-1],
        theta=of_units(*(one.theta for one in states)),
        centre=of_rows(*(one.centre for one in states)),
        basis=of_rows(*(one.basis for one in states)),
        step=of_rows(*(one.step for one in states)),
    )
    slopes = zip(*([slopes for _, slopes in one.blocks] for one in points), strict=True)
    blocks = zip((places for places, _ in points[0].blocks), slopes, strict=True)
    point = Point(
        force=of_rows(*(one.force for one in points)),
        blocks=tuple((places, of_rows(*both)) for places, both in blocks),
        residuals=of_rows(*(one.residuals for one in points)),
        q=of_rows(*(one.q for one in points)),
        objective=of_units(*(np.asarray(one.objective) for one in points)),
    )
    return state, point


@frozen
class Normal:
    """The reduced normal equations at a point, eqs. (5), (6) of `likelihood`."""

    information: Array  # S, (B, p + shared, p + shared), of one unit without its axis
    gradient: Array  # (B, p + shared)
    shared: Array  # (n, M, shared): dh/d(rho, tau)
    jacobian: Array  # J_k, (n, M, 2)
    weighted: Array  # Sigma^-1 J, (n, M, 2)
    inverse: Array  # H^-1, (n, 2, 2)
    ease: Array  # (n,), how much of its step a position takes
    angle_gradient: Array  # m_k, (n, 2)
    marginal: Array  # W_k, (n, M, M)


@frozen(eq=True)
class Optimum:
    """Where the search ended, of units with arrays (B,)."""

    state: State
    point: Point
    converged: Any
    iterations: Any
    last_step: Any
    gradient: Any

    def of(self, units: Places) -> "Optimum":
        """Return some of several units."""
        standing = some_units((self.state, self.point), units)
        ended = self.converged, self.iterations, self.last_step, self.gradient
        return Optimum(*standing, *(each[units] for each in ended))

    @property
    def status(self) -> Status:
        """How the search of one unit ended, for the result."""
        said = f"converged in {self.iterations} iterations"
        last_step, gradient = float(self.last_step), float(self.gradient)
        return Status(bool(self.converged), int(self.iterations), said, last_step, gradient)


DIRECT = Status(True, 0, "solved directly")


@frozen
class Solution:
    """What an estimator finds, before it is completed to a `Calibration`.

    Attributes
    ----------
    model : Model
        As fitted, with its gauge.
    reference : (n, 3) array [g]
        As used; estimated where it was uncertain.
    parameters, covariance, parameter_dof : (p,), (p, p), (p,) arrays
        Without the common-mode terms of the uncertainty.
    inflation : (p,) array
        Root of what multiplies the variance that the weights of the readings alone give.
    dof : (M,) array
        Degrees of freedom of each output's noise; inf where it is known beforehand.
    residuals, leverage : (n, M) arrays
    residual_sd : (M,) array
        Standard deviation of a reading as the residuals show it; NaN where none is left.
    findings : tuple of Finding
    outliers, unidentifiable : tuples of str
    condition : float
    status : Status
    orientation_sd : (n,) array [rad] or None
        Where it was estimated; inf for unknown.
    variance_components, orientations, robust_weight
        As in `Calibration`.
    claim : NoiseTest or None
        As in `Diagnostics`.
    """

    model: Model
    reference: Array
    parameters: Array
    covariance: Array
    parameter_dof: Array
    inflation: Array
    dof: Array
    residuals: Array
    residual_sd: Array
    leverage: Array
    outliers: tuple[str, ...]
    condition: float
    findings: Findings
    unidentifiable: tuple[str, ...] = ()
    status: Status = DIRECT
    orientation_sd: Array | None = None
    variance_components: VarianceComponents | None = None
    orientations: FoundOrientations | None = None
    robust_weight: Array | None = None
    claim: NoiseTest | None = None


def state_problem(
    model: Model, readings: Readings, stated_up: StatedOrientations, robust: Loss | None
) -> Problem:
    """Return the problem of the likelihood; without stated noise, with one of arbitrary size.

    Raises
    ------
    MultiposError
        An output never changes, or positions are correlated with each other.
    """
    values = readings.values
    n, m = values.shape
    still = np.ptp(values, axis=0) == 0.0
    if still.any() and n > 1:
        raise MultiposError(
            f"the readings of {readings.outputs[int(np.argmax(still))]} never change; turn the "
            "sensor between them, so that every axis points up, down and level."
        )
    noise = readings.noise
    if noise is None:
        size = np.sqrt(np.mean((values - values.mean(axis=0)) ** 2)) or 1.0  # of one position
        precision = np.full((n, m), 1.0 / (RELATIVE_NOISE * size) ** 2)
    else:
        precision = precision_of(noise, n, m)
    return pose(model, readings, stated_up, precision, robust)


def pose(
    model: Model,
    readings: Readings,
    stated_up: StatedOrientations,
    precision: Array,
    robust: Loss | None = None,
) -> Problem:
    """Return the problem of the likelihood with a precision (n, M) or (n, M, M)."""
    return Problem(
        model=model,
        values=readings.values,
        environment=readings.environment,
        precision=precision,
        reference=stated_up.reference,
        orientation_sd=stated_up.orientation_sd,
        group=stated_up.group,
        weight=np.ones(len(readings)),
        groups=stated_up.groups,
        attitude=stated_up.attitude,
        level_sd=stated_up.level_sd,
        robust=robust,
        rolls=stated_up.rolls,
        label=stated_up.label,
    )


def precision_of(noise: Array, n: int, m: int) -> Array:
    """Return the inverse of noise, as `Readings.noise` has it, (n, M) or (n, M, M).

    Raises
    ------
    MultiposError
        Positions are correlated with each other.
    """
    if noise.ndim == 1:
        return 1.0 / noise.reshape(n, m)
    blocks = noise.reshape(n, m, n, m)
    own = blocks[np.arange(n), :, np.arange(n), :]
    rest = noise.copy().reshape(n, m, n, m)
    rest[np.arange(n), :, np.arange(n), :] = 0.0
    if rest.any():
        raise MultiposError(
            "readings correlated between positions cannot be combined with uncertain or unknown "
            "orientations; give a covariance within each position only."
        )
    return np.asarray(np.linalg.inv(own))


def start_state(
    problem: Problem, theta: Array, direction: Array | None = None, turns: Array | None = None
) -> State:
    """Return a state: at the listed directions, or at others where nothing is known of them."""
    listed = directions(problem.reference)
    open_ = problem.unknown | problem.rolled
    centre = listed if direction is None else np.where(open_[:, None], direction, listed)
    centre = np.asfortranarray(centre)
    state = State(
        theta=theta,
        centre=centre,
        basis=tangent_basis(centre),
        step=np.zeros((len(centre), 2), order="F"),
        turns=np.array([np.eye(3)] * problem.groups).reshape(-1, 3, 3) if turns is None else turns,
        tilt=np.zeros(2),
        inclination=np.zeros(problem.cones),
    )
    return state if problem.rolls is None else _on_circles(problem, problem.rolls, state)


def _on_circles(problem: Problem, rolls: OpenRolls, state: State) -> State:
    """Return the state with rolls of open angle over their circles, axes as they lean there."""
    _, latitude = over_circle(state.centre, rolls.vectors)
    inclined = replace(state, inclination=mean_latitudes(rolls, latitude))
    return put_on_circles(problem, rolls, inclined, state.centre)


def put_on_circles(problem: Problem, rolls: OpenRolls, state: State, direction: Array) -> State:
    """Return the state whose rolls stand over their circles where directions (n, 3) are."""
    rows = rolls.rows
    axis = rolls.vectors[rows]
    foot, latitude = over_circle(direction[rows], axis)
    centre, basis, step = state.centre.copy(), state.basis.copy(), state.step.copy()
    centre[rows], basis[rows] = foot, circle_basis(foot, axis)
    off = latitude - spread_inclinations(rolls, state.inclination)[rows]
    tied = problem.orientation_sd[rows] > 0.0
    step[rows] = np.column_stack([np.zeros(len(off)), np.where(tied, off, 0.0)])
    return replace(state, centre=centre, basis=basis, step=step)


def standing(problem: Problem, state: State, direction: Array) -> State:
    """Return the state at which positions (n, 3) stand, with no step to make."""
    if problem.rolls is None:
        return state
    rows, axis = problem.rolls.rows, problem.rolls.vectors
    centre, basis, step = state.centre.copy(), state.basis.copy(), state.step.copy()
    centre[rows], step[rows] = direction[rows], 0.0
    basis[rows] = circle_basis(direction[rows], axis[rows])
    return replace(
        state, centre=centre, basis=basis, step=step, inclination=np.zeros(problem.cones)
    )

"""Where residuals become variances, degrees of freedom and U: variance components of B units.

`estimate` alternates the variance components of units with their solutions, `integrate` returns
the posterior of components and parameters at linearised fits, `excess_of` that of the excess of
stated noise alone; `with_unequal_outputs` is u where nothing but noise is asked, and
`own_axes_weights` and `by_own_axes` are noise and U where few positions cannot tell noise from
orientation errors. `half_interval` is U of a posterior, `half_of_mixture` of any mixture, and
`dof_of` its degrees of freedom. `Linear` of `Block` is a linearised fit, `StatedComponents` what is
stated of its noise, an `Axis` what is known of a component beforehand, `Posterior` and `Components`
what is found.

Near a solution the readings of a unit are linear in its unknowns θ. With e_k the residuals of
position k at its listed orientation, X_k their slopes by θ, S_k those by the two angles by which
the orientation may be wrong times their standard deviation, and R_k those by the rotation that
all rows of its label share,

    e_k = X_k dθ + error,      V_k = cov error = v (a Σ_k + b N_k D N_k' + F S_k S_k'),      (1)

Σ_k what is stated of the readings, D = diag(d_i) the noise of the outputs relative to each other
and N_k how it enters the combinations of the readings that are left where an angle is free. The
errors of a label add L R_k R_j' between any two of its rows. With W = V⁻¹, the restricted
likelihood of the components is [1]_

    −2 ln L = ln det V + ln det X'WX + e'We − e'WX (X'WX)⁻¹ X'We.                            (2)

Labels are eliminated as angles are: with H = I/L + Σ R_k'W_k R_k over the rows of a label,

    X'WX → X'WX − Σ (Σ X_k'W_k R_k) H⁻¹ (Σ R_k'W_k X_k),   ln det V → … + Σ ln det L H.      (3)

**Nothing stated** (a = 0, b = 1): the size v is integrated over in closed form, −½ ν ln q with
q = e'We − …, and a parameter is Student's t of ν degrees of freedom at given ratios. **Stated**
noise (a = 1, v = 1) is a lower bound, b = τ² its excess, and a parameter is normal. Ratios are
integrated over a grid of their logarithms, log-uniform with a probability of its own that there
is none, or about a stated value; a second grid lies where the first found something.

The noise of the outputs relative to each other is that of the restricted likelihood at the most
likely ratios, shrunk to equality: with q_i what output i leaves, ν_i what it should, and l_i
= ln d_i,

    (ν_i/2 + 1/s²) dl_i = (q_i − ν_i)/2 − l_i/s².                                            (4)

With c_ij the part of the variance of parameter j that is of output i, its degrees of freedom are
Satterthwaite's, with what determines the outputs' ratios beside the common size,

    1/ν_j = 1/ν + Σ_i (c_ij − mean)²/(ν_i + 2/s²),                                           (5)

n − p where orientations are exact and outputs have one model each. U is half the interval about
the estimate that holds 95 % of the mixture.

References
----------
.. [1] D. A. Harville, J. Amer. Statist. Assoc. 72, 1977. JCGM 100:2008, G.4.1.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import Any, Literal, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import coverage_factors, erf, normal_quantile

SHRUNK = 1.0  # s of eq. (4): ln of a variance
_APART = 6.0  # the same where orientations are exact, so that each output shows its own
CENTRE_SD = 1.1  # of ln of an orientation sd about what is stated
SEPARATING = 12  # positions from which on readings tell noise from orientation errors
_LOW, _HIGH = 0.3, 300.0  # ratios to the noise between which orientation errors are looked for
_FAR = 30.0  # the same, at which own axes alone count
_HIGHER = 3000.0  # the same to a stated noise
_NONE = 0.3  # probability that there are none
_AS_STATED = 0.5  # probability that the noise is as stated
_FEW = 3.0  # of the stated noise, which its excess is below where few positions show neither
_FINEST, _WIDEST = 1e-3, 10.0  # of residuals, between which a noise is that is not their unit
_NEARLY_NONE = 1e-6  # of what orientation errors do, as noise
_ROUNDS = 5  # of components and solutions
_CONVERGED = 0.05  # of ln of a component: an eighth of what a hundred contrasts know
NODES = {1: 14, 2: 10, 3: 7}  # of each axis, by how many there are
_NEGLIGIBLE = 1e-5  # probability at the ends of the next grid
_FINER = 4  # grids after the first, at most
_SHARP = 0.4  # probability of a node above which the grid is coarse: steps of a standard deviation
_STEPS, _SETTLED = 2, 8  # of eq. (4), and where nothing else is sought
_HALVINGS = 40
_FAINT = 1e-5  # probability of a node that no interval feels
_AT_ONCE = 40_000  # rows of all units and nodes
_MOST_DOF = 1e3  # beyond which Student's t is normal to a thousandth
_TINY = np.finfo(float).tiny


class Block(NamedTuple):
    """Positions of B units with r numbers each, eq. (1)."""

    error: Array  # e, (B, k, r)
    design: Array  # X, (B, k, r, P)
    spread: Array  # S, (B, k, r, 2)
    variance: Array  # Σ, (B, k, r), or (B, k, r, r)
    mix: Array | None = None  # N, (B, k, r, M); None: the identity
    turned: Array | None = None  # R, (B, k, r, 3)
    label: Places | None = None  # of the label of each position, (k,)

    def of(self, units: Any) -> "Block":
        """Return some of the units."""
        return Block(
            self.error[units],
            self.design[units],
            self.spread[units],
            self.variance[units],
            None if self.mix is None else self.mix[units],
            None if self.turned is None else self.turned[units],
            self.label,
        )

    def over(self, spread: Array) -> "Block":
        """Return the block with spreads, and rotations of labels, over so much."""
        turned = None if self.turned is None else self.turned / spread
        return self._replace(spread=self.spread / spread, turned=turned)


class Linear(NamedTuple):
    """Solutions of B units as linear models of their readings."""

    blocks: tuple[Block, ...]
    information: Array | float = 0.0  # of priors of θ, (P, P)
    gradient: Array | float = 0.0  # (P,)
    penalty: float = 0.0  # of the prior where the model is linear
    outer: Array | None = None  # (p, P) parameters as combinations of θ; None: they are θ

    def of(self, units: Any) -> "Linear":
        """Return some of the units."""
        return self._replace(blocks=tuple(block.of(units) for block in self.blocks))

    def scaled(self, spread: Array) -> "Linear":
        """Return the units with spreads, and rotations of labels, over so much (B,)."""
        by = np.where(spread > 0.0, spread, 1.0)[:, None, None, None]
        return self._replace(blocks=tuple(block.over(by) for block in self.blocks))

    def without_noise(self) -> "Linear":
        """Return the units with nothing stated of their noise."""
        none = (b._replace(variance=np.zeros_like(b.variance)) for b in self.blocks)
        return self._replace(blocks=tuple(none))

    @property
    def contrasts(self) -> int:
        """Readings less unknowns."""
        count = sum(block.error[0].size for block in self.blocks)
        return int(count - self.blocks[0].design.shape[3])


class Axis(NamedTuple):
    """A component beside the noise that is the unit of all, as a ratio of standard deviations.

    Its logarithm is uniform between the logarithms of `low` and `high` (B,), with the probability
    `none` that it is zero, or normal about that of `centre` with the standard deviation `sd`.
    """

    low: Array
    high: Array
    none: float = 0.0
    centre: Array | None = None
    sd: float = math.inf


class Posterior(NamedTuple):
    """Variance components of B units and their parameters.

    Attributes
    ----------
    weights : (B, G) array
        Probabilities of the nodes.
    ratios : (A, B, G) array
        Of each axis, as standard deviations; 0 where there is none.
    size : (B, G) array
        v of eq. (1).
    shifts, variances : (B, G, p) arrays
        Of the parameters, from where the model was linearised.
    outputs : (B, M) array
        d of eq. (4).
    unequal : (B, p) array
        The sum of eq. (5), of outputs that may be unequal.
    stated : bool
        Whether the noise is stated, so that the unit of all is known.
    grids : tuple of A (B, C) arrays
        Logarithms of the nodes of each axis.
    nu : float
        Contrasts.
    """

    weights: Array
    ratios: Array
    size: Array
    shifts: Array
    variances: Array
    outputs: Array
    unequal: Array
    stated: bool
    grids: tuple[Array, ...]
    nu: float

    def of(self, units: Places | Mask) -> "Posterior":
        """Return some of the units."""
        return Posterior(
            self.weights[units],
            self.ratios[:, units],
            self.size[units],
            self.shifts[units],
            self.variances[units],
            self.outputs[units],
            self.unequal[units],
            self.stated,
            tuple(grid[units] for grid in self.grids),
            self.nu,
        )

    def mean(self, values: Array) -> Array:
        """Return the posterior mean (B,) of values (B, G)."""
        return np.asarray(np.einsum("bg,bg->b", self.weights, values))


class _Terms(NamedTuple):
    log: Array  # ln of the restricted likelihood, (B, G)
    size: Array  # (B, G)
    shifts: Array  # (B, G, P)
    variances: Array  # (B, G, P)


class StatedComponents(NamedTuple):
    """What is stated of the noise of units, beside the variances of their blocks.

    Attributes
    ----------
    noise : bool
        The variances of the blocks are stated; else they are nothing.
    orientation : str
        'exact' (or unknown): no component of orientations; 'centre': the spreads of the blocks are
        the likely ones; 'free': their size is not known.
    few : bool
        Too few positions to tell noise from orientation errors.
    """

    noise: bool
    orientation: Literal["exact", "centre", "free"]
    few: bool = False


class Components(NamedTuple):
    """Variance components of B units, NaN where none were found.

    Attributes
    ----------
    U, dof : (B, p) arrays
        Of the parameters at 95 %.
    moves : (B, p) array
        From the solution to the posterior mean, where labels have errors of their own.
    noise : (B, M) array
        Variance beside what is stated.
    u : (B,) array
        Standard uncertainty of its root.
    factor, low, high : (B,) arrays
        On the variances of orientations, and the ends of its central 68 %.
    label : (B,) array
        The same for what the rows of a label share, 0 where it was not asked.
    valid : (B,) array of bool
        Whose searches have ended.
    """

    U: Array
    dof: Array
    moves: Array
    noise: Array
    u: Array
    factor: Array
    low: Array
    high: Array
    label: Array
    valid: Mask


class Units(Protocol):
    """B units whose searches have ended, and whose noise is estimated."""

    def of(self, units: Places, /) -> Self:
        """Return some of the units."""

    def put(self, units: Places, other: Self, /) -> None:
        """Put other units in places of these."""

    def linear(self) -> Linear:
        """Return the linear models about the solutions, with the stated noise and spreads."""

    def searched(self, noise: Array, factor: Array | None, /) -> tuple[Self, Mask]:
        """Return units under noise (B, M) beside what is stated and F (B,), and which ended."""


UnitsT = TypeVar("UnitsT", bound=Units)


def estimate(units: UnitsT, valid: Mask, given: StatedComponents) -> Components:
    """Alternate variance components and solutions of units, which follow.

    Parameters
    ----------
    units : Units
    valid : (B,) array of bool
        The units that are asked.
    given : StatedComponents
    """
    going, valid = np.flatnonzero(valid), valid.copy()
    before = np.full((2, len(valid)), np.inf)
    near: Posterior | None = None
    found: list[tuple[Places, list[Array]]] = []
    for turn in range(_ROUNDS):
        if not len(going):
            break
        here = units.of(going)
        linear = here.linear()
        axes, names, scale = _axes(linear, given)
        near = integrate(linear, axes, names, near)
        plain = _plain(near, names, scale)
        following, ended = here.searched(plain.noise, plain.factor)
        units.put(going, following)
        now = np.log([plain.noise.mean(axis=1) + scale.least, plain.logged])
        on = np.abs(now - before[:, going]).max(axis=0) > _CONVERGED
        on &= ended & (turn < _ROUNDS - 1)
        before[:, going] = now
        valid[going] &= ended
        if not on.all():
            done = np.flatnonzero(~on)
            parts = near.of(done), names, scale.of(done), plain.of(done)
            found.append((going[done], _components(*parts)))
        near, going = near.of(on), going[on]
    return _in_order(found, valid)


def _in_order(found: Sequence[tuple[Places, list[Array]]], valid: Mask) -> Components:
    """Return what was found of some units after others as components of all, NaN of the rest."""
    if not found:
        nothing = np.full((len(valid), 1), np.nan)
        each = nothing[:, 0]
        of_parameters = (nothing, nothing, nothing, nothing)
        return Components(*of_parameters, each, each, each, each, each, valid)
    whole = [np.full((len(valid), *each.shape[1:]), np.nan) for each in found[0][1]]
    for places, parts in found:
        for all_of, part in zip(whole, parts, strict=True):
            all_of[places] = part
    U, dof, moves, noise, u, factor, low, high, label = whole
    return Components(U, dof, moves, noise, u, factor, low, high, label, valid)


class Names(NamedTuple):
    """Which axis is what, None where there is none; whether the unit of all is known.

    `equal` says that the outputs have one noise, `shrunk` is s of eq. (4).
    """

    stated: bool
    excess: int | None = None
    orientation: int | None = None
    label: int | None = None
    equal: bool = False
    shrunk: float = SHRUNK


class _Scale(NamedTuple):
    """Sizes of units: of spreads, of stated noise, and a variance that is nothing."""

    spread: Array  # (B,), root mean square of what one sd of an angle does
    noise: Array  # (B,), typical sd of what is stated, or of residuals
    least: Array  # (B,)

    def of(self, units: Places) -> "_Scale":
        """Return some of the units."""
        return _Scale(*(each[units] for each in self))


def _axes(linear: Linear, given: StatedComponents) -> tuple[list[Axis], Names, _Scale]:
    """Return the axes that what is stated calls for."""
    error = np.sqrt(_mean_square(linear, "error"))
    spread = np.sqrt(_mean_square(linear, "spread") / 2.0)
    unit = not given.noise and given.orientation != "centre" and not np.ndim(linear.information)
    noise = np.sqrt(1.0 / _mean_inverse(linear)) if given.noise else error
    scale = _Scale(spread, noise, (1e-9 * noise) ** 2 + _TINY)
    axes: list[Axis] = []
    excess = orientation = label = None
    if not unit:
        excess = len(axes)
        if given.noise:
            high = _FEW * noise if given.few else np.maximum(_HIGH * noise, _WIDEST * error)
            axes.append(Axis(_LOW * noise, high, _AS_STATED))
        else:
            far = np.maximum(error, _NEARLY_NONE * spread / _FINEST)  # or V is as good as singular
            axes.append(Axis(_FINEST * far, _WIDEST * far))
    one = np.ones_like(noise) if unit else noise
    any_size = Axis(_LOW * one, (_HIGH if unit else _HIGHER) * one, _NONE)
    if given.orientation == "free":
        orientation = len(axes)
        axes.append(any_size)
    elif given.orientation == "centre":
        orientation = len(axes)
        axes.append(Axis(spread, spread, 0.0, spread, CENTRE_SD))
    if orientation is not None and any(block.label is not None for block in linear.blocks):
        label = len(axes)
        axes.append(any_size)
    return axes, Names(not unit, excess, orientation, label), scale


def _mean_square(linear: Linear, name: str) -> Array:
    """Return the mean square (B,) of errors, or of spreads a position and angle."""
    parts = [getattr(block, name) for block in linear.blocks]
    total = sum(
        np.einsum("bi,bi->b", each.reshape(len(each), -1), each.reshape(len(each), -1))
        for each in parts
    )
    if name == "error":
        count = max(linear.contrasts, 1)
    else:
        count = max(sum(int(each[0].any(axis=(1, 2)).sum()) for each in parts), 1)
    return np.asarray(total / count)


def _mean_inverse(linear: Linear) -> Array:
    """Return the mean (B,) of one over the stated variances."""
    parts = []
    for block in linear.blocks:
        variance = block.variance
        if variance.ndim == 4:
            variance = np.einsum("bkrr->bkr", variance)
        parts.append((1.0 / variance).reshape(len(variance), -1))
    return np.asarray(np.concatenate(parts, axis=1).mean(axis=1))


class _Plain(NamedTuple):
    """The components under which solutions are searched for."""

    noise: Array  # (B, M)
    factor: Array | None  # (B,)
    label: Array  # its part of labels, (B,)

    def of(self, units: Places) -> "_Plain":
        """Return some of the units."""
        factor = None if self.factor is None else self.factor[units]
        return _Plain(self.noise[units], factor, self.label[units])

    @property
    def logged(self) -> Array:
        """The factor, whose logarithm is compared."""
        return np.ones(len(self.noise)) if self.factor is None else self.factor


def _plain(posterior: Posterior, names: Names, scale: _Scale) -> _Plain:
    """Return means of the components."""
    if names.excess is None:
        v = np.exp(posterior.mean(np.log(posterior.size)))
    else:
        v = posterior.mean(posterior.ratios[names.excess] ** 2)
    noise, label = v[:, None] * posterior.outputs, np.zeros_like(v)
    if names.orientation is None:
        return _Plain(noise, None, label)
    ratio = posterior.ratios[names.orientation]
    unit = scale.noise if names.stated else np.ones_like(v)
    none = np.broadcast_to(_LOW / 3.0 * unit[:, None], ratio.shape)
    typical = np.exp(posterior.mean(np.log(np.where(ratio > 0.0, ratio, none))))
    factor = typical**2 * (1.0 if names.stated else v) / scale.spread**2
    if names.label is not None:
        ratio = posterior.ratios[names.label] ** 2 * posterior.size
        label = posterior.mean(ratio) / scale.spread**2
    return _Plain(noise, factor + label, label)


def _components(posterior: Posterior, names: Names, scale: _Scale, plain: _Plain) -> list[Array]:
    """Return the fields of `Components` of the units of a posterior, but for the last."""
    excess = names.excess
    sd = np.sqrt(posterior.size) if excess is None else posterior.ratios[excess]
    spread = posterior.mean((sd - posterior.mean(sd)[:, None]) ** 2)
    if excess is None:  # and the size at one node, of ν contrasts
        spread = spread + posterior.mean(posterior.size) / (2.0 * posterior.nu)
    u = np.sqrt(spread)
    moves = np.zeros_like(posterior.shifts[:, 0])
    if names.label is not None:
        moves = np.einsum("bg,bgp->bp", posterior.weights, posterior.shifts)
        posterior = posterior._replace(shifts=posterior.shifts - moves[:, None])
    U, dof = half_interval(posterior)
    factor = np.ones_like(u) if plain.factor is None else plain.factor
    low, high = factor, factor
    if names.orientation is not None:
        sds = posterior.ratios[names.orientation] * np.sqrt(posterior.size)
        low, high = _central(sds / scale.spread[:, None], posterior.weights) ** 2
        if excess is None:  # and the size at one node
            low, high = _widened(low, high, 2.0 / posterior.nu)
        low, high = np.minimum(low, factor), np.maximum(high, factor)
    return [U, dof, moves, plain.noise, u, factor, low, high, plain.label]


def _widened(low: Array, high: Array, more: float) -> tuple[Array, Array]:
    """Return an interval of 68 % wider by a variance `more` of its logarithm."""
    some = low > 0.0
    half = 0.5 * np.log(np.where(some, high / np.where(some, low, 1.0), 1.0))
    middle, wider = np.sqrt(low * high), np.exp(np.sqrt(half**2 + more))
    return np.where(some, middle / wider, low), np.where(some, middle * wider, high)


def _central(values: Array, weights: Array) -> Array:
    """Return the ends (2, B) of the central 68 % of values (B, G)."""
    ends = np.empty((2, len(values)))
    for unit in range(len(values)):  # nodes of one value are one
        own, place = np.unique(values[unit], return_inverse=True)
        weight = np.bincount(place.ravel(), weights[unit])
        ends[:, unit] = np.interp([0.16, 0.84], np.cumsum(weight) - 0.5 * weight, own)
    return ends


def excess_of(linear: Linear, *, equal: bool) -> Posterior:
    """Return the excess of units of exact orientations beyond the variances of their blocks."""
    noise = np.sqrt(1.0 / _mean_inverse(linear))
    high = np.maximum(_HIGH * noise, _WIDEST * np.sqrt(_mean_square(linear, "error")))
    axis = Axis(_LOW * noise, high, _AS_STATED)
    return integrate(linear, [axis], Names(stated=True, excess=0, equal=equal, shrunk=_APART))


def with_unequal_outputs(linear: Linear) -> tuple[Array, Array]:
    """Return u and degrees of freedom (B, p) of least squares where outputs may be unequal.

    Rows count alike, as where positions are unknown, and their noise is that of eq. (4).
    """
    count = len(linear.blocks[0].error)
    model = _Model(linear, Names(stated=False), None)
    nodes, best = np.zeros((0, count, 1)), np.zeros(count, dtype=np.intp)
    model.balance(nodes, best)
    size = model.evaluate(nodes).size[:, 0]
    model.balanced = False
    _, should, parts, _ = model.at(nodes, best)
    variance = parts.sum(axis=1)
    u = np.sqrt(size[:, None] * variance)
    unequal = model.unequal_of(parts / variance[:, None], should)
    return u, 1.0 / (1.0 / model.nu + unequal)


def own_axes_weights(linear: Linear) -> tuple[float, float]:
    """Return the noise of one unit, as least squares leaves it, and F far above it."""
    noise = float(_mean_square(linear, "error")[0])
    spread = float(_mean_square(linear, "spread")[0]) / 2.0
    return noise, _FAR**2 * noise / max(spread, _TINY)


def by_own_axes(linear: Linear, crossed: Mask) -> tuple[Array, float]:
    """Return U (p,) of one unit by own-axis readings, and its degrees of freedom.

    Six contrasts of six faces are as well noise as orientation errors. An estimate that takes
    orientation errors for far larger is right either way for biases and own scales, and its U is
    that of the noise that least squares of exact orientations leaves. The terms that are `crossed`
    (p,) have as many contrasts against them as for them, and √1.5 of it.
    """
    scale = np.sqrt(_mean_square(linear, "spread") / 2.0)
    names = Names(stated=False, orientation=0)
    model = _Model(linear, names, None)
    exact = model.evaluate(np.zeros((1, 1, 1)))
    _, _, parts, _ = model.at(np.full((1, 1, 1), _FAR / scale[0]), np.zeros(1, dtype=int))
    dof = model.nu
    u = np.sqrt(parts[0].sum(axis=0) * exact.size[0, 0]) * np.where(crossed, math.sqrt(1.5), 1.0)
    return coverage_factors(0.95, np.array([dof]))[0] * u, dof


def integrate(
    linear: Linear, axes: Sequence[Axis], names: Names, near: Posterior | None = None
) -> Posterior:
    """Integrate over the variance components of B units.

    Parameters
    ----------
    linear : Linear
    axes : sequence of Axis
    names : Names
        What each axis is, and whether the unit of all is known: the variances of the blocks.
    near : Posterior, optional
        What was found where the units were linearised before, which is where to look.
    """
    spread = np.sqrt(_mean_square(linear, "spread") / 2.0)
    model = _Model(linear.scaled(spread), names, None if near is None else near.outputs)
    if near is None:
        grids = [_first(axis, NODES[len(axes)]) for axis in axes]
        nodes, prior = _nodes(axes, grids)
        weights = _weights(model.evaluate(nodes).log + prior)
        model.balance(nodes, weights.argmax(axis=1))
        weights = _weights(model.evaluate(nodes).log + prior)
    else:
        grids, weights = list(near.grids), near.weights
    best, coarse = np.zeros(model.count, dtype=np.intp), np.ones(model.count, dtype=np.bool_)
    for _ in range(_FINER):  # each unit by itself
        finer = [_second(grid, _marginal(weights, grids, i)) for i, grid in enumerate(grids)]
        both = zip(finer, grids, strict=True)
        grids = [np.where(coarse[:, None], new, old) for new, old in both]
        nodes, prior = _nodes(axes, grids)
        weights = _weights(model.evaluate(nodes).log + prior)
        best = np.where(coarse, weights.argmax(axis=1), best)
        before = model.outputs
        model.balance(nodes, best)
        model.outputs = np.where(coarse[:, None], model.outputs, before)
        coarse &= ~_are_fine(weights, grids)
        if not coarse.any():
            break
    terms = model.evaluate(nodes)
    weights = _weights(terms.log + prior)
    found = (weights, nodes, terms.size, terms.shifts, terms.variances)
    unequal = model.unequal(nodes, best)
    return Posterior(*found, model.outputs, unequal, names.stated, tuple(grids), model.nu)


def _weights(log: Array) -> Array:
    """Return probabilities (B, G) of their logarithms."""
    weights = np.exp(log - log.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _first(axis: Axis, count: int) -> Array:
    """Return logarithms (B, C) of the first nodes of an axis, −inf for none."""
    if axis.centre is not None:
        steps = np.linspace(-3.0, 3.0, count)
        return np.log(axis.centre)[:, None] + axis.sd * steps
    part = np.linspace(0.0, 1.0, count - (axis.none > 0.0))
    low, high = np.log(axis.low)[:, None], np.log(axis.high)[:, None]
    grid = low + (high - low) * part
    if axis.none > 0.0:
        grid = np.concatenate([np.full((len(grid), 1), -np.inf), grid], axis=1)
    return np.asarray(grid)


def _marginal(weights: Array, grids: Sequence[Array], axis: int) -> Array:
    """Return the probability (B, C) of each node of an axis."""
    shape = [each.shape[1] for each in grids]
    whole = weights.reshape(len(weights), *shape)
    others = tuple(i + 1 for i in range(len(shape)) if i != axis)
    return np.asarray(whole.sum(axis=others))


def _are_fine(weights: Array, grids: Sequence[Array]) -> Mask:
    """Tell of which units (B,) no node but that of none has most of the probability."""
    fine = np.ones(len(weights), dtype=np.bool_)
    for i, grid in enumerate(grids):
        first = int(np.isneginf(grid[:, 0]).all())
        fine &= ~(_marginal(weights, grids, i)[:, first:] > _SHARP).any(axis=1)
    return fine


def _second(grid: Array, probability: Array) -> Array:
    """Return as many nodes where the first found something."""
    none = np.isneginf(grid[:, :1])
    first = int(none.all())
    inner = grid[:, first:]
    seen = probability[:, first:] > _NEGLIGIBLE
    seen[~seen.any(axis=1), 0] = True
    last = inner.shape[1] - 1
    low = np.maximum(seen.argmax(axis=1) - 1, 0)
    high = np.minimum(last - seen[:, ::-1].argmax(axis=1) + 1, last)
    units = np.arange(len(grid))
    part = np.linspace(0.0, 1.0, last + 1)
    start, end = inner[units, low][:, None], inner[units, high][:, None]
    return np.concatenate([grid[:, :first], start + (end - start) * part], axis=1)


def _nodes(axes: Sequence[Axis], grids: Sequence[Array]) -> tuple[Array, Array]:
    """Return the ratios (A, B, G) at all nodes, and ln of their prior probability (B, G)."""
    values, priors = [], []
    for axis, grid in zip(axes, grids, strict=True):
        first = int(axis.none > 0.0)
        inner = grid[:, first:]
        step = np.log(np.maximum(inner[:, 1:2] - inner[:, :1], _TINY))
        if axis.centre is None:
            span = np.log(np.log(axis.high / axis.low))[:, None]
            each = np.broadcast_to(step - span + math.log1p(-axis.none), inner.shape)
        else:
            away = (inner - np.log(axis.centre)[:, None]) / axis.sd
            each = step - 0.5 * away**2 - math.log(axis.sd * math.sqrt(2.0 * math.pi))
        if first:
            each = np.concatenate([np.full((len(grid), 1), math.log(axis.none)), each], axis=1)
        values.append(np.exp(grid))
        priors.append(each)
    places = np.array(list(product(*(range(each.shape[1]) for each in values)))).T
    nodes = np.stack([value[:, place] for value, place in zip(values, places, strict=True)])
    prior = sum(each[:, place] for each, place in zip(priors, places, strict=True))
    return nodes, np.asarray(prior)


class _Model:
    """Linear models whose restricted likelihood is asked for."""

    def __init__(self, linear: Linear, names: Names, outputs: Array | None) -> None:
        self.linear, self.stated = linear, names.stated
        self.excess, self.orientation, self.label, self.equal, self.shrunk = names[1:]
        block = linear.blocks[0]
        self.count = len(block.error)
        self.M = (block.error if block.mix is None else block.mix).shape[-1]
        self.outputs = np.ones((self.count, self.M)) if outputs is None else outputs
        self.nu = float(linear.contrasts)
        self.balanced = True  # rows are weighed by d

    def _squares(self, nodes: Array, axis: int | None) -> Array:
        shape = nodes.shape[1:]
        return np.zeros(shape) if axis is None else nodes[axis] ** 2

    def covariance(self, block: Block, nodes: Array, units: slice) -> Array:
        """Return V_k (B, G, k, r, r) but for v and labels."""
        _, k, r = block.error.shape
        shape = (*nodes.shape[1:], k, r, r)
        V = np.array(np.broadcast_to(self.noise(block, nodes, self.outputs[units]), shape))
        if self.orientation is not None:
            F = self._squares(nodes, self.orientation)[:, :, None, None, None]
            V += F * (block.spread @ np.swapaxes(block.spread, 2, 3))[:, None]
        if self.stated and block.variance.ndim == 4:
            V += block.variance[:, None]
        elif self.stated:
            V[..., range(r), range(r)] += block.variance[:, None]
        return V

    def noise(self, block: Block, nodes: Array, d: Array) -> Array:
        """Return b N D N' (B, G or 1, k or 1, r, r) of eq. (1)."""
        if block.mix is None:
            D = d[:, None, :, None] * np.eye(d.shape[1])
        else:
            D = (block.mix * d[:, None, None, :]) @ np.swapaxes(block.mix, 2, 3)
        if not self.stated:
            return np.asarray(D[:, None])
        return self._squares(nodes, self.excess)[:, :, None, None, None] * D[:, None]

    def evaluate(self, nodes: Array) -> _Terms:
        """Return the terms of eq. (2) at nodes (A, B, G)."""
        rows = sum(block.error.shape[1] for block in self.linear.blocks)
        step = max(1, _AT_ONCE // (rows * nodes.shape[2]))
        parts = []
        for first in range(0, self.count, step):
            units = slice(first, first + step)
            parts.append(self._evaluate(self.linear.of(units), nodes[:, units], units))
        return _Terms(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _evaluate(self, linear: Linear, nodes: Array, units: slice) -> _Terms:
        return self._solved(linear, *self._sums(linear, nodes, units))

    def _solved(self, linear: Linear, sums: Array, logdet: Array) -> _Terms:
        """Return the terms of eq. (2) of its sums."""
        P = sums.shape[-1] - 1
        A, b, q = sums[..., :P, :P], sums[..., :P, P], sums[..., P, P]
        scale = 1.0 / np.sqrt(np.einsum("bgpp->bgp", A))
        inverse = np.linalg.inv(A * scale[..., None] * scale[..., None, :])
        inverse *= scale[..., None] * scale[..., None, :]
        shift = np.einsum("bgpq,bgq->bgp", inverse, b)
        left = np.maximum(q - np.einsum("bgp,bgp->bg", shift, b), _TINY + 1e-12 * np.abs(q))
        logdet = logdet + np.linalg.slogdet(A * scale[..., None] * scale[..., None, :])[1]
        logdet -= 2.0 * np.log(scale).sum(axis=2)
        if self.stated:
            size, log = np.ones_like(left), -0.5 * (logdet + left)
        else:
            size, log = left / max(self.nu, 1.0), -0.5 * (logdet + self.nu * np.log(left))
        if linear.outer is None:
            variances = np.einsum("bgpp->bgp", inverse)
        else:
            variances = np.einsum("ip,bgpq,iq->bgi", linear.outer, inverse, linear.outer)
            shift = shift @ linear.outer.T
        return _Terms(log, size, shift, size[..., None] * variances)

    def _sums(self, linear: Linear, nodes: Array, units: slice) -> tuple[Array, Array]:
        """Return (X, e)'W(X, e) with priors (B, G, P + 1, P + 1), and ln det V (B, G)."""
        P = linear.blocks[0].design.shape[3]
        count, G = nodes.shape[1:]
        sums, logdet = np.zeros((count, G, P + 1, P + 1)), np.zeros((count, G))
        if np.ndim(linear.information):
            sums[..., :P, :P], sums[..., :P, P] = linear.information, linear.gradient
            sums[..., P, :P], sums[..., P, P] = linear.gradient, linear.penalty
        L = self._squares(nodes, self.label)
        for block in linear.blocks:
            V = self.covariance(block, nodes, units)
            _, k, r, _ = block.design.shape
            W = _inverse(V)
            logdet = logdet + _log_determinant(V).sum(axis=2)
            Xe = np.concatenate([block.design, block.error[..., None]], axis=3)
            WX = W @ Xe[:, None]
            flat = np.swapaxes(Xe.reshape(count, k * r, P + 1), 1, 2)
            sums += flat[:, None] @ WX.reshape(count, G, k * r, P + 1)
            if self.label is None or block.turned is None or block.label is None:
                continue
            one = (block.label == np.unique(block.label)[:, None]).astype(float)
            turned = np.swapaxes(block.turned, 2, 3)[:, None]
            C = turned @ WX
            H = turned @ (W @ block.turned[:, None])
            C = (one @ C.reshape(count, G, k, -1)).reshape(count, G, len(one), 3, P + 1)
            H = (one @ H.reshape(count, G, k, -1)).reshape(count, G, len(one), 3, 3)
            H = L[:, :, None, None, None] * H + np.eye(3)
            moved = L[:, :, None, None, None] * np.linalg.solve(H, C)
            sums -= np.einsum("bglcp,bglcq->bgpq", C, moved)
            logdet = logdet + np.linalg.slogdet(H)[1].sum(axis=2)
        return sums, logdet

    def at(self, nodes: Array, best: Places) -> tuple[Array, Array, Array, Array]:
        """Return what outputs leave and should leave (B, M) at each unit's best node, and parts.

        The parts (B, M, P) are those of the variances of the unknowns that are of each output.
        """
        here = nodes[:, np.arange(self.count), best][:, :, None]
        whole = slice(0, self.count)
        sums, logdet = self._sums(self.linear, here, whole)
        P = sums.shape[-1] - 1
        inverse = np.linalg.inv(sums[:, 0, :P, :P])
        if not self.balanced:
            inverse = np.linalg.inv(
                sum(np.einsum("bkrp,bkrq->bpq", b.design, b.design) for b in self.linear.blocks)
            )
        shift = np.einsum("bpq,bq->bp", inverse, sums[:, 0, :P, P])
        size = self._solved(self.linear, sums, logdet).size[:, 0]
        left, should = np.zeros((2, self.count, self.M))
        parts = np.zeros((self.count, self.M, P))
        for block in self.linear.blocks:
            V = self.covariance(block, here, whole)[:, 0]
            W = _inverse(V)
            Xe = np.concatenate([block.design, block.error[..., None]], axis=3)
            WX = (W if self.balanced else np.eye(len(V[0, 0]))) @ Xe
            if self.label is not None and block.turned is not None:
                WX, W = _without_labels(block, W, WX, here[self.label, :, 0] ** 2)
            z = WX[..., P] - np.einsum("bkrp,bp->bkr", WX[..., :P], shift)
            gain = WX[..., :P] @ inverse[:, None]
            for i in range(self.M):
                d = np.where(np.arange(self.M) == i, self.outputs, 0.0)
                D = np.broadcast_to(self.noise(block, here, d)[:, 0], V.shape)
                left[:, i] += np.einsum("bkr,bkrs,bks->b", z, D, z) / size
                should[:, i] += np.einsum("bkrs,bksr->b", W, D)
                DG = D @ gain
                parts[:, i] += np.einsum("bkrp,bkrp->bp", gain, DG)
                should[:, i] -= np.einsum("bkrp,bkrp->b", DG, WX[..., :P])
        return left, should, parts, np.asarray(inverse)

    def balance(self, nodes: Array, best: Places) -> None:
        """Move d by eq. (4)."""
        if self.M == 1 or self.equal or (self.stated and self.excess is None):
            return
        for _ in range(_SETTLED if self.orientation is None else _STEPS):
            left, should, _, _ = self.at(nodes, best)
            at = np.log(self.outputs)
            step = 0.5 * (left - should) - at / self.shrunk**2
            step /= 0.5 * np.maximum(should, 0.0) + 1.0 / self.shrunk**2
            at = at + np.clip(step, -1.0, 1.0)
            self.outputs = np.exp(at - at.mean(axis=1, keepdims=True))

    def unequal(self, nodes: Array, best: Places) -> Array:
        """Return the sum of eq. (5) (B, p), nothing where outputs have one noise."""
        p = self.linear.blocks[0].design.shape[3]
        outer = self.linear.outer
        if self.equal or self.M == 1 or outer is not None:
            return np.zeros((self.count, p if outer is None else len(outer)))
        _, should, parts, inverse = self.at(nodes, best)
        return self.unequal_of(parts / np.einsum("bpp->bp", inverse)[:, None], should)

    def unequal_of(self, share: Array, should: Array) -> Array:
        """Return the sum of eq. (5) of parts (B, M, p) and of ν (B, M)."""
        away = share - share.mean(axis=1, keepdims=True)
        known = np.maximum(should, 0.0) + 2.0 / self.shrunk**2
        return np.asarray(np.sum(away**2 / known[:, :, None], axis=1))


def _without_labels(block: Block, W: Array, WX: Array, L: Array) -> tuple[Array, Array]:
    """Return W X (B, k, r, P) and the blocks W_kk (B, k, r, r) of W with labels eliminated."""
    assert block.turned is not None
    assert block.label is not None
    R = block.turned
    WR = W @ R
    names = np.unique(block.label)
    one = (block.label == names[:, None]).astype(float)
    H = np.einsum("lk,bkri,bkrj->blij", one, R, WR)
    K = np.linalg.inv(H + np.eye(3) / np.maximum(L, _TINY)[:, None, None, None])
    C = np.einsum("lk,bkri,bkrp->blip", one, R, WX)
    of_row = np.searchsorted(names, block.label)
    WX = WX - WR @ (K @ C)[:, of_row]
    return WX, W - WR @ K[:, of_row] @ np.swapaxes(WR, 2, 3)


def _inverse(V: Array) -> Array:
    """Return inverses of (…, r, r)."""
    return np.asarray(1.0 / V if V.shape[-1] == 1 else np.linalg.inv(V))


def _log_determinant(V: Array) -> Array:
    """Return ln of determinants of (…, r, r)."""
    return np.asarray(np.log(V[..., 0, 0]) if V.shape[-1] == 1 else np.linalg.slogdet(V)[1])


def half_interval(posterior: Posterior, moves: Array | None = None) -> tuple[Array, Array]:
    """Return U (B, p) that holds 95 % of the mixture, and its degrees of freedom.

    About the solution, or about estimates that moved from it by `moves` (B, p).
    """
    weights, variances, shifts = posterior.weights, posterior.variances, posterior.shifts
    if moves is not None:
        shifts = shifts - moves[:, None]
    if not posterior.stated:
        dof = 1.0 / (1.0 / posterior.nu + posterior.unequal)
        return half_of_mixture(weights, variances, dof, shifts), dof
    U = half_of_mixture(weights, variances, None, shifts)
    alike = dof_of(weights, variances)
    dof = 1.0 / np.maximum(1.0 / alike + posterior.unequal, 0.5 / _MOST_DOF)
    dof = np.where(dof > _MOST_DOF, np.inf, dof)
    return U * coverage_factors(0.95, dof) / coverage_factors(0.95, alike), dof


def half_of_mixture(
    weights: Array, variances: Array, dof: Array | None = None, shifts: Array | None = None
) -> Array:
    """Return half the intervals (B, p) that hold 95 % of mixtures, (B, G, p) their variances.

    Of normal laws, or of Student's t of `dof` (B, p) by the normal of D. L. Wallace, Ann. Math.
    Statist. 30, 1959, exact to .6 % from three degrees of freedom on and corrected by what it is
    off for one t. `shifts` (B, G, p) are their means.
    """
    felt = np.where(weights > _FAINT * weights.sum(axis=1, keepdims=True), weights, 0.0)
    felt *= (weights.sum(axis=1) / felt.sum(axis=1))[:, None]  # of each unit for itself
    kept = felt.any(axis=0)
    weights, sd = felt[:, kept], np.sqrt(variances[:, kept])
    moved = np.zeros_like(sd) if shifts is None else shifts[:, kept]
    low = np.zeros((len(sd), sd.shape[2]))
    high = (np.abs(moved) + 40.0 * sd).max(axis=1)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        inside = _normal((middle[:, None] - moved) / sd, dof)
        inside += _normal((middle[:, None] + moved) / sd, dof)
        held = np.einsum("bg,bgp->bp", weights, inside) - weights.sum(axis=1)[:, None]
        low, high = np.where(held < 0.95, middle, low), np.where(held < 0.95, high, middle)
    if dof is None:
        return np.asarray(high)
    return np.asarray(high * coverage_factors(0.95, dof) / _of_normal(normal_quantile(0.975), dof))


def _normal(t: Array, dof: Array | None) -> Array:
    """Return the probability that a normal variate, or Student's t, is below t (B, G, p)."""
    if dof is not None:
        nu = dof[:, None]
        z = np.sqrt(nu * np.log1p(t**2 / nu)) * (8.0 * nu + 1.0) / (8.0 * nu + 3.0)
        t = np.copysign(z, t)
    return 0.5 * (1.0 + erf(t / math.sqrt(2.0)))


def _of_normal(z: float, dof: Array) -> Array:
    """Return the t that Wallace's approximation takes for a normal quantile."""
    return np.asarray(
        np.sqrt(dof * np.expm1((z * (8.0 * dof + 3.0) / (8.0 * dof + 1.0)) ** 2 / dof))
    )


def dof_of(weights: Array, variances: Array) -> Array:
    """Return the degrees of freedom (B, p) of variances (B, G, p) known by weights.

    Those of the χ² whose ratio of mean and variance is that of the precisions.
    """
    precision = 1.0 / variances
    mean = np.einsum("bg,bgp->bp", weights, precision)
    spread = np.einsum("bg,bgp->bp", weights, (precision - mean[:, None]) ** 2)
    with np.errstate(divide="ignore", over="ignore"):
        dof = 2.0 * mean**2 / spread
    return np.asarray(np.where(dof > _MOST_DOF, np.inf, np.maximum(dof, 1.0)))

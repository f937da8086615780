"""Robust fits at known orientations, of one unit or of many.

`solve_robust_known` fits one unit and `estimate_robust` many, by `fit_outputs`, of which
`search_linear` is the search.

Each output goes the way of `multipos.estimation.robustness`: from the plain fit a search under
Huber's loss, with a noise of any size where none is stated; then one with the noise for which the
median of q is that of the normal law, repeated until that converges; rows beyond all chance are set
aside, the worst first; and a last search under the loss that was asked for.

From the plain fit b₀ with exact residuals r₀ (`multipos.estimation.known`) the residuals at b₀ + d
are r = r₀ − X d, whose rounding is relative to them, and d takes the steps

    (S + λ diag S) Δ = X'W r,    S = X'W X,    W = diag ρ'(q_k)/σ_k²,    q_k = r_k²/σ_k²,  (1)

until the next one would take less than 10⁻¹⁴ off F = Σ ρ(q_k). As ρ bends down, no such step leads
up but by rounding, where a search has come to its end. A unit that has ended is left out of the
steps that follow, so that it takes the same ones alone and among others. A row that is set aside
has 10⁻¹² of its weight.

Outputs that are correlated or share a noise (`pool`) are one search of
`multipos.estimation.uncertain`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from multipos.errors import RankError
from multipos.estimation import known, robustness, stated_uncertainty
from multipos.estimation.batches import Estimates, join_estimates, rms_of
from multipos.estimation.identifiability import condition, formal_only
from multipos.estimation.problem import RELATIVE_NOISE, Solution
from multipos.files.records import LARGEST
from multipos.finding import Findings, about
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.numerics.losses import EFFICIENCY, Loss, counted, loss, loss_slope, loss_weight
from multipos.numerics.quantiles import chi2_quantile, f_quantile, f_tail
from multipos.positions.readings import Readings
from multipos.results import frozen
from multipos.sensor.fit_diagnostics import NoiseTest
from multipos.sensor.found import Status
from multipos.sensor.model import Model
from multipos.sensor.studentised import OUTLIER_LEVEL, find_outlying_positions

_ITERATIONS = 2000  # weights that change with the step make convergence linear
_DAMPING = 1e-4
_DECREMENT = 1e-14  # of F, by the next step
_XTOL = 1e-13  # relative step that is only rounding
_ROUNDING = 1e-8  # of F: what rounding can do
_LAST_STEPS = 2  # where it does, towards where the slope of F vanishes
_AT_ONCE = 12_000  # readings of an output, so that what a step needs stays in the cache
_HUBER: Loss = "huber"  # under which the noise is found, whatever the loss


@frozen
class Linear:
    """One output of B units at known positions.

    Attributes
    ----------
    design : (n, p) array
    plain : (B, p) array
        Parameters of the plain fit.
    residuals : (B, n) array
        Of the plain fit.
    """

    design: Array
    plain: Array
    residuals: Array

    @cached_property
    def squares(self) -> Array:
        """Products of the columns of the design (n, p²)."""
        products = self.design[:, :, None] * self.design[:, None, :]
        return products.reshape(len(self.design), -1)

    @cached_property
    def degrees(self) -> Array:
        """Degrees of freedom of each reading."""
        return np.ones(len(self.design))

    def information(self, weight: Array) -> Array:
        """Return S of weights (B, n)."""
        if len(weight) == 1:
            return np.asarray((self.design.T * weight) @ self.design)[None]
        p = self.design.shape[1]
        return (weight @ self.squares).reshape(-1, p, p)


class Ended(NamedTuple):
    """Where the searches of B units ended, and how."""

    moves: Array  # d, from the plain fit (B, p)
    residuals: Array  # (B, n)
    converged: Mask
    iterations: Places
    last_step: Array  # relative, (B,)
    decrement: Array  # (B,)


def search_linear(
    linear: Linear, moves: Array, variance: Array, units: Places, name: Loss
) -> Ended:
    """Return where the searches of some units end, eq. (1); the others stay.

    Parameters
    ----------
    linear : Linear
    moves : (B, p) array
        From the plain fit, where they begin.
    variance : (B, n) array
    units : array of int
    name : str
        Of the loss.
    """
    count = len(moves)
    moves = moves.copy()
    converged, stuck = np.zeros((2, count), dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.intp)
    last_step, decrement = np.full((2, count), np.inf)
    here = _Spot.of(linear, moves, variance, units, name)
    before, damping = np.zeros(len(units)), _DAMPING
    for turn in range(_ITERATIONS):
        if not len(units):
            break
        step = _step(linear, here, damping, name)
        trial = here.moved(linear, step.moves, name)
        up = trial.objective > here.objective
        following = step.decrement * np.fmin(step.decrement / before, 1.0)
        over = up | (following <= _DECREMENT * trial.objective) | (step.relative <= _XTOL)
        before = step.decrement
        damping *= 0.1
        if over.any():
            mine, lost = units[over], up[over]
            moves[mine] = np.where(up[:, None], here.moves, trial.moves)[over]
            stuck[mine] = lost & (before <= _ROUNDING * here.objective)[over]
            converged[mine] = stuck[mine] | ~lost
            iterations[mine] = turn + 1
            last_step[mine], decrement[mine] = step.relative[over], before[over]
            units, before, trial = units[~over], before[~over], trial.some(~over)
        here = trial
    units = np.flatnonzero(stuck)
    for _ in range(_LAST_STEPS if len(units) else 0):
        here = _Spot.of(linear, moves, variance, units, name)
        moves[units] += _step(linear, here, 0.0, name).moves
    residuals = linear.residuals - moves @ linear.design.T
    return Ended(moves, residuals, converged, iterations, last_step, decrement)


class _Spot(NamedTuple):
    """Some units at a point of their search."""

    plain: Array  # b₀, (B, p)
    first: Array  # r₀, (B, n)
    variance: Array  # (B, n)
    moves: Array  # d, (B, p)
    residuals: Array  # r, (B, n)
    q: Array  # (B, n)
    objective: Array  # F, (B,)

    @classmethod
    def of(
        cls, linear: Linear, moves: Array, variance: Array, units: Places, name: Loss
    ) -> "_Spot":
        """Return some of the units at moves (B, p)."""
        first = linear.residuals[units]
        empty = np.zeros(0)
        start = cls(linear.plain[units], first, variance[units], moves[units], empty, empty, empty)
        return start.moved(linear, np.zeros_like(start.moves), name)

    def moved(self, linear: Linear, by: Array, name: Loss) -> "_Spot":
        """Return the units after steps (B, p)."""
        moves = self.moves + by
        r = self.first - moves @ linear.design.T
        q = r * r / self.variance
        F = loss(name, q, linear.degrees).sum(axis=1)
        return _Spot(self.plain, self.first, self.variance, moves, r, q, F)

    def some(self, which: Mask) -> "_Spot":
        """Return some of the units."""
        return _Spot(*(each[which] for each in self))


class _Step(NamedTuple):
    moves: Array  # Δ, (B, p)
    decrement: Array  # what it should take off F, (B,)
    relative: Array  # its size, (B,)


def _step(linear: Linear, here: _Spot, damping: float, name: Loss) -> _Step:
    """Return damped steps from where units are."""
    weight = loss_weight(name, here.q, linear.degrees) / here.variance
    information = linear.information(weight)
    gradient = (weight * here.residuals) @ linear.design
    scale = np.sqrt(np.einsum("bpp->bp", information))
    damped = information / (scale[:, :, None] * scale[:, None, :])
    p = scale.shape[1]
    damped.reshape(-1, p * p)[:, :: p + 1] += max(damping, 1e-15)
    whole = np.isfinite(damped).all(axis=(1, 2))
    if not whole.all():
        damped[~whole] = np.eye(p)
    scaled = np.linalg.solve(damped, (gradient / scale)[:, :, None])[:, :, 0]
    step = scaled / scale
    size = np.abs((here.plain + here.moves) * scale).max(axis=1)
    relative = np.abs(scaled).max(axis=1) / np.maximum(size, 1e-300)
    return _Step(step, np.einsum("bp,bp->b", step, gradient), relative)


@dataclass(eq=False)
class _Units:
    """One output of B units on their way, eq. (1)."""

    linear: Linear
    variance: Array  # (B, n)
    kept: Mask  # (B, n)
    moves: Array  # (B, p)
    residuals: Array  # (B, n)
    converged: Mask
    iterations: Places
    last_step: Array
    decrement: Array
    aside: list[tuple[int, int, float]] = field(default_factory=list)  # unit, row, misfit

    @property
    def q(self) -> Array:
        """Squared misfits (B, n)."""
        return np.asarray(self.residuals**2 / self.variance)

    @property
    def freedom(self) -> Array:
        """Degrees of freedom (B,) of the rows that are kept."""
        return np.asarray(self.kept.sum(axis=1) - float(self.moves.shape[1]))

    def of(self, part: slice) -> "_Units":
        """Return some of the units, one after another."""
        linear, found = self.linear, dict(vars(self))
        arrays = found.keys() - {"linear", "aside"}
        found |= {name: found[name][part] for name in arrays}
        found["linear"] = Linear(linear.design, linear.plain[part], linear.residuals[part])
        inside = [each for each in self.aside if part.start <= each[0] < part.stop]
        found["aside"] = [(unit - part.start, row, misfit) for unit, row, misfit in inside]
        return _Units(**found)

    def search(self, units: Places, name: Loss) -> None:
        """Search on from where units are."""
        ended = search_linear(self.linear, self.moves, self.variance, units, name)
        self.moves, self.residuals = ended.moves, ended.residuals
        for each in ("converged", "last_step", "decrement"):
            getattr(self, each)[units] = getattr(ended, each)[units]
        self.iterations[units] += ended.iterations[units]


class RobustFits(NamedTuple):
    """Robust fits of one output of B units.

    Attributes
    ----------
    parameters : (B, p) array
    cofactors : (B, p, p) array
        The covariance without weights, of the noise that was found.
    factor, dof : (B,) arrays
        What the covariance is to be multiplied by, and its degrees of freedom.
    weight : (B, n) array
        Of each reading, 0 where it is set aside.
    rejected : (B,) array
        χ² under the stated noise where that is rejected, else NaN.
    plain : (B, n) array
        Residuals without weights.
    units : _Units
        Where the searches ended.
    """

    parameters: Array
    cofactors: Array
    factor: Array
    dof: Array
    weight: Array
    rejected: Array
    plain: Array
    units: _Units


def fit_outputs(
    shared: known.SharedDesign, values: Array, stated: Array | None, name: Loss
) -> list[RobustFits]:
    """Fit every output of B units under a loss, those of one design as so many more units.

    Parameters
    ----------
    shared : SharedDesign
    values : (M, B, n) array
        Readings.
    stated : (M, B, n) array, optional
        Stated variances.
    name : str
        Of the loss.
    """
    count = len(values[0])
    found: dict[int, RobustFits] = {}
    for design in shared.groups:
        y = values[design.outputs].reshape(-1, values.shape[2])
        noise = None if stated is None else stated[design.outputs].reshape(y.shape)
        fits = _fit(design, y, noise, name, alone=count == 1)
        for place, output in enumerate(design.outputs):
            part = slice(place * count, (place + 1) * count)
            arrays = (each[part] for each in fits[:-1])
            found[output] = RobustFits._make([*arrays, fits.units.of(part)])
    return [found[output] for output in range(len(values))]


def _fit(
    shared: known.Design, y: Array, stated: Array | None, name: Loss, *, alone: bool
) -> RobustFits:
    """Fit readings (B, n) of one design; one without noise is left out where it is not alone."""
    count, n = y.shape
    b, r = known.fit_output(shared.design, shared.inverse, y)
    linear = Linear(shared.design, b, r)
    if stated is None:
        spread = np.mean((y - y.mean(axis=1, keepdims=True)) ** 2, axis=1)
        variance = np.tile(RELATIVE_NOISE**2 * spread[:, None], n)
    else:
        variance = stated.copy()
    on = _Units(
        linear,
        variance,
        kept=np.ones(y.shape, dtype=np.bool_),
        moves=np.zeros_like(b),
        residuals=r,
        converged=np.einsum("bn,bn->b", r, r) > known.ROUNDING**2 * np.einsum("bn,bn->b", y, y),
        iterations=np.zeros(count, dtype=np.intp),
        last_step=np.zeros(count),
        decrement=np.zeros(count),
    )
    if stated is not None or alone:
        on.converged[:] = True
    on.search(np.flatnonzero(on.converged), _HUBER)
    _set_aside(on, None if stated is not None else (robustness.FINEST * np.abs(y).max(axis=1)) ** 2)
    if name != _HUBER:
        on.search(np.flatnonzero(on.converged), name)
    weight = np.where(on.kept, loss_weight(name, on.q, linear.degrees), 0.0)
    dof = np.maximum(counted(name, weight, linear.degrees) - b.shape[1], 1.0)
    factor = _factors(on, name, dof)
    rejected = np.full(count, np.nan)
    if stated is not None:
        chi2, nu = np.sum(on.q * weight**2, axis=1), on.freedom
        limits = {
            each: chi2_quantile(known.REJECTED, each) for each in set(nu.tolist()) if each > 0
        }
        beyond = chi2 > np.array([limits.get(each, np.inf) for each in nu.tolist()])
        rejected[beyond] = chi2[beyond]
        factor, dof = np.where(beyond, factor, 1.0 / EFFICIENCY), np.where(beyond, dof, np.inf)
    if on.kept.all() and not np.ptp(on.variance, axis=1).any():
        cofactors = on.variance[:, :1, None] * shared.cofactor
    else:
        cofactors = np.asarray(np.linalg.inv(linear.information(1.0 / on.variance)))
    return RobustFits(b + on.moves, cofactors, factor, dof, weight, rejected, r, on)


def _factors(on: _Units, name: Loss, nu: Array) -> Array:
    """Return Huber's factor (B,) of the rows that are kept."""
    q, degrees = on.q, on.linear.degrees
    weight, slope = loss_weight(name, q, degrees), loss_slope(name, q, degrees)
    found = robustness.huber_factors(q, degrees, weight, slope, nu)
    for unit in np.flatnonzero(~on.kept.all(axis=1)).tolist():
        rows = on.kept[unit]
        parts = (each[unit, rows] for each in (q, weight, slope))
        mine, own, bent = parts
        found[unit] = robustness.huber_factors(mine, degrees[rows], own, bent, nu[unit])
    return found


def _set_aside(on: _Units, finest: Array | None) -> None:
    """Set rows aside that are beyond all chance, the worst of each unit first.

    At most a quarter of them: beyond that it is the model that does not fit. Where no noise is
    stated it is found anew each time, `finest` (B,) at least.
    """
    limit = chi2_quantile(1.0 - robustness.SET_ASIDE, 1.0)
    units = np.flatnonzero(on.converged)
    for _ in range(on.kept.shape[1] // 4 + 1):
        if finest is not None:
            _settle_noise(on, units[on.freedom[units] > 0.0], finest)
        q = np.where(on.kept, on.q, 0.0)
        worst = q.argmax(axis=1)
        units = units[on.converged[units] & (q[units, worst[units]] > limit)]
        if not len(units):
            break
        rows = worst[units]
        misfits = np.sqrt(q[units, rows])
        on.aside += zip(units.tolist(), rows.tolist(), misfits.tolist(), strict=True)
        on.kept[units, rows] = False
        on.variance[units, rows] /= robustness.ASIDE
        on.search(units, _HUBER)


def _settle_noise(on: _Units, units: Places, finest: Array) -> None:
    """Scale the noise of units until the median q of the rows that are kept is that of chance."""
    typical = chi2_quantile(0.5, 1.0)
    for _ in range(robustness.ROUNDS):
        if not len(units):
            break
        q, kept = on.q[units] / typical, on.kept[units]
        if kept.all():
            middle = median(q, axis=1)
        else:
            middle = np.array([float(median(a[b])) for a, b in zip(q, kept, strict=True)])
        ratio = middle * kept.sum(axis=1) / on.freedom[units]
        least = np.where(kept, on.variance[units], np.inf).min(axis=1)
        ratio = np.maximum(ratio, finest[units] / least)
        on.variance[units] *= ratio[:, None]
        on.search(units, _HUBER)
        units = units[(np.abs(np.log(ratio)) >= robustness.SETTLED) & on.converged[units]]


def estimate_robust(shared: known.SharedDesign, values: Sequence[Array], name: Loss) -> Estimates:
    """Fit B units under a robust loss.

    Parameters
    ----------
    shared : SharedDesign
    values : sequence of M arrays (B, n)
        Readings of each output.
    name : str
        Of the loss.
    """
    blocks = stated_uncertainty.taken_by_blocks(values, (), (), _AT_ONCE)
    with np.errstate(all="ignore"):  # a unit may run away, and is then left out
        return join_estimates([_estimate(shared, y, name) for y, _ in blocks])


def _estimate(shared: known.SharedDesign, values: Array, name: Loss) -> Estimates:
    found = fit_outputs(shared, values, None, name)
    parameters = np.concatenate([each.parameters for each in found], axis=1)
    u = np.concatenate([_standard_uncertainty(each) for each in found], axis=1)
    dof = np.concatenate(
        [np.broadcast_to(each.dof[:, None], each.parameters.shape) for each in found], axis=1
    )
    residuals = np.stack([each.units.residuals for each in found])
    rms, inverted = rms_of(
        shared.model, shared.environment, shared.reference, parameters, values, residuals
    )
    sound = inverted.sound & (np.abs(parameters).max(axis=1) <= LARGEST)
    sound &= np.all([each.units.converged for each in found], axis=0)
    level = OUTLIER_LEVEL / (len(values) * values[0].shape[1])
    return Estimates(
        parameters,
        u,
        dof,
        rms,
        np.stack([each.plain for each in found]),
        *inverted[:2],
        sound,
        variance=np.stack([_variance(each.units) for each in found], axis=1),
        weight=np.stack([each.weight for each in found], axis=1),
        outlying=np.any([_are_outlying(each, level) for each in found], axis=0),
    )


def _variance(on: _Units) -> Array:
    """Return the mean variance (B,) of the readings that are kept."""
    return np.asarray(np.mean(on.variance, axis=1, where=on.kept))


def _misfits(found: RobustFits) -> Array:
    """Return squared misfits (B, n) in units of the noise that was found."""
    on, sized = found.units, np.isfinite(found.factor) & (found.factor > 0.0)
    factor = np.where(sized, found.factor, 1.0)  # 0 where every residual is
    return np.asarray(on.q / np.where(on.kept, 1.0, robustness.ASIDE) / factor[:, None])


def _are_outlying(found: RobustFits, level: float) -> Mask:
    """Return of which units (B,) a reading is beyond chance, by `find_outlying_positions`."""
    largest = _misfits(found).max(axis=1)
    # of the most degrees of freedom tails are shortest: no other can be beyond
    beyond = ~(largest <= f_quantile(1.0 - level, 1.0, float(np.nanmax(found.dof))))
    for unit in np.flatnonzero(beyond).tolist():
        beyond[unit] = f_tail(float(largest[unit]), 1.0, float(found.dof[unit])) < level
    return np.asarray(beyond)


def _standard_uncertainty(found: RobustFits) -> Array:
    """Return u (B, p)."""
    own = np.einsum("bpp->bp", found.cofactors)
    return np.asarray(np.sqrt(own * found.factor[:, None]))


def solve_robust_known(
    model: Model, reference: Array, readings: Readings, name: Loss
) -> Solution | None:
    """Fit one unit under a loss, output by output.

    None where the general search is to say what is wrong: dependent columns, nothing left over, an
    output that never changes; or where correlated readings need it.
    """
    noise, values = readings.noise, readings.values
    n, m = values.shape
    if type(model) is not Model or (noise is not None and noise.ndim == 2):
        return None
    try:
        shared = known.share_design(model, reference, readings.environment)
    except RankError:
        return None
    if not shared.well_posed or not np.ptp(values, axis=0).all():
        return None
    variances = None if noise is None else noise.reshape(n, m).T[:, None]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        found = fit_outputs(shared, values.T[:, None], variances, name)
    return _solution(shared, readings, found)


def _solution(shared: known.SharedDesign, readings: Readings, found: list[RobustFits]) -> Solution:
    """Return the solution of outputs that were fitted one by one, as a batch of one."""
    model, m = shared.model, len(found)
    texts = [_texts(shared, readings, i, each) for i, each in enumerate(found)]
    covariance = np.zeros((len(model.keys), len(model.keys)))
    for mine, each in zip(model.slices, found, strict=True):
        covariance[mine, mine] = each.cofactors[0] * each.factor[0]
    dof = np.concatenate([each.dof for each in found])
    factor = np.concatenate([each.factor for each in found])
    units = [each.units for each in found]
    stated_noise = [
        NoiseTest(float(each.rejected[0]), float(each.units.freedom[0]))
        for each in found
        if np.isfinite(each.rejected[0])
    ]
    weight = np.concatenate([each.weight for each in found]).T
    return Solution(
        model=model,
        reference=shared.reference,
        parameters=np.concatenate([each.parameters[0] for each in found]),
        covariance=covariance,
        parameter_dof=model.per_parameter(dof),
        inflation=np.sqrt(model.per_parameter(factor)),
        dof=dof,
        residuals=np.concatenate([each.residuals for each in units]).T,
        residual_sd=np.sqrt(np.concatenate([_variance(each) for each in units])),
        leverage=np.stack([_leverage(each) for each in found], axis=1),
        outliers=tuple(text for each in texts for text in each.outliers),
        condition=max(condition(each.linear.information(1.0 / each.variance)[0]) for each in units),
        findings=tuple(finding for each in texts for finding in each.findings),
        unidentifiable=tuple(text for each in texts for text in each.unidentifiable),
        status=_status(max(units, key=lambda each: int(each.iterations[0]))),
        robust_weight=weight if m > 1 else weight[:, 0],
        claim=NoiseTest(sum(c.chi2 for c in stated_noise), sum(c.dof for c in stated_noise))
        if stated_noise
        else None,
    )


class _Texts(NamedTuple):
    outliers: tuple[str, ...]
    unidentifiable: tuple[str, ...]
    findings: Findings


def _texts(
    shared: known.SharedDesign, readings: Readings, output: int, found: RobustFits
) -> _Texts:
    """Return the outliers, unidentifiable parameters and findings of an output."""
    model, on, labels = shared.model, found.units, readings.labels
    m, name = len(model.outputs), model.outputs[output]
    dof, degrees = float(found.dof[0]), on.linear.degrees
    misfits = _misfits(found)[0]
    outliers = find_outlying_positions(misfits, degrees, dof, labels, robust=True, parts=m)
    magnitude = float(np.linalg.norm(shared.reference, axis=1).mean())
    u = _standard_uncertainty(found)[0]
    unidentifiable = formal_only(model.only(name), found.parameters[0], u, magnitude)
    findings: Findings = tuple(
        robustness.aside_finding(labels[row], size) for _, row, size in on.aside
    )
    if m > 1:
        outliers = tuple(f"{name}: {text}" for text in outliers)
        unidentifiable = tuple(f"{name}: {text}" for text in unidentifiable)
        findings = about(name, findings)
    return _Texts(outliers, unidentifiable, findings)


def _leverage(found: RobustFits) -> Array:
    """Return the leverage (n,) of the rows of one unit."""
    X, on = found.units.linear.design, found.units
    return np.asarray(np.einsum("np,pq,nq->n", X, found.cofactors[0], X) / on.variance[0])


def _status(on: _Units) -> Status:
    """Return how the search of the output ended that took most iterations."""
    iterations = int(on.iterations[0])
    return Status(
        bool(on.converged[0]),
        iterations,
        f"converged in {iterations} iterations",
        float(on.last_step[0]),
        float(np.sqrt(max(on.decrement[0], 0.0))),
    )

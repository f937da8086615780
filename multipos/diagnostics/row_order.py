"""What the order of the rows shows: drift, a slip, another unit, a filter, a table, slow noise.

`search` returns the causes of time and table that chance rarely passes; `search_units`,
`search_by_noise` and `search_solutions` do so for many units. `asked` tells whether rows can be
held against their order, which `time_order` is; `plan_of` is what positions give once and
`residuals_in_order` what a calibration gives. `fit_sizes` and `estimate` are the sizes of a cause,
`slow_score` the score of slow noise.

Residuals e of rows in the order of time, whitened, are what a fit left of the readings. A cause
that the model does not know adds columns Z of q unknown sizes to it; with V = Z − QQ'Z what the
fit leaves of them, Δ = e'V(V'V)⁻¹V'e and ν degrees of freedom of an output,

    Λ = −Σ ν ln(1 − Δ_i/e_i'e_i)    outputs apart,    Λ = −N ln(1 − Δ/e'e)    together,      (1)

N = Σ ν, is twice the logarithm of the ratio of likelihoods. With f_k the force at row k, K the
slopes of the outputs and s_k = 1 from row j on, the columns are

    drift       t_k or exp(−t_k/τ), apart     replaced    s_k, or s_k times every term, apart
    slipped     s_k K (ω × f_k)               settling    a K (f_k−1 − f_k), a > 0
    hysteresis  ±1 by approach, apart; where none is stated K h with the signs of f_k − f_k−1
    vibration   the rests' own variance, apart
    level       K (R_k east, R_k north)       table       two harmonics of the angle of each roll.

As V'e = Z'e and V'V = Z'Z − (Q'Z)'(Q'Z), sums over the rows from j on give Δ for every j at once.
The j of the largest Λ is judged: together by F of (1), apart by Fisher's sum over F of each output,
times the number of j (union bound). Of fewer than twelve rows none is asked for what needs their
order alone: chance explains as much. Slow noise of correlation ρ = 1 − 5/n from row to row is
judged by its score,

    T = Σ e_i'Ω e_i / e_i'e_i,    Ω_jk = ρ^|j − k|,                                         (2)

whose law is nearly that of a χ² variable, moved and scaled, of its mean, variance and skewness. All
causes share one level: p of each is multiplied by the number of causes.

Several causes explain the same residuals, more or less. In one likelihood, the terms that the model
lacks, orientation error and outliers among them, the best has the largest

    S = Λ − q ln N − 2 ln (number tried),                                                   (3)

and it alone is named. Arrays of B units at positions that they share have these on their last axis.

Sources: J. Durbin, G. S. Watson, Biometrika 37, 1950 (2); G. Schwarz, Ann. Statist. 6, 1978 (3).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, lru_cache, partial, reduce
from typing import NamedTuple

import numpy as np

from multipos.estimation.batches import Solution
from multipos.numerics.arrays import Array, Mask, Places, median
from multipos.numerics.factoring import Covariance, factor
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_log_tails, f_quantile, f_tail
from multipos.numerics.recursions import recur
from multipos.numerics.rotations import cross_matrix
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import parameter_jacobian

LEVEL = 0.01  # of all causes together
_FIRST_SIGHT = 0.8  # of a limit, from which on p decides
_LEAST = 2  # rows before and after a change
_DOZEN = 12  # rows, of fewer of which chance explains as much as any cause of time
_SETTLED = (0.1, 0.2, 0.4)  # τ of a warm-up, in shares of the session
_SIDED = 4  # rows that are approached from one side, at least
_DIGITS = 6  # of a force, within which it did not change
_FREE = 2.0  # degrees of freedom an output: of one, its residuals by their size are a sign alone
_IDENTIFIABLE = 1e-3  # of a column's square, which a fit must leave of it
_GRID = 0.05  # of directions, to which plans are kept
_KEPT = 16
_LIMITS = 1024
_AT_ONCE = 6000  # rows of units, so that what they need stays in the cache
_SELDOM = 2.0  # standard deviations that the hundredth part of a law lies beyond
_MANY = 100_000  # positions, whose plan is too large to keep
_TURN = 12  # positions of a roll on a table
UNEQUAL = 2.0  # of the rests' own sd, largest over median, from which vibration is asked
_MOST = 400  # rows, beyond which steps are tried at so many of them
_SHORT = 64  # rows, up to which sums from each step on are one matrix
_LONG = 600  # products from step to step, beyond which they are not held
_ROUNDS = 5  # of weights, alternating with sizes
_ROUNDING = 1e-12
_NOTHING = 1e-30  # a correlation that adds nothing
_FEW = 8  # units whose probabilities are worked out one by one
_CORRELATIONS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)  # ρ at which the likelihood is evaluated
TIME, APPROACH, SLOW = "time", "approach", "time-correlated"
_CHANGES = ("slipped", "replaced")
_OF_ATTITUDE = ("slipped", "level", "table")  # where a turn of the case is free, nothing

Rows = Places
_ALONE: Rows = np.zeros(1, dtype=np.intp)  # the one output that misfits are


@frozen(eq=True)
class Cause:
    """One explanation of the residuals.

    Attributes
    ----------
    code : str
        Of its finding.
    score : float
        S of eq. (3).
    p : float
        Chance of any cause where there is none.
    row : int or None
        The first row after a change.
    place : int
        Of its test in the plan, the last of slow noise.
    """

    code: str
    score: float
    p: float
    row: int | None = None
    place: int = -1


@frozen
class _Family:
    """Columns of one cause, from each of K rows on, in the order of time.

    `base` is (n, q) where outputs are apart, (n, 3, q) by component of force where they move
    together, or (n, 1, q) of one misfit a row.
    """

    code: str
    base: Array
    steps: Rows
    wholly: bool = False

    @property
    def apart(self) -> bool:
        """Whether each output has sizes of its own."""
        return self.base.ndim == 2


@frozen
class _Test:
    """A family whitened, with what makes Δ of eq. (1) of it.

    Attributes
    ----------
    parts : tuple of _Part
        Of outputs apart, or one of all that move together.
    ranks, limits : (K,) arrays
        Columns that the fit leaves, and Λ below which nothing is said.
    tried : int
    """

    family: _Family
    parts: tuple["_Part", ...]
    ranks: Array
    limits: Array
    tried: int


class _Part(NamedTuple):
    """Columns of outputs, as (n, c, q) of what they see, c = 1 apart; Δ is the square of root Z'e.

    Of few rows the roots times Z', over the rows from each step on, are one matrix (K q, n c).
    """

    outputs: Rows
    columns: Array
    roots: Array  # (K, q, q)
    steps: Rows
    matrix: Array | None

    def seen(self, e: Array) -> Array:
        """Return a root times Z'e (K, q, B), by what columns see (c, n, B)."""
        if self.matrix is not None:
            return (self.matrix @ e.reshape(-1, e.shape[2])).reshape(*self.roots.shape[:2], -1)
        each = zip(self.columns.transpose(1, 0, 2), e, strict=True)
        return np.asarray(self.roots @ sum(_from_each(*both, self.steps) for both in each))


def _part(outputs: Rows, columns: Array, roots: Array, steps: Rows) -> _Part:
    matrix, n = None, len(columns)
    if n <= _SHORT:
        after = np.arange(n) >= steps[:, None]
        each = roots[:, None] @ columns.transpose(1, 2, 0) * after[:, None, None]
        matrix = each.swapaxes(1, 2).reshape(roots.shape[0] * roots.shape[1], -1)
    return _Part(outputs, columns, roots, steps, matrix)


@frozen
class Plan:
    """What eqs. (1) and (2) need of the positions, kept from one fit to the next.

    Attributes
    ----------
    order : (n,) array of int
    groups : tuple of (outputs, Q (n, p))
        Outputs that share a design, rows in the order of time.
    across : (n, C) array or None
        Directions in which the noise of rows is compared, of unknown orientations.
    bases : tuple of (n, p) arrays
        Q of each output.
    weight, slopes : (n, M) or (1, M), (M, 3) arrays
        What whitens readings, and slopes of the outputs.
    nu, freedom : float
        ν of an output, and N.
    tests : tuple of _Test
    codes : int
        Number of causes.
    slow : (mean, sd, skewness) of T, or None
    """

    order: Rows
    groups: tuple[tuple[Rows, Array], ...]
    across: Array | None
    bases: tuple[Array, ...]
    weight: Array
    slopes: Array
    nu: float
    freedom: float
    tests: tuple[_Test, ...]
    codes: int
    slow: tuple[Array, Array, Array] | None


class Shown(NamedTuple):
    """What causes explain in B units, one row each of C causes.

    Attributes
    ----------
    codes : tuple of str
    score : (C, B) array
        S of eq. (3), −inf of what chance may do as well.
    p : (C, B) array
        Chance of any cause, searches included.
    step : (C, B) array of int
        The first row after a change, in the order of time.
    """

    codes: tuple[str, ...]
    score: Array
    p: Array
    step: Rows


def time_order(c: Calibration) -> Rows:
    """Return the rows (n,) in the order of time, by their column or as they stand."""
    time = c.readings.environment.get(TIME)
    if time is None or not np.isfinite(time).all():
        return np.arange(len(c.readings))
    return np.argsort(time, kind="stable")


def asked(c: Calibration) -> bool:
    """Tell whether residuals can be held against their order."""
    noise = c.noise
    plain = c.robust_weight is None and c.model.has_terms
    known = c.estimator is Estimator.LINEAR or (
        c.estimator is Estimator.UNKNOWN and len(c.outputs) == 3
    )
    if not np.isfinite(c.residual_sd).all():
        return False
    nothing = _ROUNDING * np.abs(c.readings.values).max(axis=0)
    scattered = bool((c.residual_sd > nothing).all())
    return plain and known and scattered and (noise is None or noise.ndim == 1)


def search(c: Calibration) -> tuple[Cause, ...]:
    """Return the causes of time and table that chance alone passes rarely, the best of each.

    Parameters
    ----------
    c : Calibration
        With `asked(c)`.
    """
    plan, e, slopes = residuals_in_order(c)
    if plan is None:
        return ()
    found = search_units(plan, e.T[:, None], slopes[None])
    causes: dict[str, Cause] = {}
    for place, code in enumerate(found.codes):
        score, p, step = (float(part[place, 0]) for part in found[1:4])
        before = causes.get(code)
        if score > (-math.inf if before is None else before.score):
            row = int(plan.order[int(step)]) if code in _CHANGES else None
            causes[code] = Cause(code, score, p, row, place)
    held = causes.get("settling")
    if held is not None and not _sizes(plan, c, held, e, slopes).item() > 0.0:
        del causes["settling"]  # a filter holds a share of the row before, and never less than none
    return tuple(causes.values())


def plan_of(c: Calibration) -> Plan | None:
    """Return what units at the positions of one, at known orientations, share; None for none."""
    return _plan_of(_Setting(c)) if asked(c) and c.estimator is Estimator.LINEAR else None


def search_units(plan: Plan, residuals: Array, slopes: Array, level: float = LEVEL) -> Shown:
    """Return what the causes explain in B units.

    Parameters
    ----------
    plan : Plan
    residuals : (M, B, n) array
        Whitened.
    slopes : (B, M, 3) array
        Of the outputs per g, by the same standard deviations.
    level : float
        Of all causes together, above which none is one.
    """
    e = np.ascontiguousarray(residuals.transpose(2, 0, 1)[plan.order])
    size = np.sqrt(np.einsum("nmb,nmb->mb", e, e))
    whole = (size > 0.0).all(axis=0)
    size = np.where(size > 0.0, size, 1.0)
    e /= size
    slopes = slopes / size.T[:, :, None]
    along = _along_force(plan, e)
    shape = len(plan.tests) + 1, e.shape[2]
    score, p, step = np.full(shape, -np.inf), np.ones(shape), np.zeros(shape, dtype=np.intp)
    for row, test in enumerate(plan.tests):
        place, gain, explained = _best_steps(test, e, along, plan.nu)
        units = np.flatnonzero((gain > _FIRST_SIGHT * test.limits[place]) & whole)
        if len(units):
            given = e[:, :, units], slopes[units], place[units], explained[:, units], gain[units]
            place[units], p[row, units], score[row, units] = _judge(plan, test, *given, level)
        step[row] = test.family.steps[place]
    del along  # of many rows it is large
    _judge_slow(plan, e, whole, score[-1], p[-1])
    codes = (*(test.family.code for test in plan.tests), SLOW)
    return Shown(codes, score, p, step)


def _along_force(plan: Plan, e: Array) -> Array:
    """Return what e (n, M, B) has along the columns (3, n, B), or (1, n, B), of `_Family.base`."""
    if plan.across is not None:
        return np.asarray(e.transpose(1, 0, 2))
    if len(plan.weight) == 1:
        return np.tensordot(plan.slopes * plan.weight.T, e, (0, 1))
    return np.tensordot(plan.slopes, plan.weight[:, :, None] * e, (0, 1))


def _best_steps(test: _Test, e: Array, along: Array, nu: float) -> tuple[Rows, Array, Array]:
    """Return the likeliest step (B,), Λ there (B,) and Δ_i/e_i'e_i (M, B), of unit e (n, M, B).

    `along` (3, n, B) is what columns see of outputs that move together.
    """
    n, m, count = e.shape
    each = m if test.family.apart else 1
    explained = np.empty((len(test.limits), each, count))
    for part in test.parts:
        outputs = part.outputs[:each]
        for own in outputs[:, None] if part.matrix is None else [outputs]:
            seen = part.seen(e[:, own].reshape(1, n, -1) if test.family.apart else along)
            square = np.einsum("kqb,kqb->kb", seen, seen) * (each / m)
            explained[:, own] = square.reshape(-1, len(own), count)
    np.minimum(explained, 1.0 - _ROUNDING, out=explained)
    # the largest Λ less its limit, by its exponential: one logarithm a unit
    left = (1.0 - explained).prod(axis=1)
    left *= np.exp(test.limits * each / (nu * m))[:, None]
    place = left.argmin(axis=0)
    there = explained[place, :, np.arange(count)].T
    there = there if each == m else np.repeat(there, m, axis=0)
    return place, -nu * np.log1p(-there).sum(axis=0), there


def _from_each(A: Array, B: Array, steps: Rows) -> Array:
    """Return A'B (K, p, q) of A (n, p) and B (n, q), over the rows from each of K steps on."""
    if A.size * B.shape[1] > _LONG * len(steps):
        ends = [*steps[1:].tolist(), len(A)]
        pieces = [slice(*each) for each in zip(steps.tolist(), ends, strict=True)]
        between = np.stack([A[rows].T @ B[rows] for rows in pieces])
    else:
        between = np.add.reduceat(A[:, :, None] * B[:, None, :], steps, axis=0)
    return np.asarray(np.cumsum(between[::-1], axis=0)[::-1])


def _log_tails(ratios: Array, q: Array, left: Array) -> Array:
    """Return ln P of ratios (R, U) of variances on q and left (U,) degrees of freedom."""
    logs = np.empty(ratios.shape)
    if ratios.shape[1] <= _FEW:
        for place in np.ndindex(ratios.shape):
            tail = f_tail(float(ratios[place]), float(q[place[1]]), float(left[place[1]]))
            logs[place] = math.log(max(tail, 1e-300))
        return logs
    for rank in np.unique(q).tolist():
        mine = q == rank
        logs[:, mine] = f_log_tails(ratios[:, mine], rank, float(left[mine][0]))
    return logs


def _together(logs: Array) -> Array:
    """Return p (U,) of Fisher's sum over ln P (R, U): an even χ², which has a closed form."""
    half, term, total = -logs.sum(axis=0), 1.0, 0.0
    for j in range(len(logs)):
        total, term = total + term, term * half / (j + 1.0)
    return np.asarray(np.exp(-half) * total)


def _judge(
    plan: Plan,
    test: _Test,
    e: Array,
    slopes: Array,
    place: Rows,
    explained: Array,
    gain: Array,
    level: float = LEVEL,
) -> tuple[Rows, Array, Array]:
    """Return the step, p and S (U,) of units whose Λ is beyond the limit."""
    q, m = test.ranks[place], e.shape[1]
    if test.family.apart:
        left, columns = plan.nu - q, q * m
        ratios = explained / (1.0 - explained) * (left / q)
    else:
        left, columns = plan.freedom - q, q
        ratios = (np.expm1(gain / plan.freedom) * left / q)[None]
        place, gain = _refined(plan, test, e, slopes, place)
    p = np.minimum(_together(_log_tails(ratios, q, left)) * test.tried * plan.codes, 1.0)
    score = gain - columns * math.log(plan.freedom) - 2.0 * math.log(test.tried)
    return place, p, np.where(p < level, score, -np.inf)


def _refined(plan: Plan, test: _Test, e: Array, slopes: Array, place: Rows) -> tuple[Rows, Array]:
    """Return the step (U,) and Λ (U,) with the slopes (U, M, 3) and scatters of each unit."""
    moved = _moved(test.family.base, slopes) * plan.weight[..., None]
    unit, last = np.moveaxis(e, 2, 0), len(test.limits) - 1
    near = np.array([0, -1, 1] if last else [0])  # a plan's slopes may be those of another unit
    tried = np.clip(place + near[:, None], 0, last)
    after = np.arange(len(e)) >= test.family.steps[tried][..., None]
    Z = moved * after[..., None, None]
    every = fit_sizes(plan.bases, Z.reshape(-1, *Z.shape[2:]), np.tile(unit, (len(near), 1, 1)))[1]
    gain = every.reshape(tried.shape)
    gain = np.where(gain > -np.inf, gain, -np.inf)  # of readings beyond all numbers
    best = np.argmax(gain, axis=0), np.arange(len(place))
    return tried[best], gain[best]


def _moved(base: Array, slopes: Array) -> Array:
    """Return columns (…, n, M, q) of outputs of some slopes (…, M, 3) that move together."""
    if base.shape[1] == 1:
        return base
    return np.asarray(np.swapaxes(np.tensordot(slopes, base, (-1, 1)), -3, -2))


def _moved_alone(base: Array, slopes: Array) -> Array:
    """Return the columns (n, q) of one output of slopes (3,)."""
    if base.shape[1] == 1:
        return base[:, 0]
    used = np.flatnonzero(slopes).tolist() or [0]  # most are zero
    return np.asarray(reduce(np.add, (slopes[axis] * base[:, axis] for axis in used)))


def fit_sizes(bases: Sequence[Array], Z: Array, e: Array) -> tuple[Array, Array]:
    """Return the sizes (U, q) of columns Z (U, n, M, q) common to outputs, and Λ (U,).

    Outputs of e (U, n, M) are weighted by what they scatter beside the cause, which alternates
    with the sizes.
    """
    V = np.empty((len(Z), len(bases), Z.shape[3], Z.shape[1]))  # rows long: products are fast
    for i, (Q, own) in enumerate(zip(bases, V.swapaxes(0, 1), strict=True)):
        mine = Z[:, :, i].swapaxes(1, 2)
        np.subtract(mine, (mine @ Q) @ Q.T, out=own)
    nu = np.array([len(Q) - Q.shape[1] for Q in bases], dtype=np.float64)
    gram = V @ V.swapaxes(2, 3)
    along = np.einsum("umqn,unm->umq", V, e)
    square = np.einsum("unmq,unmq->umq", Z, Z)
    before = now = np.einsum("unm,unm->um", e, e)
    for _ in range(_ROUNDS):
        weight = (nu / now)[:, :, None]
        roots, _ = _roots(np.sum(weight[..., None] * gram, axis=1), np.sum(weight * square, axis=1))
        half = roots @ np.sum(weight * along, axis=1)[:, :, None]
        sizes = (roots.transpose(0, 2, 1) @ half)[:, None, :, 0]
        left = np.sum(sizes * ((gram @ sizes[..., None])[..., 0] - 2.0 * along), axis=2)
        now = np.maximum(before + left, _ROUNDING * before)
    return sizes[:, 0], np.log(before / now) @ nu


def _roots(gram: Array, size: Array) -> tuple[Array, Array]:
    """Return R (K, q, q), R'R the inverse of V'V (K, q, q), and its rank (K,).

    Directions of which a fit leaves no more than rounding of their size Z'Z (K, q) count as zero.
    """
    scale = np.sqrt(np.where(size > 0.0, size, 1.0))
    unit = gram / (scale[:, :, None] * scale[:, None, :])
    unit[~np.isfinite(unit)] = 0.0  # of readings beyond all numbers
    values, vectors = np.linalg.eigh(unit)
    kept = values > _IDENTIFIABLE
    root = kept / np.sqrt(np.where(kept, values, 1.0))
    rows = (vectors * root[:, None, :]).transpose(0, 2, 1) / scale[:, None, :]
    return rows, kept.sum(axis=1).astype(np.float64)


_NOTHING_SEEN = float(np.finfo(np.float64).tiny) ** 0.5  # no linear response, exact readings


def _response(slopes: Array) -> Array:
    """Return the sizes (…, M) of slopes (…, M, 3), no less than rounding leaves of the largest."""
    largest = np.abs(slopes).max(axis=(-1, -2), keepdims=True)[..., 0]
    lowest = np.maximum(_ROUNDING * largest, _NOTHING_SEEN)
    return np.asarray(np.maximum(np.sqrt(np.einsum("...mi,...mi->...m", slopes, slopes)), lowest))


def _weights(response: Array, sd: Array) -> Array:
    """Return powers of two (…, M) near the response of outputs over their noise, in its mean."""
    size = response / np.maximum(sd, _NOTHING_SEEN)
    mean = size.sum(axis=-1, keepdims=True) / size.shape[-1]
    return np.asarray(np.exp2(np.rint(np.log2(size / mean))))


class _Setting:
    """What a plan depends on, equal where these are."""

    def __init__(self, c: Calibration, weight: Array | None = None) -> None:
        """Take the positions of a unit, and weights (M,) of outputs, its own if not given."""
        self.calibration = c
        noise, S = c.noise, c.sensitivity
        level = noise is None or not np.ptp(noise.reshape(len(c.readings), -1), axis=0).any()
        own = _response(S)
        self.balance = _weights(own, c.residual_sd) if weight is None else weight
        # cross terms of a few percent and sd by chance give the same plan
        self.slopes = np.rint(S / (_GRID * own)[:, None]) * (_GRID * self.balance)[:, None] + 0.0
        self.weight = None
        if noise is not None and not level:
            self.weight = 1.0 / np.sqrt(noise).reshape(c.residuals.shape)

    @cached_property
    def _key(self) -> tuple[object, ...]:
        c = self.calibration
        columns, sd = c.readings.environment, c.readings.sd
        return (
            *(c.model.names, c.reference.tobytes(), self.slopes.tobytes()),
            *(columns[name].tobytes() for name in sorted(columns)),
            b"" if self.weight is None else self.weight.tobytes(),
            b"" if sd is None else sd.tobytes(),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Setting) and self._key == other._key


def _plan_of(setting: _Setting) -> Plan | None:
    """Return the plan at known orientations, kept where positions are not too many."""
    many = len(setting.calibration.readings) > _MANY
    return _plan_at_known.__wrapped__(setting) if many else _plan_at_known(setting)


@lru_cache(maxsize=_KEPT)
def _plan_at_known(setting: _Setting) -> Plan | None:
    c = setting.calibration
    weight = np.ones((1, len(c.outputs))) if setting.weight is None else setting.weight
    groups = _designs(c, weight)
    slow = _law_of_slow(groups, None)
    families = _families(c, max(Q.shape[1] for _, Q in groups))
    return _planned(time_order(c), families, groups, weight, setting.slopes, slow)


def _designs(c: Calibration, weight: Array) -> tuple[tuple[Rows, Array], ...]:
    """Return outputs that share a design, and its Q (n, p) weighted, rows in the order of time."""
    order, phi = time_order(c), c.model.basis(c.reference, c.readings.environment)
    shared: dict[tuple[bytes, bytes], list[int]] = {}
    for i, columns in enumerate(c.model.columns):
        shared.setdefault((columns.tobytes(), weight[:, i].tobytes()), []).append(i)
    groups = []
    for outputs in shared.values():
        design = phi[:, c.model.columns[outputs[0]]] * weight[:, [outputs[0]]]
        Q, _ = factor(Covariance(None, 0), design[order])
        groups.append((np.array(outputs, dtype=np.intp), Q))
    return tuple(groups)


def _planned(
    order: Rows,
    families: list[_Family],
    groups: tuple[tuple[Rows, Array], ...],
    weight: Array,
    slopes: Array,
    slow: tuple[Array, Array, Array] | None,
    across: Array | None = None,
) -> Plan | None:
    """Return the plan of families, with what whitens readings (n, M), or None of no residuals."""
    n, m = len(order), weight.shape[1]
    nu = float(n - max(Q.shape[1] for _, Q in groups))
    if nu < _FREE:
        return None
    codes, numbers = _numbers(families)
    tests, weight = [], weight[order] if len(weight) > 1 else weight
    for family, tried in zip(families, numbers, strict=True):
        parts, ranks = _whitened(family, groups, weight, slopes)
        columns = ranks * (m if family.apart else 1)
        limits = np.array([_limit(q, nu * m, tried * codes) for q in columns.tolist()])
        tests.append(_Test(family, parts, ranks, limits, tried))
    by_output = {output: Q for outputs, Q in groups for output in outputs.tolist()}
    bases = tuple(by_output[i] for i in range(m))
    found = bases, weight, slopes, nu, nu * m, tuple(tests), codes, slow
    return Plan(order, groups, across, *found)


def _numbers(families: Sequence[_Family]) -> tuple[int, list[int]]:
    """Return the number of causes, slow noise with them, and how many steps each family's has."""
    steps = Counter[str]()
    for family in families:
        steps[family.code] += len(family.steps)
    return len(steps) + 1, [steps[family.code] for family in families]


def _whitened(
    family: _Family, groups: tuple[tuple[Rows, Array], ...], weight: Array, slopes: Array
) -> tuple[tuple[_Part, ...], Array]:
    """Return the parts of a test, one of each group or one of all outputs, and its ranks."""
    apart = family.apart
    parts, grams, sizes = [], [], []
    for outputs, Q in groups:
        for output in outputs[:1].tolist() if apart else outputs.tolist():
            Z = family.base if apart else _moved_alone(family.base, slopes[output])
            Z = Z * weight[:, [output]] if len(weight) > 1 else Z
            both = _from_each(np.concatenate([Q, Z], axis=1), Z, family.steps)
            lost, square = both[:, : Q.shape[1]], both[:, Q.shape[1] :]
            grams.append(square - lost.transpose(0, 2, 1) @ lost)
            sizes.append(np.einsum("kqq->kq", square))
            parts += [(outputs, Z[:, None])] if apart else []
    if not apart:
        parts = [(np.arange(len(slopes)), family.base)]
        grams, sizes = [reduce(np.add, grams)], [reduce(np.add, sizes)]
    found = [_roots(gram, size) for gram, size in zip(grams, sizes, strict=True)]
    ranks = reduce(np.maximum, [rank for _, rank in found])
    pairs = zip(parts, found, strict=True)
    return tuple(_part(*part, root, family.steps) for part, (root, _) in pairs), ranks


@lru_cache(_LIMITS)
def _limit(q: float, freedom: float, tried: int) -> float:
    """Return Λ that chance alone seldom passes; a first sight, which p decides upon."""
    left = freedom - q
    if q < 1.0 or left < 1.0:
        return math.inf
    f = f_quantile(1.0 - LEVEL / tried, q, left)
    return freedom * math.log1p(q * f / left) if math.isfinite(f) else math.inf


def _correlation(n: int) -> float:
    """Return ρ of eq. (2)."""
    return min(max(1.0 - 5.0 / n, 0.5), 0.95)


def _judge_slow(plan: Plan, e: Array, whole: Mask, score: Array, p: Array) -> None:
    """Fill in S and p (B,) of slow noise, of unit e (n, M, B), of units that are whole (B,)."""
    if plan.slow is None:
        return
    n = len(e)
    w = e if plan.across is None else plan.across[:, :, None] * e
    before = recur(w.reshape(n, -1), _correlation(n)).reshape(w.shape)
    T = 2.0 * np.einsum("ncb,ncb->b", w, before) - np.einsum("ncb,ncb->b", w, w)
    mean, sd, skewness = map(float, plan.slow)
    k = 8.0 / skewness**2
    if k >= 1.0 and not (mean + _SELDOM * sd < T).any():
        return  # of so skew a law its hundredth lies further out than a normal one's
    units = np.flatnonzero((_slow_limit(mean, sd, skewness, plan.codes) < T) & whole)
    if not len(units):
        return
    score[units] = _slow_gains(plan, e[:, :, units]) - math.log(plan.freedom)
    for unit in units.tolist():
        chance = chi2_tail(k + math.sqrt(2.0 * k) * (float(T[unit]) - mean) / sd, k)
        p[unit] = min(chance * plan.codes, LEVEL)


def _slow_limit(mean: float, sd: float, skewness: float, codes: int) -> float:
    """Return T of eq. (2) that chance seldom passes, one of so many causes."""
    k = 8.0 / skewness**2
    return mean + sd * (chi2_quantile(1.0 - LEVEL / codes, k) - k) / math.sqrt(2.0 * k)


def _law_of_slow(
    groups: tuple[tuple[Rows, Array], ...], across: Array | None
) -> tuple[Array, Array, Array] | None:
    """Return the mean, the standard deviation and the skewness of T of eq. (2)."""
    mean = variance = third = np.zeros(())
    for outputs, Q in groups:
        nu, k = float(Q.shape[-2] - Q.shape[-1]), len(outputs)
        once, twice, thrice = _traces(Q, across)
        center = once / nu
        second = twice - center * once
        mean = mean + k * center
        variance = variance + k * 2.0 * second / (nu * (nu + 2.0))
        rest = thrice - 3.0 * center * twice + 2.0 * nu * center**3
        third = third + k * 8.0 * rest / (nu * (nu + 2.0) * (nu + 4.0))
    if not (variance > _ROUNDING).any():
        return None
    return mean, np.sqrt(variance), np.maximum(third / variance**1.5, 0.01)


def _traces(Q: Array, across: Array | None) -> tuple[Array, Array, Array]:
    """Return the traces of PΩ, (PΩ)² and (PΩ)³, P = 1 − QQ', of Q (…, n, p)."""
    n, rho = Q.shape[-2], _correlation(Q.shape[-2])
    if across is not None:
        left = _correlations(rho, across)
        left -= Q @ (Q.swapaxes(-1, -2) @ left)
        left -= (left @ Q) @ Q.swapaxes(-1, -2)
        return _trace(left), _inner(left, left), _inner(left @ left, left)

    def correlated(X: Array) -> Array:
        """Return ΩX."""
        z = recur(X, rho)
        z += recur(X[::-1], rho)[::-1]
        z -= X
        return z

    # of triples of rows 6 d (n − d) lie d apart
    d = np.arange(1.0, min(n, math.log(_NOTHING) / math.log(rho)))
    square = rho ** (2.0 * d) * (n - d)
    powers = n, n + 2.0 * square.sum(), n + 6.0 * (square @ d)
    once = correlated(Q)
    a, b, c = Q.T @ once, once.T @ once, once.T @ correlated(once)
    return (
        powers[0] - _trace(a),
        powers[1] - 2.0 * _trace(b) + _inner(a, a),
        powers[2] - 3.0 * _trace(c) + 3.0 * _inner(a, b) - _inner(a @ a, a),
    )


def _correlations(rho: float, across: Array) -> Array:
    """Return Ω (…, n, n) of misfits in the directions (…, n, C) of rows that follow one another."""
    rows = np.arange(across.shape[-2])
    return np.asarray(rho ** np.abs(rows[:, None] - rows) * (across @ across.swapaxes(-1, -2)))


def _trace(A: Array) -> Array:
    return np.asarray(np.einsum("...ii->...", A))


def _inner(A: Array, B: Array) -> Array:
    return np.asarray(np.einsum("...ij,...ij->...", A, B))


def slow_score(c: Calibration) -> float:
    """Return S of rows correlated as ρ^|j − k|."""
    plan, e, _ = residuals_in_order(c)
    if plan is None:
        return -math.inf
    if plan.slow is None:  # of many misfits: what their own test found
        return math.inf
    gains = _slow_gains(plan, e[plan.order][:, :, None])
    return float(gains[0]) - math.log(plan.freedom)


def _slow_gains(plan: Plan, e: Array) -> Array:
    """Return twice the gain (B,) in restricted likelihood of correlated rows, of e (n, M, B)."""
    best = np.zeros(e.shape[2])
    for rho in _CORRELATIONS:
        gain = np.zeros(e.shape[2])
        for outputs, Q in plan.groups:
            whiten, logs = _whitening(len(e), rho, plan.across)
            each = e[:, outputs]
            design, R = np.linalg.qr(whiten(Q))
            white = whiten(each.reshape(len(e), -1))
            white -= design @ (design.T @ white)
            left = np.einsum("nb,nb->b", white, white).reshape(each.shape[1:])
            ratio = left / np.einsum("nmb,nmb->mb", each, each)
            gain -= plan.nu * np.log(ratio).sum(axis=0)
            gain -= len(outputs) * 2.0 * (logs + float(np.log(np.abs(np.diag(R))).sum()))
        best = np.maximum(best, gain)
    return best


def _whitening(n: int, rho: float, across: Array | None) -> tuple[Callable[[Array], Array], float]:
    """Return what whitens rows (n, q) of a correlation, and half of its ln det."""
    if across is not None:
        L = np.linalg.cholesky(_correlations(rho, across))
        return partial(np.linalg.solve, L), float(np.log(np.diag(L)).sum())
    root = math.sqrt(1.0 - rho**2)

    def whiten(rows: Array) -> Array:
        return np.concatenate([rows[:1], (rows[1:] - rho * rows[:-1]) / root])

    return whiten, (n - 1.0) * math.log(root)


def _families(c: Calibration, p: int) -> list[_Family]:
    """Return the columns of every cause that these rows can have, p terms an output."""
    n, order = len(c.readings), time_order(c)
    f, start = c.reference[order], np.zeros(1, dtype=np.intp)
    t = np.arange(n, dtype=np.float64)
    time = c.readings.environment.get(TIME)
    if time is not None and np.isfinite(time).all() and np.ptp(time) > 0.0:
        t = np.asarray(time, dtype=np.float64)[order]
    families: list[_Family] = []
    if n >= _DOZEN:
        families = _in_time(t)
        after, wholly = _some(_LEAST, n - _LEAST), _some(p + 1, n - p - 1)
        turn = cross_matrix(-f)  # K_i (ω × f) = ω (f × K_i)
        families += [_Family("replaced", np.ones((n, 1)), after), _Family("slipped", turn, after)]
        if len(wholly):
            phi = c.model.basis(c.reference, c.readings.environment)[order]
            families.append(_Family("replaced", phi, wholly, wholly=True))
        families.append(_Family("settling", _held(f)[:, :, None], start))
        if APPROACH not in c.readings.environment:
            families.append(_Family("hysteresis", _sides(f), start))
    for code, base in _stated(c):
        families.append(_Family(code, base[order], start))
    return families


def _in_time(t: Array) -> list[_Family]:
    """Return a line over times (n,), and what has settled after shares of all of them."""
    after = (t - t[0]) / np.ptp(t)
    courses = [t - t.mean(), *(np.exp(-after / share) for share in _SETTLED)]
    return [_Family("drift", each[:, None], np.zeros(1, dtype=np.intp)) for each in courses]


def _held(f: Array) -> Array:
    """Return by how much the force before each row of f (…, n, 3) differs from its own."""
    return np.asarray(np.concatenate([f[..., :1, :], f[..., :-1, :]], axis=-2) - f)


def _sides(f: Array) -> Array:
    """Return from which side each component of f (…, n, 3) was approached (…, n, 3, 3).

    Nothing of the first row is known, and few rows of one side are as good as outliers.
    """
    side = np.sign(np.round(_held(f), _DIGITS))
    side[..., 0, :] = side[..., 1, :]
    ones = np.stack([(side > 0.0).sum(axis=-2), (side < 0.0).sum(axis=-2)])
    side = side * (ones.min(axis=0) >= _SIDED)[..., None, :]
    return np.asarray(np.eye(3) * side[..., None])


def _stated(c: Calibration) -> Iterable[tuple[str, Array]]:
    """Yield the columns of causes that need more than the order: approach, sd, attitudes, rolls."""
    n = len(c.readings)
    beside = c.readings.environment.items()
    sides = [side for name, side in beside if name.partition("_")[0] == APPROACH]
    sides = [side for side in sides if np.isfinite(side).all() and np.ptp(side) > 0.0]
    if sides:
        yield "hysteresis", np.column_stack(sides)
    sd = c.readings.sd
    if sd is not None:
        own = np.sqrt(np.einsum("nm,nm->n", sd, sd))
        if own.max() > UNEQUAL * median(own) > 0.0:
            yield "vibration", own[:, None] ** 2
    rotation = c.readings.rotation
    if rotation is not None and np.isfinite(rotation).all():
        yield "level", rotation[:, :, :2]
    if c.readings.up is None:
        return
    from multipos.positions.harmonics import find_rolls
    from multipos.uncertainty.turntable import table_effects

    rolls = tuple(roll for roll in find_rolls(c.readings) if len(roll.rows) >= _TURN)
    if rolls:
        yield "table", table_effects(c, rolls, np.eye(3)).reshape(n, 3, -1)


def _some(first: int, end: int) -> Rows:
    """Return rows from first to before end, no more than so many."""
    if end - first <= _MOST:
        return np.arange(first, max(end, first))
    return np.linspace(first, end - 1, _MOST).astype(np.intp)


class _Along(NamedTuple):
    """What lies along the normals of unknown orientations, rows in the order of time."""

    design: Array  # (…, n, p)
    misfit: Array  # (…, n)
    weight: Array  # of the outputs, (…, n, M)
    across: Array  # of their noise, of length one, (…, n, M)
    force: Array  # (…, n, 3)
    slopes: Array  # (…, M, 3)

    @classmethod
    def of_one(cls, c: Calibration, order: Rows) -> "_Along":
        """Return those of a calibration."""
        f, sd = c.reference[order], c.sd_of_readings[order]
        environment = {name: each[order] for name, each in c.readings.environment.items()}
        H = c.model.force_jacobian(c.parameters, f, environment)
        normal = np.linalg.solve(H.transpose(0, 2, 1), f[:, :, None])[:, :, 0]
        weight = normal / np.linalg.norm(normal * sd, axis=1, keepdims=True)
        design = weight[:, None] @ parameter_jacobian(c.model, c.parameters, f, environment)
        misfit = np.einsum("nm,nm->n", weight, c.residuals[order])
        return cls(design[:, 0], misfit, weight, weight * sd, f, c.sensitivity)

    @classmethod
    def of_units(cls, of: Solution, slopes: Array, order: Rows) -> "_Along":
        """Return those of solutions."""
        assert of.normal is not None
        assert of.rows is not None
        given = of.normal, of.push * of.variance, np.sqrt(of.variance), of.force
        weight, left, sd, force = (np.moveaxis(each[:, :, order], 0, 2) for each in given)
        misfit = np.einsum("bnm,bnm->bn", weight, left)
        design = of.rows[:, :, order].swapaxes(1, 2)
        return cls(design, misfit, weight, weight * sd, force, slopes)


def residuals_in_order(c: Calibration) -> tuple[Plan | None, Array, Array]:
    """Return the plan, whitened residuals (n, M) and slopes (M, 3) of a calibration.

    At unknown orientations the residuals are misfits along the force, as of one output.
    """
    if c.estimator is not Estimator.UNKNOWN:
        setting = _Setting(c)
        sd = c.sd_of_readings
        slopes = c.sensitivity if setting.weight is not None else c.sensitivity / sd[0][:, None]
        return _plan_of(setting), c.residuals / sd, slopes
    order = time_order(c)
    along = _Along.of_one(c, order)
    n, p = along.design.shape
    e, slopes = np.zeros((n, 1)), along.slopes[:1]
    if n - p < 1:
        return None, e, slopes
    Q = np.linalg.qr(along.design)[0]
    e[order, 0] = along.misfit - Q @ (Q.T @ along.misfit)
    groups = ((_ALONE, Q),)
    families = [
        _Family(family.code, _on_normals(family, along)[:, None], family.steps, family.wholly)
        for family in _families(c, p)
        if family.code not in _OF_ATTITUDE
    ]
    slow = None if n > _MOST else _law_of_slow(groups, along.across)
    given = families, groups, np.ones((1, 1)), slopes, slow, along.across
    return _planned(order, *given), e, slopes


def _on_normals(family: _Family, along: _Along) -> Array:
    """Return what a cause does to misfits along the force, (…, n, q)."""
    if family.wholly:  # but for a turn
        return along.design
    if family.apart:
        columns = family.base[:, :, None] * along.weight[..., None, :]
        return np.asarray(columns.reshape(*along.weight.shape[:-1], -1))
    base = _sides(along.force) if family.code == "hysteresis" else _held(along.force)[..., None]
    force = along.weight @ along.slopes  # what moves a misfit by as much as the outputs
    return np.asarray(np.einsum("...na,...naq->...nq", force, base))


def search_solutions(c: Calibration, of: Solution, slopes: Array) -> Mask:
    """Return which of B units at unknown orientations may have a cause.

    Positions are those of each unit, so that no plan serves two. Another unit that differs in its
    slopes alone is left to `search`: where its bias is another one, too, that is found here.

    Parameters
    ----------
    c : Calibration
        A unit whose rows are ordered as theirs.
    of : Solution
    slopes : (B, M, 3) array
    """
    along = _Along.of_units(of, slopes, time_order(c))
    count, n, p = along.design.shape
    if n - p < _FREE:
        return np.zeros(count, dtype=np.bool_)
    families = [family for family in _families(c, p) if family.code not in _OF_ATTITUDE]
    step = max(1, _AT_ONCE // n)
    parts = [slice(first, first + step) for first in range(0, count, step)]
    found = [_shown_along(families, _Along(*(e[units] for e in along))) for units in parts]
    return np.concatenate(found)


def _shown_along(families: list[_Family], along: _Along) -> Mask:
    """Return in which units (B,) a cause or slow noise is beyond what chance may do as well."""
    count, n, p = along.design.shape
    nu = float(n - p)
    Q, e = np.linalg.qr(along.design)[0], along.misfit[:, :, None]
    e = e - Q @ (Q.swapaxes(1, 2) @ e)
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    beyond = np.zeros(count, dtype=np.bool_)
    codes, numbers = _numbers(families)
    for family, tried in zip(families, numbers, strict=True):
        if family.wholly:
            continue
        explained, ranks = _explained_from(family.steps, _on_normals(family, along), Q, e)
        gain = -nu * np.log1p(-np.minimum(explained, 1.0 - _ROUNDING))
        for q in np.unique(ranks).tolist():
            beyond |= ((ranks == q) & (gain > _limit(q, nu, tried * codes))).any(axis=1)
    law = _law_of_slow(((_ALONE, Q),), along.across) if n <= _MOST else None
    if law is None:
        return beyond
    T = _inner(e, _correlations(_correlation(n), along.across) @ e)
    for unit in np.flatnonzero(law[0] + _SELDOM * law[1] < T).tolist():
        mean, sd, skewness = (float(each[unit]) for each in law)
        beyond[unit] |= T[unit] > _slow_limit(mean, sd, skewness, codes)
    return beyond


def _explained_from(steps: Rows, Z: Array, Q: Array, e: Array) -> tuple[Array, Array]:
    """Return Δ and q (B, K) of columns Z (B, n, q) from each of K rows on, of unit e (B, n, 1)."""
    (count, _, q), both = Z.shape, np.concatenate([Z, e, Q], axis=2)
    after, columns = np.empty((count, len(steps), q, both.shape[2])), Z.swapaxes(1, 2).copy()
    for k, step in enumerate(steps.tolist()):
        np.matmul(columns[:, :, step:], both[:, step:], out=after[:, k])
    gram, seen, across = after[..., :q], after[..., q], after[..., q + 1 :]
    size = np.einsum("bkqq->bkq", gram)
    scale = np.sqrt(np.where(size > 0.0, size, 1.0))
    left = gram - across @ across.swapaxes(2, 3)
    unit = left / (scale[..., :, None] * scale[..., None, :]) + _ROUNDING * np.eye(q)
    inverse, along = np.linalg.inv(unit), seen / scale
    explained = np.einsum("bkq,bkqr,bkr->bk", along, inverse, along)
    ranks = np.full(explained.shape, float(q))
    faint = ~(_trace(inverse) < 1.0 / _IDENTIFIABLE)  # no eigenvalue is less than 1/tr
    roots, ranks[faint] = _roots(left[faint], size[faint])
    explained[faint] = np.sum(np.einsum("uqr,ur->uq", roots, seen[faint]) ** 2, axis=1)
    return explained, ranks


def estimate(c: Calibration, cause: Cause) -> tuple[Array, Array]:
    """Return the sizes (M, q) of a cause, in reading units per unit of its column, and columns.

    Outputs that move together have one, (1, q); columns (n, …, q) are in the order of time.
    """
    plan, e, slopes = residuals_in_order(c)
    assert plan is not None
    return _sizes(plan, c, cause, e, slopes), plan.tests[cause.place].family.base


def _sizes(plan: Plan, c: Calibration, cause: Cause, e: Array, slopes: Array) -> Array:
    family = plan.tests[cause.place].family
    after = np.ones(len(e))
    if cause.row is not None:
        after[: int(np.flatnonzero(plan.order == cause.row)[0])] = 0.0
    e = e[None, plan.order]
    if not family.apart:
        Z = _moved(family.base, slopes) * (plan.weight * after[:, None])[:, :, None]
        return fit_sizes(plan.bases, Z[None], e)[0]
    Z = (family.base * after[:, None])[None, :, None] / c.sd_of_readings[plan.order][..., None]
    pairs = enumerate(plan.bases)
    return np.concatenate([fit_sizes([Q], Z[:, :, [i]], e[:, :, [i]])[0] for i, Q in pairs])

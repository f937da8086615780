"""Which units of a fleet may have a finding: one look at the residuals of many units.

- `unit_tests` returns what is worked out once, `UnitTests`; `find_in_units` what a look finds of
  each unit, `UnitFindings`, `find_in_expressions` of user-defined models.
- `lacking_in_batch` and `beyond_limit` are parts of it.

Causes are named in one place, by the `fit` of one unit (`multipos.diagnostics.examination`): a unit
in which any of them may be is fitted singly. What known positions alone decide is worked out once:
projections on missing terms, leverages, quantiles. The look is then contractions over units, of

- missing terms, by the score tests of `multipos.diagnostics.score_tests`;
- rows, by the squares of studentised residuals and by how few rows have most of all squares;
- repeats and orientation errors (`multipos.diagnostics.variances`);
- causes of time and table (`multipos.diagnostics.row_order`).

A fleet is of one kind of sensor, so that all units may lack the same term. Where a term a sensor
can have explains more than any other cause by S of eq. (3) of `multipos.diagnostics.row_order`, and
nothing else shows, it is what `fit` names, and no unit is fitted again for it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from multipos.diagnostics import projections
from multipos.diagnostics.model_error import are_better_with, columns_of
from multipos.diagnostics.row_order import Plan, plan_of, search_units
from multipos.diagnostics.score_tests import CLEAR, FINEST, LEVEL, explained_by, ratios_of
from multipos.diagnostics.variances import Residuals, across_the_force
from multipos.estimation import known
from multipos.estimation.batches import Estimates
from multipos.estimation.known import SharedDesign
from multipos.estimation.user_models import SharedExpression, cofactors
from multipos.fleets.grouping import ONE_TEMPERATURE
from multipos.numerics.arrays import COMPONENTS, Array, Mask, row_keys
from multipos.numerics.quantiles import chi2_quantile, f_log_tails, f_quantile, f_tail
from multipos.positions.headers import TEMPERATURE
from multipos.results import frozen
from multipos.sensor import fit_diagnostics, studentised
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator
from multipos.sensor.temperature import find_soaks

_NEAR = 0.05  # of ln p: what `f_log_tails` leaves open
DOUBTED = 1e-3  # of a limit: what noise that has converged leaves open of a test
_LEAST = 1e-300  # of a probability
_DOUBTFUL = 0.02  # level of causes: slopes and noise of a plan are those of another unit
_SPARE = 3.0  # degrees of freedom of an output: of fewer one is left beside a term, or none
_CLOSE = 1.0  # of S, within which causes are as good
_CONCENTRATED = 1.2, 1.55  # times the kurtosis of noise, where chi-squared rejects it, or not


@frozen
class UnitTests:
    """What the positions decide of the tests.

    Attributes
    ----------
    projection : Projection or None
        On the terms that the model lacks, if it lacks any.
    kinds : tuple of Kind
        These.
    soaks : bool
        A missing term of temperature may be a zero of each soak.
    leverage : (M, n) array
    repeats : (n,) array of int or None
        The number of the position of each row, where positions repeat.
    stated : bool
        Readings state a noise.
    order : Plan or None
        Of causes of time and table.
    of_causes : bool
        Whether what orientation errors do to residuals is no finding: they are estimated.
    """

    projection: projections.Projection | None
    kinds: tuple[projections.Kind, ...]
    soaks: bool
    leverage: Array
    repeats: NDArray[np.intp] | None
    stated: bool
    order: Plan | None
    of_causes: bool = False


class UnitFindings(NamedTuple):
    """Codes, each with the units (B,) that it is found of, and the units to be fitted singly."""

    found: dict[str, Mask]
    singly: Mask


def unit_tests(
    c: Calibration, shared: SharedDesign, *, of_causes: bool = False
) -> UnitTests | None:
    """Return the tests of units that share the positions of one that was fitted.

    None where readings are fitted robustly.
    """
    if c.estimator is not Estimator.LINEAR or c.robust_weight is not None:
        return None
    stated = c.noise is not None
    if stated and not projections.is_level(c):
        c = replace(c, readings=replace(c.readings, u=None), variance_components=None)
    temperature = c.readings.environment.get(TEMPERATURE)
    kinds = lacking_in_batch(c)
    try:
        projection = projections.project(projections.Setting(c, kinds, ())) if kinds else None
    except np.linalg.LinAlgError:
        projection = None
    if projection is not None and not len(projection.starts):
        projection = None
    columns = (c.readings.environment[name] for name in c.model.environment)
    keys = row_keys(np.column_stack([c.reference, *columns]))
    position = np.unique(np.array(keys), return_inverse=True)[1]
    return UnitTests(
        projection=projection,
        kinds=kinds,
        soaks=temperature is not None and find_soaks(temperature) is not None,
        leverage=np.stack([each.leverage for each in shared.by_output]),
        repeats=position if position.max() + 1 < len(position) else None,
        stated=stated,
        order=plan_of(c),
        of_causes=of_causes,
    )


def lacking_in_batch(c: Calibration) -> tuple[projections.Kind, ...]:
    """Return the kinds that a model lacks; of temperature where the units of a batch share it."""
    kinds = projections.lacking(c)
    temperature = c.readings.environment.get(TEMPERATURE)
    if TEMPERATURE in c.model.environment or temperature is None:
        return kinds
    if np.ptp(temperature) > ONE_TEMPERATURE:
        return kinds
    return tuple(kind for kind in kinds if TEMPERATURE not in kind.name)


def find_in_units(
    tests: UnitTests,
    shared: SharedDesign,
    values: tuple[Array, ...],
    found: Estimates,
    temperature: Sequence[Array] = (),
    rejected: Mask | bool = False,
) -> UnitFindings:
    """Return which of B units lack a term and nothing else, and which may have another finding.

    Parameters
    ----------
    tests : UnitTests
    shared : SharedDesign
    values : M arrays (B, n)
        Readings of each output.
    found : Estimates
    temperature : one array (B, n), or none
        Of each unit, where the model has no term of it. Units whose residuals follow it are fitted
        singly: the batch, whose units are each within `ONE_TEMPERATURE`, has no term to name.
    rejected : (B,) array of bool, optional
        Of which units chi-squared rejects the stated noise.
    """
    of = _weigh(tests, shared, found)
    warm = None
    if temperature and not any(TEMPERATURE in kind.name for kind in tests.kinds):
        weights = None if of.leverage is None or of.sd is None else of.sd**-2.0
        e = of.error if weights is None else of.residuals
        warm = _explained_by_temperature(shared, temperature[0], weights, e)
    significant, of_terms = _missing_terms(tests, shared, values, of, warm)
    named = significant.shape[1] - (0 if warm is None else warm.shape[1])
    singly = significant[:, named:].any(axis=1)
    lacks, significant = significant.any(axis=1), significant[:, :named]
    singly |= _beyond(shared, of.r2) | _are_concentrated(of.error, rejected)
    if tests.order is not None:
        cause = _best_cause(tests.order, of, _sensed(shared, found.sensitivity))
        singly |= (cause > -np.inf) & ~(lacks & (of_terms > cause + _CLOSE))
    if not tests.of_causes:
        singly |= _lack_of_fit(tests, shared, of.residuals)
        if not tests.stated and sorted(shared.model.axes) == list(COMPONENTS):
            singly |= _off_positions(shared, found.parameters, of.residuals) & ~lacks
    if tests.soaks or of.leverage is not None or shared.dof.min() < _SPARE:
        singly |= lacks
    asked = significant & ~singly[:, None]
    missing = _admissible(tests, shared, of.residuals, asked)
    return UnitFindings({"missing-term": missing}, singly)


def _are_concentrated(error: Array, rejected: Mask | bool) -> Mask:
    """Return in which units (B,) so few rows have the squares that outliers may hide one another.

    The mean over rows of q², q the share of a row in the squares of M outputs, is 1 + 2/M times
    that of equal rows, of normal noise.
    """
    m, count, n = error.shape
    share = np.zeros((count, n))
    for e in error:
        square = e**2
        share += square / np.maximum(square.sum(axis=1, keepdims=True), _LEAST)
    kurtosis = np.einsum("bn,bn->b", share, share) * n / m**2
    usual = 1.0 + 2.0 / m
    return np.asarray(kurtosis > np.where(rejected, *_CONCENTRATED) * usual)


def _sensed(shared: SharedDesign, sensitivity: Array) -> Array:
    """Return the slopes of outputs along all three axes (B, M, 3)."""
    slopes = np.zeros((*sensitivity.shape[:2], len(COMPONENTS)))
    slopes[:, :, list(shared.model.sensed_axes)] = sensitivity
    return slopes


def _best_cause(order: Plan, of: "_Weighed", slopes: Array) -> Array:
    """Return S (B,) of the best cause of time and table, −inf where chance does as well.

    Weights W leave residuals r with X'W r = 0, so that W r is as right of level weights; what
    causes have in common with it is that of W, their size that of its mean.
    """
    e = of.error
    if of.sd is not None:
        root = np.sqrt(np.mean(of.sd**-2.0, axis=2, keepdims=True))
        e, slopes = of.error / (of.sd * root), slopes * root[:, :, 0].T[:, :, None]
    return np.asarray(search_units(order, e, slopes, _DOUBTFUL).score.max(axis=0))


class _Weighed(NamedTuple):
    """Residuals of M outputs of B units, and what is tested of them.

    Attributes
    ----------
    residuals, error, r2 : (M, B, n) arrays
        As fitted, whitened, and the squares of studentised ones.
    sd : (M, B, n) or (M, B, 1) array, or None
        Of readings, if they state any.
    leverage : (M, B, n) array or None
    explained : (B, K, M) array or None
        By each kind of term; both where readings weigh unequally.
    """

    residuals: Array
    error: Array
    r2: Array
    sd: Array | None
    leverage: Array | None = None
    explained: Array | None = None


def _weigh(tests: UnitTests, shared: SharedDesign, found: Estimates) -> _Weighed:
    """Return the residuals of a batch, as its readings weigh."""
    dof = shared.dof[:, None, None]
    if found.variance is None and found.variances is not None and found.weighted is not None:
        sd, residuals = np.sqrt(found.variances), found.weighted
        error, leverage = residuals / sd, known.cofactors(shared, found.variances)[1]
        r2 = studentised.studentised_squares(error, leverage, dof)
        explained = _explained_under(tests, shared, 1.0 / found.variances, residuals)
        return _Weighed(residuals, error, r2, sd, leverage, explained)
    level = None if found.variance is None else np.sqrt(found.variance.T[:, :, None])
    error = found.residuals if level is None else found.residuals / level
    r2 = studentised.studentised_squares(error, tests.leverage[:, None], dof)
    return _Weighed(found.residuals, error, r2, level)


def _admissible(
    tests: UnitTests, shared: SharedDesign, residuals: Array, significant: Mask
) -> Mask:
    """Return of which units (B,) one of the kinds (B, K) is a term that a sensor can have."""
    found = np.zeros(len(significant), dtype=np.bool_)
    bases = [each.Q for each in shared.by_output]
    for place in np.flatnonzero(significant.any(axis=0)).tolist():
        assert tests.projection is not None
        name = tests.projection.names[place]
        if name in tests.projection.hidden:
            continue
        kinds = [kind for kind in tests.kinds if kind.name == name]
        units = np.flatnonzero(significant[:, place] & ~found)
        added = [
            columns_of(kinds, i, shared.reference, shared.environment) for i in range(len(bases))
        ]
        left = residuals[:, units].transpose(0, 2, 1)
        found[units] = are_better_with(bases, added, left)
    return found


def _missing_terms(
    tests: UnitTests,
    shared: SharedDesign,
    values: Sequence[Array],
    of: _Weighed,
    warm: Array | None = None,
) -> tuple[Mask, Array]:
    """Return of which units a kind of term is significant (B, K), and S (B,) of the best.

    `warm` (B, 2, M) is what the two kinds of temperature explain, if it is asked; they come last.
    """
    on, (m, count, _) = tests.projection, of.error.shape
    explained: Array = np.zeros((count, 0, m))
    q, left = np.zeros((0, m)), shared.dof
    if on is not None:
        explained = explained_by(on, of.error) if of.explained is None else of.explained
        q = on.q
    if warm is not None:
        explained = np.concatenate([explained, warm], axis=1)
        q = np.concatenate([q, np.ones((2, m))])
    if not q.size:
        return np.zeros((count, 0), dtype=np.bool_), np.full(count, -np.inf)
    whole = np.einsum("mbn,mbn->bm", of.error, of.error)[:, None]
    least_variance = np.zeros(1)
    if tests.stated:
        explained, whole = explained.sum(axis=2, keepdims=True), whole.sum(axis=2, keepdims=True)
        q, left = q.sum(axis=1, keepdims=True), left.sum(keepdims=True)
    else:
        least_variance = np.stack([np.square(np.ptp(y, axis=1) * FINEST) for y in values], axis=1)[
            :, None
        ]
    ratio, nu, tested = ratios_of(explained, whole, q, left, least_variance)
    ratio = np.where(tested, ratio, 0.0)
    logs = np.zeros(ratio.shape)
    for kind, output in np.argwhere((q > 0.0) & (nu >= 1.0)).tolist():
        dof = float(q[kind, output]), float(nu[kind, output])
        logs[:, kind, output] = f_log_tails(ratio[:, kind, output], *dof)
    total, used = np.where(tested, logs, 0.0).sum(axis=2), tested.sum(axis=2)
    limit = _limits(used)
    for unit, kind in np.argwhere(np.abs(total - limit) <= _NEAR).tolist():
        outputs = np.flatnonzero(tested[unit, kind]).tolist()
        exact = [f_tail(ratio[unit, kind, i], q[kind, i], nu[kind, i]) for i in outputs]
        total[unit, kind] = sum(math.log(max(tail, _LEAST)) for tail in exact)
    significant = total < limit
    best = np.argmin(np.where(significant, total - limit, np.inf), axis=1)
    units = np.arange(count)
    columns = np.where(tested, q, 0.0)[units, best]
    after = nu[best]
    gain = (columns + after) * np.log1p(
        columns * ratio[units, best] / np.where(columns > 0.0, after, 1.0)
    )
    score = np.where(columns > 0.0, gain, 0.0).sum(axis=1)
    score -= columns.sum(axis=1) * math.log(float(np.sum(left)))
    return significant, score - 2.0 * np.log(np.maximum(np.sum(used > 0, axis=1), 1))


def _scores(
    Q: Array, terms: Sequence[Array], weight: Array, error: Array
) -> tuple[list[Array], Array]:
    """Return Δ (B,) of each kind of terms (n, q), and e'e (B,), under weights (B, n) of units.

    By sums of products of the design Q and the terms, with residuals (B, n) of whatever weights.
    """
    A, p = np.concatenate([Q, *terms], axis=1), Q.shape[1]
    count, k = len(weight), A.shape[1]
    G = (weight @ (A[:, :, None] * A[:, None]).reshape(len(A), -1)).reshape(count, k, k)
    g = ((weight * error) @ A)[:, :, None]
    fitted = np.linalg.solve(G[:, :p, :p], np.concatenate([G[:, :p, p:], g[:, :p]], axis=2))
    V = G[:, p:, p:] - G[:, p:, :p] @ fitted[:, :, :-1]
    along = (g[:, p:] - G[:, p:, :p] @ fitted[:, :, -1:])[:, :, 0]
    whole = np.einsum("bn,bn->b", weight, error * error)
    whole -= np.einsum("bp,bp->b", g[:, :p, 0], fitted[:, :, -1])
    explained, first = [], 0
    for each in terms:
        mine = slice(first, first + each.shape[1])
        first = mine.stop
        inverse = np.linalg.pinv(V[:, mine, mine], rcond=projections.IDENTIFIABLE, hermitian=True)
        explained.append(np.einsum("bq,bqr,br->b", along[:, mine], inverse, along[:, mine]))
    return explained, whole


def _explained_under(
    tests: UnitTests, shared: SharedDesign, weights: Array, residuals: Array
) -> Array | None:
    """Return Δ (B, K, M) of the kinds under weights (M, B, n) of units; None where none lack."""
    on = tests.projection
    if on is None:
        return None
    explained = np.zeros((residuals.shape[1], on.q.size))
    blocks = np.split(on.rows, on.starts[1:])
    outputs = on.place % on.q.shape[1]
    for i, each in enumerate(shared.by_output):
        mine = np.flatnonzero(outputs == i)
        if len(mine):
            scores, _ = _scores(each.Q, [blocks[b].T for b in mine], weights[i], residuals[i])
            explained[:, on.place[mine]] = np.stack(scores, axis=1)
    return explained.reshape(-1, *on.q.shape)


def beyond_limit(ratio: Array, q: Array, free: Array, asked: Mask) -> tuple[Mask, Mask]:
    """Return which R (B, K) are significant among those asked of a unit, and which nearly so."""
    significant, close = np.zeros_like(asked), np.zeros_like(asked)
    number = np.broadcast_to(asked.sum(axis=1, keepdims=True), asked.shape)
    for each in {*zip(q[asked], free[asked], number[asked], strict=True)}:
        columns, dof, tests = map(float, each)
        limit = f_quantile((1.0 - LEVEL) ** (1.0 / tests), columns, dof)
        mine = asked & (q == columns) & (free == dof) & (number == tests)
        significant |= mine & ~(ratio < limit)
        close |= mine & (np.abs(ratio - limit) < DOUBTED * limit)
    return significant, close


def find_in_expressions(
    kinds: Sequence[projections.Kind], shared: SharedExpression, found: Estimates
) -> UnitFindings:
    """Return of which units (B,) of a user-defined model terms are missing.

    The score test has the derivatives of each unit. Fitted singly are those in which a term that
    the positions hardly show is significant, and all that lie beyond the first bound of outliers
    and lack of fit.
    """
    m, count, n = found.residuals.shape
    columns = np.column_stack([shared.reference, *shared.environment.values()])
    repeats = np.unique(np.array(row_keys(columns)), return_inverse=True)[1]
    shape = count, len(kinds)
    gain, freedom, least = np.zeros(shape), np.zeros(shape), np.ones(shape)
    singly: Mask = np.zeros(count, dtype=np.bool_)
    left = 0.0
    for i, A in enumerate(shared.respond(found.parameters)[1]):
        e, nu = found.residuals[i], float(n - A.shape[2])
        left += nu
        cofactor = cofactors(A)
        leverage = np.sum((A @ cofactor) * A, axis=2)
        r2 = studentised.studentised_squares(e, leverage, np.full(1, nu))
        singly |= ~(r2 <= _limit(nu, m * n)).all(axis=1)
        tested = fit_diagnostics.lack_of_fit_ratios(e, repeats, A.shape[2], np.ones(n))
        if tested is not None:
            f, lack, pure = tested
            singly |= ~(f <= f_quantile(1.0 - LEVEL / m, float(lack), float(pure)))
        variance = np.maximum(np.einsum("bn,bn->b", e, e) / nu, _LEAST)
        for k, kind in enumerate(kinds):
            Z = columns_of([kind], i, shared.reference, shared.environment)
            if not Z.shape[1]:
                continue
            Z = Z / np.maximum(np.linalg.norm(Z, axis=0), _LEAST)
            across = Z.T @ A
            gram = Z.T @ Z - across @ cofactor @ across.transpose(0, 2, 1)
            sizes, vectors = np.linalg.eigh(gram)
            seen = sizes > projections.IDENTIFIABLE
            along = (e[:, None] @ (Z @ vectors))[:, 0] ** 2 / np.where(seen, sizes, np.inf)
            gain[:, k] += along.sum(axis=1) / variance
            freedom[:, k] += seen.sum(axis=1)
            least[:, k] = np.minimum(least[:, k], sizes[:, 0])
    ratio, free, asked = ratios_of(gain, left, freedom, left, np.zeros(1))
    significant, _ = beyond_limit(ratio, freedom, free, asked)
    singly |= (significant & (least < CLEAR)).any(axis=1)
    missing: Mask = np.asarray(significant.any(axis=1))
    return UnitFindings({"missing-term": missing}, singly)


def _explained_by_temperature(
    shared: SharedDesign, temperature: Array, weights: Array | None, errors: Array
) -> Array:
    """Return what temperatures (B, n) of units, alone and times the own axis, explain (B, 2, M).

    Of errors (M, B, n) under weights (M, B, n), which leave nothing along the design; NaN where
    the design has it all.
    """
    warmth = temperature - temperature[:, :1]
    explained = np.empty((len(warmth), 2, len(errors)))
    for i, (each, e) in enumerate(zip(shared.by_output, errors, strict=True)):
        own = shared.reference[:, COMPONENTS.index(shared.model.axes[i])]
        w = None if weights is None else weights[i]
        push = e if w is None else w * e
        for place, column in enumerate((warmth, warmth * own)):
            weighed = column if w is None else w * column
            along = weighed @ each.Q
            follows = along if w is None else _solved_under(each.Q, w, along)
            size = np.einsum("bn,bn->b", column, weighed)
            across = size - np.einsum("bp,bp->b", along, follows)
            varies = across > projections.IDENTIFIABLE * size
            score = np.einsum("bn,bn->b", column, push) ** 2
            explained[:, place, i] = np.where(varies, score / np.where(varies, across, 1.0), np.nan)
    return explained


def _solved_under(Q: Array, weight: Array, right: Array) -> Array:
    """Return (Q'WQ)⁻¹ right (B, p) under weights (B, n)."""
    products = (Q[:, :, None] * Q[:, None]).reshape(len(Q), -1)
    gram = (weight @ products).reshape(-1, Q.shape[1], Q.shape[1])
    return np.asarray(np.linalg.solve(gram, right[:, :, None])[:, :, 0])


def _limits(used: NDArray[np.intp]) -> Array:
    """Return ln p of so many outputs together (B, K), below which a kind is significant."""
    limit = np.full(used.shape, -np.inf)
    numbers = np.sum(used > 0, axis=1)
    for number in np.unique(numbers[numbers > 0]).tolist():
        level = 1.0 - (1.0 - LEVEL) ** (1.0 / number)
        for outputs in np.unique(used[used > 0]).tolist():
            beyond = math.log(level)
            if outputs > 1:
                beyond = -0.5 * chi2_quantile(1.0 - level, 2.0 * outputs)
            limit[(numbers == number)[:, None] & (used == outputs)] = beyond
    return limit


def _beyond(shared: SharedDesign, r2: Array) -> Mask:
    """Return in which units (B,) a studentised square (M, B, n) is beyond the 1 % point."""
    limit = np.array([_limit(float(nu), len(r2) * r2.shape[2]) for nu in shared.dof.tolist()])
    return np.asarray((r2 > limit[:, None, None]).any(axis=(0, 2)))


@lru_cache(64)
def _limit(nu: float, readings: int) -> float:
    return studentised.largest_square(nu, readings) if nu >= 2.0 else math.inf


def _off_positions(shared: SharedDesign, parameters: Array, residuals: Array) -> Mask:
    """Return of which units residuals lie across the force, as orientation errors make them."""
    model, (_, count, n) = shared.model, residuals.shape
    rows = 1 if model.is_linear else n  # of one slope all have it
    force = np.ascontiguousarray(
        np.broadcast_to(shared.reference[:rows].T[:, None], (3, count, rows))
    )
    slopes = model.force_slopes(model.coefficients(parameters), force, shared.environment)
    of = Residuals(
        error=np.moveaxis(residuals, 0, 2),
        basis=shared.basis,
        columns=model.columns,
        slopes=slopes.transpose(2, 3, 0, 1),
        force=shared.reference,
    )
    return across_the_force(of)


def _lack_of_fit(tests: UnitTests, shared: SharedDesign, residuals: Array) -> Mask:
    """Return of which units repeats agree better than the model meets them."""
    beyond = np.zeros(residuals.shape[1], dtype=np.bool_)
    if tests.repeats is None:
        return beyond
    for each, design in zip(residuals, shared.designs, strict=True):
        tested = fit_diagnostics.lack_of_fit_ratios(
            each, tests.repeats, design.shape[1], np.ones(len(design))
        )
        if tested is not None:
            f, lack, pure = tested
            limit = f_quantile(1.0 - LEVEL / len(residuals), float(lack), float(pure))
            beyond |= f > limit
    return beyond

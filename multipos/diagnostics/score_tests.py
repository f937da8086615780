"""Does the model lack a term? Score tests of all that it could have, from one projection.

`judge_model` tests every kind of term that a model lacks and `judge_included` those of higher order
that it has; `significant` picks the tests beyond chance, and `score_of_term` is S of the best.
`explained_by` and `ratios_of` are Δ and R of many units.

About a solution the readings have whitened residuals e, the whitened design X of the parameters
(and of what positions share), and terms that the model lacks would add columns Z. With

    V = Z − X X⁺Z,    Δ = e'V (V'V)⁻¹ V'e,    R = (Δ/q) / ((e'e − Δ)/ν),                    (1)

R follows F(q, ν) if nothing is in the terms, q the rank of V and ν what is left of the degrees of
freedom: no model is fitted again, and at known orientations (1) is the F test of nested models.
- Known orientations without a stated noise: each output has a scatter and so an R of its own.
- Elsewhere outputs are whitened by what was found of their noise and share one R. Uncertain and
  unknown orientations have the marginal weights W_k of `multipos.estimation.likelihood`, so that
  V'V = Z'WZ − Z'WA S⁻¹ A'WZ, and V'e = Z'Σ⁻¹r − Z'WA S⁻¹ A'Σ⁻¹r.
- Rows that are correlated count as the effective number of them: R is multiplied by their share in
  all rows, and so is ν; unless a term explains the residuals better than the correlation, by S of
  `multipos.diagnostics.row_order`.

What positions cannot show, and how V is made and kept, is said in
`multipos.diagnostics.projections`.

References
----------
C. R. Rao 1948, Proc. Cambridge Phil. Soc. 44, 50 (the score test); IEEE Std 1293 (the terms).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from multipos.diagnostics import projections, row_order
from multipos.estimation.gains import AtSolution, information_at_solution
from multipos.estimation.likelihood import respond
from multipos.estimation.problem import Problem
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.rotations import directions
from multipos.numerics.terms import kind_terms
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.fit_diagnostics import ModelTest
from multipos.sensor.found import Estimator
from multipos.sensor.inverse import inverses

_Kinds = tuple[projections.Kind, ...]

LEVEL = 0.01  # chance that a model that lacks nothing is said to lack something
# of the readings' span: what scatters less is rounded, and rounding follows no law
FINEST = 3e-7
_SPARSE = 0.1  # of the level, where next to nothing is left to judge by
_LARGEST = 1e30  # of R, where nothing is left
_SLIGHT = 0.02  # mean square of a term at the positions, a third of what x y has all around
CLEAR = 0.005  # of a column's square: with as much left of it no term is hidden


@frozen(eq=True)
class Tested:
    """What was tested, and the kinds of terms that the positions do not show."""

    tests: tuple[ModelTest, ...]
    hidden: tuple[str, ...]


def judge_model(
    c: Calibration, added: tuple[str, ...] = (), at_solution: AtSolution | None = None
) -> Tested:
    """Test every kind of term that the model lacks, by eq. (1).

    Parameters
    ----------
    c : Calibration
    added : tuple of str
        Kinds that are taken as if the model had them.
    at_solution : function, optional
        Returns what `information_at_solution` does.
    """
    kinds = projections.lacking(c)
    alone = (c.estimator.exact or c.by_own_axes) and c.model.has_terms
    identifiable = bool((np.isfinite(c.residual_sd) & (c.residual_sd > 0.0)).all())
    identifiable = alone or (
        identifiable and (c.robust_weight is None or c.robust_weight.ndim == 1)
    )
    if not kinds or not identifiable:
        return Tested((), ())
    try:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            tested = _at_known(c, kinds, added) if alone else _as_one(c, kinds, added, at_solution)
    except np.linalg.LinAlgError:  # as good as singular: nothing can be said of what is beside it
        return Tested((), ())
    if c.by_own_axes:  # residuals along own axes are none
        return replace(tested, tests=())
    if not c.effective_rows or _beats_slow_noise(c, tested.tests):
        return tested
    share = min(c.effective_rows.values()) / len(c.residuals)
    return replace(tested, tests=tuple(_of_fewer(test, share) for test in tested.tests))


def judge_included(c: Calibration) -> tuple[ModelTest, ...]:
    """Test the second- and third-order terms that the model has, outputs together.

    With b the coefficients of a kind of term and C their covariance, R = b'C⁻¹b/q (Wald); at known
    orientations without a stated noise each output has one of its own, as in eq. (1).
    """
    alone = c.estimator.exact and c.noise is None
    tests = []
    for kind in projections.OF_FORCE[projections.OF_FORCE.index("own^2") :]:
        places = [
            [c.model.keys.index((output, term)) for term in kind_terms(kind, axis, c.model.inputs)]
            for output, axis, own in zip(c.outputs, c.model.axes, c.model.terms, strict=True)
            if set(kind_terms(kind, axis, c.model.inputs)) <= set(own)
        ]
        if len(places) < len(c.outputs) or not any(places):
            continue
        blocks = [each for each in places if each]
        if not alone:
            blocks = [[i for each in blocks for i in each]]
        ratios = [_wald(c.parameters[i], c.covariance[np.ix_(i, i)]) for i in blocks]
        dofs = tuple((float(len(i)), float(c.parameter_dof[i].min())) for i in blocks)
        tests.append(ModelTest(kind, c.outputs if alone else (), tuple(ratios), dofs))
    return tuple(tests)


def _wald(b: Array, covariance: Array) -> float:
    """Return b'C⁻¹b/q; NaN where C has no inverse, as of readings that are fitted exactly."""
    try:
        return float(b @ np.linalg.solve(covariance, b)) / len(b)
    except np.linalg.LinAlgError:
        return math.nan


def _beats_slow_noise(c: Calibration, tests: tuple[ModelTest, ...]) -> bool:
    """Tell whether a term explains what was taken for correlated rows.

    A scheme in its published order turns a missing term into steps, which look like slow noise.
    """
    return bool(significant(tests)) and score_of_term(c, tests) >= row_order.slow_score(c)


def score_of_term(c: Calibration, tests: Sequence[ModelTest]) -> float:
    """Return S of `multipos.diagnostics.row_order` of the best of significant tests."""
    of_misfits = c.estimator is Estimator.UNKNOWN
    freedom = float((len(c.residuals) if of_misfits else c.residuals.size) - len(c.parameters))
    best = significant(tests)[0]
    columns = sum(each for each, _ in best.dofs)
    return best.gain + columns * (2.0 - math.log(freedom)) - 2.0 * math.log(len(tests))


def _of_fewer(test: ModelTest, share: float) -> ModelTest:
    """Return a test as if there were only the effective number of correlated rows."""
    return replace(
        test,
        ratios=tuple(ratio * share for ratio in test.ratios),
        dofs=tuple((q, max(nu * share, 1.0)) for q, nu in test.dofs),
    )


def significant(tests: Sequence[ModelTest]) -> tuple[ModelTest, ...]:
    """Return the tests that chance alone passes once in a hundred sets of tests, the best first.

    The best is the least probable; where probabilities are too small for numbers, what gains most.
    """
    if not tests:
        return ()
    level = 1.0 - (1.0 - LEVEL) ** (1.0 / len(tests))
    found = (t for t in tests if t.p < (_SPARSE * level if is_sparse(t) else level))
    return tuple(sorted(found, key=lambda t: (t.p, -t.gain)))


def is_sparse(test: ModelTest) -> bool:
    """Tell whether an output has one number left to judge by, as at six faces.

    Noise that is larger at some positions than at others explains as much there.
    """
    return min(nu for _, nu in test.dofs) < 2.0


def _at_known(c: Calibration, kinds: _Kinds, added: tuple[str, ...]) -> Tested:
    """Test at known orientations, with a projection that is kept from one fit to the next."""
    found = projections.project(projections.Setting(c, kinds, added))
    if not len(found.starts):
        return Tested((), found.hidden)
    e = found.whitened(c.residuals) * projections.level_of(c)
    if added or c.estimator is Estimator.CLOSED_FORM or c.robust_weight is not None:
        pairs = zip(found.fitted, e.T, strict=True)  # such residuals are not orthogonal to X
        e = np.column_stack([column - Q @ (Q.T @ column) for Q, column in pairs])
    (explained,) = explained_by(found, e.T[:, None])
    whole, q, left = np.einsum("nm,nm->m", e, e), found.q, found.left
    if c.noise is None:
        least_variance = np.square(np.ptp(c.readings.values, axis=0) * FINEST)
        tests = _ratios(found.names, c.outputs, explained, whole, q, left, least_variance)
        return Tested(tests, found.hidden)
    explained, q = explained.sum(axis=1, keepdims=True), q.sum(axis=1, keepdims=True)
    one = _ratios(found.names, (), explained, whole.sum(), q, left.sum(), np.zeros(1))
    return Tested(one, found.hidden)


def explained_by(found: projections.Projection, errors: Array) -> Array:
    """Return Δ of eq. (1) (B, kinds, outputs) of B units, by whitened residuals (outputs, B, n)."""
    explained = np.zeros((errors.shape[1], found.q.size))
    along = np.empty((errors.shape[1], len(found.rows)))
    for mine, each in zip(found.of_outputs, errors, strict=True):
        along[:, mine] = each @ found.rows[mine].T
    explained[:, found.place] = np.add.reduceat(along**2, found.starts, axis=1)
    return explained.reshape(-1, *found.q.shape)


def ratios_of(
    explained: Array, whole: Array | float, q: Array, left: Array | float, least_variance: Array
) -> tuple[Array, Array, Mask]:
    """Return R of eq. (1) (…, kinds, outputs), ν, and where there is such a test."""
    nu = left - q
    rest = np.maximum(whole - explained, nu * least_variance)
    tested = (q > 0.0) & (nu >= 1.0) & (rest > 0.0) & np.isfinite(explained)
    safe = np.where(tested, rest, 1.0)
    ratio = np.minimum(explained * nu / (np.where(tested, q, 1.0) * safe), _LARGEST)
    return ratio, nu, tested


def _ratios(
    kinds: Sequence[str],
    outputs: tuple[str, ...],
    explained: Array,
    whole: Array | float,
    q: Array,
    left: Array | float,
    least_variance: Array,
) -> tuple[ModelTest, ...]:
    """Return R of eq. (1) for kinds (K, B) of outputs, or of all as one."""
    ratio, nu, tested = ratios_of(explained, whole, q, left, least_variance)
    tests = []
    for kind, chosen, fs, qs, nus in zip(
        kinds, tested.tolist(), ratio.tolist(), q.tolist(), nu.tolist(), strict=True
    ):
        rows = [i for i, keep in enumerate(chosen) if keep]
        if rows:
            tests.append(
                ModelTest(
                    kind,
                    tuple(outputs[i] for i in rows if outputs),
                    tuple(fs[i] for i in rows),
                    tuple((qs[i], nus[i]) for i in rows),
                )
            )
    return tuple(tests)


@frozen
class _Sums:
    """What eq. (1) is made of, with Z in R columns and the p unknowns of the solution.

    Attributes
    ----------
    gram, score : (R, R), (R,) arrays
        V'V and V'e.
    size : (R,) array
        Squares of the columns of Z.
    across : (p, R) array
        X⁺Z.
    information : (p, p) array
        X'X.
    kind_of : (R,) array of int
        The kind of each column.
    whole, left, least_variance : float
        e'e, degrees of freedom without the terms, and the least that one of them may leave.
    """

    gram: Array
    score: Array
    size: Array
    across: Array
    information: Array
    kind_of: Places
    whole: float
    left: float
    least_variance: float = 0.0


def _as_one(
    c: Calibration, kinds: _Kinds, added: tuple[str, ...], at_solution: AtSolution | None = None
) -> Tested:
    """Test all outputs as one, about the solution."""
    plain = c.estimator.exact and c.robust_weight is None
    plain = plain and (c.noise is None or c.noise.ndim == 1)
    sums = _sums_at_known(c, kinds) if plain else _sums_of_likelihood(c, kinds, at_solution)
    gram, score, kind_of = sums.gram, sums.score, sums.kind_of
    whole, left = sums.whole, sums.left
    names = [kind.name for kind in kinds]
    for name in added:  # fitted beside the parameters
        T = _identifiable(gram, sums.size, kind_of == names.index(name))
        along = T.T @ score
        score, gram = score - gram @ T @ along, gram - gram @ T @ (T.T @ gram)
        whole, left = whole - float(along @ along), left - T.shape[1]
    explained, q, least = _explained(gram, score, sums.size, kind_of, len(kinds))
    asked = np.array([name not in added for name in names])
    explained, q = explained * asked, q * asked
    least[_slight(c, kinds)] = 0.0
    faint = [k for k, name in enumerate(names) if least[k] < CLEAR and name in projections.OF_FORCE]
    hidden: tuple[str, ...] = ()
    if faint and not added:
        some = np.flatnonzero((kind_of[:, None] == faint).any(axis=1))
        shown = gram[some[:, None], some], sums.across[:, some], sums.information
        hidden = _hidden(c, [kinds[k] for k in faint], *shown)
    least_variance = np.full(1, sums.least_variance)
    alone = explained[:, None], whole, q[:, None], left, least_variance
    return Tested(_ratios(names, (), *alone), hidden)


def _slight(c: Calibration, kinds: _Kinds) -> list[int]:
    """Return the kinds of which a term is hardly applied: what is left of little is little."""
    Z, _, kind_of = projections.terms_of(kinds, c.reference, c.readings.environment)
    return [int(kind) for kind in np.unique(kind_of[np.mean(Z**2, axis=1) < _SLIGHT])]


def _sums_at_known(c: Calibration, kinds: _Kinds) -> _Sums:
    """Return the sums where positions are exact: of each output by itself, (A, Z, e)'(A, Z, e)."""
    shape, p = c.residuals.shape, len(c.parameters)
    variances = np.square(c.residual_sd) if c.noise is None else c.noise.reshape(shape)
    root = np.broadcast_to(1.0 / np.sqrt(variances), shape)
    outputs, blocks = c.model.respond(c.parameters, c.reference, c.readings.environment)
    left = c.readings.values - outputs
    Z, output_of, kind_of = projections.terms_of(kinds, c.reference, c.readings.environment)
    end = p + len(kind_of)
    whole = np.zeros((end + 1, end + 1))
    for i, (own, slopes) in enumerate(blocks):
        mine = np.flatnonzero(output_of == i)
        rows = np.concatenate([slopes.T, Z[mine], left[None, :, i]]) * root[:, i]
        places = np.concatenate([own, p + mine, [end]])
        whole[places[:, None], places] += rows @ rows.T
    cross, information = whole[:p, p:end], whole[:p, :p]
    information.flat[:: p + 1] += c.model.beliefs
    across = respond(information, cross)
    return _Sums(
        gram=whole[p:end, p:end] - cross.T @ across,
        score=whole[p:end, end] - across.T @ whole[:p, end],
        size=whole.diagonal()[p:end],
        across=across,
        information=information,
        kind_of=kind_of,
        whole=float(whole[end, end]),
        left=float(left.size - p),
    )


def _sums_of_likelihood(
    c: Calibration, kinds: _Kinds, at_solution: AtSolution | None = None
) -> _Sums:
    """Return the sums with the marginal weights of the likelihood."""
    problem, optimum = at_solution() if at_solution else information_at_solution(c)
    Z, output_of, kind_of = projections.terms_of(kinds, c.reference, c.readings.environment)
    beside = optimum.with_slopes(Z, output_of)
    across = respond(optimum.information, beside.cross)
    return _Sums(
        gram=beside.gram - beside.cross.T @ across,
        score=beside.score - across.T @ beside.own,
        size=beside.gram.diagonal(),
        across=across,
        information=optimum.information,
        kind_of=kind_of,
        whole=float(np.sum(optimum.point.q)) + _of_priors(c, problem),
        left=float(problem.degrees[problem.weight == 1.0].sum()) - problem.unknowns,
        # what was stated of positions is a lower bound: less is no finer scale to judge by
        least_variance=float(problem.has_prior),
    )


def _of_priors(c: Calibration, problem: Problem) -> float:
    """Return what steps and tilt add to F, which is stated about the solution itself."""
    found = c.orientations
    if found is None or not problem.has_prior:
        return 0.0
    total = 0.0
    if found.orientation_error_deg is not None:
        steps = np.radians(np.nan_to_num(found.orientation_error_deg))
        total += float(problem.prior @ steps**2)
    if found.level_tilt_deg is not None and found.level_sd_deg:
        total += float(np.sum((found.level_tilt_deg / found.level_sd_deg) ** 2))
    return total


def _scale(size: Array) -> Array:
    """Return the lengths of columns by their squares, 1 of a column of nothing."""
    return np.where(size > 0.0, np.sqrt(np.maximum(size, 0.0)), 1.0)


def _explained(
    gram: Array, score: Array, size: Array, kind_of: Places, kinds: int
) -> tuple[Array, Array, Array]:
    """Return Δ, q and the least part that is left of a term, (K,) each, of every kind."""
    explained, q, least = np.zeros(kinds), np.zeros(kinds), np.zeros(kinds)
    columns: list[list[int]] = [[] for _ in range(kinds)]
    for column, kind in enumerate(kind_of.tolist()):
        columns[kind].append(column)
    alike: dict[int, list[int]] = {}
    for kind, mine in enumerate(columns):
        alike.setdefault(len(mine), []).append(kind)
    scale = _scale(size)
    unit, score = gram / (scale[:, None] * scale), score / scale
    for some in alike.values():  # kinds of as many terms at once
        places = np.array([columns[kind] for kind in some])
        values, vectors = np.linalg.eigh(unit[places[:, :, None], places[:, None, :]])
        identifiable = values > projections.IDENTIFIABLE
        along = np.einsum("kr,krs->ks", score[places], vectors)
        explained[some] = np.sum(along**2 / np.where(identifiable, values, np.inf), axis=1)
        q[some], least[some] = identifiable.sum(axis=1), values[:, 0]
    return explained, q, least


def _identifiable(gram: Array, size: Array, mine: Mask) -> Array:
    """Return T (R, r) of the terms of a kind, T'GT = 1."""
    scale = _scale(size)
    values, vectors = np.linalg.eigh((gram / (scale[:, None] * scale))[mine][:, mine])
    seen = values > projections.IDENTIFIABLE
    result = np.zeros((len(size), int(seen.sum())))
    result[mine] = vectors[:, seen] / np.sqrt(values[seen]) / scale[mine, None]
    return result


def _hidden(
    c: Calibration,
    kinds: Sequence[projections.Kind],
    gram: Array,
    across: Array,
    information: Array,
) -> tuple[str, ...]:
    """Return which kinds are hidden, as far as force is concerned.

    Where nothing ties the case to the world, only the size of a force is judged: its direction
    has a rotation in it that is a convention.
    """
    force, means = projections.sphere(c)
    p = len(c.parameters)
    by_force = c.model.force_jacobian(c.parameters, force, means)
    inverse = inverses(by_force[:, :, list(c.model.sensed_axes)])
    if c.model.gauge is not None:
        inverse = directions(force)[:, None, :] @ inverse
    moved = np.zeros((*inverse.shape[:2], p))
    for i, (places, slopes) in enumerate(c.model.respond(c.parameters, force, means)[1]):
        moved[:, :, places] += inverse[:, :, i, None] * slopes[:, None, :]
    Z, output_of, kind_of = projections.terms_of(kinds, force, means)
    whole = inverse[:, :, output_of] * Z.T[:, None, :]
    moved = moved.reshape(-1, p)
    error = whole - (moved @ across[:p]).reshape(whole.shape)
    covariance = np.linalg.inv(information)[:p, :p]
    size = float(np.sum((moved @ covariance) * moved)) / len(moved)
    found = []
    for k, kind in enumerate(kinds):
        mine = kind_of == k
        wrong, all_of_it = (
            np.sqrt(part.shape[1]) * part[:, :, mine].reshape(-1, int(mine.sum()))
            for part in (error, whole)
        )
        if projections.hides(gram[np.ix_(mine, mine)], wrong, all_of_it, size):
            found.append(kind.name)
    return tuple(found)

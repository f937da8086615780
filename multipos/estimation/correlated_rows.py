"""Rows of one record in the order of time, whose noise is correlated from row to row.

`are_asked` tells whether rows can show correlation, `find_correlated` whether they do, and
`spread_correlation` puts it into a solution; `order_in_time` is the order of rows with a time, for
which `spread_in_time` is how much longer U is. `sd_of_rows` is what rows scatter.

A record given row by row, many rows a position, has n rows and far less than n independent ones:
u by the scatter of rows alone is then too small. Where rows repeat positions, the scatter within
positions tells noise from what the model lacks. Its sums S_b over runs of m rows,

    Σ S_b² / s² Σ (m − Σ_j n_bj²/n_j)     over runs b, n_bj of the n_j rows of position j,  (1)

follow χ² on the number of runs, over that number, where rows are independent, m = 2, 4, 8, …; rows
of unknown orientation show it by their misfit along the force u, of which no mean is taken. Where a
sum is beyond chance at known orientations, noise is taken as slow noise and white noise together,

    e_k − ρ e_{k−1} = w_k − θ w_{k−1},     0 ≤ θ ≤ ρ < 1,                                   (2)

whose covariance R is known for any ρ and θ. The estimate stays least squares, b = B e off the truth
with B = (X'X)⁻¹X', so that for the variance s²
that rows leave when whitened by the law,

    cov b = s² B R B'.                                                                      (3)

The law is not decided upon but integrated over by its restricted likelihood and Jeffreys' prior of
a long correlation, dρ (1 − ρ)^−½, at nodes even in ln(1 − ρ) up to times longer than the record. So
U is half the interval that holds the mixture of (3), never less than that of independent rows, with
the degrees of freedom that its tails have. The effective number of rows is the number whose mean
has the same variance,

    n_eff = n² Σ_g p_g r_g / 1'R_g 1,                                                       (4)

p_g the probabilities of the nodes, r_g the variance of a row.

Rows that a column `time` puts in order are few, and U must not wait until they show what is beyond
chance. Noise is then taken as e_k = ρ e_k−1 + w_k in every output, with one ρ of a flat prior from
−1 to 1, whose restricted likelihood over all outputs i of ν_i degrees of freedom is

    p(ρ) ∝ Π_i |R|^−½ |X_i'R⁻¹X_i|^−½ s_i^−ν_i,    R_jk = ρ^|j − k|,                        (5)

s_i² by the rows whitened by R, and U is half the interval that holds 95 % of the mixture over ρ of
Student's t with the variances (3) and ν_i degrees of freedom, never less than that of independent
rows. Healthy sets pay for that with 1.2 of their U at 12 known rows, 1.08 at 24 and 1.04 at 48;
with ρ = .9 U covers 96 to 98 % where that of independent rows covers 84, 67 and 66 %. Unknown
orientations leave one misfit a row, which shows ρ less: the half of the prior above zero is then
dρ (1 − ρ)^−⅜, between flat and that of a long correlation. At 24 rows with ρ = .9 U covers 91 %
(flat 87, the other 93), and healthy sets pay 1.25 of it (1.17, 1.29).

A drift of the session takes most of what slow noise leaves. Beside one the half above zero is
dρ/(1 − ρ), orientations that are uncertain are judged by the residuals at the listed ones, and
biases of rows with ρ = .9 cover 90 to 98 % at 12 and 24 rows (flat 39 to 93).

Rows of a log that never rests (`multipos.logs.turned`; a column `turn_rate` ω says so) have errors
that follow the motion of a hand, which no law describes. Their misfits e, along the force and over
their u, are cut into B = 24 blocks in order, as are those of a record of unknown orientation where
sums are beyond chance. With X their design, and of a hand three columns ω² n more for the bias that
a lever arm brings (n the slopes of e by the readings), leaving a block out moves the estimate by

    d_b = (X'X − X_b'X_b)⁻¹ X_b'e_b,     cov = (B − 1)/B Σ_b d_b d_b',                      (6)

the jackknife of blocks, with B less the columns of X degrees of freedom. In simulated logs of 90 to
240 s U covers 92 to 95 %, the worst parameter 83 or more; blocks of 8 s cover 98 %, with 1.4 times
the U. The effective number of rows is n times the mean ratio of the variances of independent rows
to these.

Sources: D. M. Cooper, R. Thompson, Biometrika 64, 1977 (the restricted likelihood of (2));
G. V. Bayley, J. M. Hammersley, J. R. Stat. Soc. Suppl. 8, 1946 (4); H. R. Künsch, Ann. Statist. 17,
1989 (6).
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np

from multipos.estimation.problem import Solution
from multipos.estimation.variances import dof_of, half_of_mixture
from multipos.numerics.arrays import SMALLEST, Array, Mask, Places, count_different, row_keys
from multipos.numerics.cofactors import cofactors_of
from multipos.numerics.quantiles import coverage_factor, coverage_factors, normal_quantile
from multipos.numerics.recursions import recur
from multipos.positions.headers import RUN, TURN_RATE
from multipos.positions.orientations import StatedOrientations
from multipos.positions.readings import Readings
from multipos.results import frozen
from multipos.sensor.found import Estimator, VarianceComponents, add_scatter
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model

_TIME = "time"  # the column
_FEWEST_IN_TIME = 8  # rows in order of time
_DENSE = 120  # rows in order of time, from which on eq. (1) is asked
_CURVE = 2.0  # nodes of 1 − ρ are even in its root
_FLAT = 1.0  # power of its root that the prior of 1 − ρ has
_DRIFTING = -1.0  # the same beside a drift, which takes most of slow noise
_ONE_MISFIT = 0.25  # the same, of one misfit a row
_FEWEST = 40  # rows of which any law can be identified
_FEWEST_UNKNOWN = 100  # where no position repeats that tells noise from model
_LEVEL = 0.01  # at which rows are taken as correlated
_RUNS = 6  # of a length, that tell whether sums are beyond chance
_NODES = 12  # of ρ
_LONGEST = 0.4  # 1 − ρ of the last of them, over 1/n
_SHARES = (0.0, 0.4, 0.7, 0.85, 0.93, 0.97, 0.99)  # θ/ρ: even in what white noise adds
_ROWS = 20_000  # more are taken as means of neighbours
_FAINT = 0.2  # of ρ, below which rows are as good as independent
_BLOCKS = 24
_COVERAGE = 0.95  # that of `posteriors`
_ROUNDING = 1e-12  # of the largest reading, below which a residual is nothing


@frozen
class _RowPrecision:
    """The effective number of correlated rows."""

    ratio: Array  # (p,) of U over that of independent rows
    dof: float
    rows: float | None  # of eq. (4); None where they may be independent


def spread_correlation(
    solution: Solution, readings: Readings, stated_up: StatedOrientations, estimator: Estimator
) -> Solution:
    """Return a solution with what correlation from row to row makes of its uncertainty.

    Outputs of known orientation have noises of their own; unknown orientation leaves one misfit a
    row, along the force. Left as they are: fits that are robust, expressions, readings whose
    covariance is given or that have other columns beside them, positions that are only uncertain
    where nothing drifts.
    """
    if TURN_RATE in readings.environment and estimator is Estimator.UNKNOWN:
        return _never_at_rest(solution, readings)
    order = order_in_time(readings) if solution.model.has_terms else None
    asked = are_asked(solution.model, readings, solution.reference, estimator)
    if solution.robust_weight is not None or (order is None and not asked):
        return solution
    if estimator is Estimator.LINEAR and order is not None:
        return _known_in_time(solution, readings, order)
    if estimator is Estimator.UNCERTAIN and order is not None and solution.model.drift_per:
        at = stated_up.reference
        seen = solution.model.predict(solution.parameters, at, readings.environment)
        listed = replace(solution, reference=at, residuals=readings.values - seen)
        found = _known_in_time(listed, readings, order)
        return replace(found, reference=solution.reference, residuals=solution.residuals)
    if estimator is Estimator.LINEAR:
        return _at_known(solution, readings)
    loose = np.isinf(stated_up.orientation_sd).all() and not stated_up.listed.any()
    if estimator is not Estimator.UNKNOWN or not loose or stated_up.rolls is not None:
        return solution
    return _unknown(solution, readings, order)


def order_in_time(readings: Readings) -> Places | None:
    """Return the rows (n,) in order of their column `time`, of few; None where it gives none."""
    time = readings.environment.get(_TIME)
    few = _FEWEST_IN_TIME <= len(readings) <= _DENSE
    if time is None or not few or readings.covariance is not None or not np.isfinite(time).all():
        return None
    order = np.argsort(time, kind="stable")
    return order if (np.diff(time[order]) > 0.0).all() else None


def are_asked(model: Model, readings: Readings, reference: Array, estimator: Estimator) -> bool:
    """Tell whether rows at some forces (n, 3) [g] can show whether they are correlated."""
    if not model.has_terms or readings.covariance is not None:
        return False
    if estimator is Estimator.LINEAR:
        # what varies with a column is for the model, and its tests, to say
        others = set(readings.environment) - {_TIME, RUN, "approach"}
        if others and TURN_RATE not in others:
            return False
        many = len(reference) >= _FEWEST
        return many and len(reference) >= 2 * count_different(reference)
    return estimator is Estimator.UNKNOWN and len(reference) >= _FEWEST_UNKNOWN


def find_correlated(
    reference: Array, values: Sequence[Array], residuals: Sequence[Array] | Array
) -> Mask:
    """Tell of which of B units the rows of an output are correlated, without stated noise.

    Parameters
    ----------
    reference : (n, 3) array [g]
        At which rows are asked (`are_asked`), the same of all units.
    values, residuals : sequences of M (B, n) arrays
    """
    place = _places(reference)
    found = np.zeros(len(values[0]), dtype=np.bool_)
    for signal, error in zip(values, residuals, strict=True):
        found |= _are_correlated(error, _ROUNDING * np.abs(signal).max(axis=1), place)
    return found


def _at_known(solution: Solution, readings: Readings) -> Solution:
    model = solution.model
    place = _places(solution.reference)
    sd = sd_of_rows(solution, readings)
    phi = model.basis(solution.reference, readings.environment)
    found = []
    for i, columns in enumerate(model.columns):
        error = solution.residuals[:, i] / sd[:, i]
        quiet = _ROUNDING * np.abs(readings.values[:, i]).max() / sd[:, i].min()
        if _are_correlated(error[None], quiet[None], place)[0]:
            worth = _judge(phi[:, columns] / sd[:, i, None], error)
            found.append(((i,), model.slices[i], worth))
    return _with(solution, found)


def _places(reference: Array) -> Places:
    """Return at which position each row (n,) is."""
    return np.unique(np.array(row_keys(reference)), return_inverse=True)[1]


def _are_correlated(error: Array, quiet: Array, place: Places) -> Mask:
    """Tell of which records (B, n) the scatter within positions is correlated.

    What is below `quiet` (B,) is rounding: positions that repeat to the last digit.
    """
    order, count = np.argsort(place, kind="stable"), np.bincount(place)
    sums = np.add.reduceat(error[:, order], np.cumsum(count) - count, axis=1)
    scatter = error - (sums / count)[:, place]
    beyond = _are_beyond_chance(scatter, place, float(len(place) - len(count)))
    return np.asarray((np.abs(scatter).max(axis=1) > quiet) & beyond)


def _known_in_time(solution: Solution, readings: Readings, order: Places) -> Solution:
    """Judge rows in order of time by eq. (5), outputs together."""
    model, sd = solution.model, sd_of_rows(solution, readings)[order]
    phi = model.basis(solution.reference, readings.environment)[order]
    error = solution.residuals[order] / sd
    quiet = _ROUNDING * np.abs(readings.values).max(axis=0)
    if (
        len(order) - max(map(len, model.terms)) < 2
        or not (np.abs(solution.residuals).max(axis=0) > quiet).all()
    ):
        return solution
    designs = [phi[:, columns] / sd[:, [i]] for i, columns in enumerate(model.columns)]
    worth = _judge_in_time(designs, list(error.T), model)
    found = [
        ((i,), part, each) for i, (part, each) in enumerate(zip(model.slices, worth, strict=True))
    ]
    return _with(solution, found)


def _unknown(solution: Solution, readings: Readings, order: Places | None) -> Solution:
    """Judge the misfit along the force."""
    degrees = float(len(readings) - len(solution.parameters))
    along = _along_the_force(solution, readings)
    if along is None or degrees < 2.0:
        return solution
    if order is None:
        place = np.zeros(len(readings), dtype=np.intp)
        found = _are_beyond_chance(along.error[None], place, degrees)[0]
        return _by_blocks(solution, along.design, along.error) if found else solution
    shares = (along.slopes * sd_of_rows(solution, readings))[order]
    (worth,) = _judge_in_time(
        [along.design[order]], [along.error[order]], solution.model, shares @ shares.T
    )
    return _with(solution, [(tuple(range(len(solution.model.outputs))), slice(None), worth)])


class _Along(NamedTuple):
    """Misfits along the force, over their standard deviations."""

    error: Array  # (n,)
    design: Array  # (n, p), its slopes by the parameters
    slopes: Array  # (n, M), those by the readings


def _along_the_force(solution: Solution, readings: Readings) -> _Along | None:
    """Return the misfits n'e with M'n = f, M the slopes of the outputs; None where there is none.

    Left out are residuals that are rounding, and outputs that do not respond.
    """
    model, force = solution.model, solution.reference
    slopes = model.force_jacobian(solution.parameters, force, readings.environment)
    # M'⁻¹ f but for its length, which a slope of nothing leaves defined
    across = cofactors_of(slopes.transpose(1, 2, 0))
    normal = np.einsum("mkn,nk->nm", across, force)
    whitened = normal * sd_of_rows(solution, readings)
    sd = np.sqrt(np.einsum("nm,nm->n", whitened, whitened))
    quiet = np.abs(solution.residuals).max() <= _ROUNDING * np.abs(readings.values).max()
    if quiet or not (sd > 0.0).all():
        return None
    jacobian = parameter_jacobian(model, solution.parameters, force, readings.environment)
    normal = normal / sd[:, None]
    return _Along(
        error=np.sum(normal * solution.residuals, axis=1),
        design=np.einsum("nm,nmp->np", normal, jacobian),
        slopes=normal,
    )


def _never_at_rest(solution: Solution, readings: Readings) -> Solution:
    """Return the solution of rows that follow each other while they turn with U of eq. (6)."""
    along = _along_the_force(solution, readings)
    if along is None or len(readings) < 2 * _BLOCKS:
        return solution
    square = readings.environment[TURN_RATE] ** 2
    arm = along.slopes * (square / max(float(square.max()), SMALLEST))[:, None]
    weight = np.ones(len(readings)) if solution.robust_weight is None else solution.robust_weight
    X = np.column_stack([along.design, arm]) * np.sqrt(weight)[:, None]
    return _by_blocks(solution, X, along.error * np.sqrt(weight))


def _by_blocks(solution: Solution, X: Array, e: Array) -> Solution:
    """Return the solution with U by eq. (6), of rows whose first columns are of the parameters."""
    p = len(solution.parameters)
    whole = X.T @ X
    moved = np.array(
        [
            np.linalg.lstsq(whole - X[b].T @ X[b], X[b].T @ e[b], rcond=None)[0][:p]
            for b in np.array_split(np.arange(len(e)), _BLOCKS)
        ]
    )
    covariance = (_BLOCKS - 1.0) / _BLOCKS * moved.T @ moved
    ratio = np.sqrt(np.diag(covariance) / np.diag(solution.covariance))
    dof = float(_BLOCKS - X.shape[1])
    rows = len(e) * float(np.mean(1.0 / np.maximum(ratio, 1.0) ** 2))
    components = solution.variance_components or VarianceComponents()
    return replace(
        solution,
        covariance=covariance,
        inflation=solution.inflation * ratio,
        parameter_dof=np.full(p, dof),
        dof=np.full(len(solution.dof), dof),
        variance_components=replace(
            components, effective_rows=dict.fromkeys(solution.model.outputs, rows)
        ),
    )


def sd_of_rows(solution: Solution, readings: Readings) -> Array:
    """Return the standard deviation of every reading (n, M), up to a factor common to all."""
    outputs = solution.model.outputs
    noise = add_scatter(readings.noise, solution.variance_components, outputs)
    if noise is None:
        return np.ones(solution.residuals.shape)
    return np.asarray(np.sqrt(noise).reshape(solution.residuals.shape))


def _with(
    solution: Solution, found: Sequence[tuple[tuple[int, ...], slice, _RowPrecision]]
) -> Solution:
    """Return the solution with U and dof of what was found of outputs and their parameters."""
    if not found:
        return solution
    outputs, dof = solution.model.outputs, solution.dof.copy()
    ratio, own = np.ones(len(solution.parameters)), solution.parameter_dof.copy()
    effective = dict.fromkeys(outputs, float(len(solution.residuals)))
    for judged, members, worth in found:
        dof[list(judged)] = np.minimum(dof[list(judged)], worth.dof)
        before = coverage_factors(_COVERAGE, own[members])
        own[members] = np.minimum(own[members], worth.dof)
        ratio[members] = worth.ratio * before / coverage_factors(_COVERAGE, own[members])
        if worth.rows is not None:
            effective |= {outputs[i]: worth.rows for i in judged}
    components = solution.variance_components
    if any(worth.rows is not None for *_, worth in found):
        components = replace(components or VarianceComponents(), effective_rows=effective)
    return replace(
        solution,
        covariance=solution.covariance * np.outer(ratio, ratio),
        inflation=solution.inflation * ratio,
        parameter_dof=own,
        dof=dof,
        variance_components=components,
    )


def _judge(design: Array, error: Array) -> _RowPrecision:
    """Return the effective number of rows (n, p) of equal variance, by their errors (n,)."""
    n, p = design.shape
    variance = float(error @ error) / (n - p)
    together = -(-n // _ROWS)
    X, e = (_means(rows, together) for rows in (design, error))
    Q, R = np.linalg.qr(X)
    inverse = np.linalg.inv(R)
    plain = np.einsum("ij,ij->i", inverse, inverse) * variance / together
    gains = np.column_stack([Q @ inverse.T, np.full(len(e), 1.0 / len(e))])
    log_weight, variances, of_row = _at_nodes(Q, e, gains)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    half = half_of_mixture(weight[None], variances[None, :, :p])[0]
    dof = dof_of(weight[None], variances[None, :, :p])
    usual = coverage_factor(_COVERAGE, float(n - p)) * np.sqrt(plain)
    effective = together * float(weight @ (of_row / variances[:, p]))
    return _RowPrecision(
        ratio=np.maximum(half / usual, 1.0),
        dof=min(float(np.median(dof)), float(n - p)),
        rows=min(effective, float(n)),
    )


def _judge_in_time(
    designs: list[Array], errors: list[Array], model: Model, alike: Array | None = None
) -> list[_RowPrecision]:
    """Return the effective number of rows in order of time by eq. (5), for every output."""
    power = _DRIFTING if model.drift_per else _FLAT if alike is None else _ONE_MISFIT
    ratios, rows = spread_in_time(designs, [error[None] for error in errors], alike, power)
    n = len(errors[0])
    effective = float(rows[0]) if rows[0] < n else None
    return [_RowPrecision(ratio[0], inf, effective) for ratio in ratios]


def spread_in_time(
    designs: Sequence[Array],
    errors: Sequence[Array],
    alike: Array | None = None,
    steep: float = _FLAT,
) -> tuple[list[Array], Array]:
    """Return by how much U of B units is longer than that of independent rows, by eq. (5).

    Parameters
    ----------
    designs : sequence of (n, p) arrays
        Of each output or part of readings, rows in order of time and of equal variance.
    errors : sequence of (B, n) arrays
    alike : (n, n) array, optional
        By how much rows have the same noise in them; wholly if not given.
    steep : float
        Power of the root of 1 − ρ in the prior of ρ above zero, at nodes even in it.

    Returns
    -------
    ratios : list of (B, p) arrays
    rows : (B,) array
        Whose mean has the same variance; n where rows may be independent.
    """
    count, n = errors[0].shape
    low = (_LONGEST / n) ** (1.0 / _CURVE)
    x = low + (1.0 - low) * (np.arange(_NODES) + 0.5) / _NODES
    below = _NODES // 2
    rho = np.concatenate([1.0 - x**_CURVE, -(np.arange(below) + 0.5) / below])
    above = x**steep
    prior = np.concatenate([above / above.sum(), np.full(below, 1.0 / below)])
    gap = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    power = rho[:, None, None] ** gap
    R = power if alike is None else power * alike
    L = np.linalg.cholesky(R)
    determinants = np.log(np.einsum("gnn->gn", L)).sum(axis=1)
    inverse = np.linalg.inv(L)
    log, parts = np.broadcast_to(np.log(prior), (count, len(rho))), []
    for X, e in zip(designs, errors, strict=True):
        nu = float(n - X.shape[1])
        Q, T = np.linalg.qr(inverse @ X)
        white = inverse - Q @ (Q.transpose(0, 2, 1) @ inverse)
        left = np.einsum("gkn,bn->gbk", white, e, optimize=True)
        s2 = np.einsum("gbk,gbk->bg", left, left) / nu
        sizes = np.log(np.abs(np.einsum("gpp->gp", T))).sum(axis=1)
        log = log - determinants - sizes - 0.5 * nu * np.log(s2)
        plain, triangle = np.linalg.qr(X)
        gains = plain @ np.linalg.inv(triangle).T
        factors = np.einsum("np,gnp->gp", gains, R @ gains)
        independent = np.einsum("bn,bn->b", e, e)[:, None] / nu
        independent = independent * np.einsum("np,np->p", gains, gains)
        parts.append(
            (nu, s2[:, :, None] * factors, coverage_factor(_COVERAGE, nu) * np.sqrt(independent))
        )
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    ratios = [
        np.maximum(half_of_mixture(weight, v, np.full(least.shape, nu)) / least, 1.0)
        for nu, v, least in parts
    ]
    worth = weight @ (n**2 / np.einsum("gnm->g", power))
    slow = weight[:, rho > _FAINT].sum(axis=1) > 1.0 - _LEVEL
    return ratios, np.where(slow, np.minimum(worth, n), float(n))


def _are_beyond_chance(scatter: Array, place: Places, degrees: float) -> Mask:
    """Tell of which records (B, n) sums of neighbours are too large for independent rows, eq. (1).

    χ² by the cube root of Wilson and Hilferty, which is normal.
    """
    square, n = np.einsum("bn,bn->b", scatter, scatter), scatter.shape[1]
    share = 1.0 / np.bincount(place)
    sums = np.cumsum(np.pad(scatter, ((0, 0), (1, 0))), axis=1)
    deviates = []
    m = 2
    while (count := n // m) >= _RUNS:
        whole = count * m
        runs = np.diff(sums[:, : whole + 1 : m], axis=1)
        expected = whole - _of_means(place[:whole], m, share)
        if expected < whole / 2.0:  # means of positions hold most of such sums
            break
        per_degree = np.where(square > 0.0, square, 1.0) / degrees
        ratio = np.einsum("bi,bi->b", runs, runs) / (per_degree * expected)
        by = 2.0 / (9.0 * count)
        deviates.append((np.cbrt(ratio) - 1.0 + by) / sqrt(by))
        m *= 2
    if not deviates:
        return np.zeros(len(scatter), dtype=np.bool_)
    return np.asarray(np.max(deviates, axis=0) > normal_quantile(1.0 - _LEVEL / len(deviates)))


def _of_means(place: Places, m: int, share: Array) -> float:
    """Return Σ n_bj²/n_j of eq. (1), of runs of m rows."""
    n = len(place)
    if len(share) == 1:
        return float(n * m * share[0])
    met, times = np.unique(np.arange(n) // m * len(share) + place, return_counts=True)
    return float(times**2 @ share[met % len(share)])


def _means(rows: Array, together: int) -> Array:
    """Return the means of so many neighbours each; what is left over at the end is left out."""
    whole = len(rows) // together
    groups = rows[: whole * together].reshape(whole, together, *rows.shape[1:])
    return np.asarray(groups.mean(axis=1))


def _at_nodes(Q: Array, e: Array, gains: Array) -> tuple[Array, Array, Array]:
    """Return what is known of laws (G,) as a logarithm, eq. (3) of columns B' (G, q), and s²r.

    Parameters
    ----------
    Q : (n, p) array
        Orthonormal columns that span the design.
    e : (n,) array
    gains : (n, q) array
        B'.
    """
    n, p = Q.shape
    both = np.column_stack([Q, e])
    square = np.einsum("nq,nq->q", gains, gains)
    before = np.vstack([np.zeros((1, gains.shape[1])), gains[:-1]])
    logs, variances, of_row = [], [], []
    for rho in (1.0 - np.geomspace(0.9, _LONGEST / n, _NODES)).tolist():
        # what the rows before a row bring with it, each rho times the one after it
        product = np.einsum("nq,nq->q", gains, recur(before, rho))
        for share in _SHARES:
            theta = share * rho
            r = (1.0 - 2.0 * rho * theta + theta**2) / (1.0 - rho**2)  # variance of a row over w
            next_one = (1.0 - rho * theta) * (rho - theta) / (1.0 - rho**2)
            size = np.abs(np.diag(np.linalg.qr(_whitened(both, rho, theta, r), mode="r")))
            inside = float(np.log(size[:p]).sum()) + (n - p) * log(size[p])
            logs.append(0.5 * log(1.0 - rho) - 0.5 * log(r) - inside)
            # the mean of s² as the rows leave it, χ² on n − p
            s2 = float(size[p]) ** 2 / (n - p - 2.0)
            variances.append(s2 * (r * square + 2.0 * next_one * product))
            of_row.append(s2 * r)
    return np.array(logs), np.array(variances), np.array(of_row)


def _whitened(z: Array, rho: float, theta: float, r: float) -> Array:
    """Return rows (n, p) by eq. (2) solved for w, the first as one of its kind.

    Exact for θ = 0; else the first 1/(1 − θ) rows or so lack what a longer past would tell.
    """
    white = z.copy()
    white[1:] -= rho * z[:-1]
    white[0] = z[0] / r  # what the second row remembers
    white = recur(white, theta)
    white[0] = z[0] / sqrt(r)
    return white

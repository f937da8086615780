"""Agreement of repeated calibrations within their uncertainties: exact tests for few degrees.

- `judge_repeats` returns the `Judgement` of repeats, `judge_methods` that of several methods on the
  same readings.
- `judge_together` combines the tests of outputs, in `Words` of the caller, by eq. (3), and
  `worded_test` says it with its numbers.
- `is_apart` says whether outputs have no noise in common.

R calibrations of one unit give parameters p_r, each with the covariance C_r of what is
independent between the repeats (gravity, common to all, is left out, and so are level and what else
the bench budget states within one day). If nothing moved, all estimate one p, and with the weighted
mean p̄

    Q = sum_r (p_r - p̄)' C_r⁻¹ (p_r - p̄),        p̄ = (sum C_r⁻¹)⁻¹ sum C_r⁻¹ p_r.           (1)

Where the C_r are known, Q is χ² on d (R - 1) degrees of freedom, d the number of parameters.
Where each C_r = s_r² K_r was estimated from residuals on ν_r degrees of freedom, each p_r is judged
by a scatter of its own that may have come out small by luck, and Q against χ² cries wolf: for four
repeats with one degree of freedom each, in almost half of all cases. The scatter of one unit on
one bench is however one number. Pooled,

    s² = sum ν_r s_r² / ν,   ν = sum ν_r,     F = Q(s² K_r) / (d (R - 1)),                   (2)

Q is independent of s² (both sums of squares belong to orthogonal parts of normal data), so F
follows the F distribution on d (R - 1) and ν degrees of freedom exactly, whatever the schemes.
That is done for every output, which has a scatter of its own, and the p values of M independent
outputs are combined by Fisher's method, exactly as well:

    -2 sum_i ln p_i   is χ² on 2 M degrees of freedom.                                       (3)

Level and bench differ from day to day, with the covariance L of each day. Q is then that of (1)
within every day, and of the days: their p̄ with (sum C_r⁻¹)⁻¹ + L. Of that only the share w was
estimated, and ν becomes ν/w².

Outputs that share one scatter (pooled, or correlated in the fit) are one family in (2), and
(3) is not needed.

References
----------
JCGM 100:2008, H.5 (analysis of variance); Song and Qin 2009, section 3.2 and figure 1.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from multipos.files.numbers import number, p_in_words
from multipos.numerics.arrays import Array, Places
from multipos.numerics.quantiles import chi2_tail, f_tail
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.propagation import evaluate_budget


class Words(NamedTuple):
    """What a test is called: of known noise, of one family, of several by Fisher's method."""

    known: str
    one: str
    several: str


_WORDS = Words(
    "chi-square of the repeats against their covariances",
    "F of the repeats against their pooled variance",
    "F of the repeats against the pooled variance of each output, combined by Fisher's method",
)


@frozen
class Judgement:
    """What is said of repeated calibrations; arrays (p,), in the order of the parameters.

    Attributes
    ----------
    chi2, dof, scatter_dof, p : (p,) arrays
        Q of eq. (1) of each parameter alone, on R − 1, against a scatter on ν (eq. (2)).
    statistic, dof_total, p_total : float, float or list, float
        Of all parameters together; NaN where there is no test.
    test : str
        Which test, in words.
    consistent : bool
    moved : tuple of str
        Parameters that moved, by Holm's method at the same level.
    """

    chi2: Array
    dof: Array
    scatter_dof: Array
    p: Array
    statistic: float
    dof_total: float | list[float]
    p_total: float
    test: str
    consistent: bool
    moved: tuple[str, ...]


def judge_methods(found: Sequence[Calibration], values: Array) -> Judgement:
    """Judge methods on the same readings: they share their noise, so there is no χ²."""
    expanded = np.nan_to_num(np.min([c.U for c in found], axis=0))
    beyond = np.ptp(values, axis=0) > np.maximum(expanded, 1e-12 * np.abs(values).max())
    moved = tuple(name for name, over in zip(found[0].names, beyond, strict=True) if over)
    test = (
        "the readings are the same, so their noise cannot separate the methods: consistent where "
        "no parameter differs by more than its U"
    )
    none = np.full(values.shape[1], math.nan)
    of_all = math.nan
    return Judgement(none, none, none, none, of_all, of_all, of_all, test, not moved, moved)


@frozen
class _Family:
    """Parameters that share one scatter: their cofactors K_r (R, d, d), s_r² and ν_r (R,).

    `of_days` (R, d, d) is L of the day of each, zero where all are of one day.
    """

    members: Places
    cofactors: Array
    variances: Array
    dof: Array
    of_days: Array

    def share(self, covariances: Array) -> float:
        """Return w: which share of the variances was estimated."""
        own, days = (np.einsum("rii->ri", each) for each in (covariances, self.of_days))
        return float(np.mean(own / (own + days))) if days.any() else 1.0

    @property
    def scatter(self) -> tuple[Array, float]:
        """The variance factor (R,) of each repeat, pooled by eq. (2), and ν."""
        known = np.isinf(self.dof)
        if known.all():
            return self.variances, math.inf
        nu = float(self.dof[~known].sum())
        if not nu > 0.0:
            return np.full(len(self.dof), math.nan), nu
        pooled = float(self.dof[~known] @ self.variances[~known]) / nu
        return np.where(known, self.variances, pooled), nu


def judge_repeats(
    found: Sequence[Calibration], values: Array, day: Array, level: float
) -> Judgement:
    """Judge R repeated calibrations by eqs. (1) to (3).

    Parameters
    ----------
    found : sequence of R Calibration
    values : (R, p) array
    day : (R,) array
        That each was made on: what is common to one day is not in its test.
    level : float
        Probability of a false alarm.
    """
    families = _families(found, day)
    repeats, p = values.shape
    chi2, scatter_dof, tails = np.empty(p), np.empty(p), np.empty(p)
    outcome: list[tuple[float, float, float]] = []  # Q, its degrees of freedom, ν
    for family in families:
        factor, nu = family.scatter
        covariances = family.cofactors * factor[:, None, None]
        mine = values[:, family.members]
        nu = nu / family.share(covariances) ** 2
        q = _by_days(mine, covariances, family.of_days, day)
        outcome.append((q, len(family.members) * (repeats - 1.0), nu))
        for place, member in enumerate(family.members.tolist()):
            alone = np.ix_(range(repeats), [place], [place])
            single = _by_days(mine[:, [place]], covariances[alone], family.of_days[alone], day)
            chi2[member], scatter_dof[member] = single, nu
            tails[member] = f_tail(single / (repeats - 1.0), repeats - 1.0, nu)
    statistic, dof, p_total, test = judge_together(outcome, _WORDS)
    # Holm: the smallest p against level/p, the next against level/(p − 1), …
    order = np.argsort(tails)
    passed = np.sort(tails) < level / (p - np.arange(p))
    count = int(np.argmin(passed)) if not passed.all() else p
    moved = tuple(found[0].names[i] for i in sorted(order[:count].tolist()))
    return Judgement(
        chi2=chi2,
        dof=np.full(p, repeats - 1.0),
        scatter_dof=scatter_dof,
        p=tails,
        statistic=statistic,
        dof_total=dof,
        p_total=p_total,
        test=test,
        consistent=not p_total < level,
        moved=moved,
    )


def judge_together(
    outcome: Sequence[tuple[float, float, float]], words: Words
) -> tuple[float, Any, float, str]:
    """Return statistic, degrees of freedom, p and name of the test of all families.

    Parameters
    ----------
    outcome : sequence of (Q, degrees of freedom, ν)
        Of each family; ν is infinite where its noise is known.
    words : Words
        What the test is called.
    """
    if all(math.isinf(nu) for _, _, nu in outcome):
        q, d = sum(o[0] for o in outcome), sum(o[1] for o in outcome)
        return q, d, chi2_tail(q, d), words.known
    tails = [f_tail(q / d, d, nu) for q, d, nu in outcome]
    if len(outcome) == 1:
        q, d, nu = outcome[0]
        return q / d, [d, nu], tails[0], words.one
    if any(math.isnan(p) for p in tails):
        return math.nan, math.nan, math.nan, "none: a calibration has no degrees of freedom"
    statistic = 0.0 - 2.0 * sum(math.log(max(p, np.finfo(float).tiny)) for p in tails)
    dof = 2.0 * len(tails)
    return statistic, dof, chi2_tail(statistic, dof), words.several


def worded_test(test: str, statistic: float, dof: float | Sequence[float], p: float) -> str:
    """Return the name of a test with its numbers; of none why there is none."""
    if not math.isfinite(statistic):
        return test
    on = ", ".join(map(number, dof if isinstance(dof, Sequence) else [dof]))
    return f"{test}: {number(statistic)} on {on} degrees of freedom, {p_in_words(p)}"


def _by_days(values: Array, covariances: Array, of_days: Array, day: Array) -> float:
    """Q of eq. (1) where days differ by L: that within each day, and that of their means."""
    if not of_days.any():
        return _quadratic(values, covariances)[0]
    total, means, spread = 0.0, [], []
    for one in np.unique(day):
        mine = day == one
        q, mean, covariance = _quadratic(values[mine], covariances[mine])
        total += q
        means.append(mean)
        spread.append(covariance + of_days[mine].mean(axis=0))
    return total + _quadratic(np.array(means), np.array(spread))[0]


def _quadratic(values: Array, covariances: Array) -> tuple[float, Array, Array]:
    """Q of eq. (1) for values (R, d) with covariances (R, d, d), p̄ and its covariance."""
    nothing = math.nan, values[0] * math.nan, covariances[0] * math.nan
    scale = np.sqrt(np.einsum("rii->i", covariances) / len(values))  # units differ by powers of ten
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        return nothing
    scaled = values / scale
    try:
        weights = np.linalg.inv(covariances / np.outer(scale, scale))
        mean = np.linalg.solve(weights.sum(axis=0), np.einsum("rij,rj->i", weights, scaled))
        covariance = np.linalg.inv(weights.sum(axis=0)) * np.outer(scale, scale)
    except np.linalg.LinAlgError:  # in a file a combination may be known exactly
        return nothing
    left = scaled - mean
    return float(np.einsum("ri,rij,rj->", left, weights, left)), mean * scale, covariance


def _families(found: Sequence[Calibration], day: Array) -> list[_Family]:
    """Return the parameters grouped by what scatter they are judged by."""
    budgets = [evaluate_budget(c) for c in found]
    covariances = np.array([budget.apart(same_day=True).covariance for budget in budgets])
    of_days = np.zeros_like(covariances)
    if (day != day[0]).any():
        both = [budget.apart(same_day=False).covariance for budget in budgets]
        of_days = np.array(both) - covariances
    output_of, count = found[0].model.output_of, len(found[0].outputs)
    whole = zip(found, covariances + of_days, strict=True)
    apart = all(is_apart(c, covariance, output_of) for c, covariance in whole)
    members = [[i] for i in range(count)] if apart else [list(range(count))]
    cleared = [budget.cleared for budget in budgets]
    families = []
    for mine in members:
        group = np.flatnonzero(np.isin(output_of, mine)) if apart else np.arange(len(output_of))
        dof = np.array([left.dof[mine[0]] for left in cleared])
        ratio = np.array([left.ratio[mine].mean() for left in cleared])
        variances = ratio * [_scatter(c, mine) for c in found]
        variances = np.where(np.isinf(dof), 1.0, variances)  # NaN without degrees of freedom
        block, days = (each[:, group][:, :, group] for each in (covariances, of_days))
        positive = np.where(variances > 0.0, variances, math.nan)[:, None, None]
        families.append(_Family(group, block / positive, variances, dof, days))
    return families


def is_apart(c: Calibration, covariance: Array, output_of: Places) -> bool:
    """Whether each output has its own scatter: not pooled, not correlated with another.

    Parameters
    ----------
    c : Calibration
    covariance : (p, p) array
        That of the parameters, or the part of it that is judged.
    output_of : (p,) array of int
    """
    scale = np.sqrt(np.abs(np.diag(covariance)))
    across = output_of[:, None] != output_of
    correlated = bool((np.abs(covariance) > 1e-9 * np.outer(scale, scale))[across].any())
    own = len(c.readings) - np.array([len(terms) for terms in c.model.terms])
    if c.weighed:  # a scatter from rest to rest that all share
        pooled = len(own) > 1 and bool(np.isfinite(c.dof).any()) and np.ptp(c.dof) == 0.0
    else:
        pooled = bool((np.isfinite(c.dof) & (c.dof > own)).any())
    return not correlated and not pooled


def _scatter(c: Calibration, outputs: list[int]) -> float:
    """Variance factor s_r² that the residuals gave: whitened where the noise was stated."""
    n, m = c.readings.values.shape
    noise = c.noise
    columns = (np.arange(n)[:, None] * m + np.array(outputs)).ravel()
    left = c.residuals.ravel()[columns]
    if c.weighed:  # absolute, so that repeats of unlike scatter are pooled as variances are
        return float(np.mean(c.sd_of_readings[:, outputs] ** 2))
    if noise is None:
        square = float(left @ left)
    elif noise.ndim == 1:
        square = float(np.sum(left**2 / noise[columns]))
    else:
        square = float(left @ np.linalg.solve(noise[np.ix_(columns, columns)], left))
    dof = float(c.dof[outputs[0]])
    return square / dof if dof > 0.0 else math.nan

"""Tests of coefficients where rows depend on each other, by cluster or in time.

The covariances and the law of F_robust are those of `multipos.regression.correlation`.

Switch-ons: a constant that is not the same in every run, and what the next run may have.

A sensor comes back from each switch-on with another zero. With a run of its own for each,

    y_ij = a_i + x_ij' b + e_ij,        a_i = a + o_i,                                      (1)

run i, row j: the slopes b come from what changes within the runs alone, which is least squares of
columns and response less their means over the run, and the constant is the mean of the m zeros,
every run counting once. The zeros scatter by

    s² = Σ o_i²/(m − 1),        u²(a) = s²/m + x̄' C_b x̄.                                   (2)

A slope of the variable v (that of the segments, else the first) may differ from run to run as well:
o_i + c_i (v − v̄). It is identifiable where the scatter of the c_i is beyond what the noise within
the runs gives them (F at 95 % on m − 1), and v itself is a term. Ψ is the covariance of o_i and
c_i. A prediction for a run that nobody has seen, at terms x, with z = (1, v − v̄),

    u² = x' C x + z' Ψ z + rms²,        U² = t²(m − 1) (1 + 1/m) z' Ψ z + t²(ν) · the rest,      (3)

expanded part by part: with three runs the scatter of the zeros has two degrees of freedom, and one
effective number for both parts covers down to 92 % at a stated 95 %, eq. (3) never less than 95 %.

Sources: JCGM 100, 4.2 and 5.1; F. A. Graybill, C.-M. Wang, J. Am. Stat. Assoc. 75, 1980 (limits
for a sum of variances, part by part).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import LinearFit, solve
from multipos.numerics.quantiles import f_quantile, f_tail
from multipos.numerics.terms import CONSTANT, Term, linear_term
from multipos.regression import correlation
from multipos.regression.correlation import lag_one
from multipos.regression.observations import Data
from multipos.regression.segment import Between, Robust, Segment

_ONE_ROW = 0.5  # of leverage: a row decides more than all others


def runs_lost(data: Data) -> int:
    """Return how many degrees of freedom the zeros of the runs take beside the constant."""
    return 0 if data.run is None else len(np.unique(data.run)) - 1


def within_runs(design: Array, data: Data, where: str = "") -> tuple[Array, Data]:
    """Return columns and response less what differs between runs; as they are without runs.

    Their means over a run become the mean of these means, so that the constant is that of eq. (1).

    Raises
    ------
    MultiposError
        There is one run only.
    """
    if data.run is None:
        return design, data
    labels, run, count = np.unique(data.run, return_inverse=True, return_counts=True)
    if len(labels) < 2:
        raise MultiposError(
            f"{where or 'the table'} has rows of one run only, which cannot show what runs differ "
            "by; move the edge, give more runs, or leave out --run."
        )
    both = np.column_stack([design, data.response])
    means = np.stack([np.bincount(run, column) / count for column in both.T], axis=1)
    adjusted = both - means[run] + means.mean(axis=0)
    return adjusted[:, :-1], replace(data, response=adjusted[:, -1])


def find_between(
    original: Array,
    data: Data,
    terms: Sequence[Term | None],
    values: Array,
    variable: str,
    n_effective: float,
) -> Between:
    """Return the scatter between runs, eq. (2).

    Parameters
    ----------
    original : (n, q) array
        The columns of the terms, with what differs between runs still in them.
    data : Data
        The rows, with the response as it was read.
    terms, values
        What was fitted.
    variable : str
        Whose slope may differ.
    n_effective : float
        The effective number of rows.
    """
    assert data.run is not None  # which is what there is to tell about
    v = data.columns[variable]
    centre = float(v.mean())
    left = data.response - original @ values
    offsets, slopes, noise = [], [], []
    for label in np.unique(data.run):
        mine = data.run == label
        x, e = v[mine] - v[mine].mean(), left[mine]
        spread = float(x @ x)
        slope = float(x @ e) / spread if spread > 0.0 else 0.0
        offsets.append(float(e.mean()) + slope * (centre - float(v[mine].mean())))
        slopes.append(slope)
        rest = e - e.mean()
        variance = float(rest @ rest) / max(len(e) - 2, 1) * len(left) / n_effective
        noise.append(variance / spread if spread > 0.0 else np.inf)
    m = len(slopes)
    varies = linear_term(variable) in terms
    varies &= np.var(slopes, ddof=1) > np.mean(noise) * f_quantile(0.95, m - 1, n_effective)
    if varies:
        return Between(m, variable, centre, np.cov(offsets, slopes))
    means = [float(left[data.run == label].mean()) for label in np.unique(data.run)]
    return Between(m, None, centre, np.array([[np.var(means, ddof=1)]]))


def add_between(segment: Segment, between: Between) -> Segment:
    """Return a segment whose coefficients are uncertain by what differs between runs as well."""
    added = between.of_coefficients(segment.terms)
    robust = segment.robust
    if robust is not None:
        robust = replace(robust, covariance=robust.covariance + added)
    return replace(segment, covariance=segment.covariance + added, robust=robust, between=between)


class General(NamedTuple):
    """The same terms fitted to rows made independent by one law of their noise.

    An autoregression takes a period off, of which the start of a run is then left: where one row
    decides more than all others, `later` is the fit without these rows.
    """

    values: Array
    covariance: Array
    dof: int
    later: "General | None" = None

    def turned(self, L: Array) -> "General":
        """Return the fit of coefficients that are L times these."""
        later = None if self.later is None else self.later.turned(L)
        return General(L @ self.values, L @ self.covariance @ L.T, self.dof, later)


class RobustFit(NamedTuple):
    """Robust covariance of all coefficients of a fit, and what goes with it.

    `shown` is whether correlation is beyond chance, `general` the fit by every plausible law.
    """

    covariance: Array
    nu: float
    n_effective: float
    lag_one: float
    shown: bool = True
    general: tuple[General, ...] = ()

    def turned(self, L: Array) -> "RobustFit":
        """Return the fit of coefficients that are L times these."""
        general = tuple(one.turned(L) for one in self.general)
        return self._replace(covariance=L @ self.covariance @ L.T, general=general)


def robust_fit(found: LinearFit, X: Array, data: Data) -> RobustFit | None:
    """Return the robust covariance where rows are correlated in time, or may be; else None.

    Parameters
    ----------
    found : LinearFit
    X : (n, q) array
        The columns it was found from.
    data : Data
        Its rows.
    """
    if found.dof <= 0 or not found.rss or data.order is None:
        return None
    e, noise = found.residuals, data.noise
    rho, correlated = lag_one(e, data.order)
    correlated |= noise is not None and noise.law is not None
    general = _by_plausible_laws(X, data)
    if not correlated and not general:
        return None
    size = correlation.effective_size(e, data.order) if correlated else len(e)
    covariance = correlation.hac_covariance(X, e, found.cofactor, data.order)
    nu = correlation.window_dof(e, data.order)
    return RobustFit(covariance, nu, size, rho, correlated, general)


def _by_plausible_laws(X: Array, data: Data) -> tuple[General, ...]:
    """Return the fit to rows made independent by each plausible law of their noise."""
    if data.order is None or data.noise is None:
        return ()
    both, lost = np.column_stack([X, data.response]), runs_lost(data)
    order, age = data.order.order, correlation.ages(data.order.run)
    found = []
    for law in data.noise.plausible:
        white = correlation.Whitening(data.order, law)(both)
        fit = solve(white[:, :-1], white[:, -1])
        later, rest = None, order[age > len(law.further)]
        if len(law.further) and fit.leverage.max() > _ONE_ROW and len(rest) > both.shape[1]:
            later = _general(solve(white[rest, :-1], white[rest, -1]), lost)
        one = _general(fit, lost)
        if one is not None:
            found.append(one._replace(later=later))
    return tuple(found)


def _general(fit: LinearFit, lost: int) -> General | None:
    dof = fit.dof - lost
    if dof <= 0:
        return None
    return General(fit.coefficients, fit.cofactor * (float(fit.rss) / dof), dof)


def robust_test(
    fit: RobustFit | None,
    terms: tuple[Term, ...],
    values: Array,
    classical: tuple[float, int, int],
    confidence: float,
) -> Robust | None:
    """Return F_robust of a segment's slopes.

    By rows made independent, with the largest p of all plausible laws of their noise; else by eq.
    (4) of `multipos.regression.correlation`. None where there is no robust fit, and where
    correlation is not shown and no plausible law takes from F what it says.

    Parameters
    ----------
    fit : RobustFit or None
    terms : tuple of Term
    values : (q,) array
    classical : (F, k, ν) tuple
    confidence : float
    """
    if fit is None:
        return None
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    if fit.general:
        plain = _tested(*classical)
        tests = [_by_law(one, slopes, plain.p) for one in fit.general]
        found = max(tests, key=lambda test: -1.0 if np.isnan(test.p) else test.p)
        level = 1.0 - confidence
        if not fit.shown and not plain.p < level <= found.p:
            return None
    else:
        F, k = correlation.wald(values[slopes], fit.covariance[np.ix_(slopes, slopes)])
        nu = fit.nu - k + 1.0
        found = _tested(F * nu / fit.nu, k, nu)
    dof, size = (found.k, found.nu), fit.n_effective
    return Robust("hac", fit.covariance, found.F, found.p, dof, fit.nu, size, fit.lag_one)


class _Test(NamedTuple):
    """F on k and ν, and its p; NaN where there is nothing to test with."""

    F: float
    k: int
    nu: float
    p: float


def _by_law(one: General, slopes: list[int], plain: float) -> _Test:
    """Return the test by one law; rows at the start of a run make no more of it than F does."""
    F, k = correlation.wald(one.values[slopes], one.covariance[np.ix_(slopes, slopes)])
    found = _tested(F, k, one.dof)
    if one.later is None or not found.p < plain:
        return found
    return _by_law(one.later, slopes, plain)


def _tested(F: float, k: int, nu: float) -> _Test:
    if not (k and nu > 0.0) or np.isnan(F):
        return _Test(np.nan, k, nu, np.nan)
    return _Test(F, k, nu, f_tail(F, k, nu))

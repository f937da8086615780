"""Tests of coefficients where rows depend on each other in time.

`robust_fit` returns the covariance of a fit with its laws of the noise, `robust_test` F_robust of a
segment by it. Covariance and F are those of `multipos.regression.correlation`, the laws of the
noise those of `multipos.regression.whitening`.
"""

from typing import NamedTuple

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import LinearFit, solve
from multipos.numerics.quantiles import f_tail
from multipos.numerics.terms import CONSTANT, Term
from multipos.regression import correlation, whitening
from multipos.regression.correlation import lag_one
from multipos.regression.observations import Data
from multipos.regression.runs import runs_lost
from multipos.regression.segment import Robust

_ONE_ROW = 0.5  # of leverage: a row decides more than all others


class General(NamedTuple):
    """The same terms fitted to rows made independent by one law of their noise.

    An autoregression takes a period off, of which the start of a run is then left: where one row
    decides more than all others, `later` is the fit without these rows.
    """

    values: Array
    covariance: Array
    dof: int
    later: "General | None" = None


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
    if found.dof <= 0 or not found.rss:
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
    if data.noise is None:
        return ()
    both, lost = np.column_stack([X, data.response]), runs_lost(data)
    order, age = data.order.order, whitening.ages(data.order.run)
    found = []
    for law in data.noise.plausible:
        white = whitening.Whitening(data.order, law)(both)
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
    L: Array,
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
    L : (r, q) array
        How the coefficients of the segment's terms are made of those of the fit.
    terms : tuple of r Term
    values : (r,) array
    classical : (F, k, ν) tuple
    confidence : float
    """
    if fit is None:
        return None
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    covariance = L @ fit.covariance @ L.T
    if fit.general:
        plain = _tested(*classical)
        tests = [_by_law(one, L[slopes], plain.p) for one in fit.general]
        found = max(tests, key=lambda test: -1.0 if np.isnan(test.p) else test.p)
        level = 1.0 - confidence
        if not fit.shown and not plain.p < level <= found.p:
            return None
    else:
        F, k = correlation.wald(values[slopes], covariance[np.ix_(slopes, slopes)])
        nu = fit.nu - k + 1.0
        found = _tested(F * nu / fit.nu, k, nu)
    dof, size = (found.k, found.nu), fit.n_effective
    return Robust("hac", covariance, found.F, found.p, dof, fit.nu, size, fit.lag_one)


class _Test(NamedTuple):
    """F on k and ν, and its p; NaN where there is nothing to test with."""

    F: float
    k: int
    nu: float
    p: float


def _by_law(one: General, L: Array, plain: float) -> _Test:
    """Return the test by one law; rows at the start of a run make no more of it than F does."""
    F, k = correlation.wald(L @ one.values, L @ one.covariance @ L.T)
    found = _tested(F, k, one.dof)
    if one.later is None or not found.p < plain:
        return found
    return _by_law(one.later, L, plain)


def _tested(F: float, k: int, nu: float) -> _Test:
    if not (k and nu > 0.0) or np.isnan(F):
        return _Test(np.nan, k, nu, np.nan)
    return _Test(F, k, nu, f_tail(F, k, nu))

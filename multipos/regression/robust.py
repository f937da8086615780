"""Tests of coefficients where rows depend on each other, by cluster or in time.

The covariances and the law of F_robust are those of `multipos.regression.correlation`.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import LinearFit, solve
from multipos.numerics.quantiles import f_tail
from multipos.numerics.terms import CONSTANT, Term
from multipos.regression.correlation import (
    cluster_covariance,
    effective_size,
    hac_covariance,
    lag_one,
    wald,
    window_dof,
)
from multipos.regression.observations import Data
from multipos.regression.runs import runs_lost
from multipos.regression.segment import Robust
from multipos.regression.whitening import Whitening

RowDependence = Literal["hac", "effective"]
ROBUST: tuple[RowDependence, ...] = get_args(RowDependence)


class General(NamedTuple):
    """The same terms fitted to rows made independent by one law of their noise."""

    values: Array
    covariance: Array
    dof: int


class RobustFit(NamedTuple):
    """Robust covariance of all coefficients of a fit, and what goes with it.

    `shown` is whether correlation is beyond chance, `general` the fit by every plausible law.
    """

    covariance: Array
    kind: str
    nu: float
    n_effective: float
    lag_one: float
    shown: bool = True
    general: tuple[General, ...] = ()

    def turned(self, L: Array) -> "RobustFit":
        """Return the fit of coefficients that are L times these."""
        general = tuple(
            one._replace(values=L @ one.values, covariance=L @ one.covariance @ L.T)
            for one in self.general
        )
        return self._replace(covariance=L @ self.covariance @ L.T, general=general)


def robust_fit(
    found: LinearFit, X: Array, data: Data, dependence: RowDependence
) -> RobustFit | None:
    """Return the robust covariance where a cluster column or a time column calls for one.

    Parameters
    ----------
    found : LinearFit
    X : (n, q) array
        The columns it was found from.
    data : Data
        Its rows.
    dependence : str
        'hac' or 'effective', where rows are found correlated in time.
    """
    if found.dof <= 0 or not found.rss:
        return None
    e, cofactor, noise = found.residuals, found.cofactor, data.noise
    rho, correlated = (0.0, False) if data.order is None else lag_one(e, data.order)
    correlated |= noise is not None and noise.law is not None
    size = effective_size(e, data.order) if correlated and data.order is not None else len(e)
    if data.cluster is not None:
        covariance, m = cluster_covariance(X, e, cofactor, data.cluster)
        return RobustFit(covariance, "cluster", m - 1.0, size, rho)
    if data.order is None:
        return None
    if dependence == "hac":
        general = _by_plausible_laws(X, data)
        if not correlated and not general:
            return None
        covariance = hac_covariance(X, e, cofactor, data.order)
        nu = window_dof(e, data.order)
        return RobustFit(covariance, "hac", nu, size, rho, correlated, general)
    if not correlated:
        return None
    nu = size - X.shape[1]
    scale = found.dof / nu if nu > 0.0 else np.nan
    covariance = cofactor * (float(found.rss) / found.dof)
    return RobustFit(covariance * scale, "effective", nu, size, rho)


def _by_plausible_laws(X: Array, data: Data) -> tuple[General, ...]:
    """Return the fit to rows made independent by each plausible law of their noise."""
    if data.order is None or data.noise is None:
        return ()
    both, found = np.column_stack([X, data.response]), []
    for law in data.noise.plausible:
        white = Whitening(data.order, law)(both)
        fit = solve(white[:, :-1], white[:, -1])
        dof = fit.dof - runs_lost(data)
        if dof > 0:
            found.append(General(fit.coefficients, fit.cofactor * (float(fit.rss) / dof), dof))
    return tuple(found)


def robust_test(
    fit: RobustFit | None,
    terms: tuple[Term, ...],
    values: Array,
    classical: tuple[float, int, int],
    confidence: float,
) -> Robust | None:
    """Return F_robust of a segment's slopes.

    By rows made independent, with the largest p of all plausible laws of their noise; else by eq.
    (5) of `multipos.regression.correlation`. None where there is no robust fit, and where
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
        tests = [_by_law(one, slopes) for one in fit.general]
        found = max(tests, key=lambda test: -1.0 if np.isnan(test.p) else test.p)
        level = 1.0 - confidence
        if not fit.shown and not _tested(*classical).p < level <= found.p:
            return None
    else:
        F, k = wald(values[slopes], fit.covariance[np.ix_(slopes, slopes)])
        nu = fit.nu
        if fit.kind != "effective":  # Hotelling's law for an estimated covariance
            F, nu = F * (nu - k + 1.0) / nu, nu - k + 1.0
        found = _tested(F, k, nu)
    dof = found.k, found.nu
    covariance = fit.covariance
    return Robust(fit.kind, covariance, found.F, found.p, dof, fit.nu, fit.n_effective, fit.lag_one)


class _Test(NamedTuple):
    """F on k and ν, and its p; NaN where there is nothing to test with."""

    F: float
    k: int
    nu: float
    p: float


def _by_law(one: General, slopes: list[int]) -> _Test:
    return _tested(*wald(one.values[slopes], one.covariance[np.ix_(slopes, slopes)]), one.dof)


def _tested(F: float, k: int, nu: float) -> _Test:
    if not (k and nu > 0.0) or np.isnan(F):
        return _Test(np.nan, k, nu, np.nan)
    return _Test(F, k, nu, f_tail(F, k, nu))

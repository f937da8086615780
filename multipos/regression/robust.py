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
    TimeOrder,
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
from multipos.regression.whitening import whitening_of

RowDependence = Literal["hac", "effective"]
ROBUST: tuple[RowDependence, ...] = get_args(RowDependence)


class General(NamedTuple):
    """The same terms fitted to rows made independent (`multipos.regression.whitening`)."""

    values: Array
    covariance: Array
    dof: int


class RobustFit(NamedTuple):
    """Robust covariance of all coefficients of a fit, and what goes with it."""

    covariance: Array
    kind: str
    nu: float
    n_effective: float
    lag_one: float
    general: General | None = None

    def turned(self, L: Array) -> "RobustFit":
        """Return the fit of coefficients that are L times these."""
        general = self.general
        if general is not None:
            turned = L @ general.covariance @ L.T
            general = general._replace(values=L @ general.values, covariance=turned)
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
    e, cofactor = found.residuals, found.cofactor
    rho, correlated, size = _neighbours(e, data.order)
    whitening = whitening_of(data.order, data.law)
    correlated |= whitening is not None
    if data.cluster is not None:
        covariance, m = cluster_covariance(X, e, cofactor, data.cluster)
        return RobustFit(covariance, "cluster", m - 1.0, size, rho)
    if data.order is None or not correlated:
        return None
    if dependence == "hac":
        covariance = hac_covariance(X, e, cofactor, data.order)
        general = None
        if whitening is not None:
            fit = solve(whitening(X), whitening(data.response))
            dof = fit.dof - runs_lost(data)
            general = General(fit.coefficients, fit.cofactor * (float(fit.rss) / dof), dof)
        return RobustFit(covariance, "hac", window_dof(e, data.order), size, rho, general)
    nu = size - X.shape[1]
    scale = found.dof / nu if nu > 0.0 else np.nan
    covariance = cofactor * (float(found.rss) / found.dof)
    return RobustFit(covariance * scale, "effective", nu, size, rho)


def _neighbours(e: Array, order: TimeOrder | None) -> tuple[float, bool, float]:
    """Return the correlation of neighbours, whether it is one, and how many rows they are worth."""
    if order is None:
        return 0.0, False, len(e)
    rho, correlated = lag_one(e, order)
    return rho, correlated, effective_size(e, order) if correlated else len(e)


def robust_test(fit: RobustFit, terms: tuple[Term, ...], values: Array) -> Robust:
    """Return F_robust of a segment's slopes.

    By rows made independent, where these tell how to make them so; else by eq. (5) of
    `multipos.regression.correlation`.
    """
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    g = fit.general or General(values, fit.covariance, 0)
    F, k = wald(g.values[slopes], g.covariance[np.ix_(slopes, slopes)])
    nu = fit.nu if fit.general is None else float(g.dof)
    if (
        fit.general is None and fit.kind != "effective"
    ):  # Hotelling's law for an estimated covariance
        F, nu = F * (nu - k + 1.0) / nu, nu - k + 1.0
    if not (k and nu > 0.0):
        F = np.nan
    p = f_tail(F, k, nu) if F == F else np.nan
    return Robust(fit.kind, fit.covariance, F, p, (k, nu), fit.nu, fit.n_effective, fit.lag_one)

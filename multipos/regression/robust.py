"""Tests of coefficients where rows depend on each other, by cluster or in time.

The covariances and the law of F_robust are those of `multipos.regression.correlation`.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np

from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import LinearFit
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
from multipos.regression.segment import Robust

RowDependence = Literal["hac", "effective"]
ROBUST: tuple[RowDependence, ...] = get_args(RowDependence)


class RobustFit(NamedTuple):
    """Robust covariance of all coefficients of a fit, and what goes with it."""

    covariance: Array
    kind: str
    nu: float
    n_effective: float
    lag_one: float


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
    if data.cluster is not None:
        covariance, m = cluster_covariance(X, e, cofactor, data.cluster)
        return RobustFit(covariance, "cluster", m - 1.0, size, rho)
    if data.order is None or not correlated:
        return None
    if dependence == "hac":
        covariance = hac_covariance(X, e, cofactor, data.order)
        return RobustFit(covariance, "hac", window_dof(e, data.order), size, rho)
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
    """Return F_robust of a segment's slopes, eq. (5) of `multipos.regression.correlation`."""
    slopes = [i for i, term in enumerate(terms) if term != CONSTANT]
    F, k = wald(values[slopes], fit.covariance[np.ix_(slopes, slopes)])
    nu = fit.nu
    if fit.kind != "effective":  # Hotelling's law for an estimated covariance
        F, nu = F * (nu - k + 1.0) / nu, nu - k + 1.0
    if not (k and nu > 0.0):
        F = np.nan
    p = f_tail(F, k, nu) if F == F else np.nan
    return Robust(fit.kind, fit.covariance, F, p, (k, nu), fit.nu, fit.n_effective, fit.lag_one)

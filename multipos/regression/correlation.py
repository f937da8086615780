"""Covariance of a regression whose rows are correlated in time.

`time_order` returns the order of rows and the runs without a gap. `lag_one` is the correlation of
neighbours, `bandwidth` and `window_dof` how far it reaches and how many windows that leaves, and
`effective_size` the number of independent rows that these are worth. `hac_covariance` is that of
the coefficients, `wald` the F of some of them by it.

A chamber runs for hours and is logged every second: neighbouring rows carry nearly the same error,
and n rows count as far fewer. The classical covariance s² (X'X)⁻¹ divides by n all the same and
calls everything significant. With the scores g_k = x_k e_k of a row it is

    (X'X)⁻¹ S (X'X)⁻¹,    S = Σ_l (1 − |l|/B) Σ_k g_k g_{k+l}',                            (1)

whose bandwidth B follows the correlation ρ of neighbours (Andrews' rule for the triangular kernel),

    B = 1.1447 (α n)^(1/3) + 1,    α = 4 ρ² / ((1 − ρ)² (1 + ρ)²).                         (2)

(1) alone is too small where rows are strongly correlated. So each column of scores is whitened
first, h_k = g_k − a g_{k−1} with its own lag-1 correlation a, (1) is formed of h, and its rows and
columns are divided by 1 − a; times n/(n−p), because residuals are smaller than errors. The
triangular kernel is what moving sums of B neighbours give, S = (1/B) Σ M M', so its cost does not
depend on B. Rows on both sides of a gap in time are not neighbours. The effective number of rows is

    n_eff = n γ / S_e,    γ = Σ e²,  S_e as (1) of the residuals alone.                     (3)

Over the k slopes b with robust covariance C,

    F_robust = (b' C⁻¹ b / k) (ν − k + 1)/ν      on k and ν − k + 1 degrees of freedom       (4)

(Hotelling's law), ν = 3 n / 2B, B of the residuals before whitening, as a triangular window has; t
has ν. A run that is short beside its own memory cannot be judged well so: at a stated 5 % the false
alarms of (4) with four slopes, errors and factors all of lag-1 correlation ρ, are 4 to 11 % at
ρ = .5 (100 to 2000 rows), 3 to 11 % at .9 (500 to 2000), 23 % at .9 with 100 rows, where the
classical F gives 24, 90 and 92 %. (4) therefore stands in only where
`multipos.regression.whitening` finds no law of the noise.

Sources: W. K. Newey, K. D. West, Econometrica 55, 1987; D. W. K. Andrews, Econometrica 59, 1991,
eq. (6.2); D. W. K. Andrews, J. C. Monahan, Econometrica 60, 1992 (whitening); G. V. Bayley,
J. M. Hammersley, J. R. Stat. Soc. Suppl. 8, 1946 (effective size).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.numerics.arrays import Array, median
from multipos.results import frozen

_GAP = 5.0  # median intervals without a row that end a run
_CLEARLY = 2.33  # standard deviations of the lag-1 correlation of independent rows: 1 % above it
_HALF = 0.97  # largest lag-1 correlation that is taken at its word


@frozen
class TimeOrder:
    """Rows in the order of time, and which run without a gap each belongs to."""

    order: NDArray[np.intp]
    run: NDArray[np.intp]

    def of(self, rows: NDArray[np.intp]) -> "TimeOrder":
        """Return the order of some of the rows; the rows left out part the runs."""
        position = np.empty(len(self.order), dtype=np.intp)
        position[self.order] = np.arange(len(self.order))
        place = np.sort(position[rows])
        back = np.full(len(self.order), -1, dtype=np.intp)
        back[rows] = np.arange(len(rows))
        apart = np.diff(place) > 1
        run = self.run[place] + np.concatenate(([0], np.cumsum(apart)))
        return TimeOrder(back[self.order[place]], run)


def time_order(time: ArrayLike, run: NDArray[np.intp] | None = None) -> TimeOrder:
    """Return the order of rows in time, run by run; an interval above five medians is a gap."""
    t = np.asarray(time, dtype=np.float64)
    runs = np.zeros(len(t), dtype=np.intp) if run is None else run
    order = np.lexsort((t, runs))
    apart = np.diff(runs[order]) > 0
    steps = np.diff(t[order])
    moving = steps[(steps > 0.0) & ~apart]  # rows may share a time stamp
    gap = apart | (steps > (_GAP * float(median(moving)) if len(moving) else 0.0))
    return TimeOrder(order, np.concatenate(([0], np.cumsum(gap))).astype(np.intp))


def lag_one(residuals: Array, order: TimeOrder) -> tuple[float, bool]:
    """Return the correlation of neighbouring residuals, and whether it is beyond chance (1 %)."""
    e = residuals[order.order]
    beside = order.run[1:] == order.run[:-1]
    pairs = int(beside.sum())
    power = float(e @ e)
    if pairs < 3 or power == 0.0:
        return 0.0, False
    rho = float((e[1:] * e[:-1])[beside].sum()) / power * (len(e) / pairs)
    return rho, rho > _CLEARLY / np.sqrt(pairs)


def bandwidth(rho: float, n: int) -> int:
    """Return B of eq. (2), at most a third of the rows."""
    rho = min(max(rho, 0.0), _HALF)
    alpha = 4.0 * rho**2 / ((1.0 - rho) ** 2 * (1.0 + rho) ** 2)
    return max(1, min(int(1.1447 * (alpha * n) ** (1.0 / 3.0)) + 1, n // 3))


def window_dof(residuals: Array, order: TimeOrder) -> float:
    """Return ν of eq. (4): how many independent windows the rows make."""
    n = len(residuals)
    return 1.5 * n / bandwidth(lag_one(residuals, order)[0], n)


def effective_size(residuals: Array, order: TimeOrder) -> float:
    """Return the number of independent rows equivalent to correlated ones, eq. (3)."""
    n = len(residuals)
    power = float(residuals @ residuals)
    if power == 0.0:
        return float(n)
    long_run = float(_long_run(residuals[:, np.newaxis], order)[0, 0])
    return n / max(long_run / power, 1.0)


def hac_covariance(design: Array, residuals: Array, cofactor: Array, order: TimeOrder) -> Array:
    """Return the covariance (p, p) of coefficients by eq. (1), whitened first.

    Parameters
    ----------
    design : (n, p) array
    residuals : (n,) array
    cofactor : (p, p) array
        (X'X)⁻¹.
    order : TimeOrder
    """
    n, p = design.shape
    S = _long_run(_influence(design, residuals, cofactor), order)
    return np.asarray(S * n / (n - p))


def _influence(design: Array, residuals: Array, cofactor: Array) -> Array:
    """What each row adds to the coefficients, (X'X)⁻¹ x_k e_k."""
    return np.asarray((design * residuals[:, np.newaxis]) @ cofactor)


def _long_run(scores: Array, order: TimeOrder) -> Array:
    """S of eq. (1) for scores (n, p), by way of whitened ones."""
    g = scores[order.order]
    first = np.concatenate(([True], order.run[1:] != order.run[:-1]))
    beside = ~first[1:]
    power = (g**2).sum(axis=0)
    pairs = max(int(beside.sum()), 1)
    a = (g[1:] * g[:-1])[beside].sum(axis=0) / np.where(power > 0.0, power, 1.0)
    a *= len(g) / pairs
    # an estimated correlation is too small by (1 + 3a)/n on average
    a = np.clip(a + np.where(a > 0.0, (1.0 + 3.0 * a) / len(g), 0.0), -_HALF, _HALF)
    h = g.copy()
    h[1:][beside] -= a * g[:-1][beside]
    h[first] *= np.sqrt(1.0 - a**2)  # as a first value of its kind
    left = float((h[1:] * h[:-1])[beside].sum()) / max(float((h**2).sum()), 1e-300)
    S = _moving_power(h, np.flatnonzero(first), bandwidth(abs(left), len(h)))
    return np.asarray(S / np.outer(1.0 - a, 1.0 - a))


def _moving_power(g: Array, starts: NDArray[np.intp], width: int) -> Array:
    """Σ_l (1 − |l|/B) Σ_k g_k g_{k+l}' within runs, from sums over B neighbours."""
    total = np.zeros((g.shape[1], g.shape[1]))
    for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(g)], strict=True):
        run = g[start:end]
        if width == 1 or len(run) == 1:
            total += run.T @ run
            continue
        # every window that touches the run: sums[k + B] − sums[k] over zeros on both sides
        sums = np.cumsum(np.pad(run, ((width, width - 1), (0, 0))), axis=0)
        moving = sums[width:] - sums[:-width]
        total += moving.T @ moving / width
    return total


def wald(coefficients: Array, covariance: Array) -> tuple[float, int]:
    """Return b' C⁻¹ b / k and k, the number of independent coefficients."""
    scale = np.sqrt(np.diag(covariance))
    if not len(scale) or not (scale > 0.0).all():
        return float("nan"), len(coefficients)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    part = vectors[:, kept].T @ (coefficients / scale)
    rank = int(kept.sum())
    return float((part**2 / values[kept]).sum()) / rank, rank

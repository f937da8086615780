"""Predictions of a regression, with their uncertainty, and which rows are outside it.

`predict_uncertainty` returns u and U of rows, `predict_clamped` what is predicted of rows whose
variables are held in range, which `hold_inside` does. `place_rows` returns the segment of every
row, and `thermal_balance` what is predicted where nothing heats or cools.

    predicted = x'b,        u² = x' C x + s²,        U = k u,                               (1)

with x the terms of a row, C the covariance of the segment's coefficients (the robust one where rows
were correlated) and s the noise of one row: stated, else the rms that the model left in that
segment, which is of the same residuals as C, so that k is Student's t at their degrees of freedom.
Beside a stated noise these grow by Welch and Satterthwaite, (u/u_C)⁴ times.

Where runs are distinguished (``regress --run``) the next one has a zero of its own, with the
scatter of those that were seen: u and U are those of eq. (3) of `multipos.regression.runs`.

A row is outside where a variable that its segment's model uses, or the segment variable itself,
leaves what the rows of the fit covered, or where all together leave the region that these filled
(`multipos.regression.region`). A polynomial says nothing there.

**Thermal balance.** A model of rates is measured while the chamber heats and cools, and used where
it does neither. So it is looked at there: all rates at 0, every ambient temperature (a name that
begins ``ambient``) equal to the temperature, other variables at their means, at points over the
range of temperature.
"""

from collections.abc import Mapping

import numpy as np

from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import coverage_by_tenths, coverage_factor
from multipos.regression.observations import Rows
from multipos.regression.regression import Balance, Regression, predict_rows
from multipos.regression.segment import combined_variance

_POINTS = 21  # over the range of temperature


def place_rows(
    regression: Regression, columns: Mapping[str, Array], rows: int, run: Rows | None
) -> Rows:
    """Return the number of the segment of every row; without a predictor there is one segment."""
    return regression.segment_of(columns, run) if columns else np.zeros(rows, dtype=np.intp)


def predict_clamped(
    regression: Regression, columns: Mapping[str, Array], rows: int, run: Rows | None
) -> tuple[Array, Mask]:
    """Return what is predicted of rows with their variables held in range, and which had to be."""
    place = place_rows(regression, columns, rows, run)
    beyond, clamped = hold_inside(regression, columns, place)
    return predict_rows(regression, clamped, place), beyond


def predict_uncertainty(
    regression: Regression, columns: Mapping[str, Array], place: Places, sd: Array | None
) -> tuple[Array, Array]:
    """Return u and U (n,) of eqs. (1) and (2); `sd` None: the noise that each segment left."""
    u, U = np.empty(len(place)), np.empty(len(place))
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        X = segment.design(columns, rows)
        own = combined_variance(X, segment.robust_covariance)
        variance = own + (segment.rms**2 if sd is None else sd[rows] ** 2)
        nu = segment.robust_dof
        k: Array | float = coverage_factor(regression.confidence, nu)
        if sd is not None:
            with np.errstate(divide="ignore"):
                dof = nu * np.where(own > 0.0, variance / own, np.inf) ** 2
            k = coverage_by_tenths(regression.confidence, dof)
        u[rows], U[rows] = np.sqrt(variance), k * np.sqrt(variance)
        if segment.between is not None:
            m, scatter = segment.between.runs, segment.between.variance(columns, rows)
            u[rows] = np.sqrt(variance + scatter)
            k_runs = coverage_factor(regression.confidence, m - 1.0)
            rest = np.maximum(variance - scatter / m, 0.0)
            U[rows] = np.sqrt(k_runs**2 * (1.0 + 1.0 / m) * scatter + k**2 * rest)
    return u, U


def hold_inside(
    regression: Regression, columns: Mapping[str, Array], place: Places
) -> tuple[Mask, dict[str, Array]]:
    """Return which rows leave what their segment was fitted to, and the columns clamped to it."""
    beyond = np.zeros(len(place), dtype=bool)
    clamped = {name: column.copy() for name, column in columns.items()}
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        limits = {name: segment.limits[name] for name in segment.used if name in segment.limits}
        if regression.segment_variable is not None:  # the whole segment, also where no row fell
            limits[regression.segment_variable] = segment.range
        for name, (low, high) in limits.items():
            values = columns[name][rows]
            beyond[rows] |= (values < low) | (values > high)
            clamped[name][rows] = np.clip(values, low, high)
        if segment.region is not None:
            held = {name: clamped[name][rows] for name in segment.used}
            beyond[rows] |= segment.region.leverage(held, len(rows)) > segment.region.limit
    return beyond, clamped


def thermal_balance(regression: Regression, columns: Mapping[str, Array]) -> Balance | None:
    """Return what a regression predicts where nothing heats or cools; None without rates.

    Parameters
    ----------
    regression : Regression
    columns : mapping of str to (n,) array
        The rows of the fit.
    """
    names = list(dict.fromkeys((*regression.variables, *regression.needed)))
    variable = _temperature(regression, names)
    if variable is None:
        return None
    at = np.linspace(columns[variable].min(), columns[variable].max(), _POINTS)
    still = {name: np.full(_POINTS, columns[name].mean()) for name in names}
    for name in names:
        if name.endswith("_rate"):
            still[name] = np.zeros(_POINTS)
        elif name == variable or name.startswith("ambient"):
            still[name] = at
    place = regression.segment_of(still)
    beyond, _ = hold_inside(regression, still, place)
    _, U = predict_uncertainty(regression, still, place, None)
    return Balance(variable, at, predict_rows(regression, still, place), U, beyond)


def _temperature(regression: Regression, names: list[str]) -> str | None:
    """Return the variable whose rate is 0 in balance: the segments', else the first of a rate."""
    rates = [name for name in names if name.endswith("_rate")]
    sources = [name.removesuffix("_rate") for name in rates]
    variables = [regression.segment_variable, *sources, *(n for n in names if n not in rates)]
    known = [n for n in variables if n in names and n not in rates]
    return next((n for n in known if rates and not n.startswith("ambient")), None)

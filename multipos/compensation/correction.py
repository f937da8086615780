"""Apply a regression to a table: every column kept, the predicted response and what it corrects.

The response of a regression is usually an error, and what wants correcting another column:

    corrected = column − predicted,        u² = x' C x + s²,        U = k u,                 (1)

with x the terms of a row, C the covariance of the segment's coefficients (the robust one where rows
were correlated) and s the noise of one row: `u_<column>` of the table, else what `reading_sd`
states, else the rms that the model left in that segment, which is of the same residuals as C, so
that k is Student's t at their degrees of freedom. Beside a stated noise these grow by Welch and
Satterthwaite, (u/u_C)⁴ times.

Where runs are told apart (``regress --run``) the next one has a zero of its own, with the scatter
of those that were seen: u and U are those of eq. (3) of `multipos.regression.robust`.        (2)

A row is outside where a variable that its segment's model uses, or the segment variable itself,
leaves what the rows of the fit covered, or where all together leave the region that these filled
(`multipos.regression.region`). A polynomial says nothing there: the row is flagged, its variables
are clamped to the range, or the table is refused.
"""

from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from multipos.compensation.applying import AppliedColumns, Outside, check_outside
from multipos.compensation.reading_noise import check_noise_options
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Column, Source, Table, read_table
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import largest_value
from multipos.positions.reading_tables import nonnegative_column
from multipos.positions.readings import spread_reading_sd
from multipos.regression.observations import Rows, form_rate, number_labels
from multipos.regression.regression import Regression, Regressions
from multipos.results import require
from multipos.sensor.tilt import coverage_by_tenths


class Corrected(AppliedColumns):
    """A table with `predicted`, `corrected` and `outside` beside its columns."""


def correct(
    regression: Regression | Regressions,
    data: Source,
    *,
    column: Names | None = None,
    outside: Outside = "flag",
    uncertainty: bool = False,
    reading_sd: float | Sequence[float] | None = None,
    parameters_only: bool = False,
) -> Corrected:
    """Return the columns of a table with `predicted` and `corrected` beside them.

    Parameters
    ----------
    regression : Regression or Regressions
        Of several responses the columns added are ``predicted_NAME``, ``corrected_NAME`` ….
    data : path, mapping of columns, or data frame
        Must have the columns the model uses; rates are formed as they were for the fit.
    column : str, optional
        What is corrected; the response by default, and where that is not there nothing. Of several
        responses as many names.
    outside : str
        'flag' rows beyond what was fitted, 'clamp' their variables as well, or 'refuse' the table.
    uncertainty : bool
        Add `u_predicted`, `U_predicted`, `u_corrected`, `U_corrected`, eq. (1).
    reading_sd : float, optional
        Noise of one row of the column.
    parameters_only : bool
        Leave the noise of a row out.

    Returns
    -------
    Corrected

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> table = {"T": T, "error": 0.01 + 5e-4 * T + 1e-4 * np.sin(7.0 * T)}
    >>> found = mp.regress(table, response="error", variables="T")
    >>> left = mp.correct(found, table)
    >>> list(left)
    ['T', 'error', 'predicted', 'corrected', 'outside']
    >>> bool(np.abs(left.corrected).max() < 0.01 * np.abs(table["error"]).max())
    True
    """
    require(regression, Regression, Regressions, reader="multipos.load_regression")
    check_outside(outside)
    check_noise_options(uncertainty, reading_sd, parameters_only)
    table = read_table(data, what="data")
    if isinstance(regression, Regressions):
        return _correct_each(
            regression, table, column, outside, uncertainty, reading_sd, parameters_only
        )
    target = _target(regression, table, column)
    run = read_runs(regression, table)
    columns = read_predictors(regression, table, run)
    place = place_rows(regression, columns, table.rows, run)
    beyond, clamped = _outside(regression, columns, place)
    if outside == "refuse":
        _refuse_outside(table, target or next(iter(columns), ""), beyond)
    used = clamped if outside == "clamp" else columns
    predicted = _predict(regression, used, place)
    values: dict[str, Array] = {"predicted": predicted}
    if target is not None:
        values["corrected"] = table.number(target, largest=LARGEST) - predicted
    added: dict[str, Column] = dict(values)
    noise: str | None = None
    told: tuple[str, ...] = ()
    if uncertainty:
        noise, sd = _noise(regression, table, target, reading_sd, parameters_only)
        u, U = _uncertainty(regression, used, place, sd)
        added |= {f"{size}_{name}": each for name in values for size, each in (("u", u), ("U", U))}
        told = (f"u_… and U_… hold the noise of one row: {noise}",)
    if target is None:
        told = (f"no column '{regression.response}' to correct: predicted only", *told)
    added["outside"] = beyond.astype(np.int64)
    return Corrected(_beside(table, added), noise, told)


def _beside(table: Table, added: Mapping[str, Column]) -> dict[str, Column]:
    """Return the columns of a table and behind them those that are added."""
    twice = [name for name in added if name in table]
    if twice:
        raise MultiposError(
            f"{table.source}: column '{twice[0]}' is there already; rename it, apply writes it."
        )
    kept = {name: copy(column) for name, column in table.columns.items()}  # the caller's own stay
    return {**kept, **added}


def _correct_each(
    regressions: Regressions,
    table: Table,
    column: Names | None,
    outside: Outside,
    uncertainty: bool,
    reading_sd: float | Sequence[float] | None,
    parameters_only: bool,
) -> Corrected:
    """Return what `correct` adds by each of several regressions, named after its response."""
    targets = [None] * len(regressions) if column is None else split_names(column, "--correct")
    if len(targets) != len(regressions):
        raise UsageError(
            f"--correct names {len(targets)} columns for {len(regressions)} responses; name the "
            "column that each corrects, in their order."
        )
    added: dict[str, Column] = {}
    beyond = np.zeros(table.rows, dtype=np.int64)
    noises, told = [], []
    for (name, one), target in zip(regressions.items(), targets, strict=True):
        found = correct(
            one,
            table,
            column=target,
            outside=outside,
            uncertainty=uncertainty,
            reading_sd=reading_sd,
            parameters_only=parameters_only,
        )
        beyond |= np.asarray(found["outside"])
        mine = [key for key in found if key not in table and key != "outside"]
        added |= {f"{key}_{name}": found[key] for key in mine}
        noises.append(found.noise)
        told += [f"{name}: {said}" for said in found.warnings]
    added["outside"] = beyond
    return Corrected(_beside(table, added), noises[0], tuple(told))


def _target(regression: Regression, table: Table, names: Names | None) -> str | None:
    """Return the column to correct; None where none is named and the response is not there."""
    if names is None:
        return regression.response if regression.response in table else None
    column = names if isinstance(names, str) else ",".join(names)
    if column not in table:
        raise MultiposError(
            f"{table.source}: no column '{column}' to correct; name one with --correct, of "
            f"{', '.join(table.columns)}."
        )
    return column


def _noise(
    regression: Regression,
    table: Table,
    target: str | None,
    reading_sd: float | Sequence[float] | None,
    parameters_only: bool,
) -> tuple[str, Array | None]:
    """Return which noise a row has, in words, and its size (n,); None: what the model left."""
    stated = None if reading_sd is None else spread_reading_sd(reading_sd, (table.rows, 1))[:, 0]
    beside = f"u_{target or regression.response}"
    if parameters_only:
        return "none: parameters only", np.zeros(table.rows)
    if beside in table:
        return f"{beside} of the data", nonnegative_column(table, beside)
    if stated is not None:
        return "--reading-sd", stated
    return "what the regression left of its own rows", None


def place_rows(
    regression: Regression, columns: Mapping[str, Array], rows: int, run: Rows | None
) -> Rows:
    """Return the number of the segment of every row; without a predictor there is one segment."""
    return regression.segment_of(columns, run) if columns else np.zeros(rows, dtype=np.intp)


def predict_clamped(
    regression: Regression, columns: Mapping[str, Array], rows: int, run: Rows | None
) -> tuple[Array, NDArray[np.bool_]]:
    """Return what is predicted of rows with their variables held in range, and which had to be."""
    place = place_rows(regression, columns, rows, run)
    beyond, clamped = _outside(regression, columns, place)
    return _predict(regression, clamped, place), beyond


def _refuse_outside(table: Table, target: str, beyond: NDArray[np.bool_]) -> None:
    if beyond.any():
        row = int(np.argmax(beyond))
        raise MultiposError(
            f"{table.where(row, target)}: the row is outside what the regression was fitted to "
            f"({int(beyond.sum())} of {table.rows} rows are); use --outside flag to see them."
        )


def _predict(
    regression: Regression, columns: Mapping[str, Array], place: NDArray[np.intp]
) -> Array:
    """Return what the regression predicts of every row."""
    predicted = np.empty(len(place))
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        predicted[rows] = segment.design(columns, rows) @ segment.values
    return predicted


def _uncertainty(
    regression: Regression,
    columns: Mapping[str, Array],
    place: NDArray[np.intp],
    sd: Array | None,
) -> tuple[Array, Array]:
    """Return u and U (n,) of eqs. (1) and (2); `sd` None: the noise that each segment left."""
    u, U = np.empty(len(place)), np.empty(len(place))
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        X = segment.design(columns, rows)
        robust = segment.robust
        C = segment.covariance if robust is None else robust.covariance
        own = np.einsum("ij,jk,ik->i", X, C, X)
        variance = own + (segment.rms**2 if sd is None else sd[rows] ** 2)
        nu = float(segment.dof[1]) if robust is None else robust.t_dof
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


def read_runs(regression: Regression, table: Table) -> Rows | None:
    """Return the number of every row's run; None where the table does not tell runs apart."""
    if regression.run is None or regression.run not in table:
        return None
    return number_labels(np.array(table.text(regression.run)))


def read_predictors(regression: Regression, table: Table, run: Rows | None) -> dict[str, Array]:
    """Return the columns that a prediction needs; rates from the time column as for the fit."""
    columns = {}
    terms = [term for segment in regression.segments for term in segment.terms]
    for name in regression.needed:
        window = None if name in table else regression.rates.get(name)
        if window is None or regression.time is None:
            _require_columns(table, [name])
            columns[name] = table.number(name, largest=largest_value(terms, name))
        else:
            source = name.removesuffix("_rate")
            _require_columns(table, [source, regression.time])
            at, values = (table.number(n, largest=LARGEST) for n in (regression.time, source))
            columns[name] = form_rate(at, values, window=window, causal=regression.causal, run=run)
    return columns


def _require_columns(table: Table, names: Sequence[str]) -> None:
    for name in names:
        if name not in table:
            raise MultiposError(
                f"{table.source}: no column '{name}', which this regression needs; "
                f"the columns are {', '.join(table.columns)}."
            )


def range_column(
    regression: Regression, table: Table, columns: Mapping[str, Array]
) -> tuple[str, Array]:
    """Return the variable to show errors against: that of the segments, else one that is there."""
    for name in (regression.range_variable, *regression.needed):
        if name in columns:
            return name, columns[name]
        if name in table:
            return name, table.number(name)
    return "row", np.arange(1.0, table.rows + 1.0)


def _outside(
    regression: Regression, columns: Mapping[str, Array], place: NDArray[np.intp]
) -> tuple[NDArray[np.bool_], dict[str, Array]]:
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

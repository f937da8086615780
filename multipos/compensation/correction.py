"""Apply a regression to a table: every column kept, the predicted response and what it corrects.

The response of a regression is usually an error, and what wants correcting another column:

    corrected = column − predicted,        u² = x' C x + rms²,                              (1)

with x the terms of a row, C the covariance of the segment's coefficients (the robust one where rows
were correlated) and rms what the model left in that segment.

A row is outside where a variable that its segment's model uses, or the segment variable itself,
leaves what the rows of the fit covered. A polynomial says nothing there: the row is flagged, its
variables are clamped to the range, or the table is refused.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.compensation.applying import Outside, check_outside
from multipos.errors import MultiposError
from multipos.files.tables import Column, Source, Table, read_table
from multipos.numerics.arrays import LARGEST, Array
from multipos.numerics.terms import largest_value
from multipos.regression.rates import smoothed_rate
from multipos.regression.result import Regression
from multipos.results import Columns


class Corrected(Columns):
    """A table with `predicted`, `corrected` and `outside` beside its columns."""

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"rows": n, "columns": {name: […]}}`` as what JSON can carry."""
        return {"rows": len(self["outside"]), **super().to_dict()}


def correct(
    regression: Regression,
    data: Source,
    *,
    column: str | None = None,
    outside: Outside = "flag",
    uncertainty: bool = False,
) -> Corrected:
    """Return the columns of a table with `predicted` and `corrected` beside them.

    Parameters
    ----------
    regression : Regression
    data : path, mapping of columns, or data frame
        Must have the columns the model uses; rates are formed as they were for the fit.
    column : str, optional
        What is corrected; the response by default.
    outside : str
        'flag' rows beyond what was fitted, 'clamp' their variables as well, or 'refuse' the table.
    uncertainty : bool
        Add `u_corrected`, eq. (1).

    Returns
    -------
    Corrected

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.
    """
    check_outside(outside)
    table = read_table(data, what="data")
    target = regression.response if column is None else column
    if target not in table:
        raise MultiposError(
            f"{table.source}: no column '{target}' to correct; name one with --correct, of "
            f"{', '.join(table.columns)}."
        )
    raw = table.number(target, largest=LARGEST)
    columns = read_predictors(regression, table)
    place = place_rows(regression, columns, table.rows)
    beyond, clamped = _outside(regression, columns, place)
    if outside == "refuse":
        _refuse_outside(table, target, beyond)
    predicted, u = _predict(regression, clamped if outside == "clamp" else columns, place)
    added: dict[str, Column] = {"predicted": predicted, "corrected": raw - predicted}
    if uncertainty:
        added["u_corrected"] = u
    added["outside"] = beyond.astype(np.int64)
    twice = [name for name in added if name in table]
    if twice:
        raise MultiposError(
            f"{table.source}: column '{twice[0]}' is there already; rename it, apply writes it."
        )
    kept = {name: copy(column) for name, column in table.columns.items()}  # the caller's own stay
    return Corrected({**kept, **added})


def place_rows(regression: Regression, columns: Mapping[str, Array], rows: int) -> NDArray[np.intp]:
    """Return the number of the segment of every row; without a predictor there is one segment."""
    return regression.segment_of(columns) if columns else np.zeros(rows, dtype=np.intp)


def _refuse_outside(table: Table, target: str, beyond: NDArray[np.bool_]) -> None:
    if beyond.any():
        row = int(np.argmax(beyond))
        raise MultiposError(
            f"{table.where(row, target)}: the row is outside what the regression was fitted to "
            f"({int(beyond.sum())} of {table.rows} rows are); use --outside flag to see them."
        )


def _predict(
    regression: Regression, columns: Mapping[str, Array], place: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return what the regression predicts of every row, and its standard uncertainty by eq. (1)."""
    predicted, u = np.empty(len(place)), np.empty(len(place))
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        X = segment.design(columns, rows)
        C = segment.covariance if segment.robust is None else segment.robust.covariance
        predicted[rows] = X @ segment.values
        u[rows] = np.sqrt(np.einsum("ij,jk,ik->i", X, C, X) + segment.rms**2)
    return predicted, u


def read_predictors(regression: Regression, table: Table) -> dict[str, Array]:
    """Return the columns that a prediction needs; rates from the time column as for the fit."""
    columns = {}
    terms = [term for segment in regression.segments for term in segment.terms]
    for name in regression.needed:
        window = None if name in table else regression.rates.get(name)
        if window is None or regression.time is None:
            _require_columns(table, [name])
            columns[name] = table.number(name, largest=largest_value(terms, name))
        else:
            columns[name] = _rate(table, name.removesuffix("_rate"), regression.time, window)
    return columns


def _rate(table: Table, source: str, time: str, window: float) -> Array:
    _require_columns(table, [source, time])
    at, values = (table.number(name, largest=LARGEST) for name in (time, source))
    return smoothed_rate(at, values, window=window)


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
        used = {f.variable for term in segment.terms for f in term.factors}
        limits = {name: segment.limits[name] for name in used if name in segment.limits}
        if regression.segment_variable is not None:  # the whole segment, also where no row fell
            limits[regression.segment_variable] = segment.range
        for name, (low, high) in limits.items():
            values = columns[name][rows]
            beyond[rows] |= (values < low) | (values > high)
            clamped[name][rows] = np.clip(values, low, high)
    return beyond, clamped

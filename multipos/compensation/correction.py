"""Apply a regression to a table: every column kept, the predicted response and what it corrects.

`correct` returns the table; `as_fitted` renames its columns to those of the regression,
`read_runs` and `read_predictors` read what is predicted from, and `range_column` returns the
variable against which errors are shown.

The response of a regression is usually an error, and what wants correcting another column:

    corrected = column − predicted,                                                         (1)

with the u and U of `multipos.regression.prediction`, which also tells which rows are outside what
was fitted: these are flagged, their variables are clamped to the range, or the table is refused.
The noise of one row is `u_<column>` of the table, else what `reading_sd` states, else what the
model left.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np

from multipos.compensation.added_columns import Outside, check_outside, find_outside
from multipos.compensation.applying import AppliedColumns
from multipos.compensation.reading_noise import check_noise_options
from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import Names, split_names
from multipos.files.tables import Column, Source, Table, read_table
from multipos.finding import Finding, Findings, about, in_order
from multipos.numerics.arrays import LARGEST, Array, Mask
from multipos.numerics.terms import largest_value
from multipos.positions.headers import in_celsius, under_names
from multipos.positions.reading_tables import nonnegative_column
from multipos.positions.readings import spread_reading_sd
from multipos.regression import prediction
from multipos.regression.observations import Rows, number_labels
from multipos.regression.rates import form_rate
from multipos.regression.regression import Regression, Regressions, predict_rows
from multipos.results import require


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
        Add `u_predicted`, `U_predicted`, `u_corrected`, `U_corrected`.
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
        how: dict[str, Any] = {"outside": outside, "uncertainty": uncertainty}
        how |= {"reading_sd": reading_sd, "parameters_only": parameters_only}
        each = partial(correct, data=table, **how)
        return _correct_each(regression, table, column, each)
    given = table
    asked = () if column is None else (column if isinstance(column, str) else ",".join(column),)
    table, notes = as_fitted(regression, table, asked)
    target = _target(regression, table, column)
    run = read_runs(regression, table)
    columns = read_predictors(regression, table, run)
    place = prediction.place_rows(regression, columns, table.rows, run)
    beyond, clamped = prediction.hold_inside(regression, columns, place)
    if outside == "refuse":
        _refuse_outside(table, target or next(iter(columns), ""), beyond, columns, clamped)
    used = clamped if outside == "clamp" else columns
    predicted = predict_rows(regression, used, place)
    values: dict[str, Array] = {"predicted": predicted}
    if target is not None:
        values["corrected"] = table.number(target, largest=LARGEST) - predicted
    added: dict[str, Column] = dict(values)
    noise: str | None = None
    raised: Findings = ()
    if uncertainty:
        noise, sd = _noise(regression, table, target, reading_sd, parameters_only)
        u, U = prediction.predict_uncertainty(regression, used, place, sd)
        added |= {f"{size}_{name}": each for name in values for size, each in (("u", u), ("U", U))}
        text = f"u_… and U_… include the noise of one row: {noise}"
        raised = (Finding("reading-noise", "note", text),)
    if target is None:
        text = (
            f"there is no column '{regression.response}' to correct; only predictions are written"
        )
        raised = (Finding("predicted-only", "note", text), *raised)
    raised = (*raised, *notes, *find_outside(int(beyond.sum()), table.rows))
    added["outside"] = beyond.astype(np.int64)
    return Corrected(_beside(given, added), noise, in_order(raised))


def as_fitted(
    regression: Regression, table: Table, more: Sequence[str] = ()
) -> tuple[Table, Findings]:
    """Return a table whose columns have the names and units of the fit, and what was converted.

    Parameters
    ----------
    regression : Regression
    table : Table
    more : sequence of str
        Other columns that are asked for.
    """
    r = regression
    sources = (name.removesuffix("_rate") for name in r.rates)
    wanted = (r.response, *r.needed, *sources, f"u_{r.response}", *more)
    named = tuple(name for name in (r.time, r.run) if name is not None)
    table, units = under_names(table, dict.fromkeys((*wanted, *named)))
    found: list[Finding] = []
    return in_celsius(table, units, found), tuple(found)


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
    correct_one: Callable[..., Corrected],
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
    noises: list[str | None] = []
    raised: list[Finding] = []
    for (name, one), target in zip(regressions.items(), targets, strict=True):
        found = correct_one(one, column=target)
        beyond |= np.asarray(found["outside"])
        mine = [key for key in found if key not in table and key != "outside"]
        added |= {f"{key}_{name}": found[key] for key in mine}
        noises.append(found.noise)
        raised += about(name, (each for each in found.findings if each.code != "outside"))
    added["outside"] = beyond
    raised += find_outside(int(beyond.sum()), table.rows)
    return Corrected(_beside(table, added), noises[0], in_order(raised))


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


def _refuse_outside(
    table: Table,
    target: str,
    beyond: Mask,
    columns: Mapping[str, Array],
    clamped: Mapping[str, Array],
) -> None:
    """Refuse rows outside; the first is named with the variable beyond its limits, if one is."""
    if beyond.any():
        row = int(np.argmax(beyond))
        name = next((n for n in columns if columns[n][row] != clamped[n][row]), target)
        raise MultiposError(
            f"{table.where(row, name)}: the row is outside what the regression was fitted to "
            f"({int(beyond.sum())} of {table.rows} rows are); use --outside flag to see them."
        )


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

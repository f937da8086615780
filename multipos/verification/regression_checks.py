"""A check of a regression on an independent run: errors before and after, and the run as a whole.

`check_regression` returns the errors of a run before and after correction, `check_regressions`
those of several responses.

A check takes the response on an independent run, before and after correction: it is an error that
the run knows, and what the regression leaves of it is

    e = response − predicted,    u² = x' C x + rms²,    U = k u,                            (1)

with u of eq. (1) of `multipos.compensation.correction`, that is of predicting one new row, and k
from Student's t. A column that is corrected by the same prediction (``apply --correct``) has the
same error left. Rows outside what the regression was fitted to are not counted, because it says
nothing there.

**The run as a whole.** Its rows are correlated, and share what is uncertain of the coefficients and
the zero of its switch-on. The rows are made independent by every law of their noise that they leave
plausible (`multipos.regression.whitening`), ẽ and X̃ are errors and terms then, Z̃ a constant for
each run (and the slope, where runs differ by it). What the terms explain of ẽ beyond Z̃, B an
orthonormal basis of theirs, and the zeros â = Z̃⁺ẽ have

    cov B'ẽ = s² I + B'X̃ C X̃'B,        cov â = s² (Z̃'Z̃)⁻¹ + Z̃⁺X̃ C (Z̃⁺X̃)' + Ψ,         (2)

s² of the rest of ẽ, C of the coefficients segment by segment, Ψ between runs. Each gives an F, on q
and the fewest ν of both, and on the columns of a run and m − 1, combined by Fisher's method; the
largest p of all laws is taken. Where no runs were distinguished there is no Ψ and no Z̃: the
constant stands among the terms, and another switch-on, whose zero moves by more than one run can
know, is rejected.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from multipos.compensation import correction
from multipos.errors import MultiposError
from multipos.files.numbers import p_in_words
from multipos.files.tables import Source, read_table
from multipos.finding import Finding, Findings, in_order
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import coverage_factor
from multipos.regression.correlation import TimeOrder, time_order
from multipos.regression.observations import Rows
from multipos.regression.prediction import place_rows
from multipos.regression.regression import Regression, Regressions
from multipos.regression.segment import Segment, format_span
from multipos.regression.whitening import Law, Whitening, find_noise
from multipos.verification.agreement import RATE, Agreement, no_agreement, root_of
from multipos.verification.consistency import Words, judge_together
from multipos.verification.verdicts import Check, family_confidence, judge_errors, require_limit

_LAWS = 12  # of the plausible ones: the likeliest ten are next to each other
_RANK = 1e-9
_WORDS = Words(
    "chi-square of the run",
    "F of the run against the regression, by rows made independent",
    "F of the run against the regression and of its switch-ons, combined by Fisher's method",
)


def check_regression(
    regression: Regression, data: Source, *, limit_g: float | None = None
) -> Check:
    """Return the errors of a run before and after correction, row by row and by segment.

    Parameters
    ----------
    regression : Regression
    data : path, mapping of columns, or data frame
        An independent run with the response and the columns that the model uses.
    limit_g : float, optional
        Largest error allowed, for a response in g.

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or every row is outside what was fitted.
    UsageError
        The limit is not above 0.
    """
    if limit_g is not None:
        require_limit("--limit-g", limit_g)
    r = regression
    table, _ = correction.as_fitted(r, read_table(data, what="run"))
    if r.response not in table:
        raise MultiposError(
            f"{table.source}: no column '{r.response}', the response; a check needs the error of "
            f"every row. The columns are {', '.join(table.columns)}."
        )
    found = correction.correct(r, table, uncertainty=True)
    outside = np.asarray(found["outside"]).astype(bool)
    if outside.all():
        raise MultiposError(
            f"{table.source}: all {table.rows} rows are outside what the regression was fitted to; "
            "a check needs a run within it."
        )
    run = correction.read_runs(r, table)
    columns = correction.read_predictors(r, table, run)
    place = place_rows(r, columns, table.rows, run)
    against, reference = correction.range_column(r, table, columns)
    after, u, U = (
        np.asarray(found[name])[:, None] for name in ("corrected", "u_corrected", "U_corrected")
    )
    counted = ~outside[:, None]
    nothing = np.array([np.nan])
    inside = np.flatnonzero(~outside)
    numbers = np.zeros(table.rows, dtype=np.intp) if run is None else run
    timed = r.time is not None and r.time in table
    clock = table.number(str(r.time)) if timed else np.arange(float(table.rows))
    whole = _judge_run(
        r,
        {name: column[inside] for name, column in columns.items()},
        place[inside],
        after[inside, 0],
        time_order(clock[inside], numbers[inside]),
        numbers[inside],
    )
    text = (
        f"{int(outside.sum())} of {table.rows} rows are outside the range of the regression and "
        "were not counted"
    )
    return Check(
        quantity=r.response,
        unit="" if limit_g is None else "g",
        axes=(r.response,),
        positions=tuple(str(row + 1) for row in range(table.rows)),
        reference=reference[:, None],
        before=table.number(r.response)[:, None],
        after=after,
        u=u,
        U=U,
        U_family=None if limit_g is None else U * _family_factor(r, int(counted.sum())),
        limit=limit_g,
        verdicts=judge_errors(after, U, limit_g, counted),
        counted=counted,
        linearity_percent={"before": nothing, "after": nothing},
        bias=None,
        scale=None,
        confidence=r.confidence,
        source=table.source,
        sha256=table.sha256,
        findings=(
            *_find_in_run(r, whole),
            *((Finding("outside", "warning", text),) if outside.any() else ()),
        ),
        calibration=r.created,
        against=against,
        segments=_rows_by_segment(r, place),
        consistency=whole,
    )


def _find_in_run(r: Regression, whole: Agreement) -> Findings:
    """Return that the run as a whole does not agree, and what a switch-on has to do with it."""
    if not whole.p < RATE:
        return ()
    text = f"the run disagrees with the regression beyond chance ({p_in_words(whole.p)})"
    action = "Find what differs: mounting, ageing, or the temperature profile."
    if r.run is None:
        text += "; without --run it has no variance between switch-ons"
        action = "Fit several switch-ons with --run."
    return (Finding("run-disagrees", "warning", text, action, outputs=(r.response,), p=whole.p),)


class _Rows(NamedTuple):
    """Errors of a run, the terms of all segments side by side, and what runs may differ by."""

    e: Array
    X: Array
    root: Array  # C^(1/2), block by block
    Z: Array  # (n, k runs), run after run; no column where runs were not distinguished


def _judge_run(
    r: Regression, columns: Mapping[str, Array], place: Rows, e: Array, order: TimeOrder, run: Rows
) -> Agreement:
    """Return the test of eq. (2) of rows within what was fitted."""
    if not all(np.isfinite(_covariance(s)).all() for s in r.segments):
        return no_agreement("the noise of the readings is not known")
    rows = _rows(r, columns, place, e, run)
    noise = find_noise(np.hstack([rows.X, rows.Z]), e, order)
    plausible = () if noise is None else noise.plausible[:_LAWS]
    laws = plausible or (Law(0.0, 0.0, np.zeros(0)),)
    found = [_judge_by(r, rows, Whitening(order, law)) for law in laws]
    tested = [one for one in found if one is not None]
    if not tested:
        return no_agreement("too few rows within what was fitted")
    return max(tested, key=lambda one: one.p)


def _covariance(segment: Segment) -> Array:
    """Return that of the coefficients (q, q); NaN where rows were too few to tell."""
    return segment.covariance if segment.robust is None else segment.robust.covariance


def _rows(r: Regression, columns: Mapping[str, Array], place: Rows, e: Array, run: Rows) -> _Rows:
    blocks, roots = [], []
    between: Array | None = None
    for i, s in enumerate(r.segments):
        mine = np.flatnonzero(place == i)
        block = np.zeros((len(e), len(s.terms)))
        block[mine] = s.design(columns, mine)
        blocks.append(block)
        roots.append(root_of(_covariance(s)))
        if s.between is not None and len(mine):
            z = s.between.columns(columns, mine)
            between = np.zeros((len(e), z.shape[1])) if between is None else between
            between[mine] = z
    size = sum(len(root) for root in roots)
    root, start = np.zeros((size, size)), 0
    for one in roots:
        root[start : start + len(one), start : start + len(one)] = one
        start += len(one)
    Z = np.zeros((len(e), 0))
    if between is not None:
        Z = np.hstack([between * (run == label)[:, None] for label in np.unique(run)])
    return _Rows(e, np.hstack(blocks), root, Z)


def _judge_by(r: Regression, rows: _Rows, white: Whitening) -> Agreement | None:
    """Return the test by one law of the noise; None where rows are too few."""
    q = rows.X.shape[1]
    both = white(np.column_stack([rows.e, rows.X, rows.Z]))
    e, X, Z = both[:, 0], both[:, 1 : q + 1], both[:, q + 1 :]
    L = X @ rows.root
    Q = np.linalg.qr(Z)[0]
    left, terms = e - Q @ (Q.T @ e), X - Q @ (Q.T @ X)
    scale = np.linalg.norm(terms, axis=0)
    U, d, _ = np.linalg.svd(terms / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    B = U[:, d > _RANK * d.max(initial=0.0)]
    nu = len(e) - Z.shape[1] - B.shape[1]
    if nu < 1 or not B.shape[1]:
        return None
    b = B.T @ left
    rest = left - B @ b
    s2 = float(rest @ rest) / nu
    if not s2 > 0.0:
        return None
    moves = B.T @ L
    fewest = min(float(s.dof[1] if s.robust is None else s.robust.t_dof) for s in r.segments)
    Q_terms = _weighed(b, s2 * np.eye(len(b)) + moves @ moves.T)
    outcome = [(Q_terms, float(len(b)), min(float(nu), fewest))]
    between = next((s.between for s in r.segments if s.between is not None), None)
    if between is not None and Z.shape[1]:
        k = len(between.covariance)
        inverse = np.linalg.pinv(Z)
        a, moves = inverse @ e, inverse @ L
        for i in range(0, Z.shape[1], k):
            one = slice(i, i + k)
            own = inverse[one] @ inverse[one].T
            V = s2 * own + moves[one] @ moves[one].T + between.covariance
            outcome.append((_weighed(a[one], V), float(k), between.runs - 1.0))
    return Agreement(*judge_together(outcome, _WORDS))


def _weighed(a: Array, V: Array) -> float:
    try:
        return float(a @ np.linalg.solve(V, a))
    except np.linalg.LinAlgError:  # a file may state a variance beside which no noise has digits
        return float(a @ np.linalg.pinv(V, hermitian=True) @ a)


def check_regressions(
    regressions: Regressions, data: Source, *, limit_g: float | None = None
) -> Check:
    """Return the errors of a run before and after, a column for each response.

    Parameters
    ----------
    regressions : Regressions
    data, limit_g
        As of `check_regression`.

    Raises
    ------
    MultiposError, UsageError
        As of `check_regression`.
    """
    table = read_table(data, what="run")
    found = [check_regression(r, table, limit_g=limit_g) for r in regressions.values()]
    first = found[0]
    same = all(one.segments == first.segments for one in found)
    nothing = np.full(len(found), np.nan)
    family = None
    if limit_g is not None:
        errors = sum(int(one.counted.sum()) for one in found)
        pairs = zip(regressions.values(), found, strict=True)
        family = np.hstack([one.U * _family_factor(r, errors) for r, one in pairs])
    by_row = ("reference", "before", "after", "u", "U", "verdicts", "counted")
    stacked: dict[str, Any] = {
        name: np.hstack([getattr(one, name) for one in found]) for name in by_row
    }
    return replace(
        first,
        quantity=", ".join(regressions),
        axes=tuple(regressions),
        U_family=family,
        **stacked,
        linearity_percent={"before": nothing, "after": nothing},
        findings=in_order(each for one in found for each in one.findings),
        segments=first.segments if same else {},
    )


def _family_factor(r: Regression, errors: int) -> float:
    """Return by how much U is larger for so many rows together, by the fewest dof of a segment."""
    nu = min(float(segment.dof[1]) for segment in r.segments)
    sharper = coverage_factor(family_confidence(r.confidence, errors), nu)
    return sharper / coverage_factor(r.confidence, nu)


def _rows_by_segment(r: Regression, place: Places) -> dict[str, Mask]:
    return {
        f"{number}: {format_span(r.range_variable, s.range, s.branch)}": place == number - 1
        for number, s in enumerate(r.segments, start=1)
    }

"""A check of a regression on an independent run: errors before and after, and the run as a whole.

`check_regression` returns the errors of a run before and after correction, of one response or of
several.

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
from typing import NamedTuple

import numpy as np

from multipos.compensation import correction
from multipos.errors import MultiposError
from multipos.files.numbers import p_in_words
from multipos.files.tables import Source, Table, read_table
from multipos.finding import Finding, Findings, in_order
from multipos.numerics.arrays import Array, Mask, Places
from multipos.numerics.quantiles import coverage_factor
from multipos.regression.correlation import TimeOrder, time_order
from multipos.regression.observations import Rows
from multipos.regression.prediction import place_rows
from multipos.regression.regression import Regression, Regressions, all_of
from multipos.regression.segment import Between, format_span
from multipos.regression.whitening import Law, Whitening, find_noise
from multipos.results import Frozen
from multipos.verification.agreement import RATE, Agreement, no_agreement, root_of
from multipos.verification.consistency import Words, judge_together
from multipos.verification.verdicts import Check, family_confidence, require_limit

_LAWS = 12  # of the plausible ones: the likeliest ten are next to each other
_RANK = 1e-9
_WORDS = Words(
    "chi-square of the run",
    "F of the run against the regression, by rows made independent",
    "F of the run against the regression and of its switch-ons, combined by Fisher's method",
)


class _Part(NamedTuple):
    """One response of a run: known and errors (n,), and what was found of it."""

    reference: Array
    before: Array
    after: Array
    u: Array
    U: Array
    counted: Mask
    against: str
    segments: Frozen[str, Mask]
    whole: Agreement


def check_regression(
    regression: Regression | Regressions, data: Source, *, limit_g: float | None = None
) -> Check:
    """Return the errors of a run before and after correction, a column for each response.

    Parameters
    ----------
    regression : Regression or Regressions
    data : path, mapping of columns, or data frame
        An independent run with the responses and the columns that the models use.
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
    several, table = all_of(regression), read_table(data, what="run")
    parts = [_check_one(r, table) for r in several]
    reference, before, after, u, U, counted = (
        np.column_stack(each) for each in list(zip(*parts, strict=True))[:6]
    )
    first = parts[0]
    same = all(part.segments == first.segments for part in parts)
    family = [_family_factor(r, int(counted.sum())) for r in several]
    nothing = np.full(len(several), np.nan)
    return Check(
        quantity=", ".join(r.response for r in several),
        unit="" if limit_g is None else "g",
        axes=tuple(r.response for r in several),
        positions=tuple(str(row + 1) for row in range(table.rows)),
        reference=reference,
        before=before,
        after=after,
        u=u,
        U=U,
        U_family=None if limit_g is None else U * family,
        limit=limit_g,
        counted=counted,
        linearity_percent={"before": nothing, "after": nothing},
        bias=None,
        scale=None,
        confidence=several[0].confidence,
        source=table.source,
        sha256=table.sha256,
        findings=in_order(
            finding
            for r, part in zip(several, parts, strict=True)
            for finding in (*_find_in_run(r, part.whole), *_find_outside(part))
        ),
        calibration=several[0].created,
        against=first.against,
        segments=first.segments if same else {},
        consistency=first.whole,
    )


def _check_one(r: Regression, data: Table) -> _Part:
    """Return the errors of one response."""
    table, _ = correction.as_fitted(r, data)
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
    after, u, U = (np.asarray(found[name]) for name in ("corrected", "u_corrected", "U_corrected"))
    inside = np.flatnonzero(~outside)
    numbers = np.zeros(table.rows, dtype=np.intp) if run is None else run
    timed = r.time is not None and r.time in table
    clock = table.number(str(r.time)) if timed else np.arange(float(table.rows))
    whole = _judge_run(
        r,
        {name: column[inside] for name, column in columns.items()},
        place[inside],
        after[inside],
        time_order(clock[inside], numbers[inside]),
        numbers[inside],
    )
    segments = Frozen(_rows_by_segment(r, place))
    before = table.number(r.response)
    return _Part(reference, before, after, u, U, ~outside, against, segments, whole)


def _find_outside(part: _Part) -> Findings:
    outside = int((~part.counted).sum())
    if not outside:
        return ()
    text = (
        f"{outside} of {len(part.counted)} rows are outside the range of the regression and were "
        "not counted"
    )
    return (Finding("outside", "warning", text),)


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
    L: Array  # X C^(1/2), segment by segment
    Z: Array  # (n, k runs), run after run; no column where runs were not distinguished


def _judge_run(
    r: Regression, columns: Mapping[str, Array], place: Rows, e: Array, order: TimeOrder, run: Rows
) -> Agreement:
    """Return the test of eq. (2) of rows within what was fitted."""
    if not all(np.isfinite(s.robust_covariance).all() for s in r.segments):
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


def _rows(r: Regression, columns: Mapping[str, Array], place: Rows, e: Array, run: Rows) -> _Rows:
    blocks, uncertain, smallest = [], [], _between(r)
    size = 0 if smallest is None else len(smallest.covariance)
    between = np.zeros((len(e), size))
    for i, s in enumerate(r.segments):
        mine = np.flatnonzero(place == i)
        block = np.zeros((len(e), len(s.terms)))
        block[mine] = s.design(columns, mine)
        blocks.append(block)
        uncertain.append(block @ root_of(s.robust_covariance))
        if s.between is not None:
            between[mine] = s.between.columns(columns, mine)[:, :size]
    Z = np.hstack([between * (run == label)[:, None] for label in np.unique(run)])
    return _Rows(e, np.hstack(blocks), np.hstack(uncertain), Z)


def _between(r: Regression) -> Between | None:
    """Return what runs differ by in every segment: a slope only where it is identifiable in all."""
    known = [s.between for s in r.segments if s.between is not None]
    return min(known, key=lambda each: len(each.covariance), default=None)


def _judge_by(r: Regression, rows: _Rows, white: Whitening) -> Agreement | None:
    """Return the test by one law of the noise; None where rows are too few."""
    e, X, L, Z = (white(columns) for columns in rows)
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
    fewest = min(s.robust_dof for s in r.segments)
    Q_terms = _weighed(b, s2 * np.eye(len(b)) + moves @ moves.T)
    outcome = [(Q_terms, float(len(b)), min(float(nu), fewest))]
    between = _between(r)
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
